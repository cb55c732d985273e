//! PSNR and SSIM, which work in double precision, against their definitions.

use splat::{
    image::Image,
    metrics::{PSNR_CAP, psnr, ssim},
};

use crate::{
    reference::{
        ROUNDOFF_64,
        ssim::{Mean, Pair},
    },
    row::{Bar, EXACT, Row},
};

const SSIM_BAR: Bar = Bar {
    unit: "of SSIM",
    factor: 2.0,
    why: "2⁻⁵³ (22 roundings per moment × derivative, and one per term of the mean)",
};

const PSNR_BAR: Bar =
    Bar {
        unit: "dB", factor: 2.0, why: "2⁻⁵³ (4.3 dB × one rounding per term, and one of the result)"
    };

pub(crate) fn image(width: u32, height: u32, value: impl Fn(usize) -> f32) -> Image {
    Image { width, height, pixels: (0..(3 * width * height) as usize).map(value).collect() }
}

pub(crate) fn texture(width: u32, height: u32, phase: f32) -> Image {
    image(width, height, |index| 0.5 + 0.4 * (index as f32 * 0.37 + phase).sin())
}

/// Flat, black, equal, nearly equal, opposite images of a size.
pub(crate) fn pairs(width: u32, height: u32) -> Vec<(Image, Image)> {
    let flat = |value: f32| image(width, height, |_| value);
    let texture = |phase: f32| texture(width, height, phase);
    vec![
        (texture(0.0), texture(0.3)),
        (texture(0.0), texture(0.0)),
        (texture(0.0), texture(1e-6)),
        (flat(0.0), flat(0.0)),
        (flat(0.0), flat(1.0)),
        (flat(1.0), flat(1.0)),
        (flat(0.5), texture(0.0)),
        (flat(1.0), texture(0.0)),
    ]
}

pub(crate) const SMALL: [(u32, u32); 6] = [(1, 1), (2, 3), (5, 5), (1, 11), (10, 10), (17, 13)];
pub(crate) const LONG: [(u32, u32); 2] = [(1, 4096), (8192, 1)];

fn ssim_row(extreme: &'static str, sizes: &[(u32, u32)]) -> Row {
    let mut row = Row::new("metrics: SSIM", extreme, SSIM_BAR);
    for (a, b) in sizes.iter().flat_map(|&(width, height)| pairs(width, height)) {
        let Mean { value, by_moments, by_sum } = Pair::new(&a, &b, None).ssim();
        row.case((ssim(&a, &b) - value).abs(), ROUNDOFF_64 * (22.0 * by_moments + by_sum));
    }
    row
}

fn psnr_row() -> Row {
    let mut row =
        Row::new("metrics: PSNR", "flat, black, equal and opposite images, 1×1 to 8192×1", PSNR_BAR)
            .remark(format!("equal images score {PSNR_CAP} dB, no image more"));
    for (a, b) in SMALL.iter().chain(&LONG).flat_map(|&(width, height)| pairs(width, height)) {
        let squared = Pair::new(&a, &b, None).squared();
        let expected = (-10.0 * squared.log10()).min(PSNR_CAP);
        let values = a.pixels.len() as f64;
        row.case((psnr(&a, &b) - expected).abs(), ROUNDOFF_64 * (4.35 * values + expected.abs()));
    }
    row
}

/// What cannot be compared scores nothing.
fn refusals() -> Row {
    let mut row =
        Row::new("metrics: PSNR, SSIM", "other sizes, empty images, a NaN in either", EXACT).remark("NaN");
    let whole = texture(4, 4, 0.0);
    let mut broken = whole.clone();
    broken.pixels[7] = f32::NAN;
    let empty = image(0, 0, |_| 0.0);
    for (a, b) in [(&whole, &texture(4, 5, 0.0)), (&empty, &empty), (&whole, &broken), (&broken, &whole)] {
        row.exact(psnr(a, b).is_nan() && ssim(a, b).is_nan());
    }
    row
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    vec![
        ssim_row("flat, black and tiny images, 1×1 to 17×13", &SMALL),
        ssim_row("one column of 4096, one row of 8192 pixels", &LONG),
        psnr_row(),
        refusals(),
    ]
}
