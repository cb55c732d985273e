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
    lanes::{LANES, Simd, group, group_mut, simd_kernel},
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
fn backward_kernel<S: Simd>(
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
        let place_mark = S::splat(place as f32);
        let mut sums = Sums::<S>::zero();
        for row in rows(footprint, band.first_row, band.rows) {
            let Some(span) = span(footprint, row, band.width) else { continue };
            let row_start = (row - band.first_row) * band.stride;
            let mut row_sums = RowSums::<S>::zero();
            let mut offset = span.offset;
            let mut first = row_start + span.first;
            while first < row_start + span.end {
                let undone =
                    undo::<S>(&band.last, replay, first, offset, &span, footprint.colour, place_mark);
                if let Some(undone) = undone
                    && is_active
                {
                    row_sums.add(&undone, offset);
                    sums.add_colour(&undone, &replay.gradient, first);
                }
                first += LANES;
                offset += LANES as f32;
            }
            sums.add_row(&row_sums, span.dy);
        }
        gradients[place] = if is_active { sums.reduce() } else { FootprintGradient::default() };
    }
}

/// What one footprint did to a group of pixels.
struct Undone<S> {
    weight: S,
    /// `alpha · ∂loss/∂alpha`, zero where alpha was clamped.
    v: S,
}

/// Takes a footprint's light out of a group of pixels; `None` if none of them blended it.
#[inline(always)]
fn undo<S: Simd>(
    last: &[f32],
    replay: &mut Replay,
    first: usize,
    offset: f32,
    span: &Span,
    colour: [f32; 3],
    place: S,
) -> Option<Undone<S>> {
    let unclamped = span.alpha::<S>(offset);
    let largest = S::splat(ALPHA_MAX);
    let alpha = unclamped.min(largest);
    let blended = S::both(alpha.ge(S::splat(ALPHA_MIN)), place.lt(S::load(group(last, first))));
    if !S::any(blended) {
        return None;
    }
    let zero = S::splat(0.0);
    let alpha = S::select(blended, alpha, zero);
    let inverse = S::splat(1.0).div(S::splat(1.0).sub(alpha));
    let transmittance = group_mut(&mut replay.transmittance, first);
    let before = S::load(transmittance).mul(inverse);
    before.store(transmittance);
    let weight = before.mul(alpha);
    let [red, green, blue] = &replay.gradient;
    let light = S::splat(colour[0]).mul_add(
        S::load(group(red, first)),
        S::splat(colour[1])
            .mul_add(S::load(group(green, first)), S::splat(colour[2]).mul(S::load(group(blue, first)))),
    );
    let behind_plane = group_mut(&mut replay.behind, first);
    let behind = S::load(behind_plane);
    // ∂loss/∂alpha = T_before (c · g) - behind / (1 - alpha).
    let v = weight.mul(light).sub(alpha.mul(behind).mul(inverse));
    weight.mul_add(light, behind).store(behind_plane);
    Some(Undone { weight, v: S::select(unclamped.lt(largest), v, zero) })
}

struct RowSums<S> {
    v: S,
    v_d: S,
    v_dd: S,
}

impl<S: Simd> RowSums<S> {
    #[inline(always)]
    fn zero() -> Self {
        let zero = S::splat(0.0);
        Self { v: zero, v_d: zero, v_dd: zero }
    }

    #[inline(always)]
    fn add(&mut self, undone: &Undone<S>, offset: f32) {
        let d = S::ramp().add(S::splat(offset));
        let v_d = undone.v.mul(d);
        self.v = self.v.add(undone.v);
        self.v_d = self.v_d.add(v_d);
        self.v_dd = v_d.mul_add(d, self.v_dd);
    }
}

struct Sums<S> {
    row: RowSums<S>,
    v_y: S,
    v_dy: S,
    v_yy: S,
    colour: [S; 3],
}

impl<S: Simd> Sums<S> {
    #[inline(always)]
    fn zero() -> Self {
        let zero = S::splat(0.0);
        Self { row: RowSums::zero(), v_y: zero, v_dy: zero, v_yy: zero, colour: [zero; 3] }
    }

    #[inline(always)]
    fn add_colour(&mut self, undone: &Undone<S>, gradient: &[Vec<f32>; 3], first: usize) {
        for (sum, plane) in self.colour.iter_mut().zip(gradient) {
            *sum = undone.weight.mul_add(S::load(group(plane, first)), *sum);
        }
    }

    #[inline(always)]
    fn add_row(&mut self, row: &RowSums<S>, dy: f32) {
        let dy = S::splat(dy);
        let v_y = row.v.mul(dy);
        self.row.v = self.row.v.add(row.v);
        self.row.v_d = self.row.v_d.add(row.v_d);
        self.row.v_dd = self.row.v_dd.add(row.v_dd);
        self.v_y = self.v_y.add(v_y);
        self.v_dy = row.v_d.mul_add(dy, self.v_dy);
        self.v_yy = v_y.mul_add(dy, self.v_yy);
    }

    #[inline(always)]
    fn reduce(&self) -> FootprintGradient {
        FootprintGradient {
            v: self.row.v.sum().into(),
            v_d: self.row.v_d.sum().into(),
            v_dd: self.row.v_dd.sum().into(),
            v_y: self.v_y.sum().into(),
            v_dy: self.v_dy.sum().into(),
            v_yy: self.v_yy.sum().into(),
            colour: self.colour.map(|sum| sum.sum().into()),
        }
    }
}
