//! States of the tracker as compact blobs: what whoever goes on with a view begins with. Every bit survives.

use super::{
    TrackError,
    byte_planes::{append, bit, pack_bits, row_differences, take, undo_row_differences, values},
    container::{ContainerError, Sealed, seal},
    track_blob::{MAX_PIXELS, MAX_SIDE},
};
use crate::tracking::state::{PLANES, Remembered, TrackState};

const MAGIC: &[u8; 7] = b"TSSTATE";
/// Version of the format.
pub const VERSION: u8 = 1;
/// Width, height, number of frames.
const HEADER: usize = 4 + 4 + 4;

/// Largest body, uncompressed. Bounds what a blob can make the decoder allocate.
pub const MAX_BYTES: u64 = 1 << 30;

/// Bytes of a state of tracks of this size before compression, which saves about two fifths.
pub fn uncompressed_bytes(width: u32, height: u32, frames: u32) -> u64 {
    let pixels = u64::from(width).saturating_mul(u64::from(height));
    let per_frame = pixels.saturating_mul(4 * PLANES as u64).saturating_add(pixels.div_ceil(8) + 4);
    per_frame.saturating_mul(u64::from(frames))
}

/// Compresses a state. Equal states give equal bytes.
///
/// States whose [`uncompressed_bytes`] are more than [`MAX_BYTES`] cannot be decoded again.
pub fn encode(state: &TrackState) -> Vec<u8> {
    let frames = u32::try_from(state.frames.len()).unwrap_or(u32::MAX);
    let mut body = Vec::with_capacity(uncompressed_bytes(state.width, state.height, frames) as usize);
    for frame in &state.frames {
        body.extend(frame.index.to_le_bytes());
    }
    for frame in &state.frames {
        for plane in &frame.planes {
            let bits: Vec<u32> = plane.iter().map(|value| value.to_bits()).collect();
            append::<4>(&mut body, &row_differences(&bits, state.width as usize));
        }
        body.extend(pack_bits(frame.visible.iter().copied()));
    }
    let header = [state.width, state.height, frames].map(u32::to_le_bytes).concat();
    seal(MAGIC, VERSION, &header, &body)
}

/// What a state says of itself before it is decompressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Columns of the tracks.
    pub width: u32,
    /// Rows of the tracks.
    pub height: u32,
    /// Frames that are remembered.
    pub frames: u32,
}

/// The shape that a blob claims, checked against nothing: so that one that nobody wants need not be decompressed.
pub fn shape(bytes: &[u8]) -> Result<Shape, TrackError> {
    Ok(shape_of(&Sealed::open(MAGIC, VERSION, HEADER, bytes)?))
}

fn shape_of(sealed: &Sealed<'_>) -> Shape {
    let [width, height, frames] = [0, 4, 8].map(|start| number(&sealed.header[start..]));
    Shape { width, height, frames }
}

/// Decompresses a state.
pub fn decode(bytes: &[u8]) -> Result<TrackState, TrackError> {
    let sealed = Sealed::open(MAGIC, VERSION, HEADER, bytes)?;
    let Shape { width, height, frames } = shape_of(&sealed);
    let pixels = u64::from(width) * u64::from(height);
    let size = uncompressed_bytes(width, height, frames);
    if width.max(height) > MAX_SIDE || pixels > MAX_PIXELS {
        return Err(TrackError::Size { width, height });
    }
    if size > MAX_BYTES {
        let problem = format!("{frames} frames of {width}x{height} pixels, more than {MAX_BYTES} bytes");
        return Err(ContainerError::Body(problem).into());
    }
    let (pixels, size) = (pixels as usize, size as usize);
    let body = sealed.body(size)?;
    if body.len() != size {
        let problem =
            format!("{} bytes, {size} are needed for {frames} frames of {width}x{height}", body.len());
        return Err(ContainerError::Body(problem).into());
    }
    let mut rest = &body[..];
    // The length has just been checked, so nothing is ever missing.
    let mut part = |bytes: usize| take(&mut rest, bytes).unwrap_or_default();
    let indices: Vec<u32> = part(4 * frames as usize).chunks_exact(4).map(number).collect();
    if indices.first() == Some(&0) || !indices.is_sorted_by(|earlier, later| earlier < later) {
        let problem = format!("frames {indices:?} are not in order after the key frame");
        return Err(ContainerError::Body(problem).into());
    }
    let mut remembered = Vec::with_capacity(indices.len());
    for index in indices {
        let mut planes = [const { Vec::new() }; PLANES];
        for plane in &mut planes {
            let bits = undo_row_differences(values::<4>(part(4 * pixels)), width as usize);
            *plane = bits.into_iter().map(f32::from_bits).collect();
        }
        let visible = part(pixels.div_ceil(8));
        let visible = (0..pixels).map(|pixel| bit(visible, pixel)).collect();
        remembered.push(Remembered { index, planes, visible });
    }
    Ok(TrackState { width, height, frames: remembered })
}

/// The number that four bytes begin with.
fn number(bytes: &[u8]) -> u32 {
    bytes.first_chunk().map_or(0, |bytes| u32::from_le_bytes(*bytes))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use proptest::prelude::*;

    use super::*;

    /// Of 9 × 4 pixels: smooth, with every kind of number that is none among them.
    fn state(indices: &[u32]) -> TrackState {
        let odd = [f32::NAN, f32::INFINITY, -0.0, f32::MIN_POSITIVE / 2.0, f32::from_bits(0xffff_ffff)];
        let frame = |index: u32| {
            let plane = |seed: usize| {
                let value = |i: usize| if i % 7 == seed { odd[i % 5] } else { (i * seed) as f32 * 0.3 };
                (0..36).map(value).collect()
            };
            let visible = (0..36).map(|i| i % (index as usize + 1) == 0).collect();
            Remembered { index, planes: [plane(0), plane(1), plane(2), plane(3)], visible }
        };
        TrackState { width: 9, height: 4, frames: indices.iter().copied().map(frame).collect() }
    }

    /// Also tells one NaN from another.
    fn bits(state: &TrackState) -> Vec<(u32, Vec<u32>, Vec<bool>)> {
        let of_frame = |frame: &Remembered| {
            let values = frame.planes.iter().flatten().map(|value| value.to_bits()).collect();
            (frame.index, values, frame.visible.clone())
        };
        state.frames.iter().map(of_frame).collect()
    }

    fn header(width: u32, height: u32, frames: u32) -> Vec<u8> {
        [width, height, frames].map(u32::to_le_bytes).concat()
    }

    #[test]
    fn every_bit_survives() {
        for indices in [&[][..], &[1], &[14, 15], &[3, 5, 900]] {
            let state = state(indices);
            let decoded = decode(&encode(&state)).unwrap();
            assert_eq!((decoded.width, decoded.height), (9, 4));
            assert_eq!(bits(&decoded), bits(&state));
            assert_eq!(
                decoded.indices().collect::<Vec<_>>(),
                indices.iter().map(|&i| i as usize).collect::<Vec<_>>()
            );
        }
        assert_eq!(decode(&encode(&TrackState::default())).unwrap(), TrackState::default());
    }

    #[test]
    fn the_shape_is_read_without_the_body() {
        let shape_of = |bytes: &[u8]| shape(bytes).map(|shape| (shape.width, shape.height, shape.frames));
        assert_eq!(shape_of(&encode(&state(&[4, 5]))).unwrap(), (9, 4, 2));
        assert_eq!(shape_of(&encode(&TrackState::default())).unwrap(), (0, 0, 0));
        let claimed = seal(MAGIC, VERSION, &header(8192, 8191, u32::MAX), &[]);
        assert_eq!(shape_of(&claimed).unwrap(), (8192, 8191, u32::MAX));
        assert!(shape_of(&claimed[..claimed.len() - 1]).is_err());
    }

    #[test]
    fn broken_blobs_are_refused() {
        let bytes = encode(&state(&[4, 5]));
        for index in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[index] ^= 1;
            assert!(decode(&changed).is_err(), "byte {index}");
            assert!(decode(&bytes[..index]).is_err(), "length {index}");
        }
        for indices in [[0, 1], [2, 2], [3, 2]] {
            let error = decode(&encode(&state(&indices))).unwrap_err().to_string();
            assert!(error.contains("in order") && error.contains("fetch it again"), "{error}");
        }
    }

    #[test]
    fn impossible_sizes_are_refused_before_anything_is_allocated() {
        let of = |width, height, frames| decode(&seal(MAGIC, VERSION, &header(width, height, frames), &[]));
        assert!(matches!(of(u32::MAX, u32::MAX, u32::MAX), Err(TrackError::Size { .. })));
        assert!(matches!(of(MAX_SIDE + 1, 1, 0), Err(TrackError::Size { .. })));
        for (width, height, frames) in [(8192, 8192, 1), (1, 1, u32::MAX), (0, 0, 1 << 29), (640, 360, 300)] {
            assert!(uncompressed_bytes(width, height, frames) > MAX_BYTES);
            assert!(matches!(of(width, height, frames), Err(TrackError::Container(ContainerError::Body(_)))));
        }
        for body in [0, 20, 22] {
            let short = seal(MAGIC, VERSION, &header(1, 1, 1), &vec![1; body]);
            assert!(matches!(decode(&short), Err(TrackError::Container(ContainerError::Body(_)))));
        }
    }

    proptest! {
        #[test]
        fn any_bytes_in_a_valid_envelope_are_a_state_or_an_error(
            width in 0..5_u32,
            height in 0..5_u32,
            frames in 0..4_u32,
            body in prop::collection::vec(any::<u8>(), 0..1700),
        ) {
            let fitting = uncompressed_bytes(width, height, frames) as usize;
            for length in [body.len(), fitting] {
                let mut body = body.clone();
                body.resize(length, 1);
                if let Ok(state) = decode(&seal(MAGIC, VERSION, &header(width, height, frames), &body)) {
                    let again = decode(&encode(&state)).unwrap();
                    prop_assert_eq!(bits(&again), bits(&state));
                }
            }
        }

        #[test]
        fn any_numbers_survive(pixels in prop::collection::vec(any::<([u32; PLANES], bool)>(), 1..40)) {
            let plane = |plane: usize| pixels.iter().map(|pixel| f32::from_bits(pixel.0[plane])).collect();
            let visible = pixels.iter().map(|pixel| pixel.1).collect();
            let frame = Remembered { index: 7, planes: [plane(0), plane(1), plane(2), plane(3)], visible };
            let state = TrackState { width: 1, height: pixels.len() as u32, frames: vec![frame] };
            prop_assert_eq!(bits(&decode(&encode(&state)).unwrap()), bits(&state));
        }
    }
}
