//! Criterion benchmarks of motion compensation on one thread: moments of one view, and the whole of 13 views.

// criterion's own macros make items without documentation.
#![allow(missing_docs, reason = "macros of criterion")]

#[path = "scene/mod.rs"]
mod scene;

use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};
use glam::{DMat3, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use splat::{
    cameras::Camera,
    engine::Engine,
    gaussians::Gaussians,
    image::Image,
    motion::{self, MotionSettings, MotionView, reweighting::Reweighting},
    raster::{CpuEngine, Pass},
    tracking::TrackField,
};

use self::scene::{SceneSize, generate};

const SIZE: SceneSize = SceneSize { gaussians: 100_000, width: 640, height: 360, sh_degree: 0 };
const VIEWS: usize = 13;
/// Depth of the wall, and standard deviation of the tracks, px.
const DEPTH: f64 = 4.0;
const NOISE: f32 = 0.2;

/// The Gaussians of the benchmark scene pressed onto a wall.
fn wall() -> Gaussians {
    let mut gaussians = generate(SIZE).gaussians;
    for mean in &mut gaussians.means {
        let to_wall = DEPTH as f32 / mean[2];
        *mean = [mean[0] * to_wall, mean[1] * to_wall, DEPTH as f32 + 0.01 * (mean[2] - DEPTH as f32)];
    }
    gaussians
}

/// Cameras on an arc of 40° about the middle of the wall.
fn cameras() -> Vec<Camera> {
    let middle = DVec3::new(0.0, 0.0, DEPTH);
    let first = generate(SceneSize { gaussians: 1, ..SIZE }).camera;
    (0..VIEWS)
        .map(|view| {
            let angle = (view as f64 / (VIEWS - 1) as f64 - 0.5) * 40f64.to_radians();
            let rotation = DMat3::from_rotation_y(angle);
            Camera { rotation, translation: middle - rotation * middle, ..first.clone() }
        })
        .collect()
}

/// A third of the wall slides, a third turns, the rest stays.
fn moved(x: DVec3) -> DVec3 {
    match x.x {
        ..-0.6 => x,
        ..0.6 => x + DVec3::new(0.05, 0.02, 0.0),
        _ => DMat3::from_rotation_z(0.05) * x,
    }
}

fn tracks(camera: &Camera, random: &mut ChaCha8Rng) -> TrackField {
    let mut field = TrackField {
        width: camera.width,
        height: camera.height,
        positions: Vec::new(),
        visible: Vec::new(),
        sigma: Vec::new(),
    };
    let centre = camera.centre();
    for row in 0..camera.height {
        for column in 0..camera.width {
            let slope = DVec3::new(
                (f64::from(column) + 0.5 - camera.cx) / camera.fx,
                (f64::from(row) + 0.5 - camera.cy) / camera.fy,
                1.0,
            );
            let ray = camera.rotation.transpose() * slope;
            let point = centre + ray * ((DEPTH - centre.z) / ray.z);
            let target = camera.project_world(moved(point));
            field.visible.push(target.is_some_and(|pixel| camera.contains(pixel)));
            let mut noisy = |value: f64| value as f32 + random.random_range(-1.7..1.7) * NOISE;
            field.positions.push(target.map_or([0.0; 2], |pixel| [noisy(pixel.x), noisy(pixel.y)]));
            field.sigma.push(NOISE);
        }
    }
    field
}

fn benches(criterion: &mut Criterion) {
    // The pool of one: everything below runs on this thread.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build();
    let _pool = pool.unwrap_or_else(|error| panic!("a pool of this thread: {error}"));
    let gaussians = wall();
    let mut random = ChaCha8Rng::seed_from_u64(5);
    let views: Vec<MotionView> = cameras()
        .into_iter()
        .map(|camera| MotionView { tracks: Arc::new(tracks(&camera, &mut random)), camera })
        .collect();
    let engine = CpuEngine::default();
    let settings = MotionSettings::default();
    let MotionView { camera, tracks } = &views[0];
    let mut group = criterion.benchmark_group("motion");
    group.sample_size(10);

    let mut pass = Pass::default();
    let mut image = Image::filled(camera.width, camera.height, [0.0; 3]);
    group.bench_function("render (for comparison)", |bencher| {
        bencher.iter(|| pass.forward(&gaussians, camera, 0, [0.0; 3], &mut image, &mut []));
    });
    let reweighting = Reweighting { passes: 3, noise_correlation_area: 16.0, noise_floor: 0.05 };
    for (name, reweighting) in [("moments", None), ("robust moments", Some(&reweighting))] {
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                let moments = engine.footprint_moments(&gaussians, camera, tracks, reweighting);
                moments.unwrap_or_else(|error| panic!("one view: {error}"))
            });
        });
    }
    group.bench_function(format!("estimate, {VIEWS} views"), |bencher| {
        bencher.iter(|| {
            let field = motion::estimate(&engine, &gaussians, &views, &settings);
            field.unwrap_or_else(|error| panic!("all views: {error}"))
        });
    });
    group.finish();
}

criterion_group!(all, benches);
criterion_main!(all);
