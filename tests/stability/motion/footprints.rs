//! Footprints that the real engine measures: size, aspect ratio, opacity, quaternions, noise and outliers of the
//! tracks.

use std::f64::consts::TAU;

use glam::{DQuat, DVec3};
use rand::RngExt;
use splat::{gaussians::Gaussians, motion::MotionSettings, tracking::TrackField};

use super::{
    judge::{LIFT, Verdict, judge_all, table},
    prescribed::Tracked,
    scene::{Rig, random},
    wall::Wall,
};
use crate::row::Row;

/// Lone Gaussians per row.
const CASES: u64 = 12;

/// The usual rig before a smaller image; a pixel of it is four of the rig's.
const PIXEL: f64 = 4.0;

/// One Gaussian lying on the wall, given by its standard deviations in pixels.
fn on_wall(rig: Rig, [wide, high]: [f64; 2], seed: u64) -> Gaussians {
    let mut random = random(seed);
    let mut place = || rig.length_of(random.random_range(-15.0..15.0) * PIXEL);
    let mean = rig.target + DVec3::new(0.0, place(), place());
    // The third axis along the wall's normal, after a spin about it.
    let spin = DQuat::from_rotation_x(random.random_range(0.0..TAU));
    let q = spin * DQuat::from_rotation_arc(DVec3::Z, DVec3::X);
    let thin = wide.min(high) * 1e-3;
    Gaussians {
        means: vec![mean.as_vec3().to_array()],
        rotations: vec![[q.w, q.x, q.y, q.z].map(|c| c as f32)],
        log_scales: vec![[wide, high, thin].map(|pixels| rig.length_of(pixels * PIXEL).ln() as f32)],
        logit_opacities: vec![1.0],
        sh: vec![0.0; 3],
        sh_degree: 0,
    }
}

fn row(extreme: &'static str, wall: impl Fn(u64) -> Wall + Sync) -> Verdict {
    Verdict::of_seeds("motion: footprint", extreme, LIFT, CASES, |verdict, seed| {
        let wall = wall(seed);
        judge_all(verdict, &wall, &wall.estimate(), &MotionSettings::default());
    })
}

fn of_size(extreme: &'static str, size: [f64; 2]) -> Verdict {
    row(extreme, |seed| Wall::new(on_wall(Rig::USUAL, size, seed), Rig::USUAL, seed))
}

fn altered(extreme: &'static str, alter: impl Fn(&mut Gaussians) + Sync) -> Verdict {
    row(extreme, |seed| {
        let mut gaussians = on_wall(Rig::USUAL, [3.0, 2.0], seed);
        alter(&mut gaussians);
        Wall::new(gaussians, Rig::USUAL, seed)
    })
}

/// Not rotated, so that its longest axis sticks out of the wall: what the wall shows of it may look like a strain.
fn across(extreme: &'static str, alter: impl Fn(&mut Gaussians) + Sync) -> Verdict {
    remarked(
        altered(extreme, alter).straining(0.5),
        "taken as unrotated: its longest axis sticks out of the wall",
    )
}

fn sizes() -> Vec<Verdict> {
    vec![
        of_size("footprint 0.05 px", [0.05, 0.05]),
        of_size("footprint 0.5 px", [0.5, 0.5]),
        of_size("footprint 4 px", [4.0, 4.0]),
        of_size("footprint 20 px", [20.0, 20.0]),
        of_size("footprint of the whole image (160 px)", [160.0, 160.0]),
        of_size("footprint of 100 images (16 000 px)", [16_000.0, 16_000.0]),
        of_size("aspect ratio 10, 20 px long", [20.0, 2.0]),
        of_size("aspect ratio 1e3, 20 px long", [20.0, 20e-3]),
        of_size("aspect ratio 1e6, 20 px long", [20.0, 20e-6]),
        of_size("aspect ratio 1e6, 20 000 px long", [2e4, 2e-2]),
    ]
}

fn parameters() -> Vec<Verdict> {
    let opacity = |logit: f32| move |set: &mut Gaussians| set.logit_opacities[0] = logit;
    let norm = |norm: f32| move |set: &mut Gaussians| set.rotations[0] = set.rotations[0].map(|c| c * norm);
    vec![
        altered("opacity 0 (logit -1e30)", opacity(-1e30)),
        altered("opacity 1/250", opacity(-5.517)),
        altered("opacity 1 (logit 1e30)", opacity(1e30)),
        altered("quaternion of norm 1e-20", norm(1e-20)),
        altered("quaternion of norm 1e20", norm(1e20)),
        across("zero quaternion", norm(0.0)),
        altered("scales of 1e-7 world units", |set| set.log_scales[0] = [1e-7f32.ln(); 3]),
        altered("scales of 1e4 world units, 1e-7 thick", |set| {
            set.log_scales[0] = [1e4f32.ln(), 1e4f32.ln(), 1e-7f32.ln()];
        }),
        altered("log scale -1e30, 1e30 and infinite", |set| set.log_scales[0] = [f32::INFINITY, 1e30, -1e30]),
        across("NaN quaternion", |set| set.rotations[0][2] = f32::NAN),
        altered("NaN mean", |set| set.means[0][1] = f32::NAN),
    ]
}

/// How many parts of the footprint err independently, in every view that has pixels of it.
fn independent_pixels(wall: &Wall) -> Vec<f64> {
    let of = |camera| {
        let samples = wall.samples(0, camera, true);
        (!samples.is_empty()).then(|| wall.independent_samples(&samples, camera))
    };
    wall.cameras.iter().filter_map(of).collect()
}

fn noises() -> Vec<Verdict> {
    let noisy = |extreme: &'static str, deviation: f64, cell: u32| {
        let wall = |seed| {
            Wall::new(on_wall(Rig::USUAL, [4.0, 3.0], seed), Rig::USUAL, seed)
                .with_noise(deviation, cell, seed)
        };
        let counts: Vec<f64> = (0..CASES).flat_map(|seed| independent_pixels(&wall(seed))).collect();
        let (least, most) =
            (counts.iter().copied().fold(f64::MAX, f64::min), counts.iter().copied().fold(0.0, f64::max));
        remarked(row(extreme, wall), &format!("{least:.1} to {most:.1} independent pixels in a footprint"))
    };
    vec![
        noisy("independent noise 0.1 px", 0.1, 1),
        noisy("independent noise 1 px", 1.0, 1),
        noisy("independent noise 5 px", 5.0, 1),
        noisy("noise 0.1 px, alike over 4 px", 0.1, 4),
        noisy("noise 1 px, alike over 4 px", 1.0, 4),
        noisy("noise 1 px, alike over 32 px", 1.0, 32),
        noisy("noise 5 px, alike over 4 px", 5.0, 4),
    ]
}

/// Tracks that are no positions: every pixel of every view, or a share of them.
fn invalid_tracks() -> Vec<Verdict> {
    let spoilt = |extreme: &'static str, share: f64, spoil: fn(&mut TrackField, usize)| {
        row(extreme, move |seed| {
            let wall = Wall::new(on_wall(Rig::USUAL, [4.0, 3.0], seed), Rig::USUAL, seed);
            wall.with_tracks(|view, tracks| {
                let mut random = random(seed ^ ((view as u64) << 32));
                for pixel in 0..tracks.positions.len() {
                    if random.random_range(0.0..1.0) < share {
                        spoil(tracks, pixel);
                    }
                }
            })
        })
    };
    let nan = |tracks: &mut TrackField, pixel: usize| tracks.positions[pixel] = [f32::NAN; 2];
    let infinite = |tracks: &mut TrackField, pixel: usize| tracks.positions[pixel][1] = f32::NEG_INFINITY;
    let far = |tracks: &mut TrackField, pixel: usize| tracks.positions[pixel] = [f32::MAX, -f32::MAX];
    let sigma = [
        |tracks: &mut TrackField, pixel: usize| tracks.sigma[pixel] = f32::NAN,
        |tracks: &mut TrackField, pixel: usize| tracks.sigma[pixel] = f32::INFINITY,
        |tracks: &mut TrackField, pixel: usize| tracks.sigma[pixel] = 0.0,
        |tracks: &mut TrackField, pixel: usize| tracks.sigma[pixel] = -1.0,
    ];
    let [sigma_nan, sigma_infinite, sigma_zero, sigma_negative] = sigma;
    vec![
        spoilt("all pixels invisible", 1.0, |tracks, pixel| tracks.visible[pixel] = false),
        spoilt("30 % of the pixels invisible", 0.3, |tracks, pixel| tracks.visible[pixel] = false),
        spoilt("all tracks NaN, claimed visible", 1.0, nan),
        spoilt("30 % of the tracks NaN, claimed visible", 0.3, nan),
        spoilt("all tracks infinite, claimed visible", 1.0, infinite),
        spoilt("30 % of the tracks infinite, claimed visible", 0.3, infinite),
        spoilt("all tracks at the largest numbers, claimed visible", 1.0, far),
        spoilt("all standard deviations NaN", 1.0, sigma_nan),
        spoilt("all standard deviations infinite", 1.0, sigma_infinite),
        spoilt("all standard deviations zero", 1.0, sigma_zero),
        spoilt("all standard deviations negative", 1.0, sigma_negative),
        spoilt("all standard deviations 1e-45 px", 1.0, |tracks, pixel| tracks.sigma[pixel] = 1e-45),
        row("all standard deviations 1e38 px", |seed| {
            Wall::new(on_wall(Rig::USUAL, [4.0, 3.0], seed), Rig::USUAL, seed).claiming(1e38)
        }),
    ]
}

fn outliers() -> Vec<Verdict> {
    let wrong = |extreme: &'static str, share: f64| {
        row(extreme, move |seed| {
            let wall = Wall::new(on_wall(Rig::USUAL, [4.0, 3.0], seed), Rig::USUAL, seed);
            wall.with_noise(0.1, 1, seed).with_outliers(share, seed)
        })
    };
    vec![
        wrong("wrong tracks on 10 % of the pixels", 0.1),
        wrong("wrong tracks on 30 % of the pixels", 0.3),
        wrong("wrong tracks on 50 % of the pixels", 0.5),
        wrong("wrong tracks on 70 % of the pixels", 0.7),
    ]
}

/// World scale and origin, fields of view and views, as the real engine sees them.
fn geometry() -> Vec<Verdict> {
    let usual = Rig::USUAL;
    let of = |extreme: &'static str, rig: Rig| {
        row(extreme, move |seed| Wall::new(on_wall(rig, [1.5, 1.0], seed), rig, seed))
    };
    vec![
        remarked(
            of("world units 1e-7 of the usual", Rig { distance: 4e-7, ..usual }),
            "before the rasterizer's near plane at 0.01 world units",
        ),
        of("world units 1e-2 of the usual", Rig { distance: 4e-2, ..usual }),
        of("world units 1e4 of the usual", Rig { distance: 4e4, ..usual }),
        of("world origin 1e3 away", Rig { target: DVec3::new(0.0, -0.6, 0.8) * 1e3, ..usual }),
        of("world origin 1e6 away", Rig { target: DVec3::new(0.0, -0.6, 0.8) * 1e6, ..usual }),
        of("field of view 2°", Rig { fov_degrees: 2.0, ..usual }),
        of("field of view 120°", Rig { fov_degrees: 120.0, ..usual }),
        of("field of view 170°", Rig { fov_degrees: 170.0, ..usual }),
        of("64 views", Rig { views: 64, ..usual }),
    ]
}

fn remarked(mut verdict: Verdict, remark: &str) -> Verdict {
    verdict.solved.remark = remark.into();
    verdict
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    table([sizes(), parameters(), geometry(), noises(), invalid_tracks(), outliers()].concat())
}
