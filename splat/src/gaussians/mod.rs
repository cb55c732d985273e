//! Sets of 3D Gaussians.
//!
//! Parameters are stored as they are optimised and as the Inria PLY layout stores them: natural logarithm of
//! the standard deviations, logit of the opacity, unnormalised quaternion `w, x, y, z`.

pub mod delta;
pub mod gradients;
pub(crate) mod part;
pub mod sh;
pub mod validate;

use glam::{DMat3, DQuat, DVec3};

/// A set of `N` Gaussians, one array per parameter class.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gaussians {
    /// World positions, `N × 3`, in the clip's world units.
    pub means: Vec<[f32; 3]>,
    /// Quaternions `w, x, y, z`, `N × 4`, not necessarily normalised.
    pub rotations: Vec<[f32; 4]>,
    /// Natural logarithm of the standard deviations along the rotated axes, `N × 3`.
    pub log_scales: Vec<[f32; 3]>,
    /// Logit of the opacity, `N`.
    pub logit_opacities: Vec<f32>,
    /// Spherical-harmonic coefficients, `N × K × 3` with `K = (sh_degree + 1)²`: Gaussian, coefficient, channel.
    pub sh: Vec<f32>,
    /// 0 to 3.
    pub sh_degree: u32,
}

impl Gaussians {
    /// An empty set of the given spherical-harmonic degree.
    pub fn empty(sh_degree: u32) -> Self {
        Self { sh_degree, ..Self::default() }
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }

    /// Coefficients per Gaussian and channel, `(sh_degree + 1)²`.
    pub fn sh_coefficients(&self) -> usize {
        sh::coefficients(self.sh_degree)
    }

    /// The `K × 3` coefficients of Gaussian `index`.
    pub fn sh_of(&self, index: usize) -> &[f32] {
        let stride = self.sh_coefficients() * 3;
        &self.sh[index * stride..(index + 1) * stride]
    }

    /// World position of Gaussian `index`.
    pub fn mean(&self, index: usize) -> DVec3 {
        let [x, y, z] = self.means[index];
        DVec3::new(x.into(), y.into(), z.into())
    }

    /// Normalised rotation of Gaussian `index`; the identity where the stored quaternion has no direction.
    pub fn rotation(&self, index: usize) -> DQuat {
        normalised_rotation(self.rotations[index])
    }

    /// World covariance `R diag(exp(s))² Rᵀ` of Gaussian `index`.
    pub fn covariance(&self, index: usize) -> DMat3 {
        let [a, b, c] = self.log_scales[index];
        let scale = DVec3::new(a.into(), b.into(), c.into()).exp();
        let axes = DMat3::from_quat(self.rotation(index)) * DMat3::from_diagonal(scale);
        axes * axes.transpose()
    }

    /// Opacity of Gaussian `index` in `[0, 1]`.
    pub fn opacity(&self, index: usize) -> f64 {
        sigmoid(self.logit_opacities[index].into())
    }

    /// Whether every parameter of Gaussian `index` is a finite number and its quaternion has a direction.
    pub fn is_finite(&self, index: usize) -> bool {
        let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
        finite(&self.means[index])
            && finite(&self.rotations[index])
            && self.rotations[index] != [0.0; 4]
            && finite(&self.log_scales[index])
            && self.logit_opacities[index].is_finite()
            && finite(self.sh_of(index))
    }

    /// The Gaussians of `indices`, in that order.
    pub fn select(&self, indices: &[usize]) -> Self {
        Self {
            means: indices.iter().map(|&i| self.means[i]).collect(),
            rotations: indices.iter().map(|&i| self.rotations[i]).collect(),
            log_scales: indices.iter().map(|&i| self.log_scales[i]).collect(),
            logit_opacities: indices.iter().map(|&i| self.logit_opacities[i]).collect(),
            sh: indices.iter().flat_map(|&i| self.sh_of(i).iter().copied()).collect(),
            sh_degree: self.sh_degree,
        }
    }
}

/// A stored `w, x, y, z` quaternion as a unit quaternion; the identity for zero or non-finite input.
///
/// Works in f64 after dividing by the largest component, so that norms from 1e-20 to 1e20 neither vanish nor
/// overflow when squared.
pub fn normalised_rotation(stored: [f32; 4]) -> DQuat {
    let [w, x, y, z] = stored.map(f64::from);
    let largest = w.abs().max(x.abs()).max(y.abs()).max(z.abs());
    // A maximum passes over NaN, a sum does not.
    if !(largest > 0.0 && (w + x + y + z).is_finite()) {
        return DQuat::IDENTITY;
    }
    DQuat::from_xyzw(x / largest, y / largest, z / largest, w / largest).normalize()
}

/// `1 / (1 + exp(-x))`, without overflow at either end.
pub fn sigmoid(x: f64) -> f64 {
    if x >= 0.0 {
        return 1.0 / (1.0 + (-x).exp());
    }
    let e = x.exp();
    e / (1.0 + e)
}

/// Inverse of [`sigmoid`] for `p` in `(0, 1)`.
pub fn logit(p: f64) -> f64 {
    (p / (1.0 - p)).ln()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quaternions_without_direction_do_not_rotate() {
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            for place in 0..4 {
                let mut stored = [0.1, 0.2, 0.3, 0.4];
                stored[place] = value;
                assert_eq!(normalised_rotation(stored), DQuat::IDENTITY, "{stored:?}");
            }
        }
        assert_eq!(normalised_rotation([0.0, -0.0, 0.0, 0.0]), DQuat::IDENTITY);
        assert_eq!(normalised_rotation([f32::INFINITY, f32::NEG_INFINITY, 0.0, 0.0]), DQuat::IDENTITY);
        assert_eq!(normalised_rotation([f32::MAX, 0.0, 0.0, 0.0]), DQuat::IDENTITY);
        assert_eq!(
            normalised_rotation([0.0, f32::from_bits(1), 0.0, 0.0]),
            DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0)
        );
    }
}
