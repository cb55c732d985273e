//! Scan and sort.

use bytemuck::bytes_of;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{run, support};
use crate::{
    buffers::{BLOCK, CommonBuffers, DIGITS, SortBuffers, allocate, storage},
    engine::Context,
    layout::{State, Step},
    program::Groups,
    stages::Binder,
    transfer::read,
};

/// Workgroups of a row.
pub(super) const ROW: u32 = 65_535;

/// Around the ends of a thread's share, of a block, and of what the spine takes at a time.
const LENGTHS: [usize; 9] = [0, 1, 3, 255, 1023, 1024, 1025, 40_000, 270_001];

#[test]
fn exclusive_sums_are_those_of_a_loop() {
    support::engines().for_each(|engine| check_sums(&engine.context, ROW));
}

/// Where a dispatch has more workgroups than one row may have they are in several: a device for that is larger than those that tests run
/// on (65 536 blocks are 67 million keys), so that the rows are shorter.
#[test]
fn workgroups_in_rows_do_what_those_in_one_row_do() {
    for engine in support::engines() {
        for row in [1, 7] {
            check_sums(&engine.context, row);
            check_order(&engine.context, row);
        }
    }
}

#[test]
fn a_plan_has_every_workgroup_within_the_limits_of_a_dispatch() {
    let Some(engine) = support::engine() else { return };
    let context = &*engine.context;
    let device = &context.device;
    let binder = Binder { device, kernels: &context.kernels };
    for needed in [0, 1, 1024, 1025, 65_535 * 1024, 65_535 * 1024 + 1, 70_000_000, u32::MAX - (1 << 27)] {
        let common = CommonBuffers::new(device).unwrap();
        let [counts] = allocate(device, [storage("counts", 4)]).unwrap();
        let step = Step { capacity: u32::MAX - 1, ..Step::default() };
        device.queue.write_buffer(&common.step, 0, bytes_of(&step));
        device.queue.write_buffer(&common.state, 0, bytes_of(&State::default()));
        device.queue.write_buffer(&counts, 0, bytes_of(&needed));
        run(context, &[binder.plan(&common, &counts)]);
        let state: Vec<State> = read(device, &common.state, 1).unwrap();
        assert_eq!((state[0].intersections, state[0].failed), (needed, 0));
        let planned: Vec<[u32; 4]> = read(device, &common.dispatches, 2).unwrap();
        let blocks = u64::from(needed).div_ceil(BLOCK);
        for (planned, groups) in planned.iter().zip([blocks, (DIGITS * blocks).div_ceil(BLOCK)]) {
            let [columns, rows] = [planned[0], planned[1]].map(u64::from);
            assert!(planned[..3].iter().all(|&size| size <= 65_535), "{needed}: {planned:?}");
            assert!(
                (groups..groups + columns.max(1)).contains(&(columns * rows)),
                "{needed}: {planned:?} for {groups}"
            );
        }
    }
}

fn check_sums(context: &Context, row: u32) {
    let binder = Binder { device: &context.device, kernels: &context.kernels };
    let mut random = ChaCha8Rng::seed_from_u64(1);
    for largest in [5, 1 << 20] {
        for length in LENGTHS {
            // The list over Gaussians has one value more than Gaussians.
            let values: Vec<u32> = (0..=length).map(|_| random.random_range(0..largest)).collect();
            let common = CommonBuffers::new(&context.device).unwrap();
            let bytes = 4 * values.len() as u64;
            let blocks = (values.len() as u64).div_ceil(BLOCK);
            let [buffer, sums] =
                allocate(&context.device, [storage("values", bytes), storage("sums", 4 * blocks)]).unwrap();
            let state = State { gaussians: length as u32, ..State::default() };
            context.device.queue.write_buffer(&common.state, 0, bytes_of(&state));
            context.device.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(&values));
            let mut program = Vec::new();
            binder.scan(&common, 0, &buffer, &sums, &Groups::in_rows(blocks, row), &mut program);
            run(context, &program);
            let found: Vec<u32> = read(&context.device, &buffer, values.len()).unwrap();
            let mut sum = 0_u32;
            for (place, value) in values.iter().enumerate() {
                assert_eq!(found[place], sum, "place {place} of {length}");
                sum = sum.saturating_add(*value);
            }
        }
    }
}

#[test]
fn keys_are_sorted_and_equal_ones_keep_their_order() {
    support::engines().for_each(|engine| check_order(&engine.context, ROW));
}

fn check_order(context: &Context, row: u32) {
    let mut random = ChaCha8Rng::seed_from_u64(2);
    for (passes, largest) in [(4, u32::MAX), (4, 3), (2, 1 << 12), (1, 256), (3, 1 << 24)] {
        for length in LENGTHS {
            let keys: Vec<u32> = (0..length).map(|_| random.random_range(0..largest)).collect();
            check_sort(context, keys, passes, row);
        }
    }
}

/// Sorts keys below `256^passes` with their places as values.
pub(super) fn check_sort(context: &Context, keys: Vec<u32>, passes: u32, row: u32) {
    let binder = Binder { device: &context.device, kernels: &context.kernels };
    let length = keys.len();
    let values: Vec<u32> = (0..length as u32).collect();
    let common = CommonBuffers::new(&context.device).unwrap();
    let buffers = SortBuffers::new(&context.device, length as u64).unwrap();
    let state = State { gaussians: length as u32, ..State::default() };
    context.device.queue.write_buffer(&common.state, 0, bytes_of(&state));
    context.device.queue.write_buffer(&buffers.keys[0], 0, bytemuck::cast_slice(&keys));
    context.device.queue.write_buffer(&buffers.values[0], 0, bytemuck::cast_slice(&values));
    let blocks = (length as u64).div_ceil(BLOCK);
    let scans = Groups::in_rows((DIGITS * blocks).div_ceil(BLOCK), row);
    let mut program = Vec::new();
    let blocks = Groups::in_rows(blocks, row);
    let (sorted, order) = binder.sort(&common, &buffers, 0, passes, &blocks, &scans, &mut program);
    run(context, &program);
    let mut expected: Vec<(u32, u32)> = keys.into_iter().zip(values).collect();
    expected.sort_by_key(|&(key, _)| key);
    let sorted: Vec<u32> = read(&context.device, sorted, length).unwrap();
    let order: Vec<u32> = read(&context.device, order, length).unwrap();
    assert!(sorted.into_iter().zip(order).eq(expected), "{length} keys in {passes} passes");
}
