//! Tracks from numpy archives: the exact flow of rendered clips, and fields of any tracker.
//!
//! Exact flow of one view, `T` frames of `H × W` pixels:
//!
//! | array | content |
//! |---|---|
//! | `flow_x64` | i16 `[T-1, H, W, 2]`: displacement from the key frame, 64ths of a pixel |
//! | `visible` | u8, `numpy.packbits` of bool `[T-1, H*W]` along the last axis, or flattened |
//! | `valid` | u8, `numpy.packbits` of bool `[H*W]`: pixels whose displacement is known |
//!
//! A tracker's field of one view: `tracks` or `positions` `[T, H, W, 2]` (f32 or f64), the position `x, y` of every
//! key-frame pixel in every frame, in pixels with the centre of the top-left pixel at (0.5, 0.5); `visible` or
//! `visibility` `[T, H, W]` (bool, u8 or float, visible above 0.5); optionally `sigma` `[T, H, W]`, the standard
//! deviation per axis in pixels. Frame 0 is the key frame.
//!
//! [`open_tracks`] also takes what other trackers' programs give: see `conventions.rs`.

use std::{
    fs::File,
    io::{BufReader, Read},
    path::Path,
};

use npyz::{DType, NpyFile, Order, TypeChar};
use zip::ZipArchive;

use super::TrackError;
use crate::tracking::TrackField;

mod by_view;
mod conventions;
mod grid;
mod imported;
mod points;
#[cfg(test)]
mod tests;
mod writer;

pub use by_view::{Names, TrackFilesError, files_by_view};
pub use conventions::open_tracks;
pub use imported::ImportedTracks;
pub use points::PointTracks;
pub use writer::TrackNpzWriter;

/// Standard deviation of what claims to be exact, pixels: interpolation and sampling err by so much.
pub const SIGMA_FLOOR: f32 = 0.05;

/// Standard deviation of imported tracks that state none, pixels.
pub const DEFAULT_SIGMA: f32 = 0.5;

/// Deflate, which numpy packs with, makes nothing smaller than by this.
const DEFLATE_RATIO: u64 = 1032;

/// Longest header of an array, bytes: ten times what numpy itself reads without being told to.
const MAX_HEADER: u32 = 100_000;

/// Steps per pixel of exact flow.
const FLOW_STEPS: f32 = 64.0;

/// Reads the exact flow of one view whole: [`open_exact_flow`], every field.
pub fn read_exact_flow(path: &Path) -> Result<Vec<TrackField>, TrackError> {
    Ok(open_exact_flow(path)?.fields().collect())
}

/// Reads the exact flow of one view; index `i` is the field of frame `i + 2`, counting the key frame as 1.
///
/// Where the flow is not valid the pixel is invisible. The standard deviation is one step of the stored flow plus
/// [`SIGMA_FLOOR`].
pub fn open_exact_flow(path: &Path) -> Result<ImportedTracks, TrackError> {
    let mut archive = Archive::open(path)?;
    let flow = archive.integers(&["flow_x64"])?;
    let &[frames, height, width, 2] = &flow.shape[..] else {
        return Err(archive.shape(&flow.name, &flow.shape, "[T-1, H, W, 2]".into()));
    };
    let (width, height, pixels) = archive.size(&flow.name, &flow.shape, width, height)?;
    let row = pixels.div_ceil(8);

    let visible = archive.bytes(&["visible"])?;
    let by_frame = visible.shape == [frames, row as u64];
    let flat = visible.shape == [(frames * pixels as u64).div_ceil(8)];
    if !by_frame && !flat {
        let expected = format!("[{frames}, {row}] (packed bits of [{frames}, {pixels}])");
        return Err(archive.shape(&visible.name, &visible.shape, expected));
    }
    let valid = archive.bytes(&["valid"])?;
    if valid.shape != [row as u64] {
        let expected = format!("[{row}] (packed bits of [{pixels}])");
        return Err(archive.shape(&valid.name, &valid.shape, expected));
    }

    let first_bit = move |frame: usize| frame * if by_frame { 8 * row } else { pixels };
    let field = move |frame: usize| TrackField {
        width,
        height,
        positions: flow.values[2 * pixels * frame..2 * pixels * (frame + 1)]
            .chunks_exact(2)
            .enumerate()
            .map(|(index, flow)| {
                let centre = pixel_centre(index, width);
                [centre[0] + f32::from(flow[0]) / FLOW_STEPS, centre[1] + f32::from(flow[1]) / FLOW_STEPS]
            })
            .collect(),
        visible: (0..pixels)
            .map(|index| {
                numpy_bit(&valid.values, index) && numpy_bit(&visible.values, first_bit(frame) + index)
            })
            .collect(),
        sigma: vec![1.0 / FLOW_STEPS + SIGMA_FLOOR; pixels],
    };
    Ok(ImportedTracks::new(frames as usize, (width, height), field))
}

/// Reads which pixels of a view have exact flow, of `width × height` pixels.
pub fn read_exact_validity(path: &Path, width: u32, height: u32) -> Result<Vec<bool>, TrackError> {
    let pixels = width as usize * height as usize;
    let mut archive = Archive::open(path)?;
    let valid = archive.bytes(&["valid"])?;
    if valid.shape != [pixels.div_ceil(8) as u64] {
        let expected = format!("[{}] (packed bits of [{pixels}])", pixels.div_ceil(8));
        return Err(archive.shape(&valid.name, &valid.shape, expected));
    }
    Ok((0..pixels).map(|index| numpy_bit(&valid.values, index)).collect())
}

/// Reads a tracker's fields of one view whole; index `i` is the field of frame `i + 2`, counting the key frame as 1.
///
/// Positions that are not finite, and standard deviations that are negative or not a number, make their pixel
/// invisible, at its place in the key frame. Standard deviations are kept as they are stated, but for 0, which becomes
/// [`SIGMA_FLOOR`]; without a `sigma` array they are [`DEFAULT_SIGMA`].
pub fn read_track_npz(path: &Path) -> Result<Vec<TrackField>, TrackError> {
    let mut archive = Archive::open(path)?;
    let tracks = archive.floats(&POSITIONS)?;
    Ok(fields_of(&mut archive, tracks)?.fields().collect())
}

/// Names of the array of positions.
const POSITIONS: [&str; 2] = ["tracks", "positions"];

fn fields_of(archive: &mut Archive<'_>, tracks: Array<f32>) -> Result<ImportedTracks, TrackError> {
    let &[frames, height, width, 2] = &tracks.shape[..] else {
        return Err(archive.shape(&tracks.name, &tracks.shape, "[T, H, W, 2]".into()));
    };
    let (columns, rows, pixels) = archive.size(&tracks.name, &tracks.shape, width, height)?;
    let per_pixel = [frames, height, width];
    let expected = || format!("[{frames}, {height}, {width}], the shape of `{}`", tracks.name);

    let visible = archive.floats(&["visible", "visibility"])?;
    if visible.shape != per_pixel {
        return Err(archive.shape(&visible.name, &visible.shape, expected()));
    }
    let sigma = if archive.has("sigma") { Some(archive.floats(&["sigma"])?) } else { None };
    if let Some(sigma) = sigma.as_ref().filter(|sigma| sigma.shape != per_pixel) {
        return Err(archive.shape(&sigma.name, &sigma.shape, expected()));
    }

    let field = move |index: usize| {
        let frame = index + 1;
        let mut field = TrackField {
            width: columns,
            height: rows,
            positions: Vec::with_capacity(pixels),
            visible: Vec::with_capacity(pixels),
            sigma: Vec::with_capacity(pixels),
        };
        for index in 0..pixels {
            let entry = frame * pixels + index;
            let position = [tracks.values[2 * entry], tracks.values[2 * entry + 1]];
            let sigma = sigma.as_ref().map_or(DEFAULT_SIGMA, |sigma| sigma.values[entry]);
            let known = position.iter().all(|value| value.is_finite()) && sigma.is_finite() && sigma >= 0.0;
            field.positions.push(if known { position } else { pixel_centre(index, columns) });
            field.sigma.push(match known {
                true if sigma > 0.0 => sigma,
                true => SIGMA_FLOOR,
                false => DEFAULT_SIGMA,
            });
            field.visible.push(known && visible.values[entry] > 0.5);
        }
        field
    };
    Ok(ImportedTracks::new(later(frames), (columns, rows), field))
}

/// Frames after the key frame, of `frames` with it.
fn later(frames: u64) -> usize {
    frames.saturating_sub(1) as usize
}

fn pixel_centre(index: usize, width: u32) -> [f32; 2] {
    let width = width as usize;
    [(index % width) as f32 + 0.5, (index / width) as f32 + 0.5]
}

/// Bit `index` as `numpy.packbits` stores it: the first in the highest bit.
fn numpy_bit(bytes: &[u8], index: usize) -> bool {
    bytes[index / 8] >> (7 - index % 8) & 1 == 1
}

/// A numpy array in C order.
struct Array<T> {
    name: String,
    shape: Vec<u64>,
    values: Vec<T>,
}

/// An open npz file.
struct Archive<'a> {
    path: &'a Path,
    /// Most bytes that anything in the file can unpack to.
    unpacked: u64,
    zip: ZipArchive<BufReader<File>>,
}

impl<'a> Archive<'a> {
    fn open(path: &'a Path) -> Result<Self, TrackError> {
        let unreadable = |problem: String| TrackError::Unreadable { path: path.into(), problem };
        let file = File::open(path).map_err(|error| unreadable(error.to_string()))?;
        let bytes = file.metadata().map_err(|error| unreadable(error.to_string()))?.len();
        let zip = ZipArchive::new(BufReader::new(file)).map_err(|error| unreadable(error.to_string()))?;
        Ok(Self { path, unpacked: bytes.saturating_mul(DEFLATE_RATIO), zip })
    }

    fn has(&self, name: &str) -> bool {
        self.zip.index_for_name(&npyz::npz::file_name_from_array_name(name)).is_some()
    }

    fn shape(&self, array: &str, found: &[u64], expected: String) -> TrackError {
        TrackError::Shape { path: self.path.into(), array: array.into(), found: found.into(), expected }
    }

    /// Width, height and pixel count of a field; refuses sizes that no image has.
    fn size(
        &self,
        array: &str,
        shape: &[u64],
        width: u64,
        height: u64,
    ) -> Result<(u32, u32, usize), TrackError> {
        use super::track_blob::{MAX_PIXELS, MAX_SIDE};
        let longest = u64::from(MAX_SIDE);
        if width == 0 || height == 0 || width > longest || height > longest || width * height > MAX_PIXELS {
            let expected = format!("height and width between 1 and {MAX_SIDE}, at most {MAX_PIXELS} pixels");
            return Err(self.shape(array, shape, expected));
        }
        Ok((width as u32, height as u32, (width * height) as usize))
    }

    fn integers(&mut self, names: &[&str]) -> Result<Array<i16>, TrackError> {
        self.read(names, |kind, file| match kind {
            (TypeChar::Int, 2) => Ok(file.into_vec::<i16>()),
            _ => Err("i16"),
        })
    }

    fn bytes(&mut self, names: &[&str]) -> Result<Array<u8>, TrackError> {
        self.read(names, |kind, file| match kind {
            (TypeChar::Uint, 1) => Ok(file.into_vec::<u8>()),
            _ => Err("u8 (as numpy.packbits gives)"),
        })
    }

    /// Floats, or flags as 0 and 1.
    fn floats(&mut self, names: &[&str]) -> Result<Array<f32>, TrackError> {
        self.read(names, |kind, file| match kind {
            (TypeChar::Float, 4) => Ok(file.into_vec::<f32>()),
            (TypeChar::Float, 8) => narrowed(file.into_vec::<f64>(), |value| value as f32),
            (TypeChar::Uint, 1) => narrowed(file.into_vec::<u8>(), f32::from),
            (TypeChar::Bool, 1) => narrowed(file.into_vec::<bool>(), |value| f32::from(u8::from(value))),
            _ => Err("f32, f64, u8 or bool"),
        })
    }

    /// Reads the first of `names` that the archive has; `convert` takes what it understands and names it otherwise.
    fn read<T>(
        &mut self,
        names: &[&str],
        convert: impl FnOnce(
            (TypeChar, u64),
            NpyFile<std::io::Take<&mut dyn Read>>,
        ) -> Result<std::io::Result<Vec<T>>, &'static str>,
    ) -> Result<Array<T>, TrackError> {
        let Some(name) = names.iter().find(|name| self.has(name)) else {
            return Err(self.missing(names));
        };
        let path = self.path;
        let problem =
            |problem: String| TrackError::Array { path: path.into(), array: (*name).into(), problem };
        let mut entry = self
            .zip
            .by_name(&npyz::npz::file_name_from_array_name(name))
            .map_err(|error| problem(error.to_string()))?;
        // What the entry says about its size it may say wrongly.
        let size = entry.size().min(self.unpacked);
        let mut start = Vec::new();
        entry.by_ref().take(12).read_to_end(&mut start).map_err(|error| problem(error.to_string()))?;
        if let Some(length) = header_length(&start).filter(|&length| length > MAX_HEADER) {
            return Err(problem(format!("its header claims {length} bytes; save the file again")));
        }
        let mut whole = start.as_slice().chain(&mut entry);
        let reader: &mut dyn Read = &mut whole;
        let file = NpyFile::new(reader.take(size)).map_err(|error| problem(error.to_string()))?;
        let shape = file.shape().to_vec();
        if file.order() != Order::C && shape.len() > 1 {
            return Err(problem("it is in Fortran order; save it through numpy.ascontiguousarray".into()));
        }
        let DType::Plain(kind) = file.dtype() else {
            return Err(problem("it has named fields; save a plain array".into()));
        };
        // The stated shape must not make us reserve more than the entry can hold.
        let item = kind.size_field().max(1);
        let stated = shape.iter().try_fold(item, |product, extent| product.checked_mul(*extent));
        if stated.is_none_or(|stated| stated > size) {
            let stated = format!("its shape {shape:?} needs more than the {size} bytes that are there");
            return Err(problem(format!("{stated}; save the file again")));
        }
        match convert((kind.type_char(), kind.size_field()), file) {
            Ok(Ok(values)) => Ok(Array { name: (*name).into(), shape, values }),
            Ok(Err(error)) => Err(problem(error.to_string())),
            Err(expected) => Err(problem(format!("its type is {}, expected {expected}", kind))),
        }
    }

    fn missing(&self, names: &[&str]) -> TrackError {
        let found: Vec<&str> = self.zip.file_names_raw().filter_map(array_name).collect();
        TrackError::MissingArray {
            path: self.path.into(),
            expected: names.join("` or `"),
            found: if found.is_empty() { "no arrays".into() } else { found.join(", ") },
        }
    }
}

/// What an array of npy version 2 or 3 says about the length of its header, which its reader reserves unseen. Version 1
/// has two bytes for it.
fn header_length(start: &[u8]) -> Option<u32> {
    let &[b'\x93', b'N', b'U', b'M', b'P', b'Y', 2..=255, _, a, b, c, d] = start else { return None };
    Some(u32::from_le_bytes([a, b, c, d]))
}

fn array_name(file: &[u8]) -> Option<&str> {
    npyz::npz::array_name_from_file_name(std::str::from_utf8(file).ok()?)
}

fn narrowed<T>(
    values: std::io::Result<Vec<T>>,
    convert: impl Fn(T) -> f32,
) -> Result<std::io::Result<Vec<f32>>, &'static str> {
    Ok(values.map(|values| values.into_iter().map(convert).collect()))
}
