//! Measures the tracker on clips with exact flow: `track_clip CLIP_FOLDER CAMERA...
//! [--quality draft|balanced|best] [--set KEY=JSON]... [--maps FOLDER]`.
#![allow(clippy::print_stdout, reason = "an example prints its figures")]

use std::{
    error::Error,
    fs,
    path::{Path, PathBuf},
    sync::Arc,
    time::Instant,
};

use splat::{
    image::{Image, Mask},
    settings::Quality,
    tracking::{TrackField, TrackingSettings, track_view},
};

type Anything = Box<dyn Error>;

/// Exact flow from frame 1 to each later frame.
struct ExactFlow {
    flow: Vec<i16>,
    visible: Vec<u8>,
    valid: Vec<u8>,
}

fn packed_bit(bytes: &[u8], i: usize) -> bool {
    bytes[i / 8] >> (7 - i % 8) & 1 == 1
}

impl ExactFlow {
    fn read(path: &Path) -> Result<Self, Anything> {
        fn array<T: npyz::Deserialize>(path: &Path, name: &str) -> Result<Vec<T>, Anything> {
            let mut archive = npyz::npz::NpzArchive::open(path)?;
            let array = archive.by_name(name)?.ok_or_else(|| format!("no {name} in {}", path.display()))?;
            Ok(array.into_vec()?)
        }
        Ok(Self {
            flow: array(path, "flow_x64")?,
            visible: array(path, "visible")?,
            valid: array(path, "valid")?,
        })
    }
}

/// Errors of one group of pixels.
#[derive(Default)]
struct Figures {
    errors: Vec<f32>,
    false_visible: usize,
    missed: usize,
    right_visible: usize,
    within: [usize; 2],
    axes: usize,
    weight: f64,
    gross_weight: f64,
}

impl Figures {
    /// Counts a pixel; `truth` is its exact position, or none where it is not visible.
    fn add(&mut self, at: [f32; 2], called_visible: bool, sigma: f32, exact: [f32; 2], visible: bool) {
        let off = [(at[0] - exact[0]).abs(), (at[1] - exact[1]).abs()];
        let error = off[0].hypot(off[1]);
        if called_visible {
            let weight = 1.0 / f64::from(sigma * sigma);
            self.weight += weight;
            if error > 2.0 {
                self.gross_weight += weight;
            }
        }
        match (called_visible, visible) {
            (true, true) => {
                self.right_visible += 1;
                self.errors.push(error);
                self.axes += 2;
                self.within[0] += off.iter().filter(|&&off| off <= sigma).count();
                self.within[1] += off.iter().filter(|&&off| off <= 2.0 * sigma).count();
            }
            (true, false) => self.false_visible += 1,
            (false, true) => self.missed += 1,
            (false, false) => {}
        }
    }

    fn print(&mut self, name: &str) {
        self.errors.sort_by(f32::total_cmp);
        let at = |fraction: f64| {
            let i = (self.errors.len() as f64 * fraction) as usize;
            self.errors.get(i).copied().unwrap_or(f32::NAN)
        };
        let mean = self.errors.iter().map(|&e| f64::from(e)).sum::<f64>() / self.errors.len().max(1) as f64;
        let gross = self.errors.iter().filter(|&&e| e > 2.0).count() as f64 / self.errors.len().max(1) as f64;
        let percent = |a: usize, b: usize| 100.0 * a as f64 / b.max(1) as f64;
        println!(
            "{name:>10}: EPE mean {mean:7.3} median {:6.3} p90 {:7.3} >2px {:5.2}% | visible precision {:5.1}% recall {:5.1}% | 1s {:4.1}% 2s {:4.1}% | gross weight {:5.2}%",
            at(0.5),
            at(0.9),
            100.0 * gross,
            percent(self.right_visible, self.right_visible + self.false_visible),
            percent(self.right_visible, self.right_visible + self.missed),
            percent(self.within[0], self.axes),
            percent(self.within[1], self.axes),
            100.0 * self.gross_weight / self.weight.max(1e-12),
        );
    }
}

/// Grey: error of pixels rightly called visible, white at 4 px. Red: called visible but hidden. Blue: visible but
/// called hidden, brighter with the error of the guess. Black: rightly called hidden.
fn map_colour(error: f32, called_visible: bool, visible: bool) -> [f32; 3] {
    let level = (error / 4.0).min(1.0);
    match (called_visible, visible) {
        (true, true) => [level; 3],
        (true, false) => [1.0, 0.0, 0.0],
        (false, true) => [0.0, 0.3 * level, 0.5 + 0.5 * level],
        (false, false) => [0.0; 3],
    }
}

fn main() -> Result<(), Anything> {
    let mut quality = Quality::Balanced;
    let mut overrides = serde_json::Map::new();
    let mut words = Vec::new();
    let mut maps: Option<PathBuf> = None;
    let mut arguments = std::env::args().skip(1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--quality" => {
                quality = serde_json::from_value(arguments.next().ok_or("--quality WHICH")?.into())?
            }
            "--maps" => maps = Some(PathBuf::from(arguments.next().ok_or("--maps FOLDER")?)),
            "--set" => {
                let pair = arguments.next().ok_or("--set KEY=VALUE")?;
                let (key, value) = pair.split_once('=').ok_or("--set KEY=VALUE")?;
                overrides.insert(key.to_owned(), serde_json::from_str(value)?);
            }
            _ => words.push(argument),
        }
    }
    let clip = PathBuf::from(words.first().ok_or("usage: track_clip CLIP CAMERA...")?);
    let mut settings = serde_json::to_value(TrackingSettings::preset(quality))?;
    for (key, value) in overrides {
        settings[key] = value;
    }
    let settings: TrackingSettings = serde_json::from_value(settings)?;
    let mut all = Figures::default();
    let mut moving = Figures::default();
    let mut still = Figures::default();
    let mut seconds = 0.0;
    for camera in &words[1..] {
        let frames = fs::read_dir(clip.join("images").join(camera))?.count();
        let name = |i: usize| format!("frame_{:04}.png", i + 1);
        let images = (0..frames)
            .map(|i| Ok(Arc::new(Image::decode(&fs::read(clip.join("images").join(camera).join(name(i)))?)?)))
            .collect::<Result<Vec<_>, Anything>>()?;
        let mask = clip.join("masks").join(camera).join(name(0));
        let moves = fs::read(mask).ok().map(|bytes| Mask::decode(&bytes)).transpose()?;
        let exact = ExactFlow::read(&clip.join("flow").join(format!("{camera}.npz"))).ok();

        let mut fields: Vec<TrackField> = Vec::new();
        let start = Instant::now();
        track_view::<Anything>(frames, &mut |i| Ok(images[i].clone()), &settings, &mut |_, field| {
            fields.push(field);
            Ok(())
        })?;
        seconds += start.elapsed().as_secs_f64();

        for (t, field) in fields.iter().enumerate() {
            let pixels = field.positions.len();
            let mut frame_moving = Figures::default();
            let mut map = Image::filled(field.width, field.height, [0.0; 3]);
            for i in 0..pixels {
                if exact.as_ref().is_some_and(|exact| !packed_bit(&exact.valid, i)) {
                    continue;
                }
                let (column, row) = (i % field.width as usize, i / field.width as usize);
                let flow = |axis: usize| {
                    exact
                        .as_ref()
                        .map_or(0.0, |exact| f32::from(exact.flow[2 * (t * pixels + i) + axis]) / 64.0)
                };
                let truth = [column as f32 + 0.5 + flow(0), row as f32 + 0.5 + flow(1)];
                let bytes = pixels.div_ceil(8);
                let seen = exact.as_ref().is_none_or(|exact| packed_bit(&exact.visible[t * bytes..], i));
                let off = (field.positions[i][0] - truth[0]).hypot(field.positions[i][1] - truth[1]);
                map.pixels[3 * i..3 * i + 3].copy_from_slice(&map_colour(off, field.visible[i], seen));
                let is_mover = moves.as_ref().is_some_and(|mask| mask.inside[i]);
                let groups = if is_mover { [&mut all, &mut moving] } else { [&mut all, &mut still] };
                for group in groups {
                    group.add(field.positions[i], field.visible[i], field.sigma[i], truth, seen);
                }
                if is_mover {
                    frame_moving.add(field.positions[i], field.visible[i], field.sigma[i], truth, seen);
                }
            }
            if let Some(folder) = &maps {
                fs::create_dir_all(folder)?;
                fs::write(folder.join(format!("{camera}_{}", name(t + 1))), map.encode_png())?;
            }
            frame_moving.print(&format!("{camera} {}", t + 2));
        }
    }
    all.print("all");
    still.print("still");
    moving.print("moving");
    println!("{:.2} s per view", seconds / (words.len() - 1) as f64);
    Ok(())
}
