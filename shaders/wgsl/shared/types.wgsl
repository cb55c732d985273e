// What the host writes and every stage reads. `src/layout.rs` has the twins; a test compares the two.
#define_import_path types

// One view: where it is taken from, and its size.
struct View {
    // Rows of the rotation from world to camera axes; the fourth values are the camera centre, rounded.
    right: vec4<f32>,
    down: vec4<f32>,
    forward: vec4<f32>,
    // What rounding left of the camera centre.
    centre_rest: vec4<f32>,
    // Colour behind everything.
    background: vec4<f32>,
    // Pixels.
    focal: vec2<f32>,
    principal: vec2<f32>,
    // Bounds of x / z and y / z in the slope of the local affine projection.
    slope_low: vec2<f32>,
    slope_high: vec2<f32>,
    // Pixels, and tiles.
    size: vec2<u32>,
    tiles: vec2<u32>,
    // Weights of the absolute and the structural term, per pixel and channel that counts.
    absolute: f32,
    structural: f32,
    // 1 if the training image has 8 bits per channel, in one word per pixel; 0 if it has four numbers.
    is_packed: u32,
    padding: u32,
}

// One step: the set of Gaussians, and how it is to be changed.
struct Step {
    // Number of Gaussians.
    count: u32,
    // Spherical-harmonic coefficients per Gaussian and channel, those stored.
    coefficients: u32,
    // Degree to evaluate.
    degree: u32,
    // Intersections that the buffers hold.
    capacity: u32,
    // Rates: mean, rotation, log scale, logit opacity.
    rates: vec4<f32>,
    // Rates of the spherical harmonics: degree 0, higher degrees.
    sh_rates: vec2<f32>,
    // 1 / (1 - beta1^t) and 1 / sqrt(1 - beta2^t).
    first_correction: f32,
    second_correction: f32,
    // Number of the step, for the report of an overflow.
    number: u32,
    // Where the loss is written.
    loss_place: u32,
    // 1 if only those Gaussians are changed that are flagged as active.
    has_active: u32,
    padding: u32,
}

// What the stages know about the step that runs, and what the host reads when it looks.
struct State {
    // Lengths of the two sorts: Gaussians, intersections.
    gaussians: u32,
    intersections: u32,
    // Intersections that the view has, saturated.
    needed: u32,
    // 1 from the first overflow on until the host has made room: no stage does anything then.
    failed: u32,
    // The step that overflowed.
    failed_step: u32,
}

// Constants of the equations, the same as in `splat::raster`; a test compares the two.
const NEAR_PLANE: f32 = 0.01;
const LOW_PASS: f32 = 0.3;
const ALPHA_MIN: f32 = 0.00392156862745098;
const ALPHA_MAX: f32 = 0.99;
const TRANSMITTANCE_MIN: f32 = 1e-4;

// Columns and rows of a tile.
const TILE: u32 = 16u;

// Values per Gaussian: mean 3, rotation 4, log scale 3, logit opacity 1.
const GEOMETRY: u32 = 11u;

// Values of an intersection's share of the gradient.
const SUMS: u32 = 9u;

const LOG2_E: f32 = 1.4426950408889634;

// Threads of a workgroup of the stages that have no own number.
const THREADS: u32 = 256u;

// Depth of a Gaussian that no pixel sees: sorted behind all others.
const UNSEEN: u32 = 0xffffffffu;

// Number of the workgroup where more than 65535 are laid out in rows.
fn group_number(group: vec3<u32>, groups: vec3<u32>) -> u32 {
    return group.y * groups.x + group.x;
}

// By the bits: a compiler may assume that there is no infinity and no NaN.
fn is_finite(value: f32) -> bool {
    return (bitcast<u32>(value) & 0x7f800000u) != 0x7f800000u;
}

fn all_finite(values: vec3<f32>) -> bool {
    return is_finite(values.x) && is_finite(values.y) && is_finite(values.z);
}
