//! Rotations of flat Gaussians, from their own footprints and beside neighbours.

use glam::DQuat;
use splat::motion::{MotionOrigin, MotionSettings, estimate};

use super::{
    judge::{is_sound, is_unstrained},
    lift::body,
    prescribed::{Noise, Prescribed, Scene, Tracked, effective_samples},
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

/// Exact discs and tracks, without allowance for anything.
const EXACT_BESIDE: Bar = Bar { unit: "degrees", factor: 1.0, why: "0.05°, the issue's bar; nothing errs" };

/// The same for lone Gaussians.
const EXACT_ALONE: Bar = Bar {
    unit: "degrees",
    factor: 2.0,
    why: "shrinkage of a turn θ by its significance, θ (9 σ²/θ²)², where σ is that of discs whose points all lie 0.3 % off their \
          surface on the same side, as is assumed of all; 0.025° at least: nothing errs",
};

/// Least share of the Gaussians that must be solved.
const LEAST_SOLVED: f64 = 0.95;

/// Adds the rotations of the solved Gaussians of a scene to a row, `predicted` from a Gaussian's standard deviation and its
/// turn in degrees; how many of how many are solved.
fn judge(row: &mut Row, scene: &Scene, predicted: impl Fn(f64, f64) -> f64) -> [usize; 2] {
    let settings = MotionSettings::default();
    let field = estimate(&Prescribed(scene), &scene.gaussians, &scene.views(), &settings).unwrap();
    if !is_sound(&field, scene.gaussians.len()) || !is_unstrained(&field) {
        println!("{}: not sound, or strained {:?}", row.extreme, field.log_scale);
        row.case(f64::NAN, 0.0);
    }
    let mut counts = [0; 2];
    for index in 0..scene.gaussians.len() {
        let Some(deviation) = rotation_deviation(scene, index, OFF_SURFACE) else { continue };
        counts[1] += 1;
        if field.origin[index] == MotionOrigin::Solved {
            counts[0] += 1;
            let error = field.rotation[index].angle_between(scene.motion.turn);
            let turn = scene.motion.turn.angle_between(DQuat::IDENTITY);
            row.case(error.to_degrees(), predicted(deviation.to_degrees(), turn.to_degrees()));
        }
    }
    counts
}

fn pair(extreme: &'static str, rig: Rig, noise: f64, size: f64) -> [Row; 2] {
    // Standard deviations, LEAST at least once the factor is on them.
    let within = |bar: Bar| move |deviation: f64, _: f64| deviation.hypot(LEAST / bar.factor);
    pair_of(extreme, rig, noise, size, (ALONE, within(ALONE)), (BESIDE, within(BESIDE)))
}

fn exact_pair(extreme: &'static str, rig: Rig, size: f64) -> [Row; 2] {
    let significance = MotionSettings::default().rotation_significance;
    // Points that all err alike are worth one.
    let alike = effective_samples(&body(rig, 1, 0).samples(0, &rig.cameras()[0], false));
    let shrunk = move |deviation: f64, turn: f64| {
        let excess = alike * (significance * deviation / turn).powi(2);
        (excess * excess * turn).max(LEAST / EXACT_ALONE.factor)
    };
    pair_of(extreme, rig, 0.0, size, (EXACT_ALONE, shrunk), (EXACT_BESIDE, |_, _| LEAST))
}

fn pair_of(
    extreme: &'static str,
    rig: Rig,
    noise: f64,
    size: f64,
    alone: (Bar, impl Fn(f64, f64) -> f64),
    beside: (Bar, impl Fn(f64, f64) -> f64),
) -> [Row; 2] {
    let mut rows = [
        Row::new("motion: rotation alone", extreme, alone.0),
        Row::new("motion: rotation beside neighbours", extreme, beside.0),
    ];
    let mut counts = [[0; 2]; 2];
    let mut add = |which: usize, [solved, all]: [usize; 2]| {
        counts[which][0] += solved;
        counts[which][1] += all;
    };
    for seed in 0..8 {
        let mut scene = body(rig, 25, seed);
        scene.noise = Noise::Independent(noise);
        for scales in &mut scene.gaussians.log_scales {
            *scales = scales.map(|scale| scale + (size / 0.6).ln() as f32);
        }
        add(1, judge(&mut rows[1], &scene, &beside.1));
        for index in 0..scene.gaussians.len() {
            let lone = Scene { gaussians: scene.gaussians.select(&[index]), ..scene.clone() };
            add(0, judge(&mut rows[0], &lone, &alone.1));
        }
    }
    for (row, [solved, all]) in rows.iter_mut().zip(counts) {
        row.exact(all > 0 && solved as f64 >= LEAST_SOLVED * all as f64);
        row.remark = format!("{solved} of {all} solved, 95 % at least");
    }
    rows
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let usual = Rig::USUAL;
    let three = Rig { views: 3, baseline_degrees: 20.0, ..usual };
    let narrow = Rig { views: 3, baseline_degrees: 5.0, ..usual };
    let twelve = Rig { views: 12, ..usual };
    [
        exact_pair("exact discs and tracks, 3 views over 20°", three, 0.6),
        exact_pair("exact discs and tracks, 12 views over 60°", twelve, 0.6),
        exact_pair("exact discs and tracks, 3 views over 5°", narrow, 0.6),
        exact_pair("exact discs and tracks of 10 px, 6 views over 60°", usual, 10.0),
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
