//! The contact sheet: a held-out view beside its reconstruction, for a few frames.

use std::collections::BTreeSet;

use splat::{formats::ply, image::Image};

use super::{AssembledFrame, AssembledView, AssemblyError, AssemblyInput, font, frame_path};
use crate::queue::task::TaskState;

/// Rows of the sheet.
const MAX_FRAMES: usize = 5;
/// Wider images are halved until they fit.
const MAX_TILE_WIDTH: u32 = 640;
/// What differences are multiplied by, to be seen.
const DIFFERENCE_GAIN: f32 = 4.0;
const MARGIN: u32 = 6;
const PAPER: [f32; 3] = [0.1; 3];
const INK: [f32; 3] = [0.92; 3];

/// A row per chosen frame: truth, reconstruction, difference × 4. `None` without a held-out view or a finished frame.
pub(super) fn draw(input: &AssemblyInput<'_>) -> Result<Option<Image>, AssemblyError> {
    let Some(view) = input.views.iter().find(|view| view.held_out) else { return Ok(None) };
    let done: Vec<&AssembledFrame> =
        input.frames.iter().filter(|frame| frame.state == TaskState::Done).collect();
    let mut rows = Vec::new();
    for index in spread(done.len(), MAX_FRAMES) {
        let frame = done[index];
        let Some(truth) = (input.test_image)(&view.name, frame.number) else { continue };
        let reconstruction = render(input, view, frame.number)?;
        rows.push(row(view, frame, &truth, &reconstruction));
    }
    Ok((!rows.is_empty()).then(|| stack(&rows)))
}

/// At most `count` of `0..len`, evenly spread, the first and the last among them.
fn spread(len: usize, count: usize) -> BTreeSet<usize> {
    // One frame stands at the start, whatever it is divided by.
    let steps = count.min(len).saturating_sub(1).max(1);
    let place = |step: usize| (step * (len - 1) + steps / 2) / steps;
    (0..count.min(len)).map(place).collect()
}

fn render(input: &AssemblyInput<'_>, view: &AssembledView, frame: u32) -> Result<Image, AssemblyError> {
    let path = input.output.join(frame_path(frame));
    let bytes = std::fs::read(&path).map_err(|source| AssemblyError::Io { path, source })?;
    let failed = |reason| AssemblyError::Frame { frame, reason };
    let gaussians = ply::parse_ply(&bytes).map_err(|error| failed(error.to_string()))?;
    let rendering = input.engine.render(&gaussians, &view.camera, input.settings.background);
    Ok(rendering.map_err(|error| failed(error.to_string()))?.image)
}

fn row(view: &AssembledView, frame: &AssembledFrame, truth: &Image, reconstruction: &Image) -> Image {
    let psnr =
        frame.report.as_ref().and_then(|report| report.after.iter().find(|after| after.view == view.name));
    let quality = psnr.map(|metrics| format!(" {:.1} dB", metrics.psnr)).unwrap_or_default();
    let tiles = [
        (format!("frame {}  {}", frame.number, view.name), truth.clone()),
        (format!("reconstruction{quality}"), reconstruction.clone()),
        (format!("difference x {DIFFERENCE_GAIN}"), difference(truth, reconstruction)),
    ];
    let tiles = tiles.map(|(caption, image)| captioned(&caption, &shrunk(image)));
    let width = tiles.iter().map(|tile| tile.width + MARGIN).sum::<u32>() + MARGIN;
    let mut row = Image::filled(width, tiles[0].height, PAPER);
    let mut left = MARGIN;
    for tile in &tiles {
        paste(&mut row, tile, left, 0);
        left += tile.width + MARGIN;
    }
    row
}

fn difference(truth: &Image, reconstruction: &Image) -> Image {
    let pairs = truth.pixels.iter().zip(&reconstruction.pixels);
    // Clamped first: the difference of what is shown, not of what lies beyond white.
    let pixels = pairs.map(|(t, r)| DIFFERENCE_GAIN * (t - r.clamp(0.0, 1.0)).abs()).collect();
    Image { width: truth.width, height: truth.height, pixels }
}

/// The image, each 2 × 2 block averaged until it fits a tile.
fn shrunk(mut image: Image) -> Image {
    while image.width > MAX_TILE_WIDTH {
        let (width, height) = (image.width / 2, (image.height / 2).max(1));
        let mut half = Image::filled(width, height, [0.0; 3]);
        for y in 0..height as usize {
            for x in 0..width as usize {
                let below = (2 * y + 1).min(image.height as usize - 1);
                let block = [(2 * x, 2 * y), (2 * x + 1, 2 * y), (2 * x, below), (2 * x + 1, below)];
                let first = (y * width as usize + x) * 3;
                for channel in 0..3 {
                    let sum: f32 = block.iter().map(|&(x, y)| image.at(x, y)[channel]).sum();
                    half.pixels[first + channel] = sum / 4.0;
                }
            }
        }
        image = half;
    }
    image
}

/// The image under a line of text.
fn captioned(caption: &str, image: &Image) -> Image {
    let scale = if image.width >= 300 { 2 } else { 1 };
    let line = (font::GLYPH_HEIGHT * scale) as u32 + 2 * MARGIN;
    let mut tile = Image::filled(image.width, image.height + line, PAPER);
    paste(&mut tile, image, 0, line);
    for (x, y) in font::covered(caption, scale, image.width as usize) {
        let first = ((y + MARGIN as usize) * image.width as usize + x) * 3;
        tile.pixels[first..first + 3].copy_from_slice(&INK);
    }
    tile
}

fn stack(rows: &[Image]) -> Image {
    let width = rows.iter().map(|row| row.width).max().unwrap_or(0);
    let height = rows.iter().map(|row| row.height).sum::<u32>() + MARGIN;
    let mut sheet = Image::filled(width, height, PAPER);
    let mut top = 0;
    for row in rows {
        paste(&mut sheet, row, 0, top);
        top += row.height;
    }
    sheet
}

/// Copies an image into another one that has room for it.
fn paste(target: &mut Image, source: &Image, left: u32, top: u32) {
    let stride = source.width as usize * 3;
    for (y, line) in source.pixels.chunks_exact(stride.max(1)).enumerate() {
        let first = ((top as usize + y) * target.width as usize + left as usize) * 3;
        target.pixels[first..first + stride].copy_from_slice(line);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_spread_from_the_first_to_the_last() {
        let of = |len| spread(len, 5).into_iter().collect::<Vec<_>>();
        assert_eq!(of(0), [0_usize; 0]);
        assert_eq!(of(1), [0]);
        assert_eq!(of(3), [0, 1, 2]);
        assert_eq!(of(5), [0, 1, 2, 3, 4]);
        assert_eq!(of(10), [0, 2, 5, 7, 9]);
        assert_eq!(of(1000).len(), 5);
        assert_eq!(of(1000).last(), Some(&999));
    }

    #[test]
    fn a_wide_image_is_averaged_until_it_fits() {
        let mut wide = Image::filled(1301, 3, [0.0; 3]);
        wide.pixels.iter_mut().enumerate().for_each(|(i, value)| *value = ((i / 3) % 2) as f32);
        let small = shrunk(wide);
        assert_eq!((small.width, small.height), (325, 1));
        assert!(small.pixels.iter().all(|value| (value - 0.5).abs() < 1e-6));
    }

    #[test]
    fn an_equal_image_has_a_black_difference() {
        let grey = Image::filled(2, 2, [0.25; 3]);
        let white = Image::filled(2, 2, [1.0; 3]);
        let beyond = Image::filled(2, 2, [1.7; 3]);
        assert!(difference(&grey, &grey).pixels.iter().all(|value| *value == 0.0));
        assert!(difference(&white, &beyond).pixels.iter().all(|value| *value == 0.0));
        assert!((difference(&white, &grey).pixels[0] - 3.0).abs() < 1e-6);
    }
}
