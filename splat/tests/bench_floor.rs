//! The microkernels of the floor do what the table takes them for.

#[path = "../benches/raster_table/floor/mod.rs"]
mod floor;

use floor::{Floor, Machine};

#[test]
fn no_lane_is_idle_and_the_replay_undoes_the_blending() {
    for machine in [Machine::Avx512, Machine::Avx2, Machine::Baseline] {
        if machine.is_there() {
            floor::check(machine);
        }
    }
    assert!(Machine::best().is_there() && !Machine::best().name().is_empty());
}

#[test]
fn every_run_gives_a_time() {
    let mut floor = Floor::default();
    floor.measure(Machine::Baseline, 2);
    floor.measure(Machine::best(), 1);
    let adam = floor::adam_milliseconds(Machine::best(), 100_003, 3);
    assert_eq!((floor.forward.len(), floor.backward.len(), adam.len()), (3, 3, 3));
    assert!(floor.forward.iter().chain(&floor.backward).chain(&adam).all(|&time| time > 0.0));
}
