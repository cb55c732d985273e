#![allow(clippy::unwrap_used, reason = "tests")]

use super::{histogram::Histogram, *};
use crate::tracking::TrackField;

/// Key-frame pixels in one row, moved by `shifts` along x.
fn row(shifts: &[f32], visible: &[bool], sigma: &[f32]) -> TrackField {
    TrackField {
        width: shifts.len() as u32,
        height: 1,
        positions: shifts.iter().enumerate().map(|(i, shift)| [i as f32 + 0.5 + shift, 0.5]).collect(),
        visible: visible.to_vec(),
        sigma: sigma.to_vec(),
    }
}

fn near(a: Option<f64>, b: f64, relative: f64) -> bool {
    a.is_some_and(|a| (a - b).abs() <= relative * b.abs())
}

/// Half of the widest bin.
const BIN: f64 = 1.0 / 1024.0;

#[test]
fn errors_and_visibility_are_those_counted_by_hand() {
    let tracks = row(
        &[1.0, 2.0, 3.0, 4.0, 100.0, 7.0],
        &[true, true, false, true, true, true],
        &[1.0, 1.0, 1.0, 2.0, 1.0, 1.0],
    );
    let exact = row(&[0.0; 6], &[true, true, true, false, true, true], &[0.1; 6]);
    let valid = [true, true, true, true, true, false];
    let moving = [false, false, true, true, true, true];
    let mut scores = FieldScores::default();
    scores.add(&tracks, &exact, &valid, &moving);
    let report = scores.report();

    // Truly visible and known: errors 1, 2, 3, 100.
    let all = report.all.endpoint.unwrap();
    assert_eq!((all.pixels, all.mean), (4, 26.5));
    assert!(near(Some(all.median), 2.0, BIN) && near(Some(all.p90), 100.0, BIN), "{all:?}");
    assert_eq!(report.moving.endpoint.unwrap().mean, 51.5);
    assert_eq!(report.still.endpoint.unwrap().mean, 1.5);

    // Rightly visible 0, 1, 4; wrongly 3; missed 2.
    let seen = report.all.visibility;
    assert_eq!((seen.precision, seen.recall, seen.iou), (Some(0.75), Some(0.75), Some(0.6)));
    let still = report.still.visibility;
    assert_eq!((still.precision, still.recall, still.iou), (Some(1.0), Some(1.0), Some(1.0)));

    // Errors along y are 0; along x 1 and 2 are within one and two standard deviations of 1, 100 is not.
    assert_eq!(report.all.within, Some([4.0 / 6.0, 5.0 / 6.0]));
}

#[test]
fn each_frame_has_its_own_errors() {
    // Seen, seen and moving, hidden, unknown.
    let exact = row(&[0.0; 4], &[true, true, false, true], &[0.1; 4]);
    let (valid, moving) = ([true, true, true, false], [false, true, true, true]);
    let mut scores = FieldScores::default();
    let mut frame =
        |shifts: &[f32]| scores.add(&row(shifts, &[false; 4], &[1.0; 4]), &exact, &valid, &moving);
    let (first, second) = (frame(&[1.0, 2.5, 9.0, 9.0]), frame(&[3.0, 0.5, 9.0, 9.0]));
    let sum = |count, sum| ErrorSum { count, sum };
    assert_eq!(first, FrameErrors { all: sum(2, 3.5), moving: sum(1, 2.5) });
    assert_eq!(second, FrameErrors { all: sum(2, 3.5), moving: sum(1, 0.5) });
    let mut both = first;
    both.merge(second);
    assert_eq!((both.all.mean(), both.moving.mean()), (Some(1.75), Some(1.5)));
    assert_eq!(scores.report().all.endpoint.unwrap().mean, 1.75);
    assert_eq!(ErrorSum::default().mean(), None);
}

#[test]
fn nothing_has_no_figures() {
    let report = FieldScores::default().report();
    assert_eq!(report.all.endpoint, None);
    assert_eq!(report.all.within, None);
    assert!(report.all.deciles.is_empty());
    assert_eq!(report.all.visibility, Visibility { precision: None, recall: None, iou: None });
    let mut hidden = FieldScores::default();
    let field = row(&[0.0], &[false], &[1.0]);
    hidden.add(&field, &field, &[true], &[false]);
    assert_eq!(hidden.report(), report);
    hidden.add(&row(&[], &[], &[]), &row(&[], &[], &[]), &[], &[]);
    assert_eq!(hidden.report(), report);
}

#[test]
fn nothing_is_counted_beyond_the_shortest_array() {
    let whole = || row(&[1.0, 2.0, 3.0], &[true; 3], &[0.5; 3]);
    let mut expected = FieldScores::default();
    expected.add(&row(&[1.0], &[true], &[0.5]), &row(&[0.0], &[true], &[0.5]), &[true], &[false]);
    let exact = || row(&[0.0; 3], &[true; 3], &[0.5; 3]);
    for short in 0..7 {
        let (mut tracks, mut truth, mut valid, mut moving) =
            (whole(), exact(), vec![true; 3], vec![false; 3]);
        match short {
            0 => tracks.positions.truncate(1),
            1 => tracks.visible.truncate(1),
            2 => tracks.sigma.truncate(1),
            3 => truth.positions.truncate(1),
            4 => truth.visible.truncate(1),
            5 => valid.truncate(1),
            _ => moving.truncate(1),
        }
        let mut scores = FieldScores::default();
        scores.add(&tracks, &truth, &valid, &moving);
        assert_eq!(scores.report(), expected.report(), "{short}");
    }
    // The truth's own standard deviation is not asked for.
    let mut scores = FieldScores::default();
    scores.add(&row(&[1.0], &[true], &[0.5]), &row(&[0.0], &[true], &[]), &[true], &[false]);
    assert_eq!(scores.report(), expected.report());
}

#[test]
fn a_sigma_of_negative_zero_is_zero() {
    let mut calibration = Calibration::default();
    calibration.add([0.0, 1.0], std::hint::black_box(-0.0));
    assert_eq!(calibration.overall(), Some([0.5, 0.5]));
    assert!(calibration.deciles().iter().all(|decile| decile.from == 0.0));
}

#[test]
fn what_is_not_a_number_counts_as_the_diagonal_and_is_never_within() {
    let exact = row(&[0.0; 3], &[true; 3], &[0.1; 3]);
    let tracks = row(&[f32::NAN, f32::INFINITY, 0.0], &[true; 3], &[1.0, f32::INFINITY, f32::NAN]);
    let mut scores = FieldScores::default();
    scores.add(&tracks, &exact, &[true; 3], &[false; 3]);
    let report = scores.report().all;
    let diagonal = f64::from(3.0_f32.hypot(1.0));
    assert!(near(Some(report.endpoint.unwrap().mean), 2.0 * diagonal / 3.0, 1e-12));
    // The y axes: 0 within 1; 0 within 0, twice. The x axes: only the last.
    assert_eq!(report.within, Some([4.0 / 6.0, 4.0 / 6.0]));
}

#[test]
fn merged_counts_are_those_of_one_pass() {
    let exact = row(&[0.0; 4], &[true, true, false, true], &[0.1; 4]);
    let first = row(&[0.3, 2.0, 1.0, 0.0], &[true; 4], &[0.5, 1.0, 2.0, 0.2]);
    let second = row(&[1.3, 0.2, 1.0, 5.0], &[false, true, true, true], &[0.5, 1.5, 2.0, 9.0]);
    let moving = [true, false, true, false];
    let (mut one, mut left, mut right) =
        (FieldScores::default(), FieldScores::default(), FieldScores::default());
    for (part, tracks) in [(&mut left, &first), (&mut right, &second)] {
        one.add(tracks, &exact, &[true; 4], &moving);
        part.add(tracks, &exact, &[true; 4], &moving);
    }
    left.merge(&right);
    assert_eq!(left.report(), one.report());
}

#[test]
fn quantiles_have_the_resolution_of_the_bins() {
    let mut histogram = Histogram::default();
    assert_eq!((histogram.mean(), histogram.quantile(0.5)), (None, None));
    for i in 1..=1000_u32 {
        histogram.add(i as f32 / 7.0);
    }
    assert!(near(histogram.mean(), 500.5 / 7.0, 1e-6));
    for (fraction, expected) in [(0.5, 500.0), (0.9, 900.0), (1.0, 1000.0), (0.0, 1.0)] {
        assert!(near(histogram.quantile(fraction), expected / 7.0, BIN), "{fraction}");
    }
    let mut extremes = Histogram::default();
    for value in [0.0, -0.0, f32::MIN_POSITIVE / 4.0, f32::MAX] {
        extremes.add(value);
    }
    assert_eq!(extremes.quantile(0.5), Some(0.0));
    assert!(near(extremes.quantile(1.0), f64::from(f32::MAX), 2.0 * BIN));
}

#[test]
fn deciles_are_in_order_of_sigma_and_of_equal_size() {
    let mut calibration = Calibration::default();
    assert_eq!(calibration.overall(), None);
    // Sigma 1 to 20: each decile holds two of them. Errors of 0 and 1.5 sigma where sigma is odd, of 3 else.
    for sigma in 1..=20_u8 {
        let sigma = f32::from(sigma);
        let error = if sigma % 2.0 == 1.0 { [0.0, 1.5 * sigma] } else { [-3.0 * sigma; 2] };
        calibration.add(error, sigma);
    }
    let deciles = calibration.deciles();
    assert_eq!(deciles.len(), 10);
    for (i, decile) in deciles.iter().enumerate() {
        let first = (2 * i + 1) as f64;
        assert!(decile.from <= first && decile.to > first + 1.0 && decile.to < first + 2.0, "{decile:?}");
        assert!((decile.within_1 - 0.25).abs() < 1e-9 && (decile.within_2 - 0.5).abs() < 1e-9, "{decile:?}");
    }
    assert_eq!(calibration.overall(), Some([0.25, 0.5]));
}

#[test]
fn equal_sigmas_are_shared_among_the_deciles() {
    let mut calibration = Calibration::default();
    for i in 0..7 {
        calibration.add([if i < 3 { 0.5 } else { 2.5 }, 1.5], 1.0);
    }
    let deciles = calibration.deciles();
    assert_eq!(deciles.len(), 10);
    for decile in deciles {
        assert!((decile.within_1 - 3.0 / 14.0).abs() < 1e-9, "{decile:?}");
        assert!((decile.within_2 - 10.0 / 14.0).abs() < 1e-9, "{decile:?}");
    }
}

/// A 128×64 field that moves every pixel by `shift`: distances double along x and quadruple along y.
fn shifted(shift: [f32; 2], visible: bool) -> TrackField {
    let (width, height) = (128, 64);
    let centres = (0..height).flat_map(|y| (0..width).map(move |x| [x as f32 + 0.5, y as f32 + 0.5]));
    let pixels = (width * height) as usize;
    TrackField {
        width,
        height,
        positions: centres.map(|at| [at[0] + shift[0], at[1] + shift[1]]).collect(),
        visible: vec![visible; pixels],
        sigma: vec![1.0; pixels],
    }
}

fn point(exact: [f64; 2], visible: bool) -> PointQuery {
    PointQuery { at_key: [20.25, 30.75], exact, visible }
}

#[test]
fn point_scores_are_those_counted_by_hand() {
    let field = shifted([1.0, 0.0], true);
    let mut scores = PointScores::default();
    assert_eq!(scores.report().delta_average, None);
    assert_eq!(scores.report().average_jaccard, None);
    // 0 px, 3 px (1.5 columns), 12 px (3 rows) away, and a hidden one that is called visible.
    let at = [21.25, 30.75];
    let points = [
        point(at, true),
        point([at[0] + 1.5, at[1]], true),
        point([at[0], at[1] - 3.0], true),
        point([0.0, 0.0], false),
    ];
    scores.add(&field, points);
    let report = scores.report();
    assert_eq!(report.points, 4);
    // Found within 1, 2, 4, 8, 16: 1, 1, 2, 2, 3 of three.
    assert!(near(report.delta_average, 9.0 / 15.0, 1e-12));
    // Positives 3; false positives 4 minus found: 1/6, 1/6, 2/5, 2/5, 3/4.
    assert!(near(report.average_jaccard, (2.0 / 6.0 + 4.0 / 5.0 + 0.75) / 5.0, 1e-12));
    assert_eq!(report.occlusion_accuracy, Some(0.75));
}

#[test]
fn points_called_hidden_are_found_but_no_true_positives() {
    let mut scores = PointScores::default();
    scores.add(&shifted([0.0, 0.0], false), [point([20.25, 30.75], true), point([0.0, 0.0], false)]);
    let report = scores.report();
    assert_eq!((report.delta_average, report.average_jaccard), (Some(1.0), Some(0.0)));
    assert_eq!(report.occlusion_accuracy, Some(0.5));
    let half = PointReport { points: 3, delta_average: Some(0.5), average_jaccard: None, ..report };
    let mean = PointReport::mean(&[report, half]).unwrap();
    assert_eq!((mean.points, mean.delta_average, mean.average_jaccard), (5, Some(0.75), Some(0.0)));
    assert_eq!(PointReport::mean(&[]), None);
}

#[test]
fn points_outside_and_broken_fields_are_no_finds() {
    let mut scores = PointScores::default();
    let field = shifted([f32::NAN, 0.0], true);
    let outside = PointQuery { at_key: [128.0, 3.0], ..point([0.0; 2], true) };
    let not_a_place = PointQuery { at_key: [f64::NAN, 3.0], ..point([0.0; 2], true) };
    scores.add(&field, [point([20.0, 30.0], true), outside, not_a_place]);
    let report = scores.report();
    assert_eq!((report.points, report.delta_average, report.average_jaccard), (1, Some(0.0), Some(0.0)));
}

#[test]
fn interpolation_is_bilinear_between_pixel_centres_and_constant_beyond() {
    let mut field = shifted([0.0, 0.0], true);
    field.positions[5 * 128 + 8][0] += 4.0;
    field.visible[5 * 128 + 8] = false;
    assert_eq!(interpolated(&field, [8.5, 5.5]), Some(([12.5, 5.5], false)));
    assert_eq!(interpolated(&field, [8.25, 5.0]), Some(([8.25 + 4.0 * 0.75 * 0.5, 5.0], false)));
    assert_eq!(interpolated(&field, [7.75, 5.5]), Some(([7.75 + 4.0 * 0.25, 5.5], true)));
    assert_eq!(interpolated(&field, [0.0, 0.25]), Some(([0.0, 0.25], true)));
    assert_eq!(interpolated(&shifted([2.0, 1.0], true), [127.9, 63.9]), Some(([129.9, 64.9], true)));
}
