//! A Gaussian that too few views see for a position of its own, beside neighbours that are solved.

use glam::DVec3;
use splat::motion::{MotionOrigin, MotionSettings, estimate};

use super::{
    judge::is_sound,
    lift::body,
    prescribed::{Noise, Prescribed, Scene, Stray},
    reference::{LEAST_CLAIM, sights},
    scene::{Rig, direction, random},
};
use crate::row::{Bar, Row};

const SEEN: Bar = Bar {
    unit: "px",
    factor: 4.0,
    why: "track noise in the only view, the rounding of a mean, and the share v / (v + s²/12) of its stray that the variance v \
          which its track claims leaves to 12 neighbours of expected strain s",
};

const UNSEEN: Bar = Bar {
    unit: "world units",
    factor: 4.0,
    why: "the length of its stray, and the neighbours' own errors by 0.001 px of track",
};

/// How far the Gaussian strays from its body, in expected strains of its neighbourhood.
fn strayed(strains: f64, noise: f64, seed: u64) -> (Scene, f64) {
    let mut scene = body(Rig::USUAL, 40, seed);
    scene.noise = Noise::Independent(noise);
    // The one in the middle, so that neighbours lie on all sides.
    let mean = (0..scene.gaussians.len())
        .map(|index| scene.gaussians.mean(index))
        .min_by(|a, b| a.length().total_cmp(&b.length()))
        .unwrap();
    let mut distances: Vec<f64> =
        (0..scene.gaussians.len()).map(|index| scene.gaussians.mean(index).distance(mean)).collect();
    distances.sort_by(f64::total_cmp);
    let settings = MotionSettings::default();
    let strain = settings.neighbour_strain * distances[1..=settings.neighbours].iter().sum::<f64>()
        / settings.neighbours as f64;
    let shift = direction(&mut random(seed)) * strains * strain;
    scene.stray = Some(Stray { mean, shift, views: 1 });
    (scene, strain)
}

fn rows_of(extreme: [&'static str; 2], strains: f64, noise: f64) -> [Row; 2] {
    let mut seen = Row::new("motion: one view", extreme[0], SEEN);
    let mut unseen = Row::new("motion: one view", extreme[1], UNSEEN);
    let mut followed = 0;
    for seed in 0..40 {
        let (scene, strain) = strayed(strains, noise, seed);
        let stray = scene.stray.unwrap();
        let index = (0..scene.gaussians.len()).find(|&i| scene.gaussians.mean(i) == stray.mean).unwrap();
        let settings = MotionSettings::default();
        let field = estimate(&Prescribed(&scene), &scene.gaussians, &scene.views(), &settings).unwrap();
        if !is_sound(&field, scene.gaussians.len()) || field.origin[index] != MotionOrigin::Propagated {
            seen.case(f64::INFINITY, 0.0);
            continue;
        }
        followed += 1;
        let truth = scene.motion.of(stray.mean) + stray.shift;
        let found = stray.mean + field.translation[index];
        // What its track errs by; the stray itself is no error.
        let body = Scene { stray: Some(Stray { shift: DVec3::ZERO, ..stray }), ..scene.clone() };
        let sights = sights(&body, index, &settings);
        let camera = sights[0].camera;
        let error = camera.project_world(found).unwrap() - camera.project_world(truth).unwrap();
        let depth = camera.to_camera(truth).z;
        let in_pixels = |length: f64| length * camera.fx / depth;
        // The fixed point of own information 1 / v and twelve ties of 1 / s² each.
        let ties = in_pixels(strain).powi(2) / settings.neighbours as f64;
        let pull = in_pixels(stray.shift.length()) * sights[0].assumed_variance
            / (sights[0].assumed_variance + ties);
        let rounding = in_pixels(f64::from(f32::EPSILON) * stray.mean.length());
        seen.case(error.length(), sights[0].deviation.hypot(pull) + rounding);
        let ray: DVec3 = (truth - camera.centre()).normalize();
        let own = LEAST_CLAIM.max(noise) * depth / camera.fx;
        unseen.case((found - truth).dot(ray).abs(), stray.shift.length().hypot(own));
    }
    [seen.remark(format!("{followed} from neighbours")), unseen]
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    [
        rows_of(["with its body: across the ray", "with its body: along the ray"], 0.0, 0.0),
        rows_of(
            ["strays by 1 expected strain: across the ray", "strays by 1 expected strain: along the ray"],
            1.0,
            0.0,
        ),
        rows_of(
            ["strays by 2 expected strains: across the ray", "strays by 2 expected strains: along the ray"],
            2.0,
            0.0,
        ),
        rows_of(
            [
                "strays by 1 expected strain, noise 0.5 px: across the ray",
                "strays by 1 expected strain, noise 0.5 px: along the ray",
            ],
            1.0,
            0.5,
        ),
    ]
    .concat()
}
