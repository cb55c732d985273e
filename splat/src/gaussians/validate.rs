//! Invariants of a set of Gaussians.

use thiserror::Error;

use super::{Gaussians, sh};

/// Which invariant a set breaks, and where.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum InvalidGaussians {
    /// The spherical-harmonic degree is not supported.
    #[error("spherical harmonics of degree {0}, at most 3 are supported; reduce the degree")]
    Degree(u32),
    /// The arrays disagree on the number of Gaussians.
    #[error(
        "`{property}` has {found} values, {expected} are needed for {gaussians} Gaussians; export the set again"
    )]
    Length {
        /// Name of the array.
        property: &'static str,
        /// Values that are there.
        found: usize,
        /// Values that should be there.
        expected: usize,
        /// Number of means.
        gaussians: usize,
    },
    /// A parameter is not a finite number.
    #[error("Gaussian {index}, `{property}` is {value}; remove it from the set")]
    NotFinite {
        /// Counting from 0.
        index: usize,
        /// Name of the array.
        property: &'static str,
        /// What is stored.
        value: f32,
    },
    /// A quaternion without a direction.
    #[error("Gaussian {index}, `rotations` is the zero quaternion; store 1 0 0 0 for no rotation")]
    ZeroRotation {
        /// Counting from 0.
        index: usize,
    },
}

/// Checks that the arrays belong together, every value is finite and every quaternion has a direction.
pub fn validate(gaussians: &Gaussians) -> Result<(), InvalidGaussians> {
    let count = gaussians.len();
    if gaussians.sh_degree > sh::MAX_DEGREE {
        return Err(InvalidGaussians::Degree(gaussians.sh_degree));
    }
    check("means", gaussians.means.as_flattened(), 3, count)?;
    check("rotations", gaussians.rotations.as_flattened(), 4, count)?;
    check("log_scales", gaussians.log_scales.as_flattened(), 3, count)?;
    check("logit_opacities", &gaussians.logit_opacities, 1, count)?;
    check("sh", &gaussians.sh, 3 * gaussians.sh_coefficients(), count)?;
    match gaussians.rotations.iter().position(|rotation| *rotation == [0.0; 4]) {
        Some(index) => Err(InvalidGaussians::ZeroRotation { index }),
        None => Ok(()),
    }
}

/// Length and finiteness of one array of `width` values per Gaussian.
fn check(
    property: &'static str,
    values: &[f32],
    width: usize,
    gaussians: usize,
) -> Result<(), InvalidGaussians> {
    let (found, expected) = (values.len(), gaussians * width);
    if found != expected {
        return Err(InvalidGaussians::Length { property, found, expected, gaussians });
    }
    match values.iter().position(|value| !value.is_finite()) {
        Some(at) => Err(InvalidGaussians::NotFinite { index: at / width, property, value: values[at] }),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Spoil = fn(&mut Gaussians);

    fn valid() -> Gaussians {
        Gaussians {
            means: vec![[1.0, 2.0, 3.0]; 4],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; 4],
            log_scales: vec![[-2.0; 3]; 4],
            logit_opacities: vec![0.5; 4],
            sh: vec![0.1; 4 * 12],
            sh_degree: 1,
        }
    }

    #[test]
    fn sound_sets_pass() {
        assert_eq!(validate(&valid()), Ok(()));
        assert_eq!(validate(&Gaussians::empty(3)), Ok(()));
        // The smallest subnormal still gives a direction.
        let tiny = Gaussians { rotations: vec![[0.0, f32::from_bits(1), 0.0, -0.0]; 4], ..valid() };
        assert_eq!(validate(&tiny), Ok(()));
    }

    #[test]
    fn broken_values_are_named() {
        let cases: [(&str, Spoil); 5] = [
            ("Gaussian 2, `means` is NaN", |set| set.means[2][1] = f32::NAN),
            ("Gaussian 0, `rotations` is inf", |set| set.rotations[0][3] = f32::INFINITY),
            ("Gaussian 3, `log_scales` is -inf", |set| set.log_scales[3][0] = f32::NEG_INFINITY),
            ("Gaussian 1, `logit_opacities` is NaN", |set| set.logit_opacities[1] = f32::NAN),
            ("Gaussian 3, `sh` is NaN", |set| set.sh[36] = f32::NAN),
        ];
        for (expected, spoil) in cases {
            let mut gaussians = valid();
            spoil(&mut gaussians);
            let message = validate(&gaussians).expect_err(expected).to_string();
            assert!(message.starts_with(expected), "{message}");
        }
    }

    #[test]
    fn broken_shapes_are_named() {
        let cases: [(&str, Spoil); 6] = [
            ("`rotations` has 20 values, 16", |set| set.rotations.push([1.0; 4])),
            ("`log_scales` has 9 values, 12", |set| set.log_scales.truncate(3)),
            ("`logit_opacities` has 0 values, 4", |set| set.logit_opacities.clear()),
            ("`sh` has 47 values, 48", |set| set.sh.truncate(47)),
            ("spherical harmonics of degree 4", |set| set.sh_degree = 4),
            ("Gaussian 3, `rotations` is the zero quaternion", |set| {
                set.rotations[3] = [0.0, -0.0, 0.0, 0.0]
            }),
        ];
        for (expected, spoil) in cases {
            let mut gaussians = valid();
            spoil(&mut gaussians);
            let message = validate(&gaussians).expect_err(expected).to_string();
            assert!(message.starts_with(expected), "{message}");
        }
    }
}
