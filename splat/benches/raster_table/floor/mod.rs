//! The floor under a step: what a pair of pixel and footprint costs when every lane is of use, all data is in the L1
//! cache, and nothing is left but its arithmetic; and what Adam costs when nothing is left but its memory traffic.
//!
//! The microkernels do to a group of pixels what those of `splat::raster` do, without spans, early outs and bookkeeping.
//! They share no code with them: a ruler must not shrink with what it measures.

mod kernels;
mod vectors;

use std::{hint::black_box, time::Instant};

pub(crate) use kernels::Machine;
use kernels::{Patch, Splat, adam, backward, forward};

/// Footprints blended over the patch before it starts anew.
const SPLATS: usize = 64;
/// Pixels of the patch: six planes of them are 12 KiB.
const PIXELS: usize = 512;
/// Floats from plane to plane: not a power of two, so that equal places of two planes do not compete for one cache set.
const PLANE: usize = PIXELS + 48;
/// Pixels per row of the patch.
const ROW: usize = 128;
/// Shortest run that is timed, seconds.
const SHORTEST_RUN: f64 = 0.005;

/// Nanoseconds per pair on one core, one entry per timed run.
#[derive(Clone, Debug, Default)]
pub(crate) struct Floor {
    /// Blending.
    pub(crate) forward: Vec<f64>,
    /// Replay and the nine gradient sums.
    pub(crate) backward: Vec<f64>,
}

impl Floor {
    /// Times `runs` more runs of both kernels.
    pub(crate) fn measure(&mut self, machine: Machine, runs: usize) {
        let splats = splats();
        let mut blended = Patch::open();
        let mut blend = || {
            blended = Patch::open();
            forward(machine, black_box(&splats), black_box(&mut blended));
        };
        self.forward.extend(per_pair(&mut blend, runs));
        let mut sums = [[0.0; 9]; SPLATS];
        let mut replay = || {
            let mut patch = blended.clone();
            backward(machine, black_box(&splats), black_box(&mut patch), black_box(&mut sums));
        };
        self.backward.extend(per_pair(&mut replay, runs));
    }
}

/// Checks the kernels of an instruction set: no lane may be idle, and the replay must end where the blending began.
///
/// # Panics
/// If a kernel does not do what it is timed for.
#[allow(dead_code, reason = "for the tests")]
pub(crate) fn check(machine: Machine) {
    let splats = splats();
    let mut patch = Patch::open();
    forward(machine, &splats, &mut patch);
    assert!(patch.last[..PIXELS].iter().all(|&last| last == SPLATS as f32), "a pixel missed the last splat");
    // With 64 splats of alpha 0.02 to 0.05, each as an f64 sum of the definition.
    for (pixel, &transmittance) in patch.transmittance[..PIXELS].iter().enumerate() {
        let expected: f64 = splats.iter().map(|splat| 1.0 - splat.alpha(pixel)).product();
        let error = (f64::from(transmittance) / expected - 1.0).abs();
        assert!(error < 1e-4, "{}: transmittance of pixel {pixel} is {transmittance}", machine.name());
    }
    let mut sums = [[0.0; 9]; SPLATS];
    backward(machine, &splats, &mut patch, &mut sums);
    // Each of 64 divisions undoes a product to 1e-7, and the reciprocal is an estimate with one Newton step.
    assert!(patch.transmittance[..PIXELS].iter().all(|&before| (before - 1.0).abs() < 1e-4), "not undone");
    assert!(sums.iter().flatten().all(|sum| sum.is_finite() && *sum != 0.0), "a sum was not taken");
}

/// Milliseconds of each of `runs` Adam steps over `parameters` numbers on one core: seven streams through memory.
pub(crate) fn adam_milliseconds(machine: Machine, parameters: usize, runs: usize) -> Vec<f64> {
    let mut values = vec![1.0; parameters];
    let gradient = vec![0.5; parameters];
    let (mut first, mut second) = (vec![0.1; parameters], vec![0.1; parameters]);
    let mut step = || adam(machine, black_box(&mut values), black_box(&gradient), &mut first, &mut second);
    step();
    (0..runs).map(|_| seconds(&mut step, 1) * 1e3).collect()
}

/// Faint and wide, so that no lane of any of them is idle and every pixel is still open after the last.
fn splats() -> Vec<Splat> {
    (0..SPLATS)
        .map(|number| {
            let share = number as f32 / SPLATS as f32;
            Splat {
                peak: -4.5 - share,
                curvature: 1e-4 * (1.0 + share),
                offset: -60.0 + 7.0 * share,
                colour: [share, 0.5, 1.0 - share],
                mark: (number + 1) as f32,
            }
        })
        .collect()
}

/// Nanoseconds per pair in each of `runs` runs of as many rounds as take [`SHORTEST_RUN`].
fn per_pair(round: &mut impl FnMut(), runs: usize) -> Vec<f64> {
    let mut rounds = 1;
    while seconds(round, rounds) < SHORTEST_RUN {
        rounds *= 2;
    }
    let pairs = (rounds * SPLATS * PIXELS) as f64;
    (0..runs).map(|_| seconds(round, rounds) * 1e9 / pairs).collect()
}

fn seconds(round: &mut impl FnMut(), rounds: usize) -> f64 {
    let start = Instant::now();
    for _ in 0..rounds {
        round();
    }
    start.elapsed().as_secs_f64()
}
