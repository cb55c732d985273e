// Adam (Kingma and Ba 2015) with dense moments, one thread per parameter.

#import types::{Step, State, GEOMETRY, THREADS, group_number}
#import harmonics::coefficients_of

@group(0) @binding(0) var<uniform> step: Step;
@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read_write> values: array<f32>;
@group(0) @binding(3) var<storage, read> gradient: array<f32>;
// First and second moments.
@group(0) @binding(4) var<storage, read_write> first: array<f32>;
@group(0) @binding(5) var<storage, read_write> second: array<f32>;
// Per Gaussian; read only where the step says that it is there.
@group(0) @binding(6) var<storage, read> is_active: array<u32>;

const ONE_MINUS_BETA_A: f32 = 0.1;
const BETA_A: f32 = 0.9;
const ONE_MINUS_BETA_B: f32 = 0.001;
const BETA_B: f32 = 0.999;
// As in 3D Gaussian Splatting: gradients of a mean loss over a whole image are tiny.
const EPSILON: f32 = 1e-15;

fn descend(at: u32, rate: f32) {
    let slope = gradient[at];
    let mean = BETA_A * first[at] + ONE_MINUS_BETA_A * slope;
    let square = BETA_B * second[at] + ONE_MINUS_BETA_B * (slope * slope);
    first[at] = mean;
    second[at] = square;
    values[at] -= rate * step.first_correction * mean / (sqrt(square) * step.second_correction + EPSILON);
}

fn is_frozen(gaussian: u32) -> bool {
    return step.has_active != 0u && is_active[gaussian] == 0u;
}

@compute @workgroup_size(THREADS)
fn adam_geometry(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let at = group_number(group, groups) * THREADS + thread;
    let gaussian = at / GEOMETRY;
    if gaussian >= step.count || state.failed != 0u || is_frozen(gaussian) {
        return;
    }
    let parameter = at % GEOMETRY;
    var rate = step.rates.x;
    if parameter >= 3u {
        rate = step.rates.y;
    }
    if parameter >= 7u {
        rate = step.rates.z;
    }
    if parameter >= 10u {
        rate = step.rates.w;
    }
    descend(at, rate);
}

@compute @workgroup_size(THREADS)
fn adam_sh(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let at = group_number(group, groups) * THREADS + thread;
    let width = 3u * step.coefficients;
    let gaussian = at / width;
    let parameter = at % width;
    if gaussian >= step.count || state.failed != 0u || parameter >= 3u * coefficients_of(step.degree) {
        return;
    }
    if !is_frozen(gaussian) {
        descend(at, select(step.sh_rates.y, step.sh_rates.x, parameter < 3u));
    }
}
