//! From the types of `splat` to the wire.

use splat::cameras::Camera;
use trackersplat_proto::v1;

/// A camera on the wire: the rotation row by row.
pub(crate) fn camera_to_wire(camera: &Camera) -> v1::Camera {
    v1::Camera {
        width: camera.width,
        height: camera.height,
        fx: camera.fx,
        fy: camera.fy,
        cx: camera.cx,
        cy: camera.cy,
        // Columns of the transpose are the rows.
        rotation: camera.rotation.transpose().to_cols_array().to_vec(),
        translation: camera.translation.to_array().to_vec(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rotation_goes_row_by_row() {
        // A quarter turn about z maps x to y: row 0 is (0, -1, 0).
        let quarter = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]];
        let camera: Camera = serde_json::from_value(serde_json::json!({
            "width": 4, "height": 3, "fx": 5.0, "fy": 6.0, "cx": 2.0, "cy": 1.5,
            "rotation": quarter.concat(), "translation": [7.0, 8.0, 9.0],
        }))
        .expect("a camera");
        let wire = camera_to_wire(&camera);
        assert_eq!(wire.rotation, [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
        assert_eq!((wire.width, wire.height, wire.fx, wire.cy), (4, 3, 5.0, 1.5));
        assert_eq!(wire.translation, [7.0, 8.0, 9.0]);
    }
}
