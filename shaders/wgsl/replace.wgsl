// Moments of the optimiser follow their Gaussians to a new set.

#import types::{THREADS, group_number}

struct ReplaceSettings {
    // Gaussians of the new set, and values per Gaussian.
    count: u32,
    width: u32,
}

@group(0) @binding(0) var<uniform> settings: ReplaceSettings;
// Per new Gaussian the old one that it takes over, or NONE.
@group(0) @binding(1) var<storage, read> sources: array<u32>;
@group(0) @binding(2) var<storage, read> old: array<f32>;
@group(0) @binding(3) var<storage, read_write> taken_over: array<f32>;

const NONE: u32 = 0xffffffffu;

@compute @workgroup_size(THREADS)
fn replace(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let at = group_number(group, groups) * THREADS + thread;
    let gaussian = at / settings.width;
    if gaussian >= settings.count {
        return;
    }
    let source = sources[gaussian];
    var value = 0.0;
    if source != NONE {
        value = old[source * settings.width + at % settings.width];
    }
    taken_over[at] = value;
}
