//! Every stage at its extremes, the shipped single-precision path beside a plain double-precision reference.
//!
//! A sweep is a module with a function `rows`: one [`row::Row`] per extreme, each with the worst error that was found
//! and the bound that it is held to. `cargo xtask numerics` writes the same rows into `docs/numerics.md`, which says
//! how to read them.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "tests; `--nocapture` shows the rows that were found"
)]

mod document;
mod reference;
mod row;

mod adam;
mod harmonics;
mod loss;
mod metrics;
mod motion;
mod raster_backward;
mod raster_forward;
mod raster_input;
mod scenes;
mod session;
mod storage;

use motion::{
    footprints as motion_footprints, lift as motion_lift, moments as motion_moments,
    partial as motion_partial, population as motion_population, poses,
    regularisation as motion_regularisation, rotation as motion_rotation,
};

/// A test for every sweep, and the list of them.
macro_rules! sweeps {
    ($($name:ident),+ $(,)?) => {
        $(#[test]
        fn $name() {
            document::prove(stringify!($name), &$name::rows());
        })+

        #[test]
        fn the_document_has_a_table_for_every_sweep_and_no_other() {
            document::require_tables(&[$(stringify!($name)),+]);
        }
    };
}

// In the order of a training step, then of motion compensation.
sweeps! {
    raster_forward,
    raster_backward,
    raster_input,
    loss,
    adam,
    session,
    harmonics,
    storage,
    metrics,
    poses,
    motion_moments,
    motion_footprints,
    motion_lift,
    motion_partial,
    motion_regularisation,
    motion_rotation,
    motion_population,
}
