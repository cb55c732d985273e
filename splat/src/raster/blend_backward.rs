//! Stage 4: the gradient of blending, by replay from back to front.
//!
//! Nothing is stored per pixel and footprint. From the final transmittance `T` and the light that arrives from behind,
//! `behind = Σ_later w_j (c_j · g) + T_final (background · g - g_alpha)` with `g` the gradient of the loss by the
//! pixel's colour, each step recovers the transmittance before a footprint as `T / (1 - alpha)`, which is safe as
//! alpha never exceeds [`ALPHA_MAX`].

use super::{
    ALPHA_MAX, ALPHA_MIN,
    bin::Bins,
    blend::{Band, Span, rows, span},
    lanes::{LANES, exp2, group, group_mut, multiply_add, simd_kernel, sum},
};

/// Gradient of the loss by one footprint, from one band or summed over bands.
///
/// With `v = alpha · ∂loss/∂alpha` and `d` the offset from the row centre, the moments of `v` suffice for the
/// footprint's position and shape.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct FootprintGradient {
    /// `Σ v`: by the logarithm of the opacity.
    pub v: f64,
    /// `Σ v d`.
    pub v_d: f64,
    /// `Σ v d²`.
    pub v_dd: f64,
    /// `Σ v dy`.
    pub v_y: f64,
    /// `Σ v d dy`.
    pub v_dy: f64,
    /// `Σ v dy²`.
    pub v_yy: f64,
    /// By the colour.
    pub colour: [f64; 3],
}

impl FootprintGradient {
    /// Adds another band's share.
    pub fn add(&mut self, other: &Self) {
        self.v += other.v;
        self.v_d += other.v_d;
        self.v_dd += other.v_dd;
        self.v_y += other.v_y;
        self.v_dy += other.v_dy;
        self.v_yy += other.v_yy;
        for channel in 0..3 {
            self.colour[channel] += other.colour[channel];
        }
    }
}

/// Planes of the replay, beside those of the [`Band`].
#[derive(Clone, Debug, Default)]
pub struct Replay {
    /// Gradient of the loss by red, green and blue.
    pub gradient: [Vec<f32>; 3],
    /// Transmittance behind the footprint at hand.
    pub transmittance: Vec<f32>,
    /// Light from behind, weighted with the gradient.
    pub behind: Vec<f32>,
}

impl Replay {
    /// Starts the replay of a blended band: `image_gradient` is `H × W × 3`, `alpha_gradient` `H × W` or empty.
    pub fn reset(
        &mut self,
        band: &Band,
        background: [f32; 3],
        image_gradient: &[f32],
        alpha_gradient: &[f32],
    ) {
        let size = band.stride * band.rows;
        for plane in self.gradient.iter_mut().chain([&mut self.transmittance, &mut self.behind]) {
            plane.clear();
            plane.resize(size, 0.0);
        }
        for row in 0..band.rows {
            for x in 0..band.width {
                let (place, pixel) = (row * band.stride + x, (band.first_row + row) * band.width + x);
                let transmittance = band.transmittance[place].abs();
                let mut from_background = -alpha_gradient.get(pixel).copied().unwrap_or(0.0);
                for channel in 0..3 {
                    let gradient = image_gradient[3 * pixel + channel];
                    self.gradient[channel][place] = gradient;
                    from_background += gradient * background[channel];
                }
                self.transmittance[place] = transmittance;
                self.behind[place] = transmittance * from_background;
            }
        }
    }
}

simd_kernel! {
    /// Gradients of the entries of band `number`, one per entry; those of Gaussians that are not `active` (empty: all
    /// are) stay zero, but their light is taken out all the same.
    pub fn blend_backward(
        bins: &Bins,
        number: usize,
        band: &Band,
        active: &[bool],
        replay: &mut Replay,
        gradients: &mut [FootprintGradient],
    ) = backward_kernel
}

#[inline(always)]
fn backward_kernel<const FUSED: bool>(
    bins: &Bins,
    number: usize,
    band: &Band,
    active: &[bool],
    replay: &mut Replay,
    gradients: &mut [FootprintGradient],
) {
    for (place, &position) in bins.band(number).iter().enumerate().rev() {
        let footprint = &bins.footprints[position as usize];
        let is_active = active.get(footprint.index as usize).copied().unwrap_or(true);
        let mut sums = Sums::default();
        for row in rows(footprint, band.first_row, band.rows) {
            let Some(span) = span(footprint, row, band.width) else { continue };
            let row_start = (row - band.first_row) * band.stride;
            let mut row_sums = RowSums::default();
            let mut offset = span.offset;
            let mut first = span.first;
            while first < span.end {
                let group_start = row_start + first;
                backward_group::<FUSED>(
                    &band.last,
                    replay,
                    group_start,
                    offset,
                    &span,
                    footprint.colour,
                    place as u32,
                    &mut row_sums,
                    &mut sums.colour,
                );
                first += LANES;
                offset += LANES as f32;
            }
            sums.add_row::<FUSED>(&row_sums, span.dy);
        }
        gradients[place] = if is_active { sums.reduce() } else { FootprintGradient::default() };
    }
}

#[derive(Default)]
struct RowSums {
    v: [f32; LANES],
    v_d: [f32; LANES],
    v_dd: [f32; LANES],
}

#[derive(Default)]
struct Sums {
    row: RowSums,
    v_y: [f32; LANES],
    v_dy: [f32; LANES],
    v_yy: [f32; LANES],
    colour: [[f32; LANES]; 3],
}

impl Sums {
    #[inline(always)]
    fn add_row<const FUSED: bool>(&mut self, row: &RowSums, dy: f32) {
        for lane in 0..LANES {
            let v_y = row.v[lane] * dy;
            self.row.v[lane] += row.v[lane];
            self.row.v_d[lane] += row.v_d[lane];
            self.row.v_dd[lane] += row.v_dd[lane];
            self.v_y[lane] += v_y;
            self.v_dy[lane] = multiply_add::<FUSED>(row.v_d[lane], dy, self.v_dy[lane]);
            self.v_yy[lane] = multiply_add::<FUSED>(v_y, dy, self.v_yy[lane]);
        }
    }

    #[inline(always)]
    fn reduce(&self) -> FootprintGradient {
        FootprintGradient {
            v: sum(&self.row.v).into(),
            v_d: sum(&self.row.v_d).into(),
            v_dd: sum(&self.row.v_dd).into(),
            v_y: sum(&self.v_y).into(),
            v_dy: sum(&self.v_dy).into(),
            v_yy: sum(&self.v_yy).into(),
            colour: [sum(&self.colour[0]).into(), sum(&self.colour[1]).into(), sum(&self.colour[2]).into()],
        }
    }
}

#[inline(always)]
fn backward_group<const FUSED: bool>(
    last: &[u32],
    replay: &mut Replay,
    first: usize,
    offset: f32,
    span: &Span,
    colour: [f32; 3],
    place: u32,
    row: &mut RowSums,
    colour_sums: &mut [[f32; LANES]; 3],
) {
    let last = group(last, first);
    let [red, green, blue] = &replay.gradient;
    let (red, green, blue) = (group(red, first), group(green, first), group(blue, first));
    let transmittance = group_mut(&mut replay.transmittance, first);
    let behind = group_mut(&mut replay.behind, first);
    let [red_sum, green_sum, blue_sum] = colour_sums;
    for lane in 0..LANES {
        let d = offset + lane as f32;
        let unclamped = exp2::<FUSED>(multiply_add::<FUSED>(-span.curvature * d, d, span.peak));
        let clamps = unclamped >= ALPHA_MAX;
        let alpha = if clamps { ALPHA_MAX } else { unclamped };
        let blended = (alpha >= ALPHA_MIN) & (last[lane] > place);
        let alpha = if blended { alpha } else { 0.0 };
        let inverse = 1.0 / (1.0 - alpha);
        let before = transmittance[lane] * inverse;
        let weight = before * alpha;
        let light = multiply_add::<FUSED>(
            colour[0],
            red[lane],
            multiply_add::<FUSED>(colour[1], green[lane], colour[2] * blue[lane]),
        );
        // alpha · ∂loss/∂alpha, with ∂loss/∂alpha = T_before (c · g) - behind / (1 - alpha).
        let v = weight * light - alpha * behind[lane] * inverse;
        let v = if clamps { 0.0 } else { v };
        let v_d = v * d;
        row.v[lane] += v;
        row.v_d[lane] += v_d;
        row.v_dd[lane] = multiply_add::<FUSED>(v_d, d, row.v_dd[lane]);
        red_sum[lane] = multiply_add::<FUSED>(weight, red[lane], red_sum[lane]);
        green_sum[lane] = multiply_add::<FUSED>(weight, green[lane], green_sum[lane]);
        blue_sum[lane] = multiply_add::<FUSED>(weight, blue[lane], blue_sum[lane]);
        transmittance[lane] = before;
        behind[lane] = multiply_add::<FUSED>(weight, light, behind[lane]);
    }
}
