// The opacity of a footprint on pixels, one definition for every stage that blends: alpha at offset e is
// 2^(peak - |L e|²), with the whitening matrix L in units of base-2 exponents.
#define_import_path footprint

// Alpha before the clamp at whitened offset (u, v). Every product is fused explicitly, so that no compiler decides
// differently in two stages whether a pixel lies inside a footprint.
fn alpha_of(peak: f32, u: f32, v: f32) -> f32 {
    return exp2(fma(-u, u, fma(-v, v, peak)));
}

// The whitened offset of a pixel, by the rows of the whitening matrix.
fn whiten(whitening: vec4<f32>, offset: vec2<f32>) -> vec2<f32> {
    return vec2(
        fma(whitening.x, offset.x, whitening.y * offset.y),
        fma(whitening.z, offset.x, whitening.w * offset.y),
    );
}

// The same for four pixels of a column, operation by operation.
fn alphas_of(peak: f32, u: vec4<f32>, v: vec4<f32>) -> vec4<f32> {
    return exp2(fma(-u, u, fma(-v, v, vec4(peak))));
}

fn whiten_column(row: vec2<f32>, x: f32, y: vec4<f32>) -> vec4<f32> {
    return fma(vec4(row.x), vec4(x), row.y * y);
}
