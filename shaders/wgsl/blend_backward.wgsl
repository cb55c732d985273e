// Stage 4: the gradient of blending, replayed back to front, one workgroup per tile, four pixels of a column per thread.
//
// With `g` the gradient of the loss by the pixel's colour, `T` the transmittance in front of footprint i, and `behind` the
// light from behind it, seen through nothing else:
//
//   T_i = T_(i+1) / (1 - alpha_i)
//   behind_last = background · g - g_alpha
//   behind_(i-1) = behind_i + alpha_i (c_i · g - behind_i)
//   ∂loss/∂alpha_i = T_i (c_i · g - behind_i)
//
// Alpha is at most 0.99 and `T` ends at 1e-4 or above: the division loses an ulp or two per footprint and nothing more.
// With v = alpha · ∂loss/∂alpha, the moments of v over the whitened offsets suffice for position and shape. They are
// summed over the four pixels first, then over the threads of the workgroup, a column of shared memory per sum and always
// in the same order, and written per intersection.

#import types::{View, ALPHA_MIN, ALPHA_MAX, TILE, SUMS, group_number}
#import footprint::{alphas_of, whiten_column}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(2) var<storage, read> bounds: array<vec2<u32>>;
@group(0) @binding(3) var<storage, read> slots: array<u32>;
@group(0) @binding(4) var<storage, read> owners: array<u32>;
@group(0) @binding(5) var<storage, read> footprints: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read> rendered: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read> last: array<u32>;
// By colour and alpha of every pixel.
@group(0) @binding(8) var<storage, read> image_gradient: array<vec4<f32>>;
// Per slot: Σ v, Σ v u, Σ v w, Σ v u², Σ v u w, Σ v w² of the whitened offset (u, w); the gradient by the colour.
@group(0) @binding(9) var<storage, read_write> sums: array<f32>;

const THREADS: u32 = 64u;

// Footprints whose sums fit in shared memory together.
const CHUNK: u32 = 6u;

// One more than there are threads: neighbouring columns then start in different banks.
const COLUMN: u32 = 65u;

var<workgroup> positions: array<vec4<f32>, CHUNK>;
var<workgroup> whitenings: array<vec4<f32>, CHUNK>;
var<workgroup> colours: array<vec4<f32>, CHUNK>;
var<workgroup> chunk_slots: array<u32, CHUNK>;
// CHUNK · SUMS columns.
var<workgroup> shares: array<f32, 3510>;
var<workgroup> deepest: atomic<u32>;

fn total(values: vec4<f32>) -> f32 {
    return (values.x + values.y) + (values.z + values.w);
}

@compute @workgroup_size(THREADS)
fn blend_backward(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group_number(group, groups);
    if tile >= view.tiles.x * view.tiles.y {
        return;
    }
    let corner = vec2(tile % view.tiles.x, tile / view.tiles.x) * TILE;
    let column = corner.x + thread % TILE;
    let first_row = corner.y + 4u * (thread / TILE);
    var red = vec4(0.0);
    var green = vec4(0.0);
    var blue = vec4(0.0);
    var behind = vec4(0.0);
    var transmittance = vec4(1.0);
    var place_of_last = vec4(0u);
    for (var i = 0u; i < 4u; i++) {
        if column < view.size.x && first_row + i < view.size.y {
            let place = (first_row + i) * view.size.x + column;
            let gradient = image_gradient[place];
            red[i] = gradient.x;
            green[i] = gradient.y;
            blue[i] = gradient.z;
            behind[i] = dot(gradient.xyz, view.background.xyz) - gradient.w;
            transmittance[i] = rendered[place].w;
            place_of_last[i] = last[place];
        }
    }
    let range = bounds[tile];
    if thread == 0u {
        atomicStore(&deepest, 0u);
    }
    workgroupBarrier();
    atomicMax(&deepest, max(max(place_of_last.x, place_of_last.y), max(place_of_last.z, place_of_last.w)));
    // After an overflow the lists are empty, while the pixels still have what they had before.
    let depth = min(workgroupUniformLoad(&deepest), range.y - range.x);

    for (var place = range.x + depth + thread; place < range.y; place += THREADS) {
        for (var k = 0u; k < SUMS; k++) {
            sums[slots[place] * SUMS + k] = 0.0;
        }
    }

    let x = f32(column) + 0.5;
    let rows = f32(first_row) + vec4(0.5, 1.5, 2.5, 3.5);
    var end = depth;
    while end > 0u {
        let count = min(CHUNK, end);
        let first = end - count;
        if thread < count {
            let slot = slots[range.x + first + thread];
            let index = 3u * owners[slot];
            chunk_slots[thread] = slot;
            positions[thread] = footprints[index];
            whitenings[thread] = footprints[index + 1u];
            colours[thread] = footprints[index + 2u];
        }
        workgroupBarrier();
        for (var remaining = count; remaining > 0u; remaining--) {
            let i = remaining - 1u;
            let position = positions[i];
            let whitening = whitenings[i];
            let colour = colours[i];
            let ex = x - position.x;
            let ey = rows - position.y;
            let u = whiten_column(whitening.xy, ex, ey);
            let w = whiten_column(whitening.zw, ex, ey);
            let clamped = min(alphas_of(position.z, u, w), vec4(ALPHA_MAX));
            let was_blended = (clamped >= vec4(ALPHA_MIN)) & (vec4(first + i) < place_of_last);
            let alpha = select(vec4(0.0), clamped, was_blended);
            transmittance = transmittance / (1.0 - alpha);
            let weight = transmittance * alpha;
            let light = colour.x * red + (colour.y * green + colour.z * blue);
            let excess = light - behind;
            behind += alpha * excess;
            // Where alpha was clamped it follows nothing.
            let v = select(weight * excess, vec4(0.0), alpha >= vec4(ALPHA_MAX));
            let v_u = v * u;
            let v_w = v * w;
            let at = i * SUMS * COLUMN + thread;
            shares[at] = total(v);
            shares[at + COLUMN] = total(v_u);
            shares[at + 2u * COLUMN] = total(v_w);
            shares[at + 3u * COLUMN] = total(v_u * u);
            shares[at + 4u * COLUMN] = total(v_u * w);
            shares[at + 5u * COLUMN] = total(v_w * w);
            shares[at + 6u * COLUMN] = total(weight * red);
            shares[at + 7u * COLUMN] = total(weight * green);
            shares[at + 8u * COLUMN] = total(weight * blue);
        }
        workgroupBarrier();
        if thread < count * SUMS {
            var parts = vec4(0.0);
            for (var i = 0u; i < THREADS; i += 4u) {
                let at = thread * COLUMN + i;
                parts += vec4(shares[at], shares[at + 1u], shares[at + 2u], shares[at + 3u]);
            }
            sums[chunk_slots[thread / SUMS] * SUMS + thread % SUMS] = total(parts);
        }
        workgroupBarrier();
        end = first;
    }
}
