#![allow(clippy::unwrap_used, reason = "tests")]

use super::{
    super::{SIGMA_FLOOR, tests::Npz},
    *,
};
use crate::tracking::TrackField;

fn read(npz: Npz, size: (u32, u32)) -> Result<Vec<TrackField>, String> {
    let (_folder, path) = npz.finish();
    let tracks = open_tracks(&path, size).map_err(|error| error.to_string())?;
    assert!(tracks.field(tracks.count()).is_none());
    Ok(tracks.fields().collect())
}

/// Whether fields agree but for rounding.
fn assert_close(field: &TrackField, expected: impl Fn(f32, f32) -> [f32; 2]) {
    for (index, position) in field.positions.iter().enumerate() {
        let (x, y) = (index as u32 % field.width, index as u32 / field.width);
        let wanted = expected(x as f32 + 0.5, y as f32 + 0.5);
        let off = (position[0] - wanted[0]).abs().max((position[1] - wanted[1]).abs());
        assert!(off < 1e-4, "{x}, {y}: {position:?}, expected {wanted:?}");
    }
}

/// Points of the key frame in CoTracker's pixels, and where they are two frames on.
fn cotracker_npz(points: &[[f32; 2]], batch: bool, moved: impl Fn([f32; 2]) -> [f32; 2]) -> Npz {
    let later = points.iter().map(|&point| moved(point));
    let tracks: Vec<f32> = points.iter().copied().chain(later.clone()).chain(later).flatten().collect();
    let count = points.len() as u64;
    let shape = if batch { vec![1, 3, count, 2] } else { vec![3, count, 2] };
    let visible: Vec<bool> = (0..3 * points.len()).map(|index| index % points.len() != 1).collect();
    Npz::new().array("pred_tracks", &shape, &tracks).array(
        "pred_visibility",
        &shape[..shape.len() - 1],
        &visible,
    )
}

#[test]
fn own_arrays_are_read_as_ever() {
    let positions = [0.5, 0.5, 1.5, 0.5, 3.25, 4.5, -1.0, 0.125];
    let npz =
        || Npz::new().array("tracks", &[2, 1, 2, 2], &positions).array("visible", &[2, 1, 2], &[true; 4]);
    let fields = read(npz(), (2, 1)).unwrap();
    assert_eq!(fields[0].positions, [[3.25, 4.5], [-1.0, 0.125]]);
    let (_folder, path) = npz().finish();
    assert_eq!(fields, super::super::read_track_npz(&path).unwrap());
}

#[test]
fn dot_counts_from_pixel_centres() {
    // 3 x 2 pixels: index (x, y) is at (x + 0.5, y + 0.5); the second frame is half a pixel further, one is hidden.
    let entry = |x: f32, y: f32, step: f32, seen: f32| [x + step, y - step, seen];
    let frame = |step: f32, hidden: f32| -> Vec<f32> {
        (0..6)
            .flat_map(|i| entry((i % 3) as f32, (i / 3) as f32, step, if i == 4 { hidden } else { 1.0 }))
            .collect()
    };
    let values = [frame(0.0, 1.0), frame(0.5, 0.0)].concat();
    for shape in [&[2, 2, 3, 3][..], &[1, 2, 2, 3, 3]] {
        let fields = read(Npz::new().array("tracks", shape, &values), (3, 2)).unwrap();
        assert_eq!(fields.len(), 1);
        assert_eq!((fields[0].width, fields[0].height), (3, 2));
        assert_close(&fields[0], |x, y| [x + 0.5, y - 0.5]);
        assert_eq!(fields[0].visible, [true, true, true, true, false, true]);
        assert!(fields[0].sigma.iter().all(|&sigma| (sigma - DEFAULT_SIGMA).abs() < 1e-5));
    }
}

#[test]
fn dot_at_its_own_resolution_is_stretched_over_the_image() {
    // 4 x 4 for an image of 8 x 12: a step of one pixel right and one down there is two and three here.
    let later = (0..16).flat_map(|i| [(i % 4) as f32 + 1.0, (i / 4) as f32 + 1.0, 1.0]);
    let values: Vec<f32> = vec![0.0; 48].into_iter().chain(later).collect();
    let field = read(Npz::new().array("tracks", &[2, 4, 4, 3], &values), (8, 12)).unwrap().remove(0);
    assert_eq!((field.width, field.height), (8, 12));
    assert_close(&field, |x, y| [x + 2.0, y + 3.0]);
    let stretched = 3.0 * DEFAULT_SIGMA - 1e-4..3.0 * DEFAULT_SIGMA + 0.1;
    assert!(field.sigma.iter().all(|sigma| stretched.contains(sigma)));
}

#[test]
fn cotrackers_dense_points_come_in_any_order() {
    // CoTracker's dense mode tracks interleaved grids: offset by offset.
    let (width, height) = (6, 4);
    let mut points = Vec::new();
    for offset in 0..4 {
        for y in (offset / 2..height).step_by(2) {
            for x in (offset % 2..width).step_by(2) {
                points.push([x as f32, y as f32]);
            }
        }
    }
    for batch in [true, false] {
        let npz = cotracker_npz(&points, batch, |[x, y]| [1.1 * x + 0.25, y - 0.5]);
        let fields = read(npz, (6, 4)).unwrap();
        assert_eq!(fields.len(), 2);
        // In pixels from the corner: x' = 1.1 (x - 0.5) + 0.25 + 0.5.
        assert_close(&fields[1], |x, y| [1.1 * (x - 0.5) + 0.75, y - 0.5]);
        // The second point of the file is index (2, 0).
        let hidden: Vec<usize> = (0..24).filter(|&index| !fields[0].visible[index]).collect();
        assert_eq!(hidden, [2]);
        assert!(fields[0].sigma.iter().all(|&sigma| (sigma - DEFAULT_SIGMA).abs() < 1e-4));
    }
}

#[test]
fn sparse_grids_are_interpolated_with_growing_doubt() {
    // Every fourth pixel of 13 x 9, exactly on columns 0, 4, 8, 12 and rows 0, 4, 8.
    let points: Vec<[f32; 2]> = (0..12).map(|i| [(i % 4) as f32 * 4.0, (i / 4) as f32 * 4.0]).collect();
    let affine = |[x, y]: [f32; 2]| [x + 0.02 * y + 1.0, y - 0.01 * x];
    let npz = cotracker_npz(&points, true, affine);
    let field = read(npz, (13, 9)).unwrap().remove(0);
    // Bilinear interpolation reproduces affine motion.
    assert_close(&field, |x, y| {
        let [x, y] = affine([x - 0.5, y - 0.5]);
        [x + 0.5, y + 0.5]
    });
    let sigma = |x: usize, y: usize| field.sigma[y * 13 + x];
    assert!((sigma(4, 4) - DEFAULT_SIGMA).abs() < 1e-4);
    assert!(sigma(4, 4) < sigma(5, 4) && sigma(5, 4) < sigma(6, 4) && sigma(6, 4) < sigma(6, 6));
    // The point at (4, 0) is hidden: so is what lies next to it, not what lies elsewhere.
    assert!(!field.visible[4] && !field.visible[5] && field.visible[8] && field.visible[6 * 13 + 6]);

    // A motion boundary between two points is doubt.
    let torn = cotracker_npz(&points, true, |[x, y]| [if x > 5.0 { x + 10.0 } else { x }, y]);
    let field = read(torn, (13, 9)).unwrap().remove(0);
    assert!(field.sigma[4 * 13 + 6] > 3.0 && field.sigma[4 * 13 + 2] < 1.0 && field.sigma[4 * 13 + 10] < 1.0);
}

#[test]
fn queries_say_where_points_begin() {
    // The online tracker does not return its queries exactly.
    let points: Vec<[f32; 2]> =
        (0..9).map(|i| [(i % 3) as f32 * 3.0 + 1.0, (i / 3) as f32 * 3.0 + 1.0]).collect();
    let jittered: Vec<[f32; 2]> =
        points.iter().enumerate().map(|(i, p)| [p[0] + 0.1 * i as f32, p[1] - 0.07 * i as f32]).collect();
    let queries = |frame: f32| points.iter().flat_map(|p| [frame, p[0], p[1]]).collect::<Vec<f32>>();
    let npz = || {
        let tracks: Vec<f32> =
            jittered.iter().copied().chain(points.iter().map(|p| [p[0] + 2.0, p[1]])).flatten().collect();
        let npz = Npz::new().array("pred_tracks", &[2, 9, 2], &tracks);
        npz.array("pred_visibility", &[1, 2, 9, 1], &[1.0; 18])
    };
    assert!(read(npz(), (9, 9)).unwrap_err().contains("form no grid"));
    let message = read(npz().array("queries", &[9, 3], &queries(1.0)), (9, 9)).unwrap_err();
    assert!(message.contains("frame 1") && message.contains("queries"), "{message}");
    let fields = read(npz().array("queries", &[1, 9, 3], &queries(0.0)), (9, 9)).unwrap();
    assert_close(&fields[0], |x, y| [x + 2.0, y]);
}

#[test]
fn what_is_not_finite_is_hidden_at_its_place() {
    let points: Vec<[f32; 2]> = (0..9).map(|i| [(i % 3) as f32, (i / 3) as f32]).collect();
    let npz = cotracker_npz(&points, true, |[x, y]| [if x == 2.0 { f32::NAN } else { x + 1.0 }, y]);
    let field = read(npz, (3, 3)).unwrap().remove(0);
    for (index, position) in field.positions.iter().enumerate() {
        let (x, y) = (index % 3, index / 3);
        let expected = if x == 2 { 2.5 } else { x as f32 + 1.5 };
        assert!((position[0] - expected).abs() < 1e-5 && (position[1] - y as f32 - 0.5).abs() < 1e-5);
        assert_eq!(field.visible[index], x != 2 && index != 1);
        assert!(field.sigma[index] >= SIGMA_FLOOR);
    }
}

#[test]
fn refusals_name_file_array_and_remedy() {
    let scattered: Vec<[f32; 2]> = (0..9).map(|i| [i as f32, ((i * 5) % 7) as f32 * 0.9]).collect();
    let twice = vec![[1.0, 1.0], [1.0, 1.0], [5.0, 1.0], [1.0, 5.0]];
    let outside = vec![[1.0, 1.0], [20.0, 1.0]];
    let still = |point: [f32; 2]| point;
    let cases: [(Npz, &[&str]); 8] = [
        (
            cotracker_npz(&scattered, true, still),
            &["`pred_tracks`", "9 points form no grid", "grid_size", "[T, H, W, 2]"],
        ),
        (cotracker_npz(&twice, true, still), &["two points at 1.5, 1.5"]),
        (cotracker_npz(&outside, true, still), &["image of 9 x 9", "20.5, 1.5"]),
        (
            Npz::new().array("pred_tracks", &[2, 3, 4, 2], &[0.0; 48]),
            &["has shape [2, 3, 4, 2]", "one video"],
        ),
        (Npz::new().array("pred_tracks", &[2, 4, 2], &[0.0; 16]), &["no array `pred_visibility`"]),
        (
            Npz::new().array("pred_tracks", &[2, 4, 2], &[0.0; 16]).array(
                "pred_visibility",
                &[4, 2],
                &[true; 8],
            ),
            &["`pred_visibility` has shape [4, 2]", "[2, 4]"],
        ),
        (Npz::new().array("tracks", &[2, 3, 3], &[0.0; 18]), &["[2, 3, 3]", "as DOT gives"]),
        (
            Npz::new().array("flow", &[1], &[0.0]),
            &["`tracks` or `positions` or `pred_tracks`", "it holds: flow"],
        ),
    ];
    for (npz, expected) in cases {
        let message = read(npz, (9, 9)).unwrap_err();
        assert!(message.contains("tracks.npz"), "{message}");
        assert!(expected.iter().all(|part| message.contains(part)), "{message}");
    }
}

#[test]
fn a_small_file_of_many_frames_is_not_expanded() {
    // One point per frame, of images of 2 million pixels: as fields, 3.6 TB.
    const FRAMES: usize = 100_000;
    let size = (1920, 1080);
    let point = |frame: usize| [960.0 + frame as f32, 540.0];
    let positions: Vec<f32> = (0..FRAMES).flat_map(point).collect();
    let cotracker = Npz::new().array("pred_tracks", &[FRAMES as u64, 1, 2], &positions).array(
        "pred_visibility",
        &[FRAMES as u64, 1],
        &[true; FRAMES],
    );
    let entries: Vec<f32> = (0..FRAMES).flat_map(|frame| [frame as f32 / size.0 as f32, 0.0, 1.0]).collect();
    let dot = Npz::new().array("tracks", &[FRAMES as u64, 1, 1, 3], &entries);
    for npz in [cotracker, dot] {
        let (_folder, path) = npz.finish();
        let tracks = open_tracks(&path, size).unwrap();
        assert_eq!((tracks.count(), tracks.size()), (FRAMES - 1, size));
        let field = tracks.field(6).unwrap();
        assert_eq!((field.width, field.height), size);
        // A grid of one point moves every pixel alike: by 7 pixels in the eighth frame.
        assert_close(&field, |x, y| [x + 7.0, y]);
        assert!(tracks.field(FRAMES - 1).is_none());
    }
}
