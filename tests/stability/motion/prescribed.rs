//! An engine whose footprints are prescribed: exact projections of points on a Gaussian, so that geometry alone is
//! under test.

use std::sync::Arc;

use glam::{DMat2, DMat3, DVec2, DVec3};
use splat::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput},
    gaussians::Gaussians,
    motion::{MotionView, moments::FootprintMoments, reweighting::Reweighting},
    raster::LOW_PASS,
    tracking::TrackField,
};

use super::{
    reference::LEAST_CLAIM,
    scene::{Rigid, normal, random},
};

/// Samples per side of a footprint, and how far they reach in standard deviations.
const SIDE: i32 = 5;
const REACH: f64 = 1.5;

/// One tracked point of a Gaussian.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sample {
    /// In the world, before the motion; not known of pixels.
    pub point: DVec3,
    /// Blending weight times pixels.
    pub weight: f64,
    pub from: DVec2,
    pub to: DVec2,
    /// Whether it is in front of the camera and inside the image in both frames.
    pub is_visible: bool,
}

/// How tracks err.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Noise {
    /// Each sample on its own.
    Independent(f64),
    /// All samples of a footprint alike.
    Alike(f64),
    /// Those of a square cell of pixels alike.
    Cells(f64),
}

impl Noise {
    pub(super) fn deviation(self) -> f64 {
        match self {
            Self::Independent(deviation) | Self::Alike(deviation) | Self::Cells(deviation) => deviation,
        }
    }
}

/// Effective number of samples, `(Σ w)² / Σ w²`.
pub(super) fn effective_samples(samples: &[Sample]) -> f64 {
    effective_number(samples.iter().map(|sample| sample.weight))
}

/// Effective number of parts of which the weights are given.
pub(super) fn effective_number(weights: impl Iterator<Item = f64>) -> f64 {
    let (sum, squares) = weights.fold((0.0, 0.0), |(sum, squares), w| (sum + w, squares + w * w));
    sum * sum / squares
}

/// A scene of which every tracked point of every Gaussian is known.
pub(super) trait Tracked {
    fn gaussians(&self) -> &Gaussians;
    fn cameras(&self) -> &[Camera];
    fn motion(&self) -> Rigid;
    fn noise(&self) -> Noise;
    /// Whether the track of the Gaussian at `mean` is wrong in this view.
    fn has_outlier(&self, mean: DVec3, camera: &Camera) -> bool;
    /// Whether most tracked points of the right views are right, so that falling back is not called for.
    fn is_answerable(&self) -> bool {
        true
    }
    /// Number of samples whose errors, independent of each other, would leave the same error in their mean: that of the
    /// parts of the footprint that err alike.
    fn independent_samples(&self, samples: &[Sample], _: &Camera) -> f64 {
        match self.noise() {
            Noise::Independent(_) => effective_samples(samples),
            Noise::Alike(_) | Noise::Cells(_) => 1.0,
        }
    }
    /// The rightly tracked points of a Gaussian in one view, with the noise of the tracks or without.
    fn samples(&self, index: usize, camera: &Camera, is_noisy: bool) -> Vec<Sample>;
}

/// A rigid body whose Gaussians are tracked at points of their own.
#[derive(Clone, Debug)]
pub(super) struct Scene {
    pub gaussians: Gaussians,
    pub cameras: Vec<Camera>,
    pub motion: Rigid,
    pub noise: Noise,
    /// Share of the views of each Gaussian whose track leads anywhere.
    pub outliers: f64,
    pub stray: Option<Stray>,
    pub seed: u64,
}

/// A Gaussian of the body that goes its own way, and that only the first views see.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stray {
    pub mean: DVec3,
    /// What it moves beyond the body.
    pub shift: DVec3,
    pub views: usize,
}

impl Scene {
    pub(super) fn views(&self) -> Vec<MotionView> {
        unread_tracks(&self.cameras)
    }
}

impl Tracked for Scene {
    fn gaussians(&self) -> &Gaussians {
        &self.gaussians
    }

    fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    fn motion(&self) -> Rigid {
        self.motion
    }

    fn noise(&self) -> Noise {
        self.noise
    }

    /// In exactly the stated share of the views, rounded down.
    fn has_outlier(&self, mean: DVec3, camera: &Camera) -> bool {
        let rank = |camera: &Camera| hash(self.seed ^ 0x5eed, mean, camera);
        let own = rank(camera);
        let before = self.cameras.iter().filter(|other| rank(other) < own).count();
        before < (self.outliers * self.cameras.len() as f64) as usize
    }

    fn samples(&self, index: usize, camera: &Camera, is_noisy: bool) -> Vec<Sample> {
        sampled(self, &self.gaussians, index, camera, is_noisy)
    }
}

impl Scene {
    /// The motion of the Gaussian at `mean`, and whether the camera sees it at all.
    fn motion_of(&self, mean: DVec3, camera: &Camera) -> (Rigid, bool) {
        match self.stray {
            Some(stray) if stray.mean == mean => {
                let shift = self.motion.shift + stray.shift;
                (Rigid { shift, ..self.motion }, self.cameras[..stray.views].contains(camera))
            }
            _ => (self.motion, true),
        }
    }
}

/// Points on the disc of a Gaussian. Depends on the Gaussian and the view by their values alone, so that an order of
/// the Gaussians other than the scene's makes no difference.
fn sampled(
    scene: &Scene,
    gaussians: &Gaussians,
    index: usize,
    camera: &Camera,
    is_noisy: bool,
) -> Vec<Sample> {
    let mean = gaussians.mean(index);
    let (motion, is_seen) = scene.motion_of(mean, camera);
    if camera.project_world(mean).is_none() {
        return Vec::new();
    }
    let mut random = random(hash(scene.seed, mean, camera));
    let mut pair = || DVec2::new(normal(&mut random), normal(&mut random));
    let size = DVec2::new(camera.width.into(), camera.height.into());
    let (anywhere, alike) = (pair() * size, pair());
    let is_lost = is_noisy && scene.has_outlier(mean, camera);
    let lost = (anywhere.rem_euclid(size) - camera.project_world(motion.of(mean)).unwrap_or_default())
        * f64::from(u8::from(is_lost));
    let [wide, high] = major_axes(gaussians, index);
    let step = 2.0 * REACH / f64::from(SIDE - 1);
    let grid = (0..SIDE * SIDE)
        .map(|k| DVec2::new(f64::from(k % SIDE), f64::from(k / SIDE)) * step - DVec2::splat(REACH));
    let mut samples: Vec<Sample> = grid
        .map(|at| {
            let point = mean + wide * at.x + high * at.y;
            let error = match scene.noise {
                _ if !is_noisy => DVec2::ZERO,
                Noise::Independent(deviation) => pair() * deviation,
                Noise::Alike(deviation) | Noise::Cells(deviation) => alike * deviation,
            };
            let from = camera.project_world(point);
            let to = camera.project_world(motion.of(point)).map(|exact| exact + lost + error);
            Sample {
                point,
                weight: (-0.5 * at.length_squared()).exp(),
                from: from.unwrap_or_default(),
                to: to.unwrap_or_default(),
                is_visible: is_seen && to.is_some_and(|to| camera.contains(to)) && from.is_some(),
            }
        })
        .collect();
    let total: f64 = samples.iter().map(|sample| sample.weight).sum();
    let unoccluded = unoccluded_weight(gaussians, index, camera);
    samples.iter_mut().for_each(|sample| sample.weight *= unoccluded / total);
    // What is not in the image at the key frame has no pixels.
    samples.retain(|sample| camera.contains(sample.from));
    samples
}

/// The two longest axes of a Gaussian, one standard deviation long.
pub(super) fn major_axes(gaussians: &Gaussians, index: usize) -> [DVec3; 2] {
    let axes = DMat3::from_quat(gaussians.rotation(index));
    let mut axes: [DVec3; 3] =
        std::array::from_fn(|k| axes.col(k) * f64::from(gaussians.log_scales[index][k]).exp());
    axes.sort_by(|a, b| b.length().total_cmp(&a.length()));
    [axes[0], axes[1]]
}

/// What the blending weights of a Gaussian with nothing before it add up to.
pub(super) fn unoccluded_weight(gaussians: &Gaussians, index: usize, camera: &Camera) -> f64 {
    let [u, v] = camera.world_jacobian(camera.to_camera(gaussians.mean(index)));
    let covariance = gaussians.covariance(index);
    let uv = u.dot(covariance * v);
    let footprint = DMat2::from_cols(
        DVec2::new(u.dot(covariance * u) + LOW_PASS, uv),
        DVec2::new(uv, v.dot(covariance * v) + LOW_PASS),
    );
    gaussians.opacity(index) * std::f64::consts::TAU * footprint.determinant().sqrt()
}

fn hash(seed: u64, mean: DVec3, camera: &Camera) -> u64 {
    let values = mean.to_array().into_iter().chain(camera.rotation.to_cols_array());
    let values = values.chain(camera.translation.to_array());
    values.fold(seed ^ 0xcbf2_9ce4_8422_2325, |hash, value| {
        (hash ^ value.to_bits()).wrapping_mul(0x0100_0000_01b3).rotate_left(29)
    })
}

/// Views whose tracks have a size but no pixels, for engines that do not read them.
pub(super) fn unread_tracks(cameras: &[Camera]) -> Vec<MotionView> {
    let view = |camera: &Camera| {
        let (width, height) = (camera.width, camera.height);
        let (positions, visible, sigma) = (Vec::new(), Vec::new(), Vec::new());
        let tracks = Arc::new(TrackField { width, height, positions, visible, sigma });
        MotionView { camera: camera.clone(), tracks }
    };
    cameras.iter().map(view).collect()
}

/// Measures the prescribed footprints of a scene, which have one surface each: nothing to weigh again.
pub(super) struct Prescribed<'a>(pub &'a Scene);

impl Engine for Prescribed<'_> {
    fn name(&self) -> &str {
        "prescribed"
    }

    fn render(&self, _: &Gaussians, _: &Camera, _: [f32; 3]) -> Result<Rendering, EngineError> {
        Err(EngineError::InvalidInput("prescribed footprints cannot be drawn".into()))
    }

    fn footprint_moments(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        _: &TrackField,
        _: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        let variance = self.0.noise.deviation().max(LEAST_CLAIM).powi(2);
        let of = |index| moments(&sampled(self.0, gaussians, index, camera, true), variance);
        Ok((0..gaussians.len()).map(of).collect())
    }

    fn session(&self, _: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        Err(EngineError::InvalidInput("prescribed footprints cannot be refined".into()))
    }
}

/// Centred moments in two passes, by their definition.
pub(super) fn moments(samples: &[Sample], variance: f64) -> FootprintMoments {
    let blend_weight: f64 = samples.iter().map(|sample| sample.weight).sum();
    let mut m = FootprintMoments { blend_weight, ..FootprintMoments::default() };
    let visible: Vec<&Sample> = samples.iter().filter(|sample| sample.is_visible).collect();
    if visible.is_empty() {
        return m;
    }
    let weight: f64 = visible.iter().map(|s| s.weight).sum();
    let mean = |of: fn(&Sample) -> DVec2| visible.iter().map(|s| of(s) * s.weight).sum::<DVec2>() / weight;
    let (source, target) = (mean(|s| s.from), mean(|s| s.to));
    m.pixels = visible.len() as u32;
    (m.centroid, m.tracked_centroid) = (source.to_array(), target.to_array());
    for sample in visible {
        let w = sample.weight / variance;
        let (d, e) = (sample.from - source, sample.to - target);
        m.weight += w;
        m.weight_squared += w * w;
        m.variance += sample.weight;
        m.visible += sample.weight;
        let add = |sums: &mut [f64], products: &[f64]| {
            sums.iter_mut().zip(products).for_each(|(sum, product)| *sum += w * product);
        };
        add(&mut m.source, &[d.x * d.x, d.x * d.y, d.y * d.y]);
        add(&mut m.cross, &[e.x * d.x, e.x * d.y, e.y * d.x, e.y * d.y]);
        m.target += w * e.length_squared();
    }
    m
}
