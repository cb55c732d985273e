#![allow(clippy::unwrap_used, reason = "tests")]

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{window::gaussian_taps, *};

fn random_image(width: u32, height: u32, seed: u64) -> Image {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let pixels = (0..width * height * 3).map(|_| random.random_range(0.0..1.0)).collect();
    Image { width, height, pixels }
}

/// The target with noise: similar images, as in training.
fn disturbed(target: &Image, amplitude: f32, seed: u64) -> Image {
    let noise = random_image(target.width, target.height, seed);
    let pixels = target.pixels.iter().zip(&noise.pixels).map(|(t, n)| t + amplitude * (n - 0.5)).collect();
    Image { pixels, ..*target }
}

fn random_mask(width: u32, height: u32, seed: u64) -> Mask {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    Mask { width, height, inside: (0..width * height).map(|_| random.random_bool(0.4)).collect() }
}

/// Windowed mean of `f(pixel index)` around a pixel, the direct two-dimensional sum.
fn windowed(image: &Image, x: usize, y: usize, f: impl Fn(usize) -> f64) -> f64 {
    let taps = gaussian_taps();
    let mut sum = 0.0;
    for (j, row_tap) in taps.iter().enumerate() {
        for (i, column_tap) in taps.iter().enumerate() {
            let (column, row) = (x as isize + i as isize - 5, y as isize + j as isize - 5);
            let inside =
                (0..image.width as isize).contains(&column) && (0..image.height as isize).contains(&row);
            if inside {
                sum += row_tap * column_tap * f(row as usize * image.width as usize + column as usize);
            }
        }
    }
    sum
}

/// The loss as its formula reads, in double precision.
fn reference(rendered: &[f64], target: &Image, mask: Option<&Mask>, weight: f64) -> f64 {
    let (mut absolute, mut similarity, mut count) = (0.0, 0.0, 0.0);
    for y in 0..target.height as usize {
        for x in 0..target.width as usize {
            let pixel = y * target.width as usize + x;
            if mask.is_some_and(|mask| !mask.inside[pixel]) {
                continue;
            }
            for channel in 0..3 {
                let a = |pixel: usize| rendered[3 * pixel + channel];
                let b = |pixel: usize| f64::from(target.pixels[3 * pixel + channel]);
                let mean_a = windowed(target, x, y, a);
                let mean_b = windowed(target, x, y, b);
                let variance_a = windowed(target, x, y, |p| a(p) * a(p)) - mean_a * mean_a;
                let variance_b = windowed(target, x, y, |p| b(p) * b(p)) - mean_b * mean_b;
                let covariance = windowed(target, x, y, |p| a(p) * b(p)) - mean_a * mean_b;
                similarity += (2.0 * mean_a * mean_b + C1) * (2.0 * covariance + C2)
                    / ((mean_a * mean_a + mean_b * mean_b + C1) * (variance_a + variance_b + C2));
                absolute += (a(pixel) - b(pixel)).abs();
                count += 1.0;
            }
        }
    }
    (1.0 - weight) * absolute / count + weight * (1.0 - similarity / count)
}

fn evaluate(rendered: &Image, target: &Image, mask: Option<&Mask>, weight: f32) -> (f32, Vec<f32>) {
    let mut gradient = vec![f32::NAN; rendered.pixels.len()];
    let loss = PhotometricLoss::new(target, mask, weight).evaluate(
        rendered,
        &mut LossWorkspace::default(),
        &mut gradient,
    );
    (loss, gradient)
}

/// Loss within 2e-6 of the reference (f32 moments of values near 1 against C2 = 9e-4 leave about 1e-4 relative in
/// single windows, which averages out), gradient against central differences of the reference.
fn check(rendered: &Image, target: &Image, mask: Option<&Mask>, weight: f32) {
    let (loss, gradient) = evaluate(rendered, target, mask, weight);
    let exact: Vec<f64> = rendered.pixels.iter().map(|&value| value.into()).collect();
    let expected = reference(&exact, target, mask, weight.into());
    assert!((f64::from(loss) - expected).abs() < 2e-6, "loss {loss}, reference {expected}");

    let stride = (gradient.len() / 150).max(1);
    let (mut squared_error, mut squared_norm) = (0.0, 0.0);
    for index in (0..gradient.len()).step_by(stride) {
        // Small against the distance to the kink of |x - y| that the noise leaves at nearly every value.
        let step = 1e-6;
        let at = |offset: f64| {
            let mut shifted = exact.clone();
            shifted[index] += offset;
            reference(&shifted, target, mask, weight.into())
        };
        let numeric = (at(step) - at(-step)) / (2.0 * step);
        squared_error += (f64::from(gradient[index]) - numeric).powi(2);
        squared_norm += numeric * numeric;
    }
    assert!(
        squared_error.sqrt() <= 2e-4 * squared_norm.sqrt(),
        "gradient error {} of {}",
        squared_error.sqrt(),
        squared_norm.sqrt()
    );
}

#[test]
fn agrees_with_the_formula_and_its_finite_differences() {
    let target = random_image(23, 17, 1);
    check(&disturbed(&target, 0.2, 2), &target, None, 0.2);
    check(&random_image(23, 17, 3), &target, None, 1.0);
    check(&disturbed(&target, 0.5, 4), &target, None, 0.0);
}

#[test]
fn agrees_under_a_mask() {
    let target = random_image(21, 19, 5);
    check(&disturbed(&target, 0.3, 6), &target, Some(&random_mask(21, 19, 7)), 0.2);
}

#[test]
fn agrees_on_images_smaller_than_the_window() {
    for (width, height) in [(1, 1), (8, 1), (1, 9), (2, 3)] {
        let target = random_image(width, height, 8);
        check(&disturbed(&target, 0.3, 9), &target, None, 0.2);
    }
}

#[test]
fn agrees_on_long_thin_images() {
    for (width, height) in [(3, 200), (200, 3)] {
        let target = random_image(width, height, 10);
        let rendered = disturbed(&target, 0.2, 11);
        let (loss, _) = evaluate(&rendered, &target, None, 0.2);
        let exact: Vec<f64> = rendered.pixels.iter().map(|&value| value.into()).collect();
        let expected = reference(&exact, &target, None, f64::from(0.2_f32));
        assert!((f64::from(loss) - expected).abs() < 2e-6, "loss {loss}, reference {expected}");
    }
}

#[test]
fn equal_images_have_neither_loss_nor_gradient() {
    for image in [random_image(37, 12, 12), Image::filled(20, 20, [0.0, 0.5, 1.0])] {
        let (loss, gradient) = evaluate(&image, &image, None, 0.2);
        assert_eq!(loss, 0.0);
        assert!(gradient.iter().all(|&value| value == 0.0));
    }
}

#[test]
fn constant_images_agree_with_the_formula() {
    check(&Image::filled(15, 15, [0.2, 0.9, 0.0]), &Image::filled(15, 15, [0.7, 0.85, 1.0]), None, 0.2);
}

#[test]
fn far_out_of_range_values_stay_finite() {
    // Large and nearly constant: rounded variances are a thousand times C2, of either sign.
    let target = Image::filled(24, 24, [0.5; 3]);
    let mut rendered = Image::filled(24, 24, [1e4; 3]);
    for (index, value) in rendered.pixels.iter_mut().enumerate() {
        *value += (index % 3) as f32 * 1e-3;
    }
    let (loss, gradient) = evaluate(&rendered, &target, None, 0.2);
    assert!(loss.is_finite() && loss > 1e3);
    assert!(gradient.iter().all(|value| value.is_finite()));
}

#[test]
fn a_nan_value_makes_the_loss_nan() {
    let target = random_image(30, 30, 13);
    for weight in [0.0, 0.2, 1.0] {
        let mut rendered = target.clone();
        rendered.pixels[500] = f32::NAN;
        assert!(evaluate(&rendered, &target, None, weight).0.is_nan());
    }
}

#[test]
fn nothing_counts_under_an_empty_mask_or_in_an_empty_image() {
    let image = random_image(9, 9, 14);
    let mask = Mask { width: 9, height: 9, inside: vec![false; 81] };
    let (loss, gradient) = evaluate(&image, &random_image(9, 9, 15), Some(&mask), 0.2);
    assert_eq!(loss, 0.0);
    assert!(gradient.iter().all(|&value| value == 0.0));

    let empty = Image { width: 0, height: 5, pixels: Vec::new() };
    assert_eq!(evaluate(&empty, &empty, None, 0.2).0, 0.0);
}

#[test]
fn a_reused_workspace_and_any_thread_count_give_the_same_bytes() {
    let (large, small) = (random_image(53, 41, 16), random_image(19, 23, 17));
    let mut workspace = LossWorkspace::default();
    for target in [&large, &small, &large] {
        let rendered = disturbed(target, 0.2, 18);
        let (expected_loss, expected) = evaluate(&rendered, target, None, 0.2);
        for threads in [1, 3, 8] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let mut gradient = vec![0.0; expected.len()];
            let loss = pool.install(|| {
                PhotometricLoss::new(target, None, 0.2).evaluate(&rendered, &mut workspace, &mut gradient)
            });
            assert_eq!(loss.to_bits(), expected_loss.to_bits());
            assert!(gradient.iter().zip(&expected).all(|(a, b)| a.to_bits() == b.to_bits()));
        }
    }
}

#[test]
fn every_instruction_set_gives_the_same_bytes() {
    let (width, height) = (43, 29);
    let target = random_image(width, height, 19);
    let rendered = disturbed(&target, 0.3, 20);
    let loss = PhotometricLoss::new(&target, None, 0.2);
    let run = |instructions| {
        let mut out = vec![0.0; rendered.pixels.len()];
        let value = loss.evaluate(&rendered, &mut LossWorkspace::new(instructions), &mut out);
        (value.to_bits(), out.iter().map(|value| value.to_bits()).collect::<Vec<_>>())
    };
    let expected = run(Instructions::detect());
    for instructions in Instructions::available() {
        assert_eq!(run(instructions), expected, "{}", instructions.set());
    }
}
