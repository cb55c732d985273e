//! How long the stages take, and a refinement as a whole.

use std::{fmt, ops::ControlFlow, path::PathBuf, sync::Arc, time::Instant};

use anyhow::Result;
use glam::DVec3;
use serde::Serialize;
use splat::{
    engine::{Engine, EngineError, SessionInput, TrainingView},
    raster::pair_counts,
    refine::{RefineInput, RefineSettings, refine},
};
use splat_shaders::{GpuEngine, Probe, Stage};

use crate::{
    report::Check,
    scene::{self, Scene, SceneSize},
    tracks::rough,
};

const BLACK: [f32; 3] = [0.0; 3];

/// What a stage may take in all, seconds.
const BUDGET: f64 = 1.0;

/// Where a scene comes from.
pub(crate) enum Source {
    File(PathBuf),
    Size(SceneSize),
}

impl Source {
    fn load(self) -> Result<(Scene, Option<String>)> {
        match self {
            Self::File(path) => Ok((scene::read(&path)?, Some(path.display().to_string()))),
            Self::Size(size) => Ok((scene::generate(size), None)),
        }
    }
}

/// Figures of one scene.
#[derive(Serialize)]
pub(crate) struct Row {
    file: Option<String>,
    gaussians: usize,
    size: [u32; 2],
    sh_degree: u32,
    /// Gaussian-pixel pairs that are blended.
    pairs: u64,
    #[serde(flatten)]
    outcome: Outcome,
}

#[derive(Serialize)]
#[serde(rename_all = "snake_case")]
enum Outcome {
    Measured(Measured),
    /// The device has no room for it.
    Skipped(String),
}

#[derive(Serialize)]
struct Measured {
    /// Of footprints with tiles.
    intersections: u32,
    /// Whether by the device's own clock; else by that of the host, over many submissions.
    device_clock: bool,
    stages: Vec<StageTimes>,
    /// Mean and standard deviation per channel of what is drawn over black: other programs can show that they draw the same.
    image_mean: [f64; 3],
    image_std: [f64; 3],
}

#[derive(Serialize)]
struct StageTimes {
    stage: &'static str,
    median_ms: f64,
    min_ms: f64,
    p90_ms: f64,
    /// By the median.
    pairs_per_second: f64,
}

impl Row {
    /// Times every stage.
    pub(crate) fn measure(engine: &GpuEngine, source: Source, is_quick: bool) -> Result<Self> {
        let (scene, file) = source.load()?;
        let SceneSize { gaussians, width, height, sh_degree } = scene.size();
        let pairs = pair_counts(&scene.gaussians, &scene.camera).blended_pairs;
        let outcome = match measured(engine, scene, pairs, is_quick) {
            Ok(measured) => Outcome::Measured(measured),
            Err(error @ EngineError::OutOfResources { .. }) => Outcome::Skipped(error.to_string()),
            Err(error) => return Err(error.into()),
        };
        Ok(Self { file, gaussians, size: [width, height], sh_degree, pairs, outcome })
    }
}

fn measured(engine: &GpuEngine, scene: Scene, pairs: u64, is_quick: bool) -> Result<Measured, EngineError> {
    let image = engine.render(&scene.gaussians, &scene.camera, BLACK)?.image.pixels;
    let tracks = rough(&scene.camera, 1);
    let view = TrainingView { camera: scene.camera, image: Arc::new(scene.target), mask: None };
    let input = SessionInput {
        gaussians: scene.gaussians,
        views: vec![view],
        background: BLACK,
        dssim_weight: 0.2,
        frozen: Vec::new(),
    };
    let probe = Probe::new(engine, input, &tracks)?;
    let (mut stages, mut device_clock) = (Vec::new(), true);
    for stage in Stage::ALL {
        let (mut times, by_device) = sampled(&probe, stage, is_quick)?;
        device_clock &= by_device;
        times.sort_by(f64::total_cmp);
        let at = |share: f64| 1e3 * times[((times.len() - 1) as f64 * share).round() as usize];
        let median = at(0.5);
        stages.push(StageTimes {
            stage: stage.name(),
            median_ms: median,
            min_ms: at(0.0),
            p90_ms: at(0.9),
            pairs_per_second: pairs as f64 / (1e-3 * median),
        });
    }
    let [image_mean, image_std] = channels(&image);
    Ok(Measured { intersections: probe.intersections()?, device_clock, stages, image_mean, image_std })
}

/// Seconds of single runs, or means over several where only the host has a clock.
fn sampled(probe: &Probe, stage: Stage, is_quick: bool) -> Result<(Vec<f64>, bool), EngineError> {
    let (budget, most) = if is_quick { (0.3, 5) } else { (BUDGET, 50) };
    let start = Instant::now();
    probe.run(stage, 1)?;
    let once = start.elapsed().as_secs_f64();
    let repeats = ((budget / once) as u32).clamp(3, most);
    probe.run(stage, repeats.div_ceil(5))?;
    if let Some(times) = probe.run(stage, repeats)? {
        return Ok((times, true));
    }
    let mut means = Vec::new();
    for _ in 0..5 {
        let start = Instant::now();
        probe.run(stage, repeats)?;
        means.push(start.elapsed().as_secs_f64() / f64::from(repeats));
    }
    Ok((means, false))
}

fn channels(pixels: &[f32]) -> [[f64; 3]; 2] {
    let count = (pixels.len() / 3) as f64;
    let values = |channel: usize| pixels.iter().skip(channel).step_by(3).map(|&value| f64::from(value));
    let mean: [f64; 3] = std::array::from_fn(|channel| values(channel).sum::<f64>() / count);
    let deviation = |channel: usize| {
        (values(channel).map(|value| (value - mean[channel]).powi(2)).sum::<f64>() / count).sqrt()
    };
    [mean, std::array::from_fn(deviation)]
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { gaussians, size: [width, height], sh_degree, pairs, outcome, .. } = self;
        write!(f, "{gaussians} in {width}x{height}, SH {sh_degree}, {:.1} M pairs: ", *pairs as f64 / 1e6)?;
        match outcome {
            Outcome::Skipped(reason) => write!(f, "skipped, {reason}"),
            Outcome::Measured(Measured { stages, device_clock, .. }) => {
                for StageTimes { stage, median_ms, pairs_per_second, .. } in stages {
                    write!(f, "{stage} {median_ms:.3} ms ({:.2} G/s), ", pairs_per_second / 1e9)?;
                }
                write!(f, "by the {}'s clock", if *device_clock { "device" } else { "host" })
            }
        }
    }
}

/// One frame from four views.
#[derive(Serialize)]
pub(crate) struct Refinement {
    gaussians: usize,
    size: [u32; 2],
    views: usize,
    steps: u32,
    /// From the host's parameters and images to the host's parameters.
    seconds: f64,
    steps_per_second: f64,
    /// Means over the first and over the last epoch.
    loss: [f32; 2],
}

/// Refines a frame whose Gaussians were moved off their places by a pixel or so.
pub(crate) fn refinement(engine: &GpuEngine, is_quick: bool, max_gaussians: usize) -> Result<Refinement> {
    let (count, width, height, iterations) =
        if is_quick { (5_000, 320, 180, 24) } else { (100_000, 1280, 720, 1000) };
    let size = SceneSize { gaussians: count.min(max_gaussians), width, height, sh_degree: 3 };
    let Scene { mut gaussians, camera, .. } = scene::generate(size);
    let views: Vec<TrainingView> = (0..4)
        .map(|number| {
            let mut camera = camera.clone();
            camera.translation = DVec3::new(0.1 * f64::from(number) - 0.15, 0.0, 0.0);
            let image = Arc::new(engine.render(&gaussians, &camera, BLACK)?.image);
            Ok(TrainingView { camera, image, mask: None })
        })
        .collect::<Result<_, EngineError>>()?;
    for (index, mean) in gaussians.means.iter_mut().enumerate() {
        mean[index % 2] += 0.004;
    }
    let settings = RefineSettings { iterations, plateau_window: iterations, ..RefineSettings::default() };
    let input =
        RefineInput { gaussians, views: views.clone(), frozen: Vec::new(), background: BLACK, seed: 1 };
    let start = Instant::now();
    let refined = refine(engine, input, &settings, &mut |_, _| ControlFlow::Continue(()))?;
    let seconds = start.elapsed().as_secs_f64();
    let refined = refined.expect("nobody stopped it");
    Ok(Refinement {
        gaussians: size.gaussians,
        size: [width, height],
        views: views.len(),
        steps: refined.steps,
        seconds,
        steps_per_second: f64::from(refined.steps) / seconds,
        loss: refined.loss,
    })
}

impl Refinement {
    /// Whether anything was learned.
    pub(crate) fn check(&self) -> Check {
        Check::new("refinement", "last loss over first", f64::from(self.loss[1] / self.loss[0]), 0.9)
    }
}

impl fmt::Display for Refinement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { gaussians, size: [width, height], views, steps, seconds, steps_per_second, loss } = self;
        write!(f, "refinement of {gaussians} on {views} views of {width}x{height}: {steps} steps in ")?;
        write!(f, "{seconds:.2} s ({steps_per_second:.1} per second), loss {:.4} to {:.4}", loss[0], loss[1])
    }
}
