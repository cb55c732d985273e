//! Errors of both paths in one cell of the table.

use std::sync::Arc;

use anyhow::Result;
use glam::{DQuat, DVec3};
use serde::Serialize;
use splat::{
    gaussians::Gaussians,
    motion::{
        self, LiftMethod, MotionField, MotionOrigin, MotionSettings, MotionView, OrderCounts, reference,
    },
};

use super::{
    corner::{self, Motion},
    fits::NoisyFits,
};

/// Size of the images that the footprints are measured in.
const IMAGE: (u32, u32) = (640, 360);

/// Cameras on an arc.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rig {
    pub(crate) name: &'static str,
    pub(crate) views: usize,
    /// Degrees.
    pub(crate) half_angle: f64,
}

/// Median and nine tenths.
#[derive(Clone, Copy, Debug, Serialize)]
pub(crate) struct Spread {
    pub(crate) median: f64,
    pub(crate) ninth: f64,
}

impl Spread {
    fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values.get((share * values.len() as f64) as usize).copied().unwrap_or(f64::NAN);
        Self { median: at(0.5), ninth: at(0.9) }
    }
}

/// How far one path is off, over all Gaussians, solved or not.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Errors {
    /// Share of the corner's diagonal.
    pub(crate) position: Spread,
    /// Degrees.
    pub(crate) rotation: Spread,
    /// Degrees, to the nearest of the four rotations that leave the Gaussian's ellipsoid the same.
    pub(crate) shape_rotation: Spread,
    /// Share of the Gaussians whose position came from their own footprints.
    pub(crate) solved: f64,
}

/// One line of the table.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Cell {
    pub(crate) motion: &'static str,
    pub(crate) rig: &'static str,
    pub(crate) noise: f64,
    /// Nothing moved, nothing turned.
    pub(crate) none: Errors,
    pub(crate) reference: Errors,
    /// Share of the Gaussians whose rotation the released path finds from their own footprints.
    pub(crate) reference_rotations_solved: f64,
    pub(crate) robust: Errors,
}

impl Cell {
    /// Both paths on the same fits.
    pub(crate) fn measure(
        motion: Motion,
        rig: Rig,
        noise: f64,
        gaussians: usize,
        seed: u64,
        settings: &MotionSettings,
    ) -> Result<Self> {
        let gaussians = corner::gaussians(gaussians, seed);
        let cameras = corner::arc(rig.views, rig.half_angle, IMAGE);
        let engine = NoisyFits::new(&gaussians, &cameras, motion, noise, seed)?;
        let views: Vec<MotionView> = cameras
            .into_iter()
            .zip(engine.tracks())
            .map(|(camera, tracks)| MotionView { camera, tracks: Arc::new(tracks) })
            .collect();
        let run = |lift: LiftMethod| {
            let settings = MotionSettings { lift, ..settings.clone() };
            motion::estimate(&engine, &gaussians, &views, &settings)
        };
        let own = reference::solve(&engine, &gaussians, &views)?;
        let turned = own.rotation.iter().filter(|rotation| rotation.is_some()).count();
        Ok(Self {
            motion: motion.name(),
            rig: rig.name,
            noise,
            none: errors(&gaussians, &unmoved(gaussians.len()), motion),
            reference: errors(&gaussians, &run(LiftMethod::Reference)?, motion),
            reference_rotations_solved: turned as f64 / gaussians.len() as f64,
            robust: errors(&gaussians, &run(LiftMethod::Robust)?, motion),
        })
    }

    /// Error of the released path's positions over ours.
    pub(crate) fn position_gain(&self) -> f64 {
        self.reference.position.median / self.robust.position.median
    }

    /// The same for rotations.
    pub(crate) fn rotation_gain(&self) -> f64 {
        self.reference.rotation.median / self.robust.rotation.median
    }
}

fn unmoved(count: usize) -> MotionField {
    MotionField {
        translation: vec![DVec3::ZERO; count],
        rotation: vec![DQuat::IDENTITY; count],
        origin: vec![MotionOrigin::Unsolved; count],
        information: vec![glam::DMat3::ZERO; count],
        turns_harmonics: false,
        log_scale: vec![DVec3::ZERO; count],
        orders: OrderCounts::default(),
    }
}

fn errors(gaussians: &Gaussians, field: &MotionField, motion: Motion) -> Errors {
    let all = 0..gaussians.len();
    let position = |index: usize| {
        let mean = gaussians.mean(index);
        (mean + field.translation[index] - motion.of(mean)).length() / corner::extent()
    };
    let error = |index: usize| {
        let normal = gaussians.rotation(index) * DVec3::Z;
        motion.turn(gaussians.mean(index), normal).conjugate() * field.rotation[index]
    };
    let shape_rotation = |index: usize| {
        let (own, error) = (gaussians.rotation(index), error(index));
        let half_turns = DVec3::AXES.map(|axis| DQuat::from_axis_angle(own * axis, std::f64::consts::PI));
        half_turns.iter().map(|&half_turn| angle(error * half_turn)).fold(angle(error), f64::min)
    };
    let solved = field.origin.iter().filter(|&&origin| origin == MotionOrigin::Solved).count();
    Errors {
        position: Spread::of(all.clone().map(position).collect()),
        rotation: Spread::of(all.clone().map(|index| angle(error(index))).collect()),
        shape_rotation: Spread::of(all.map(shape_rotation).collect()),
        solved: solved as f64 / gaussians.len() as f64,
    }
}

/// Degrees; exact for small angles, unlike the arc cosine of `w`.
fn angle(turn: DQuat) -> f64 {
    let sine = DVec3::new(turn.x, turn.y, turn.z).length();
    2.0 * sine.atan2(turn.w.abs()).to_degrees()
}
