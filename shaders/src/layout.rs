//! The structs that host and kernels share. A test compares each with what the compiler of the shaders makes of its twin in
//! `wgsl/shared/types.wgsl`.

use bytemuck::{Pod, Zeroable};
use glam::DVec3;
use splat::{cameras::Camera, raster::FRUSTUM_MARGIN};

/// Columns and rows of a tile.
pub(crate) const TILE: u32 = 16;

/// Values per Gaussian in the geometry buffer: mean 3, rotation 4, log scale 3, logit opacity 1.
pub(crate) const GEOMETRY: usize = 11;

/// Values of an intersection's share of the gradient.
pub(crate) const SUMS: usize = 9;

/// One view.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct View {
    pub right: [f32; 4],
    pub down: [f32; 4],
    pub forward: [f32; 4],
    pub centre_rest: [f32; 4],
    pub background: [f32; 4],
    pub focal: [f32; 2],
    pub principal: [f32; 2],
    pub slope_low: [f32; 2],
    pub slope_high: [f32; 2],
    pub size: [u32; 2],
    pub tiles: [u32; 2],
    pub absolute: f32,
    pub structural: f32,
    pub is_packed: u32,
    pub padding: u32,
}

/// One step.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct Step {
    pub count: u32,
    pub coefficients: u32,
    pub degree: u32,
    pub capacity: u32,
    pub rates: [f32; 4],
    pub sh_rates: [f32; 2],
    pub first_correction: f32,
    pub second_correction: f32,
    pub number: u32,
    pub loss_place: u32,
    pub has_active: u32,
    pub padding: u32,
}

/// What the stages know about the step that runs.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct State {
    pub gaussians: u32,
    pub intersections: u32,
    pub needed: u32,
    pub failed: u32,
    pub failed_step: u32,
}

/// One pass of a sort.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct SortSettings {
    pub list: u32,
    pub shift: u32,
}

/// One scan.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct ScanSettings {
    pub list: u32,
}

/// A change of the set.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct ReplaceSettings {
    pub count: u32,
    pub width: u32,
}

/// What densification decides by, per Gaussian.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct Density {
    pub gradient_norm: f32,
    pub visible_steps: u32,
}

/// Sums over a footprint's pixels, or means and central sums.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct Moments {
    pub weights: [f32; 4],
    pub first: [f32; 4],
    pub second: [f32; 4],
    pub cross: [f32; 4],
    pub reference: [f32; 2],
    pub anchor: u32,
    pub pixels: f32,
}

/// By what a footprint's pixels are reweighted.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct Expectation {
    pub displacement: [f32; 2],
    pub fall: f32,
    pub is_wanted: f32,
}

impl View {
    /// Without weights of a loss.
    pub(crate) fn new(camera: &Camera, background: [f32; 3]) -> Self {
        let centre = camera.centre();
        let rounded = centre.as_vec3();
        let rest = (centre - rounded.as_dvec3()).as_vec3();
        let row = |axis: usize, w: f32| {
            let DVec3 { x, y, z } = camera.rotation.row(axis);
            [x as f32, y as f32, z as f32, w]
        };
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let bounds = |focal: f64, principal: f64, size: f64| {
            let margin = FRUSTUM_MARGIN * 0.5 * size / focal;
            [-(principal / focal + margin), (size - principal) / focal + margin].map(|bound| bound as f32)
        };
        let x = bounds(camera.fx, camera.cx, width);
        let y = bounds(camera.fy, camera.cy, height);
        let [red, green, blue] = background;
        Self {
            right: row(0, rounded.x),
            down: row(1, rounded.y),
            forward: row(2, rounded.z),
            centre_rest: rest.extend(0.0).to_array(),
            background: [red, green, blue, 0.0],
            focal: [camera.fx as f32, camera.fy as f32],
            principal: [camera.cx as f32, camera.cy as f32],
            slope_low: [x[0], y[0]],
            slope_high: [x[1], y[1]],
            size: [camera.width, camera.height],
            tiles: [camera.width.div_ceil(TILE), camera.height.div_ceil(TILE)],
            ..Self::default()
        }
    }

    /// Number of tiles; saturated, for a camera of more pixels than any device has room for.
    pub(crate) fn tile_count(&self) -> u32 {
        self.tiles[0].saturating_mul(self.tiles[1])
    }

    /// Number of pixels.
    pub(crate) fn pixels(&self) -> u64 {
        u64::from(self.size[0]) * u64::from(self.size[1])
    }
}
