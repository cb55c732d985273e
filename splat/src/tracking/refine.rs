//! Variational refinement: robust colour constancy against edge-aware smoothness, linearised around the given flow.
//! It fills untextured areas from their surroundings and takes the patch grid out of the flow.

use super::{
    TrackingSettings,
    flow::Flow,
    patches::Reference,
    planes::{Planes, box_mean},
};

/// Residual at which the data term turns from quadratic to linear, 0 to 255 scale.
const RESIDUAL_SCALE: f32 = 4.0;
/// Flow difference between neighbours at which the smoothness turns from quadratic to linear, pixels.
const DIFFERENCE_SCALE: f32 = 0.3;
/// Weight of staying: keeps pixels without neighbour or texture where they are.
const HOLD: f32 = 1e-4;
/// Colour difference between neighbours that halves their smoothness, 0 to 255 scale.
const EDGE_SCALE: f32 = 40.0;
/// Half side of the window whose mean residual is not counted: shading and exposure.
const SHADING_RADIUS: usize = 4;

/// How strongly and how long to smooth.
#[derive(Clone, Copy)]
pub(super) struct Smoothing {
    /// Weight of smoothness against colour constancy.
    pub(super) weight: f32,
    /// How often the residuals are linearised anew.
    pub(super) warps: u32,
    /// Half side of the windows that share one displacement in the data term, pixels.
    pub(super) window: u32,
    /// Sweeps over the image per linearisation.
    pub(super) iterations: u32,
}

impl Smoothing {
    pub(super) fn of(settings: &TrackingSettings) -> Self {
        Self {
            weight: settings.smoothness,
            warps: settings.smoothing_warps,
            window: settings.smoothing_window,
            iterations: settings.smoothing_iterations,
        }
    }
}

/// Refines `flow` from `reference` to `target`; where `trust` is given and false, colour does not count.
pub(super) fn refine(
    reference: &Reference<'_>,
    target: &Reference<'_>,
    flow: &Flow,
    trust: Option<&[bool]>,
    smoothing: Smoothing,
) -> Flow {
    if smoothing.iterations == 0 {
        return flow.clone();
    }
    let mut start = flow.clone();
    for _ in 0..smoothing.warps {
        let equations = Equations::new(reference, target, &start, trust, smoothing);
        start = equations.relaxed(&start, smoothing.iterations);
    }
    start
}

/// `xx du + xy dv + x = 0`, `xy du + yy dv + y = 0` per pixel: the normal equations of the linearised residuals.
struct DataTerm {
    xx: Vec<f32>,
    xy: Vec<f32>,
    yy: Vec<f32>,
    x: Vec<f32>,
    y: Vec<f32>,
}

impl DataTerm {
    fn new(
        reference: &Reference<'_>,
        target: &Reference<'_>,
        flow: &Flow,
        trust: Option<&[bool]>,
        window: usize,
    ) -> Self {
        let (width, height) = (flow.width, flow.height);
        let residuals = residuals(reference.planes, target.planes, flow)
            .map(|channel| subtract(&channel, &box_mean(&channel, width, height, SHADING_RADIUS)));
        let mut term = Self {
            xx: vec![0.0; width * height],
            xy: vec![0.0; width * height],
            yy: vec![0.0; width * height],
            x: vec![0.0; width * height],
            y: vec![0.0; width * height],
        };
        for y in 0..height {
            let line = y * width..(y + 1) * width;
            let residual = [0, 1, 2].map(|channel: usize| &residuals[channel][line.clone()]);
            let (xx, xy, yy) =
                (&mut term.xx[line.clone()], &mut term.xy[line.clone()], &mut term.yy[line.clone()]);
            let (right_x, right_y) = (&mut term.x[line.clone()], &mut term.y[line.clone()]);
            for i in 0..width {
                let r = [residual[0][i], residual[1][i], residual[2][i]];
                // The target's gradients: those of the reference are turned and sheared against it.
                let [u, v] = flow.at(i, y);
                let [gx, gy] =
                    target.gradients.each_ref().map(|planes| planes.colour_at(i as f32 + u, y as f32 + v));
                let squares = (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]) * (1.0 / 3.0);
                let trusted = trust.is_none_or(|trust| trust[line.start + i]);
                let weight =
                    if trusted { 1.0 / (squares + RESIDUAL_SCALE * RESIDUAL_SCALE).sqrt() } else { 0.0 };
                xx[i] = weight * (gx[0] * gx[0] + gx[1] * gx[1] + gx[2] * gx[2]);
                xy[i] = weight * (gx[0] * gy[0] + gx[1] * gy[1] + gx[2] * gy[2]);
                yy[i] = weight * (gy[0] * gy[0] + gy[1] * gy[1] + gy[2] * gy[2]);
                right_x[i] = weight * (gx[0] * r[0] + gx[1] * r[1] + gx[2] * r[2]);
                right_y[i] = weight * (gy[0] * r[0] + gy[1] * r[1] + gy[2] * r[2]);
            }
        }
        for values in [&mut term.xx, &mut term.xy, &mut term.yy, &mut term.x, &mut term.y] {
            *values = box_mean(values, width, height, window);
        }
        term
    }
}

/// The target, fetched along the flow, minus the reference.
pub(super) fn residuals(reference: &Planes, target: &Planes, flow: &Flow) -> [Vec<f32>; 3] {
    let (width, height) = (flow.width, flow.height);
    let mut residuals = [(); 3].map(|()| Vec::with_capacity(width * height));
    for y in 0..height {
        let here = [0, 1, 2].map(|channel| reference.row(channel, y));
        for x in 0..width {
            let [u, v] = flow.at(x, y);
            let there = target.colour_at(x as f32 + u, y as f32 + v);
            for channel in 0..3 {
                residuals[channel].push(there[channel] - here[channel][x]);
            }
        }
    }
    residuals
}

fn subtract(a: &[f32], b: &[f32]) -> Vec<f32> {
    a.iter().zip(b).map(|(a, b)| a - b).collect()
}

/// Smoothness weights of each pixel with its left and its upper neighbour; 0 across the image's edge. One more column
/// and row than the image, so that the weight with the right neighbour is the next entry, the lower one a row on.
struct Links {
    left: Vec<f32>,
    up: Vec<f32>,
}

impl Links {
    fn new(planes: &Planes, flow: &Flow, weight: f32) -> Self {
        let (width, height) = (flow.width, flow.height);
        let link = |i: usize, j: usize, colour_difference: f32| {
            let (du, dv) = (flow.u[i] - flow.u[j], flow.v[i] - flow.v[j]);
            let edge = 1.0 + colour_difference / (EDGE_SCALE * EDGE_SCALE);
            weight / (edge * ((du * du + dv * dv) / (DIFFERENCE_SCALE * DIFFERENCE_SCALE) + 1.0).sqrt())
        };
        let mut links = Self { left: vec![0.0; width * (height + 1)], up: vec![0.0; width * (height + 1)] };
        for y in 0..height {
            let rows = [0, 1, 2].map(|channel| planes.row(channel, y));
            let above = [0, 1, 2].map(|channel| planes.row(channel, y.saturating_sub(1)));
            for x in 0..width {
                let i = y * width + x;
                let difference = |other: [&[f32]; 3], at: usize| {
                    let off = [0, 1, 2].map(|channel: usize| rows[channel][x] - other[channel][at]);
                    (off[0] * off[0] + off[1] * off[1] + off[2] * off[2]) / 3.0
                };
                if x > 0 {
                    links.left[i] = link(i, i - 1, difference(rows, x - 1));
                }
                if y > 0 {
                    links.up[i] = link(i, i - width, difference(above, x));
                }
            }
        }
        links
    }
}

/// Per pixel two linear equations, coupled with the four neighbours.
struct Equations {
    data: DataTerm,
    links: Links,
    /// Constant right-hand sides.
    right: Flow,
}

impl Equations {
    fn new(
        reference: &Reference<'_>,
        target: &Reference<'_>,
        start: &Flow,
        trust: Option<&[bool]>,
        smoothing: Smoothing,
    ) -> Self {
        let data = DataTerm::new(reference, target, start, trust, smoothing.window as usize);
        let links = Links::new(reference.planes, start, smoothing.weight);
        let (width, height) = (start.width, start.height);
        let mut right = Flow::zeros(width, height);
        for i in 0..width * height {
            let (u0, v0) = (start.u[i], start.v[i]);
            right.u[i] = data.xx[i] * u0 + data.xy[i] * v0 - data.x[i] + HOLD * u0;
            right.v[i] = data.xy[i] * u0 + data.yy[i] * v0 - data.y[i] + HOLD * v0;
        }
        Self { data, links, right }
    }

    /// Jacobi sweeps: each pixel solves its equations with its neighbours held.
    fn relaxed(&self, start: &Flow, sweeps: u32) -> Flow {
        let (width, height) = (start.width, start.height);
        // A row before and after, so that every neighbour exists; its links are 0.
        let padded = |axis: &[f32]| [&vec![0.0; width], axis, &vec![0.0; width]].concat();
        let mut current = [padded(&start.u), padded(&start.v)];
        let mut next = current.clone();
        for _ in 0..sweeps {
            for y in 0..height {
                self.sweep_row(y, width, &current, &mut next);
            }
            std::mem::swap(&mut current, &mut next);
        }
        let [u, v] = current.map(|axis| axis[width..width * (height + 1)].to_vec());
        Flow { width, height, u, v }
    }

    fn sweep_row(&self, y: usize, width: usize, current: &[Vec<f32>; 2], next: &mut [Vec<f32>; 2]) {
        let (first, centre) = (y * width, (y + 1) * width);
        let slice = |from: usize| from..from + width;
        let (left, up) = (&self.links.left[slice(first)], &self.links.up[slice(first)]);
        // The last row's last pixel has its right link at the start of the spare row.
        let (right, down) = (&self.links.left[slice(first + 1)], &self.links.up[slice(first + width)]);
        let data = &self.data;
        let (xx, xy, yy) = (&data.xx[slice(first)], &data.xy[slice(first)], &data.yy[slice(first)]);
        let (right_u, right_v) = (&self.right.u[slice(first)], &self.right.v[slice(first)]);
        let [u, v] = current.each_ref().map(|values| {
            [centre - 1, centre - width, centre + 1, centre + width].map(|from| &values[slice(from)])
        });
        let [next_u, next_v] = next;
        let (next_u, next_v) = (&mut next_u[slice(centre)], &mut next_v[slice(centre)]);
        for i in 0..width {
            let total = left[i] + up[i] + right[i] + down[i] + HOLD;
            let pull_u =
                left[i] * u[0][i] + up[i] * u[1][i] + right[i] * u[2][i] + down[i] * u[3][i] + right_u[i];
            let pull_v =
                left[i] * v[0][i] + up[i] * v[1][i] + right[i] * v[2][i] + down[i] * v[3][i] + right_v[i];
            let (a, b, c) = (xx[i] + total, xy[i], yy[i] + total);
            let inverse = 1.0 / (a * c - b * b);
            next_u[i] = (c * pull_u - b * pull_v) * inverse;
            next_v[i] = (a * pull_v - b * pull_u) * inverse;
        }
    }
}
