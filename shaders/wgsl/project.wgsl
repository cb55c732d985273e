// Stage 1: each Gaussian's footprint, colour and depth in one view.

#import types::{View, Step, State, ALPHA_MIN, NEAR_PLANE, GEOMETRY, LOG2_E, THREADS, UNSEEN, group_number, is_finite, all_finite}
#import projection::{Projected, camera_offset, to_camera, unit_rotation, project_locally, whitening, variance_along_row}
#import harmonics::{coefficients_of, basis, direction_of}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> state: State;
@group(0) @binding(3) var<storage, read> geometry: array<f32>;
@group(0) @binding(4) var<storage, read> sh: array<f32>;
// Three per Gaussian: mean, logarithm to base 2 of the opacity; whitening matrix in units of base-2 exponents; colour.
@group(0) @binding(5) var<storage, read_write> footprints: array<vec4<f32>>;
// Two per Gaussian, see `tiles`.
@group(0) @binding(6) var<storage, read_write> reaches: array<vec4<f32>>;
// Depths as integers of the same order, and the number of the Gaussian.
@group(0) @binding(7) var<storage, read_write> depths: array<u32>;
@group(0) @binding(8) var<storage, read_write> indices: array<u32>;
// First intersection, UNSEEN for those that no pixel sees, and number of intersections: none yet, see `bin`.
@group(0) @binding(9) var<storage, read_write> ranges: array<vec2<u32>>;

const LN_OF_255: f32 = 5.541263545158426;

fn colour_of(index: u32, offset: vec3<f32>) -> vec3<f32> {
    let direction = direction_of(offset);
    let count = coefficients_of(step.degree);
    var colour = vec3(0.5);
    var place = index * step.coefficients * 3u;
    for (var k = 0u; k < count; k++) {
        colour += basis(k, direction) * vec3(sh[place], sh[place + 1u], sh[place + 2u]);
        place += 3u;
    }
    return colour;
}

@compute @workgroup_size(THREADS)
fn project(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let index = group_number(group, groups) * THREADS + thread;
    if index >= step.count || state.failed != 0u {
        return;
    }
    indices[index] = index;
    depths[index] = UNSEEN;
    ranges[index] = vec2(UNSEEN, 0u);
    let at = index * GEOMETRY;
    let logit = geometry[at + 10u];
    // The logarithm of the sigmoid, without overflow at either end.
    let log_opacity = min(logit, 0.0) - log(1.0 + exp(-abs(logit)));
    let reach = log_opacity + LN_OF_255;
    if !(reach >= 0.0) || !is_finite(logit) {
        return;
    }
    let mean = vec3(geometry[at], geometry[at + 1u], geometry[at + 2u]);
    let offset = camera_offset(mean, view);
    let camera = to_camera(offset, view);
    if !(camera.z > NEAR_PLANE) || !all_finite(camera) {
        return;
    }
    let stored = vec4(geometry[at + 3u], geometry[at + 4u], geometry[at + 5u], geometry[at + 6u]);
    let log_scale = vec3(geometry[at + 7u], geometry[at + 8u], geometry[at + 9u]);
    let local = project_locally(offset, camera, unit_rotation(stored), log_scale, view);
    let position = view.focal * (camera.xy / camera.z) + view.principal;
    let along_row = variance_along_row(local);
    let is_sound = all_finite(vec3(position, along_row)) && all_finite(vec3(local.xx, local.xy, local.yy))
        && all_finite(log_scale) && along_row > 0.0;
    if !is_sound {
        return;
    }
    let half_size = sqrt(2.0 * reach * vec2(local.xx, local.yy));
    let size = vec2<f32>(view.size);
    if any(position + half_size < vec2(0.5)) || any(position - half_size > size - 0.5) {
        return;
    }
    let colour = colour_of(index, offset);
    if !all_finite(colour) {
        return;
    }
    depths[index] = bitcast<u32>(camera.z);
    ranges[index] = vec2(0u);
    footprints[3u * index] = vec4(position, log_opacity * LOG2_E, 0.0);
    footprints[3u * index + 1u] = whitening(local) * sqrt(0.5 * LOG2_E);
    footprints[3u * index + 2u] = vec4(max(colour, vec3(0.0)), 0.0);
    let fall = sqrt(0.5 / local.yy);
    reaches[2u * index] = vec4(position, local.xy / local.yy, 2.0 * along_row);
    reaches[2u * index + 1u] = vec4(reach, fall, half_size.y, half_size.x * (local.xy / local.xx));
}
