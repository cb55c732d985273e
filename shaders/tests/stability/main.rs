//! The rasterizer's rows of the stability suite (`tests/stability`, `docs/numerics.md`) on the GPU engine: the same scenes, the same references
//! in double precision and the same predictions.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    dead_code,
    reason = "tests; `--nocapture` shows the rows that were found; a part of the suite is used"
)]

#[path = "../../../tests/stability/raster_backward.rs"]
mod raster_backward;
#[path = "../../../tests/stability/raster_forward.rs"]
mod raster_forward;
#[path = "../../../tests/stability/reference/mod.rs"]
mod reference;
#[path = "../../../tests/stability/row.rs"]
mod row;
#[path = "../../../tests/stability/scenes.rs"]
mod scenes;
#[path = "../gpu/support.rs"]
mod support;

use splat::engine::Engine;

use crate::{
    raster_backward::{Allowance, Backward},
    row::Row,
    scenes::Extreme,
};

/// One scene of each value.
fn thinned(mut extreme: Extreme) -> Extreme {
    let each = if extreme.scenes.len() < 8 { 1 } else { 4 };
    extreme.scenes = extreme.scenes.into_iter().step_by(each).collect();
    extreme
}

fn prove(rows: &[Row]) {
    for Row { extreme, cases, largest, error, predicted, bar, .. } in rows {
        println!(
            "{extreme}: {cases} cases, largest {largest:.1e}, {:.1} of {} predictions",
            error / predicted,
            bar.factor
        );
    }
    let failing: Vec<_> = rows.iter().filter(|row| !row.holds()).map(|row| row.extreme).collect();
    assert!(failing.is_empty(), "beyond their bounds: {failing:?}");
}

/// Predictions assume that footprints are projected in double precision, as the processor does. Here a position is rounded in single
/// precision: 8192 pixels away to half a thousandth of a pixel, which is more than alpha's own rounding.
fn factor_of_images(extreme: &str) -> f64 {
    if extreme.starts_with("images of") { 2.0 } else { 1.0 }
}

#[test]
fn images_at_the_extremes_are_those_of_double_precision() {
    let Some(engine) = support::engine() else { return };
    let engines: [&dyn Engine; 1] = [engine];
    let row = |extreme: Extreme| {
        let factor = factor_of_images(extreme.name);
        raster_forward::row(&thinned(extreme), &engines, factor)
    };
    prove(&raster_forward::sweeps().into_iter().map(row).collect::<Vec<_>>());
}

/// The replay divides the transmittance by what each footprint left of it, which is a hundred thousand roundings; the processor keeps what it had on
/// the way there. And spheres have a gradient by rotation that is exactly zero, of terms that are not: the processor adds them up in
/// double precision.
fn allowance(extreme: &str) -> Allowance {
    let factor = if extreme.starts_with("100 000 Gaussians") { 4.0 } else { 1.0 };
    Allowance { factor, zero: 2f64.powi(-23) }
}

#[test]
fn gradients_at_the_extremes_are_those_of_double_precision() {
    let Some(engine) = support::engine() else { return };
    let backward: Backward<'_> = &|scene, image, alpha| {
        engine.render_backward(&scene.gaussians, &scene.camera, scene.background, image, alpha).unwrap()
    };
    let row = |extreme: Extreme| {
        let allowance = allowance(extreme.name);
        raster_backward::row(&thinned(extreme), &[backward], allowance)
    };
    let sweeps = [scenes::typical()].into_iter().chain(raster_backward::sweeps());
    prove(&sweeps.map(row).collect::<Vec<_>>());
}
