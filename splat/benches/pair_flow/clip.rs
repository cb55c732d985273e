//! Clips with exact flow from the first frame to each later one.

use std::{fs, path::Path};

use anyhow::{Context, Result, bail};
use splat::{
    formats::track_npz::{self, ImportedTracks},
    image::{Image, Mask},
    tracking::TrackField,
};

/// A clip, as far as it is measured.
pub(crate) struct Clip {
    pub(crate) name: String,
    pub(crate) views: Vec<View>,
}

/// What one camera saw.
pub(crate) struct View {
    pub(crate) frames: Vec<Image>,
    moving: Vec<bool>,
    /// From the first frame to each later one.
    exact: ImportedTracks,
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
        let exact = track_npz::open_exact_flow(&folder.join("flow").join(format!("{camera}.npz")))?;
        let bytes = |kind: &str, frame: usize| {
            let path = folder.join(kind).join(camera).join(format!("frame_{frame:04}.png"));
            fs::read(&path).with_context(|| path.display().to_string())
        };
        // Flow leads to every frame but the first.
        let read = |frame: usize| Ok(Image::decode(&bytes("images", frame)?)?);
        let frames: Vec<Image> = (1..=exact.count() + 1).map(read).collect::<Result<_>>()?;
        let mask = Mask::decode(&bytes("masks", 1)?)?;
        let sizes = frames.iter().map(|image| (image.width, image.height));
        if let Some(size) = sizes.chain([(mask.width, mask.height)]).find(|&size| size != exact.size()) {
            bail!("flow of {:?} pixels, but a frame or the mask of {size:?}", exact.size());
        }
        Ok(Self { frames, moving: mask.inside, exact })
    }

    /// The exact tracks of the first frame's pixels to a later frame.
    pub(crate) fn truth(&self, frame: usize) -> Result<TrackField> {
        let field = frame.checked_sub(1).and_then(|index| self.exact.field(index));
        field.with_context(|| format!("no exact flow to frame {}", frame + 1))
    }

    pub(crate) fn moves(&self, pixel: usize) -> bool {
        self.moving[pixel]
    }
}
