//! Rotation of spherical harmonics: the rotated function at the rotated direction against the function as it was.

use glam::{DQuat, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use splat::gaussians::sh;

use crate::{
    reference::{ROUNDOFF_32, ROUNDOFF_64, project::harmonics},
    row::{Bar, Row},
};

const BAR: Bar = Bar {
    unit: "of the coefficients' sum",
    factor: 1.0,
    why: "2⁻²⁴ × one rounding per coefficient and rotation, and 2⁻⁵³ × 26 directions of quadrature",
};

fn direction(random: &mut ChaCha8Rng) -> DVec3 {
    DVec3::from_array(std::array::from_fn(|_| random.random_range(-1.0..1.0))).normalize()
}

fn value(coefficients: &[f32], direction: DVec3) -> f64 {
    let basis = harmonics(direction.to_array());
    coefficients.iter().step_by(3).zip(basis).map(|(&c, b)| f64::from(c) * b).sum()
}

/// Rotates `times` times by the same rotation.
fn add(row: &mut Row, random: &mut ChaCha8Rng, rotation: DQuat, size: f32, times: u32) {
    for degree in 0..=sh::MAX_DEGREE {
        let count = 3 * sh::coefficients(degree);
        let original: Vec<f32> = (0..count).map(|_| size * random.random_range(-1.0..1.0_f32)).collect();
        let mut rotated = original.clone();
        let mut turned = DQuat::IDENTITY;
        for _ in 0..times {
            sh::rotate(&mut rotated, rotation);
            turned = (rotation * turned).normalize();
        }
        let sum: f64 = original.iter().step_by(3).map(|&c| f64::from(c).abs()).sum();
        let tiny = f64::from(f32::MIN_POSITIVE) * ROUNDOFF_32;
        let predicted = f64::from(times) * (ROUNDOFF_32 + 26.0 * ROUNDOFF_64) + count as f64 * tiny / sum;
        row.case_of((0..10).map(|_| {
            let d = direction(random);
            ((value(&rotated, turned * d) - value(&original, d)).abs() / sum, predicted)
        }));
    }
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let mut random = ChaCha8Rng::seed_from_u64(8);
    let stage = "rotation of harmonics";
    let mut angles = Row::new(stage, "angles 0 and 1e-12 to π, degrees 0 to 3", BAR);
    for angle in [0.0, 1e-12, 1e-6, 1e-3, 0.5, 1.5, 3.0, std::f64::consts::PI] {
        let rotation = DQuat::from_axis_angle(direction(&mut random), angle);
        add(&mut angles, &mut random, rotation, 1.0, 1);
    }
    let mut sizes = Row::new(stage, "coefficients of 1e-36 to 1e36", BAR);
    for power in [-36, -20, -5, 5, 20, 36] {
        let rotation = DQuat::from_axis_angle(direction(&mut random), 1.0);
        add(&mut sizes, &mut random, rotation, 10.0_f32.powi(power), 1);
    }
    let mut often = Row::new(stage, "1000 rotations in a row", BAR);
    for angle in [1e-4, 0.1, 2.0] {
        let rotation = DQuat::from_axis_angle(direction(&mut random), angle);
        add(&mut often, &mut random, rotation, 1.0, 1000);
    }
    vec![angles, sizes, often]
}
