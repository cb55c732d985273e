//! The flow between two images, whole and in parts.

use super::*;
use crate::{
    simd::{Instructions, LANES, Plain, Simd as _},
    tracking::{
        flow::Flow,
        pair::{Frame, Level, Pyramid, match_pyramids},
        patches::{self, Guess, PatchField},
        planes::{PATCH, Planes},
        refine::{Smoothing, refine},
        texels::Texels,
    },
};

const QUALITIES: [Quality; 3] = [Quality::Draft, Quality::Balanced, Quality::Best];

/// Waves along several directions, whose value between the pixels is known; `[0, 1]`.
fn waves(x: f32, y: f32) -> [f32; 3] {
    let wave = |kx: f32, ky: f32, phase: f32| (kx * x + ky * y + phase).sin();
    [0.0f32, 1.3, 2.1].map(|phase| {
        0.5 + 0.15 * wave(0.41, 0.13, phase)
            + 0.15 * wave(-0.17, 0.37, 2.0 * phase)
            + 0.1 * wave(0.05, 0.07, 0.0)
    })
}

fn lanes(of: Plain) -> [f32; LANES] {
    let mut lanes = [0.0; LANES];
    of.store(&mut lanes);
    lanes
}

fn finest_level(image: &Image) -> Level<1> {
    Level::pyramid(Planes::luma_of(image, 0), &balanced()).swap_remove(0)
}

fn flow_between(first: &Image, second: &Image, quality: Quality) -> PairFlow {
    pair_flow(first, second, None, &TrackingSettings::preset(quality)).unwrap()
}

fn end_point_errors(flow: &DenseFlow, truth: impl Fn([f32; 2]) -> [f32; 2]) -> Vec<f32> {
    let width = flow.width as usize;
    let error = |(i, found): (usize, &[f32; 2])| {
        let exact = truth([(i % width) as f32 + 0.5, (i / width) as f32 + 0.5]);
        (found[0] - exact[0]).hypot(found[1] - exact[1])
    };
    flow.displacement.iter().enumerate().map(error).collect()
}

#[test]
fn frames_are_matched_at_the_size_that_the_settings_say() {
    for quality in QUALITIES {
        let settings = TrackingSettings::preset(quality);
        for (width, height) in [(1, 1), (8, 6), (400, 3), (401, 3), (5, 799), (801, 2), (3, 1601), (3203, 1)]
        {
            let frame = Frame::new(&Image::filled(width, height, [0.5; 3]), &settings);
            let found = (frame.width() as u32, frame.height() as u32);
            assert_eq!(settings.matched_size(width, height), found, "{quality:?} {width}x{height}");
        }
    }
    let draft = TrackingSettings::preset(Quality::Draft);
    for (side, matched) in [(160, 160), (320, 160), (640, 160), (1280, 320), (1920, 480), (3840, 480)] {
        assert_eq!(draft.matched_size(side, 9).0, matched, "{side}");
    }
}

#[test]
fn samples_agree_with_double_precision_and_clamp_outside() {
    let planes = Planes::luma_of(&render(13, 9, |x, y| waves(3.0 * x, 5.0 * y)), 0);
    let sloped = Planes::luma_of(&render(13, 9, |x, y| waves(2.0 * y, 4.0 * x)), 0);
    let texels = Texels::new(&planes, &sloped);
    let of = |planes: &Planes<1>, x: i64, y: i64| {
        f64::from(planes.row(0, y.clamp(0, 8) as usize)[x.clamp(0, 12) as usize])
    };
    let slope = |x: i64, y: i64| of(&sloped, x, y);
    let quantities = |x: i64, y: i64| {
        // The border replicates gradients too.
        let (x, y) = (x.clamp(0, 12), y.clamp(0, 8));
        let along_x = 0.5 * (slope(x + 1, y) - slope(x - 1, y));
        let along_y = 0.5 * (slope(x, y + 1) - slope(x, y - 1));
        [of(&planes, x, y), along_x, along_y]
    };
    for (x, y) in [(0.0f32, 0.0f32), (3.25, 4.75), (11.9, 8.0), (-1.0, 9.0), (13.0, -1.0), (6.5, 0.125)] {
        let (column, row) = (f64::from(x).floor(), f64::from(y).floor());
        let (fx, fy) = (f64::from(x) - column, f64::from(y) - row);
        let [sample] = texels.sample(Plain::splat(x), Plain::splat(y));
        let found = sample.map(lanes);
        for k in 0..3 {
            let at = |dx: i64, dy: i64| quantities(column as i64 + dx, row as i64 + dy)[k];
            let upper = (1.0 - fx) * at(0, 0) + fx * at(1, 0);
            let exact = (1.0 - fy) * upper + fy * ((1.0 - fx) * at(0, 1) + fx * at(1, 1));
            // Values up to 255 in f32: three interpolations round by 6e-8 each.
            for found in found[k] {
                assert!((f64::from(found) - exact).abs() < 1e-3, "{x} {y} {k}: {found} {exact}");
            }
        }
    }
    for far in [f32::MAX, f32::MIN, f32::INFINITY, f32::NEG_INFINITY, f32::NAN] {
        let [sample] = texels.sample(Plain::splat(far), Plain::splat(-far));
        assert!(sample.map(lanes).as_flattened().iter().all(|value| value.is_finite()));
    }
}

#[test]
fn descent_finds_a_known_shift_on_every_instruction_set() {
    let shift = [1.3f32, -0.6];
    let first = render(64, 48, waves);
    let second = render(64, 48, |x, y| waves(x - shift[0], y - shift[1]));
    let (first, second) = (Planes::luma_of(&first, 0), Planes::luma_of(&second, 0));
    let mut fields = Vec::new();
    for instructions in Instructions::available() {
        let mut field = PatchField::new(64, 48, 4);
        patches::search(instructions, &first, &second, &[], None, 16, &mut field);
        for (at, found) in field.displacement.iter().enumerate() {
            let (x, y) = (field.xs[at % field.columns], field.ys[at / field.columns]);
            if x < 4 || y < 4 || x + PATCH + 4 > 64 || y + PATCH + 4 > 48 {
                continue;
            }
            let error = (found[0] - shift[0]).hypot(found[1] - shift[1]);
            // Bilinear interpolation of waves of 15 pixels errs by 2 % of their amplitude, 0.05 px along their gradient; where a
            // patch holds less than a wave it determines the other direction less well.
            assert!(error < 0.08, "{} {x} {y}: {found:?}", instructions.set());
        }
        fields.push((instructions, field));
    }
    for pair in fields.windows(2) {
        for (a, b) in pair[0].1.displacement.iter().zip(&pair[1].1.displacement) {
            // The baseline rounds products before they are added; descent stops within a hundredth of a pixel.
            assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 0.05);
        }
    }
}

#[test]
fn seeds_reach_what_descent_cannot_and_not_a_number_is_no_seed() {
    let texture = Texture::new(31, 4.0);
    let first = Planes::luma_of(&render(80, 48, |x, y| texture.at(x, y)), 0);
    let second = Planes::luma_of(&render(80, 48, |x, y| texture.at(x - 25.0, y)), 0);
    let found = |seed: f32| {
        let mut flow = Flow::zeros(80, 48);
        flow.u.fill(seed);
        let seeds = Some(Guess { flow: &flow, scale: 1.0 });
        let mut field = PatchField::new(80, 48, 8);
        patches::search(Instructions::detect(), &first, &second, &[], seeds, 12, &mut field);
        assert!(field.displacement.iter().flatten().all(|value| value.is_finite()));
        let inside = |at: &usize| field.xs[at % field.columns] < 40;
        let right =
            (0..field.cost.len()).filter(inside).map(|at| (field.displacement[at][0] - 25.0).abs() < 0.2);
        fraction(right)
    };
    assert!(found(24.5) > 0.95);
    assert!(found(f32::NAN) < 0.2);
}

#[test]
fn refinement_finds_a_known_affine_field() {
    // The second image shows at A p + t what the first shows at p. Nothing rests: that would be smoothed more.
    let truth = |x: f32, y: f32| [2.8 + 0.02 * x - 0.01 * y, -2.5 + 0.015 * x + 0.01 * y];
    let back = |x: f32, y: f32| {
        // Solves (1 + G) p = q - t for the field's gradient G.
        let (a, b, c, d) = (1.02f32, -0.01, 0.015, 1.01);
        let (x, y, determinant) = (x - 2.8, y + 2.5, a * d - b * c);
        [(d * x - b * y) / determinant, (a * y - c * x) / determinant]
    };
    let first = finest_level(&render(72, 56, waves));
    let second = finest_level(&render(72, 56, |x, y| {
        let [x, y] = back(x, y);
        waves(x, y)
    }));
    let mut start = Flow::zeros(72, 56);
    for i in 0..72 * 56 {
        let [u, v] = truth((i % 72) as f32 + 0.5, (i / 72) as f32 + 0.5);
        let sign = if (i % 72 / 3 + i / 72 / 3) % 2 == 0 { 1.0 } else { -1.0 };
        (start.u[i], start.v[i]) = (u + 0.4 * sign, v - 0.3 * sign);
    }
    let smoothing = Smoothing::of(&balanced());
    let refined = refine(Instructions::detect(), &first, &second, start, None, smoothing);
    let inner = (0..72 * 56).filter(|i| (8..60).contains(&(i % 72)) && (8..46).contains(&(i / 72)));
    let errors = inner.map(|i| {
        let [u, v] = truth((i % 72) as f32 + 0.5, (i / 72) as f32 + 0.5);
        (refined.u[i] - u).hypot(refined.v[i] - v)
    });
    // Half a pixel off at the start, as neighbouring patches are: to and fro. The sweeps are too few to forget all of it, let
    // alone to move a field as a whole; bilinear interpolation of the waves errs by a few hundredths.
    let error = quantile(errors.collect(), 0.9);
    assert!(error < 0.05, "{error}");
}

#[test]
fn every_preset_follows_shifts_and_jumps() {
    let texture = Texture::new(32, 6.0);
    let first = render(192, 108, |x, y| texture.at(x, y));
    for (shift, bound) in [([2.25f32, -1.5], 0.15), ([52.0, 6.5], 0.3)] {
        let second = render(192, 108, |x, y| texture.at(x - shift[0], y - shift[1]));
        for quality in QUALITIES {
            let flow = flow_between(&first, &second, quality);
            let seen = |i: &usize| {
                (4.0..188.0 - shift[0]).contains(&((i % 192) as f32))
                    && (8.0..100.0).contains(&((i / 192) as f32))
            };
            let errors = end_point_errors(&flow.forward, |_| shift);
            let errors: Vec<f32> = (0..errors.len()).filter(seen).map(|i| errors[i]).collect();
            let error = quantile(errors, 0.9);
            assert!(error < bound, "{quality:?} {shift:?}: {error}");
        }
    }
}

#[test]
fn identical_images_have_exactly_zero_flow() {
    let texture = Texture::new(33, 5.0);
    for image in [render(96, 64, |x, y| texture.at(x, y)), Arc::new(Image::filled(40, 24, [0.3; 3]))] {
        for quality in QUALITIES {
            let PairFlow { forward, backward } = flow_between(&image, &image, quality);
            assert!(forward.displacement.iter().chain(&backward.displacement).all(|d| *d == [0.0; 2]));
        }
    }
}

#[test]
fn exchanging_the_images_exchanges_the_flows() {
    let (first, second) = (square_scene([24.0, 20.0], 40.0), square_scene([60.0, 30.0], 40.0));
    let (there, back) =
        (flow_between(&first, &second, Quality::Balanced), flow_between(&second, &first, Quality::Balanced));
    assert_eq!((there.forward, there.backward), (back.backward, back.forward));
}

#[test]
fn an_initial_flow_leads_where_no_search_goes() {
    let texture = Texture::new(34, 4.0);
    let first = render(160, 64, |x, y| texture.at(x, y));
    let second = render(160, 64, |x, y| texture.at(x - 70.0, y));
    for colour in [false, true] {
        let settings = TrackingSettings { search_radius: 0.0, colour, ..balanced() };
        let shifted = |by: f32| DenseFlow { width: 160, height: 64, displacement: vec![[by, 0.0]; 160 * 64] };
        let initial = PairFlow { forward: shifted(69.0), backward: shifted(-69.0) };
        let near = |flow: &PairFlow| {
            let errors = end_point_errors(&flow.forward, |_| [70.0, 0.0]);
            fraction((0..errors.len()).filter(|i| i % 160 < 80).map(|i| errors[i] < 0.5))
        };
        assert!(near(&pair_flow(&first, &second, Some(&initial), &settings).unwrap()) > 0.9);
        assert!(near(&pair_flow(&first, &second, None, &settings).unwrap()) < 0.5);
    }
}

#[test]
fn images_of_different_sizes_are_refused_by_name() {
    let (first, second) = (Image::filled(8, 6, [0.5; 3]), Image::filled(8, 7, [0.5; 3]));
    let error = pair_flow(&first, &second, None, &balanced()).unwrap_err();
    assert_eq!(error, PairFlowError::SizesDiffer { first: (8, 6), second: (8, 7) });
    assert!(error.to_string().contains("8 x 7"));
    let initial = flow_between(&second, &second, Quality::Draft);
    assert!(pair_flow(&first, &first, Some(&initial), &balanced()).is_err());
    let mut short = flow_between(&first, &first, Quality::Draft);
    short.backward.displacement.pop();
    let error = pair_flow(&first, &first, Some(&short), &balanced()).unwrap_err();
    assert_eq!(error, PairFlowError::Displacements { width: 8, height: 6, displacements: 47 });
}

#[test]
fn whatever_the_images_hold_the_flow_is_finite() {
    let texture = Texture::new(35, 5.0);
    let broken = |x: f32, y: f32| {
        let value = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30, 1e-40];
        [value[(x as usize + y as usize) % 6], value[x as usize % 6], 0.5]
    };
    for (width, height) in [(0, 0), (1, 1), (8, 8), (3, 5), (1, 40), (200, 2), (65, 47)] {
        let grey = Image::filled(width, height, [0.5; 3]);
        let images = [
            render(width, height, |x, y| texture.at(x, y)),
            render(width, height, |x, y| texture.at(width as f32 - x, height as f32 - y)),
            render(width, height, broken),
            noisy(&grey, 0.2, 1),
            Arc::new(Image::filled(width, height, [0.0; 3])),
            Arc::new(grey),
        ];
        for quality in QUALITIES {
            for second in &images {
                let flow = flow_between(&images[0], second, quality);
                let all = || flow.forward.displacement.iter().chain(&flow.backward.displacement);
                assert_eq!(all().count(), 2 * images[0].pixel_count());
                if images[0].pixel_count() > 0 {
                    assert_raw_flow_is_finite(&images[0], second, &TrackingSettings::preset(quality));
                }
            }
        }
    }
}

/// Of the matcher itself: `pair_flow` replaces what is not a number.
fn assert_raw_flow_is_finite(first: &Image, second: &Image, settings: &TrackingSettings) {
    let (a, b) = (Pyramid::new(first, settings), Pyramid::new(second, settings));
    for instructions in Instructions::available() {
        let (forward, backward) = match_pyramids(instructions, &a, &b, None, settings);
        let size = (first.width, first.height);
        for axis in [&forward.u, &forward.v, &backward.u, &backward.v] {
            assert!(axis.iter().all(|value| value.is_finite()), "{size:?}, {settings:?}");
        }
    }
}

#[test]
fn settings_at_the_ends_of_their_ranges_do_no_harm() {
    // An edge of 45 degrees: all gradients are alike, so the data alone leave equations without a solution.
    let edge = |shift: f32| render(60, 44, |x, y| if x + y + shift < 52.0 { [0.0; 3] } else { [1.0; 3] });
    let (first, second) = (edge(0.0), edge(1.5));
    for (key, values) in [
        ("smoothness", [0.0, 1e6]),
        ("smoothing_window", [0.0, 10.0]),
        ("smoothing_iterations", [0.0, 1000.0]),
        ("smoothing_warps", [0.0, 100.0]),
        ("patch_stride", [1.0, 8.0]),
        ("patch_iterations", [1.0, 1000.0]),
        ("patch_side", [0.0, 65_536.0]),
        ("search_side", [16.0, 256.0]),
        ("search_radius", [0.0, 1.0]),
        ("max_side", [16.0, 65_536.0]),
        ("full_side", [16.0, 65_536.0]),
        ("quarter_side", [16.0, 65_536.0]),
    ] {
        for value in values {
            let mut settings = serde_json::to_value(balanced()).unwrap();
            settings[key] = match settings[key].is_f64() {
                true => value.into(),
                false => (value as u32).into(),
            };
            let settings: TrackingSettings = serde_json::from_value(settings).unwrap();
            assert_raw_flow_is_finite(&first, &second, &settings);
        }
    }
}

#[test]
fn another_exposure_leaves_the_flow_as_it_is() {
    let texture = Texture::new(36, 6.0);
    let dark = |gain: f32, shift: f32| {
        render(160, 90, |x, y| texture.at(x - shift, y).map(|value| gain * 0.4 * value))
    };
    let flow = flow_between(&dark(1.0, 0.0), &dark(2.0, 3.5), Quality::Balanced);
    let errors = end_point_errors(&flow.forward, |_| [3.5, 0.0]);
    let inner = (0..errors.len()).filter(|i| (8..148).contains(&(i % 160)) && (8..82).contains(&(i / 160)));
    let error = quantile(inner.map(|i| errors[i]).collect(), 0.9);
    assert!(error < 0.15, "{error}");
}

#[test]
fn bytes_do_not_depend_on_threads_and_hardly_on_instructions() {
    let (first, second) = (square_scene([24.0, 20.0], 40.0), square_scene([70.0, 40.5], 40.0));
    for colour in [false, true] {
        let settings = TrackingSettings { colour, ..balanced() };
        let in_pool = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| pair_flow(&first, &second, None, &settings).unwrap())
        };
        assert_eq!(in_pool(1), in_pool(3));

        let (a, b) = (Pyramid::new(&first, &settings), Pyramid::new(&second, &settings));
        let flows: Vec<_> = Instructions::available()
            .map(|instructions| (instructions.set(), match_pyramids(instructions, &a, &b, None, &settings)))
            .collect();
        for pair in flows.windows(2) {
            let ((set, flow), (other_set, other)) = (&pair[0], &pair[1]);
            if *other_set != crate::simd::InstructionSet::Baseline {
                assert_eq!(flow, other, "{set} {other_set}");
                continue;
            }
            // Rounding may tip the choice between candidates, so single pixels may differ by anything.
            let alike = |i: usize| (flow.0.u[i] - other.0.u[i]).hypot(flow.0.v[i] - other.0.v[i]) < 0.02;
            assert!(fraction((0..flow.0.u.len()).map(alike)) > 0.95);
        }
    }
}
