//! The flow between two images, for use on its own.

use super::{
    TrackingSettings,
    exposure::Exposure,
    flow::Flow,
    pair::{Guides, Pyramid, match_pyramids},
};
use crate::{image::Image, simd::Instructions};

/// How far each pixel of one image has moved in another.
#[derive(Clone, Debug, PartialEq)]
pub struct DenseFlow {
    /// Columns of the images.
    pub width: u32,
    /// Rows of the images.
    pub height: u32,
    /// Displacement `x, y` of every pixel, row by row, in pixels.
    pub displacement: Vec<[f32; 2]>,
}

impl DenseFlow {
    /// Refuses another size than `first`, and what is not one displacement per pixel.
    fn check(&self, first: (u32, u32)) -> Result<(), PairFlowError> {
        let (width, height) = (self.width, self.height);
        same_size(first, (width, height))?;
        let displacements = self.displacement.len();
        if displacements != width as usize * height as usize {
            return Err(PairFlowError::Displacements { width, height, displacements });
        }
        Ok(())
    }

    fn planar(&self) -> Flow {
        let axis = |axis: usize| self.displacement.iter().map(|displacement| displacement[axis]).collect();
        Flow { width: self.width as usize, height: self.height as usize, u: axis(0), v: axis(1) }
    }
}

/// The flow from the first to the second of two images, and the flow back.
#[derive(Clone, Debug, PartialEq)]
pub struct PairFlow {
    /// Displacements of the first image's pixels.
    pub forward: DenseFlow,
    /// Displacements of the second image's pixels.
    pub backward: DenseFlow,
}

/// Why two images cannot be matched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PairFlowError {
    /// The images, or the initial flow, have different sizes.
    #[error(
        "a flow between {} x {} and {} x {} pixels; give images and initial flows of one size",
        first.0, first.1, second.0, second.1
    )]
    SizesDiffer {
        /// Columns and rows of the first image.
        first: (u32, u32),
        /// Columns and rows of what differs from it.
        second: (u32, u32),
    },
    /// The initial flow is not one displacement per pixel.
    #[error(
        "an initial flow of {width} x {height} pixels has {displacements} displacements; give one per pixel"
    )]
    Displacements {
        /// Columns that it states.
        width: u32,
        /// Rows that it states.
        height: u32,
        /// Displacements that it has.
        displacements: usize,
    },
}

fn same_size(first: (u32, u32), second: (u32, u32)) -> Result<(), PairFlowError> {
    if first == second { Ok(()) } else { Err(PairFlowError::SizesDiffer { first, second }) }
}

/// Matches two images both ways.
///
/// `initial` is what is known of the flow beforehand: it competes with what the images suggest. Displacements are
/// finite whatever the images hold, and zero between identical images.
pub fn pair_flow(
    first: &Image,
    second: &Image,
    initial: Option<&PairFlow>,
    settings: &TrackingSettings,
) -> Result<PairFlow, PairFlowError> {
    let size = (first.width, first.height);
    same_size(size, (second.width, second.height))?;
    if let Some(PairFlow { forward, backward }) = initial {
        forward.check(size)?;
        backward.check(size)?;
    }
    if first.pixel_count() == 0 {
        let nothing = DenseFlow { width: size.0, height: size.1, displacement: Vec::new() };
        return Ok(PairFlow { forward: nothing.clone(), backward: nothing });
    }
    let instructions = Instructions::detect();
    let second = &*Exposure::of(first).equalised(second);
    let (first, second) = rayon::join(|| Pyramid::new(first, settings), || Pyramid::new(second, settings));
    let initial = initial.map(|initial| (initial.forward.planar(), initial.backward.planar()));
    let scale = Flow::reduction([size.0 as usize, size.1 as usize], first.size());
    let guides = initial.as_ref().map(|(forward, backward)| Guides { forward, backward, scale: 1.0 / scale });
    let (forward, backward) = match_pyramids(instructions, &first, &second, guides, settings);
    let [forward, backward] = [forward, backward].map(|flow| enlarged(&flow, size, scale));
    Ok(PairFlow { forward, backward })
}

/// The flow at the resolution of the images, `scale` times that of the field; bilinear.
fn enlarged(flow: &Flow, (width, height): (u32, u32), scale: f32) -> DenseFlow {
    let mut displacement = vec![[0.0; 2]; width as usize * height as usize];
    let mut line = [(); 2].map(|()| vec![0.0f32; flow.width]);
    for (y, row) in displacement.chunks_exact_mut(width as usize).enumerate() {
        let at = ((y as f32 + 0.5) / scale - 0.5).clamp(0.0, (flow.height - 1) as f32);
        let (upper, share) = (at as usize, at.fract());
        let lower = (upper + 1).min(flow.height - 1);
        for (line, axis) in line.iter_mut().zip([&flow.u, &flow.v]) {
            let upper = &axis[upper * flow.width..(upper + 1) * flow.width];
            let lower = &axis[lower * flow.width..(lower + 1) * flow.width];
            for ((value, upper), lower) in line.iter_mut().zip(upper).zip(lower) {
                let blend = scale * (upper + share * (lower - upper));
                // Only settings without sense give anything else.
                *value = if blend.is_finite() { blend } else { 0.0 };
            }
        }
        let [u, v] = &line;
        // Loops of these lengths unroll.
        match scale as usize {
            2 => stretch([u, v], 2, row),
            4 => stretch([u, v], 4, row),
            8 => stretch([u, v], 8, row),
            scale => stretch([u, v], scale, row),
        }
    }
    DenseFlow { width, height, displacement }
}

/// A row of vectors, interpolated at `scale` times as many places.
#[inline(always)]
fn stretch([u, v]: [&[f32]; 2], scale: usize, row: &mut [[f32; 2]]) {
    let at = |x: usize| [u[x], v[x]];
    let share = |n: usize| (n as f32 + 0.5) / scale as f32;
    let between = |[a, b]: [f32; 2], [c, d]: [f32; 2], share: f32| [a + share * (c - a), b + share * (d - b)];
    for (x, places) in row.chunks_mut(scale).enumerate() {
        let (left, here, right) = (at(x.saturating_sub(1)), at(x), at((x + 1).min(u.len() - 1)));
        for (n, place) in places.iter_mut().enumerate() {
            // Places lie symmetrically around the centre of what they are stretched from.
            *place = if n < scale / 2 {
                between(left, here, share(n) + 0.5)
            } else {
                between(here, right, share(n) - 0.5)
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn enlarging_interpolates_between_the_centres_and_stays_flat_beyond() {
        for (scale, size) in
            [(1, (3, 2)), (2, (5, 4)), (2, (6, 3)), (4, (9, 7)), (8, (24, 9)), (16, (40, 17))]
        {
            let (width, height) = (size.0 as usize, size.1 as usize);
            let mut flow = Flow::zeros(width.div_ceil(scale), height.div_ceil(scale));
            for i in 0..flow.u.len() {
                (flow.u[i], flow.v[i]) = ((i * 7 % 5) as f32, (i * 3 % 11) as f32);
            }
            let large = enlarged(&flow, size, scale as f32);
            for (i, found) in large.displacement.iter().enumerate() {
                let centre = [i % width, i / width].map(|at| (at as f32 + 0.5) / scale as f32 - 0.5);
                let exact = flow.sample(centre[0], centre[1]).map(|value| scale as f32 * value);
                // Values up to 160, rounded a few times each.
                let error = (found[0] - exact[0]).abs().max((found[1] - exact[1]).abs());
                assert!(error < 1e-4, "{scale} {size:?} {i}: {found:?} {exact:?}");
            }
        }
    }
}
