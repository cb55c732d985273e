//! Gaussians on a moving wall, measured by the real engine; footprints are those of a plain double-precision
//! rasterizer of one Gaussian.

use std::{collections::BTreeMap, sync::Arc};

use glam::{DMat2, DVec2, DVec3};
use rand::RngExt;
use splat::{
    cameras::Camera,
    engine::Engine,
    gaussians::Gaussians,
    motion::{MotionField, MotionSettings, MotionView, estimate, moments::FootprintMoments},
    raster::{ALPHA_MAX, ALPHA_MIN, CpuEngine, LOW_PASS, NEAR_PLANE},
    tracking::TrackField,
};

use super::{
    prescribed::{Noise, Sample, Tracked, effective_number},
    reference::LEAST_CLAIM,
    scene::{Rig, Rigid, normal, random},
};

pub(super) const WIDTH: u32 = 160;
pub(super) const HEIGHT: u32 = 120;

/// A wall through `centre`, across the x axis, with one Gaussian on it.
#[derive(Clone, Debug)]
pub(super) struct Wall {
    pub gaussians: Gaussians,
    pub cameras: Vec<Camera>,
    pub motion: Rigid,
    pub noise: Noise,
    /// Tracks of each camera.
    exact: Vec<Arc<TrackField>>,
    tracks: Vec<Arc<TrackField>>,
    /// Share of the pixels whose tracks are wrong, and which they are, by view.
    outliers: f64,
    is_wrong: Vec<Vec<bool>>,
    /// Side of the cells that err alike, pixels, and where in a cell the image begins, by view.
    cells: (u32, Vec<[u32; 2]>),
}

impl Wall {
    /// Six views of a wall that turns a little and moves some 12 px.
    pub(super) fn new(gaussians: Gaussians, rig: Rig, seed: u64) -> Self {
        let mut random = random(seed);
        let degrees = random.random_range(1.0..8.0);
        let motion = Rigid::random(&mut random, rig.target, degrees, rig.length_of(50.0));
        Self::moving(gaussians, rig, motion)
    }

    pub(super) fn moving(gaussians: Gaussians, rig: Rig, motion: Rigid) -> Self {
        let cameras: Vec<Camera> = rig.cameras().iter().map(|c| c.resized(WIDTH, HEIGHT)).collect();
        let exact: Vec<Arc<TrackField>> =
            cameras.iter().map(|camera| Arc::new(tracks(camera, rig.target, motion))).collect();
        let noise = Noise::Independent(0.0);
        let is_wrong = vec![vec![false; (WIDTH * HEIGHT) as usize]; cameras.len()];
        let tracks = exact.clone();
        let cells = (1, vec![[0; 2]; cameras.len()]);
        Self { gaussians, cameras, motion, noise, exact, tracks, outliers: 0.0, is_wrong, cells }
    }

    /// With what `change` makes of each view's tracks.
    pub(super) fn with_tracks(mut self, change: impl Fn(usize, &mut TrackField)) -> Self {
        for (view, tracks) in self.tracks.iter_mut().enumerate() {
            change(view, Arc::make_mut(tracks));
        }
        self
    }

    /// With normal errors of the tracks that are alike within cells of `cell` pixels, which the tracks claim.
    pub(super) fn with_noise(mut self, deviation: f64, cell: u32, seed: u64) -> Self {
        self.noise = if cell > 1 { Noise::Cells(deviation) } else { Noise::Independent(deviation) };
        // Cells begin anywhere.
        let first = |view: usize| {
            let mut random = random(seed ^ ((view as u64) << 24));
            [random.random_range(0..cell), random.random_range(0..cell)]
        };
        self.cells = (cell, (0..self.cameras.len()).map(first).collect());
        self.with_tracks(|view, tracks| {
            let first = first(view);
            let mut random = random(seed ^ ((view as u64) << 32));
            let columns = WIDTH.div_ceil(cell) + 1;
            let cells = columns * (HEIGHT.div_ceil(cell) + 1);
            let errors: Vec<[f64; 2]> =
                (0..cells).map(|_| [normal(&mut random), normal(&mut random)]).collect();
            tracks.sigma.fill(deviation.max(LEAST_CLAIM) as f32);
            for (pixel, position) in tracks.positions.iter_mut().enumerate() {
                let (column, row) = (pixel as u32 % WIDTH + first[0], pixel as u32 / WIDTH + first[1]);
                let error = errors[(row / cell * columns + column / cell) as usize];
                *position = [0, 1].map(|axis| position[axis] + (error[axis] * deviation) as f32);
            }
        })
    }

    /// With tracks that claim this standard deviation, as large as it is.
    pub(super) fn claiming(mut self, sigma: f32) -> Self {
        self.noise = Noise::Independent(sigma.into());
        self.with_tracks(|_, tracks| tracks.sigma.fill(sigma))
    }

    /// With tracks that lead anywhere on this share of the pixels.
    pub(super) fn with_outliers(mut self, share: f64, seed: u64) -> Self {
        self.outliers = share;
        for (view, is_wrong) in self.is_wrong.iter_mut().enumerate() {
            let mut random = random(seed ^ ((view as u64) << 40));
            let tracks = Arc::make_mut(&mut self.tracks[view]);
            for (is_wrong, position) in is_wrong.iter_mut().zip(&mut tracks.positions) {
                *is_wrong = random.random_range(0.0..1.0) < share;
                if *is_wrong {
                    *position =
                        [random.random_range(0.0..WIDTH as f32), random.random_range(0.0..HEIGHT as f32)];
                }
            }
        }
        self
    }

    pub(super) fn estimate(&self) -> MotionField {
        let views: Vec<MotionView> = self
            .cameras
            .iter()
            .zip(&self.tracks)
            .map(|(camera, tracks)| MotionView { camera: camera.clone(), tracks: Arc::clone(tracks) })
            .collect();
        estimate(&CpuEngine::default(), &self.gaussians, &views, &MotionSettings::default()).unwrap()
    }
}

impl Wall {
    /// What the real engine measures in each view.
    pub(super) fn moments(&self) -> Vec<Vec<FootprintMoments>> {
        let of = |(camera, tracks): (&Camera, &Arc<TrackField>)| {
            CpuEngine::default().footprint_moments(&self.gaussians, camera, tracks, None).unwrap()
        };
        self.cameras.iter().zip(&self.tracks).map(of).collect()
    }
}

/// Exact tracks of the wall's points, visible where they stay inside the image.
fn tracks(camera: &Camera, centre: DVec3, motion: Rigid) -> TrackField {
    let pixels = (camera.width * camera.height) as usize;
    let mut field = TrackField {
        width: camera.width,
        height: camera.height,
        positions: Vec::with_capacity(pixels),
        visible: Vec::with_capacity(pixels),
        sigma: vec![LEAST_CLAIM as f32; pixels],
    };
    for pixel in 0..pixels {
        let at = pixel_centre(pixel, camera.width);
        let slope = DVec3::new((at.x - camera.cx) / camera.fx, (at.y - camera.cy) / camera.fy, 1.0);
        let ray = camera.rotation.transpose() * slope;
        // Relative to the wall, so that a far origin costs no digits.
        let eye = -(camera.rotation.transpose() * camera.to_camera(centre));
        let reach = -eye.x / ray.x;
        let point = eye + ray * reach;
        let target = (reach > 0.0 && reach.is_finite())
            .then(|| centre + point)
            .and_then(|point| camera.project_world(motion.of(point)))
            .filter(|&target| camera.contains(target));
        field.visible.push(target.is_some());
        field.positions.push(target.map_or([f32::NAN; 2], |target| target.as_vec2().to_array()));
    }
    field
}

fn pixel_centre(pixel: usize, width: u32) -> DVec2 {
    DVec2::new((pixel % width as usize) as f64 + 0.5, (pixel / width as usize) as f64 + 0.5)
}

impl Wall {
    fn view_of(&self, camera: &Camera) -> usize {
        self.cameras.iter().position(|other| other == camera).expect("one of the wall's cameras")
    }
}

impl Tracked for Wall {
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

    fn has_outlier(&self, _: DVec3, _: &Camera) -> bool {
        false
    }

    fn is_answerable(&self) -> bool {
        self.outliers < 0.5
    }

    fn independent_samples(&self, samples: &[Sample], camera: &Camera) -> f64 {
        let view = self.view_of(camera);
        let (side, [left, top]) = (self.cells.0, self.cells.1[view]);
        let mut weights = BTreeMap::new();
        for sample in samples {
            let cell = [sample.from.x as u32 + left, sample.from.y as u32 + top].map(|place| place / side);
            *weights.entry(cell).or_insert(0.0) += sample.weight;
        }
        effective_number(weights.into_values())
    }

    /// Every pixel on which the Gaussian has at least 1/255 of opacity.
    fn samples(&self, index: usize, camera: &Camera, is_noisy: bool) -> Vec<Sample> {
        let view = self.view_of(camera);
        let tracks = if is_noisy { &self.tracks[view] } else { &self.exact[view] };
        let position = camera.to_camera(self.gaussians.mean(index));
        let Some(mean) = camera.project(position).filter(|_| position.z > NEAR_PLANE) else {
            return Vec::new();
        };
        let [u, v] = camera.world_jacobian(position);
        let covariance = self.gaussians.covariance(index);
        let uv = u.dot(covariance * v);
        let footprint = DMat2::from_cols(
            DVec2::new(u.dot(covariance * u) + LOW_PASS, uv),
            DVec2::new(uv, v.dot(covariance * v) + LOW_PASS),
        );
        let conic = footprint.inverse();
        let opacity = self.gaussians.opacity(index);
        let sample = |pixel: usize| {
            let offset = pixel_centre(pixel, camera.width) - mean;
            let half_square = 0.5 * offset.dot(conic * offset);
            // exp(-6) is below the least alpha of an opaque Gaussian.
            if half_square > 6.0 {
                return None;
            }
            let alpha = opacity * (-half_square).exp();
            if alpha < f64::from(ALPHA_MIN) {
                return None;
            }
            if is_noisy && self.is_wrong[view][pixel] {
                return None;
            }
            let to = DVec2::from_array(tracks.positions[pixel].map(f64::from));
            let sigma = tracks.sigma[pixel];
            let is_visible = tracks.visible[pixel] && to.is_finite() && sigma.is_finite() && sigma > 0.0;
            let from = mean + offset;
            Some(Sample { point: DVec3::NAN, weight: alpha.min(ALPHA_MAX.into()), from, to, is_visible })
        };
        (0..tracks.positions.len()).filter_map(sample).collect()
    }
}
