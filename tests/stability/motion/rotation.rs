//! Rotations of flat Gaussians, from their own footprints and beside neighbours.

use splat::motion::{MotionOrigin, MotionSettings, estimate};

use super::{
    judge::is_sound,
    lift::body,
    prescribed::{Noise, Prescribed, Scene},
    reference::rotation_deviation,
    scene::Rig,
};
use crate::row::{Bar, Row};

/// Degrees that a rotation may err where nothing else forbids it: the bar.
const LEAST: f64 = 0.05;

/// Share of its size by which a disc's tracked surface may lie off its plane: 0.3 of its relative thickness.
const OFF_SURFACE: f64 = 3e-3;

const ALONE: Bar = Bar {
    unit: "degrees",
    factor: 12.0,
    why: "noise and thickness through the rigid motion of all tracked points, 0.05° at least; what is below three \
          standard deviations is held back, and the tracks' noise is taken to be correlated over 16 px",
};

const BESIDE: Bar = Bar {
    unit: "degrees",
    factor: 1.0,
    why: "a lone Gaussian's standard deviation, 0.05° at least; neighbours must not make it worse",
};

fn judge(row: &mut Row, scene: &Scene) {
    let settings = MotionSettings::default();
    let field = estimate(&Prescribed(scene), &scene.gaussians, &scene.views(), &settings).unwrap();
    if !is_sound(&field, scene.gaussians.len()) {
        row.case(f64::NAN, 0.0);
    }
    for index in 0..scene.gaussians.len() {
        if field.origin[index] != MotionOrigin::Solved {
            continue;
        }
        let Some(deviation) = rotation_deviation(scene, index, OFF_SURFACE) else { continue };
        let error = field.rotation[index].angle_between(scene.motion.turn);
        let least = LEAST / row.bar.factor;
        row.case(error.to_degrees(), deviation.to_degrees().hypot(least));
    }
}

fn pair(extreme: &'static str, rig: Rig, noise: f64, size: f64) -> [Row; 2] {
    let mut alone = Row::new("motion: rotation alone", extreme, ALONE);
    let mut beside = Row::new("motion: rotation beside neighbours", extreme, BESIDE);
    for seed in 0..8 {
        let mut scene = body(rig, 25, seed);
        scene.noise = Noise::Independent(noise);
        for scales in &mut scene.gaussians.log_scales {
            *scales = scales.map(|scale| scale + (size / 0.6).ln() as f32);
        }
        judge(&mut beside, &scene);
        for index in 0..scene.gaussians.len() {
            judge(&mut alone, &Scene { gaussians: scene.gaussians.select(&[index]), ..scene.clone() });
        }
    }
    [alone, beside]
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let usual = Rig::USUAL;
    let three = Rig { views: 3, baseline_degrees: 20.0, ..usual };
    let narrow = Rig { views: 3, baseline_degrees: 5.0, ..usual };
    let twelve = Rig { views: 12, ..usual };
    [
        pair("exact tracks, 3 views over 20°", three, 0.0, 0.6),
        pair("exact tracks, 12 views over 60°", twelve, 0.0, 0.6),
        pair("exact tracks, 3 views over 5°", narrow, 0.0, 0.6),
        pair("noise 0.1 px on 3 px, 3 views over 20°", three, 0.1, 3.0),
        pair("noise 0.1 px on 3 px, 12 views over 60°", twelve, 0.1, 3.0),
        pair("noise 0.5 px on 3 px, 12 views over 60°", twelve, 0.5, 3.0),
        pair("noise 1 px on 3 px, 6 views over 60°", usual, 1.0, 3.0),
        pair("noise 0.1 px on 0.6 px, 6 views over 60°", usual, 0.1, 0.6),
        pair("exact tracks on 10 px, 6 views over 60°", usual, 0.0, 10.0),
    ]
    .concat()
}
