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
        self.between(&self.corners(x, y))
    }

    /// The displacement between the pixels that [`Self::corners`] has given.
    pub(super) fn between(&self, corners: &[(usize, f32); 4]) -> [f32; 2] {
        [&self.u, &self.v].map(|axis| corners.iter().map(|&(i, weight)| weight * axis[i]).sum())
    }

    /// The same field on a grid of twice the resolution, displacements scaled along.
    /// The nearest value, so that motion boundaries stay sharp.
    pub(super) fn doubled(&self, width: usize, height: usize) -> Self {
        let mut out = Self::zeros(width, height);
        for y in 0..height {
            for x in 0..width {
                let [u, v] = self.at(x / 2, y / 2);
                out.u[y * width + x] = 2.0 * u;
                out.v[y * width + x] = 2.0 * v;
            }
        }
        out
    }

    /// Resolution of an image over that of a field that was found on it after halvings, each of which rounds up: a power
    /// of two, not the ratio of the sizes.
    pub(super) fn reduction(image: [usize; 2], field: [usize; 2]) -> f32 {
        let mut halvings = 0;
        while image[0].div_ceil(1 << halvings) > field[0] || image[1].div_ceil(1 << halvings) > field[1] {
            halvings += 1;
        }
        (1u32 << halvings) as f32
    }
}

/// Least weight of a pixel that counts.
const LEAST_WEIGHT: f32 = 0.05;

/// Whether a place between the pixels that [`Flow::corners`] has given is seen: all that count are.
pub(super) fn sees(corners: &[(usize, f32); 4], visible: &[bool]) -> bool {
    corners.iter().all(|&(corner, weight)| weight < LEAST_WEIGHT || visible[corner])
}
