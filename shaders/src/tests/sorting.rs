//! Scan and sort.

use bytemuck::bytes_of;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{run, support};
use crate::{
    buffers::{BLOCK, CommonBuffers, DIGITS, SortBuffers, allocate, storage},
    engine::Context,
    layout::State,
    program::Groups,
    stages::Binder,
    transfer::read,
};

/// Around the ends of a thread's share, of a block, and of what the spine takes at a time.
const LENGTHS: [usize; 9] = [0, 1, 3, 255, 1023, 1024, 1025, 40_000, 270_001];

#[test]
fn exclusive_sums_are_those_of_a_loop() {
    support::engines().for_each(|engine| check_sums(&engine.context));
}

fn check_sums(context: &Context) {
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
            binder.scan(&common, 0, &buffer, &sums, &Groups::of(blocks), &mut program);
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
    support::engines().for_each(|engine| check_order(&engine.context));
}

fn check_order(context: &Context) {
    let binder = Binder { device: &context.device, kernels: &context.kernels };
    let mut random = ChaCha8Rng::seed_from_u64(2);
    for (passes, largest) in [(4, u32::MAX), (4, 3), (2, 1 << 12), (1, 256), (3, 1 << 24)] {
        for length in LENGTHS {
            let keys: Vec<u32> = (0..length).map(|_| random.random_range(0..largest)).collect();
            let values: Vec<u32> = (0..length as u32).collect();
            let common = CommonBuffers::new(&context.device).unwrap();
            let buffers = SortBuffers::new(&context.device, length as u64).unwrap();
            let state = State { gaussians: length as u32, ..State::default() };
            context.device.queue.write_buffer(&common.state, 0, bytes_of(&state));
            context.device.queue.write_buffer(&buffers.keys[0], 0, bytemuck::cast_slice(&keys));
            context.device.queue.write_buffer(&buffers.values[0], 0, bytemuck::cast_slice(&values));
            let blocks = (length as u64).div_ceil(BLOCK);
            let scans = Groups::of((DIGITS * blocks).div_ceil(BLOCK));
            let mut program = Vec::new();
            let (sorted, order) =
                binder.sort(&common, &buffers, 0, passes, &Groups::of(blocks), &scans, &mut program);
            run(context, &program);
            let mut expected: Vec<(u32, u32)> = keys.into_iter().zip(values).collect();
            expected.sort_by_key(|&(key, _)| key);
            let sorted: Vec<u32> = read(&context.device, sorted, length).unwrap();
            let order: Vec<u32> = read(&context.device, order, length).unwrap();
            assert!(sorted.into_iter().zip(order).eq(expected), "{length} keys below {largest}");
        }
    }
}
