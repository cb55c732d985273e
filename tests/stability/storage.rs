//! What storing loses: tracks as fixed-point blobs, frames as differences of bit patterns. Neither uses half floats.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use splat::{
    formats::track_blob::{decode, encode},
    gaussians::{
        Gaussians,
        delta::{apply, encode as encode_delta},
    },
    tracking::TrackField,
};

use crate::{
    reference::ROUNDOFF_32,
    row::{Bar, EXACT, Row},
    scenes::blobs,
};

const POSITION: Bar =
    Bar { unit: "pixel", factor: 1.0, why: "half a step of 1/64 pixel, and 2⁻²⁴ of the position" };
const DEVIATION: Bar =
    Bar { unit: "of the deviation", factor: 1.0, why: "half a step of nine significant bits" };

/// A field whose pixels have moved by up to `reach` pixels, with deviations down to `least`.
fn field(width: u32, height: u32, reach: f32, least: f32, seed: u64) -> TrackField {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let pixels = (width * height) as usize;
    let mut field = TrackField {
        width,
        height,
        positions: Vec::new(),
        visible: (0..pixels).map(|pixel| pixel % 5 != 0).collect(),
        sigma: (0..pixels).map(|_| least * 10.0_f32.powf(random.random_range(0.0..1.0))).collect(),
    };
    for pixel in 0..pixels {
        let centre = [(pixel % width as usize) as f32 + 0.5, (pixel / width as usize) as f32 + 0.5];
        field.positions.push(centre.map(|c| c + reach * random.random_range(-1.0..=1.0_f32)));
    }
    field
}

fn track_rows() -> Vec<Row> {
    let mut positions =
        Row::new("tracks: position", "displacement 0 to twice the width, 1×1 to 8192×1 pixels", POSITION);
    let mut deviations = Row::new("tracks: deviation", "1e-37 to 6e4 pixels", DEVIATION);
    let cases = [
        (1, 1, 0.0, 1e-37),
        (1, 1, 2.0, 1e-20),
        (40, 30, 80.0, 1e-6),
        (640, 3, 1280.0, 1e-2),
        (8192, 1, 16384.0, 1.0),
        (1, 4096, 1e5, 6e3),
    ];
    for (seed, &(width, height, reach, least)) in cases.iter().enumerate() {
        let field = field(width, height, reach, least, seed as u64);
        let decoded = decode(&encode(&field)).unwrap();
        let found = decoded.positions.iter().flatten().zip(field.positions.iter().flatten());
        positions.case_of(found.map(|(&found, &given)| {
            let (found, given) = (f64::from(found), f64::from(given));
            ((found - given).abs(), 0.5 / 64.0 + ROUNDOFF_32 * given.abs())
        }));
        deviations.case_of(decoded.sigma.iter().zip(&field.sigma).map(|(&found, &given)| {
            let (found, given) = (f64::from(found), f64::from(given));
            ((found - given).abs() / given, 1.0 / 512.0)
        }));
    }
    let mut hopeless = Row::new("tracks", "NaN, infinite and negative values in every field", EXACT)
        .remark("the pixel becomes invisible, at rest, with the largest deviation");
    let mut far = Row::new("tracks: position", "displacement of 2e5 to 3e38 pixels", EXACT)
        .remark("saturates 131 072 pixels away");
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for spoil in 0..3 {
            let mut field = field(3, 2, 1.0, 0.1, 9);
            field.visible.fill(true);
            if spoil < 2 {
                field.positions[4][spoil] = bad
            } else {
                field.sigma[4] = -bad.abs()
            }
            let decoded = decode(&encode(&field)).unwrap();
            let is_gone =
                !decoded.visible[4] && decoded.positions[4] == [1.5, 1.5] && decoded.sigma[4] == 65_536.0;
            hopeless.exact(is_gone && decoded.visible[..4].iter().all(|&visible| visible));
        }
    }
    for reach in [2e5, 1e10, 3e38] {
        let mut field = field(3, 2, 0.0, 0.1, 10);
        field.positions[0] = [reach, -reach];
        let decoded = decode(&encode(&field)).unwrap();
        far.exact(decoded.positions[0] == [131_072.5, -131_071.5]);
    }
    vec![positions, deviations, far, hopeless]
}

fn bits(gaussians: &Gaussians) -> Vec<u32> {
    let Gaussians { means, rotations, log_scales, logit_opacities, sh, .. } = gaussians;
    let all =
        [means.as_flattened(), rotations.as_flattened(), log_scales.as_flattened(), logit_opacities, sh];
    all.concat().iter().map(|value| value.to_bits()).collect()
}

fn delta_row() -> Row {
    let mut row = Row::new(
        "deltas",
        "every bit pattern: NaN, infinity, −0, subnormals; 0, 1 and 3000 Gaussians",
        EXACT,
    )
    .remark("bit for bit");
    let mut random = ChaCha8Rng::seed_from_u64(11);
    for count in [0, 1, 3000] {
        let model = blobs(count, 3);
        let mut frame = model.clone();
        for mean in &mut frame.means {
            *mean = std::array::from_fn(|_| f32::from_bits(random.random()));
        }
        for (index, value) in frame.logit_opacities.iter_mut().enumerate() {
            *value = [f32::NAN, f32::INFINITY, -0.0, f32::from_bits(1), *value][index % 5];
        }
        let decoded = apply(&model, &[7; 32], &encode_delta(&model, &[7; 32], &frame)).unwrap();
        row.exact(bits(&decoded) == bits(&frame));
    }
    row
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    track_rows().into_iter().chain([delta_row()]).collect()
}
