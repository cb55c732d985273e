//! A frame's Gaussians as their exact difference against the static model.
//!
//! Per parameter class: which Gaussians changed (one bit each), then their values as differences of bit patterns. What
//! refinement left alone costs one bit; applying the delta gives the frame's bits back.

use thiserror::Error;

use super::Gaussians;
use crate::formats::{
    byte_planes::{append, bit, pack_bits, take, undo_zigzag, values, zigzag_difference},
    container::{ContainerError, Sealed, seal},
};

const MAGIC: &[u8; 7] = b"TSDELTA";
const VERSION: u8 = 1;
/// Digest of the static model, number of Gaussians, harmonic degree.
const HEADER: usize = 32 + 8 + 4;

/// Why a delta does not give a frame.
#[derive(Debug, Error)]
pub enum DeltaError {
    /// Not a delta, or broken on the way.
    #[error(transparent)]
    Container(#[from] ContainerError),
    /// Made against another static model.
    #[error(
        "the delta belongs to the static model {found}, not to {expected}; use the static model of its own job"
    )]
    OtherStaticModel {
        /// BLAKE3 of the given static model, hexadecimal.
        expected: String,
        /// BLAKE3 that the delta names.
        found: String,
    },
    /// The static model has not the size that the delta was made for.
    #[error(
        "the delta is for {found} Gaussians of degree {found_degree}, the static model has {expected} of degree {expected_degree}; use the static model of its own job"
    )]
    Shape {
        /// Gaussians of the static model.
        expected: u64,
        /// Harmonic degree of the static model.
        expected_degree: u32,
        /// Gaussians that the delta names.
        found: u64,
        /// Harmonic degree that the delta names.
        found_degree: u32,
    },
}

/// The parameter classes as flat arrays with their values per Gaussian.
fn classes(gaussians: &Gaussians) -> [(&[f32], usize); 5] {
    [
        (gaussians.means.as_flattened(), 3),
        (gaussians.rotations.as_flattened(), 4),
        (gaussians.log_scales.as_flattened(), 3),
        (&gaussians.logit_opacities, 1),
        (&gaussians.sh, 3 * gaussians.sh_coefficients()),
    ]
}

/// [`classes`] to write to.
fn classes_mut(gaussians: &mut Gaussians) -> [(&mut [f32], usize); 5] {
    let harmonics = 3 * gaussians.sh_coefficients();
    [
        (gaussians.means.as_flattened_mut(), 3),
        (gaussians.rotations.as_flattened_mut(), 4),
        (gaussians.log_scales.as_flattened_mut(), 3),
        (&mut gaussians.logit_opacities, 1),
        (&mut gaussians.sh, harmonics),
    ]
}

/// `frame` as a delta against `static_model`, whose PLY bytes have the BLAKE3 digest `static_digest`. Equal input
/// gives equal bytes.
///
/// # Panics
/// If frame and static model differ in number of Gaussians or harmonic degree: a frame job keeps both.
pub fn encode(static_model: &Gaussians, static_digest: &[u8; 32], frame: &Gaussians) -> Vec<u8> {
    assert_eq!(
        (frame.len(), frame.sh_degree),
        (static_model.len(), static_model.sh_degree),
        "a frame has the Gaussians of its static model"
    );
    let mut body = Vec::new();
    for ((old, width), (new, _)) in classes(static_model).into_iter().zip(classes(frame)) {
        assert_eq!(new.len(), old.len(), "a frame has the Gaussians of its static model");
        let rows = || old.chunks_exact(width).zip(new.chunks_exact(width));
        let changed = |(old, new): (&[f32], &[f32])| {
            old.iter().zip(new).any(|(old, new)| old.to_bits() != new.to_bits())
        };
        body.extend(pack_bits(rows().map(changed)));
        let differences: Vec<u32> = rows()
            .filter(|&row| changed(row))
            .flat_map(|(old, new)| old.iter().zip(new))
            .map(|(old, new)| zigzag_difference(new.to_bits(), old.to_bits()))
            .collect();
        append::<4>(&mut body, &differences);
    }
    let mut header = static_digest.to_vec();
    header.extend((static_model.len() as u64).to_le_bytes());
    header.extend(static_model.sh_degree.to_le_bytes());
    seal(MAGIC, VERSION, &header, &body)
}

/// The frame that [`encode`] was given, bit for bit.
pub fn apply(
    static_model: &Gaussians,
    static_digest: &[u8; 32],
    bytes: &[u8],
) -> Result<Gaussians, DeltaError> {
    let sealed = Sealed::open(MAGIC, VERSION, HEADER, bytes)?;
    let (digest, shape) = sealed.header.split_at(32);
    if digest != static_digest {
        let hexadecimal = |digest: &[u8]| digest.iter().map(|byte| format!("{byte:02x}")).collect();
        return Err(DeltaError::OtherStaticModel {
            expected: hexadecimal(static_digest),
            found: hexadecimal(digest),
        });
    }
    let (count, degree) = shape.split_at(8);
    // The header has exactly these lengths, so the defaults are never taken.
    let found = u64::from_le_bytes(count.try_into().unwrap_or_default());
    let found_degree = u32::from_le_bytes(degree.try_into().unwrap_or_default());
    let (expected, expected_degree) = (static_model.len() as u64, static_model.sh_degree);
    if (found, found_degree) != (expected, expected_degree) {
        return Err(DeltaError::Shape { expected, expected_degree, found, found_degree });
    }

    let per_gaussian: usize = classes(static_model).iter().map(|(_, width)| 4 * width).sum();
    let flags = static_model.len().div_ceil(8);
    let body = sealed.body(5 * flags + static_model.len() * per_gaussian)?;
    let short = || ContainerError::Body("shorter than its changes".into());
    let mut rest = &body[..];
    let mut frame = static_model.clone();
    for (class, width) in classes_mut(&mut frame) {
        let flags = take(&mut rest, flags).ok_or_else(short)?;
        let changed: Vec<usize> = (0..class.len() / width).filter(|&gaussian| bit(flags, gaussian)).collect();
        let differences = values::<4>(take(&mut rest, 4 * changed.len() * width).ok_or_else(short)?);
        for (gaussian, differences) in changed.into_iter().zip(differences.chunks_exact(width)) {
            for (value, difference) in class[gaussian * width..].iter_mut().zip(differences) {
                *value = f32::from_bits(undo_zigzag(*difference, value.to_bits()));
            }
        }
    }
    if !rest.is_empty() {
        return Err(ContainerError::Body("longer than its changes".into()).into());
    }
    Ok(frame)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use proptest::prelude::*;

    use super::*;

    const DIGEST: [u8; 32] = [0xab; 32];

    fn model(count: usize, sh_degree: u32) -> Gaussians {
        let value = |index: usize| (index as f32 * 0.7).sin();
        let coefficients = 3 * crate::gaussians::sh::coefficients(sh_degree);
        Gaussians {
            means: (0..count).map(|i| [value(i), value(i + 1), value(i + 2)]).collect(),
            rotations: (0..count).map(|i| [value(i), value(i + 3), 0.0, -0.0]).collect(),
            log_scales: (0..count).map(|i| [value(i) - 4.0; 3]).collect(),
            logit_opacities: (0..count).map(value).collect(),
            sh: (0..count * coefficients).map(value).collect(),
            sh_degree,
        }
    }

    /// Equality of bits, which tells -0 from 0.
    fn same_bits(a: &Gaussians, b: &Gaussians) -> bool {
        classes(a).into_iter().zip(classes(b)).all(|((a, _), (b, _))| {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits())
        })
    }

    #[test]
    fn an_unchanged_frame_costs_next_to_nothing() {
        let model = model(5000, 3);
        let bytes = encode(&model, &DIGEST, &model);
        assert!(bytes.len() < 150, "{}", bytes.len());
        assert!(same_bits(&apply(&model, &DIGEST, &bytes).unwrap(), &model));
    }

    #[test]
    fn moving_few_gaussians_costs_little() {
        let model = model(5000, 3);
        let mut frame = model.clone();
        frame.means[..100].iter_mut().for_each(|mean| mean[0] += 1e-3);
        let bytes = encode(&model, &DIGEST, &frame);
        assert!(bytes.len() < 100 * 12, "{}", bytes.len());
        assert!(same_bits(&apply(&model, &DIGEST, &bytes).unwrap(), &frame));
    }

    #[test]
    fn another_static_model_is_refused() {
        let bytes = encode(&model(10, 1), &DIGEST, &model(10, 1));
        let error = apply(&model(10, 1), &[0xcd; 32], &bytes).unwrap_err();
        assert!(error.to_string().contains(&"ab".repeat(32)) && error.to_string().contains(&"cd".repeat(32)));
        for other in [model(9, 1), model(10, 2)] {
            assert!(matches!(apply(&other, &DIGEST, &bytes), Err(DeltaError::Shape { found: 10, .. })));
        }
    }

    #[test]
    fn broken_bytes_are_refused() {
        let model = model(20, 0);
        let mut frame = model.clone();
        frame.logit_opacities[3] += 1.0;
        let bytes = encode(&model, &DIGEST, &frame);
        for index in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[index] ^= 1;
            assert!(apply(&model, &DIGEST, &changed).is_err(), "byte {index}");
            assert!(apply(&model, &DIGEST, &bytes[..index]).is_err(), "length {index}");
        }
    }

    #[test]
    fn bodies_of_another_length_than_their_changes_are_refused() {
        let model = model(8, 0);
        let header = [&DIGEST[..], &8_u64.to_le_bytes(), &0_u32.to_le_bytes()].concat();
        for body in [&[][..], &[0; 4], &[0; 6], &[1, 0, 0, 0, 0], &[0xff; 40], &[0; 1000]] {
            let bytes = seal(MAGIC, VERSION, &header, body);
            assert!(
                matches!(apply(&model, &DIGEST, &bytes), Err(DeltaError::Container(ContainerError::Body(_)))),
                "{body:?}"
            );
        }
        assert!(apply(&model, &DIGEST, &seal(MAGIC, VERSION, &header, &[0; 5])).is_ok());
    }

    proptest! {
        #[test]
        fn any_frame_round_trips(
            count in 0..20_usize,
            degree in 0..=3_u32,
            changes in prop::collection::vec(any::<(usize, usize, u32)>(), 0..60),
        ) {
            let model = model(count, degree);
            let mut frame = model.clone();
            for (class, index, bits) in changes {
                let values = &mut *classes_mut(&mut frame)[class % 5].0;
                if !values.is_empty() {
                    let index = index % values.len();
                    values[index] = f32::from_bits(bits);
                }
            }
            let bytes = encode(&model, &DIGEST, &frame);
            prop_assert!(same_bits(&apply(&model, &DIGEST, &bytes).unwrap(), &frame));
            prop_assert_eq!(encode(&model, &DIGEST, &frame), bytes);
        }
    }
}
