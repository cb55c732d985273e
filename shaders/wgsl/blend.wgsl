// Stage 3: front-to-back blending, one workgroup per tile, one thread per pixel.

#import types::{View, State, ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN, TILE, group_number}
#import footprint::{alpha_of, whiten}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> state: State;
@group(0) @binding(2) var<storage, read> bounds: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> owners: array<u32>;
@group(0) @binding(5) var<storage, read> footprints: array<vec4<f32>>;
// Colour over the background, and transmittance.
@group(0) @binding(6) var<storage, read_write> rendered: array<vec4<f32>>;
// How many of the tile's list came before the pixel's blending stopped.
@group(0) @binding(7) var<storage, read_write> last: array<u32>;

const BATCH: u32 = 256u;

var<workgroup> positions: array<vec4<f32>, BATCH>;
var<workgroup> whitenings: array<vec4<f32>, BATCH>;
var<workgroup> colours: array<vec4<f32>, BATCH>;
var<workgroup> open: atomic<u32>;

@compute @workgroup_size(16, 16)
fn blend(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_id) local: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group_number(group, groups);
    if tile >= view.tiles.x * view.tiles.y || state.failed != 0u {
        return;
    }
    let corner = vec2(tile % view.tiles.x, tile / view.tiles.x) * TILE;
    let pixel = corner + local.xy;
    let is_inside = all(pixel < view.size);
    let centre = vec2<f32>(pixel) + 0.5;
    let range = bounds[tile];

    var colour = vec3(0.0);
    var transmittance = 1.0;
    var blended = 0u;
    var is_open = is_inside;
    for (var first = range.x; first < range.y; first += BATCH) {
        // A batch in which no pixel is open any more is the last.
        if thread == 0u {
            atomicStore(&open, 0u);
        }
        workgroupBarrier();
        if is_open {
            atomicStore(&open, 1u);
        }
        if first + thread < range.y {
            let index = 3u * owners[slots[first + thread]];
            positions[thread] = footprints[index];
            whitenings[thread] = footprints[index + 1u];
            colours[thread] = footprints[index + 2u];
        }
        if workgroupUniformLoad(&open) == 0u {
            break;
        }
        if is_open {
            let count = min(BATCH, range.y - first);
            for (var i = 0u; i < count; i++) {
                let offset = whiten(whitenings[i], centre - positions[i].xy);
                let alpha = min(alpha_of(positions[i].z, offset.x, offset.y), ALPHA_MAX);
                if !(alpha >= ALPHA_MIN) {
                    continue;
                }
                let weight = transmittance * alpha;
                let left = transmittance - weight;
                if left < TRANSMITTANCE_MIN {
                    is_open = false;
                    break;
                }
                transmittance = left;
                colour += weight * colours[i].xyz;
                blended = first + i + 1u - range.x;
            }
        }
        workgroupBarrier();
    }
    if is_inside {
        let place = pixel.y * view.size.x + pixel.x;
        rendered[place] = vec4(colour + transmittance * view.background.xyz, transmittance);
        last[place] = blended;
    }
}
