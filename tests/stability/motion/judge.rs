//! Runs the shipped path on a scene and holds every Gaussian to its prediction.

use glam::DVec3;
use splat::{
    gaussians::Gaussians,
    motion::{MotionField, MotionOrigin, MotionSettings, apply, estimate},
};

use super::{
    prescribed::{Prescribed, Scene, Tracked},
    reference::{Prediction, Sight, predict, sights},
};
use crate::row::{Bar, Row};

/// For lone Gaussians.
pub(super) const LIFT: Bar = Bar {
    unit: "world units",
    factor: 5.0,
    why: "track noise and curvature of the footprint through the normal equations; worst of some hundred normal errors",
};

/// For Gaussians with neighbours.
pub(super) const FIELD: Bar = Bar {
    unit: "world units",
    factor: 3.0,
    why: "standard deviation that the tracks claim, 0.05 px at least, through the normal equations; worst of some hundred",
};

/// How often each origin was reported.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Origins {
    pub solved: usize,
    pub at_rest: usize,
    pub propagated: usize,
    pub unsolved: usize,
}

impl Origins {
    pub(super) fn of(field: &MotionField) -> Self {
        let count = |origin| field.origin.iter().filter(|&&other| other == origin).count();
        Self {
            solved: count(MotionOrigin::Solved),
            at_rest: count(MotionOrigin::Static),
            propagated: count(MotionOrigin::Propagated),
            unsolved: count(MotionOrigin::Unsolved),
        }
    }

    pub(super) fn add(&mut self, other: Self) {
        self.solved += other.solved;
        self.at_rest += other.at_rest;
        self.propagated += other.propagated;
        self.unsolved += other.unsolved;
    }

    pub(super) fn remark(self) -> String {
        let parts = [
            (self.solved, "solved"),
            (self.at_rest, "at rest"),
            (self.propagated, "from neighbours"),
            (self.unsolved, "unsolved"),
        ];
        let parts: Vec<String> = parts
            .iter()
            .filter(|(count, _)| *count > 0)
            .map(|(count, name)| format!("{count} {name}"))
            .collect();
        parts.join(", ")
    }
}

/// Whether no entry of a field is NaN or infinite, every rotation is a unit quaternion, and what is reported as
/// unmoved has not moved.
pub(super) fn is_sound(field: &MotionField, count: usize) -> bool {
    let lengths =
        [field.translation.len(), field.rotation.len(), field.origin.len(), field.information.len()];
    lengths == [count; 4]
        && field.log_scale.len() == count
        && field.log_scale.iter().all(|scale| scale.is_finite())
        && field.translation.iter().all(|d| d.is_finite())
        && field.rotation.iter().all(|q| q.is_finite() && (q.length() - 1.0).abs() < 1e-9)
        && field.information.iter().all(|h| h.is_finite())
        && (0..count).all(|i| {
            let stays = matches!(field.origin[i], MotionOrigin::Static | MotionOrigin::Unsolved);
            !stays || (field.translation[i] == DVec3::ZERO && field.rotation[i] == glam::DQuat::IDENTITY)
        })
}

/// Whether moved Gaussians are where the field says, to the rounding of single precision, and what was finite still is.
fn is_applied(gaussians: &Gaussians, field: &MotionField) -> bool {
    let moved = apply(gaussians, field);
    (0..gaussians.len()).filter(|&index| gaussians.is_finite(index)).all(|index| {
        let expected = gaussians.mean(index) + field.translation[index];
        let rounding = expected.abs() * f64::from(f32::EPSILON) / 2.0;
        let error = (moved.mean(index) - expected).abs();
        moved.is_finite(index) && error.cmple(rounding + f64::from(f32::MIN_POSITIVE)).all()
    })
}

/// What the data demand of a lone Gaussian's origin.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Demand {
    Solved,
    /// Near the limit: either will do.
    Either,
    Fallback,
}

fn demand(prediction: Option<&Prediction>, cameras: usize, settings: &MotionSettings) -> Demand {
    let Some(prediction) = prediction else { return Demand::Fallback };
    let relative = |deviation: f64| deviation / prediction.depth / settings.max_relative_deviation;
    let is_majority = 2 * prediction.views > cameras;
    // The shipped path may drop a view or two, and scales its covariance with the misfit.
    match prediction.views {
        0 | 1 => Demand::Fallback,
        _ if !(relative(prediction.assumed) <= 2.0) => Demand::Fallback,
        _ if relative(prediction.assumed.max(prediction.deviation)) < 0.4 && is_majority => Demand::Solved,
        _ => Demand::Either,
    }
}

/// Estimates the motion of every Gaussian alone and adds a case for each to the row.
pub(super) fn lone(row: &mut Row, scene: &Scene) -> Origins {
    let mut origins = Origins::default();
    for index in 0..scene.gaussians.len() {
        origins.add(together(row, &Scene { gaussians: scene.gaussians.select(&[index]), ..scene.clone() }));
    }
    origins
}

/// Estimates the motion of all Gaussians together and adds a case for each to the row.
pub(super) fn together(row: &mut Row, scene: &Scene) -> Origins {
    let settings = MotionSettings::default();
    let field = estimate(&Prescribed(scene), &scene.gaussians, &scene.views(), &settings).unwrap();
    judge_all(row, scene, &field, &settings);
    Origins::of(&field)
}

/// Adds a case for every Gaussian of a field.
pub(super) fn judge_all(row: &mut Row, scene: &impl Tracked, field: &MotionField, settings: &MotionSettings) {
    if !is_sound(field, scene.gaussians().len()) {
        row.case(f64::NAN, 1.0);
    }
    if !is_applied(scene.gaussians(), field) {
        row.case(f64::INFINITY, 0.0);
    }
    for index in 0..scene.gaussians().len() {
        judge(row, scene, field, index, settings);
    }
}

fn judge(row: &mut Row, scene: &impl Tracked, field: &MotionField, index: usize, settings: &MotionSettings) {
    let mean = scene.gaussians().mean(index);
    let truth = scene.motion().of(mean);
    let sights = sights(scene, index, settings);
    let prediction = predict(&sights, truth);
    // Wrong views are among the cameras; views that do not see the Gaussian have no say.
    let wrong = scene.cameras().iter().filter(|camera| scene.has_outlier(mean, camera)).count();
    let demand = match demand(prediction.as_ref(), sights.len() + wrong, settings) {
        Demand::Solved if !scene.is_answerable() => Demand::Either,
        demand => demand,
    };
    let error = (mean + field.translation[index] - truth).length();
    match (field.origin[index], prediction) {
        (MotionOrigin::Solved, Some(prediction)) if demand != Demand::Fallback => {
            // Rounding of a world position, when its origin is far.
            let rounding = f64::EPSILON * (mean.length() + truth.length());
            let told = if scene.gaussians().len() > 1 { prediction.assumed } else { 0.0 };
            let predicted = prediction.deviation.hypot(told) + rounding;
            if error > row.bar.factor * predicted {
                println!("{}: error {error} of {prediction:?}", row.extreme);
            }
            let from_reference = (mean + field.translation[index] - prediction.position).length();
            row.case(error.max(if told > 0.0 { 0.0 } else { from_reference }), predicted);
        }
        (MotionOrigin::Static, Some(_)) if rests(&sights, mean, settings) => row.case(0.0, 0.0),
        (MotionOrigin::Solved | MotionOrigin::Static, _) => refuse(row, "without grounds", prediction, error),
        (_, Some(_)) if demand == Demand::Solved => refuse(row, "fell back without need", prediction, error),
        _ => row.case(0.0, 0.0),
    }
}

fn refuse(row: &mut Row, what: &str, prediction: Option<Prediction>, error: f64) {
    println!("{}: {what}, error {error}, {prediction:?}", row.extreme);
    row.case(f64::INFINITY, 0.0);
}

/// Whether most views find a displacement that is small or, at twice the limit for chance, insignificant.
fn rests(sights: &[Sight<'_>], mean: DVec3, settings: &MotionSettings) -> bool {
    let is_small = |sight: &&Sight<'_>| {
        let Some(before) = sight.camera.project_world(mean) else { return false };
        let limit = settings.static_significance * sight.assumed_variance.sqrt();
        (sight.pixel - before).length() <= 2.0 * limit.max(settings.static_floor)
    };
    2 * sights.iter().filter(is_small).count() >= sights.len()
}
