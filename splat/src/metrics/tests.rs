use super::*;
use crate::loss::{LossWorkspace, PhotometricLoss};

fn image(width: u32, height: u32, value: impl Fn(usize) -> f32) -> Image {
    Image { width, height, pixels: (0..(width * height * 3) as usize).map(value).collect() }
}

/// Varied values in `[0.1, 0.9]` without a random generator.
fn texture(width: u32, height: u32, phase: f32) -> Image {
    image(width, height, |index| 0.5 + 0.4 * (index as f32 * 0.37 + phase).sin())
}

#[test]
fn psnr_of_a_constant_difference_is_its_logarithm() {
    let (a, b) = (Image::filled(7, 5, [0.5; 3]), Image::filled(7, 5, [0.625; 3]));
    // MSE = 1/64.
    assert!((psnr(&a, &b) - 10.0 * 64.0_f64.log10()).abs() < 1e-12);
}

#[test]
fn values_beyond_the_range_count_as_its_ends() {
    let (a, b) = (Image::filled(4, 4, [2.0; 3]), Image::filled(4, 4, [1.0; 3]));
    assert_eq!(psnr(&a, &b), PSNR_CAP);
    assert_eq!(psnr(&Image::filled(4, 4, [-3.0; 3]), &b), 0.0);
}

#[test]
fn equal_images_score_the_stated_maxima() {
    let a = texture(20, 15, 0.0);
    assert_eq!(psnr(&a, &a), PSNR_CAP);
    assert!((ssim(&a, &a) - 1.0).abs() < 1e-12);
    let nearly = image(20, 15, |index| a.pixels[index] + 1e-7);
    assert_eq!(psnr(&a, &nearly), PSNR_CAP);
}

#[test]
fn ssim_agrees_with_the_loss() {
    for (width, height) in [(33, 21), (1, 1), (3, 60)] {
        let (a, b) = (texture(width, height, 0.0), texture(width, height, 0.3));
        let mut gradient = vec![0.0; a.pixels.len()];
        let loss =
            PhotometricLoss::new(&b, None, 1.0).evaluate(&a, &mut LossWorkspace::default(), &mut gradient);
        // The loss works in single precision on moments of values near 1 and divides by C2 = 9e-4.
        assert!((ssim(&a, &b) - (1.0 - f64::from(loss))).abs() < 1e-5);
    }
}

#[test]
fn a_mask_selects_its_pixels() {
    let a = texture(10, 8, 0.0);
    let mut b = a.clone();
    b.pixels[0] += 0.1;
    let only = |pixel: usize| {
        let mut inside = vec![false; 80];
        inside[pixel] = true;
        Mask { width: 10, height: 8, inside }
    };
    let expected = -10.0 * (f64::from(b.pixels[0] - a.pixels[0]).powi(2) / 3.0).log10();
    assert!((masked_psnr(&a, &b, &only(0)).expect("one pixel") - expected).abs() < 1e-9);
    assert_eq!(masked_psnr(&a, &b, &only(79)), Some(PSNR_CAP));
    assert!(masked_ssim(&a, &b, &only(0)).expect("one pixel") < 0.999);
    assert!((masked_ssim(&a, &b, &only(79)).expect("one pixel") - 1.0).abs() < 1e-12);

    let all = Mask { width: 10, height: 8, inside: vec![true; 80] };
    assert_eq!(masked_psnr(&a, &b, &all), Some(psnr(&a, &b)));
    assert_eq!(masked_ssim(&a, &b, &all), Some(ssim(&a, &b)));
    let none = Mask { width: 10, height: 8, inside: vec![false; 80] };
    assert_eq!((masked_psnr(&a, &b, &none), masked_ssim(&a, &b, &none)), (None, None));
}

#[test]
fn what_cannot_be_compared_scores_nothing() {
    let (a, b) = (texture(4, 4, 0.0), texture(4, 5, 0.0));
    let mask = Mask { width: 4, height: 5, inside: vec![true; 20] };
    assert!(psnr(&a, &b).is_nan() && ssim(&a, &b).is_nan());
    assert_eq!((masked_psnr(&a, &a, &mask), masked_ssim(&a, &a, &mask)), (None, None));
    let empty = Image { width: 0, height: 0, pixels: Vec::new() };
    assert!(psnr(&empty, &empty).is_nan() && ssim(&empty, &empty).is_nan());

    let mut broken = a.clone();
    broken.pixels[7] = f32::NAN;
    assert!(psnr(&a, &broken).is_nan() && ssim(&a, &broken).is_nan());
}
