// The photometric loss L1 + D-SSIM against one training image, and its gradient by the rendering, in the two sweeps of a
// separable window: `similarity` blurs the moments and finds the derivatives of SSIM by them, `loss_gradient` blurs these.
// Images are continued with zeros. `total` sums the tiles' shares up, in the order of the tiles.

#import types::{View, Step, State, TILE, group_number}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> step: Step;
@group(0) @binding(2) var<storage, read> state: State;
@group(0) @binding(3) var<storage, read> rendered: array<vec4<f32>>;
// Colour, and whether the pixel counts.
@group(0) @binding(4) var<storage, read> wanted: array<u32>;
// Per channel the derivatives by windowed mean, square and product, a plane each.
@group(0) @binding(5) var<storage, read_write> derivatives: array<f32>;
@group(0) @binding(6) var<storage, read_write> image_gradient: array<vec4<f32>>;
// Per tile: dissimilarity, then absolute difference of all tiles.
@group(0) @binding(7) var<storage, read_write> shares: array<f32>;
@group(0) @binding(8) var<storage, read_write> losses: array<f32>;

// Stabilisers of SSIM for values in [0, 1].
const STABLE_MEAN: f32 = 1e-4;
const STABLE_VARIANCE: f32 = 9e-4;

const THREADS: u32 = 256u;
const RADIUS: u32 = 5u;
// A tile with its margins, and a row of it after the horizontal blur.
const WIDE: u32 = 26u;

fn wanted_pixel(at: u32) -> vec4<f32> {
    if view.is_packed != 0u {
        return unpack4x8unorm(wanted[at]);
    }
    let first = 4u * at;
    return bitcast<vec4<f32>>(vec4(wanted[first], wanted[first + 1u], wanted[first + 2u], wanted[first + 3u]));
}

// Normalised Gaussian of standard deviation 1.5 at the integers from -5 to 0.
fn tap(distance: u32) -> f32 {
    switch distance {
        case 0u: { return 0.26601172486179436; }
        case 1u: { return 0.2130055377112537; }
        case 2u: { return 0.10936068950970002; }
        case 3u: { return 0.03600077212843083; }
        case 4u: { return 0.007598758135239185; }
        default: { return 0.00102838008447911; }
    }
}

// The source values with their margins, then their horizontal blurs: `WIDE` rows of `TILE`.
var<workgroup> source_x: array<f32, 676>;
var<workgroup> source_y: array<f32, 676>;
var<workgroup> source_z: array<f32, 676>;
var<workgroup> blurred_first: array<vec4<f32>, 416>;
var<workgroup> blurred_second: array<f32, 416>;
var<workgroup> parts: array<f32, THREADS>;

// The pixel at a place of the wide tile; beyond the image if its x is not below the width or its y not below the height.
fn wide_pixel(corner: vec2<u32>, place: u32) -> vec2<u32> {
    // Wraps below zero to far beyond.
    return corner + vec2(place % WIDE, place / WIDE) - RADIUS;
}

// Sum over the workgroup, in `parts[0]` for all threads.
fn sum_over_threads(thread: u32, value: f32) {
    parts[thread] = value;
    workgroupBarrier();
    for (var stride = THREADS / 2u; stride > 0u; stride /= 2u) {
        if thread < stride {
            parts[thread] += parts[thread + stride];
        }
        workgroupBarrier();
    }
}

// What SSIM is on a pixel, and its derivatives by windowed mean, square and product.
fn similarity_of(mean: f32, square: f32, product: f32, target_mean: f32, target_square: f32) -> vec4<f32> {
    // |2 cov| ≤ var + var holds exactly, but not after rounding: without these bounds the quotient of values far above 1
    // could have a zero or negative denominator.
    let variances = max((square - mean * mean) + (target_square - target_mean * target_mean), 0.0);
    let covariance = clamp(2.0 * (product - mean * target_mean), -variances, variances);
    let luminance = 2.0 * mean * target_mean + STABLE_MEAN;
    let structure = covariance + STABLE_VARIANCE;
    let luminance_norm = mean * mean + target_mean * target_mean + STABLE_MEAN;
    let structure_norm = variances + STABLE_VARIANCE;
    let norm = luminance_norm * structure_norm;
    let similarity = luminance * structure / norm;
    // Written as differences that vanish exactly for equal images.
    let by_mean = 2.0
        * (target_mean * (structure - luminance) + mean * similarity * (luminance_norm - structure_norm)) / norm;
    return vec4(similarity, by_mean, -similarity * luminance_norm / norm, 2.0 * luminance / norm);
}

@compute @workgroup_size(THREADS)
fn similarity(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group_number(group, groups);
    if tile >= view.tiles.x * view.tiles.y || state.failed != 0u {
        return;
    }
    let corner = vec2(tile % view.tiles.x, tile / view.tiles.x) * TILE;
    let pixel = corner + vec2(thread % TILE, thread / TILE);
    let is_inside = all(pixel < view.size);
    let pixels = view.size.x * view.size.y;
    let at = pixel.y * view.size.x + pixel.x;
    var weight = 0.0;
    if is_inside {
        weight = wanted_pixel(at).w;
    }
    var dissimilarity = 0.0;
    for (var channel = 0u; channel < 3u; channel++) {
        for (var place = thread; place < WIDE * WIDE; place += THREADS) {
            let from_pixel = wide_pixel(corner, place);
            var x = 0.0;
            var y = 0.0;
            if all(from_pixel < view.size) {
                let source = from_pixel.y * view.size.x + from_pixel.x;
                x = rendered[source][channel];
                y = wanted_pixel(source)[channel];
            }
            source_x[place] = x;
            source_y[place] = y;
        }
        workgroupBarrier();
        for (var place = thread; place < WIDE * TILE; place += THREADS) {
            let first = (place / TILE) * WIDE + place % TILE;
            var means = vec4(0.0);
            var product = 0.0;
            for (var i = 0u; i <= 2u * RADIUS; i++) {
                let x = source_x[first + i];
                let y = source_y[first + i];
                let w = tap(max(i, RADIUS) - min(i, RADIUS));
                means += w * vec4(x, y, x * x, y * y);
                product += w * (x * y);
            }
            blurred_first[place] = means;
            blurred_second[place] = product;
        }
        workgroupBarrier();
        if is_inside {
            var means = vec4(0.0);
            var product = 0.0;
            for (var i = 0u; i <= 2u * RADIUS; i++) {
                let w = tap(max(i, RADIUS) - min(i, RADIUS));
                means += w * blurred_first[thread + i * TILE];
                product += w * blurred_second[thread + i * TILE];
            }
            let found = similarity_of(means.x, means.z, product, means.y, means.w);
            dissimilarity += weight * (1.0 - found.x);
            derivatives[3u * channel * pixels + at] = weight * found.y;
            derivatives[(3u * channel + 1u) * pixels + at] = weight * found.z;
            derivatives[(3u * channel + 2u) * pixels + at] = weight * found.w;
        }
        workgroupBarrier();
    }
    sum_over_threads(thread, dissimilarity);
    if thread == 0u {
        shares[tile] = parts[0];
    }
}

@compute @workgroup_size(THREADS)
fn loss_gradient(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) thread: u32,
) {
    let tile = group_number(group, groups);
    if tile >= view.tiles.x * view.tiles.y || state.failed != 0u {
        return;
    }
    let corner = vec2(tile % view.tiles.x, tile / view.tiles.x) * TILE;
    let pixel = corner + vec2(thread % TILE, thread / TILE);
    let is_inside = all(pixel < view.size);
    let pixels = view.size.x * view.size.y;
    let at = pixel.y * view.size.x + pixel.x;
    var gradient = vec4(0.0);
    var difference = 0.0;
    for (var channel = 0u; channel < 3u; channel++) {
        for (var place = thread; place < WIDE * WIDE; place += THREADS) {
            let from_pixel = wide_pixel(corner, place);
            var values = vec3(0.0);
            if all(from_pixel < view.size) {
                let source = 3u * channel * pixels + from_pixel.y * view.size.x + from_pixel.x;
                values = vec3(derivatives[source], derivatives[source + pixels], derivatives[source + 2u * pixels]);
            }
            source_x[place] = values.x;
            source_y[place] = values.y;
            source_z[place] = values.z;
        }
        workgroupBarrier();
        // Three blurs fit in the memory of the four.
        for (var place = thread; place < WIDE * TILE; place += THREADS) {
            let first = (place / TILE) * WIDE + place % TILE;
            var sums = vec3(0.0);
            for (var i = 0u; i <= 2u * RADIUS; i++) {
                let w = tap(max(i, RADIUS) - min(i, RADIUS));
                sums += w * vec3(source_x[first + i], source_y[first + i], source_z[first + i]);
            }
            blurred_first[place] = vec4(sums, 0.0);
        }
        workgroupBarrier();
        if is_inside {
            var sums = vec3(0.0);
            for (var i = 0u; i <= 2u * RADIUS; i++) {
                let w = tap(max(i, RADIUS) - min(i, RADIUS));
                sums += w * blurred_first[thread + i * TILE].xyz;
            }
            let x = rendered[at][channel];
            let goal = wanted_pixel(at);
            let y = goal[channel];
            let weight = goal.w;
            let side = select(0.0, 1.0, x > y) - select(0.0, 1.0, x < y);
            let structural = sums.x + 2.0 * x * sums.y + y * sums.z;
            gradient[channel] = view.absolute * weight * side - view.structural * structural;
            difference += weight * abs(x - y);
        }
        workgroupBarrier();
    }
    if is_inside {
        image_gradient[at] = gradient;
    }
    sum_over_threads(thread, difference);
    if thread == 0u {
        shares[view.tiles.x * view.tiles.y + tile] = parts[0];
    }
}

@compute @workgroup_size(THREADS)
fn total(@builtin(local_invocation_index) thread: u32) {
    if state.failed != 0u {
        return;
    }
    let tiles = view.tiles.x * view.tiles.y;
    var dissimilarity = 0.0;
    var difference = 0.0;
    for (var tile = thread; tile < tiles; tile += THREADS) {
        dissimilarity += shares[tile];
        difference += shares[tiles + tile];
    }
    sum_over_threads(thread, view.absolute * difference + view.structural * dissimilarity);
    if thread == 0u {
        losses[step.loss_place] = parts[0];
    }
}
