// Moments of every footprint under a track field, in two steps: sums per footprint and tile, and from those of a Gaussian's
// tiles its central moments.
//
// Nothing cancels in single precision. A tile's sums are about the pixel in which the footprint is centred, or the tile's
// nearest one to it, and relative to the displacement of that pixel; tiles are joined as central moments (Chan, Golub,
// LeVeque), by differences of means and sums of non-negative terms. Positions leave the device relative to a pixel, and
// displacements relative to one that occurs.

#import types::{View, ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN, TILE, THREADS, UNSEEN, group_number, is_finite}
#import footprint::{alphas_of, whiten_column}

// Of a footprint's pixels, all of them or those of one tile. With w the weight of a pixel, (u, v) its position and (a, b) its
// displacement: raw sums of one tile, or means and central sums of all.
struct Moments {
    // Σ w, Σ w², blending weight, and that of the pixels that have a track.
    weights: vec4<f32>,
    // u, v, a, b.
    first: vec4<f32>,
    // uu, uv, vv, aa + bb.
    second: vec4<f32>,
    // au, av, bu, bv.
    cross: vec4<f32>,
    // Displacement that a and b are relative to.
    reference: vec2<f32>,
    // Number of the pixel that u and v are relative to.
    anchor: u32,
    pixels: f32,
}

// By what a footprint's pixels are reweighted.
struct Expectation {
    displacement: vec2<f32>,
    // Exponent to base 2 per squared residual.
    fall: f32,
    // 1 if the footprint's moments are wanted.
    is_wanted: f32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> bounds: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read> slots: array<u32>;
@group(0) @binding(3) var<storage, read> owners: array<u32>;
@group(0) @binding(4) var<storage, read> footprints: array<vec4<f32>>;
// Per Gaussian.
@group(0) @binding(5) var<storage, read> expectations: array<Expectation>;
// Per pixel: where it is tracked to; the standard deviation of that, 0 where it is hidden.
@group(0) @binding(6) var<storage, read> positions: array<vec2<f32>>;
@group(0) @binding(7) var<storage, read> sigmas: array<f32>;
// Per slot; all zero before.
@group(0) @binding(8) var<storage, read_write> sums: array<Moments>;

// As in `splat::raster`; a test compares the two.
const SIGMA_MIN: f32 = 1e-6;
const SIGMA_MAX: f32 = 1e6;
const FARTHEST: f32 = 65536.0;

// Threads of a workgroup: each blends four pixels of a column.
const LANES: u32 = 64u;

// Footprints whose weights fit in shared memory together, and threads that share the sums of each.
const CHUNK: u32 = 8u;
const PARTS: u32 = 8u;

// The tile's tracks, four pixels of a column per entry: inverse variance, 0 where there is none, and displacement.
var<workgroup> reliabilities: array<vec4<f32>, LANES>;
var<workgroup> rightward: array<vec4<f32>, LANES>;
var<workgroup> downward: array<vec4<f32>, LANES>;

var<workgroup> centres: array<vec4<f32>, CHUNK>;
var<workgroup> whitenings: array<vec4<f32>, CHUNK>;
var<workgroup> expected: array<Expectation, CHUNK>;
var<workgroup> chunk_slots: array<u32, CHUNK>;
// Per footprint the weights of the tile's pixels; then per thread what it has summed up, four vectors and a number.
var<workgroup> shared_values: array<vec4<f32>, 512>;
var<workgroup> counts: array<f32, LANES>;

var<workgroup> last_wanted: atomic<u32>;
var<workgroup> first_usable: atomic<u32>;
var<workgroup> open: atomic<u32>;

fn sum_of(values: vec4<f32>) -> f32 {
    return (values.x + values.y) + (values.z + values.w);
}

// The displacement of a pixel of the tile, by thread and row of the thread.
fn displacement_of(pixel: u32) -> vec2<f32> {
    return vec2(rightward[pixel / 4u][pixel % 4u], downward[pixel / 4u][pixel % 4u]);
}

fn take_tracks(corner: vec2<u32>, lane: u32) {
    var reliability = vec4(0.0);
    var right = vec4(0.0);
    var down = vec4(0.0);
    for (var i = 0u; i < 4u; i++) {
        let pixel = corner + vec2(lane % TILE, 4u * (lane / TILE) + i);
        if any(pixel >= view.size) {
            continue;
        }
        let place = pixel.y * view.size.x + pixel.x;
        let position = positions[place];
        let sigma = sigmas[place];
        if !is_finite(position.x) || !is_finite(position.y) || !is_finite(sigma) || !(sigma > 0.0) {
            continue;
        }
        // Whole and half numbers: a single rounding, and none where the track is near.
        let displacement = position - (vec2<f32>(pixel) + 0.5);
        if any(abs(displacement) > vec2(FARTHEST)) {
            continue;
        }
        let bounded = clamp(sigma, SIGMA_MIN, SIGMA_MAX);
        reliability[i] = 1.0 / (bounded * bounded);
        right[i] = displacement.x;
        down[i] = displacement.y;
        atomicMin(&first_usable, 4u * lane + i);
    }
    reliabilities[lane] = reliability;
    rightward[lane] = right;
    downward[lane] = down;
}

// The pixel of the tile that a footprint's sums are about, from the tile's corner.
fn anchor_of(centre: vec2<f32>, corner: vec2<u32>) -> vec2<u32> {
    let last = min(vec2(TILE - 1u), view.size - 1u - corner);
    return vec2<u32>(clamp(floor(centre) - vec2<f32>(corner), vec2(0.0), vec2<f32>(last)));
}

// The displacement of the anchor or, if it has no track, of the first pixel that has.
fn reference_at(anchor: vec2<u32>, usable: u32) -> vec2<f32> {
    let pixel = 4u * (anchor.x + TILE * (anchor.y / 4u)) + anchor.y % 4u;
    let has_track = reliabilities[pixel / 4u][pixel % 4u] > 0.0;
    return displacement_of(select(min(usable, 255u), pixel, has_track));
}

// A thread's part of a footprint's sums.
fn part_of(footprint: u32, part: u32, anchor: vec2<u32>, reference: vec2<f32>) -> Moments {
    var m: Moments;
    let expectation = expected[footprint];
    let expected_here = expectation.displacement - reference;
    for (var place = part; place < LANES; place += PARTS) {
        var share = shared_values[footprint * LANES + place];
        let reliability = reliabilities[place];
        let a = rightward[place] - reference.x;
        let b = downward[place] - reference.y;
        m.weights.z += sum_of(share);
        if expectation.fall > 0.0 {
            let from_a = a - expected_here.x;
            let from_b = b - expected_here.y;
            // Below, the power may be anything.
            share *= exp2(max(-expectation.fall * (from_a * from_a + from_b * from_b), vec4(-126.0)));
        }
        let has_track = reliability > vec4(0.0);
        m.weights.w += sum_of(select(vec4(0.0), share, has_track));
        let w = share * reliability;
        m.weights.y += sum_of(w * w);
        m.pixels += sum_of(select(vec4(0.0), vec4(1.0), w > vec4(0.0)));
        let u = f32(place % TILE) - f32(anchor.x);
        let v = f32(4u * (place / TILE)) - f32(anchor.y) + vec4(0.0, 1.0, 2.0, 3.0);
        let wv = w * v;
        let wa = w * a;
        let wb = w * b;
        let of_w = sum_of(w);
        let of_v = sum_of(wv);
        let of_a = sum_of(wa);
        let of_b = sum_of(wb);
        m.weights.x += of_w;
        m.first += vec4(u * of_w, of_v, of_a, of_b);
        m.second += vec4(u * (u * of_w), u * of_v, sum_of(wv * v), sum_of(wa * a + wb * b));
        m.cross += vec4(u * of_a, sum_of(wa * v), u * of_b, sum_of(wb * v));
    }
    return m;
}

@compute @workgroup_size(LANES)
fn footprint_moments(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let tile = group_number(group, groups);
    if tile >= view.tiles.x * view.tiles.y {
        return;
    }
    let corner = vec2(tile % view.tiles.x, tile / view.tiles.x) * TILE;
    let range = bounds[tile];
    if lane == 0u {
        atomicStore(&last_wanted, range.x);
        atomicStore(&first_usable, UNSEEN);
    }
    workgroupBarrier();
    for (var place = range.x + lane; place < range.y; place += LANES) {
        if expectations[owners[slots[place]]].is_wanted > 0.0 {
            atomicMax(&last_wanted, place + 1u);
        }
    }
    take_tracks(corner, lane);
    // What lies behind the last footprint that is wanted matters to none.
    let end = workgroupUniformLoad(&last_wanted);
    let usable = workgroupUniformLoad(&first_usable);

    let column = corner.x + lane % TILE;
    let first_row = corner.y + 4u * (lane / TILE);
    let x = f32(column) + 0.5;
    let rows = f32(first_row) + vec4(0.5, 1.5, 2.5, 3.5);
    let is_inside = vec4(column < view.size.x)
        & (vec4(first_row) + vec4(0u, 1u, 2u, 3u) < vec4(view.size.y));
    var is_open = is_inside;
    var transmittance = vec4(1.0);
    for (var first = range.x; first < end; first += CHUNK) {
        let count = min(CHUNK, end - first);
        if lane == 0u {
            atomicStore(&open, 0u);
        }
        workgroupBarrier();
        if any(is_open) {
            atomicStore(&open, 1u);
        }
        if lane < count {
            let slot = slots[first + lane];
            let owner = owners[slot];
            chunk_slots[lane] = slot;
            centres[lane] = footprints[3u * owner];
            whitenings[lane] = footprints[3u * owner + 1u];
            expected[lane] = expectations[owner];
        }
        if workgroupUniformLoad(&open) == 0u {
            break;
        }
        for (var i = 0u; i < count; i++) {
            let centre = centres[i];
            let whitening = whitenings[i];
            let ex = x - centre.x;
            let ey = rows - centre.y;
            let u = whiten_column(whitening.xy, ex, ey);
            let w = whiten_column(whitening.zw, ex, ey);
            let clamped = min(alphas_of(centre.z, u, w), vec4(ALPHA_MAX));
            let alpha = select(vec4(0.0), clamped, clamped >= vec4(ALPHA_MIN));
            let weight = transmittance * alpha;
            let left = transmittance - weight;
            is_open = is_open & (left >= vec4(TRANSMITTANCE_MIN));
            transmittance = select(transmittance, left, is_open);
            shared_values[i * LANES + lane] = select(vec4(0.0), weight, is_open);
        }
        workgroupBarrier();

        let footprint = lane / PARTS;
        let is_summed = footprint < count && expected[footprint].is_wanted > 0.0;
        var part: Moments;
        var anchor = vec2(0u);
        var reference = vec2(0.0);
        if is_summed {
            anchor = anchor_of(centres[footprint].xy, corner);
            reference = reference_at(anchor, usable);
            part = part_of(footprint, lane % PARTS, anchor, reference);
        }
        workgroupBarrier();
        shared_values[4u * lane] = part.weights;
        shared_values[4u * lane + 1u] = part.first;
        shared_values[4u * lane + 2u] = part.second;
        shared_values[4u * lane + 3u] = part.cross;
        counts[lane] = part.pixels;
        workgroupBarrier();
        if is_summed && lane % PARTS == 0u {
            var total: Moments;
            total.reference = reference;
            total.anchor = (corner.y + anchor.y) * view.size.x + corner.x + anchor.x;
            for (var other = lane; other < lane + PARTS; other++) {
                total.weights += shared_values[4u * other];
                total.first += shared_values[4u * other + 1u];
                total.second += shared_values[4u * other + 2u];
                total.cross += shared_values[4u * other + 3u];
                total.pixels += counts[other];
            }
            sums[chunk_slots[footprint]] = total;
        }
    }
}

// Per Gaussian: first slot and number of slots.
@group(0) @binding(9) var<storage, read> ranges: array<vec2<u32>>;
// How many Gaussians are wanted; which.
@group(0) @binding(10) var<storage, read> wanted: array<u32>;
@group(0) @binding(11) var<storage, read> tile_sums: array<Moments>;
// In the order of `wanted`.
@group(0) @binding(12) var<storage, read_write> moments: array<Moments>;

// More tiles than this are joined by a whole workgroup.
const MANY: u32 = 64u;

// Gaussians of the workgroup that have many, in any order, and their number.
var<workgroup> large: array<u32, THREADS>;
var<workgroup> large_count: atomic<u32>;
// What each of the first threads has joined.
var<workgroup> joints: array<Moments, LANES>;

// From raw sums to means and central sums.
fn centred(sums: Moments) -> Moments {
    var m = sums;
    let w = sums.weights.x;
    if !(w > 0.0) {
        return m;
    }
    m.first = sums.first / w;
    let mean = m.first;
    m.second -= w * vec4(mean.x * mean.x, mean.x * mean.y, mean.y * mean.y, mean.z * mean.z + mean.w * mean.w);
    m.second = max(m.second, vec4(0.0, m.second.y, 0.0, 0.0));
    m.cross -= w * vec4(mean.z * mean.xy, mean.w * mean.xy);
    return m;
}

fn pixel_of(anchor: u32) -> vec2<f32> {
    return vec2(f32(anchor % view.size.x), f32(anchor / view.size.x));
}

// The central moments of both.
fn joined(all: Moments, other: Moments) -> Moments {
    var m = all;
    if !(all.weights.x > 0.0) {
        m = other;
    }
    m.weights = all.weights + other.weights;
    m.pixels = all.pixels + other.pixels;
    if !(all.weights.x > 0.0 && other.weights.x > 0.0) {
        return m;
    }
    let base = vec4(pixel_of(other.anchor) - pixel_of(all.anchor), other.reference - all.reference);
    let d = (base + other.first) - all.first;
    let share = other.weights.x / m.weights.x;
    let w = all.weights.x * share;
    m.first += d * share;
    m.second += other.second + w * vec4(d.x * d.x, d.x * d.y, d.y * d.y, d.z * d.z + d.w * d.w);
    m.cross += other.cross + w * vec4(d.z * d.xy, d.w * d.xy);
    return m;
}

// Every `stride`-th tile from slot `first` on.
fn joined_tiles(first: u32, end: u32, stride: u32) -> Moments {
    var all: Moments;
    for (var slot = first; slot < end; slot += stride) {
        all = joined(all, centred(tile_sums[slot]));
    }
    return all;
}

// The same by the whole workgroup, in an order that depends on the number of tiles only.
fn joined_together(range: vec2<u32>, thread: u32) -> Moments {
    if thread < LANES {
        joints[thread] = joined_tiles(range.x + thread, range.x + range.y, LANES);
    }
    workgroupBarrier();
    for (var stride = LANES / 2u; stride > 0u; stride /= 2u) {
        if thread < stride {
            joints[thread] = joined(joints[thread], joints[thread + stride]);
        }
        workgroupBarrier();
    }
    let all = joints[0];
    workgroupBarrier();
    return all;
}

@compute @workgroup_size(THREADS)
fn join_moments(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let first_place = group_number(group, groups) * THREADS;
    let place = first_place + thread;
    var range = vec2(0u);
    if place < wanted[0] {
        range = ranges[wanted[place + 1u]];
    }
    if thread == 0u {
        atomicStore(&large_count, 0u);
    }
    workgroupBarrier();
    var all: Moments;
    if range.y > MANY {
        large[atomicAdd(&large_count, 1u)] = thread;
    } else {
        all = joined_tiles(range.x, range.x + range.y, 1u);
    }
    let together = workgroupUniformLoad(&large_count);
    for (var i = 0u; i < together; i++) {
        let owner = large[i];
        let found = joined_together(ranges[wanted[first_place + owner + 1u]], thread);
        if thread == owner {
            all = found;
        }
    }
    if place < wanted[0] {
        moments[place] = all;
    }
}
