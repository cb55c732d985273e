//! An engine without images: its footprints have exact affine motions, plus noise on each.

use std::{collections::HashMap, f64::consts::PI};

use anyhow::{Context, Result};
use glam::{DMat2, DMat3, DVec2, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use splat::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput},
    gaussians::Gaussians,
    motion::{MotionSettings, moments::FootprintMoments, reweighting::Reweighting},
    tracking::TrackField,
};

use crate::corner::Motion;

/// Variance that rasterization adds to footprints, px².
const LOW_PASS: f64 = 0.3;
/// What exact tracks claim, px: the library's floor for imported ones.
const EXACT_SIGMA: f64 = 0.05;
/// Opacity over the least that is drawn.
const ALPHA_LEVELS: f64 = 255.0;

/// Moments of every Gaussian in every view such that their fit is `A_v + noise`.
///
/// A pixel follows the mean of the Gaussian's matter behind it: `A = T' F Σ Tᵀ (T Σ Tᵀ)⁻¹` with the Jacobians `T` at
/// the old and `T'` at the new mean and the gradient `F` of the motion. For flat Gaussians that is the motion of their
/// plane. Nothing hides anything.
pub(crate) struct NoisyFits {
    views: Vec<FittedView>,
    /// Index of each Gaussian by the bits of its mean: motion compensation orders Gaussians as it likes.
    index_of: HashMap<[u32; 3], usize>,
}

struct FittedView {
    camera: Camera,
    /// At weights of `alpha T`.
    moments: Vec<FootprintMoments>,
    /// Pixel that each Gaussian's centre lies in.
    centres: Vec<usize>,
    /// Median over the Gaussians of the standard deviation of a pixel's track.
    sigma: f32,
}

impl NoisyFits {
    /// `noise` is the standard deviation of every entry of `A`; that of the position is `noise` times the footprint's
    /// standard deviation, as independent errors of the pixels make them.
    pub(crate) fn new(
        gaussians: &Gaussians,
        cameras: &[Camera],
        motion: Motion,
        noise: f64,
        seed: u64,
    ) -> Result<Self> {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let mut views = Vec::with_capacity(cameras.len());
        for camera in cameras {
            let mut view =
                FittedView { camera: camera.clone(), moments: Vec::new(), centres: Vec::new(), sigma: 0.0 };
            let mut sigmas = Vec::with_capacity(gaussians.len());
            for index in 0..gaussians.len() {
                let footprint = Footprint::of(gaussians, index, camera, motion)
                    .context("every camera sees the corner before and after")?;
                sigmas.push(footprint.pixel_sigma(noise));
                view.centres.push(footprint.pixel(camera));
                view.moments.push(footprint.moments(gaussians.opacity(index), noise, &mut random));
            }
            sigmas.sort_by(f64::total_cmp);
            view.sigma =
                sigmas.get(sigmas.len() / 2).map_or(EXACT_SIGMA, |sigma| sigma.max(EXACT_SIGMA)) as f32;
            views.push(view);
        }
        let bits = |mean: &[f32; 3]| mean.map(f32::to_bits);
        let index_of = gaussians.means.iter().enumerate().map(|(index, mean)| (bits(mean), index)).collect();
        Ok(Self { views, index_of })
    }

    /// Fields to hand over with the cameras: they claim the right noise; their positions only say that nothing rests and that nothing leaves the image.
    pub(crate) fn tracks(&self) -> impl Iterator<Item = TrackField> + '_ {
        self.views.iter().map(|FittedView { camera, sigma, .. }| {
            let (width, height) = (camera.width, camera.height);
            let pixels = width as usize * height as usize;
            let elsewhere =
                |y: u32| (0..width).map(move |x| [((x + width / 2) % width) as f32 + 0.5, y as f32 + 0.5]);
            TrackField {
                width,
                height,
                positions: (0..height).flat_map(elsewhere).collect(),
                visible: vec![true; pixels],
                sigma: vec![*sigma; pixels],
            }
        })
    }
}

/// One Gaussian's footprint and its motion.
struct Footprint {
    centre: DVec2,
    target: DVec2,
    covariance: DMat2,
    gradient: DMat2,
}

impl Footprint {
    fn of(gaussians: &Gaussians, index: usize, camera: &Camera, motion: Motion) -> Option<Self> {
        let (mean, covariance) = (gaussians.mean(index), gaussians.covariance(index));
        let moved = motion.of(mean);
        let jacobian = |at: DVec3| camera.world_jacobian(camera.to_camera(at));
        let (old, new) = (jacobian(mean), jacobian(moved));
        let plain = between(old, covariance, old);
        let carried = between(new, motion.gradient(mean) * covariance, old);
        Some(Self {
            centre: camera.project_world(mean)?,
            target: camera.project_world(moved)?,
            covariance: plain + DMat2::from_diagonal(DVec2::splat(LOW_PASS)),
            gradient: carried * plain.inverse(),
        })
    }

    /// Geometric mean of the standard deviations, px.
    fn radius(&self) -> f64 {
        self.covariance.determinant().max(0.0).powf(0.25)
    }

    /// Number of pixels that would weigh as much if all weighed the same: `(Σw)² / Σw²` of a Gaussian.
    fn effective_pixels(&self) -> f64 {
        4.0 * PI * self.radius().powi(2)
    }

    /// Standard deviation of the pixels' tracks that makes the fit as uncertain as `noise` says, if errors are alike
    /// over the area that dense trackers match on.
    fn pixel_sigma(&self, noise: f64) -> f64 {
        let area = MotionSettings::default().noise_correlation_area;
        let independent = 1.0 + (self.effective_pixels() - 1.0).max(0.0) / area;
        noise * self.radius() * independent.sqrt()
    }

    fn pixel(&self, camera: &Camera) -> usize {
        let within = |value: f64, size: u32| (value.max(0.0) as usize).min(size as usize - 1);
        within(self.centre.y, camera.height) * camera.width as usize + within(self.centre.x, camera.width)
    }

    fn moments(&self, opacity: f64, noise: f64, random: &mut ChaCha8Rng) -> FootprintMoments {
        let mut draw = || noise * normal(random);
        let error = DMat2::from_cols(DVec2::new(draw(), draw()), DVec2::new(draw(), draw()));
        let gradient = self.gradient + error;
        let tracked = self.target + DVec2::new(draw(), draw()) * self.radius();
        let area = 2.0 * PI * self.radius().powi(2);
        let weight = opacity * area;
        let cross = gradient * self.covariance;
        let explained = cross * gradient.transpose();
        let unexplained = 2.0 * self.pixel_sigma(noise).powi(2);
        FootprintMoments {
            blend_weight: weight,
            visible: weight,
            weight,
            weight_squared: 0.5 * opacity * weight,
            pixels: (area * (ALPHA_LEVELS * opacity).ln().max(0.0)) as u32,
            centroid: self.centre.to_array(),
            tracked_centroid: tracked.to_array(),
            source: [self.covariance.x_axis.x, self.covariance.x_axis.y, self.covariance.y_axis.y]
                .map(|value| weight * value),
            cross: [cross.x_axis.x, cross.y_axis.x, cross.x_axis.y, cross.y_axis.y]
                .map(|value| weight * value),
            target: weight * (explained.x_axis.x + explained.y_axis.y + unexplained),
            variance: weight,
            contest: 0.0,
        }
    }
}

/// `a M bᵀ` of two Jacobians, given by their rows.
fn between(a: [DVec3; 2], middle: DMat3, b: [DVec3; 2]) -> DMat2 {
    let column = |of: DVec3| DVec2::new(a[0].dot(middle * of), a[1].dot(middle * of));
    DMat2::from_cols(column(b[0]), column(b[1]))
}

/// Box–Muller.
fn normal(random: &mut ChaCha8Rng) -> f64 {
    let radius = (-2.0 * (1.0 - random.random::<f64>()).ln()).sqrt();
    radius * (2.0 * PI * random.random::<f64>()).cos()
}

/// The moments if the weights are divided by the track's variance.
fn reweighted(moments: &FootprintMoments, variance: f64) -> FootprintMoments {
    let scale = 1.0 / variance;
    FootprintMoments {
        weight: moments.weight * scale,
        weight_squared: moments.weight_squared * scale * scale,
        source: moments.source.map(|value| value * scale),
        cross: moments.cross.map(|value| value * scale),
        target: moments.target * scale,
        ..*moments
    }
}

impl Engine for NoisyFits {
    fn name(&self) -> &str {
        "noisy fits"
    }

    fn render(&self, _: &Gaussians, _: &Camera, _: [f32; 3]) -> Result<Rendering, EngineError> {
        Err(EngineError::InvalidInput("this engine has no images".into()))
    }

    fn footprint_moments(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        tracks: &TrackField,
        _: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        let Some(view) = self.views.iter().find(|view| view.camera == *camera) else {
            return Err(EngineError::InvalidInput("a camera that was not prepared".into()));
        };
        let of = |mean: &[f32; 3]| {
            let index = self.index_of.get(&mean.map(f32::to_bits));
            let index = *index.ok_or_else(|| EngineError::InvalidInput("an unknown Gaussian".into()))?;
            let (moments, centre) = (&view.moments[index], view.centres[index]);
            if tracks.visible[centre] {
                return Ok(reweighted(moments, f64::from(tracks.sigma[centre]).powi(2)));
            }
            Ok(FootprintMoments { blend_weight: moments.blend_weight, ..FootprintMoments::default() })
        };
        gaussians.means.iter().map(of).collect()
    }

    fn session(&self, _: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        Err(EngineError::InvalidInput("this engine has no images".into()))
    }
}
