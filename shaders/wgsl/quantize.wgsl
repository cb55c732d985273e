// A rendering as 8-bit RGB, row by row without gaps: four pixels in three words.

#import types::{View, THREADS, group_number}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> rendered: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> bytes: array<u32>;

fn rounded(pixel: u32) -> vec3<u32> {
    if pixel >= view.size.x * view.size.y {
        return vec3(0u);
    }
    return vec3<u32>(clamp(rendered[pixel].xyz, vec3(0.0), vec3(1.0)) * 255.0 + 0.5);
}

@compute @workgroup_size(THREADS)
fn quantize(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let place = group_number(group, groups) * THREADS + thread;
    if 4u * place >= view.size.x * view.size.y {
        return;
    }
    let a = rounded(4u * place);
    let b = rounded(4u * place + 1u);
    let c = rounded(4u * place + 2u);
    let d = rounded(4u * place + 3u);
    bytes[3u * place] = a.x | (a.y << 8u) | (a.z << 16u) | (b.x << 24u);
    bytes[3u * place + 1u] = b.y | (b.z << 8u) | (c.x << 16u) | (c.y << 24u);
    bytes[3u * place + 2u] = c.z | (d.x << 8u) | (d.y << 16u) | (d.z << 24u);
}
