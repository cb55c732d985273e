//! Numbers of Gaussians from none to a million, all of them identical, and poses that are no rotations.

use glam::{DQuat, DVec3};
use rand::RngExt;
use splat::{
    cameras::Camera,
    engine::{Engine, EngineError, Rendering, Session, SessionInput},
    gaussians::Gaussians,
    motion::{
        MotionOrigin, MotionSettings, apply, estimate, moments::FootprintMoments, reweighting::Reweighting,
    },
    tracking::TrackField,
};

use super::{
    judge::{Origins, is_sound},
    prescribed::unread_tracks,
    scene::{Rig, Rigid, normal, random},
};
use crate::row::{Bar, Row};

const FIELD: Bar = Bar {
    unit: "world units",
    factor: 3.0,
    why: "standard deviation of a lone position under the noise of the tracks; worst of a million",
};

/// Footprints of one pixel that move with their means, in closed form.
struct Points {
    motion: Rigid,
    noise: f64,
}

impl Engine for Points {
    fn name(&self) -> &str {
        "points"
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
        let mut random = random(camera.translation.x.to_bits());
        let mut error = || self.noise * normal(&mut random);
        let of = |index: usize| {
            let error = [error(), error()];
            let mean = gaussians.mean(index);
            let seen = camera.project_world(mean).zip(camera.project_world(self.motion.of(mean)));
            let Some((from, to)) = seen else { return FootprintMoments::default() };
            // Sixteen pixels of a quarter each; a variance of one square pixel across.
            let weight = 4.0 / self.noise.powi(2);
            FootprintMoments {
                blend_weight: 4.0,
                visible: 4.0,
                contest: 0.0,
                weight,
                weight_squared: weight * weight / 16.0,
                pixels: 16,
                centroid: from.to_array(),
                tracked_centroid: [to.x + error[0], to.y + error[1]],
                source: [weight, 0.0, weight],
                cross: [weight, 0.0, 0.0, weight],
                target: 2.0 * weight,
                variance: 4.0,
            }
        };
        Ok((0..gaussians.len()).map(of).collect())
    }

    fn session(&self, _: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        Err(EngineError::InvalidInput("points cannot be refined".into()))
    }
}

fn points(count: usize, mut mean: impl FnMut(usize) -> [f32; 3]) -> Gaussians {
    Gaussians {
        means: (0..count).map(&mut mean).collect(),
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; count],
        log_scales: vec![[-5.0; 3]; count],
        logit_opacities: vec![2.0; count],
        sh: vec![0.1; 3 * count],
        sh_degree: 0,
    }
}

/// A population that moves as one body, with noise of 0.1 px in three views.
fn row(extreme: &'static str, count: usize, mean: impl FnMut(usize) -> [f32; 3]) -> Row {
    let motion = Rigid {
        turn: DQuat::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.1),
        about: DVec3::ZERO,
        shift: DVec3::new(0.05, 0.1, -0.1),
    };
    let gaussians = points(count, mean);
    let cameras = Rig { views: 3, ..Rig::USUAL }.cameras();
    let engine = Points { motion, noise: 0.1 };
    let field = estimate(&engine, &gaussians, &unread_tracks(&cameras), &MotionSettings::default()).unwrap();
    let mut row = Row::new("motion: population", extreme, FIELD);
    row.exact(is_sound(&field, count) && apply(&gaussians, &field).len() == count);
    // 0.1 px at 554 px focal length, four units away, twice that along the weak direction; 16 px make one track.
    let deviation = 0.1_f64.hypot(0.05) / (554.0 / 4.0) * 2.0;
    for index in 0..count {
        let mean = gaussians.mean(index);
        let error = (mean + field.translation[index] - motion.of(mean)).length();
        let is_moved = matches!(field.origin[index], MotionOrigin::Solved | MotionOrigin::Propagated);
        row.case(if is_moved { error } else { f64::INFINITY }, deviation);
    }
    row.remark(Origins::of(&field).remark())
}

fn anywhere(seed: u64) -> impl FnMut(usize) -> [f32; 3] {
    let mut random = random(seed);
    move |_| [0; 3].map(|_| random.random_range(-0.8..0.8))
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let grid = |index: usize| [index % 25, index / 25 % 25, index / 625].map(|k| k as f32 * 0.05 - 0.6);
    vec![
        row("no Gaussian", 0, anywhere(0)),
        row("one Gaussian", 1, anywhere(1)),
        row("two Gaussians", 2, anywhere(2)),
        row("1 000 000 Gaussians, 3 views", 1_000_000, anywhere(3)),
        row("100 000 identical Gaussians", 100_000, |_| [0.1, 0.2, -0.1]),
        row("15 625 Gaussians on a grid (ties among neighbours)", 15_625, grid),
        row("20 000 Gaussians on one plane", 20_000, {
            let mut anywhere = anywhere(4);
            move |index| {
                let [_, y, z] = anywhere(index);
                [0.25, y, z]
            }
        }),
        row("half of 2000 Gaussians identical", 2000, {
            let mut anywhere = anywhere(5);
            move |index| if index % 2 == 0 { [0.0; 3] } else { anywhere(index) }
        }),
    ]
}
