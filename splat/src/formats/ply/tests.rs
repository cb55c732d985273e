#![allow(clippy::unwrap_used, reason = "tests")]

use std::io::Write;

use proptest::prelude::*;

use super::*;
use crate::gaussians::{Gaussians, logit};

/// Every value different, so that no exchange of columns goes unseen.
fn counting_gaussians(count: usize, sh_degree: u32) -> Gaussians {
    let mut next = 0.0_f32;
    let mut value = || {
        next += 0.25;
        next
    };
    Gaussians {
        means: (0..count).map(|_| std::array::from_fn(|_| value())).collect(),
        rotations: (0..count).map(|_| std::array::from_fn(|_| value())).collect(),
        log_scales: (0..count).map(|_| std::array::from_fn(|_| value())).collect(),
        logit_opacities: (0..count).map(|_| value()).collect(),
        sh: (0..count * 3 * sh::coefficients(sh_degree)).map(|_| value()).collect(),
        sh_degree,
    }
}

/// A file of `properties` (type and name), with the given rows.
fn file(format: &str, count: usize, properties: &[(&str, &str)], rows: &[u8]) -> Vec<u8> {
    let mut bytes =
        format!("ply\nformat {format} 1.0\ncomment made by hand\nelement vertex {count}\n").into_bytes();
    for (kind, name) in properties {
        writeln!(bytes, "property {kind} {name}").unwrap();
    }
    bytes.extend(b"end_header\n");
    bytes.extend(rows);
    bytes
}

fn message(bytes: &[u8]) -> String {
    parse_ply(bytes).unwrap_err().to_string()
}

const DEGREE_0: [(&str, &str); 14] = [
    ("float", "x"),
    ("float", "y"),
    ("float", "z"),
    ("float", "f_dc_0"),
    ("float", "f_dc_1"),
    ("float", "f_dc_2"),
    ("float", "opacity"),
    ("float", "scale_0"),
    ("float", "scale_1"),
    ("float", "scale_2"),
    ("float", "rot_0"),
    ("float", "rot_1"),
    ("float", "rot_2"),
    ("float", "rot_3"),
];

#[test]
fn every_degree_round_trips() {
    for degree in 0..=3 {
        for count in [0, 1, 7] {
            let gaussians = counting_gaussians(count, degree);
            assert_eq!(parse_ply(&write_ply(&gaussians)).unwrap(), gaussians);
        }
    }
}

#[test]
fn more_than_a_block_round_trips() {
    let gaussians = counting_gaussians(9000, 1);
    assert_eq!(parse_ply(&write_ply(&gaussians)).unwrap(), gaussians);
}

#[test]
fn the_layout_is_the_inria_layout() {
    let gaussians = counting_gaussians(1, 1);
    let bytes = write_ply(&gaussians);
    let end = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let names: Vec<&str> = std::str::from_utf8(&bytes[..end])
        .unwrap()
        .lines()
        .filter_map(|line| line.strip_prefix("property float "))
        .collect();
    assert_eq!(
        names.join(" "),
        "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 f_rest_0 f_rest_1 f_rest_2 f_rest_3 f_rest_4 f_rest_5 f_rest_6 \
         f_rest_7 f_rest_8 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3"
    );
    let row: Vec<f32> =
        bytes[end..].chunks_exact(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap())).collect();
    assert_eq!(row[3..6], [0.0; 3]);
    let sh = &gaussians.sh;
    assert_eq!(row[6..9], sh[..3]);
    // All red coefficients, then green, then blue.
    assert_eq!(row[9..18], [sh[3], sh[6], sh[9], sh[4], sh[7], sh[10], sh[5], sh[8], sh[11]]);
    assert_eq!(row[18], gaussians.logit_opacities[0]);
    assert_eq!(row[22..], gaussians.rotations[0]);
}

#[test]
fn properties_come_in_any_order_with_unknown_ones_between() {
    let mut properties: Vec<(&str, &str)> = DEGREE_0.into_iter().rev().collect();
    properties.insert(0, ("uchar", "label"));
    properties.insert(5, ("short", "group"));
    properties[3].0 = "double";
    let mut row = Vec::new();
    for (index, (kind, _)) in properties.iter().enumerate() {
        match *kind {
            "uchar" => row.push(9),
            "short" => row.extend(9_i16.to_le_bytes()),
            "double" => row.extend((index as f64).to_le_bytes()),
            _ => row.extend((index as f32).to_le_bytes()),
        }
    }
    let gaussians = parse_ply(&file("binary_little_endian", 1, &properties, &row)).unwrap();
    assert_eq!(gaussians.rotations, [[4.0, 3.0, 2.0, 1.0]]);
    assert_eq!(gaussians.means, [[15.0, 14.0, 13.0]]);
    assert_eq!(gaussians.sh, [12.0, 11.0, 10.0]);
}

#[test]
fn other_elements_and_line_ends_are_passed_over() {
    let gaussians = counting_gaussians(2, 0);
    let bytes = write_ply(&gaussians);
    let end = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    let header = std::str::from_utf8(&bytes[..end]).unwrap();
    let before = header.replace("element vertex", "element camera 2\nproperty double focal\nelement vertex");
    let mut changed = before.replace('\n', "\r\n").into_bytes();
    changed.extend([7; 16]);
    changed.extend(&bytes[end..]);
    changed.extend(b"what follows the vertices");
    assert_eq!(parse_ply(&changed).unwrap(), gaussians);
}

#[test]
fn what_is_not_supported_is_refused_by_name() {
    let properties = DEGREE_0;
    for format in ["ascii", "binary_big_endian"] {
        let text = message(&file(format, 0, &properties, &[]));
        assert!(text.contains(format) && text.contains("splat-transform"), "{text}");
    }
    let chunked = b"ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\nelement vertex 1\nproperty uint packed_position\nend_header\n";
    assert!(matches!(parse_ply(chunked), Err(PlyError::Compressed)));
    assert!(message(chunked).contains("convert with splat-transform"));
    assert!(matches!(parse_ply(b"OBJ file\n"), Err(PlyError::NotPly)));
    assert!(matches!(parse_ply(&[0xff; 100]), Err(PlyError::NotPly)));
    assert!(matches!(parse_ply(b""), Err(PlyError::NotPly)));
}

#[test]
fn malformed_headers_name_their_line() {
    let cases: [(&str, &str); 7] = [
        ("ply\nformat binary_little_endian 1.0\nelement vertex many\n", "line 3: `many`"),
        ("ply\nproperty float x\n", "line 2: property before any element"),
        ("ply\nelement vertex 1\nproperty quaternion q\n", "line 3: unknown type `quaternion`"),
        ("ply\nelement vertex 1\nproperty float x\nproperty float x\n", "line 4: property `x` appears twice"),
        ("ply\nelement vertex 1\nproperty list uchar int faces\n", "is not a single value"),
        ("ply\nformat binary_little_endian 1.0\nend_header\n", "no element `vertex`"),
        ("ply\nformat binary_little_endian 1.0\nelement vertex 1\n", "the header does not end"),
    ];
    for (header, expected) in cases {
        let text = message(header.as_bytes());
        assert!(text.contains(expected), "{text}");
    }
    let mut endless = b"ply\ncomment ".to_vec();
    endless.resize(1 << 20, b'a');
    assert!(message(&endless).contains("does not end"));
    let overflow = "ply\nformat binary_little_endian 1.0\nelement a 18446744073709551615\nproperty double v\nelement vertex 0\nend_header\n";
    assert!(message(overflow.as_bytes()).contains("exceed any file"));
}

#[test]
fn missing_and_mistyped_properties_are_named() {
    for missing in 0..DEGREE_0.len() {
        let mut properties = DEGREE_0.to_vec();
        let (_, name) = properties.remove(missing);
        let text = message(&file("binary_little_endian", 0, &properties, &[]));
        assert!(text.contains(&format!("`{name}` is missing")), "{text}");
    }
    let mut properties = DEGREE_0;
    properties[6].0 = "uchar";
    let text = message(&file("binary_little_endian", 0, &properties, &[]));
    assert!(text.contains("`opacity` has type `uchar`"), "{text}");
    let mut properties = DEGREE_0.to_vec();
    properties.push(("float", "f_rest_0"));
    assert!(message(&file("binary_little_endian", 0, &properties, &[])).starts_with("1 `f_rest`"));
}

#[test]
fn truncation_is_found_wherever_it_happens() {
    let bytes = write_ply(&counting_gaussians(3, 0));
    let row = 17 * 4;
    for (missing, found) in [(1, 2), (row, 2), (row + 1, 1), (3 * row, 0)] {
        match parse_ply(&bytes[..bytes.len() - missing]) {
            Err(PlyError::Truncated { stated: 3, found: actual }) => assert_eq!(actual, found),
            other => panic!("{other:?}"),
        }
    }
    // A count that no memory could hold must not be believed.
    let boast = file("binary_little_endian", usize::MAX, &DEGREE_0, &[0; 56]);
    assert!(matches!(parse_ply(&boast), Err(PlyError::Truncated { found: 1, .. })));
}

#[test]
fn values_that_are_not_finite_are_named() {
    for (value, shown) in [(f32::NAN, "NaN"), (f32::INFINITY, "inf"), (f32::NEG_INFINITY, "-inf")] {
        let mut gaussians = counting_gaussians(5, 1);
        gaussians.sh[4 * 12 + 3 + 2] = value;
        let text = message(&write_ply(&gaussians));
        assert!(text.contains(&format!("vertex 4, property `f_rest_6` is {shown}")), "{text}");
    }
}

#[test]
fn errors_of_files_name_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.ply");
    assert!(read_ply(&path).unwrap_err().to_string().contains("model.ply: cannot read"));
    let gaussians = counting_gaussians(3, 2);
    std::fs::write(&path, write_ply(&gaussians)).unwrap();
    assert_eq!(read_ply(&path).unwrap(), gaussians);
    std::fs::write(&path, &write_ply(&gaussians)[..1400]).unwrap();
    assert!(read_ply(&path).unwrap_err().to_string().contains("model.ply: truncated"));
}

#[test]
fn a_summary_states_order_statistics() {
    let mut gaussians = counting_gaussians(101, 0);
    for index in 0..101 {
        gaussians.means[index] = [index as f32, -(index as f32), 3.0];
        gaussians.logit_opacities[index] = logit((index as f64 + 1.0) / 200.0) as f32;
        gaussians.log_scales[index] = [(0.5_f32).ln(); 3];
    }
    let summary = inspect(&write_ply(&gaussians)).unwrap();
    assert_eq!((summary.count, summary.sh_degree), (101, 0));
    assert_eq!(summary.bounds, Some([[0.0, -100.0, 3.0], [100.0, 0.0, 3.0]]));
    let opacity = summary.opacity.unwrap();
    // Logits are stored in single precision.
    assert!((opacity.min - 0.005).abs() < 1e-6 && (opacity.max - 0.505).abs() < 1e-6);
    assert!((opacity.p5 - 0.03).abs() < 1e-6 && (opacity.p50 - 0.255).abs() < 1e-6);
    assert!((summary.scale.unwrap().p95 - 0.5).abs() < 1e-6);

    let empty = inspect(&write_ply(&Gaussians::empty(2))).unwrap();
    assert_eq!((empty.count, empty.bounds, empty.opacity, empty.scale), (0, None, None, None));
}

#[test]
fn a_file_of_another_tool_is_read() {
    let path =
        std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/splats/inria_degree3_100.ply");
    let Ok(bytes) = std::fs::read(path) else { return };
    let gaussians = parse_ply(&bytes).unwrap();
    assert_eq!((gaussians.len(), gaussians.sh_degree), (100, 3));
    // Same layout and normals of zero: writing it gives the same bytes (the file goes on after its stated vertices).
    assert!(bytes.starts_with(&write_ply(&gaussians)));
}

proptest! {
    #[test]
    fn any_finite_bits_round_trip(bits in prop::collection::vec(any::<u32>(), 23 * 3)) {
        // Finite by clearing the exponent's lowest bit; subnormal and negative zero included.
        let mut values = bits.into_iter().map(|bits| f32::from_bits(bits & !(1 << 23)));
        let mut value = || values.next().unwrap();
        let gaussians = Gaussians {
            means: vec![std::array::from_fn(|_| value()); 3],
            rotations: vec![std::array::from_fn(|_| value()); 3],
            log_scales: vec![std::array::from_fn(|_| value()); 3],
            logit_opacities: vec![value(); 3],
            sh: (0..36).map(|_| value()).collect(),
            sh_degree: 1,
        };
        let bytes = write_ply(&gaussians);
        prop_assert_eq!(write_ply(&parse_ply(&bytes).unwrap()), bytes);
    }

    #[test]
    fn any_bytes_end_in_a_result(bytes in prop::collection::vec(any::<u8>(), 0..300), keep in 0..420_usize) {
        let mut file = write_ply(&counting_gaussians(1, 0));
        file.truncate(keep);
        file.extend(bytes);
        let _ = parse_ply(&file);
    }
}
