//! Exhaustive search on a small image: finds displacements that no pyramid can follow.
//!
//! One cost volume serves both directions: the best match of `x` in the second image and the best match of `y` in
//! the first are the minima over the same costs.

use super::{flow::Flow, planes::Planes};

/// The best match of every pixel of one image in the other, in pixels of the searched level.
pub(super) struct CoarseMatches {
    pub(super) forward: Flow,
    pub(super) backward: Flow,
}

/// Half side of the compared windows.
const RADIUS: usize = 2;
/// Half side of the windows whose mean is removed first. Wide, so that a patch keeps its colour.
const HIGH_PASS_RADIUS: usize = 6;

struct Best {
    cost: Vec<f32>,
    label: Vec<u32>,
}

impl Best {
    fn new(pixels: usize) -> Self {
        Self { cost: vec![f32::INFINITY; pixels], label: vec![0; pixels] }
    }

    fn offer(&mut self, first: usize, costs: &[f32], label: u32) {
        let best = self.cost[first..first + costs.len()].iter_mut();
        let labels = self.label[first..first + costs.len()].iter_mut();
        for ((best, chosen), &cost) in best.zip(labels).zip(costs) {
            *chosen = if cost < *best { label } else { *chosen };
            *best = best.min(cost);
        }
    }

    fn into_flow(self, width: usize, displacements: &[[i32; 2]], sign: f32) -> Flow {
        let height = self.label.len() / width;
        let axis = |axis: usize| -> Vec<f32> {
            self.label.iter().map(|&label| sign * displacements[label as usize][axis] as f32).collect()
        };
        Flow { width, height, u: axis(0), v: axis(1) }
    }
}

/// Compares every pixel's window with all windows at most `radius` pixels away along either axis.
///
/// Of equal costs the smallest displacement wins, so identical images match at zero.
pub(super) fn search(first: &Planes, second: &Planes, radius: usize) -> CoarseMatches {
    let (width, height) = (first.width, first.height);
    let first = smoothed(&first.high_passed(HIGH_PASS_RADIUS));
    let second = smoothed(&second.high_passed(HIGH_PASS_RADIUS));
    let displacements = displacements_by_length(radius.min(width - 1), radius.min(height - 1));

    let mut scratch = Scratch::default();
    let mut energy = |planes: &Planes| {
        let mut sums = vec![0.0; width * height];
        scratch.for_each_row(planes, planes, [0, 0], |y, row| {
            sums[y * width..(y + 1) * width].copy_from_slice(row);
        });
        sums
    };
    let (first_energy, second_energy) = (energy(&first), energy(&second));

    let mut forward = Best::new(width * height);
    let mut backward = Best::new(width * height);
    let mut costs = vec![0.0f32; width];
    for (label, &[dx, dy]) in displacements.iter().enumerate() {
        let from_x = (-dx).max(0) as usize;
        scratch.for_each_row(&first, &second, [dx, dy], |y, row| {
            let at_first = y * width + from_x;
            let at_second = (at_first as i64 + dy as i64 * width as i64 + dx as i64) as usize;
            let costs = &mut costs[..row.len()];
            let first_energy = &first_energy[at_first..at_first + row.len()];
            let second_energy = &second_energy[at_second..at_second + row.len()];
            for i in 0..costs.len() {
                costs[i] = (first_energy[i] - 2.0 * row[i]) + second_energy[i];
            }
            forward.offer(at_first, costs, label as u32);
            backward.offer(at_second, costs, label as u32);
        });
    }
    CoarseMatches {
        forward: forward.into_flow(width, &displacements, 1.0),
        backward: backward.into_flow(width, &displacements, -1.0),
    }
}

/// Binomial smoothing: a displacement of half a coarse pixel must not hide a match.
fn smoothed(planes: &Planes) -> Planes {
    let interiors = planes.interiors().map(|channel| {
        // Two box filters of different size approximate the binomial well enough.
        let (width, height) = (planes.width, planes.height);
        let box3 = super::planes::box_mean(&channel, width, height, 1);
        channel.iter().zip(&box3).map(|(value, mean)| 0.5 * (value + mean)).collect()
    });
    Planes::from_interiors(planes.width, planes.height, interiors)
}

fn displacements_by_length(radius_x: usize, radius_y: usize) -> Vec<[i32; 2]> {
    let (rx, ry) = (radius_x as i32, radius_y as i32);
    let mut all: Vec<[i32; 2]> = (-ry..=ry).flat_map(|dy| (-rx..=rx).map(move |dx| [dx, dy])).collect();
    all.sort_by_key(|&[dx, dy]| (dx * dx + dy * dy, dy, dx));
    all
}

/// Window sums of the products of two images, one shifted, computed without allocating per displacement.
#[derive(Default)]
struct Scratch {
    products: Vec<f32>,
    sums: Vec<f32>,
    row: Vec<f32>,
}

impl Scratch {
    /// Calls `visit(y, sums)` for each row `y` of `first` that `second` shifted by `(dx, dy)` overlaps, with the sums
    /// for the columns that overlap.
    fn for_each_row(
        &mut self,
        first: &Planes,
        second: &Planes,
        [dx, dy]: [i32; 2],
        mut visit: impl FnMut(usize, &[f32]),
    ) {
        let overlap = |size: usize, shift: i32| {
            let (size, shift) = (size as i32, shift);
            ((-shift).max(0) as usize, (size - shift).min(size) as usize)
        };
        let (x0, x1) = overlap(first.width, dx);
        let (y0, y1) = overlap(first.height, dy);
        let columns = x1 - x0;
        let padded = columns + 2 * RADIUS;
        let window = 2 * RADIUS + 1;
        self.products.resize(padded, 0.0);
        self.sums.resize((y1 - y0 + 2 * RADIUS) * columns, 0.0);
        self.row.resize(columns, 0.0);

        let border = super::planes::BORDER;
        for (line, sums) in self.sums.chunks_exact_mut(columns).enumerate() {
            let at = (y0 + line + border - RADIUS) * first.stride + x0 + border - RADIUS;
            let shifted = (at as i64 + dy as i64 * second.stride as i64 + dx as i64) as usize;
            let a = [0, 1, 2].map(|channel: usize| &first.channels[channel][at..at + padded]);
            let b = [0, 1, 2].map(|channel: usize| &second.channels[channel][shifted..shifted + padded]);
            for i in 0..padded {
                self.products[i] = a[0][i] * b[0][i] + a[1][i] * b[1][i] + a[2][i] * b[2][i];
            }
            let shifts: [&[f32]; 2 * RADIUS + 1] = std::array::from_fn(|s| &self.products[s..s + columns]);
            for i in 0..columns {
                sums[i] = shifts[0][i] + shifts[1][i] + shifts[2][i] + shifts[3][i] + shifts[4][i];
            }
        }
        for y in y0..y1 {
            let lines: [&[f32]; 2 * RADIUS + 1] = std::array::from_fn(|line| {
                let from = (y - y0 + line) * columns;
                &self.sums[from..from + columns]
            });
            debug_assert_eq!(lines.len(), window);
            let row = &mut self.row[..columns];
            for i in 0..columns {
                row[i] = lines[0][i] + lines[1][i] + lines[2][i] + lines[3][i] + lines[4][i];
            }
            visit(y, row);
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};

    use super::*;

    #[test]
    fn shifts_up_to_the_radius_are_found_both_ways() {
        let (width, height) = (40, 30);
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        let wide: Vec<[f32; 3]> =
            (0..100 * 100).map(|_| random.random::<[f32; 3]>().map(|v| 255.0 * v)).collect();
        let crop = |x0: usize, y0: usize| {
            let channel = |c: usize| {
                let at = |i: usize| wide[(y0 + i / width) * 100 + x0 + i % width][c];
                (0..width * height).map(at).collect()
            };
            Planes::from_interiors(width, height, [channel(0), channel(1), channel(2)])
        };
        let matches = search(&crop(30, 30), &crop(19, 36), 12);
        let (mut right, mut all) = (0, 0);
        for y in 10..height - 10 {
            for x in 3..width - 15 {
                all += 2;
                right += usize::from(matches.forward.at(x, y) == [11.0, -6.0]);
                right += usize::from(matches.backward.at(x + 11, y - 6) == [-11.0, 6.0]);
            }
        }
        assert_eq!(right, all);
        let limited = search(&crop(30, 30), &crop(19, 36), 5);
        assert!(limited.forward.u.iter().chain(&limited.backward.v).all(|&value| value.abs() <= 5.0));
        assert_eq!(search(&crop(0, 0), &crop(0, 0), 12).forward, Flow::zeros(width, height));
    }
}
