//! Track fields as compact blobs: what coordinator and workers exchange.
//!
//! Positions are rounded to 1/64 pixel and saturate 131 072 pixels away from where they started; standard deviations
//! keep nine significant bits (relative error at most 0.2 %) and saturate at 65 536 pixels. Whatever is not a number
//! becomes an invisible pixel that did not move. Encoding a decoded blob gives the same bytes.

use super::{
    TrackError,
    byte_planes::{append, bit, pack_bits, row_differences, take, undo_row_differences, values},
    container::{ContainerError, Sealed, seal},
};
use crate::tracking::TrackField;

const MAGIC: &[u8; 7] = b"TSTRACK";
const VERSION: u8 = 1;
/// Width, height.
const HEADER: usize = 4 + 4;

/// Steps per pixel.
const STEPS: f64 = 64.0;
/// Positions up to this plus the image's width are exact multiples of a step in f32, so decoding is exact.
const MAX_DISPLACEMENT: f64 = 131_072.0;
/// Largest standard deviation: nothing is known, and its square is still far from overflow.
const MAX_SIGMA: f32 = 65_536.0;

/// Longest side of an image. Bounds what a blob can make the decoder allocate, with [`MAX_PIXELS`].
pub const MAX_SIDE: u32 = 65_536;
/// Most pixels of an image, 8192 × 8192.
pub const MAX_PIXELS: u64 = 1 << 26;

/// Bytes of a pixel in the body besides its visibility: differences of two 32-bit displacements, and of a 16-bit
/// standard deviation, which with its sign takes 17 bits.
const PIXEL_BYTES: usize = 4 + 4 + 3;

/// Compresses a track field. Equal fields give equal bytes.
///
/// The field's arrays must have `width * height` entries, and a decodable size: at most [`MAX_SIDE`] per side and
/// [`MAX_PIXELS`] in all.
pub fn encode(field: &TrackField) -> Vec<u8> {
    let width = field.width as usize;
    let pixels = field.positions.len();
    let mut displacements = [Vec::with_capacity(pixels), Vec::with_capacity(pixels)];
    let mut sigmas = Vec::with_capacity(pixels);
    let mut visible = Vec::with_capacity(pixels);
    for (index, (position, sigma)) in field.positions.iter().zip(&field.sigma).enumerate() {
        let known = position.iter().all(|value| value.is_finite()) && *sigma >= 0.0;
        let centre = [(index % width) as f64 + 0.5, (index / width) as f64 + 0.5];
        for axis in 0..2 {
            let displacement = if known { f64::from(position[axis]) - centre[axis] } else { 0.0 };
            let steps = (displacement.clamp(-MAX_DISPLACEMENT, MAX_DISPLACEMENT) * STEPS).round();
            displacements[axis].push((steps as i32).cast_unsigned());
        }
        sigmas.push(u32::from(pack_sigma(if known { *sigma } else { MAX_SIGMA })));
        visible.push(known && field.visible[index]);
    }

    let mut body = Vec::with_capacity(pixels * PIXEL_BYTES + pixels.div_ceil(8));
    for displacement in &displacements {
        append::<4>(&mut body, &row_differences(displacement, width));
    }
    append::<3>(&mut body, &row_differences(&sigmas, width));
    body.extend(pack_bits(visible.into_iter()));
    let header = [field.width.to_le_bytes(), field.height.to_le_bytes()].concat();
    seal(MAGIC, VERSION, &header, &body)
}

/// The width and height that a blob claims, checked against nothing: so that one that nobody wants need not be
/// decompressed.
pub fn size(bytes: &[u8]) -> Result<(u32, u32), TrackError> {
    Ok(size_of(&Sealed::open(MAGIC, VERSION, HEADER, bytes)?))
}

fn size_of(sealed: &Sealed<'_>) -> (u32, u32) {
    let (width, height) = sealed.header.split_at(4);
    // The header has exactly these lengths, so the defaults are never taken.
    let number = |bytes: &[u8]| u32::from_le_bytes(bytes.try_into().unwrap_or_default());
    (number(width), number(height))
}

/// Decompresses a track field.
pub fn decode(bytes: &[u8]) -> Result<TrackField, TrackError> {
    let sealed = Sealed::open(MAGIC, VERSION, HEADER, bytes)?;
    let (width, height) = size_of(&sealed);
    if width.max(height) > MAX_SIDE || u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(TrackError::Size { width, height });
    }

    let pixels = width as usize * height as usize;
    let size = pixels * PIXEL_BYTES + pixels.div_ceil(8);
    let body = sealed.body(size)?;
    if body.len() != size {
        let problem = format!("{} bytes, {size} are needed for {width}x{height} pixels", body.len());
        return Err(ContainerError::Body(problem).into());
    }
    let mut rest = &body[..];
    // The length has just been checked, so nothing is ever missing.
    let mut plane = |bytes: usize| take(&mut rest, bytes).unwrap_or_default();
    let columns = width as usize;
    let x = undo_row_differences(values::<4>(plane(4 * pixels)), columns);
    let y = undo_row_differences(values::<4>(plane(4 * pixels)), columns);
    let sigma = undo_row_differences(values::<3>(plane(3 * pixels)), columns);
    let visible = plane(pixels.div_ceil(8));

    let position =
        |steps: u32, centre: usize| (centre as f64 + 0.5 + f64::from(steps.cast_signed()) / STEPS) as f32;
    Ok(TrackField {
        width,
        height,
        positions: (0..pixels)
            .map(|index| [position(x[index], index % columns), position(y[index], index / columns)])
            .collect(),
        visible: (0..pixels).map(|index| bit(visible, index)).collect(),
        sigma: sigma.into_iter().map(|packed| unpack_sigma(packed as u16)).collect(),
    })
}

/// A standard deviation as the upper half of its f32 bits, shifted by the sign that it does not have: eight bits of
/// exponent and eight of mantissa, rounded to nearest.
fn pack_sigma(sigma: f32) -> u16 {
    ((sigma.clamp(0.0, MAX_SIGMA).to_bits() + (1 << 14)) >> 15) as u16
}

fn unpack_sigma(packed: u16) -> f32 {
    f32::from_bits(u32::from(packed) << 15)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use proptest::prelude::*;

    use super::*;

    fn field(width: u32, height: u32, pixel: impl Fn(usize) -> ([f32; 2], bool, f32)) -> TrackField {
        let pixels: Vec<_> = (0..(width * height) as usize).map(pixel).collect();
        TrackField {
            width,
            height,
            positions: pixels.iter().map(|pixel| pixel.0).collect(),
            visible: pixels.iter().map(|pixel| pixel.1).collect(),
            sigma: pixels.iter().map(|pixel| pixel.2).collect(),
        }
    }

    fn smooth(width: u32, height: u32) -> TrackField {
        field(width, height, |index| {
            let (x, y) = ((index % width as usize) as f32 + 0.5, (index / width as usize) as f32 + 0.5);
            let shift = 5.0 * (x * 0.03).sin();
            ([x + 12.0 + shift, y - 3.0 * (y * 0.05).cos()], index % 7 != 0, 0.1 + 0.01 * shift.abs())
        })
    }

    #[test]
    fn a_field_survives_within_the_stated_errors() {
        let field = smooth(53, 31);
        let decoded = decode(&encode(&field)).unwrap();
        assert_eq!((decoded.width, decoded.height, &decoded.visible), (53, 31, &field.visible));
        for (decoded, original) in decoded.positions.iter().flatten().zip(field.positions.iter().flatten()) {
            assert!((decoded - original).abs() <= 0.5 / 64.0);
        }
        for (decoded, original) in decoded.sigma.iter().zip(&field.sigma) {
            assert!((decoded - original).abs() <= original / 511.0);
        }
    }

    #[test]
    fn a_smooth_field_is_small() {
        let bytes = encode(&smooth(320, 180));
        // 13 bytes per pixel in memory.
        assert!(bytes.len() < 320 * 180 * 2, "{} bytes", bytes.len());
    }

    #[test]
    fn the_origin_of_every_pixel_is_exact() {
        let standing =
            field(300, 2, |index| ([(index % 300) as f32 + 0.5, (index / 300) as f32 + 0.5], true, 0.25));
        assert_eq!(decode(&encode(&standing)).unwrap(), standing);
    }

    #[test]
    fn extremes_saturate_and_what_is_no_number_becomes_invisible() {
        let pixels = [
            ([1e30, -1e30], 0.0),
            ([f32::NAN, 1.0], 1.0),
            ([2.0, f32::INFINITY], 1.0),
            ([3.0, 3.0], f32::NAN),
            ([4.0, 4.0], -1.0),
            ([5.0, 5.0], f32::INFINITY),
            ([6.0, 0.5], 1e-40),
        ];
        let decoded =
            decode(&encode(&field(7, 1, |index| (pixels[index].0, true, pixels[index].1)))).unwrap();
        assert_eq!(decoded.visible, [true, false, false, false, false, true, true]);
        assert_eq!(decoded.positions[0], [131_072.5, -131_071.5]);
        for index in 1..5 {
            assert_eq!(
                (decoded.positions[index], decoded.sigma[index]),
                ([index as f32 + 0.5, 0.5], MAX_SIGMA)
            );
        }
        assert_eq!(decoded.sigma[5], MAX_SIGMA);
        assert!((decoded.sigma[6] - 1e-40).abs() < 1e-40);
    }

    #[test]
    fn empty_fields_are_fields() {
        for (width, height) in [(0, 0), (0, 5), (5, 0)] {
            let empty = field(width, height, |_| unreachable!());
            assert_eq!(decode(&encode(&empty)).unwrap(), empty);
        }
    }

    #[test]
    fn broken_blobs_are_refused() {
        let bytes = encode(&smooth(9, 4));
        for index in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[index] ^= 1;
            assert!(decode(&changed).is_err(), "byte {index}");
            assert!(decode(&bytes[..index]).is_err(), "length {index}");
        }
        let header = |width: u32, height: u32| [width.to_le_bytes(), height.to_le_bytes()].concat();
        let huge = seal(MAGIC, VERSION, &header(u32::MAX, u32::MAX), &[]);
        assert_eq!(size(&huge).unwrap(), (u32::MAX, u32::MAX), "known without the body");
        assert!(size(&huge[..huge.len() - 1]).is_err());
        assert!(matches!(decode(&huge), Err(TrackError::Size { .. })));
        for body in [0, 11, 13] {
            let short = seal(MAGIC, VERSION, &header(1, 1), &vec![0; body]);
            assert!(matches!(decode(&short), Err(TrackError::Container(ContainerError::Body(_)))));
        }
    }

    proptest! {
        #[test]
        fn encoding_is_idempotent(
            width in 1..9_u32,
            pixels in prop::collection::vec(any::<(u32, u32, bool, u32)>(), 1..60),
        ) {
            let height = (pixels.len() as u32).div_ceil(width);
            let of_bits = |index: usize| {
                let (x, y, visible, sigma) = pixels[index % pixels.len()];
                ([f32::from_bits(x), f32::from_bits(y)], visible, f32::from_bits(sigma))
            };
            let bytes = encode(&field(width, height, of_bits));
            prop_assert_eq!(encode(&decode(&bytes).unwrap()), bytes);
        }

        #[test]
        fn encoding_is_idempotent_at_plausible_positions(
            width in 1..9_u32,
            pixels in prop::collection::vec(any::<(i32, i16, bool)>(), 1..60),
        ) {
            let height = (pixels.len() as u32).div_ceil(width);
            let of_bits = |index: usize| {
                let (x, y, visible) = pixels[index % pixels.len()];
                ([x as f32 / 16_384.0, f32::from(y) / 77.0], visible, f32::from(y.unsigned_abs()) / 300.0)
            };
            let bytes = encode(&field(width, height, of_bits));
            prop_assert_eq!(encode(&decode(&bytes).unwrap()), bytes);
        }
    }
}
