//! Writing a tracker's field frame by frame.

use std::{
    fs::{self, File},
    io::{self, BufWriter, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
};

use npyz::WriterBuilder;
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

use super::pixel_centre;
use crate::tracking::TrackField;

/// Writes the fields of one view as the npz that [`super::read_track_npz`] reads, in memory that does not grow with
/// the clip: `tracks` `[T, H, W, 2]` f32, `visible` `[T, H, W]` bool, `sigma` `[T, H, W]` f32.
///
/// Frame 0, the key frame, is written by the writer itself. Until [`Self::finish`] the file has another name, and is
/// removed if the writer is dropped.
pub struct TrackNpzWriter {
    path: PathBuf,
    size: (u32, u32),
    frames: usize,
    written: usize,
    tracks: Spool<f32>,
    visible: Spool<bool>,
    sigma: Spool<f32>,
}

impl TrackNpzWriter {
    /// Starts a file for `frames` frames, the key frame counted, of `width × height` pixels.
    pub fn create(path: &Path, frames: usize, width: u32, height: u32) -> io::Result<Self> {
        let per_pixel = [frames as u64, u64::from(height), u64::from(width)];
        let per_axis = [&per_pixel[..], &[2]].concat();
        let mut writer = Self {
            path: path.to_owned(),
            size: (width, height),
            frames,
            written: 0,
            tracks: Spool::create(path, "tracks", &per_axis)?,
            visible: Spool::create(path, "visible", &per_pixel)?,
            sigma: Spool::create(path, "sigma", &per_pixel)?,
        };
        let pixels = width as usize * height as usize;
        writer.push(&TrackField {
            width,
            height,
            positions: (0..pixels).map(|index| pixel_centre(index, width)).collect(),
            visible: vec![true; pixels],
            sigma: vec![super::SIGMA_FLOOR; pixels],
        })?;
        Ok(writer)
    }

    /// Appends the next frame's field.
    pub fn push(&mut self, field: &TrackField) -> io::Result<()> {
        let pixels = self.size.0 as usize * self.size.1 as usize;
        let fits = (field.width, field.height) == self.size
            && [field.positions.len(), field.visible.len(), field.sigma.len()] == [pixels; 3];
        if !fits || self.written == self.frames {
            let problem = format!(
                "frame {} of {} has {}x{} pixels, the file is for {}x{}",
                self.written + 1,
                self.frames,
                field.width,
                field.height,
                self.size.0,
                self.size.1
            );
            return Err(io::Error::new(io::ErrorKind::InvalidInput, problem));
        }
        self.tracks.extend(field.positions.iter().flatten().copied())?;
        self.visible.extend(field.visible.iter().copied())?;
        self.sigma.extend(field.sigma.iter().copied())?;
        self.written += 1;
        Ok(())
    }

    /// Completes the file; refuses if frames are missing.
    pub fn finish(self) -> io::Result<()> {
        if self.written < self.frames {
            let problem = format!("{} of {} frames are written", self.written, self.frames);
            return Err(io::Error::new(io::ErrorKind::InvalidInput, problem));
        }
        let unfinished = Temporary(beside(&self.path, "unfinished"));
        let mut zip = ZipWriter::new(BufWriter::new(File::create(&unfinished.0)?));
        self.tracks.move_into(&mut zip)?;
        self.visible.move_into(&mut zip)?;
        self.sigma.move_into(&mut zip)?;
        zip.finish()?.flush()?;
        fs::rename(&unfinished.0, &self.path)
    }
}

/// An array that grows in a file of its own, because an archive takes one array after the other.
struct Spool<T: npyz::Serialize> {
    name: &'static str,
    array: npyz::NpyWriter<T, BufWriter<File>>,
    file: File,
    _temporary: Temporary,
}

impl<T: npyz::AutoSerialize> Spool<T> {
    fn create(path: &Path, name: &'static str, shape: &[u64]) -> io::Result<Self> {
        let temporary = Temporary(beside(path, name));
        let file = File::options().read(true).write(true).create(true).truncate(true).open(&temporary.0)?;
        let buffer = BufWriter::new(file.try_clone()?);
        let array = npyz::WriteOptions::new().default_dtype().shape(shape).writer(buffer).begin_nd()?;
        Ok(Self { name, array, file, _temporary: temporary })
    }

    fn extend(&mut self, values: impl Iterator<Item = T>) -> io::Result<()> {
        self.array.extend(values)
    }

    fn move_into(mut self, zip: &mut ZipWriter<BufWriter<File>>) -> io::Result<()> {
        self.array.finish()?;
        self.file.seek(SeekFrom::Start(0))?;
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Deflated)
            .compression_level(Some(1))
            .large_file(true);
        zip.start_file(npyz::npz::file_name_from_array_name(self.name), options)?;
        io::copy(&mut self.file, zip)?;
        Ok(())
    }
}

/// A file that goes when this does.
struct Temporary(PathBuf);

impl Drop for Temporary {
    fn drop(&mut self) {
        // It may have been renamed; what cannot be removed is left beside the output, under a name that says so.
        let _ = fs::remove_file(&self.0);
    }
}

/// A name next to `path` that no track file has.
fn beside(path: &Path, what: &str) -> PathBuf {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{what}.part"));
    path.with_file_name(name)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;
    use crate::formats::track_npz::read_track_npz;

    fn field(shift: f32) -> TrackField {
        let positions = (0..6).map(|i| pixel_centre(i, 3)).map(|at| [at[0] + shift, at[1] - shift]).collect();
        TrackField {
            width: 3,
            height: 2,
            positions,
            visible: (0..6).map(|i| i % 3 != 1).collect(),
            // Far below the floor of what states none, and far above.
            sigma: (0..6).map(|i| 0.001 * 10.0_f32.powi(i)).collect(),
        }
    }

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
    }

    #[test]
    fn what_is_written_is_read_back_and_nothing_else_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cam00.npz");
        let mut writer = TrackNpzWriter::create(&path, 3, 3, 2).unwrap();
        writer.push(&field(0.25)).unwrap();
        writer.push(&field(-7.125)).unwrap();
        assert!(!path.exists());
        writer.finish().unwrap();
        assert_eq!(read_track_npz(&path).unwrap(), [field(0.25), field(-7.125)]);
        assert_eq!(names(folder.path()), ["cam00.npz"]);
    }

    #[test]
    fn missing_extra_and_misshapen_frames_are_refused_and_leave_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.npz");
        let mut writer = TrackNpzWriter::create(&path, 2, 3, 2).unwrap();
        let wide = TrackField { width: 6, height: 1, ..field(0.0) };
        assert!(writer.push(&wide).unwrap_err().to_string().contains("6x1"));
        writer.push(&field(0.0)).unwrap();
        assert_eq!(writer.push(&field(0.0)).unwrap_err().kind(), io::ErrorKind::InvalidInput);
        drop(writer);
        let short = TrackNpzWriter::create(&path, 2, 3, 2).unwrap();
        assert!(short.finish().unwrap_err().to_string().contains("1 of 2"));
        assert!(names(folder.path()).is_empty());
        assert!(TrackNpzWriter::create(&folder.path().join("no/such/a.npz"), 2, 3, 2).is_err());
    }
}
