//! COLMAP's text files.

use std::{
    collections::BTreeMap,
    fs::File,
    io::{BufRead, BufReader},
    path::Path,
    str::{FromStr, SplitAsciiWhitespace},
};

use glam::DVec3;

use super::{super::ClipError, ModelCamera, ModelImage};
use crate::static_model::SfmPoint;

/// `CAMERA_ID MODEL WIDTH HEIGHT PARAMS...` per line.
pub(super) fn cameras(path: &Path) -> Result<BTreeMap<u32, ModelCamera>, ClipError> {
    let mut cameras = BTreeMap::new();
    let mut lines = Lines::open(path)?;
    while let Some(line) = lines.next_record()? {
        let mut fields = lines.fields(&line);
        let id = fields.next("CAMERA_ID")?;
        let camera = ModelCamera {
            model: fields.next("MODEL")?,
            width: fields.next("WIDTH")?,
            height: fields.next("HEIGHT")?,
            parameters: fields.rest("PARAMS")?,
        };
        if cameras.insert(id, camera).is_some() {
            return Err(ClipError::malformed(
                path,
                lines.place(),
                format!("camera {id} again"),
                "one line per camera",
            ));
        }
    }
    Ok(cameras)
}

/// `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`, each followed by a line of 2D points, which may be empty.
pub(super) fn images(path: &Path) -> Result<Vec<ModelImage>, ClipError> {
    let mut images = Vec::new();
    let mut lines = Lines::open(path)?;
    while let Some(line) = lines.next_record()? {
        let mut fields = lines.fields(&line);
        fields.next::<u32>("IMAGE_ID")?;
        let image = ModelImage {
            quaternion: fields.numbers(["QW", "QX", "QY", "QZ"])?,
            translation: fields.numbers(["TX", "TY", "TZ"])?,
            camera_id: fields.next("CAMERA_ID")?,
            // Names may hold spaces.
            name: fields.text("NAME")?,
        };
        images.push(image);
        lines.skip()?;
    }
    Ok(images)
}

/// `POINT3D_ID X Y Z R G B ERROR TRACK...` per line.
pub(super) fn points(path: &Path) -> Result<Vec<SfmPoint>, ClipError> {
    let mut points = Vec::new();
    let mut lines = Lines::open(path)?;
    while let Some(line) = lines.next_record()? {
        let mut fields = lines.fields(&line);
        fields.next::<u64>("POINT3D_ID")?;
        let position = DVec3::from_array(fields.numbers(["X", "Y", "Z"])?);
        if !position.is_finite() {
            return Err(ClipError::malformed(path, lines.place(), position, "a finite position"));
        }
        let colour = [fields.next::<u8>("R")?, fields.next("G")?, fields.next("B")?];
        points.push(SfmPoint { position, colour: colour.map(|value| f32::from(value) / 255.0) });
    }
    Ok(points)
}

/// Lines of a file, counted for error messages.
struct Lines<'a> {
    path: &'a Path,
    reader: BufReader<File>,
    number: usize,
}

impl<'a> Lines<'a> {
    fn open(path: &'a Path) -> Result<Self, ClipError> {
        let file = File::open(path).map_err(ClipError::io(path))?;
        Ok(Self { path, reader: BufReader::new(file), number: 0 })
    }

    fn next_line(&mut self) -> Result<Option<String>, ClipError> {
        let mut line = String::new();
        let read = self.reader.read_line(&mut line).map_err(ClipError::io(self.path))?;
        self.number += 1;
        Ok((read > 0).then_some(line))
    }

    /// The next line that is neither empty nor a comment.
    fn next_record(&mut self) -> Result<Option<String>, ClipError> {
        while let Some(line) = self.next_line()? {
            let trimmed = line.trim();
            if !trimmed.is_empty() && !trimmed.starts_with('#') {
                return Ok(Some(trimmed.to_owned()));
            }
        }
        Ok(None)
    }

    fn skip(&mut self) -> Result<(), ClipError> {
        self.next_line().map(drop)
    }

    fn place(&self) -> String {
        format!("line {}", self.number)
    }

    fn fields<'l>(&self, line: &'l str) -> Fields<'l>
    where
        'a: 'l,
    {
        Fields { path: self.path, line: self.number, words: line.split_ascii_whitespace() }
    }
}

struct Fields<'a> {
    path: &'a Path,
    line: usize,
    words: SplitAsciiWhitespace<'a>,
}

impl Fields<'_> {
    fn parse<T: FromStr>(&self, name: &str, word: &str) -> Result<T, ClipError> {
        let number = std::any::type_name::<T>();
        word.parse().map_err(|_| {
            ClipError::malformed(
                self.path,
                format!("line {}, {name}", self.line),
                format!("`{word}`"),
                format!("a {number}"),
            )
        })
    }

    fn next<T: FromStr>(&mut self, name: &str) -> Result<T, ClipError> {
        let Some(word) = self.words.next() else {
            return Err(ClipError::malformed(
                self.path,
                format!("line {}", self.line),
                "the end of the line",
                name,
            ));
        };
        self.parse(name, word)
    }

    fn numbers<const N: usize>(&mut self, names: [&str; N]) -> Result<[f64; N], ClipError> {
        let mut numbers = [0.0; N];
        for (number, name) in numbers.iter_mut().zip(names) {
            *number = self.next(name)?;
        }
        Ok(numbers)
    }

    fn text(mut self, name: &str) -> Result<String, ClipError> {
        let first: String = self.next(name)?;
        Ok(self.words.fold(first, |text, word| text + " " + word))
    }

    fn rest(mut self, name: &str) -> Result<Vec<f64>, ClipError> {
        let mut numbers = Vec::new();
        while let Some(word) = self.words.next() {
            numbers.push(self.parse(name, word)?);
        }
        Ok(numbers)
    }
}
