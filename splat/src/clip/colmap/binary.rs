//! COLMAP's binary files, little endian.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{self, BufRead, BufReader, Read},
    path::Path,
};

use glam::DVec3;

use super::{super::ClipError, ModelCamera, ModelImage};
use crate::static_model::SfmPoint;

/// Model name and number of parameters by model id, as in COLMAP's `sensor/models.h`.
const MODELS: [(&str, usize); 11] = [
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
];

/// Bytes of one 2D point of an image: x, y, point id.
const POINT_2D_BYTES: u64 = 24;
/// Bytes of one element of a point's track: image id, 2D point index.
const TRACK_ELEMENT_BYTES: u64 = 8;
/// Longest image name that is plausible; guards against reading a damaged file as one name.
const MAX_NAME_BYTES: u64 = 4096;

/// `cameras.bin`.
pub(super) fn cameras(path: &Path) -> Result<BTreeMap<u32, ModelCamera>, ClipError> {
    let mut input = Input::open(path)?;
    let mut cameras = BTreeMap::new();
    for _ in 0..input.u64()? {
        let id = input.u32()?;
        let model = input.u32()?;
        let Some(&(name, parameter_count)) = MODELS.get(model as usize) else {
            // The record's length is unknown too, so nothing after it can be read.
            let (camera, model) = (id.to_string(), format!("with the id {model}"));
            return Err(ClipError::UnsupportedLens { path: path.to_owned(), camera, model });
        };
        let (width, height) = (input.u64()?, input.u64()?);
        let parameters = (0..parameter_count).map(|_| input.f64()).collect::<Result<_, _>>()?;
        let camera = ModelCamera { model: name.to_owned(), width, height, parameters };
        if cameras.insert(id, camera).is_some() {
            return Err(ClipError::malformed(
                path,
                "camera id",
                format!("{id} again"),
                "one record per camera",
            ));
        }
    }
    Ok(cameras)
}

/// `images.bin`.
pub(super) fn images(path: &Path) -> Result<Vec<ModelImage>, ClipError> {
    let mut input = Input::open(path)?;
    let mut images = Vec::new();
    for _ in 0..input.u64()? {
        input.u32()?;
        let image = ModelImage {
            quaternion: input.numbers()?,
            translation: input.numbers()?,
            camera_id: input.u32()?,
            name: input.name()?,
        };
        images.push(image);
        let points = input.u64()?;
        input.skip(points.saturating_mul(POINT_2D_BYTES))?;
    }
    Ok(images)
}

/// `points3D.bin`.
pub(super) fn points(path: &Path) -> Result<Vec<SfmPoint>, ClipError> {
    let mut input = Input::open(path)?;
    let mut points = Vec::new();
    for _ in 0..input.u64()? {
        let id = input.u64()?;
        let position = DVec3::from_array(input.numbers()?);
        if !position.is_finite() {
            return Err(ClipError::malformed(path, format!("point {id}"), position, "a finite position"));
        }
        let colour: [u8; 3] = input.bytes()?;
        let _reprojection_error = input.f64()?;
        let track = input.u64()?;
        input.skip(track.saturating_mul(TRACK_ELEMENT_BYTES))?;
        points.push(SfmPoint { position, colour: colour.map(|value| f32::from(value) / 255.0) });
    }
    Ok(points)
}

/// A file that is read value by value; its end in the middle of one is an error that names the file.
struct Input<'a> {
    path: &'a Path,
    reader: BufReader<File>,
}

impl<'a> Input<'a> {
    fn open(path: &'a Path) -> Result<Self, ClipError> {
        let file = File::open(path).map_err(ClipError::io(path))?;
        Ok(Self { path, reader: BufReader::new(file) })
    }

    fn cut_short(&self) -> ClipError {
        ClipError::malformed(self.path, "last record", "the end of the file", "the whole record")
    }

    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], ClipError> {
        let mut bytes = [0; N];
        match self.reader.read_exact(&mut bytes) {
            Ok(()) => Ok(bytes),
            Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => Err(self.cut_short()),
            Err(error) => Err(ClipError::io(self.path)(error)),
        }
    }

    fn u32(&mut self) -> Result<u32, ClipError> {
        self.bytes().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, ClipError> {
        self.bytes().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, ClipError> {
        self.bytes().map(f64::from_le_bytes)
    }

    fn numbers<const N: usize>(&mut self) -> Result<[f64; N], ClipError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.f64()?;
        }
        Ok(numbers)
    }

    /// A zero-terminated name.
    fn name(&mut self) -> Result<String, ClipError> {
        let mut bytes = Vec::new();
        let mut limited = (&mut self.reader).take(MAX_NAME_BYTES);
        limited.read_until(0, &mut bytes).map_err(ClipError::io(self.path))?;
        if bytes.pop() != Some(0) {
            return Err(self.cut_short());
        }
        String::from_utf8(bytes).map_err(|error| {
            let found = String::from_utf8_lossy(error.as_bytes()).into_owned();
            ClipError::malformed(self.path, "image name", found, "UTF-8")
        })
    }

    fn skip(&mut self, length: u64) -> Result<(), ClipError> {
        let mut skipped = (&mut self.reader).take(length);
        let copied = io::copy(&mut skipped, &mut io::sink()).map_err(ClipError::io(self.path))?;
        if copied < length { Err(self.cut_short()) } else { Ok(()) }
    }
}
