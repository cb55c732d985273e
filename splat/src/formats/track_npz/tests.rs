#![allow(clippy::unwrap_used, reason = "tests")]

use std::{io::Write, path::PathBuf};

use npyz::WriterBuilder;
use zip::{ZipWriter, write::SimpleFileOptions};

use super::*;
use crate::metrics::tracks::PointQuery;

/// An npz under construction.
pub(super) struct Npz {
    folder: tempfile::TempDir,
    zip: ZipWriter<File>,
}

impl Npz {
    pub(super) fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let zip = ZipWriter::new(File::create(folder.path().join("tracks.npz")).unwrap());
        Self { folder, zip }
    }

    pub(super) fn array<T: npyz::AutoSerialize + Copy>(
        self,
        name: &str,
        shape: &[u64],
        values: &[T],
    ) -> Self {
        self.ordered(name, shape, values, Order::C)
    }

    fn ordered<T: npyz::AutoSerialize + Copy>(
        mut self,
        name: &str,
        shape: &[u64],
        values: &[T],
        order: Order,
    ) -> Self {
        let mut bytes = Vec::new();
        let options = npyz::WriteOptions::new().default_dtype().order(order).shape(shape);
        let mut writer = options.writer(&mut bytes).begin_nd().unwrap();
        writer.extend(values.iter().copied()).unwrap();
        writer.finish().unwrap();
        self.zip.start_file(format!("{name}.npy"), SimpleFileOptions::default()).unwrap();
        self.zip.write_all(&bytes).unwrap();
        self
    }

    fn texts(mut self, name: &str, values: &[&str]) -> Self {
        let dtype = npyz::DType::Plain("<U6".parse().unwrap());
        let mut bytes = Vec::new();
        let options = npyz::WriteOptions::new().dtype(dtype).shape(&[values.len() as u64]);
        let mut writer = options.writer(&mut bytes).begin_nd().unwrap();
        writer.extend(values.iter().map(|value| (*value).to_owned())).unwrap();
        writer.finish().unwrap();
        self.zip.start_file(format!("{name}.npy"), SimpleFileOptions::default()).unwrap();
        self.zip.write_all(&bytes).unwrap();
        self
    }

    pub(super) fn finish(self) -> (tempfile::TempDir, PathBuf) {
        self.zip.finish().unwrap();
        let path = self.folder.path().join("tracks.npz");
        (self.folder, path)
    }
}

/// Two later frames of 3 × 3 pixels: nine pixels do not fill whole bytes.
fn flow() -> Npz {
    let flow: Vec<i16> = (0..36).map(|value| 16 * value - 200).collect();
    Npz::new().array("flow_x64", &[2, 3, 3, 2], &flow)
}

#[test]
fn exact_flow_is_read() {
    let (_folder, path) = flow()
        .array("visible", &[2, 2], &[0b1010_0001_u8, 0b1000_0000, 0b0000_0000, 0b1000_0000])
        .array("valid", &[2], &[0b1110_1111_u8, 0b1000_0000])
        .finish();
    let fields = read_exact_flow(&path).unwrap();
    assert_eq!(fields.len(), 2);
    let first = &fields[0];
    assert_eq!((first.width, first.height), (3, 3));
    assert_eq!(first.positions[0], [0.5 - 3.125, 0.5 - 2.875]);
    // Pixel 4 is at column 1, row 1; its flow has indices 8 and 9.
    assert_eq!(first.positions[4], [1.5 - 1.125, 1.5 - 0.875]);
    assert_eq!(fields[1].positions[8], [2.5 + 5.375, 2.5 + 5.625]);
    assert_eq!(first.visible, [true, false, true, false, false, false, false, true, true]);
    assert_eq!(fields[1].visible, [false, false, false, false, false, false, false, false, true]);
    assert!(first.sigma.iter().all(|&sigma| (sigma - 0.065625).abs() < 1e-7));
}

#[test]
fn invalid_flow_is_invisible() {
    let (_folder, path) = flow()
        .array("visible", &[2, 2], &[0xff_u8; 4])
        .array("valid", &[2], &[0b0111_1111_u8, 0x80])
        .finish();
    for field in read_exact_flow(&path).unwrap() {
        assert_eq!(field.visible, [false, true, true, true, true, true, true, true, true]);
    }
}

#[test]
fn visibility_may_be_packed_without_row_ends() {
    // 18 bits in a row: frame 1 sees pixel 0 only, frame 2 pixels 0 and 8.
    let (_folder, path) = flow()
        .array("visible", &[3], &[0b1000_0000_u8, 0b0100_0000, 0b0100_0000])
        .array("valid", &[2], &[0xff_u8; 2])
        .finish();
    let fields = read_exact_flow(&path).unwrap();
    let seen = |field: &TrackField| (0..9).filter(|&index| field.visible[index]).collect::<Vec<_>>();
    assert_eq!((seen(&fields[0]), seen(&fields[1])), (vec![0], vec![0, 8]));
}

#[test]
fn a_rendered_clip_is_read() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/clips/dev-slide/flow/cam00.npz");
    if !path.exists() {
        return;
    }
    let fields = read_exact_flow(&path).unwrap();
    assert_eq!(fields.len(), 9);
    for field in fields {
        assert_eq!((field.width, field.height), (320, 180));
        // Occlusion and the image border hide some; most of the room stands still.
        let visible = field.visible.iter().filter(|&&visible| visible).count();
        assert!((30_000..57_600).contains(&visible), "{visible}");
        // Whatever is visible at the frame is inside its image.
        let inside = |p: &[f32; 2]| (-0.5..320.5).contains(&p[0]) && (-0.5..180.5).contains(&p[1]);
        assert!(field.positions.iter().zip(&field.visible).all(|(p, visible)| !visible || inside(p)));
    }
}

#[test]
fn a_trackers_fields_are_read_whatever_their_number_type() {
    // Two frames of 1 × 2 pixels; the key frame is skipped.
    let positions = [0.5, 0.5, 1.5, 0.5, 3.25, 4.5, -1.0, 0.125];
    let narrow = positions.map(|value| value as f32);
    let files = [
        Npz::new().array("tracks", &[2, 1, 2, 2], &positions).array(
            "visible",
            &[2, 1, 2],
            &[true, true, true, false],
        ),
        Npz::new().array("positions", &[2, 1, 2, 2], &narrow).array(
            "visibility",
            &[2, 1, 2],
            &[1_u8, 1, 1, 0],
        ),
        Npz::new().array("tracks", &[2, 1, 2, 2], &narrow).array(
            "visible",
            &[2, 1, 2],
            &[1.0, 0.0, 0.51, 0.5],
        ),
    ];
    for file in files {
        let (_folder, path) = file.finish();
        let expected = TrackField {
            width: 2,
            height: 1,
            positions: vec![[3.25, 4.5], [-1.0, 0.125]],
            visible: vec![true, false],
            sigma: vec![DEFAULT_SIGMA; 2],
        };
        assert_eq!(read_track_npz(&path).unwrap(), [expected]);
    }
}

#[test]
fn stated_deviations_are_taken_and_unknown_positions_hidden() {
    let positions = [[0.0_f32; 2]; 6].concat();
    let later = [2.0, 2.0, f32::NAN, 2.0, 2.0, f32::INFINITY, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0];
    let (_folder, path) = Npz::new()
        .array("tracks", &[2, 2, 3, 2], &[positions, later.to_vec()].concat())
        .array("visible", &[2, 2, 3], &[1_u8; 12])
        .array("sigma", &[2, 2, 3], &[1.0_f32, 1.0, 1.0, 1.0, 1.0, 1.0, 0.01, 1.0, 1.0, 0.0, -1.0, f32::NAN])
        .finish();
    let field = read_track_npz(&path).unwrap().remove(0);
    assert_eq!(field.visible, [true, false, false, true, false, false]);
    // What is stated is kept, however small; exactness, which 0 claims, is not believed.
    assert_eq!(field.sigma, [0.01, DEFAULT_SIGMA, DEFAULT_SIGMA, SIGMA_FLOOR, DEFAULT_SIGMA, DEFAULT_SIGMA]);
    assert_eq!((field.positions[1], field.positions[5]), ([1.5, 0.5], [2.5, 1.5]));
}

#[test]
fn errors_name_file_array_and_shapes() {
    let cases: [(Npz, &[&str]); 6] = [
        (Npz::new().array("flow", &[2], &[0_u8; 2]), &["no array `tracks` or `positions`", "it holds: flow"]),
        (Npz::new().array("tracks", &[2, 2], &[0.0; 4]), &["`tracks` has shape [2, 2]", "[T, H, W, 2]"]),
        (
            Npz::new().array("tracks", &[1, 0, 2, 2], &[0.0; 0]),
            &["`tracks` has shape [1, 0, 2, 2]", "between 1 and"],
        ),
        (
            Npz::new().array("tracks", &[1, 1, 2, 2], &[0.0; 4]).array("visible", &[2, 1], &[true; 2]),
            &["`visible` has shape [2, 1]", "expected [1, 1, 2], the shape of `tracks`"],
        ),
        (Npz::new().array("tracks", &[1, 1, 1, 2], &[0_i64; 2]), &["`tracks`", "i8", "expected f32, f64"]),
        (
            Npz::new().ordered("tracks", &[1, 1, 1, 2], &[0.0; 2], Order::Fortran),
            &["`tracks`", "Fortran order", "ascontiguousarray"],
        ),
    ];
    for (npz, expected) in cases {
        let (_folder, path) = npz.finish();
        let message = read_track_npz(&path).unwrap_err().to_string();
        assert!(message.contains("tracks.npz"), "{message}");
        assert!(expected.iter().all(|part| message.contains(part)), "{message}");
    }
}

#[test]
fn errors_of_exact_flow_name_what_is_wrong() {
    let cases: [(Npz, &str); 4] = [
        (Npz::new().array("flow_x64", &[1, 1, 1, 2], &[0.0; 2]), "expected i16"),
        (Npz::new().array("flow_x64", &[1, 2], &[0_i16; 2]), "has shape [1, 2], expected [T-1, H, W, 2]"),
        (flow().array("visible", &[5], &[0_u8; 5]), "`visible` has shape [5], expected [2, 2]"),
        (
            flow().array("visible", &[2, 2], &[0_u8; 4]).array("valid", &[9], &[1_u8; 9]),
            "`valid` has shape [9], expected [2]",
        ),
    ];
    for (npz, expected) in cases {
        let (_folder, path) = npz.finish();
        let message = read_exact_flow(&path).unwrap_err().to_string();
        assert!(message.contains("tracks.npz") && message.contains(expected), "{message}");
    }
}

#[test]
fn files_that_are_no_archives_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("flow.npz");
    assert!(read_exact_flow(&path).unwrap_err().to_string().contains("flow.npz: cannot read"));
    std::fs::write(&path, b"not a zip").unwrap();
    assert!(read_track_npz(&path).unwrap_err().to_string().contains("flow.npz: cannot read"));
}

#[test]
fn shapes_that_boast_are_refused() {
    let mut bytes = Vec::new();
    let options = npyz::WriteOptions::new().default_dtype().shape(&[1, 1, 1, 2]);
    let mut writer = options.writer(&mut bytes).begin_nd().unwrap();
    writer.extend([0.0_f32, 0.0]).unwrap();
    writer.finish().unwrap();
    let shape = bytes.windows(7).position(|window| window == b"1, 1, 1").unwrap();
    bytes[shape..shape + 7].copy_from_slice(b"9, 9, 9");
    let mut npz = Npz::new();
    npz.zip.start_file("tracks.npy", SimpleFileOptions::default()).unwrap();
    npz.zip.write_all(&bytes).unwrap();
    let (_folder, path) = npz.finish();
    let message = read_track_npz(&path).unwrap_err().to_string();
    assert!(message.contains("needs more than"), "{message}");
}

#[test]
fn validity_is_read_apart_and_must_fit_the_size() {
    let (_folder, path) = flow().array("valid", &[2], &[0b0111_1110_u8, 0x80]).finish();
    let valid = read_exact_validity(&path, 3, 3).unwrap();
    assert_eq!(valid, [false, true, true, true, true, true, true, false, true]);
    let error = read_exact_validity(&path, 5, 5).unwrap_err().to_string();
    assert!(error.contains("[2]") && error.contains("[4]"), "{error}");
}

/// Two frames of three points, seen by two views.
fn points() -> Npz {
    let xyz =
        [0.0_f32, 0.0, 2.0, 0.5, 0.0, 1.0, 0.0, 0.0, -1.0, 0.5, 0.25, 2.0, 9.0, 0.0, 1.0, 0.0, 0.0, 1.0];
    Npz::new().array("xyz", &[2, 3, 3], &xyz).texts("cameras", &["a", "test00"]).array(
        "dynamic",
        &[3],
        &[true, false, true],
    )
}

#[test]
fn points_are_projected_and_asked_for_where_the_key_frame_sees_them() {
    let bits = [0b1110_0000_u8, 0b0110_0000, 0b1010_0000, 0b0000_0000];
    let (_folder, path) = points().array("visible", &[2, 2, 1], &bits).finish();
    let points = PointTracks::read(&path).unwrap();
    let camera = crate::cameras::Camera {
        width: 20,
        height: 10,
        fx: 8.0,
        fy: 8.0,
        cx: 10.0,
        cy: 5.0,
        rotation: glam::DMat3::IDENTITY,
        translation: glam::DVec3::ZERO,
    };
    let asked = |view: &str, frame: usize, moving: bool| points.queries(view, &camera, frame, moving);
    let query = |at_key: [f64; 2], exact: [f64; 2], visible: bool| PointQuery { at_key, exact, visible };
    // The third point starts behind the camera.
    assert_eq!(asked("a", 1, true).unwrap(), [query([10.0, 5.0], [12.0, 6.0], true)]);
    assert_eq!(asked("a", 1, false).unwrap(), [query([14.0, 5.0], [82.0, 5.0], false)]);
    assert_eq!(asked("a", 0, false).unwrap(), [query([14.0, 5.0], [14.0, 5.0], true)]);
    assert_eq!(asked("test00", 1, true).unwrap(), []);
    assert_eq!(asked("test00", 1, false).unwrap().len(), 1);
    assert_eq!((asked("b", 1, true), asked("a", 2, true)), (None, None));
}

#[test]
fn points_of_another_shape_are_refused() {
    let (_folder, path) = points().array("visible", &[2, 1, 1], &[0_u8; 2]).finish();
    let error = PointTracks::read(&path).unwrap_err().to_string();
    assert!(error.contains("`visible`") && error.contains("[2, 2, 1]"), "{error}");
}

#[test]
fn a_header_that_claims_gigabytes_is_refused_before_it_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tracks.npz");
    let mut zip = ZipWriter::new(File::create(&path).unwrap());
    zip.start_file("tracks.npy", SimpleFileOptions::default()).unwrap();
    zip.write_all(b"\x93NUMPY\x02\x00\xff\xff\xff\xff").unwrap();
    zip.finish().unwrap();
    let message = read_track_npz(&path).unwrap_err().to_string();
    assert!(message.contains("header claims 4294967295 bytes"), "{message}");
}

#[test]
fn what_an_entry_says_about_its_size_reserves_nothing() {
    // Both the directory and the array claim 4 GB; the file has not 200 bytes.
    let mut bytes = Vec::new();
    let options = npyz::WriteOptions::<f32>::new().default_dtype().shape(&[1 << 30]);
    drop(options.writer(&mut bytes).begin_nd().unwrap());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tracks.npz");
    let mut zip = ZipWriter::new(File::create(&path).unwrap());
    let stored = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    zip.start_file("tracks.npy", stored).unwrap();
    zip.write_all(&bytes).unwrap();
    zip.finish().unwrap();
    let mut file = std::fs::read(&path).unwrap();
    // Uncompressed size in the central directory, whose header begins with this signature.
    let header = file.windows(4).rposition(|window| window == b"PK\x01\x02").unwrap();
    file[header + 24..header + 28].copy_from_slice(&0xffff_fff0_u32.to_le_bytes());
    std::fs::write(&path, file).unwrap();
    let message = read_track_npz(&path).unwrap_err().to_string();
    assert!(message.contains("tracks.npz") && message.contains("needs more than"), "{message}");
}
