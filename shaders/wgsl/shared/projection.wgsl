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

// w, x, y, z of norm 1; the identity where the stored one has no direction.
fn unit_rotation(stored: vec4<f32>) -> vec4<f32> {
    let magnitude = abs(stored);
    let largest = max(max(magnitude.x, magnitude.y), max(magnitude.z, magnitude.w));
    if !(largest > 0.0 && largest < 3e38) {
        return vec4(1.0, 0.0, 0.0, 0.0);
    }
    // Twice, as the inverse of a subnormal number overflows.
    let doubled = select(stored, stored * 1e30, largest < 1e-30);
    let scaled = doubled / select(largest, largest * 1e30, largest < 1e-30);
    return scaled / sqrt(dot(scaled, scaled));
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
