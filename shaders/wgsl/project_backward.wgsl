// Stage 5: from the sums of a Gaussian's intersections to the gradient by its parameters.

#import types::{View, Step, State, GEOMETRY, LOG2_E, SUMS, THREADS, UNSEEN, group_number, is_finite, all_finite}
#import projection::{Projected, camera_offset, to_camera, unit_rotation, rotation_gradient, project_locally, whitening, whitened_spread}
#import harmonics::{coefficients_of, basis, basis_gradient, direction_of}

// What densification decides by.
struct Density {
    gradient_norm: f32,
    visible_steps: u32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> state: State;
@group(0) @binding(3) var<storage, read> geometry: array<f32>;
@group(0) @binding(4) var<storage, read> sh: array<f32>;
@group(0) @binding(5) var<storage, read> ranges: array<vec2<u32>>;
@group(0) @binding(6) var<storage, read> sums: array<f32>;
@group(0) @binding(7) var<storage, read_write> geometry_gradient: array<f32>;
@group(0) @binding(8) var<storage, read_write> sh_gradient: array<f32>;
@group(0) @binding(9) var<storage, read_write> density: array<Density>;

// Moments of v over the whitened offsets, and the gradient by the colour.
struct FootprintGradient {
    v: f32,
    first: vec2<f32>,
    // Σ v u², Σ v u w, Σ v w².
    second: vec3<f32>,
    colour: vec3<f32>,
}

struct GeometryGradient {
    mean: vec3<f32>,
    rotation: vec4<f32>,
    log_scale: vec3<f32>,
    logit_opacity: f32,
    projected_mean: vec2<f32>,
}

// More intersections than this are summed up by the whole workgroup.
const MANY: u32 = 64u;

// Gaussians of the workgroup that have many, in any order, and their number.
var<workgroup> large: array<u32, THREADS>;
var<workgroup> large_count: atomic<u32>;

// What each thread has summed up: three vectors per thread.
var<workgroup> parts: array<vec3<f32>, 768>;

// Every `stride`-th intersection from `first` on, in the order of their tiles.
fn summed(first: u32, end: u32, stride: u32) -> mat3x3<f32> {
    var total: mat3x3<f32>;
    for (var slot = first; slot < end; slot += stride) {
        let at = slot * SUMS;
        total[0] += vec3(sums[at], sums[at + 1u], sums[at + 2u]);
        total[1] += vec3(sums[at + 3u], sums[at + 4u], sums[at + 5u]);
        total[2] += vec3(sums[at + 6u], sums[at + 7u], sums[at + 8u]);
    }
    return total;
}

// The same by the whole workgroup, in an order that depends on the number of intersections only.
fn summed_together(range: vec2<u32>, thread: u32) -> mat3x3<f32> {
    let own = summed(range.x + thread, range.x + range.y, THREADS);
    for (var k = 0u; k < 3u; k++) {
        parts[k * THREADS + thread] = own[k];
    }
    workgroupBarrier();
    for (var stride = THREADS / 2u; stride > 0u; stride /= 2u) {
        if thread < stride {
            for (var k = 0u; k < 3u; k++) {
                parts[k * THREADS + thread] += parts[k * THREADS + thread + stride];
            }
        }
        workgroupBarrier();
    }
    let total = mat3x3(parts[0], parts[THREADS], parts[2u * THREADS]);
    workgroupBarrier();
    return total;
}

// From base-2 exponents to whitened offsets proper.
fn footprint_gradient(total: mat3x3<f32>) -> FootprintGradient {
    return FootprintGradient(
        total[0].x,
        total[0].yz / sqrt(0.5 * LOG2_E),
        total[1] / (0.5 * LOG2_E),
        total[2],
    );
}

// By the mean in camera axes, through the projected mean and through the Jacobian's entries.
fn camera_gradient(local: Projected, mean: vec2<f32>, row_x: vec3<f32>, row_y: vec3<f32>) -> vec3<f32> {
    let inverse_z = 1.0 / local.camera.z;
    let scale = view.focal * inverse_z;
    let by_diagonal = vec2(dot(view.right.xyz, row_x), dot(view.down.xyz, row_y));
    let by_z_entry = vec2(dot(view.forward.xyz, row_x), dot(view.forward.xyz, row_y)) * scale;
    let is_free = select(vec2(1.0), vec2(0.0), local.is_clamped);
    let sideways = mean * scale - is_free * by_z_entry * inverse_z;
    let along_z = by_z_entry * local.slope * (1.0 + is_free) * inverse_z
        - mean * scale * local.camera.xy * inverse_z
        - by_diagonal * scale * inverse_z;
    return vec3(sideways, along_z.x + along_z.y);
}

// Writes the gradient by the coefficients and returns that by the mean.
fn colour_backward(index: u32, offset: vec3<f32>, colour_gradient: vec3<f32>) -> vec3<f32> {
    let direction = direction_of(offset);
    let count = coefficients_of(step.degree);
    let first = index * step.coefficients * 3u;
    var colour = vec3(0.5);
    for (var k = 0u; k < count; k++) {
        let at = first + 3u * k;
        colour += basis(k, direction) * vec3(sh[at], sh[at + 1u], sh[at + 2u]);
    }
    let passed = select(vec3(0.0), colour_gradient, colour >= vec3(0.0));
    var along = vec3(0.0);
    for (var k = 0u; k < count; k++) {
        let at = first + 3u * k;
        let gradient = basis(k, direction) * passed;
        sh_gradient[at] = gradient.x;
        sh_gradient[at + 1u] = gradient.y;
        sh_gradient[at + 2u] = gradient.z;
        along += basis_gradient(k, direction) * dot(passed, vec3(sh[at], sh[at + 1u], sh[at + 2u]));
    }
    let distance = dot(direction, offset);
    if !(distance > 0.0) {
        return vec3(0.0);
    }
    return (along - direction * dot(direction, along)) / distance;
}

fn geometry_backward(index: u32, footprint: FootprintGradient) -> GeometryGradient {
    let at = index * GEOMETRY;
    let offset = camera_offset(vec3(geometry[at], geometry[at + 1u], geometry[at + 2u]), view);
    let camera = to_camera(offset, view);
    let stored = vec4(geometry[at + 3u], geometry[at + 4u], geometry[at + 5u], geometry[at + 6u]);
    let log_scale = vec3(geometry[at + 7u], geometry[at + 8u], geometry[at + 9u]);
    let local = project_locally(offset, camera, unit_rotation(stored), log_scale, view);

    // Alpha's exponent is -½ |L e|²: by the mean Lᵀ Σ v (L e), and by the spread S, as the covariance is S Sᵀ plus the
    // blur, Lᵀ U (L S) with U the second moments.
    let l = whitening(local);
    let projected = vec2(
        l.x * footprint.first.x + l.z * footprint.first.y,
        l.y * footprint.first.x + l.w * footprint.first.y,
    );
    let spread = whitened_spread(local);
    let u = footprint.second;
    let first = u.x * spread[0] + u.y * spread[1];
    let second = u.y * spread[0] + u.z * spread[1];
    let across = l.x * first + l.z * second;
    let along = l.y * first + l.w * second;

    var gradient: GeometryGradient;
    gradient.projected_mean = projected;
    gradient.log_scale = spread[0] * first + spread[1] * second;
    let row_x = local.rotation * (local.scale * across);
    let row_y = local.rotation * (local.scale * along);
    let in_camera = camera_gradient(local, projected, row_x, row_y);
    gradient.mean = in_camera.x * view.right.xyz + in_camera.y * view.down.xyz + in_camera.z * view.forward.xyz;
    let by_rotation = mat3x3<f32>(
        local.scale.x * (local.row_x * across.x + local.row_y * along.x),
        local.scale.y * (local.row_x * across.y + local.row_y * along.y),
        local.scale.z * (local.row_x * across.z + local.row_y * along.z),
    );
    gradient.rotation = rotation_gradient(stored, by_rotation);
    // 1 - opacity, without cancellation.
    let logit = geometry[at + 10u];
    let e = exp(-abs(logit));
    gradient.logit_opacity = footprint.v * select(1.0, e, logit >= 0.0) / (1.0 + e);
    gradient.mean += colour_backward(index, offset, footprint.colour);
    return gradient;
}

fn is_sound(g: GeometryGradient, colour: vec3<f32>) -> bool {
    return all_finite(g.mean) && all_finite(g.rotation.xyz) && is_finite(g.rotation.w) && all_finite(g.log_scale)
        && all_finite(vec3(g.projected_mean, g.logit_opacity)) && all_finite(colour);
}

@compute @workgroup_size(THREADS)
fn project_backward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let first_index = group_number(group, groups) * THREADS;
    if first_index >= step.count || state.failed != 0u {
        return;
    }
    let index = first_index + thread;
    var range = vec2(UNSEEN, 0u);
    if index < step.count {
        range = ranges[index];
    }
    if thread == 0u {
        atomicStore(&large_count, 0u);
    }
    workgroupBarrier();
    var total: mat3x3<f32>;
    if range.y > MANY {
        large[atomicAdd(&large_count, 1u)] = thread;
    } else {
        total = summed(range.x, range.x + range.y, 1u);
    }
    let together = workgroupUniformLoad(&large_count);
    for (var i = 0u; i < together; i++) {
        let owner = large[i];
        let found = summed_together(ranges[first_index + owner], thread);
        if thread == owner {
            total = found;
        }
    }
    if index >= step.count {
        return;
    }
    var gradient: GeometryGradient;
    var is_wanted = range.y > 0u;
    if is_wanted {
        let footprint = footprint_gradient(total);
        gradient = geometry_backward(index, footprint);
        is_wanted = is_sound(gradient, footprint.colour);
    }
    // Beyond single precision there is no direction to follow; a step of infinity would spread.
    if !is_wanted {
        gradient = GeometryGradient();
        let first = index * step.coefficients * 3u;
        for (var k = 0u; k < 3u * coefficients_of(step.degree); k++) {
            sh_gradient[first + k] = 0.0;
        }
    }
    let at = index * GEOMETRY;
    for (var k = 0u; k < 3u; k++) {
        geometry_gradient[at + k] = gradient.mean[k];
        geometry_gradient[at + 7u + k] = gradient.log_scale[k];
    }
    for (var k = 0u; k < 4u; k++) {
        geometry_gradient[at + 3u + k] = gradient.rotation[k];
    }
    geometry_gradient[at + 10u] = gradient.logit_opacity;
    if range.x != UNSEEN {
        let half_size = 0.5 * vec2<f32>(view.size);
        density[index].gradient_norm += length(gradient.projected_mean * half_size);
        density[index].visible_steps += 1u;
    }
}
