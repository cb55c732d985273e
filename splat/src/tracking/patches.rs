//! Dense inverse search: patches of the reference image, each matched in the target image by inverse-compositional
//! gradient descent on the mean-normalised squared difference, with candidates handed from neighbour to neighbour
//! (Kroeger et al., "Fast optical flow using dense inverse search", 2016).

use super::{
    flow::Flow,
    planes::{PATCH, PATCH_VALUES, Patch, Planes},
};

/// Variance of image noise on the 0 to 255 scale that damps badly conditioned patches.
const NOISE_VARIANCE: f32 = 9.0;
/// Expected distance of a start from the optimum, pixels: the prior of the damping.
const START_DEVIATION: f32 = 2.0;
/// How much a difference of mean colour counts against a candidate; 1 would be the plain squared difference.
/// Shadows and exposure change the mean, but between equally textured candidates the colour decides.
const MEAN_WEIGHT: f32 = 0.1;
/// Candidates closer than this to one already tried are not tried again, pixels.
const SAME_CANDIDATE: f32 = 0.1;

/// Patches on a regular grid and where they went.
pub(super) struct PatchField {
    pub(super) columns: usize,
    pub(super) rows: usize,
    /// Top-left pixel of each patch column and of each patch row.
    pub(super) xs: Vec<usize>,
    pub(super) ys: Vec<usize>,
    pub(super) displacement: Vec<[f32; 2]>,
    /// Squared difference of the patch, summed over its values.
    pub(super) cost: Vec<f32>,
}

/// One level of the frame that patches are taken from.
pub(super) struct Reference<'a> {
    pub(super) planes: &'a Planes,
    pub(super) gradients: &'a [Planes; 2],
}

struct Template {
    values: Patch,
    gradient: [Patch; 2],
    /// Damped Gauss-Newton matrix `xx, xy, yy`.
    matrix: [f32; 3],
}

const DAMPING: f32 = NOISE_VARIANCE / (START_DEVIATION * START_DEVIATION);

impl Template {
    fn new(reference: &Reference<'_>, x: usize, y: usize) -> Self {
        let gradient = [0, 1].map(|axis: usize| centred(&reference.gradients[axis].patch(x, y)));
        let matrix = [
            dot(&gradient[0], &gradient[0]) + DAMPING,
            dot(&gradient[0], &gradient[1]),
            dot(&gradient[1], &gradient[1]) + DAMPING,
        ];
        Self { values: reference.planes.patch(x, y), gradient, matrix }
    }

    /// The difference image of the patch, and its cost.
    fn compare(&self, target: &Planes, x: f32, y: f32) -> (Patch, f32) {
        let mut difference = target.patch_at(x, y);
        difference.iter_mut().zip(&self.values).for_each(|(there, here)| *there -= here);
        let mut cost = 0.0;
        for channel in difference.as_chunks::<{ PATCH * PATCH }>().0 {
            let (sum, squares) = sums(channel);
            cost += squares - (1.0 - MEAN_WEIGHT) * sum * sum / (PATCH * PATCH) as f32;
        }
        (difference, cost.max(0.0))
    }

    /// The step that Gauss-Newton takes from a difference image, with the prior on the distance to the start.
    fn step(&self, difference: &Patch, from_start: [f32; 2]) -> [f32; 2] {
        let right = [0, 1].map(|axis| dot(&self.gradient[axis], difference) + DAMPING * from_start[axis]);
        let [xx, xy, yy] = self.matrix;
        // Positive: the damping is added to a positive semidefinite matrix.
        let determinant = xx * yy - xy * xy;
        [(yy * right[0] - xy * right[1]) / determinant, (xx * right[1] - xy * right[0]) / determinant]
    }
}

fn sums(values: &[f32; PATCH * PATCH]) -> (f32, f32) {
    let mut sum = [0.0f32; PATCH];
    let mut squares = [0.0f32; PATCH];
    for row in values.as_chunks::<PATCH>().0 {
        for i in 0..PATCH {
            sum[i] += row[i];
            squares[i] += row[i] * row[i];
        }
    }
    (sum.iter().sum(), squares.iter().sum())
}

fn dot(a: &Patch, b: &Patch) -> f32 {
    let mut lanes = [0.0f32; PATCH];
    for (a, b) in a.as_chunks::<PATCH>().0.iter().zip(b.as_chunks::<PATCH>().0) {
        for i in 0..PATCH {
            lanes[i] += a[i] * b[i];
        }
    }
    lanes.iter().sum()
}

/// The patch minus the mean of each channel: products with it ignore a constant offset.
fn centred(patch: &Patch) -> Patch {
    let mut out = [0.0; PATCH_VALUES];
    let channels = patch.as_chunks::<{ PATCH * PATCH }>().0.iter();
    for (channel, out) in channels.zip(out.as_chunks_mut::<{ PATCH * PATCH }>().0) {
        let mean = sums(channel).0 / (PATCH * PATCH) as f32;
        out.iter_mut().zip(channel).for_each(|(out, value)| *out = value - mean);
    }
    out
}

/// Positions of patches along an axis: every `stride` pixels, the last one flush with the end.
fn grid(size: usize, stride: usize) -> Vec<usize> {
    let last = size.saturating_sub(PATCH);
    let mut at: Vec<usize> = (0..last).step_by(stride.max(1)).collect();
    at.push(last);
    at
}

struct Search<'a> {
    target: &'a Planes,
    iterations: u32,
}

impl Search<'_> {
    /// The best of the candidates, improved by descent.
    fn improve(&self, template: &Template, x: f32, y: f32, candidates: &[[f32; 2]]) -> ([f32; 2], f32) {
        let mut tried: [[f32; 2]; 12] = [[f32::INFINITY; 2]; 12];
        let mut best = ([0.0; 2], f32::INFINITY);
        for (n, &candidate) in candidates.iter().enumerate() {
            let known = |seen: &[f32; 2]| {
                (seen[0] - candidate[0]).abs() + (seen[1] - candidate[1]).abs() < SAME_CANDIDATE
            };
            if tried.iter().any(known) {
                continue;
            }
            tried[n % 12] = candidate;
            let (_, cost) = template.compare(self.target, x + candidate[0], y + candidate[1]);
            if cost < best.1 {
                best = (candidate, cost);
            }
        }
        self.descend(template, x, y, best)
    }

    fn descend(&self, template: &Template, x: f32, y: f32, start: ([f32; 2], f32)) -> ([f32; 2], f32) {
        let mut best = start;
        let mut at = start.0;
        for _ in 0..self.iterations {
            let (difference, cost) = template.compare(self.target, x + at[0], y + at[1]);
            if cost > best.1 {
                break;
            }
            best = (at, cost);
            let from_start = [at[0] - start.0[0], at[1] - start.0[1]];
            let step = template.step(&difference, from_start);
            at = [at[0] - step[0], at[1] - step[1]];
            let moved = (at[0] - start.0[0]).abs().max((at[1] - start.0[1]).abs());
            let settled = step[0].abs().max(step[1].abs()) < 0.01;
            // A patch that runs away from its start has left the basin that the start was chosen for.
            if settled || moved > PATCH as f32 || !moved.is_finite() {
                break;
            }
        }
        best
    }
}

/// Matches every patch of `reference` in `target`.
///
/// Candidates of a patch are the fields of `guesses` at its centre, zero, and what its neighbours found: those
/// left and above in the first pass, those right and below in the second.
pub(super) fn search(
    reference: &Reference<'_>,
    target: &Planes,
    guesses: &[&Flow],
    stride: usize,
    iterations: u32,
) -> PatchField {
    let (width, height) = (reference.planes.width, reference.planes.height);
    let (xs, ys) = (grid(width, stride), grid(height, stride));
    let (columns, rows) = (xs.len(), ys.len());
    let mut displacement = vec![[0.0f32; 2]; columns * rows];
    let mut cost = vec![f32::INFINITY; columns * rows];
    let pass = Search { target, iterations: iterations.div_ceil(2) };
    let mut candidates: Vec<[f32; 2]> = Vec::new();

    for j in 0..rows {
        for i in 0..columns {
            let at = j * columns + i;
            let (x, y) = (xs[i], ys[j]);
            candidates.clear();
            candidates.push([0.0; 2]);
            let centre = ((x + PATCH / 2).min(width - 1), (y + PATCH / 2).min(height - 1));
            candidates.extend(guesses.iter().map(|guess| guess.at(centre.0, centre.1)));
            let neighbours = [(i > 0, 1), (j > 0, columns), (i > 0 && j > 0, columns + 1)];
            candidates.extend(
                neighbours.iter().filter(|(exists, _)| *exists).map(|&(_, back)| displacement[at - back]),
            );
            let template = Template::new(reference, x, y);
            (displacement[at], cost[at]) = pass.improve(&template, x as f32, y as f32, &candidates);
        }
    }
    for j in (0..rows).rev() {
        for i in (0..columns).rev() {
            let at = j * columns + i;
            candidates.clear();
            candidates.push(displacement[at]);
            let (right, below) = (i + 1 < columns, j + 1 < rows);
            let neighbours = [(right, 1), (below, columns), (right && below, columns + 1)];
            candidates.extend(
                neighbours.iter().filter(|(exists, _)| *exists).map(|&(_, ahead)| displacement[at + ahead]),
            );
            let template = Template::new(reference, xs[i], ys[j]);
            (displacement[at], cost[at]) = pass.improve(&template, xs[i] as f32, ys[j] as f32, &candidates);
        }
    }
    PatchField { columns, rows, xs, ys, displacement, cost }
}

/// Residual at which a pixel stops to believe a patch, on the 0 to 255 scale.
const RESIDUAL_SCALE: f32 = 6.0;
/// Displacements closer than this belong to the same motion and are averaged, pixels.
const SAME_MOTION: f32 = 1.0;

/// One displacement per pixel from the patches that cover it: the patch that explains the pixel best picks the
/// motion, patches that agree with it are averaged. Averaging over different motions would put pixels of an edge
/// between them.
pub(super) fn densify(reference: &Planes, target: &Planes, field: &PatchField) -> Flow {
    let (width, height) = (reference.width, reference.height);
    let weights: Vec<[f32; PATCH * PATCH]> =
        (0..field.columns * field.rows).map(|at| pixel_weights(reference, target, field, at)).collect();

    let mut best_weight = vec![-1.0f32; width * height];
    let mut best = vec![[0.0f32; 2]; width * height];
    for_each_pixel(field, width, height, |pixel, patch, inside| {
        if weights[patch][inside] > best_weight[pixel] {
            best_weight[pixel] = weights[patch][inside];
            best[pixel] = field.displacement[patch];
        }
    });
    let mut flow = Flow::zeros(width, height);
    let mut total = vec![0.0f32; width * height];
    for_each_pixel(field, width, height, |pixel, patch, inside| {
        let [u, v] = field.displacement[patch];
        if (u - best[pixel][0]).abs().max((v - best[pixel][1]).abs()) > SAME_MOTION {
            return;
        }
        let weight = weights[patch][inside];
        flow.u[pixel] += weight * u;
        flow.v[pixel] += weight * v;
        total[pixel] += weight;
    });
    // Every pixel is covered, and weights are positive.
    for axis in [&mut flow.u, &mut flow.v] {
        axis.iter_mut().zip(&total).for_each(|(value, total)| *value /= total);
    }
    flow
}

/// Calls `visit(pixel, patch, index in patch)` for each pixel of the image that a patch covers.
fn for_each_pixel(
    field: &PatchField,
    width: usize,
    height: usize,
    mut visit: impl FnMut(usize, usize, usize),
) {
    for (j, &y) in field.ys.iter().enumerate() {
        for (i, &x) in field.xs.iter().enumerate() {
            for row in 0..PATCH.min(height - y) {
                for column in 0..PATCH.min(width - x) {
                    visit((y + row) * width + x + column, j * field.columns + i, row * PATCH + column);
                }
            }
        }
    }
}

fn pixel_weights(reference: &Planes, target: &Planes, field: &PatchField, at: usize) -> [f32; PATCH * PATCH] {
    let (x, y) = (field.xs[at % field.columns], field.ys[at / field.columns]);
    let [u, v] = field.displacement[at];
    let mut difference = target.patch_at(x as f32 + u, y as f32 + v);
    difference.iter_mut().zip(&reference.patch(x, y)).for_each(|(there, here)| *there -= here);
    let difference = centred(&difference);
    let (r, g, b) = (&difference[..64], &difference[64..128], &difference[128..]);
    let scale = RESIDUAL_SCALE * RESIDUAL_SCALE;
    let patch = 1.0 / (scale + field.cost[at] / PATCH_VALUES as f32);
    std::array::from_fn(|i| patch / (scale + (r[i] * r[i] + g[i] * g[i] + b[i] * b[i]) / 3.0))
}
