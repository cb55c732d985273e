//! How a Gaussian turns: from its neighbours' displacements and from its own footprints' deformation.

use glam::{DMat3, DQuat, DVec3};

use super::{
    MotionSettings,
    fit2d::Fit,
    linear::{cross_matrix, outer, trace},
};
use crate::{cameras::Camera, gaussians::Gaussians};

/// Most Gauss-Newton steps on the rigid motion; a small rotation takes about six, half a turn ten.
const STEPS: usize = 16;
/// Last step, radians or spacings, after which no other is taken.
const CONVERGED: f64 = 1e-5;
/// Longest step, radians: keeps the linearisation honest.
const LONGEST_STEP: f64 = 0.7;
/// Strain at which a neighbour stops counting as part of the same body. The next stage starts when a step
/// turns by less than `SETTLED`: a body that turns must not shed its members before the turn is found.
const BODY_STRAIN: [f64; 4] = [2.0, 1.0, 0.5, 0.25];
/// Radians.
const SETTLED: f64 = 0.2;
/// Relative error of a footprint's affine motion along a Gaussian's axis as thick as its thinnest: how much
/// of the axis lies out of the tracked surface.
const OFF_SURFACE: f64 = 0.3;
/// The same for an infinitely thin Gaussian: the footprint is small but not infinitesimal.
const LEAST_AXIS_ERROR: f64 = 1e-3;

/// A displaced point of the neighbourhood.
#[derive(Clone, Copy, Debug)]
pub(super) struct Member {
    /// Position relative to the centre, before the motion.
    pub offset: DVec3,
    pub translation: DVec3,
    /// Inverse covariance of `translation`.
    pub information: DMat3,
    /// How much it belongs to the centre, 0 to 1.
    pub affinity: f64,
}

/// Where an axis of the Gaussian is seen to turn to.
#[derive(Clone, Copy, Debug)]
pub(super) struct TurnedAxis {
    /// Unit axis before the motion.
    pub from: DVec3,
    /// The same material line after it.
    pub to: DVec3,
    /// Inverse covariance of `to`.
    pub information: DMat3,
}

/// What is expected of a rigid motion before anything is measured.
#[derive(Clone, Copy, Debug)]
pub(super) struct Expectation {
    /// Displacement of the centre, from which members are judged first.
    pub translation: DVec3,
    pub rotation: DQuat,
    /// Standard deviation of the rotation, radians.
    pub deviation: f64,
}

impl Expectation {
    /// No rotation, give or take the expected one.
    pub(super) fn unturned(translation: DVec3, settings: &MotionSettings) -> Self {
        Self { translation, rotation: DQuat::IDENTITY, deviation: settings.expected_rotation }
    }

    /// Of both components.
    fn precision(&self) -> f64 {
        self.deviation.powi(2).max(f64::MIN_POSITIVE).recip()
    }

    /// Rotation vector from the expected rotation.
    fn departure(&self, rotation: DQuat) -> DVec3 {
        let departure = rotation * self.rotation.inverse();
        // The shorter way round: `q` and `-q` are the same rotation.
        if departure.w < 0.0 { -departure } else { departure }.to_scaled_axis()
    }
}

/// A rigid motion of a neighbourhood about its centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct RigidMotion {
    /// Displacement of the centre.
    pub translation: DVec3,
    /// The expected one unless what is measured differs significantly.
    pub rotation: DQuat,
    /// Mean square error of the rotation vector, radians²: its covariance and what shrinking it left out.
    pub rotation_error: DMat3,
}

/// Fits `d_j ≈ t + (R − I) x_j` to the members and `y_k ≈ R q_k` to the axes, each by its information.
///
/// Both sources meet in one least-squares problem on SE(3), so that each direction of rotation comes from
/// whichever knows it better. Members that do not move with the rest are shed by redescending weights on
/// their strain. What the rotation differs from the expected one is shrunk by its significance, where its deviation grows
/// with the misfit: noise alone turns nothing.
pub(super) fn fit_rigid_motion(
    members: &[Member],
    axes: &[TurnedAxis],
    expectation: &Expectation,
    spacing: f64,
    settings: &MotionSettings,
) -> RigidMotion {
    let unmeasured = RigidMotion {
        translation: expectation.translation,
        rotation: expectation.rotation,
        rotation_error: DMat3::from_diagonal(DVec3::splat(expectation.deviation.powi(2))),
    };
    let mut motion = unmeasured;
    let mut stage = 0;
    let mut system = System::new(members, axes, &motion, BODY_STRAIN[stage], spacing, expectation);
    if let Some(rotation) = turn_of_axes(axes) {
        let turned = RigidMotion { rotation, ..unmeasured };
        let from_there = System::new(members, axes, &turned, BODY_STRAIN[stage], spacing, expectation);
        if from_there.cost(&turned, expectation) < system.cost(&unmeasured, expectation) {
            (motion, system) = (turned, from_there);
        }
    }
    for _ in 0..STEPS {
        let (translation, turn) = system.solve();
        let turn = turn.clamp_length_max(LONGEST_STEP);
        if !(translation.is_finite() && turn.is_finite()) {
            return unmeasured;
        }
        motion.translation += translation;
        motion.rotation = (DQuat::from_scaled_axis(turn) * motion.rotation).normalize();
        let is_last_stage = stage + 1 == BODY_STRAIN.len();
        let has_converged = turn.length() < CONVERGED && translation.length() <= CONVERGED * spacing;
        if turn.length() < SETTLED && !is_last_stage {
            stage += 1;
        }
        system = System::new(members, axes, &motion, BODY_STRAIN[stage], spacing, expectation);
        if is_last_stage && has_converged {
            break;
        }
    }
    let turn = expectation.departure(motion.rotation);
    let information = system.rotation_information().unwrap_or_default();
    let kept = significant_share(turn.dot(information * turn), settings.rotation_significance);
    let left_out = turn * (1.0 - kept);
    if kept < 1.0 {
        motion.rotation = DQuat::from_scaled_axis(turn * kept) * expectation.rotation;
    }
    motion.rotation_error = system.rotation_covariance() + outer(left_out, left_out);
    // The translation that goes with the rotation that is left.
    let system = System::new(members, axes, &motion, BODY_STRAIN[stage], spacing, expectation);
    let translation = system.translation_covariance() * system.force;
    if translation.is_finite() {
        motion.translation += translation;
    }
    motion
}

/// What to keep of an estimate of this squared significance: nothing of an insignificant one, soon everything of one
/// beyond it.
pub(super) fn significant_share(chi_squared: f64, significance: f64) -> f64 {
    let excess = significance.powi(2) / chi_squared.max(f64::MIN_POSITIVE);
    (1.0 - excess * excess).max(0.0)
}

/// The rotation that takes two axes to where they are seen, each bent as much as the other to keep their angle.
///
/// A start on the right side: tilted discs that few views see look almost like their mirror images, and no small
/// steps lead from one to the other.
fn turn_of_axes(axes: &[TurnedAxis]) -> Option<DQuat> {
    let [a, b] = axes else { return None };
    let frame = |a: DVec3, b: DVec3| {
        let (along, across) = ((a + b).try_normalize()?, (a - b).try_normalize()?);
        Some(DMat3::from_cols(along, across, along.cross(across)))
    };
    let turn = frame(a.to, b.to)? * frame(a.from, b.from)?.transpose();
    Some(DQuat::from_mat3(&turn).normalize()).filter(|turn| turn.is_finite())
}

/// Normal equations of the increments of translation and rotation vector, by 3×3 blocks.
#[derive(Default)]
struct System {
    /// Translation by translation.
    translation: DMat3,
    /// Translation by rotation.
    coupling: DMat3,
    /// Rotation by rotation, without the prior.
    rotation: DMat3,
    force: DVec3,
    torque: DVec3,
    prior: f64,
    chi_squared: f64,
    /// Squared residuals of the axes over their number less the three unknowns of a rotation.
    axes_misfit: f64,
    /// Number of residuals, counted with their robust weights, less the six unknowns.
    freedom: f64,
}

impl System {
    fn new(
        members: &[Member],
        axes: &[TurnedAxis],
        motion: &RigidMotion,
        body_strain: f64,
        spacing: f64,
        expectation: &Expectation,
    ) -> Self {
        let turn = DMat3::from_quat(motion.rotation);
        let prior = expectation.precision();
        let torque = expectation.departure(motion.rotation) * -prior;
        let mut system = Self { prior, torque, freedom: -6.0, ..Self::default() };
        for member in members {
            let lever = turn * member.offset;
            let residual = member.translation - motion.translation - (lever - member.offset);
            let tolerance = body_strain * (member.offset.length() + 0.1 * spacing);
            // Members that all have the centre's mean tolerate nothing, and need not.
            let misfit = residual.length_squared() / (tolerance * tolerance).max(f64::MIN_POSITIVE);
            let weight = member.affinity / (1.0 + misfit).powi(2);
            let information = member.information * weight;
            let coupling = system.add_rotation(lever, information, residual, weight);
            system.translation += information;
            system.coupling += coupling;
            system.force += information * residual;
        }
        let members_chi_squared = system.chi_squared;
        for axis in axes {
            let turned = turn * axis.from;
            system.add_rotation(turned, axis.information, axis.to - turned, 1.0);
        }
        system.axes_misfit =
            (system.chi_squared - members_chi_squared) / (3.0 * axes.len() as f64 - 3.0).max(1.0);
        system
    }

    /// Adds a residual that falls by `δω × lever`; gives the block that couples it to its translation.
    #[inline(always)]
    fn add_rotation(&mut self, lever: DVec3, information: DMat3, residual: DVec3, weight: f64) -> DMat3 {
        let by_rotation = -cross_matrix(lever);
        let force = information * residual;
        let coupling = information * by_rotation;
        self.rotation += by_rotation.transpose() * coupling;
        self.torque += lever.cross(force);
        self.chi_squared += residual.dot(force);
        // A singular information matrix observes fewer than three components; counting all of them only
        // lowers the estimated misfit where it is ill determined anyway.
        self.freedom += 3.0 * weight;
        coupling
    }

    /// What `motion`, at which this was set up, costs.
    fn cost(&self, motion: &RigidMotion, expectation: &Expectation) -> f64 {
        self.chi_squared + self.prior * expectation.departure(motion.rotation).length_squared()
    }

    /// Inverse of the translation block; a tiny share of its trace stands in where no member sees a
    /// direction.
    fn translation_covariance(&self) -> DMat3 {
        let trace = trace(self.translation);
        if !trace.is_normal() {
            return DMat3::ZERO;
        }
        (self.translation + DMat3::from_diagonal(DVec3::splat(1e-12 * trace))).inverse()
    }

    /// The rotation block once the translation is free (Schur complement), without the prior.
    fn free_rotation(&self) -> DMat3 {
        self.rotation - self.coupling.transpose() * self.translation_covariance() * self.coupling
    }

    /// Increments of translation and rotation vector.
    fn solve(&self) -> (DVec3, DVec3) {
        let covariance = self.translation_covariance();
        let torque = self.torque - self.coupling.transpose() * covariance * self.force;
        let stiffness = self.free_rotation() + DMat3::from_diagonal(DVec3::splat(self.prior));
        let turn = stiffness.inverse() * torque;
        (covariance * (self.force - self.coupling * turn), turn)
    }

    /// Covariance of the rotation vector, times the misfit of the axes: strain of the neighbourhood is a misfit too, but no
    /// error of the rotation.
    fn rotation_covariance(&self) -> DMat3 {
        let information = self.free_rotation() * self.axes_misfit.max(1.0).recip();
        let covariance = (information + DMat3::from_diagonal(DVec3::splat(self.prior))).inverse();
        if covariance.is_finite() {
            covariance
        } else {
            DMat3::from_diagonal(DVec3::splat(self.prior.recip()))
        }
    }

    /// Inverse covariance of the rotation vector, divided by the misfit.
    fn rotation_information(&self) -> Option<DMat3> {
        let misfit = if self.freedom > 0.0 { (self.chi_squared / self.freedom).max(1.0) } else { 1.0 };
        let information = self.free_rotation() * misfit.recip();
        information.is_finite().then_some(information)
    }
}

/// One view's fit of a Gaussian whose new position is known.
#[derive(Clone, Copy, Debug)]
pub(super) struct Deformation<'a> {
    pub camera: &'a Camera,
    pub fit: &'a Fit,
}

/// Lifts the footprints' deformation to the Gaussian's axes: `T' F q ≈ A T q` for the deformation gradient
/// `F`, with the Jacobian `T` at the old and `T'` at the new mean.
///
/// The relation holds for lines in the tracked surface only, so the thinnest axis takes no part, and an axis
/// counts by how much it is longer than the thinnest: both major axes of a flat Gaussian, the long one of a
/// needle, hardly any of a ball. Directions along which no view sees the axis turn stay as they were.
pub(super) fn lift_axes(
    gaussians: &Gaussians,
    index: usize,
    translation: DVec3,
    deformations: &[Deformation<'_>],
) -> Vec<TurnedAxis> {
    let mean = gaussians.mean(index);
    let axes = DMat3::from_quat(gaussians.rotation(index));
    let log_scales = gaussians.log_scales[index].map(f64::from);
    let thinnest = (0..3).fold(0, |least, k| if log_scales[k] < log_scales[least] { k } else { least });
    (0..3)
        .filter(|&k| k != thinnest)
        .filter_map(|k| {
            let off_surface =
                (OFF_SURFACE * (log_scales[thinnest] - log_scales[k]).exp()).max(LEAST_AXIS_ERROR);
            lift_axis(axes.col(k), off_surface, mean, mean + translation, deformations)
        })
        .collect()
}

fn lift_axis(
    axis: DVec3,
    off_surface: f64,
    old_mean: DVec3,
    new_mean: DVec3,
    deformations: &[Deformation<'_>],
) -> Option<TurnedAxis> {
    let (mut information, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for Deformation { camera, fit } in deformations {
        let [u, v] = camera.world_jacobian(camera.to_camera(old_mean));
        let [new_u, new_v] = camera.world_jacobian(camera.to_camera(new_mean));
        let projected = glam::DVec2::new(u.dot(axis), v.dot(axis));
        let noise = projected.dot(fit.affine_covariance * projected);
        let variance = noise + (off_surface * projected.length()).powi(2);
        if variance <= 0.0 || variance.is_nan() {
            continue;
        }
        let seen = fit.affine * projected;
        information += (outer(new_u, new_u) + outer(new_v, new_v)) * variance.recip();
        right += (new_u * (seen.x - new_u.dot(axis)) + new_v * (seen.y - new_v.dot(axis))) * variance.recip();
    }
    // Relative to the information itself, so that it only decides what nothing else does.
    let trace = trace(information);
    let ridge = DMat3::from_diagonal(DVec3::splat(1e-9 * trace));
    let to = axis + (information + ridge).inverse() * right;
    let is_lifted = trace > 0.0 && to.is_finite() && information.is_finite() && to.length_squared() > 0.0;
    // The length is strain, not rotation. What came out short turns by more for the same error; what came out long may
    // be nothing but noise.
    let precision = to.length_squared().min(1.0);
    is_lifted.then(|| TurnedAxis { from: axis, to: to.normalize(), information: information * precision })
}
