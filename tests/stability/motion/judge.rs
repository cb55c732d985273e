//! Runs the shipped path on a scene and holds every Gaussian to its prediction.

use glam::{DQuat, DVec3};
use rayon::prelude::*;
use splat::{
    gaussians::Gaussians,
    motion::{MotionField, MotionOrigin, MotionSettings, apply, estimate},
};

use super::{
    prescribed::{Prescribed, Scene, Tracked},
    reference::{Prediction, led_deviation, predict, resting_deviation, sights},
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

/// For Gaussians found at rest: how far from it they may truly be.
const AT_REST: Bar = Bar {
    unit: "world units",
    factor: 3.0,
    why: "`static_significance` × the standard deviation of the mean if every view that sees it errs by what its tracks claim, or by a third of the floor of 0.2 px, and by its true noise",
};

/// For Gaussians that follow their neighbours.
const LED: Bar = Bar {
    unit: "world units",
    factor: 3.0,
    why: "the rigid motion of the 12 nearest solved or resting Gaussians under the noise that their tracks claim, 0.05 px at \
          least, its turn unknown to its true size; the bodies do not strain",
};

/// The same where so few are known that the nearest ones do not show how they turn, and are too noisy to turn on their own.
const LED_BY_FEW: Bar = Bar {
    why: "that of the row of every other Gaussian unseen, but only of those among the 12 nearest of all: motion is passed on \
          from neighbour to neighbour",
    ..LED
};

/// What was found of the Gaussians of an extreme, by the origin of their motion.
#[derive(Clone, Debug)]
pub(super) struct Verdict {
    /// A case for every Gaussian: the errors of the solved, and whether the others fell back with reason.
    pub solved: Row,
    /// Errors of those found at rest.
    pub at_rest: Row,
    /// Errors of those that follow neighbours.
    pub led: Row,
    origins: Origins,
    strained: usize,
    /// Share of the Gaussians whose scale may change although the motion is rigid.
    may_strain: f64,
    /// Whether followers know those among their nearest neighbours only.
    is_led_by_few: bool,
}

impl Verdict {
    pub(super) fn new(stage: &'static str, extreme: &'static str, bar: Bar) -> Self {
        Self {
            solved: Row::new(stage, extreme, bar),
            at_rest: Row::new("motion: at rest", extreme, AT_REST),
            led: Row::new("motion: from neighbours", extreme, LED),
            origins: Origins::default(),
            strained: 0,
            may_strain: 0.0,
            is_led_by_few: false,
        }
    }

    /// What `add` finds of every seed.
    pub(super) fn of_seeds(
        stage: &'static str,
        extreme: &'static str,
        bar: Bar,
        seeds: u64,
        add: impl Fn(&mut Self, u64) + Sync,
    ) -> Self {
        let of_seed = |seed| {
            let mut verdict = Self::new(stage, extreme, bar);
            add(&mut verdict, seed);
            verdict
        };
        let verdicts: Vec<Self> = (0..seeds).into_par_iter().map(of_seed).collect();
        verdicts.iter().fold(Self::new(stage, extreme, bar), Self::with)
    }

    fn with(mut self, other: &Self) -> Self {
        self.solved.absorb(&other.solved);
        self.at_rest.absorb(&other.at_rest);
        self.led.absorb(&other.led);
        self.origins.add(other.origins);
        self.strained += other.strained;
        self.may_strain = self.may_strain.max(other.may_strain);
        self.is_led_by_few |= other.is_led_by_few;
        self.led.bar = other.led.bar;
        self
    }

    /// With leave to change the scales of this share of the Gaussians.
    pub(super) fn straining(mut self, share: f64) -> Self {
        self.may_strain = self.may_strain.max(share);
        self
    }

    /// Followers know those among their nearest neighbours only.
    pub(super) fn expect_few(&mut self) {
        self.is_led_by_few = true;
        self.led.bar = LED_BY_FEW;
    }

    fn row(mut self) -> Row {
        let allowed = self.may_strain * self.origins.all() as f64;
        if self.strained as f64 > allowed {
            println!("{}: {} strained, {allowed} may", self.solved.extreme, self.strained);
            self.solved.case(f64::INFINITY, 0.0);
        }
        let strained = match self.strained {
            0 => String::new(),
            count => format!("{count} change their scale, {allowed:.0} may"),
        };
        let parts = [self.origins.remark(), strained, self.solved.remark.clone()];
        let parts: Vec<String> = parts.into_iter().filter(|part| !part.is_empty()).collect();
        self.solved.remark(parts.join("; "))
    }
}

/// Share of the Gaussians whose scale may change by chance where tracks are noisy: beyond four standard deviations, which
/// are estimated.
const STRAINED_BY_CHANCE: f64 = 0.02;

/// One row per extreme, then one for all that were found at rest, and one for all that followed neighbours if there are
/// any.
pub(super) fn table(verdicts: Vec<Verdict>) -> Vec<Row> {
    let mut at_rest = Row::new("motion: at rest", "whoever is found at rest in the rows above", AT_REST);
    let mut led = Row::new("motion: from neighbours", "whoever follows neighbours in the rows above", LED);
    let mut rows = Vec::new();
    for verdict in verdicts {
        at_rest.absorb(&verdict.at_rest);
        if !verdict.is_led_by_few {
            led.absorb(&verdict.led);
        }
        rows.push(verdict.row());
    }
    rows.extend([at_rest, led].into_iter().filter(|row| row.cases > 0));
    rows
}

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

    fn all(self) -> usize {
        self.solved + self.at_rest + self.propagated + self.unsolved
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

/// Whether no entry of a field is NaN or infinite, every rotation is a unit quaternion, no scale changes beyond its bound
/// or without footprints of its own, and what is reported as unmoved has not moved.
pub(super) fn is_sound(field: &MotionField, count: usize) -> bool {
    let lengths = [
        field.translation.len(),
        field.rotation.len(),
        field.origin.len(),
        field.information.len(),
        field.log_scale.len(),
    ];
    let most = MotionSettings::default().max_log_strain;
    lengths == [count; 5]
        && field.log_scale.iter().all(|strain| strain.is_finite() && strain.abs().max_element() <= most)
        && field.translation.iter().all(|d| d.is_finite())
        && field.rotation.iter().all(|q| q.is_finite() && (q.length() - 1.0).abs() < 1e-9)
        && field.information.iter().all(|h| h.is_finite())
        && (0..count).all(|i| {
            let stays = matches!(field.origin[i], MotionOrigin::Static | MotionOrigin::Unsolved);
            let has_own = field.origin[i] == MotionOrigin::Solved;
            (!stays || (field.translation[i] == DVec3::ZERO && field.rotation[i] == DQuat::IDENTITY))
                && (has_own || field.log_scale[i] == DVec3::ZERO)
        })
}

/// Whether no scale changes at all, as becomes a rigid motion.
pub(super) fn is_unstrained(field: &MotionField) -> bool {
    field.log_scale.iter().all(|strain| *strain == DVec3::ZERO)
}

/// Whether moved Gaussians are where the field says, to the rounding of single precision, and what was finite still is.
fn is_applied(gaussians: &Gaussians, field: &MotionField) -> bool {
    let moved = apply(gaussians, field);
    (0..gaussians.len()).filter(|&index| gaussians.is_finite(index)).all(|index| {
        let expected = gaussians.mean(index) + field.translation[index];
        let rounding = expected.abs() * f64::from(f32::EPSILON) / 2.0;
        let error = (moved.mean(index) - expected).abs();
        let strain = field.log_scale[index].to_array();
        let scales = (0..3).all(|k| {
            let expected = f64::from(gaussians.log_scales[index][k]) + strain[k];
            (f64::from(moved.log_scales[index][k]) - expected).abs()
                <= expected.abs() * f64::from(f32::EPSILON)
        });
        let is_turned = field.rotation[index] != DQuat::IDENTITY;
        let rotations = is_turned || moved.rotations[index] == gaussians.rotations[index];
        moved.is_finite(index)
            && error.cmple(rounding + f64::from(f32::MIN_POSITIVE)).all()
            && scales
            && rotations
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

/// Estimates the motion of every Gaussian alone and adds a case for each.
pub(super) fn lone(verdict: &mut Verdict, scene: &Scene) {
    for index in 0..scene.gaussians.len() {
        together(verdict, &Scene { gaussians: scene.gaussians.select(&[index]), ..scene.clone() });
    }
}

/// Estimates the motion of all Gaussians together and adds a case for each.
pub(super) fn together(verdict: &mut Verdict, scene: &Scene) {
    let settings = MotionSettings::default();
    let field = estimate(&Prescribed(scene), &scene.gaussians, &scene.views(), &settings).unwrap();
    judge_all(verdict, scene, &field, &settings);
}

/// Adds a case for every Gaussian of the field of a rigid scene.
pub(super) fn judge_all(
    verdict: &mut Verdict,
    scene: &impl Tracked,
    field: &MotionField,
    settings: &MotionSettings,
) {
    verdict.origins.add(Origins::of(field));
    if !is_sound(field, scene.gaussians().len()) || !is_applied(scene.gaussians(), field) {
        println!("{}: not sound, or not applied", verdict.solved.extreme);
        verdict.solved.case(f64::NAN, 1.0);
    }
    verdict.strained += field.log_scale.iter().filter(|strain| **strain != DVec3::ZERO).count();
    if scene.noise().deviation() > 0.0 {
        verdict.may_strain = verdict.may_strain.max(STRAINED_BY_CHANCE);
    }
    for index in 0..scene.gaussians().len() {
        judge(verdict, scene, field, index, settings);
    }
}

fn judge(
    verdict: &mut Verdict,
    scene: &impl Tracked,
    field: &MotionField,
    index: usize,
    settings: &MotionSettings,
) {
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
    // Rounding of a world position, when its origin is far.
    let rounding = f64::EPSILON * (mean.length() + truth.length());
    let row = &mut verdict.solved;
    match (field.origin[index], prediction) {
        (MotionOrigin::Solved, Some(prediction)) if demand != Demand::Fallback => {
            let told = if scene.gaussians().len() > 1 { prediction.assumed } else { 0.0 };
            let predicted = prediction.deviation.hypot(told) + rounding;
            if error > row.bar.factor * predicted {
                println!("{}: error {error} of {prediction:?}", row.extreme);
            }
            let from_reference = (mean + field.translation[index] - prediction.position).length();
            row.case(error.max(if told > 0.0 { 0.0 } else { from_reference }), predicted);
        }
        (MotionOrigin::Static, Some(_)) => {
            let predicted = resting_deviation(&sights, mean, settings) + rounding;
            if error > AT_REST.factor * predicted {
                println!("{}: {error} from rest, predicted {predicted}", row.extreme);
            }
            verdict.at_rest.case(error, predicted);
            row.case(0.0, 0.0);
        }
        (MotionOrigin::Propagated, _) if demand != Demand::Solved => {
            let reach = if verdict.is_led_by_few { settings.neighbours } else { scene.gaussians().len() };
            let predicted =
                led_deviation(scene, field, index, reach, settings).unwrap_or_default() + rounding;
            if error > LED.factor * predicted {
                println!("{}: {error} behind its neighbours, predicted {predicted}", row.extreme);
            }
            verdict.led.case(error, predicted);
            row.case(0.0, 0.0);
        }
        (MotionOrigin::Solved | MotionOrigin::Static, _) => refuse(row, "without grounds", prediction, error),
        (_, Some(_)) if demand == Demand::Solved => refuse(row, "fell back without need", prediction, error),
        // The bodies hang together: one known motion leads to all others.
        _ if field.origin.contains(&MotionOrigin::Solved) => refuse(row, "left behind", prediction, error),
        _ => row.case(0.0, 0.0),
    }
}

fn refuse(row: &mut Row, what: &str, prediction: Option<Prediction>, error: f64) {
    println!("{}: {what}, error {error}, {prediction:?}", row.extreme);
    row.case(f64::INFINITY, 0.0);
}
