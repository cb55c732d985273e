// Which tiles a footprint reaches: those in which the ellipse alpha ≥ 1/255 has a point between the outermost pixel centres.
#define_import_path tiles

#import types::{View, TILE}

// The ellipse inside which alpha can reach the threshold.
struct Reach {
    // Mean, pixels.
    mean: vec2<f32>,
    // Row centre shift per row.
    slope: f32,
    // 2 · variance along a row.
    double_conditional: f32,
    // What the exponent may fall.
    reach: f32,
    // Root of half the inverse variance across rows: squared with the offset, so that neither overflows alone.
    fall: f32,
    // Rows between the mean and the end of the reach, and between the mean and the rightmost point in reach.
    half_height: f32,
    row_of_rightmost: f32,
}

fn unpack_reach(first: vec4<f32>, second: vec4<f32>) -> Reach {
    return Reach(first.xy, first.z, first.w, second.x, second.y, second.z, second.w);
}

// Margins cover the rounding of single precision, here and in the alpha of a pixel: the pixel itself decides at the threshold.
fn reached_height(r: Reach) -> f32 {
    return r.half_height * 1.000004 + 1e-3;
}

// From the first row of tiles to before the last one.
fn tile_rows(r: Reach, view: View) -> vec2<u32> {
    let last_row = f32(view.size.y) - 1.0;
    let low = r.mean.y - reached_height(r) - 0.5;
    let high = r.mean.y + reached_height(r) - 0.5;
    if !(high >= 0.0 && low <= last_row) {
        return vec2(0u);
    }
    return vec2(u32(max(low, 0.0)) / TILE, u32(min(high, last_row)) / TILE + 1u);
}

fn half_row(r: Reach, dy: f32) -> f32 {
    let root = dy * r.fall;
    return sqrt(max(r.reach - root * root, 0.0) * r.double_conditional);
}

// From the first tile of a row of tiles to before the last one. The rightmost point within the row is the ellipse's
// rightmost point of all, or lies on the row's edge towards it; the leftmost likewise.
fn tile_columns(r: Reach, row: u32, view: View) -> vec2<u32> {
    let height = reached_height(r);
    let above = max(f32(row * TILE) + 0.5 - r.mean.y, -height);
    let below = min(f32(min((row + 1u) * TILE, view.size.y)) - 0.5 - r.mean.y, height);
    if !(below >= above) {
        return vec2(0u);
    }
    let left_row = clamp(-r.row_of_rightmost, above, below);
    let right_row = clamp(r.row_of_rightmost, above, below);
    let left_half = half_row(r, left_row);
    let right_half = half_row(r, right_row);
    let left_shift = r.slope * left_row;
    let right_shift = r.slope * right_row;
    let magnitude = abs(r.mean.x) + abs(left_shift) + abs(right_shift) + left_half + right_half;
    let margin = magnitude * 4e-6 + 1e-3 + 0.5;
    let last_column = f32(view.size.x) - 1.0;
    let low = max(ceil(r.mean.x + left_shift - left_half - margin), 0.0);
    let high = min(floor(r.mean.x + right_shift + right_half + margin - 1.0), last_column);
    if !(high >= low) {
        return vec2(0u);
    }
    return vec2(u32(low) / TILE, u32(high) / TILE + 1u);
}
