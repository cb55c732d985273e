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
/// Colour difference between neighbours that halves their smoothness, 0 to 255 scale.
const EDGE_SCALE: f32 = 12.0;
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
    target: &Planes,
    flow: &Flow,
    trust: Option<&[bool]>,
    smoothing: Smoothing,
) -> Flow {
    if smoothing.iterations == 0 {
        return flow.clone();
    }
    let mut current = flow.clone();
    let mut next = flow.clone();
    for _ in 0..smoothing.warps {
        let start = current.clone();
        let data = DataTerm::new(reference, target, &start, trust, smoothing.window as usize);
        let links = Links::new(reference.planes, &start, smoothing.weight);
        for _ in 0..smoothing.iterations {
            sweep(&start, &data, &links, &current, &mut next);
            std::mem::swap(&mut current, &mut next);
        }
    }
    current
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
    fn new(reference: &Reference<'_>, target: &Planes, flow: &Flow, trust: Option<&[bool]>, window: usize) -> Self {
        let (width, height) = (flow.width, flow.height);
        let residuals = residuals(reference.planes, target, flow)
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
            let gradient_x = [0, 1, 2].map(|channel: usize| reference.gradients[0].row(channel, y));
            let gradient_y = [0, 1, 2].map(|channel: usize| reference.gradients[1].row(channel, y));
            let residual = [0, 1, 2].map(|channel: usize| &residuals[channel][line.clone()]);
            let (xx, xy, yy) = (&mut term.xx[line.clone()], &mut term.xy[line.clone()], &mut term.yy[line.clone()]);
            let (right_x, right_y) = (&mut term.x[line.clone()], &mut term.y[line.clone()]);
            for i in 0..width {
                let r = [residual[0][i], residual[1][i], residual[2][i]];
                let gx = [gradient_x[0][i], gradient_x[1][i], gradient_x[2][i]];
                let gy = [gradient_y[0][i], gradient_y[1][i], gradient_y[2][i]];
                let squares = (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]) * (1.0 / 3.0);
                let trusted = trust.is_none_or(|trust| trust[line.start + i]);
                let weight = if trusted { 1.0 / (squares + RESIDUAL_SCALE * RESIDUAL_SCALE).sqrt() } else { 0.0 };
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

/// Smoothness weights of each pixel with its right and its lower neighbour; 0 across the image's edge.
struct Links {
    right: Vec<f32>,
    down: Vec<f32>,
}

impl Links {
    fn new(planes: &Planes, flow: &Flow, weight: f32) -> Self {
        let (width, height) = (flow.width, flow.height);
        let link = |i: usize, j: usize, colour_difference: f32| {
            let (du, dv) = (flow.u[i] - flow.u[j], flow.v[i] - flow.v[j]);
            let edge = 1.0 + colour_difference / (EDGE_SCALE * EDGE_SCALE);
            weight / (edge * ((du * du + dv * dv) / (DIFFERENCE_SCALE * DIFFERENCE_SCALE) + 1.0).sqrt())
        };
        let mut links = Self { right: vec![0.0; width * height], down: vec![0.0; width * height] };
        for y in 0..height {
            let rows = [0, 1, 2].map(|channel| planes.row(channel, y));
            let below = [0, 1, 2].map(|channel| planes.row(channel, (y + 1).min(height - 1)));
            for x in 0..width {
                let i = y * width + x;
                let difference = |other: [f32; 3]| -> f32 {
                    (0..3).map(|channel| (rows[channel][x] - other[channel]).powi(2)).sum::<f32>() / 3.0
                };
                if x + 1 < width {
                    links.right[i] = link(i, i + 1, difference([0, 1, 2].map(|c: usize| rows[c][x + 1])));
                }
                if y + 1 < height {
                    links.down[i] = link(i, i + width, difference([0, 1, 2].map(|c: usize| below[c][x])));
                }
            }
        }
        links
    }
}

/// One Jacobi sweep: each pixel solves its two equations with its neighbours held.
fn sweep(start: &Flow, data: &DataTerm, links: &Links, current: &Flow, next: &mut Flow) {
    let (width, height) = (start.width, start.height);
    for y in 0..height {
        for x in 0..width {
            let i = y * width + x;
            let (left, up) = (if x > 0 { i - 1 } else { i }, if y > 0 { i - width } else { i });
            let (right, down) = ((i + 1).min(width * height - 1), (i + width).min(width * height - 1));
            let s = [
                if x > 0 { links.right[left] } else { 0.0 },
                if y > 0 { links.down[up] } else { 0.0 },
                links.right[i],
                links.down[i],
            ];
            let total = s[0] + s[1] + s[2] + s[3];
            let mean = |axis: &[f32]| s[0] * axis[left] + s[1] * axis[up] + s[2] * axis[right] + s[3] * axis[down];
            // Without a neighbour or texture the pixel stays.
            let hold = 1e-6;
            let (u0, v0) = (start.u[i], start.v[i]);
            let a = data.xx[i] + total + hold;
            let c = data.yy[i] + total + hold;
            let b = data.xy[i];
            let right_u = mean(&current.u) + data.xx[i] * u0 + b * v0 - data.x[i] + hold * u0;
            let right_v = mean(&current.v) + data.yy[i] * v0 + b * u0 - data.y[i] + hold * v0;
            let determinant = a * c - b * b;
            next.u[i] = (c * right_u - b * right_v) / determinant;
            next.v[i] = (a * right_v - b * right_u) / determinant;
        }
    }
}
