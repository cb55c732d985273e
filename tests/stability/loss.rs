//! L1 + D-SSIM in single precision, its value and its gradient.

use splat::{
    image::{Image, Mask},
    loss::{LossWorkspace, PhotometricLoss},
    simd::Instructions,
};

use crate::{
    metrics::{LONG, SMALL, image, pairs, texture},
    reference::{
        ROUNDOFF_32,
        ssim::{Mean, Pair},
    },
    row::{Bar, EXACT, Row},
};

const VALUE: Bar = Bar {
    unit: "of the loss, at least 1",
    factor: 1.0,
    why: "2⁻²⁴ (22 roundings per moment × derivative, and the sums of a row)",
};

const GRADIENT: Bar = Bar {
    unit: "of the largest gradient",
    factor: 4.0,
    why: "2⁻²⁴ Σ of terms under the window × (squares / variance), by which small variances amplify rounding",
};

/// Two images and which pixels count.
type Case = (Image, Image, Option<Mask>);

fn evaluate((rendered, target, mask): &Case, weight: f32, instructions: Instructions) -> (f64, Vec<f32>) {
    let mut gradient = vec![f32::NAN; rendered.pixels.len()];
    let mut workspace = LossWorkspace::new(instructions);
    let loss = PhotometricLoss::new(target, mask.as_ref(), weight);
    let value = loss.evaluate(rendered, &mut workspace, &mut gradient);
    (value.into(), gradient)
}

/// Adds one pair of images, with every weight on every instruction set, to the row of values and that of gradients.
fn add(value_row: &mut Row, gradient_row: &mut Row, case: &Case) {
    let pair = Pair::new(&case.0, &case.1, case.2.as_ref());
    let Mean { value: similarity, by_moments, .. } = pair.ssim();
    let (absolute, dissimilarity) = (pair.absolute(), 1.0 - similarity);
    let (absolute_slopes, structure_slopes) = (pair.absolute_gradient(), pair.ssim_gradient());
    // SSIM lies between -1 and 1 whatever is rounded.
    let structural = (22.0 * by_moments).min(2.0 / ROUNDOFF_32);
    // Eight sums per row, whose terms may all be equal and round the same way.
    let row_sums = 2.0 + f64::from(case.0.width) / 8.0;
    for weight in WEIGHTS {
        let w = f64::from(weight);
        let expected = (1.0 - w) * absolute + w * dissimilarity;
        let sums = row_sums * ((1.0 - w) * absolute + w * dissimilarity.abs());
        let predicted = ROUNDOFF_32 * (w * structural + sums + w);
        let slopes: Vec<(f64, f64)> = absolute_slopes
            .iter()
            .zip(&structure_slopes)
            .map(|(absolute, [by_structure, terms])| {
                let slope = (1.0 - w) * absolute - w * by_structure;
                (slope, ROUNDOFF_32 * (4.0 * (1.0 - w) * absolute.abs() + w * terms))
            })
            .collect();
        let largest = slopes.iter().map(|(slope, _)| slope.abs()).fold(f64::MIN_POSITIVE, f64::max);
        // Equal images have no gradient: what is left is compared with that of a difference everywhere.
        let largest = largest.max(1.0 / slopes.len() as f64);
        for instructions in Instructions::available() {
            let (value, gradient) = evaluate(case, weight, instructions);
            let size = expected.max(1.0);
            value_row.case((value - expected).abs() / size, predicted / size);
            gradient_row.case_of(gradient.iter().zip(&slopes).map(|(&found, &(slope, predicted))| {
                ((f64::from(found) - slope).abs() / largest, predicted / largest)
            }));
        }
    }
}

const WEIGHTS: [f32; 3] = [0.0, 0.2, 1.0];

fn rows_of(extreme: &'static str, cases: &[Case], remark: &str) -> [Row; 2] {
    let mut rows = [
        Row::new("loss: value", extreme, VALUE),
        Row::new("loss: gradient", extreme, GRADIENT).remark(remark),
    ];
    let [values, gradients] = &mut rows;
    cases.iter().for_each(|case| add(values, gradients, case));
    rows
}

fn unmasked(sizes: &[(u32, u32)]) -> Vec<Case> {
    sizes.iter().flat_map(|&(width, height)| pairs(width, height)).map(|(a, b)| (a, b, None)).collect()
}

fn masked() -> Vec<Case> {
    let inside =
        |which: fn(usize) -> bool| Mask { width: 17, height: 13, inside: (0..221).map(which).collect() };
    [inside(|pixel| pixel == 100), inside(|pixel| pixel % 3 == 0), inside(|_| true)]
        .map(|mask| (texture(17, 13, 0.0), texture(17, 13, 0.4), Some(mask)))
        .into()
}

/// Renderings are not clamped: bright and negative values come from saturated harmonics.
fn bright() -> Vec<Case> {
    let scaled = |scale: f32| image(17, 13, |index| scale * (index as f32 * 0.37).sin());
    [10.0, 1e3, 1e6].map(|scale| (scaled(scale), texture(17, 13, 0.4), None)).into()
}

/// No pixel that counts, NaN, and bytes that must not depend on anything but the images.
fn exact_rows() -> Vec<Row> {
    let mut nothing =
        Row::new("loss: value, gradient", "no pixel counts", EXACT).remark("zero, with zero gradient");
    let mut broken = Row::new("loss: value", "a NaN in the rendering", EXACT)
        .remark("the loss is NaN, so that it is seen");
    let mut bytes = Row::new("loss: value, gradient", "instruction sets", EXACT).remark("the same bytes");
    let none = Mask { width: 17, height: 13, inside: vec![false; 221] };
    let (a, b) = (texture(17, 13, 0.0), texture(17, 13, 0.4));
    let mut with_nan = a.clone();
    with_nan.pixels[50] = f32::NAN;
    let widest = evaluate(&(a.clone(), b.clone(), None), 0.2, Instructions::detect());
    for instructions in Instructions::available() {
        let (value, gradient) = evaluate(&(a.clone(), b.clone(), Some(none.clone())), 0.2, instructions);
        nothing.exact(value == 0.0 && gradient.iter().all(|&slope| slope == 0.0));
        broken.exact(evaluate(&(with_nan.clone(), b.clone(), None), 0.2, instructions).0.is_nan());
        bytes.exact(evaluate(&(a.clone(), b.clone(), None), 0.2, instructions) == widest);
    }
    vec![nothing, broken, bytes]
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let mut rows = Vec::new();
    rows.extend(rows_of(
        "flat, black, equal and tiny images, 1×1 to 17×13, weights 0 to 1",
        &unmasked(&SMALL),
        "",
    ));
    rows.extend(rows_of("one column of 4096, one row of 8192 pixels", &unmasked(&LONG), ""));
    rows.extend(rows_of("masks of one pixel, a third, all", &masked(), ""));
    rows.extend(rows_of(
        "renderings of ±10 to ±1e6",
        &bright(),
        "variances are no small differences there any more",
    ));
    rows.extend(exact_rows());
    rows
}
