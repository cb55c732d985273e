//! Times one scene on a number of threads.

use std::time::Instant;

use anyhow::{Context, Result};
use splat::raster::{PairCounts, pair_counts};

use super::{
    floor::{self, Machine},
    scene::{Scene, SceneSize},
    step::{STAGES, Stages, rates, session},
};

/// Steps before the first that is timed: buffers grow, and the order of the Gaussians settles.
const WARM_UP: usize = 2;

/// Times of one scene on a number of threads, milliseconds, one entry per repeat.
#[derive(Clone, Debug)]
pub(crate) struct Row {
    /// File of the scene, if it was not generated.
    pub(crate) file: Option<String>,
    pub(crate) size: SceneSize,
    pub(crate) threads: usize,
    pub(crate) counts: PairCounts,
    /// In the order of [`STAGES`].
    pub(crate) stages: [Vec<f64>; STAGES.len()],
    /// Whole steps of a session.
    pub(crate) step: Vec<f64>,
    /// Adam at the floor, one thread.
    pub(crate) adam_floor: Vec<f64>,
}

impl Row {
    /// Times `repeat` steps, each in stages and whole, turn by turn.
    pub(crate) fn measure(
        scene: &Scene,
        file: Option<&str>,
        threads: usize,
        repeat: usize,
        machine: Machine,
    ) -> Result<Self> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().context("a thread pool")?;
        let counts = pool.install(|| pair_counts(&scene.gaussians, &scene.camera));
        let (stages, step) = pool.install(|| times(scene, repeat))?;
        let parameters = scene.gaussians.len() * (11 + 3 * scene.gaussians.sh_coefficients());
        Ok(Self {
            file: file.map(str::to_owned),
            size: scene.size(),
            threads,
            counts,
            stages,
            step,
            adam_floor: floor::adam_milliseconds(machine, parameters, repeat),
        })
    }
}

type Times = ([Vec<f64>; STAGES.len()], Vec<f64>);

fn times(scene: &Scene, repeat: usize) -> Result<Times> {
    let mut apart = Stages::new(scene);
    let mut whole = session(scene)?;
    let rates = rates(scene.gaussians.sh_degree);
    let mut times: Times = Default::default();
    for number in 0..WARM_UP + repeat {
        let stages = STAGES.map(|(_, stage)| milliseconds(|| stage(&mut apart)));
        let mut outcome = Ok(());
        let step = milliseconds(|| outcome = whole.step(0, &rates));
        outcome.context("a step of the session")?;
        if number < WARM_UP {
            continue;
        }
        times.1.push(step);
        for (all, new) in times.0.iter_mut().zip(stages) {
            all.push(new);
        }
    }
    Ok(times)
}

fn milliseconds(work: impl FnOnce()) -> f64 {
    let start = Instant::now();
    work();
    start.elapsed().as_secs_f64() * 1e3
}
