//! Moving Gaussians by a motion field.

use glam::{DQuat, Quat};
use rayon::prelude::*;

use super::MotionField;
use crate::gaussians::{Gaussians, sh};

/// The Gaussians after a motion: means moved, rotations composed, spherical harmonics rotated with them, scales
/// stretched.
///
/// Opacities stay, and so does the norm of each stored quaternion. A Gaussian without motion keeps
/// its bytes.
pub fn apply(gaussians: &Gaussians, field: &MotionField) -> Gaussians {
    let mut moved = gaussians.clone();
    for (index, translation) in field.translation.iter().enumerate().take(moved.len()) {
        if *translation != glam::DVec3::ZERO {
            moved.means[index] = (gaussians.mean(index) + *translation).as_vec3().to_array();
        }
    }
    for (stored, change) in moved.log_scales.iter_mut().zip(&field.log_scale) {
        if *change != glam::DVec3::ZERO {
            for (stored, change) in stored.iter_mut().zip(change.to_array()) {
                *stored += change as f32;
            }
        }
    }
    moved.rotations.par_iter_mut().zip(&field.rotation).for_each(|(stored, turn)| {
        if *turn != DQuat::IDENTITY {
            *stored = turned(*stored, *turn);
        }
    });
    let stride = moved.sh_coefficients() * 3;
    moved.sh.par_chunks_mut(stride).zip(&field.rotation).for_each(|(coefficients, turn)| {
        if *turn != DQuat::IDENTITY {
            sh::rotate(coefficients, *turn);
        }
    });
    moved
}

/// `turn * stored` for a quaternion stored as `w, x, y, z` of any norm.
fn turned(stored: [f32; 4], turn: DQuat) -> [f32; 4] {
    let [w, x, y, z] = stored;
    let product = turn * Quat::from_xyzw(x, y, z, w).as_dquat();
    [product.w as f32, product.x as f32, product.y as f32, product.z as f32]
}
