//! The engine's footprint moments against sums in double precision, over the rasterizer's extremes and tracks of any
//! reach.

use rand::RngExt;
use splat::{
    engine::Engine, motion::moments::FootprintMoments, raster::CpuEngine, simd::Instructions,
    tracking::TrackField,
};

use super::scene::random;
use crate::{
    reference::{
        ROUNDOFF_32,
        blend::{Close, traverse},
        render::shapes,
    },
    row::{Bar, Row, excess},
    scenes::{Extreme, Scene, extremes, typical},
};

const BAR: Bar = Bar {
    unit: "px, px²; of each weight",
    factor: 2.0,
    why: "2⁻²⁴ through alpha and transmittance of every pixel, times its distance from the mean; sums of 16 pixels about their \
          block",
};

/// Roundings of a sum over a block of 16 pixels and of the features that enter it.
const BLOCK: f64 = 8.0;
/// Pixels from the middle of a block to its corner.
const HALF_BLOCK: f64 = 3.0;

/// A pixel of a footprint.
#[derive(Clone, Copy)]
struct Pixel {
    place: usize,
    /// Blending weight, and its relative error.
    weight: f64,
    error: f64,
}

/// Every footprint's pixels.
fn footprints(scene: &Scene, close: Close) -> Vec<Vec<Pixel>> {
    let (indices, shapes) = shapes(&scene.gaussians, &scene.camera);
    let mut footprints = vec![Vec::new(); scene.gaussians.len()];
    for place in 0..(scene.camera.width * scene.camera.height) as usize {
        let [x, y] = centre(place, scene.camera.width);
        traverse(&shapes, x, y, close, |number, sample, front| {
            let (weight, error) = (sample.alpha * front.value, sample.error + front.error() + ROUNDOFF_32);
            footprints[indices[number]].push(Pixel { place, weight, error });
        });
    }
    footprints
}

fn centre(place: usize, width: u32) -> [f64; 2] {
    [(place % width as usize) as f64 + 0.5, (place / width as usize) as f64 + 0.5]
}

/// Displacements beyond this, pixels, are no tracks.
const FARTHEST: f64 = 65_536.0;

fn is_usable(tracks: &TrackField, place: usize) -> bool {
    let from = centre(place, tracks.width);
    let is_near = |axis: usize| (f64::from(tracks.positions[place][axis]) - from[axis]).abs() <= FARTHEST;
    tracks.visible[place] && is_near(0) && is_near(1)
}

/// A sum and its error.
#[derive(Clone, Copy, Default)]
struct Sum {
    value: f64,
    error: f64,
}

impl Sum {
    fn add(&mut self, value: f64, error: f64) {
        self.value += value;
        self.error += error;
    }

    fn against(self, found: f64, scale: f64) -> (f64, f64) {
        ((found - self.value).abs() / scale, self.error / scale)
    }
}

/// Errors and predictions of all moments of a footprint; its number of pixels must be right.
fn of_footprint(found: &FootprintMoments, pixels: &[Pixel], tracks: &TrackField) -> Vec<(f64, f64)> {
    let mut blend = Sum::default();
    pixels.iter().for_each(|p| blend.add(p.weight, p.weight * (p.error + BLOCK * ROUNDOFF_32)));
    let seen: Vec<&Pixel> = pixels.iter().filter(|pixel| is_usable(tracks, pixel.place)).collect();
    let mut values = vec![blend.against(found.blend_weight, blend.value.max(f64::MIN_POSITIVE))];
    values.push((f64::from(found.pixels.abs_diff(seen.len() as u32)), 0.0));
    if seen.is_empty() {
        values.push((found.weight.abs() + found.visible.abs(), 0.0));
        return values;
    }
    let weight = |p: &Pixel| p.weight / f64::from(tracks.sigma[p.place]).powi(2);
    let total: f64 = seen.iter().map(|p| weight(p)).sum();
    let at = |p: &Pixel| {
        let from = centre(p.place, tracks.width);
        let to = tracks.positions[p.place].map(f64::from);
        [from[0], from[1], to[0], to[1]]
    };
    let mean: [f64; 4] =
        std::array::from_fn(|k| seen.iter().map(|p| weight(p) * at(p)[k]).sum::<f64>() / total);
    // Displacements are summed relative to one of their block's.
    let spread = |k: usize| {
        let from_mean = |p: &&Pixel| (at(p)[2 + k] - mean[2 + k] - (at(p)[k] - mean[k])).abs();
        seen.iter().map(from_mean).fold(0.0, f64::max)
    };
    let reach = [HALF_BLOCK, HALF_BLOCK, HALF_BLOCK + spread(0), HALF_BLOCK + spread(1)];
    let [mut all, mut squares, mut variance] = [Sum::default(); 3];
    let mut firsts = [Sum::default(); 4];
    let mut seconds = [[Sum::default(); 4]; 4];
    for p in &seen {
        let (w, sigma) = (weight(p), f64::from(tracks.sigma[p.place]));
        let error = p.error + BLOCK * ROUNDOFF_32;
        let d: [f64; 4] = std::array::from_fn(|k| at(p)[k] - mean[k]);
        all.add(w, w * error);
        squares.add(w * w, 2.0 * w * w * error);
        variance.add(w * sigma * sigma, w * sigma * sigma * error);
        for k in 0..4 {
            firsts[k].add(0.0, w * (p.error * d[k].abs() + BLOCK * ROUNDOFF_32 * reach[k]) / total);
            for j in 0..4 {
                let size = (d[k].abs() + reach[k]) * (d[j].abs() + reach[j]);
                seconds[k][j]
                    .add(w * d[k] * d[j], w * (p.error * (d[k] * d[j]).abs() + BLOCK * ROUNDOFF_32 * size));
            }
        }
    }
    let mut visible = Sum::default();
    seen.iter().for_each(|p| visible.add(p.weight, p.weight * (p.error + BLOCK * ROUNDOFF_32)));
    let relative = |sum: Sum, found: f64| sum.against(found, sum.value);
    values.push(relative(visible, found.visible));
    values.push(relative(all, found.weight));
    values.push(relative(squares, found.weight_squared));
    values.push(relative(variance, found.variance));
    let means = [found.centroid, found.tracked_centroid].concat();
    values.extend((0..4).map(|k| Sum { value: mean[k], error: firsts[k].error }.against(means[k], 1.0)));
    let pairs = [(0, 0), (0, 1), (1, 1), (2, 0), (2, 1), (3, 0), (3, 1)];
    let measured = [found.source.as_slice(), &found.cross].concat();
    let second = pairs.iter().zip(measured).map(|(&(k, j), found)| seconds[k][j].against(found, total));
    values.extend(second);
    let mut target = seconds[2][2];
    target.add(seconds[3][3].value, seconds[3][3].error);
    values.push(target.against(found.target, total));
    values
}

/// Noisy affine tracks with a few that are lost; `reach` px away.
fn tracks(scene: &Scene, reach: f64, seed: u64) -> TrackField {
    let (width, height) = (scene.camera.width, scene.camera.height);
    let mut random = random(seed);
    let places = 0..(width * height) as usize;
    let positions = places.clone().map(|place| {
        let [x, y] = centre(place, width);
        let mut noise = || random.random_range(-0.5..0.5);
        [x + reach + 0.05 * y + noise(), y - 0.7 * reach - 0.03 * x + noise()].map(|value| value as f32)
    });
    let positions = positions.collect();
    TrackField {
        width,
        height,
        positions,
        visible: places.clone().map(|_| random.random_range(0..10) > 0).collect(),
        sigma: places.map(|_| random.random_range(0.05..1.0)).collect(),
    }
}

fn row(extreme: &'static str, scenes: &[Scene], reach: f64) -> Row {
    let mut row = Row::new("footprint moments", extreme, BAR);
    for (number, scene) in scenes.iter().enumerate() {
        let tracks = tracks(scene, reach, number as u64);
        let references = Close::ALL.map(|close| footprints(scene, close));
        for instructions in Instructions::available() {
            let engine = CpuEngine::new(instructions);
            let found = engine.footprint_moments(&scene.gaussians, &scene.camera, &tracks, None).unwrap();
            // Every footprint against the decision that suits it best, as in images.
            let best = |index: usize| {
                let tries = references
                    .each_ref()
                    .map(|footprints| of_footprint(&found[index], &footprints[index], &tracks));
                tries.into_iter().min_by(|a, b| excess(a).total_cmp(&excess(b))).unwrap()
            };
            row.case_of((0..scene.gaussians.len()).flat_map(best));
        }
    }
    row
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let Extreme { name, scenes } = typical();
    let mut rows = vec![row(name, &scenes, 3.0)];
    rows.extend(extremes().iter().map(|extreme| row(extreme.name, &extreme.scenes, 3.0)));
    for (extreme, reach) in [
        ("tracks that do not move but for noise", 0.0),
        ("tracks 100 px away", 100.0),
        ("tracks 1e4 px away", 1e4),
        ("tracks 1e6 px away: not used", 1e6),
    ] {
        rows.push(row(extreme, &scenes, reach));
    }
    rows
}
