// The opacity of a footprint on pixels, one definition for every stage that blends.
#define_import_path footprint

// A footprint as the blending stages read it.
struct Footprint {
    // Projected mean, pixels, and the logarithm to base 2 of the opacity.
    mean: vec2<f32>,
    peak: f32,
    // Whitening matrix by rows, in units of base-2 exponents: alpha at offset e is 2^(peak - |L e|²).
    whitening: vec4<f32>,
    colour: vec3<f32>,
}

// Alpha before the clamp at whitened offset (u, v). Every product is fused explicitly, so that no compiler decides
// differently in two stages whether a pixel lies inside a footprint.
fn alpha_of(peak: f32, u: f32, v: f32) -> f32 {
    return exp2(fma(-u, u, fma(-v, v, peak)));
}

// The whitened offset of a pixel.
fn whiten(whitening: vec4<f32>, offset: vec2<f32>) -> vec2<f32> {
    return vec2(
        fma(whitening.x, offset.x, whitening.y * offset.y),
        fma(whitening.z, offset.x, whitening.w * offset.y),
    );
}
