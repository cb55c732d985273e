//! Pinhole cameras in OpenCV axes: x right, y down, z forward; the centre of the top-left pixel is (0.5, 0.5).

pub mod distortion;
pub mod rig;

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// A calibrated pinhole camera. Lens distortion is removed from images when a clip is read, never modelled here.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Image columns.
    pub width: u32,
    /// Image rows.
    pub height: u32,
    /// Horizontal focal length, pixels.
    pub fx: f64,
    /// Vertical focal length, pixels.
    pub fy: f64,
    /// Principal point, pixels from the left image border.
    pub cx: f64,
    /// Principal point, pixels from the top image border.
    pub cy: f64,
    /// Rotation from world to camera axes.
    pub rotation: DMat3,
    /// World origin in camera axes: `x_camera = rotation * x_world + translation`.
    pub translation: DVec3,
}

impl Camera {
    /// A world point in camera axes.
    pub fn to_camera(&self, world: DVec3) -> DVec3 {
        self.rotation * world + self.translation
    }

    /// Position of the optical centre in the world.
    pub fn centre(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// Pixel position of a point in camera axes; `None` unless it lies in front of the principal plane.
    pub fn project(&self, camera: DVec3) -> Option<DVec2> {
        if !(camera.z > 0.0) {
            return None;
        }
        let pixel =
            DVec2::new(self.fx * camera.x / camera.z + self.cx, self.fy * camera.y / camera.z + self.cy);
        pixel.is_finite().then_some(pixel)
    }

    /// Pixel position of a world point; `None` unless it lies in front of the principal plane.
    pub fn project_world(&self, world: DVec3) -> Option<DVec2> {
        self.project(self.to_camera(world))
    }

    /// Rows of the 2×3 Jacobian of the pixel position by the **world** position, at a point given in camera axes.
    pub fn world_jacobian(&self, camera: DVec3) -> [DVec3; 2] {
        let inverse_z = 1.0 / camera.z;
        let du = DVec3::new(self.fx * inverse_z, 0.0, -self.fx * camera.x * inverse_z * inverse_z);
        let dv = DVec3::new(0.0, self.fy * inverse_z, -self.fy * camera.y * inverse_z * inverse_z);
        let to_world = self.rotation.transpose();
        [to_world * du, to_world * dv]
    }

    /// Whether a pixel position lies inside the image.
    pub fn contains(&self, pixel: DVec2) -> bool {
        pixel.x >= 0.0
            && pixel.y >= 0.0
            && pixel.x <= f64::from(self.width)
            && pixel.y <= f64::from(self.height)
    }

    /// The same view at another resolution, for a whole image resampled to `width × height`.
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (f64::from(width) / f64::from(self.width), f64::from(height) / f64::from(self.height));
        Self {
            width,
            height,
            fx: self.fx * sx,
            fy: self.fy * sy,
            cx: self.cx * sx,
            cy: self.cy * sy,
            ..self.clone()
        }
    }
}
