//! Which blocks a footprint reaches, four footprints and four rows of blocks at a time.

use super::{
    blocks::{BLOCK, BLOCK_ROWS},
    project::Footprint,
};
use crate::simd::{LANES, ROWS, Simd};

/// Columns of blocks that a footprint reaches, per row of blocks: from `first` to before `end`.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Spans {
    first: [i32; BLOCK_ROWS],
    end: [i32; BLOCK_ROWS],
}

/// Where a span that is empty begins: to the right of every end.
const NOWHERE: f32 = 1e9;

impl Spans {
    /// Tiles from the first to the last that it reaches.
    #[inline(always)]
    pub(super) fn tiles(&self) -> std::ops::Range<usize> {
        let first = self.first.iter().fold(i32::MAX, |least, &first| least.min(first));
        let end = self.end.iter().fold(0, |most, &end| most.max(end));
        if first >= end {
            return 0..0;
        }
        first as usize / BLOCK_ROWS..(end as usize).div_ceil(BLOCK_ROWS)
    }

    /// A bit for each block of a tile that is reached, row by row.
    #[inline(always)]
    pub(super) fn blocks(&self, tile: usize) -> u32 {
        let left = (tile * BLOCK_ROWS) as i32;
        let mut bits = 0;
        for row in 0..BLOCK_ROWS {
            let first = (self.first[row] - left).clamp(0, BLOCK_ROWS as i32);
            let end = (self.end[row] - left).clamp(0, BLOCK_ROWS as i32);
            let before = |column: i32| (1u32 << column) - 1;
            bits |= (before(end) & !before(first)) << (BLOCK_ROWS * row);
        }
        bits
    }
}

/// The ellipse inside which a footprint's alpha can reach the threshold.
#[derive(Clone, Copy, Default)]
pub(super) struct Reach {
    /// Mean, pixels, `y` from the band's first row; row centre shift per row; `2 · variance along a row`.
    line: [f32; ROWS],
    /// What the exponent may fall; root of half the inverse variance across rows: squared with the offset, so that
    /// neither overflows alone; half height; row of the rightmost point.
    extent: [f32; ROWS],
}

impl Reach {
    #[inline(always)]
    pub(super) fn new(footprint: &Footprint, first_row: usize) -> Self {
        let [x, y] = footprint.mean;
        Self {
            line: [
                x as f32,
                (y - first_row as f64) as f32,
                footprint.slope as f32,
                (2.0 * footprint.conditional) as f32,
            ],
            extent: [
                footprint.reach as f32,
                (0.5 * footprint.inverse_yy).sqrt() as f32,
                footprint.half_height as f32,
                footprint.row_of_rightmost as f32,
            ],
        }
    }
}

/// Columns of blocks per footprint, each row of lanes a footprint and each lane in it a row of blocks of the band. In a row of
/// blocks the rightmost point is the ellipse's rightmost point of all, or lies on that row's edge towards it; the
/// leftmost likewise. Margins cover the rounding of single precision, here and in the kernel's alpha: the kernel itself
/// decides at the threshold.
#[inline(always)]
pub(super) fn spans<S: Simd>(reaches: &[Reach; ROWS], rows: usize, width: usize) -> [Spans; ROWS] {
    let mut edges = [[0.0; LANES]; 2];
    for lane in 0..LANES {
        let row = lane % BLOCK_ROWS;
        edges[0][lane] = (row * BLOCK) as f32 + 0.5;
        edges[1][lane] = ((row + 1) * BLOCK).min(rows) as f32 - 0.5;
    }
    let [a, b, c, d] = reaches;
    let line = S::load_rows([&a.line, &b.line, &c.line, &d.line]);
    let extent = S::load_rows([&a.extent, &b.extent, &c.extent, &d.extent]);
    let (x, y) = (line.spread_in_rows::<0>(), line.spread_in_rows::<1>());
    let (slope, double_conditional) = (line.spread_in_rows::<2>(), line.spread_in_rows::<3>());
    let (reach, fall) = (extent.spread_in_rows::<0>(), extent.spread_in_rows::<1>());
    let (half_height, rightmost) = (extent.spread_in_rows::<2>(), extent.spread_in_rows::<3>());
    let (zero, small) = (S::splat(0.0), S::splat(4e-6));
    let height = half_height.mul_add(small, half_height).add(S::splat(1e-3));
    let above = S::load(&edges[0]).sub(y).max(zero.sub(height));
    let below = S::load(&edges[1]).sub(y).min(height);
    let half = |dy: S| {
        let root = dy.mul(fall);
        reach.sub(root.mul(root)).max(zero).mul(double_conditional).sqrt()
    };
    let (left_row, right_row) = (zero.sub(rightmost).max(above).min(below), rightmost.max(above).min(below));
    let (left_shift, right_shift) = (slope.mul(left_row), slope.mul(right_row));
    let (left_half, right_half) = (half(left_row), half(right_row));
    let magnitude = x.mul(x).add(left_shift.mul(left_shift)).add(right_shift.mul(right_shift));
    let magnitude = magnitude.add(left_half.mul(left_half)).add(right_half.mul(right_half)).sqrt();
    let margin = magnitude.mul_add(small, S::splat(1e-3 + 0.5));
    let low = x.add(left_shift).sub(left_half).sub(margin);
    let high = x.add(right_shift).add(right_half).add(margin).sub(S::splat(1.0));
    let low = low.ceil().max(zero);
    let high = high.floor().min(S::splat(width as f32 - 1.0));
    let is_reached = S::both(below.ge(above), high.ge(low));
    let quarter = S::splat(1.0 / BLOCK as f32);
    let (mut first, mut last) = ([0; LANES], [0; LANES]);
    S::select(is_reached, low.mul(quarter).floor(), S::splat(NOWHERE)).store_integers(&mut first);
    S::select(is_reached, high.mul(quarter).floor(), S::splat(-1.0)).store_integers(&mut last);
    let mut spans = [Spans::default(); ROWS];
    for lane in 0..LANES {
        let spans = &mut spans[lane / BLOCK_ROWS];
        spans.first[lane % BLOCK_ROWS] = first[lane];
        spans.end[lane % BLOCK_ROWS] = last[lane] + 1;
    }
    spans
}
