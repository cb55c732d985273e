//! Clips with exact flow from the first frame to each later one.

use std::{fs, path::Path};

use anyhow::{Context, Result};
use splat::image::{Image, Mask};

/// A clip, as far as it is measured.
pub(crate) struct Clip {
    pub(crate) name: String,
    pub(crate) views: Vec<View>,
}

/// What one camera saw.
pub(crate) struct View {
    pub(crate) frames: Vec<Image>,
    moving: Vec<bool>,
    /// In 64ths of a pixel, `frame * pixels * 2`.
    flow: Vec<i16>,
    visible: Vec<u8>,
    valid: Vec<u8>,
}

impl Clip {
    pub(crate) fn read(folder: &Path, cameras: &[String]) -> Result<Self> {
        let name = folder.file_name().context("a folder with a name")?.to_string_lossy().into_owned();
        let views = cameras.iter().map(|camera| View::read(folder, camera).with_context(|| camera.clone()));
        let views = views.collect::<Result<_>>().with_context(|| folder.display().to_string())?;
        Ok(Self { name, views })
    }
}

impl View {
    fn read(folder: &Path, camera: &str) -> Result<Self> {
        let images = folder.join("images").join(camera);
        let name = |i: usize| format!("frame_{i:04}.png");
        let count = fs::read_dir(&images)?.count();
        let read = |i: usize| Ok(Image::decode(&fs::read(images.join(name(i)))?)?);
        let frames = (1..=count).map(read).collect::<Result<_>>()?;
        let mask = Mask::decode(&fs::read(folder.join("masks").join(camera).join(name(1)))?)?;
        let flow = folder.join("flow").join(format!("{camera}.npz"));
        Ok(Self {
            frames,
            moving: mask.inside,
            flow: array(&flow, "flow_x64")?,
            visible: array(&flow, "visible")?,
            valid: array(&flow, "valid")?,
        })
    }

    /// The exact displacement of a pixel of the first frame at a later frame, if it is visible there.
    pub(crate) fn truth(&self, frame: usize, pixel: usize) -> Option<[f32; 2]> {
        let pixels = self.moving.len();
        let seen = bit(&self.visible[(frame - 1) * pixels.div_ceil(8)..], pixel) && bit(&self.valid, pixel);
        let at = 2 * ((frame - 1) * pixels + pixel);
        seen.then(|| [self.flow[at], self.flow[at + 1]].map(|value| f32::from(value) / 64.0))
    }

    pub(crate) fn moves(&self, pixel: usize) -> bool {
        self.moving[pixel]
    }
}

fn bit(bytes: &[u8], i: usize) -> bool {
    bytes[i / 8] >> (7 - i % 8) & 1 == 1
}

fn array<T: npyz::Deserialize>(path: &Path, name: &str) -> Result<Vec<T>> {
    let mut archive = npyz::npz::NpzArchive::open(path)?;
    let array = archive.by_name(name)?.with_context(|| format!("no {name} in {}", path.display()))?;
    Ok(array.into_vec()?)
}
