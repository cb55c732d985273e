// The local affine projection of one Gaussian, shared by `project` and its gradient.
//
// Single precision throughout, so every formula is chosen to have no cancellation however thin and slanted a footprint is:
// the offset from the camera centre is taken before the rotation; the cross product of the two rows of the spread is
// taken from the rows' own cross product, which is known in closed form; the inverse covariance is held as a triangular
// whitening matrix, whose conditional variance is Lagrange's sum of non-negative terms, along the axis in which the
// footprint is narrower, so that its slope is at most 1.
#define_import_path projection

#import types::{View, LOW_PASS}

struct Projected {
    // World position minus camera centre.
    offset: vec3<f32>,
    // Mean in camera axes.
    camera: vec3<f32>,
    // x / z and y / z after the clamp to the widened frustum, and where the clamp was active.
    slope: vec2<f32>,
    is_clamped: vec2<bool>,
    // Derivative of the pixel position by the world position, one row per axis.
    row_x: vec3<f32>,
    row_y: vec3<f32>,
    // Rotation of the Gaussian, one column per axis.
    rotation: mat3x3<f32>,
    scale: vec3<f32>,
    // The two rows of J W R diag(scale), and their cross product.
    across: vec3<f32>,
    along: vec3<f32>,
    crossed: vec3<f32>,
    // Covariance, pixels².
    xx: f32,
    xy: f32,
    yy: f32,
}

fn camera_offset(mean: vec3<f32>, view: View) -> vec3<f32> {
    let centre = vec3(view.right.w, view.down.w, view.forward.w);
    return (mean - centre) - view.centre_rest.xyz;
}

fn to_camera(offset: vec3<f32>, view: View) -> vec3<f32> {
    return vec3(dot(view.right.xyz, offset), dot(view.down.xyz, offset), dot(view.forward.xyz, offset));
}

fn largest_of(stored: vec4<f32>) -> f32 {
    let magnitude = abs(stored);
    return max(max(magnitude.x, magnitude.y), max(magnitude.z, magnitude.w));
}

// w, x, y, z of norm 1; the identity where the stored one has no direction.
fn unit_rotation(stored: vec4<f32>) -> vec4<f32> {
    let largest = largest_of(stored);
    if !(largest > 0.0 && largest < 3e38) {
        return vec4(1.0, 0.0, 0.0, 0.0);
    }
    // By the largest component first: squares of the stored ones may vanish or overflow.
    let scaled = stored / largest;
    return scaled / sqrt(dot(scaled, scaled));
}

// Gradient by the stored quaternion, from that by the rotation matrix.
fn rotation_gradient(stored: vec4<f32>, g: mat3x3<f32>) -> vec4<f32> {
    let unit = unit_rotation(stored);
    let w = unit.x;
    let x = unit.y;
    let y = unit.z;
    let z = unit.w;
    // g[c][r] is the gradient by entry (r, c).
    let by_unit = vec4(
        2.0 * (z * (g[0].y - g[1].x) + y * (g[2].x - g[0].z) + x * (g[1].z - g[2].y)),
        2.0 * (y * (g[1].x + g[0].y) + z * (g[2].x + g[0].z) + w * (g[1].z - g[2].y)) - 4.0 * x * (g[1].y + g[2].z),
        2.0 * (x * (g[1].x + g[0].y) + z * (g[2].y + g[1].z) + w * (g[2].x - g[0].z)) - 4.0 * y * (g[0].x + g[2].z),
        2.0 * (x * (g[2].x + g[0].z) + y * (g[2].y + g[1].z) + w * (g[0].y - g[1].x)) - 4.0 * z * (g[0].x + g[1].y),
    );
    let largest = largest_of(stored);
    if !(largest > 0.0 && largest < 3e38) {
        return vec4(0.0);
    }
    let scaled = stored / largest;
    return (by_unit - unit * dot(unit, by_unit)) / sqrt(dot(scaled, scaled)) / largest;
}

fn rotation_matrix(q: vec4<f32>) -> mat3x3<f32> {
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return mat3x3<f32>(
        vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
}

// The point must lie in front of the camera.
fn project_locally(
    offset: vec3<f32>,
    camera: vec3<f32>,
    unit: vec4<f32>,
    log_scale: vec3<f32>,
    view: View,
) -> Projected {
    var local: Projected;
    local.offset = offset;
    local.camera = camera;
    let slope = camera.xy / camera.z;
    local.slope = clamp(slope, view.slope_low, view.slope_high);
    local.is_clamped = (slope < view.slope_low) | (slope > view.slope_high);
    let by_depth = view.focal / camera.z;
    local.row_x = by_depth.x * (view.right.xyz - local.slope.x * view.forward.xyz);
    local.row_y = by_depth.y * (view.down.xyz - local.slope.y * view.forward.xyz);
    let normal = (by_depth.x * by_depth.y)
        * (local.slope.x * view.right.xyz + local.slope.y * view.down.xyz + view.forward.xyz);
    local.rotation = rotation_matrix(unit);
    local.scale = exp(log_scale);
    let s = local.scale;
    local.across = s * (local.row_x * local.rotation);
    local.along = s * (local.row_y * local.rotation);
    local.crossed = vec3(s.y * s.z, s.z * s.x, s.x * s.y) * (normal * local.rotation);
    local.xx = dot(local.across, local.across) + LOW_PASS;
    local.xy = dot(local.across, local.along);
    local.yy = dot(local.along, local.along) + LOW_PASS;
    return local;
}

// Variance along a row, `xx - xy² / yy`.
fn variance_along_row(local: Projected) -> f32 {
    let unblurred = dot(local.crossed, local.crossed) + LOW_PASS * dot(local.across, local.across);
    return LOW_PASS + unblurred / local.yy;
}

// Variance along a column, `yy - xy² / xx`.
fn variance_along_column(local: Projected) -> f32 {
    let unblurred = dot(local.crossed, local.crossed) + LOW_PASS * dot(local.along, local.along);
    return LOW_PASS + unblurred / local.xx;
}

// The rows of a matrix `L` with `LᵀL` the inverse covariance, first row, then second row: whitened offsets `L e` have
// the exponent `½ |L e|²`.
fn whitening(local: Projected) -> vec4<f32> {
    if local.xx <= local.yy {
        let inverse = 1.0 / sqrt(variance_along_row(local));
        return vec4(inverse, -local.xy / local.yy * inverse, 0.0, 1.0 / sqrt(local.yy));
    }
    let inverse = 1.0 / sqrt(variance_along_column(local));
    return vec4(-local.xy / local.xx * inverse, inverse, 1.0 / sqrt(local.xx), 0.0);
}

// The rows of `L` times the spread. Of the first one, the difference `across - slope · along` is written by the vector
// triple product, which does not cancel for needles.
fn whitened_spread(local: Projected) -> mat2x3<f32> {
    if local.xx <= local.yy {
        let along_row = LOW_PASS * local.across + cross(local.along, local.crossed);
        let scale = 1.0 / (local.yy * sqrt(variance_along_row(local)));
        return mat2x3(along_row * scale, local.along / sqrt(local.yy));
    }
    let along_column = LOW_PASS * local.along + cross(local.crossed, local.across);
    let scale = 1.0 / (local.xx * sqrt(variance_along_column(local)));
    return mat2x3(along_column * scale, local.across / sqrt(local.xx));
}
