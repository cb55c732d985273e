//! The neighbours' field by conjugate gradients against a dense solve of the same normal equations.
//!
//! The system is written down here once more from its documentation: what [`estimate`] gives without rounds is its start and
//! its data, what it gives with rounds its solution.

use std::collections::BTreeMap;

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{DMatrix, DVector, Matrix3};
use rand::RngExt;
use splat::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput},
    gaussians::{Gaussians, sh},
    motion::{
        MotionField, MotionOrigin, MotionSettings, estimate, moments::FootprintMoments,
        reweighting::Reweighting,
    },
    tracking::TrackField,
};

use super::{
    judge::is_sound,
    prescribed::unread_tracks,
    scene::{Rig, direction, random},
};
use crate::{
    reference::ROUNDOFF_64,
    row::{Bar, EXACT, Row},
};

const STAGE: &str = "motion: regularisation";

const BAR: Bar = Bar {
    unit: "of the start's distance, energy norm",
    factor: 1.0,
    why: "convergence of conjugate gradients by the condition number κ of the system by blocks, 2 ((√κ−1)/(√κ+1))ⁿ but no more \
          than 1, or their end at a residual of 1e-5, √κ times that; rounding",
};

/// What the tracks say of a Gaussian: where it goes, and their variance, px²; nothing of those that no view sees.
#[derive(Clone, Copy)]
struct Told {
    displacement: DVec3,
    variance: f64,
}

/// Footprints of one pixel with prescribed motion and variance, found by the Gaussian's mean.
struct Measured(BTreeMap<[u32; 3], Told>);

impl Engine for Measured {
    fn name(&self) -> &str {
        "measured"
    }

    fn render(&self, _: &Gaussians, _: &Camera, _: [f32; 3]) -> Result<Rendering, EngineError> {
        Err(EngineError::InvalidInput("points cannot be drawn".into()))
    }

    fn footprint_moments(
        &self,
        gaussians: &Gaussians,
        camera: &Camera,
        _: &TrackField,
        _: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        let of = |index: usize| {
            let mean = gaussians.mean(index);
            let told = self.0.get(&gaussians.means[index].map(f32::to_bits))?;
            let from = camera.project_world(mean)?.to_array();
            let to = camera.project_world(mean + told.displacement)?.to_array();
            // Sixteen pixels of a quarter each; a variance of one square pixel across.
            let weight = 4.0 / told.variance;
            Some(FootprintMoments {
                blend_weight: 4.0,
                visible: 4.0,
                contest: 0.0,
                weight,
                weight_squared: weight * weight / 16.0,
                pixels: 16,
                centroid: from,
                tracked_centroid: to,
                source: [weight, 0.0, weight],
                cross: [weight, 0.0, 0.0, weight],
                target: 2.0 * weight,
                variance: 4.0,
            })
        };
        Ok((0..gaussians.len()).map(|index| of(index).unwrap_or_default()).collect())
    }

    fn session(&self, _: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        Err(EngineError::InvalidInput("points cannot be refined".into()))
    }
}

/// Points and what their tracks say.
struct Problem {
    gaussians: Gaussians,
    told: Vec<Option<Told>>,
}

/// `count` points of many colours in a ball about `centre` that turn, and stray from that by some of their distance.
fn points(count: usize, centre: DVec3, seed: u64) -> Problem {
    let mut random = random(seed);
    let mut gaussians = Gaussians::empty(0);
    let turn = DQuat::from_axis_angle(direction(&mut random), 0.2);
    let mut told = Vec::new();
    for _ in 0..count {
        let mean = (centre + direction(&mut random) * random.random_range(0.0..0.5f64)).as_vec3();
        gaussians.means.push(mean.to_array());
        gaussians.rotations.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.log_scales.push([-5.0; 3]);
        gaussians.logit_opacities.push(2.0);
        gaussians.sh.extend([0; 3].map(|_| random.random_range(-0.5..0.5f32)));
        let mean = mean.as_dvec3();
        let stray = direction(&mut random) * random.random_range(0.0..0.03);
        told.push(Some(Told { displacement: turn * mean - mean + stray, variance: 0.1 }));
    }
    Problem { gaussians, told }
}

impl Problem {
    fn told(mut self, mut change: impl FnMut(usize, &mut Option<Told>)) -> Self {
        self.told.iter_mut().enumerate().for_each(|(index, told)| change(index, told));
        self
    }

    fn beside(mut self, other: Self) -> Self {
        self.gaussians.means.extend(other.gaussians.means);
        self.gaussians.rotations.extend(other.gaussians.rotations);
        self.gaussians.log_scales.extend(other.gaussians.log_scales);
        self.gaussians.logit_opacities.extend(other.gaussians.logit_opacities);
        self.gaussians.sh.extend(other.gaussians.sh);
        self.told.extend(other.told);
        self
    }

    fn field(&self, settings: &MotionSettings) -> MotionField {
        let told = self.gaussians.means.iter().zip(&self.told);
        let told = told
            .filter_map(|(mean, told)| Some((mean.map(f32::to_bits), (*told)?)))
            .collect::<BTreeMap<_, _>>();
        let views = unread_tracks(&Rig { views: 4, ..Rig::USUAL }.cameras());
        estimate(&Measured(told), &self.gaussians, &views, settings).unwrap()
    }
}

/// Settings by which every position counts that any track says anything of, and only what does not move at all rests.
fn settings(rounds: usize, steps: usize) -> MotionSettings {
    MotionSettings {
        noise_floor: 0.0,
        static_floor: 0.0,
        static_significance: 0.0,
        max_relative_deviation: 1e30,
        field_rounds: rounds,
        field_steps: steps,
        ..MotionSettings::default()
    }
}

/// The nearest neighbours within reach of each point, with distances, and the median reach.
fn neighbours(gaussians: &Gaussians, settings: &MotionSettings) -> (Vec<Vec<(usize, f64)>>, f64) {
    let mut nearest: Vec<Vec<(usize, f64)>> = (0..gaussians.len())
        .map(|index| {
            let distance = |other: usize| gaussians.mean(index).distance(gaussians.mean(other));
            let mut others: Vec<(usize, f64)> = (0..gaussians.len())
                .filter(|&other| other != index)
                .map(|other| (other, distance(other)))
                .collect();
            others.sort_by(|a, b| a.1.total_cmp(&b.1));
            others.truncate(settings.neighbours);
            others
        })
        .collect();
    let mut reach: Vec<f64> = nearest.iter().filter_map(|list| Some(list.last()?.1)).collect();
    reach.sort_by(f64::total_cmp);
    let spacing = reach.get(reach.len() / 2).copied().unwrap_or(0.0);
    for list in &mut nearest {
        list.retain(|&(_, distance)| distance <= settings.max_edge * spacing);
    }
    (nearest, spacing)
}

/// The normal equations of one round, three unknowns per moving point.
struct Dense {
    matrix: DMatrix<f64>,
    right: DVector<f64>,
    moving: Vec<usize>,
}

/// `Σ (d−d̂)ᵀ H (d−d̂) + Σ λ_ij |d_i − d_j − r_ij|²` under the weights that the translations of `before` give.
fn dense(gaussians: &Gaussians, own: &MotionField, before: &MotionField, settings: &MotionSettings) -> Dense {
    let moving: Vec<usize> = (0..gaussians.len())
        .filter(|&i| matches!(own.origin[i], MotionOrigin::Solved | MotionOrigin::Propagated))
        .collect();
    let (nearest, spacing) = neighbours(gaussians, settings);
    let mut dense = Dense {
        matrix: DMatrix::zeros(3 * moving.len(), 3 * moving.len()),
        right: DVector::zeros(3 * moving.len()),
        moving: moving.clone(),
    };
    for (row, &i) in moving.iter().enumerate() {
        let departure = before.translation[i] - own.translation[i];
        let misfit = departure.dot(own.information[i] * departure) / settings.outlier_significance.powi(2);
        let information = own.information[i] * (1.0 + misfit).powi(-2);
        dense.add(row, row, information);
        dense.add_right(row, information * own.translation[i]);
        for j in (0..gaussians.len()).filter(|&j| j != i && own.origin[j] != MotionOrigin::Unsolved) {
            let tie = |from: usize, to: usize| nearest[from].iter().find(|(other, _)| *other == to);
            let Some(&(_, distance)) = tie(i, j).or(tie(j, i)) else { continue };
            let lever = gaussians.mean(i) - gaussians.mean(j);
            let expected = (own.rotation[i] * lever + own.rotation[j] * lever) / 2.0 - lever;
            let distance = distance + 0.1 * spacing;
            let strain = before.translation[i] - before.translation[j] - expected;
            let label = if own.origin[j] == MotionOrigin::Static { 0.1 } else { 1.0 };
            let boundary = (1.0 + (strain.length() / (0.25 * distance)).powi(2)).powi(-2);
            let tie = label * affinity(gaussians, i, j, settings) * boundary
                / (settings.neighbour_strain * distance).powi(2);
            let tie = DMat3::from_diagonal(DVec3::splat(tie));
            dense.add(row, row, tie);
            dense.add_right(row, tie * expected);
            match moving.iter().position(|&other| other == j) {
                Some(column) => dense.add(row, column, -tie),
                None => dense.add_right(row, tie * own.translation[j]),
            }
        }
    }
    dense
}

fn affinity(gaussians: &Gaussians, a: usize, b: usize, settings: &MotionSettings) -> f64 {
    let difference = gaussians.sh_of(a).iter().zip(gaussians.sh_of(b));
    let squares: f64 = difference.map(|(a, b)| ((f64::from(*a) - f64::from(*b)) * sh::C0).powi(2)).sum();
    1.0 / (1.0 + squares / settings.colour_scale.powi(2))
}

impl Dense {
    fn add(&mut self, row: usize, column: usize, block: DMat3) {
        for (k, axis) in block.to_cols_array_2d().iter().enumerate() {
            for (l, value) in axis.iter().enumerate() {
                self.matrix[(3 * row + l, 3 * column + k)] += value;
            }
        }
    }

    fn add_right(&mut self, row: usize, value: DVec3) {
        (0..3).for_each(|axis| self.right[3 * row + axis] += value[axis]);
    }

    fn stacked(&self, field: &MotionField) -> DVector<f64> {
        let values = self.moving.iter().flat_map(|&index| field.translation[index].to_array());
        DVector::from_iterator(3 * self.moving.len(), values)
    }

    /// Relative error of `found` and what theory allows it after so many steps from `start`.
    fn error(&self, start: &DVector<f64>, found: &DVector<f64>, steps: usize) -> (f64, f64) {
        let size = self.right.len();
        // Inverse roots of the diagonal blocks: conjugate gradients are preconditioned by their squares.
        let mut scale = DMatrix::zeros(size, size);
        for block in (0..size).step_by(3) {
            let own: Matrix3<f64> = self.matrix.fixed_view::<3, 3>(block, block).into();
            let factor = own.cholesky().expect("every moving point is tied or seen").l();
            let inverse = factor.try_inverse().expect("a Cholesky factor has no zero on its diagonal");
            scale.fixed_view_mut::<3, 3>(block, block).copy_from(&inverse);
        }
        let scaled = &scale * &self.matrix * scale.transpose();
        let eigen = ((&scaled + scaled.transpose()) * 0.5).symmetric_eigen();
        let root = eigen.eigenvalues.map(|value| value.max(ROUNDOFF_64).sqrt());
        // Coordinates in which the energy norm is the length.
        let energy = |x: &DVector<f64>| {
            let inverse = scale.clone().try_inverse().expect("its blocks are");
            (eigen.eigenvectors.transpose() * inverse.transpose() * x).component_mul(&root)
        };
        let exact = (eigen.eigenvectors.transpose() * &scale * &self.right).component_div(&root);
        let (before, after) = ((energy(start) - &exact).norm(), (energy(found) - &exact).norm());
        let condition = (root.max() / root.min()).powi(2);
        let rate = (condition.sqrt() - 1.0) / (condition.sqrt() + 1.0);
        let by_steps = (2.0 * rate.powi(steps as i32)).min(1.0);
        let by_residual = 1e-5 * condition.sqrt();
        let rounding = 64.0 * ROUNDOFF_64 * condition * exact.norm() / before;
        (after / before, by_steps.max(by_residual.min(1.0)) + rounding)
    }
}

fn row(extreme: &'static str, steps: usize, problem: impl Fn(u64) -> Problem) -> Row {
    let mut row = Row::new(STAGE, extreme, BAR);
    let mut unknowns = 0;
    for seed in 0..3 {
        let problem = problem(seed);
        let own = problem.field(&settings(0, steps));
        let mut before = own.clone();
        for rounds in 1..4 {
            let field = problem.field(&settings(rounds, steps));
            if !is_sound(&field, problem.told.len()) {
                row.case(f64::NAN, 0.0);
            }
            let dense = dense(&problem.gaussians, &own, &before, &settings(1, steps));
            unknowns += dense.right.len();
            let (error, predicted) = dense.error(&dense.stacked(&before), &dense.stacked(&field), steps);
            row.case(error, predicted);
            before = field;
        }
    }
    row.remark(format!("{steps} steps, {unknowns} unknowns"))
}

/// What no view sees, and what nothing ties to anything that one sees, stays.
fn nothing_known() -> Row {
    let mut row = Row::new(STAGE, "no information at all", EXACT);
    for seed in 0..3 {
        let unseen = points(30, DVec3::ZERO, seed).told(|_, told| *told = None);
        let field = unseen.field(&settings(3, 20));
        row.exact(
            is_sound(&field, 30) && field.origin.iter().all(|origin| *origin == MotionOrigin::Unsolved),
        );
    }
    row.remark("all unsolved, none moved")
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let usual = |seed| points(50, DVec3::ZERO, seed);
    let ratios = |seed| {
        let mut random = random(seed ^ 77);
        usual(seed).told(move |_, told| {
            let power = random.random_range(-12.0..12.0f64);
            *told = told.map(|told| Told { variance: 10f64.powf(power), ..told });
        })
    };
    let anchored = |seed| {
        usual(seed).told(|index, told| {
            *told = told.map(|told| match index % 2 {
                0 => Told { displacement: DVec3::ZERO, ..told },
                _ => Told { variance: 1e12, ..told },
            });
        })
    };
    let unseen = |seed| usual(seed).told(|index, told| *told = told.filter(|_| index % 3 > 0));
    let islands = |seed| {
        let sizes = [1, 2, 5, 14, 20];
        let islands = sizes.iter().enumerate().map(|(place, &size)| {
            let centre = DVec3::new(0.0, place as f64 - 2.0, 0.3);
            let island = points(size, DVec3::ZERO, 10 * seed + place as u64);
            let gaussians = Gaussians {
                means: (island.gaussians.means.iter())
                    .map(|mean| (DVec3::from_array(mean.map(f64::from)) * 0.02 + centre).as_vec3().to_array())
                    .collect(),
                ..island.gaussians
            };
            Problem { gaussians, told: island.told }
        });
        islands.reduce(Problem::beside).unwrap()
    };
    vec![
        row("nothing extreme, default steps", 20, usual),
        row("nothing extreme, to convergence", 2000, usual),
        row("information 1e-12 to 1e12 px⁻², default steps", 20, ratios),
        row("information 1e-12 to 1e12 px⁻², to convergence", 2000, ratios),
        row("anchors alone: half at rest, 1e-12 px⁻² of the others", 2000, anchored),
        row("a third without information of their own, default steps", 20, unseen),
        row("a third without information of their own, to convergence", 2000, unseen),
        row("islands of 1, 2, 5, 14 and 20, to convergence", 2000, islands),
        nothing_known(),
    ]
}
