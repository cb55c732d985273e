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

    /// How much the displacements of each pixel and its eight neighbours differ: length of their ranges along both axes.
    pub(super) fn contrast(&self) -> Vec<f32> {
        let (along_x, along_y) = (ranges(&self.u, self.width), ranges(&self.v, self.width));
        along_x.iter().zip(&along_y).map(|(x, y)| (x * x + y * y).sqrt()).collect()
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

/// Largest minus smallest of each value and its eight neighbours.
fn ranges(values: &[f32], width: usize) -> Vec<f32> {
    let height = values.len() / width;
    let around = |at: usize, size: usize| at.saturating_sub(1)..(at + 2).min(size);
    let of_row = |i: usize| -> [f32; 2] {
        let (row, x) = (i - i % width, i % width);
        extremes(values[row..][around(x, width)].iter().map(|&value| [value; 2]))
    };
    let rows: Vec<[f32; 2]> = (0..values.len()).map(of_row).collect();
    let range = |i: usize| {
        let [least, most] = extremes(around(i / width, height).map(|y| rows[y * width + i % width]));
        most - least
    };
    (0..values.len()).map(range).collect()
}

fn extremes(pairs: impl Iterator<Item = [f32; 2]>) -> [f32; 2] {
    pairs.fold([f32::INFINITY, f32::NEG_INFINITY], |[least, most], [low, high]| {
        [least.min(low), most.max(high)]
    })
}

/// Least weight of a pixel that counts.
const LEAST_WEIGHT: f32 = 0.05;

/// Whether a place between the pixels that [`Flow::corners`] has given is seen: all that count are.
pub(super) fn sees(corners: &[(usize, f32); 4], visible: &[bool]) -> bool {
    corners.iter().all(|&(corner, weight)| weight < LEAST_WEIGHT || visible[corner])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn contrast_is_the_extent_of_the_displacements_around_a_pixel() {
        let mut flow = Flow::zeros(5, 4);
        flow.u[5 + 1] = 3.0;
        flow.v[2 * 5 + 2] = -4.0;
        // A pixel sees both, one or none.
        #[rustfmt::skip]
        let exact = [
            3.0, 3.0, 3.0, 0.0, 0.0,
            3.0, 5.0, 5.0, 4.0, 0.0,
            3.0, 5.0, 5.0, 4.0, 0.0,
            0.0, 4.0, 4.0, 4.0, 0.0,
        ];
        assert_eq!(flow.contrast(), exact);
        assert_eq!(Flow::zeros(1, 1).contrast(), [0.0]);
    }
}
