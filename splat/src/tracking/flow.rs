//! Displacement fields.

/// A displacement per pixel, `height * width`, row by row, in pixels of its own level.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Flow {
    pub(super) width: usize,
    pub(super) height: usize,
    pub(super) u: Vec<f32>,
    pub(super) v: Vec<f32>,
}

impl Flow {
    pub(super) fn zeros(width: usize, height: usize) -> Self {
        Self { width, height, u: vec![0.0; width * height], v: vec![0.0; width * height] }
    }

    pub(super) fn at(&self, x: usize, y: usize) -> [f32; 2] {
        let i = y * self.width + x;
        [self.u[i], self.v[i]]
    }

    /// The four pixels around fractional index `(x, y)` and their bilinear weights, clamped to the image.
    pub(super) fn corners(&self, x: f32, y: f32) -> [(usize, f32); 4] {
        let x = x.clamp(0.0, (self.width - 1) as f32);
        let y = y.clamp(0.0, (self.height - 1) as f32);
        let (x0, y0) = (x as usize, y as usize);
        let (x1, y1) = ((x0 + 1).min(self.width - 1), (y0 + 1).min(self.height - 1));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        [
            (y0 * self.width + x0, (1.0 - fx) * (1.0 - fy)),
            (y0 * self.width + x1, fx * (1.0 - fy)),
            (y1 * self.width + x0, (1.0 - fx) * fy),
            (y1 * self.width + x1, fx * fy),
        ]
    }

    /// The displacement at fractional index `(x, y)`, bilinear, clamped to the image.
    pub(super) fn sample(&self, x: f32, y: f32) -> [f32; 2] {
        let corners = self.corners(x, y);
        [&self.u, &self.v].map(|axis| corners.iter().map(|&(i, weight)| weight * axis[i]).sum())
    }

    /// The same field on a grid of another size, displacements scaled along; `scale` is new over old resolution.
    /// The nearest value, so that motion boundaries stay sharp.
    pub(super) fn resampled_nearest(&self, width: usize, height: usize, scale: f32) -> Self {
        let mut out = Self::zeros(width, height);
        for y in 0..height {
            let source_y = (((y as f32 + 0.5) / scale) as usize).min(self.height - 1);
            for x in 0..width {
                let source_x = (((x as f32 + 0.5) / scale) as usize).min(self.width - 1);
                let at = self.at(source_x, source_y);
                out.u[y * width + x] = at[0] * scale;
                out.v[y * width + x] = at[1] * scale;
            }
        }
        out
    }
}
