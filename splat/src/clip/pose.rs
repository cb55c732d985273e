//! Poses from the conventions of data sets to world-to-camera in OpenCV axes.

use glam::{DMat3, DQuat, DVec3};

use super::PoseProblem;

/// Largest entry of `RᵀR - I` that passes as rounding (files with four decimals reach 2e-4).
const ORTHONORMAL_TOLERANCE: f64 = 1e-3;

/// `x_camera = rotation * x_world + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pose {
    pub(super) rotation: DMat3,
    pub(super) translation: DVec3,
}

impl Pose {
    /// From COLMAP's world-to-camera quaternion `w, x, y, z` (of any length, as COLMAP reads it) and translation.
    pub(super) fn from_colmap([w, x, y, z]: [f64; 4], translation: [f64; 3]) -> Result<Self, PoseProblem> {
        let quaternion = DQuat::from_xyzw(x, y, z, w);
        let translation = DVec3::from_array(translation);
        let length = quaternion.length();
        if !(length.is_finite() && translation.is_finite()) {
            return Err(PoseProblem::NotFinite);
        }
        if length == 0.0 {
            return Err(PoseProblem::ZeroQuaternion);
        }
        Ok(Self { rotation: DMat3::from_quat(quaternion / length), translation })
    }

    /// From camera-to-world columns right, up, back and position (OpenGL, Blender, nerfstudio).
    pub(super) fn from_opengl(axes: DMat3, centre: DVec3) -> Result<Self, PoseProblem> {
        Self::from_axes(DMat3::from_cols(axes.x_axis, -axes.y_axis, -axes.z_axis), centre)
    }

    /// From camera-to-world columns down, right, back and position (LLFF).
    pub(super) fn from_llff(axes: DMat3, centre: DVec3) -> Result<Self, PoseProblem> {
        Self::from_axes(DMat3::from_cols(axes.y_axis, axes.x_axis, -axes.z_axis), centre)
    }

    /// From camera-to-world columns right, down, forward and position.
    fn from_axes(axes: DMat3, centre: DVec3) -> Result<Self, PoseProblem> {
        let rotation = nearest_rotation(axes.transpose())?;
        if !centre.is_finite() {
            return Err(PoseProblem::NotFinite);
        }
        Ok(Self { rotation, translation: -(rotation * centre) })
    }
}

/// The rotation that `matrix` is, up to rounding.
fn nearest_rotation(matrix: DMat3) -> Result<DMat3, PoseProblem> {
    if !matrix.is_finite() {
        return Err(PoseProblem::NotFinite);
    }
    let gram = matrix.transpose() * matrix - DMat3::IDENTITY;
    let deviation = gram.to_cols_array().into_iter().fold(0.0, |worst: f64, entry| worst.max(entry.abs()));
    // A mirrored rotation is orthonormal, and a scaled one is no reflection: each gets its own name.
    if deviation > ORTHONORMAL_TOLERANCE {
        return Err(PoseProblem::NotOrthonormal { deviation, tolerance: ORTHONORMAL_TOLERANCE });
    }
    let determinant = matrix.determinant();
    if determinant < 0.0 {
        return Err(PoseProblem::Mirrored { determinant });
    }
    Ok(DMat3::from_quat(DQuat::from_mat3(&matrix).normalize()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: DMat3, b: DMat3) -> bool {
        (a - b).to_cols_array().iter().all(|entry| entry.abs() < 1e-12)
    }

    #[test]
    fn conventions_agree() {
        let rotation = DMat3::from_quat(DQuat::from_xyzw(0.1, -0.5, 0.3, 0.8).normalize());
        let centre = DVec3::new(1.0, -2.0, 3.0);
        let [right, down, forward] = [rotation.row(0), rotation.row(1), rotation.row(2)];
        let expected = Pose { rotation, translation: -(rotation * centre) };
        let opengl = Pose::from_opengl(DMat3::from_cols(right, -down, -forward), centre).expect("a rotation");
        let llff = Pose::from_llff(DMat3::from_cols(down, right, -forward), centre).expect("a rotation");
        let colmap =
            Pose::from_colmap([1.6, 0.2, -1.0, 0.6], expected.translation.to_array()).expect("a rotation");
        for pose in [opengl, llff, colmap] {
            assert!(close(pose.rotation, rotation));
            assert!((pose.translation - expected.translation).length() < 1e-12);
        }
    }

    #[test]
    fn rounding_is_mended() {
        let rounded = DMat3::from_cols_array(&[0.8, 0.6001, 0.0, -0.6, 0.8, 0.0, 0.0, 0.0, 1.0]);
        let pose = Pose::from_opengl(rounded, DVec3::ZERO).expect("within tolerance");
        assert!(close(pose.rotation.transpose() * pose.rotation, DMat3::IDENTITY));
    }

    #[test]
    fn what_is_no_rigid_motion_is_refused() {
        let mirrored = DMat3::from_diagonal(DVec3::new(1.0, -1.0, 1.0));
        assert!(matches!(Pose::from_opengl(mirrored, DVec3::ZERO), Err(PoseProblem::Mirrored { .. })));
        let scaled = DMat3::from_diagonal(DVec3::splat(1.01));
        assert!(matches!(Pose::from_opengl(scaled, DVec3::ZERO), Err(PoseProblem::NotOrthonormal { .. })));
        let zero = Pose::from_opengl(DMat3::ZERO, DVec3::ZERO);
        assert!(matches!(zero, Err(PoseProblem::NotOrthonormal { .. })));

        let nan = DMat3::from_diagonal(DVec3::new(1.0, f64::NAN, 1.0));
        assert_eq!(Pose::from_opengl(nan, DVec3::ZERO), Err(PoseProblem::NotFinite));
        let far = Pose::from_opengl(DMat3::IDENTITY, DVec3::new(f64::INFINITY, 0.0, 0.0));
        assert_eq!(far, Err(PoseProblem::NotFinite));
        assert_eq!(Pose::from_colmap([0.0; 4], [0.0; 3]), Err(PoseProblem::ZeroQuaternion));
        assert_eq!(Pose::from_colmap([1.0, 0.0, 0.0, f64::NAN], [0.0; 3]), Err(PoseProblem::NotFinite));
        assert_eq!(
            Pose::from_colmap([1.0, 0.0, 0.0, 0.0], [0.0, f64::INFINITY, 0.0]),
            Err(PoseProblem::NotFinite)
        );
    }
}
