//! A double-precision rasterizer that only measures footprints: every Gaussian against every pixel that it
//! can reach.

use glam::{DMat2, DVec2, DVec3};

use crate::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput},
    gaussians::Gaussians,
    motion::{
        moments::FootprintMoments,
        reweighting::{ExpectedMotion, Reweighting},
    },
    tracking::TrackField,
};

/// See [`weights`] for the conventions.
pub(super) struct DenseEngine;

impl Engine for DenseEngine {
    fn name(&self) -> &str {
        "dense"
    }

    fn render(&self, _: &Gaussians, _: &Camera, _: [f32; 3]) -> Result<Rendering, EngineError> {
        Err(EngineError::InvalidInput("the dense engine only measures footprints".into()))
    }

    fn footprint_moments(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        tracks: &TrackField,
        reweighting: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        let robust = |blend: &Blend| match reweighting {
            Some(reweighting) => robust_moments(blend, tracks, reweighting),
            None => moments(blend, tracks),
        };
        Ok(weights(gaussians, camera).iter().map(robust).collect())
    }

    fn session(&self, _: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        Err(EngineError::InvalidInput("the dense engine only measures footprints".into()))
    }
}

/// Blending weights `alpha * T` with their pixel's index, pixels ascending.
pub(super) type Blend = Vec<(usize, f64)>;

/// Blending weights of every Gaussian, by the constants of the golden data.
pub(super) fn weights(gaussians: &Gaussians, camera: &Camera) -> Vec<Blend> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let position = |i: usize| camera.to_camera(gaussians.mean(i));
    let mut order: Vec<usize> = (0..gaussians.len()).collect();
    order.sort_by(|&a, &b| position(a).z.total_cmp(&position(b).z));
    let mut transmittance = vec![1.0; width * height];
    let mut alive = vec![true; width * height];
    let mut weights = vec![Blend::new(); gaussians.len()];
    for i in order {
        let x = position(i);
        if x.z <= 0.01 {
            continue;
        }
        let clamp = |value: f64, focal: f64, centre: f64, size: u32| {
            let (size, margin) = (f64::from(size), 0.15 * f64::from(size) / focal);
            value.clamp(-centre / focal - margin, (size - centre) / focal + margin)
        };
        let clamped = DVec3::new(
            clamp(x.x / x.z, camera.fx, camera.cx, camera.width) * x.z,
            clamp(x.y / x.z, camera.fy, camera.cy, camera.height) * x.z,
            x.z,
        );
        let [u, v] = camera.world_jacobian(clamped);
        let covariance = gaussians.covariance(i);
        let uv = u.dot(covariance * v);
        let footprint = DMat2::from_cols(
            DVec2::new(u.dot(covariance * u) + 0.3, uv),
            DVec2::new(uv, v.dot(covariance * v) + 0.3),
        );
        let conic = footprint.inverse();
        let Some(centre) = camera.project(x) else { continue };
        let log_reach = (255.0 * gaussians.opacity(i)).ln();
        if log_reach <= 0.0 {
            continue;
        }
        let reach = |variance: f64| (2.0 * log_reach * variance).sqrt() + 1.0;
        let span = |centre: f64, reach: f64, size: usize| {
            let limit = |x: f64| x.clamp(0.0, size as f64) as usize;
            limit(centre - reach)..limit(centre + reach + 1.0)
        };
        for row in span(centre.y, reach(footprint.y_axis.y), height) {
            for column in span(centre.x, reach(footprint.x_axis.x), width) {
                let pixel = row * width + column;
                let d = DVec2::new(column as f64 + 0.5, row as f64 + 0.5) - centre;
                let alpha = (gaussians.opacity(i) * (-0.5 * d.dot(conic * d)).exp()).min(0.99);
                if !alive[pixel] || alpha < 1.0 / 255.0 {
                    continue;
                }
                if transmittance[pixel] * (1.0 - alpha) < 1e-4 {
                    alive[pixel] = false;
                    continue;
                }
                weights[i].push((pixel, alpha * transmittance[pixel]));
                transmittance[pixel] *= 1.0 - alpha;
            }
        }
    }
    weights
}

/// Centred moments of one footprint, fitted again as `reweighting` asks.
fn robust_moments(blend: &Blend, tracks: &TrackField, reweighting: &Reweighting) -> FootprintMoments {
    let mut found = moments(blend, tracks);
    for _ in 0..reweighting.passes {
        let Some(expected) = reweighting.expected(&found) else { break };
        found.reweigh(weighted_moments(blend, tracks, |source, target| share(&expected, source, target)));
    }
    found
}

/// What a pixel keeps of its weight.
fn share(expected: &ExpectedMotion, source: DVec2, target: DVec2) -> f64 {
    let residual = target - source - DVec2::from_array(expected.displacement);
    (-residual.length_squared() * expected.inverse_scale_squared).exp()
}

/// Centred moments of one footprint in two passes.
pub(super) fn moments(blend: &Blend, tracks: &TrackField) -> FootprintMoments {
    weighted_moments(blend, tracks, |_, _| 1.0)
}

/// The same with a share of each pixel's weight that depends on the pixel and its tracked position.
fn weighted_moments(
    blend: &Blend,
    tracks: &TrackField,
    share: impl Fn(DVec2, DVec2) -> f64,
) -> FootprintMoments {
    let mut m = FootprintMoments { blend_weight: blend.iter().map(|(_, w)| w).sum(), ..Default::default() };
    let width = tracks.width as usize;
    let usable =
        |pixel: usize| tracks.visible[pixel] && tracks.positions[pixel].iter().all(|c| c.is_finite());
    let visible: Vec<(f64, f64, DVec2, DVec2)> = blend
        .iter()
        .filter(|(pixel, _)| usable(*pixel))
        .map(|&(pixel, weight)| {
            let variance = f64::from(tracks.sigma[pixel]).powi(2);
            let source = DVec2::new((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
            let [x, y] = tracks.positions[pixel];
            let target = DVec2::new(x.into(), y.into());
            (weight / variance * share(source, target), variance, source, target)
        })
        .collect();
    if visible.is_empty() {
        return m;
    }
    m.pixels = visible.len() as u32;
    m.visible = blend.iter().filter(|(pixel, _)| usable(*pixel)).map(|(_, w)| w).sum();
    let (mut source, mut target) = (DVec2::ZERO, DVec2::ZERO);
    for (w, variance, s, t) in &visible {
        m.weight += w;
        m.weight_squared += w * w;
        m.variance += w * variance;
        source += *s * *w;
        target += *t * *w;
    }
    (source, target) = (source / m.weight, target / m.weight);
    (m.centroid, m.tracked_centroid) = (source.to_array(), target.to_array());
    for (w, _, s, t) in &visible {
        let (d, e) = (*s - source, *t - target);
        for (sum, product) in m.source.iter_mut().zip([d.x * d.x, d.x * d.y, d.y * d.y]) {
            *sum += w * product;
        }
        for (sum, product) in m.cross.iter_mut().zip([e.x * d.x, e.x * d.y, e.y * d.x, e.y * d.y]) {
            *sum += w * product;
        }
        m.target += w * e.length_squared();
    }
    m
}
