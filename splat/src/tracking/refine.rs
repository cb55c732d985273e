//! Variational refinement: robust colour constancy against edge-aware smoothness, linearised around the given flow.
//! It fills untextured areas from their surroundings and takes the patch grid out of the flow.

use super::{TrackingSettings, flow::Flow, pair::Level, windows::average_windows};
use crate::simd::{Instructions, LANES, Simd, simd_kernel};

/// Residual at which the data term turns from quadratic to linear, 0 to 255 scale.
const RESIDUAL_SCALE: f32 = 4.0;
/// Flow difference between neighbours at which the smoothness turns from quadratic to linear, pixels: small where
/// nothing moves, as what rests does so alike, and growing with the motion, as what moves turns and bends.
const DIFFERENCE_AT_REST: f32 = 0.003;
const DIFFERENCE_BY_MOTION: f32 = 0.1;
const DIFFERENCE_AT_MOST: f32 = 0.3;
/// Weight of staying: keeps pixels without neighbour or texture where they are.
const HOLD: f32 = 1e-4;
/// Spectral radius of the sweeps that their acceleration expects.
const SPECTRAL_RADIUS: f32 = 0.95;
/// Half side of the window whose mean residual is not counted: shading and exposure.
pub(super) const SHADING_RADIUS: usize = 4;

/// How much more what rests is smoothed, and the displacement at which that is halved, pixels: cameras stand still, so
/// most of what they see moves by nothing but noise. With the differences above, equal neighbours at rest hold together a
/// few thousand times as firmly as equal neighbours that move.
const REST: f32 = 30.0;
const REST_SPEED: f32 = 0.05;

/// How many times as smooth the flow is where its square is this.
#[inline(always)]
pub(super) fn rest(squared: f32) -> f32 {
    1.0 + REST / (1.0 + squared * (1.0 / (REST_SPEED * REST_SPEED)))
}

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
pub(super) fn refine<const C: usize>(
    instructions: Instructions,
    reference: &Level<C>,
    target: &Level<C>,
    mut flow: Flow,
    trust: Option<&[bool]>,
    smoothing: Smoothing,
) -> Flow {
    if smoothing.iterations == 0 {
        return flow;
    }
    for _ in 0..smoothing.warps {
        let linear = Linearised::new(instructions, reference, target, &flow);
        let mut equations = Equations::zeros(flow.width, flow.height);
        combine(instructions, &linear, trust, &mut equations);
        let mut mean = vec![0.0; flow.u.len()];
        for term in
            [&mut equations.xx, &mut equations.xy, &mut equations.yy, &mut equations.x, &mut equations.y]
        {
            average_windows(
                instructions,
                term,
                flow.width,
                flow.height,
                smoothing.window as usize,
                &mut mean,
            );
            std::mem::swap(term, &mut mean);
        }
        link(instructions, &reference.similarity, &flow, smoothing.weight, &mut equations);
        relax(instructions, &equations, smoothing.iterations, &mut flow);
    }
    flow
}

/// What the target shows along the flow: difference from the reference and gradients, means removed from both: else
/// every step falls short.
struct Linearised<const C: usize> {
    residual: [Vec<f32>; C],
    along_x: [Vec<f32>; C],
    along_y: [Vec<f32>; C],
}

impl<const C: usize> Linearised<C> {
    fn new(instructions: Instructions, reference: &Level<C>, target: &Level<C>, flow: &Flow) -> Self {
        let pixels = flow.u.len();
        let zeros = || [(); C].map(|()| vec![0.0f32; pixels]);
        let mut linear = Self { residual: zeros(), along_x: zeros(), along_y: zeros() };
        warp(instructions, reference, target, flow, &mut linear);
        let mut mean = vec![0.0; pixels];
        for residual in &mut linear.residual {
            average_windows(instructions, residual, flow.width, flow.height, SHADING_RADIUS, &mut mean);
            residual.iter_mut().zip(&mean).for_each(|(value, mean)| *value -= mean);
        }
        linear
    }
}

simd_kernel! {
    fn warp<const C: usize>(reference: &Level<C>, target: &Level<C>, flow: &Flow, linear: &mut Linearised<C>) = warp_kernel
}

#[inline(always)]
fn warp_kernel<S: Simd, const C: usize>(
    reference: &Level<C>,
    target: &Level<C>,
    flow: &Flow,
    linear: &mut Linearised<C>,
) {
    let steps: [f32; LANES] = std::array::from_fn(|lane| lane as f32);
    let steps = S::load(&steps);
    for y in 0..flow.height {
        for x in (0..flow.width).step_by(LANES) {
            let count = LANES.min(flow.width - x);
            let pixels = y * flow.width + x..y * flow.width + x + count;
            let along = |axis: &[f32]| some::<S>(&axis[pixels.clone()]);
            let at_x = along(&flow.u).add(steps).add(S::splat(x as f32));
            let at_y = along(&flow.v).add(S::splat(y as f32));
            // The target's gradients: those of the reference are turned and sheared against it.
            let sample = target.texels.sample(at_x, at_y);
            for (c, [value, along_x, along_y]) in sample.into_iter().enumerate() {
                let here = some::<S>(&reference.planes.row(c, y)[x..x + count]);
                put(value.sub(here), &mut linear.residual[c][pixels.clone()]);
                put(along_x, &mut linear.along_x[c][pixels.clone()]);
                put(along_y, &mut linear.along_y[c][pixels.clone()]);
            }
        }
    }
}

/// At most [`LANES`] numbers; the other lanes are 0.
#[inline(always)]
fn some<S: Simd>(from: &[f32]) -> S {
    if let Some(all) = from.first_chunk() {
        return S::load(all);
    }
    let mut lanes = [0.0; LANES];
    lanes[..from.len()].copy_from_slice(from);
    S::load(&lanes)
}

/// Writes what [`some`] reads.
#[inline(always)]
fn put<S: Simd>(numbers: S, to: &mut [f32]) {
    if let Some(all) = to.first_chunk_mut() {
        numbers.store(all);
        return;
    }
    let mut lanes = [0.0; LANES];
    numbers.store(&mut lanes);
    to.copy_from_slice(&lanes[..to.len()]);
}

/// Per pixel two linear equations, coupled with the four neighbours:
/// `xx u + xy v = x` and `xy u + yy v = y` plus the differences from the neighbours, weighted by the links.
struct Equations {
    width: usize,
    xx: Vec<f32>,
    xy: Vec<f32>,
    yy: Vec<f32>,
    x: Vec<f32>,
    y: Vec<f32>,
    /// Smoothness weights of each pixel with its left and its upper neighbour; 0 across the image's edge. One more row
    /// than the image: the weight with the right neighbour is the next entry, the lower one a row on.
    left: Vec<f32>,
    up: Vec<f32>,
}

impl Equations {
    fn zeros(width: usize, height: usize) -> Self {
        let zeros = || vec![0.0f32; width * height];
        let links = || vec![0.0f32; width * (height + 1)];
        Self {
            width,
            xx: zeros(),
            xy: zeros(),
            yy: zeros(),
            x: zeros(),
            y: zeros(),
            left: links(),
            up: links(),
        }
    }
}

simd_kernel! {
    /// The normal equations of the linearised residuals, each pixel on its own.
    fn combine<const C: usize>(linear: &Linearised<C>, trust: Option<&[bool]>, equations: &mut Equations) = combine_kernel
}

#[inline(always)]
fn combine_kernel<S: Simd, const C: usize>(
    linear: &Linearised<C>,
    trust: Option<&[bool]>,
    equations: &mut Equations,
) {
    let pixels = equations.xx.len();
    let mut weights = vec![0.0f32; pixels];
    for residual in &linear.residual {
        for (weight, r) in weights.iter_mut().zip(residual) {
            *weight += r * r * (1.0 / C as f32);
        }
    }
    for weight in &mut weights {
        *weight = 1.0 / (*weight + RESIDUAL_SCALE * RESIDUAL_SCALE).sqrt();
    }
    if let Some(trust) = trust {
        for (weight, &trusted) in weights.iter_mut().zip(trust) {
            *weight = if trusted { *weight } else { 0.0 };
        }
    }
    for c in 0..C {
        let (r, gx, gy) =
            (&linear.residual[c][..pixels], &linear.along_x[c][..pixels], &linear.along_y[c][..pixels]);
        let (xx, xy, yy) =
            (&mut equations.xx[..pixels], &mut equations.xy[..pixels], &mut equations.yy[..pixels]);
        let (x, y) = (&mut equations.x[..pixels], &mut equations.y[..pixels]);
        // One channel of a colour image counts a third.
        let share = 3.0 / C as f32;
        for i in 0..pixels {
            let (weighted_x, weighted_y) = (share * weights[i] * gx[i], share * weights[i] * gy[i]);
            xx[i] += weighted_x * gx[i];
            xy[i] += weighted_x * gy[i];
            yy[i] += weighted_y * gy[i];
            x[i] -= weighted_x * r[i];
            y[i] -= weighted_y * r[i];
        }
    }
}

simd_kernel! {
    /// Adds the smoothness to the equations and brings them to the form that sweeps use: `x` and `y` the constant
    /// right-hand sides, `xx`, `xy`, `yy` the inverse of the pixel's matrix.
    fn link(similarity: &[Vec<f32>; 2], flow: &Flow, weight: f32, equations: &mut Equations) = link_kernel
}

#[inline(always)]
fn link_kernel<S: Simd>(similarity: &[Vec<f32>; 2], flow: &Flow, weight: f32, equations: &mut Equations) {
    let (width, height) = (flow.width, flow.height);
    let pixels = width * height;
    let weight = weight * DIFFERENCE_AT_MOST;
    for (links, step, similarity) in
        [(&mut equations.left, 1, &similarity[0]), (&mut equations.up, width, &similarity[1])]
    {
        let count = pixels - step.min(pixels);
        let links = &mut links[pixels - count..pixels];
        let similarity = &similarity[pixels - count..pixels];
        let (u, v) = (&flow.u[pixels - count..], &flow.v[pixels - count..]);
        let (other_u, other_v) = (&flow.u[..count], &flow.v[..count]);
        for i in 0..count {
            let (du, dv) = (u[i] - other_u[i], v[i] - other_v[i]);
            let (here, there) =
                (u[i] * u[i] + v[i] * v[i], other_u[i] * other_u[i] + other_v[i] * other_v[i]);
            let faster = if here > there { here } else { there };
            let scale = DIFFERENCE_AT_REST * DIFFERENCE_AT_REST
                + DIFFERENCE_BY_MOTION * DIFFERENCE_BY_MOTION * faster;
            let scale = scale.min(DIFFERENCE_AT_MOST * DIFFERENCE_AT_MOST);
            links[i] = rest(faster) * weight * similarity[i] / (du * du + dv * dv + scale).sqrt();
        }
    }
    let equations = &mut *equations;
    let (left, up) = (&equations.left[..pixels], &equations.up[..pixels]);
    let (right, down) = (&equations.left[1..1 + pixels], &equations.up[width..width + pixels]);
    let (xx, xy, yy) =
        (&mut equations.xx[..pixels], &mut equations.xy[..pixels], &mut equations.yy[..pixels]);
    let (x, y) = (&mut equations.x[..pixels], &mut equations.y[..pixels]);
    let (u, v) = (&flow.u[..pixels], &flow.v[..pixels]);
    for i in 0..pixels {
        x[i] += xx[i] * u[i] + xy[i] * v[i] + HOLD * u[i];
        y[i] += xy[i] * u[i] + yy[i] * v[i] + HOLD * v[i];
        let total = left[i] + up[i] + right[i] + down[i] + HOLD;
        let (a, b, c) = (xx[i] + total, xy[i], yy[i] + total);
        // What the determinant is at least, however the products round.
        let least = total * (xx[i] + yy[i] + total);
        let inverse = 1.0 / (a * c - b * b).max(least);
        xx[i] = c * inverse;
        xy[i] = -b * inverse;
        yy[i] = a * inverse;
    }
}

simd_kernel! {
    /// Jacobi sweeps, each pixel solving its equations with its neighbours held, with Chebyshev's acceleration (Golub
    /// and Varga, 1961).
    fn relax(equations: &Equations, sweeps: u32, flow: &mut Flow) = relax_kernel
}

#[inline(always)]
fn relax_kernel<S: Simd>(equations: &Equations, sweeps: u32, flow: &mut Flow) {
    let (width, height) = (flow.width, flow.height);
    // A row before and after, so that every neighbour exists; its links are 0.
    let spare = vec![0.0; width];
    let start = [[&spare[..], &flow.u, &spare].concat(), [&spare[..], &flow.v, &spare].concat()];
    let mut sides = [start.clone(), start];
    let sweeps = momenta(sweeps);
    // Each sweep follows the one before at a distance of one row: what a row needs is still in the cache.
    for front in 0..height + sweeps.len() {
        for (sweep, &momentum) in sweeps.iter().enumerate() {
            let Some(y) = front.checked_sub(sweep).filter(|&y| y < height) else { continue };
            let [even, odd] = &mut sides;
            let (current, next) = if sweep % 2 == 0 { (&*even, odd) } else { (&*odd, even) };
            sweep_row(equations, y, momentum, current, next);
        }
    }
    let current = &sides[sweeps.len() % 2];
    flow.u.copy_from_slice(&current[0][width..width * (height + 1)]);
    flow.v.copy_from_slice(&current[1][width..width * (height + 1)]);
}

/// Chebyshev's factor of every sweep.
fn momenta(sweeps: u32) -> Vec<f32> {
    let square = SPECTRAL_RADIUS * SPECTRAL_RADIUS;
    let mut momentum = 1.0;
    (0..sweeps)
        .map(|sweep| {
            let of_this = momentum;
            momentum = 1.0 / (1.0 - if sweep == 0 { 0.5 * square } else { 0.25 * square * momentum });
            of_this
        })
        .collect()
}

#[inline(always)]
fn sweep_row(
    equations: &Equations,
    y: usize,
    momentum: f32,
    current: &[Vec<f32>; 2],
    next: &mut [Vec<f32>; 2],
) {
    let width = equations.width;
    let (first, centre) = (y * width, (y + 1) * width);
    let line = first..first + width;
    let (left, up) = (&equations.left[line.clone()], &equations.up[line.clone()]);
    // The last row's last pixel has its right link at the start of the spare row.
    let (right, down) = (&equations.left[first + 1..][..width], &equations.up[centre..][..width]);
    let (xx, xy, yy) =
        (&equations.xx[line.clone()], &equations.xy[line.clone()], &equations.yy[line.clone()]);
    let (x, y) = (&equations.x[line.clone()], &equations.y[line]);
    let [u, v] = current;
    let (u_left, v_left) = (&u[centre - 1..][..width], &v[centre - 1..][..width]);
    let (u_up, v_up) = (&u[first..][..width], &v[first..][..width]);
    let (u_right, v_right) = (&u[centre + 1..][..width], &v[centre + 1..][..width]);
    let (u_down, v_down) = (&u[centre + width..][..width], &v[centre + width..][..width]);
    let [next_u, next_v] = next;
    let (next_u, next_v) = (&mut next_u[centre..][..width], &mut next_v[centre..][..width]);
    for i in 0..width {
        let pull_u =
            left[i] * u_left[i] + up[i] * u_up[i] + right[i] * u_right[i] + down[i] * u_down[i] + x[i];
        let pull_v =
            left[i] * v_left[i] + up[i] * v_up[i] + right[i] * v_right[i] + down[i] * v_down[i] + y[i];
        let (solved_u, solved_v) = (xx[i] * pull_u + xy[i] * pull_v, xy[i] * pull_u + yy[i] * pull_v);
        // `next` holds the values before the current ones.
        next_u[i] += momentum * (solved_u - next_u[i]);
        next_v[i] += momentum * (solved_v - next_v[i]);
    }
}
