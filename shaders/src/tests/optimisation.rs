//! Loss and optimiser beside those of the CPU engine.

use std::sync::Arc;

use bytemuck::bytes_of;
use splat::{
    engine::TrainingView,
    gaussians::gradients::GaussianGradients,
    image::{Image, Mask},
    loss::{LossWorkspace, PhotometricLoss},
    optim::{Adam, LearningRates},
};

use super::{
    run,
    support::{self, arc, blobs, seeds},
};
use crate::{
    GpuEngine,
    buffers::{
        GradientBuffers, LossBuffers, OptimiserBuffers, allocate, parameters::interleaved, separated, storage,
    },
    layout::{GEOMETRY, State, Step, View},
    session::{SessionView, session_view},
    stages::Binder,
    transfer::{read, write},
};

/// Values about and beyond [0, 1].
fn image(width: u32, height: u32, phase: usize) -> Image {
    let count = (3 * width * height) as usize;
    let pixels = seeds(count + phase)[phase..].iter().map(|value| 0.5 + 0.55 * value).collect();
    Image { width, height, pixels }
}

/// As an 8-bit file has it.
fn rounded(image: &Image) -> Image {
    let pixels = image.to_rgb8().into_iter().map(|byte| f32::from(byte) / 255.0).collect();
    Image { pixels, ..image.clone() }
}

#[test]
fn the_loss_and_its_gradient_are_those_of_the_cpu_engine() {
    let Some(engine) = support::engine() else { return };
    for (width, height, weight, is_masked) in [
        (1, 1, 0.2, false),
        (17, 13, 0.2, false),
        (64, 45, 0.5, true),
        (33, 70, 0.0, true),
        (5, 90, 1.0, false),
    ] {
        check_loss(engine, [width, height], weight, is_masked, 0);
    }
}

/// The loss between two images that `phase` chooses; masked ones are of 8 bits.
pub(super) fn check_loss(
    engine: &GpuEngine,
    [width, height]: [u32; 2],
    weight: f32,
    is_masked: bool,
    phase: usize,
) {
    let context = &*engine.context;
    let device = &context.device;
    let rendered = image(width, height, phase);
    let wanted = image(width, height, phase + 7);
    let wanted = if is_masked { rounded(&wanted) } else { wanted };
    let pixels = (width * height) as usize;
    let inside: Vec<bool> = (0..pixels).map(|pixel| !is_masked || pixel % 7 < 4).collect();
    let mask = Mask { width, height, inside };
    let mut expected = vec![0.0; 3 * pixels];
    let value = PhotometricLoss::new(&wanted, is_masked.then_some(&mask), weight).evaluate(
        &rendered,
        &mut LossWorkspace::default(),
        &mut expected,
    );

    let training = TrainingView {
        camera: arc(1, width, height).swap_remove(0),
        image: Arc::new(wanted),
        mask: is_masked.then(|| Arc::new(mask)),
    };
    let SessionView { view, wanted, .. } = session_view(device, &training, [0.0; 3], weight).unwrap();
    assert_eq!(view.data.is_packed, u32::from(is_masked), "masked ones have 8 bits here");
    let gaussians = blobs(1, 0, 1);
    let buffers = engine.buffers(&gaussians, &view.data, true).unwrap();
    let gradients = GradientBuffers::new(device, &buffers.size).unwrap();
    let loss = LossBuffers::new(device, &buffers.size, 4).unwrap();
    let colours = rendered.pixels.as_chunks::<3>().0.iter();
    let shown: Vec<[f32; 4]> = colours.map(|&[red, green, blue]| [red, green, blue, 0.5]).collect();
    device.queue.write_buffer(&buffers.images.rendered, 0, bytemuck::cast_slice(&shown));
    let step = Step { loss_place: 2, ..Step::default() };
    device.queue.write_buffer(&buffers.common.step, 0, bytes_of(&step));
    let binder = Binder { device, kernels: &context.kernels };
    run(context, &binder.loss(&buffers, &gradients, &loss, &view, &wanted));

    let found: Vec<f32> = read(device, &loss.losses, 3).unwrap();
    assert!((found[2] - value).abs() < 2e-6 * value, "{width}x{height}: {} for {value}", found[2]);
    let found: Vec<[f32; 4]> = read(device, &gradients.image, pixels).unwrap();
    let largest = expected.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
    for (pixel, expected) in expected.as_chunks::<3>().0.iter().enumerate() {
        for channel in 0..3 {
            // The variance of a window is a difference of sums: 1e-7 of the square of the values, over its own size.
            let off = (found[pixel][channel] - expected[channel]).abs();
            assert!(off < 2e-5 * largest, "{width}x{height}, pixel {pixel}: off by {off} of {largest}");
        }
        assert_eq!(found[pixel][3], 0.0, "no gradient by alpha");
    }
}

const RATES: LearningRates = LearningRates {
    mean: 1e-3,
    rotation: 2e-3,
    log_scale: 5e-3,
    logit_opacity: 0.05,
    sh_dc: 4e-3,
    sh_rest: 1e-4,
    sh_degree: 1,
};

#[test]
fn descent_is_that_of_the_cpu_engine() {
    let Some(engine) = support::engine() else { return };
    check_descent(engine, 150, 2, 8);
}

/// Four steps by random gradients; a quarter of the Gaussians is frozen.
pub(super) fn check_descent(engine: &GpuEngine, count: usize, degree: u32, seed: u64) {
    let coefficients = (degree as usize + 1).pow(2);
    let context = &*engine.context;
    let device = &context.device;
    let start = blobs(count, degree, seed);
    let active: Vec<bool> = (0..count).map(|index| index % 4 != 1).collect();
    let view = View::new(&arc(1, 8, 8)[0], [0.0; 3]);
    let buffers = engine.buffers(&start, &view, true).unwrap();
    let gradients = GradientBuffers::new(device, &buffers.size).unwrap();
    let optimiser = OptimiserBuffers::new(device, &buffers.size, &active).unwrap();
    let state = State { gaussians: count as u32, ..State::default() };
    device.queue.write_buffer(&buffers.common.state, 0, bytes_of(&state));
    let (mut expected, mut adam) = (start.clone(), Adam::new(&start));
    for number in 1..=4 {
        // Sizes from 1e-12 to 1: the optimiser makes them equal.
        let mut by = blobs(count, degree, 1000 + 4 * seed + number);
        for (index, mean) in by.means.iter_mut().enumerate() {
            *mean = mean.map(|value| value * 10.0_f32.powi(-((index % 13) as i32)));
        }
        let gradient = GaussianGradients {
            means: by.means.clone(),
            rotations: by.rotations.clone(),
            log_scales: by.log_scales.clone(),
            logit_opacities: by.logit_opacities.clone(),
            sh: by.sh.clone(),
        };
        adam.step(&mut expected, &gradient, &RATES, Some(&active));
        device.queue.write_buffer(&gradients.geometry, 0, bytemuck::cast_slice(&interleaved(&by)));
        device.queue.write_buffer(&gradients.sh, 0, bytemuck::cast_slice(&by.sh));
        let step = Step {
            count: count as u32,
            coefficients: coefficients as u32,
            degree: RATES.sh_degree,
            rates: [RATES.mean, RATES.rotation, RATES.log_scale, RATES.logit_opacity],
            sh_rates: [RATES.sh_dc, RATES.sh_rest],
            first_correction: (1.0 / (1.0 - 0.9_f64.powi(number as i32))) as f32,
            second_correction: (1.0 / (1.0 - 0.999_f64.powi(number as i32)).sqrt()) as f32,
            has_active: 1,
            ..Step::default()
        };
        device.queue.write_buffer(&buffers.common.step, 0, bytes_of(&step));
        let binder = Binder { device, kernels: &context.kernels };
        run(context, &binder.adam(&buffers, &gradients, &optimiser, coefficients as u64));
    }
    let geometry: Vec<[f32; GEOMETRY]> = read(device, &buffers.parameters.geometry, count).unwrap();
    let found =
        separated(&geometry, read(device, &buffers.parameters.sh, 3 * coefficients * count).unwrap(), degree);
    for index in 0..count {
        if !active[index] {
            assert_eq!(found.select(&[index]), start.select(&[index]), "frozen Gaussian {index}");
        }
    }
    let close = |ours: &[f32], theirs: &[f32]| {
        // A few roundings of the value, and of four steps.
        ours.iter().zip(theirs).all(|(a, b)| (a - b).abs() < 1e-6 * (b.abs() + 0.1))
    };
    assert!(close(found.means.as_flattened(), expected.means.as_flattened()));
    assert!(close(found.rotations.as_flattened(), expected.rotations.as_flattened()));
    assert!(close(found.log_scales.as_flattened(), expected.log_scales.as_flattened()));
    assert!(close(&found.logit_opacities, &expected.logit_opacities));
    assert!(close(&found.sh, &expected.sh));
}

/// Gaussians of degree 3 whose 48 coefficients take more threads than the 65 535 workgroups of 256 of a row.
const MORE_THAN_A_ROW: usize = 349_530;
const _: () = assert!(48 * MORE_THAN_A_ROW > 65_535 * 256);

#[test]
fn descent_of_more_parameters_than_one_row_of_workgroups_is_that_of_the_cpu_engine() {
    let Some(engine) = support::engine() else { return };
    check_descent(engine, MORE_THAN_A_ROW, 3, 9);
}

#[test]
fn more_values_than_one_row_of_workgroups_are_all_taken_over() {
    let Some(engine) = support::engine() else { return };
    let context = &*engine.context;
    let device = &context.device;
    let (count, width) = (MORE_THAN_A_ROW, 48_usize);
    let bytes = 4 * (count * width) as u64;
    let [sources, old, new] = allocate(
        device,
        [storage("sources", 4 * count as u64), storage("old", bytes), storage("new", bytes)],
    )
    .unwrap();
    let values: Vec<f32> = (0..count * width).map(|place| (place % 9_999_991) as f32).collect();
    let backwards: Vec<u32> = (0..count as u32).rev().collect();
    write(device, &old, &values).unwrap();
    write(device, &sources, &backwards).unwrap();
    let binder = Binder { device, kernels: &context.kernels };
    run(context, &[binder.replace(&sources, &old, &new, count as u64, width as u64).unwrap()]);
    let found: Vec<f32> = read(device, &new, count * width).unwrap();
    let expected = backwards.iter().flat_map(|&row| &values[row as usize * width..][..width]);
    assert!(found.iter().eq(expected));
}
