//! Pictures of tracks, for people: flow as a colour wheel, tracks over the frame, uncertainty and error.

mod colours;
mod trails;

use std::path::{Path, PathBuf};

use splat::{clip::file_stem, image::Image, tracking::TrackField};

pub(crate) use trails::Trails;

use crate::error::CliError;

/// Standard deviations at the ends of the heat map, pixels; between them it is logarithmic.
const HEAT_RANGE: [f32; 2] = [0.008, 16.0];
/// Error that is white, pixels.
const WHITE_ERROR: f32 = 4.0;

/// The PNG files of one view, one per kind and frame: `<folder>/<view>/<kind>_0002.png`.
pub(crate) struct PictureFolder {
    folder: PathBuf,
}

impl PictureFolder {
    /// Makes the folder of a view.
    pub(crate) fn create(pictures: &Path, view: &str) -> Result<Self, CliError> {
        let folder = pictures.join(file_stem(view));
        std::fs::create_dir_all(&folder).map_err(|error| {
            CliError::bad_input(
                folder.display(),
                format!("{error}; --pictures names a folder that can be made"),
            )
        })?;
        Ok(Self { folder })
    }

    /// Writes one picture.
    pub(crate) fn write(&self, kind: &str, frame: u32, picture: &Image) -> Result<(), CliError> {
        let path = self.folder.join(format!("{kind}_{frame:04}.png"));
        std::fs::write(&path, picture.encode_png()).map_err(|error| {
            CliError::failed(path.display(), format!("{error}; run again with room to write"))
        })
    }
}

/// Displacements in Middlebury's colours: hue is direction, saturation is length, up to the length that all but one
/// in a hundred visible tracks stay below. Hidden pixels are black.
pub(crate) fn flow(field: &TrackField) -> Image {
    let moves: Vec<[f32; 2]> = (0..field.positions.len()).map(|i| displacement(field, i)).collect();
    let mut lengths: Vec<f32> = moves
        .iter()
        .zip(&field.visible)
        .filter(|(_, visible)| **visible)
        .map(|([u, v], _)| u.hypot(*v))
        .collect();
    lengths.sort_by(f32::total_cmp);
    // Less than a pixel would draw noise in full colours.
    let longest = lengths.get(lengths.len() * 99 / 100).copied().unwrap_or(0.0).max(1.0);
    drawn(field, |i| {
        if field.visible[i] { colours::wheel(moves[i].map(|value| value / longest)) } else { [0.0; 3] }
    })
}

/// Standard deviations from dark (0.008 px) to bright (16 px) on a logarithmic scale. Hidden pixels are half as bright.
pub(crate) fn uncertainty(field: &TrackField) -> Image {
    let [low, high] = HEAT_RANGE.map(f32::ln);
    drawn(field, |i| {
        let level = (field.sigma[i].max(f32::MIN_POSITIVE).ln() - low) / (high - low);
        let brightness = if field.visible[i] { 1.0 } else { 0.5 };
        colours::heat(level).map(|value| value * brightness)
    })
}

/// Errors against exact tracks. Grey: rightly called visible, white at 4 px of error. Red: called visible, but hidden.
/// Blue: visible, but called hidden, brighter with the error of the guess. Black: rightly called hidden.
pub(crate) fn error(field: &TrackField, exact: &TrackField) -> Image {
    drawn(field, |i| {
        let (at, truth) = (field.positions[i], exact.positions[i]);
        let level = ((at[0] - truth[0]).hypot(at[1] - truth[1]) / WHITE_ERROR).min(1.0);
        match (field.visible[i], exact.visible[i]) {
            (true, true) => [level; 3],
            (true, false) => [1.0, 0.0, 0.0],
            (false, true) => [0.0, 0.3 * level, 0.5 + 0.5 * level],
            (false, false) => [0.0; 3],
        }
    })
}

/// How far key-frame pixel `i` has moved.
fn displacement(field: &TrackField, i: usize) -> [f32; 2] {
    let width = field.width as usize;
    let [x, y] = field.positions[i];
    [x - ((i % width) as f32 + 0.5), y - ((i / width) as f32 + 0.5)]
}

fn drawn(field: &TrackField, colour: impl Fn(usize) -> [f32; 3]) -> Image {
    let pixels = (0..field.positions.len()).flat_map(colour).collect();
    Image { width: field.width, height: field.height, pixels }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    fn field(shifts: &[[f32; 2]], visible: bool, sigma: f32) -> TrackField {
        let place = |(i, shift): (usize, &[f32; 2])| [i as f32 + 0.5 + shift[0], 0.5 + shift[1]];
        TrackField {
            width: shifts.len() as u32,
            height: 1,
            positions: shifts.iter().enumerate().map(place).collect(),
            visible: vec![visible; shifts.len()],
            sigma: vec![sigma; shifts.len()],
        }
    }

    #[test]
    fn rest_is_white_and_hidden_is_black() {
        assert_eq!(flow(&field(&[[0.0; 2]; 3], true, 1.0)).pixels, [1.0; 9]);
        assert_eq!(flow(&field(&[[5.0, 1.0]; 3], false, 1.0)).pixels, [0.0; 9]);
    }

    #[test]
    fn broken_fields_give_finite_pictures() {
        let broken = field(&[[f32::NAN, 1.0], [f32::INFINITY, 0.0], [1e30, -1e30]], true, f32::NAN);
        for picture in [flow(&broken), uncertainty(&broken), error(&broken, &broken)] {
            // What the encoder makes of it is what counts.
            assert_eq!(picture.to_rgb8().len(), 9);
        }
        let nothing = field(&[], true, 1.0);
        assert_eq!(flow(&nothing).pixels.len() + uncertainty(&nothing).pixels.len(), 0);
    }

    #[test]
    fn uncertainty_grows_brighter_and_hidden_pixels_are_darker() {
        let sum = |visible: bool, sigma: f32| {
            uncertainty(&field(&[[0.0; 2]], visible, sigma)).pixels.iter().sum::<f32>()
        };
        assert!(
            sum(true, 0.01) < sum(true, 0.02)
                && sum(true, 0.02) < sum(true, 0.5)
                && sum(true, 0.5) < sum(true, 16.0)
        );
        assert_eq!(sum(true, 16.0), sum(true, 1e6));
        assert_eq!(2.0 * sum(false, 1.0), sum(true, 1.0));
    }

    #[test]
    fn errors_have_their_colours() {
        let exact = field(&[[0.0; 2], [0.0; 2]], true, 1.0);
        let mut hidden = exact.clone();
        hidden.visible = vec![false; 2];
        let tracks = field(&[[2.0, 0.0], [0.0, 9.0]], true, 1.0);
        assert_eq!(error(&tracks, &exact).pixels, [0.5, 0.5, 0.5, 1.0, 1.0, 1.0]);
        assert_eq!(error(&tracks, &hidden).pixels, [1.0, 0.0, 0.0, 1.0, 0.0, 0.0]);
        assert_eq!(error(&hidden, &exact).pixels[2], 0.5);
        assert_eq!(error(&hidden, &hidden).pixels, [0.0; 6]);
    }

    #[test]
    fn files_are_named_by_kind_and_frame() {
        let folder = tempfile::tempdir().unwrap();
        let pictures = PictureFolder::create(folder.path(), "cam00").unwrap();
        pictures.write("flow", 7, &Image::filled(4, 3, [0.5; 3])).unwrap();
        let bytes = std::fs::read(folder.path().join("cam00/flow_0007.png")).unwrap();
        assert_eq!(Image::decode(&bytes).unwrap().width, 4);
        std::fs::write(folder.path().join("file"), b"").unwrap();
        let error = PictureFolder::create(&folder.path().join("file"), "cam00").err().unwrap();
        assert_eq!(error.exit_code(), 3);
    }
}
