//! Weighted moments of a Gaussian's footprint under a track field.

/// Moments of one Gaussian in one view, accumulated centred (see `goldens`: pixel minus centroid, tracked position
/// minus tracked centroid), so that single precision suffices for the sums.
///
/// The weight of a pixel is its blending weight `alpha * T`, times visibility, divided by the track's variance
/// where the caller asked for it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FootprintMoments {
    /// Sum of the blending weights `alpha * T` over **all** pixels of the footprint, visible or not.
    pub blend_weight: f64,
    /// Sum of the weights that entered the moments.
    pub weight: f64,
    /// Sum of the squared weights that entered the moments: `weight² / weight_squared` is the effective number of pixels.
    pub weight_squared: f64,
    /// Number of pixels that entered the moments.
    pub pixels: u32,
    /// Weighted mean pixel position, pixels.
    pub centroid: [f64; 2],
    /// Weighted mean tracked position, pixels.
    pub tracked_centroid: [f64; 2],
    /// `Σ w (du du, du dv, dv dv)` with `(du, dv)` the pixel minus the centroid.
    pub source: [f64; 3],
    /// `Σ w (eu du, eu dv, ev du, ev dv)` with `(eu, ev)` the tracked position minus the tracked centroid.
    pub cross: [f64; 4],
    /// `Σ w (eu² + ev²)`.
    pub target: f64,
    /// `Σ w σ²`, the track variance summed with the weights.
    pub variance: f64,
}
