//! What is measured.

use anyhow::Result;
use serde::Serialize;
use splat::{
    image::Image,
    tracking::{DenseFlow, TrackingSettings, pair_flow},
};

use super::{
    clip::{Clip, View},
    clock,
};

/// Two frames to be timed, at any size.
pub(crate) struct Frames([Image; 2]);

impl Frames {
    /// The first two frames of a view.
    pub(crate) fn of(view: &View) -> Result<Self> {
        match view.frames.as_slice() {
            [first, second, ..] => Ok(Self([first.clone(), second.clone()])),
            _ => anyhow::bail!("a clip of at least two frames"),
        }
    }

    /// Two frames of waves of many lengths that move by some pixels.
    pub(crate) fn synthetic() -> Self {
        let render = |shift: f32| {
            let mut image = Image::filled(1280, 720, [0.0; 3]);
            for (i, pixel) in image.pixels.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                let (x, y) = ((i % 1280) as f32 - shift, (i / 1280) as f32 + 0.5 * shift);
                for (c, value) in pixel.iter_mut().enumerate() {
                    let wave =
                        |length: f32| (x / length + c as f32).sin() * (y / length - 0.3 * x / length).cos();
                    *value = 0.5 + 0.15 * (wave(31.0) + wave(9.0) + wave(4.3));
                }
            }
            image
        };
        Self([render(0.0), render(9.0)])
    }

    fn resized(&self, size: (u32, u32)) -> [Image; 2] {
        [resized(&self.0[0], size), resized(&self.0[1], size)]
    }
}

/// Bilinear, corners replicated.
pub(crate) fn resized(image: &Image, (width, height): (u32, u32)) -> Image {
    let mut out = Image::filled(width, height, [0.0; 3]);
    let along = |at: usize, to: u32, from: u32| {
        let at = ((at as f32 + 0.5) * from as f32 / to as f32 - 0.5).clamp(0.0, (from - 1) as f32);
        (at as usize, (at as usize + 1).min(from as usize - 1), at.fract())
    };
    for (i, pixel) in out.pixels.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        let (left, right, fx) = along(i % width as usize, width, image.width);
        let (upper, lower, fy) = along(i / width as usize, height, image.height);
        let row = |y: usize| {
            let (a, b) = (image.at(left, y), image.at(right, y));
            [0, 1, 2].map(|c: usize| a[c] + fx * (b[c] - a[c]))
        };
        let (above, below) = (row(upper), row(lower));
        *pixel = [0, 1, 2].map(|c: usize| above[c] + fy * (below[c] - above[c]));
    }
    out
}

/// What one preset takes and gives.
#[derive(Debug, Serialize)]
pub(crate) struct Preset {
    pub(crate) name: String,
    pub(crate) times: Vec<Time>,
    pub(crate) errors: Vec<Errors>,
}

/// Time at one size.
#[derive(Debug, Serialize)]
pub(crate) struct Time {
    pub(crate) width: u32,
    pub(crate) height: u32,
    /// Per one-way flow: half of what both ways take, pyramids included.
    pub(crate) milliseconds: f64,
}

/// End-point errors over the visible pixels of one clip, first frame to every later one, pixels.
#[derive(Debug, Serialize)]
pub(crate) struct Errors {
    pub(crate) clip: String,
    pub(crate) all: Summary,
    pub(crate) moving: Summary,
}

/// Mean and median of errors.
#[derive(Debug, Serialize)]
pub(crate) struct Summary {
    pub(crate) mean: f64,
    pub(crate) median: f64,
}

impl Summary {
    fn of(mut errors: Vec<f32>) -> Self {
        errors.sort_by(f32::total_cmp);
        let sum: f64 = errors.iter().copied().map(f64::from).sum();
        let median = errors.get(errors.len() / 2).copied().unwrap_or(f32::NAN);
        Self { mean: sum / errors.len() as f64, median: median.into() }
    }
}

pub(crate) fn preset(
    name: &str,
    settings: &TrackingSettings,
    frames: &Frames,
    sizes: &[(u32, u32)],
    repeats: usize,
    clips: &[Clip],
    enlarge: u32,
) -> Result<Preset> {
    let mut times = Vec::new();
    for &(width, height) in sizes {
        let [first, second] = frames.resized((width, height));
        let mut fastest = f64::INFINITY;
        for _ in 0..repeats {
            let start = clock::now();
            std::hint::black_box(pair_flow(&first, &second, None, settings)?);
            fastest = fastest.min((clock::now() - start).as_secs_f64());
        }
        if repeats > 0 {
            times.push(Time { width, height, milliseconds: 500.0 * fastest });
        }
    }
    let errors = clips.iter().map(|clip| errors(clip, settings, enlarge)).collect::<Result<_>>()?;
    Ok(Preset { name: name.to_owned(), times, errors })
}

fn errors(clip: &Clip, settings: &TrackingSettings, enlarge: u32) -> Result<Errors> {
    let (mut all, mut moving) = (Vec::new(), Vec::new());
    for view in &clip.views {
        let (width, height) = (view.frames[0].width, view.frames[0].height);
        let enlarged = |frame: usize| resized(&view.frames[frame], (enlarge * width, enlarge * height));
        let key = enlarged(0);
        for frame in 1..view.frames.len() {
            let flow = pair_flow(&key, &enlarged(frame), None, settings)?.forward;
            let exact = view.truth(frame)?;
            for pixel in (0..exact.positions.len()).filter(|&pixel| exact.visible[pixel]) {
                let centre = [pixel as u32 % width, pixel as u32 / width].map(|index| index as f32 + 0.5);
                let at = exact.positions[pixel];
                let found = at_pixel(&flow, pixel, enlarge as usize);
                let error = (found[0] - (at[0] - centre[0])).hypot(found[1] - (at[1] - centre[1]));
                all.push(error);
                if view.moves(pixel) {
                    moving.push(error);
                }
            }
        }
    }
    Ok(Errors { clip: clip.name.clone(), all: Summary::of(all), moving: Summary::of(moving) })
}

/// The displacement of a pixel of the clip in a flow of frames enlarged by a factor: the mean over what it became.
fn at_pixel(flow: &DenseFlow, pixel: usize, factor: usize) -> [f32; 2] {
    let width = flow.width as usize;
    let (x, y) = (pixel % (width / factor) * factor, pixel / (width / factor) * factor);
    let mut sum = [0.0; 2];
    for row in y..y + factor {
        for [u, v] in &flow.displacement[row * width + x..row * width + x + factor] {
            sum = [sum[0] + u, sum[1] + v];
        }
    }
    // A factor for the mean along each axis, and one for the unit.
    sum.map(|value| value / (factor * factor * factor) as f32)
}
