//! Poses that are no rotations are refused where a clip is read; what remains is right-handed.

use glam::{DMat3, DQuat, DVec3};
use splat::clip::{Clip, ClipOptions};
use trackersplat_tests::clips;

use super::scene::{direction, random};
use crate::row::{Bar, Row};

const REFUSED: Bar = Bar { unit: "", factor: 1.0, why: "exact" };

const FILE: &str = "transforms/frame_0001.json";

/// Opens a clip whose first pose has been replaced by these axes; whether it opened, and the error.
fn open(folder: &std::path::Path, axes: DMat3) -> Result<(), String> {
    let text = std::fs::read_to_string(folder.join(FILE)).unwrap();
    let mut document: serde_json::Value = serde_json::from_str(&text).unwrap();
    for row in 0..3 {
        for column in 0..3 {
            document["frames"][0]["transform_matrix"][row][column] = axes.col(column)[row].into();
        }
    }
    std::fs::write(folder.join(FILE), document.to_string()).unwrap();
    Clip::open(folder, &ClipOptions::default()).map(|_| ()).map_err(|error| error.to_string())
}

fn row(extreme: &'static str, spoil: DMat3, said: Option<&str>) -> Row {
    let scratch = clips::scratch(1, 2);
    let mut row = Row::new("poses", extreme, REFUSED);
    for seed in 0..20 {
        let mut random = random(seed);
        let turn = DQuat::from_axis_angle(direction(&mut random), seed as f64);
        let outcome = open(scratch.path(), DMat3::from_quat(turn) * spoil);
        row.exact(match (said, &outcome) {
            (None, outcome) => outcome.is_ok(),
            (Some(said), Err(error)) => error.contains(said),
            (Some(_), Ok(())) => false,
        });
    }
    row
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let diagonal = |x, y, z| DMat3::from_diagonal(DVec3::new(x, y, z));
    vec![
        row("right-handed", DMat3::IDENTITY, None),
        row("left-handed", diagonal(1.0, 1.0, -1.0), Some("mirror")).remark("refused"),
        row("left-handed, all axes reversed", diagonal(-1.0, -1.0, -1.0), Some("mirror")).remark("refused"),
        row("axes of length 1.01", diagonal(1.01, 1.01, 1.01), Some("not a rotation")).remark("refused"),
        row("rank two", diagonal(1.0, 1.0, 0.0), Some("not a rotation")).remark("refused"),
        row("left-handed and scaled", diagonal(1.0, -2.0, 1.0), Some("not a rotation")).remark("refused"),
    ]
}
