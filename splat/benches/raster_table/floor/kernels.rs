//! The microkernels of the floor, and the choice of their instruction set.

#[cfg(target_arch = "x86_64")]
use super::vectors::{Avx2, Avx512};
use super::{
    PIXELS, PLANE, ROW,
    vectors::{Baseline, Vector},
};

const ALPHA_MIN: f32 = 1.0 / 255.0;
const ALPHA_MAX: f32 = 0.99;
const TRANSMITTANCE_MIN: f32 = 1e-4;
const RAMP: [f32; 16] = [0., 1., 2., 3., 4., 5., 6., 7., 8., 9., 10., 11., 12., 13., 14., 15.];

/// The instruction set of the kernels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Machine {
    /// Sixteen lanes per register.
    Avx512,
    /// Eight lanes per register.
    Avx2,
    /// What every machine of the architecture has.
    Baseline,
}

impl Machine {
    /// The widest that this machine has.
    pub(crate) fn best() -> Self {
        [Self::Avx512, Self::Avx2].into_iter().find(|machine| machine.is_there()).unwrap_or(Self::Baseline)
    }

    /// Whether this machine has it.
    pub(crate) fn is_there(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        {
            let is_avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
            match self {
                Self::Avx512 => is_avx2 && is_x86_feature_detected!("avx512f"),
                Self::Avx2 => is_avx2,
                Self::Baseline => true,
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        {
            self == Self::Baseline
        }
    }

    /// Name for reports.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Avx512 => "AVX-512",
            Self::Avx2 => "AVX2",
            Self::Baseline => "baseline",
        }
    }
}

/// One footprint, the same on each row of the patch.
#[derive(Clone, Copy, Debug)]
pub(super) struct Splat {
    /// Logarithm to base 2 of alpha at the centre.
    pub peak: f32,
    /// Fall of the exponent per squared pixel.
    pub curvature: f32,
    /// First column minus centre.
    pub offset: f32,
    /// What it looks like.
    pub colour: [f32; 3],
    /// 1 + number.
    pub mark: f32,
}

impl Splat {
    /// Alpha at a pixel of the patch, by definition.
    pub(super) fn alpha(&self, pixel: usize) -> f64 {
        let Span { peak, offset, curvature } = Span::new(self, pixel / ROW);
        let d = f64::from(offset) + (pixel % ROW) as f64;
        (f64::from(peak) - f64::from(curvature) * d * d).exp2()
    }
}

/// Planes of the pixels, aligned so that no register crosses a cache line.
#[derive(Clone, Debug)]
#[repr(align(64))]
pub(super) struct Patch {
    pub transmittance: [f32; PLANE],
    pub colour: [[f32; PLANE]; 3],
    pub last: [f32; PLANE],
    pub behind: [f32; PLANE],
}

impl Patch {
    /// Nothing blended yet.
    pub(super) fn open() -> Self {
        Self {
            transmittance: [1.0; PLANE],
            colour: [[0.0; PLANE]; 3],
            last: [0.0; PLANE],
            behind: [0.01; PLANE],
        }
    }
}

/// A footprint on a row of the patch. Rows differ, or the compiler would take alpha out of the loop over them.
#[derive(Clone, Copy)]
struct Span {
    /// Logarithm to base 2 of alpha at the row centre.
    peak: f32,
    /// Offset of the first column from the row centre.
    offset: f32,
    curvature: f32,
}

impl Span {
    #[inline(always)]
    fn new(splat: &Splat, row: usize) -> Self {
        let row = row as f32;
        Self { peak: splat.peak - 0.01 * row, offset: splat.offset + 0.3 * row, curvature: splat.curvature }
    }

    #[inline(always)]
    fn offsets<V: Vector>(&self) -> V {
        V::load(&RAMP).add(V::splat(self.offset))
    }

    #[inline(always)]
    fn alpha<V: Vector>(&self, d: V) -> V {
        d.mul(d).mul_add(V::splat(-self.curvature), V::splat(self.peak)).exp2()
    }
}

#[inline(always)]
fn forward_kernel<V: Vector>(splats: &[Splat], patch: &mut Patch) {
    let zero = V::splat(0.0);
    for splat in splats {
        for row in (0..PIXELS).step_by(ROW) {
            let span = Span::new(splat, row / ROW);
            let mut d: V = span.offsets();
            for first in (row..row + ROW).step_by(V::LANES) {
                let alpha = span.alpha(d).min(V::splat(ALPHA_MAX));
                let before = V::load(&patch.transmittance[first..]);
                let hit = V::both(alpha.ge(V::splat(ALPHA_MIN)), before.ge(zero));
                let weight = before.mul(alpha);
                let after = before.sub(weight);
                let blends = V::both(hit, after.ge(V::splat(TRANSMITTANCE_MIN)));
                let stopped = V::select(hit, zero.sub(before), before);
                V::select(blends, after, stopped).store(&mut patch.transmittance[first..]);
                let weight = V::select(blends, weight, zero);
                for (plane, colour) in patch.colour.iter_mut().zip(splat.colour) {
                    let plane = &mut plane[first..];
                    weight.mul_add(V::splat(colour), V::load(plane)).store(plane);
                }
                let last = &mut patch.last[first..];
                V::select(blends, V::splat(splat.mark), V::load(last)).store(last);
                d = d.add(V::splat(V::LANES as f32));
            }
        }
    }
}

/// The colour planes serve as gradient by the colour.
#[inline(always)]
fn backward_kernel<V: Vector>(splats: &[Splat], patch: &mut Patch, sums: &mut [[f32; 9]]) {
    let (zero, one, largest) = (V::splat(0.0), V::splat(1.0), V::splat(ALPHA_MAX));
    for (splat, out) in splats.iter().zip(sums).rev() {
        let [mut v_all, mut v_d_all, mut v_dd_all, mut v_y, mut v_dy, mut v_yy] = [zero; 6];
        let mut colour_sums = [zero; 3];
        for row in (0..PIXELS).step_by(ROW) {
            let [mut v_row, mut v_d_row, mut v_dd_row] = [zero; 3];
            let span = Span::new(splat, row / ROW);
            let mut d: V = span.offsets();
            for first in (row..row + ROW).step_by(V::LANES) {
                let unclamped = span.alpha(d);
                let clamped = unclamped.min(largest);
                let is_last = V::load(&patch.last[first..]).ge(V::splat(splat.mark));
                let alpha = V::select(V::both(clamped.ge(V::splat(ALPHA_MIN)), is_last), clamped, zero);
                let inverse = one.sub(alpha).reciprocal();
                let before = V::load(&patch.transmittance[first..]).mul(inverse);
                before.store(&mut patch.transmittance[first..]);
                let weight = before.mul(alpha);
                let [red, green, blue] = patch.colour.each_ref().map(|plane| V::load(&plane[first..]));
                let [r, g, b] = splat.colour.map(V::splat);
                let light = r.mul_add(red, g.mul_add(green, b.mul(blue)));
                let behind = V::load(&patch.behind[first..]);
                let v = weight.mul(light).sub(alpha.mul(behind).mul(inverse));
                weight.mul_add(light, behind).store(&mut patch.behind[first..]);
                let v = V::select(largest.ge(unclamped), v, zero);
                let v_d = v.mul(d);
                v_row = v_row.add(v);
                v_d_row = v_d_row.add(v_d);
                v_dd_row = v_d.mul_add(d, v_dd_row);
                for (sum, plane) in colour_sums.iter_mut().zip([red, green, blue]) {
                    *sum = weight.mul_add(plane, *sum);
                }
                d = d.add(V::splat(V::LANES as f32));
            }
            let dy = V::splat(row as f32 * 0.01 - 3.7);
            let v_y_row = v_row.mul(dy);
            v_all = v_all.add(v_row);
            v_d_all = v_d_all.add(v_d_row);
            v_dd_all = v_dd_all.add(v_dd_row);
            v_y = v_y.add(v_y_row);
            v_dy = v_d_row.mul_add(dy, v_dy);
            v_yy = v_y_row.mul_add(dy, v_yy);
        }
        let [red, green, blue] = colour_sums;
        *out = [v_all, v_d_all, v_dd_all, v_y, v_dy, v_yy, red, green, blue].map(V::sum);
    }
}

/// Adam over one flat array: `values -= rate · first / (√second + tiny)`.
#[inline(always)]
fn adam_kernel<V: Vector>(values: &mut [f32], gradient: &[f32], first: &mut [f32], second: &mut [f32]) {
    let [keep_first, keep_second] = [V::splat(0.9), V::splat(0.999)];
    let [take_first, take_second] = [V::splat(0.1), V::splat(0.001)];
    let (rate, tiny) = (V::splat(1e-7), V::splat(1e-15));
    let chunks = values.chunks_exact_mut(V::LANES).zip(gradient.chunks_exact(V::LANES));
    let moments = first.chunks_exact_mut(V::LANES).zip(second.chunks_exact_mut(V::LANES));
    for ((values, gradient), (first, second)) in chunks.zip(moments) {
        let slope = V::load(gradient);
        let mean = V::load(first).mul_add(keep_first, slope.mul(take_first));
        mean.store(first);
        let variance = V::load(second).mul_add(keep_second, slope.mul(slope).mul(take_second));
        variance.store(second);
        V::load(values).sub(rate.mul(mean).div(variance.sqrt().add(tiny))).store(values);
    }
}

/// Defines the compilations of a kernel and the choice between them.
macro_rules! compilations {
    ($(#[$meta:meta])* $name:ident($($argument:ident: $type:ty),*) = $kernel:ident) => {
        $(#[$meta])*
        ///
        /// # Panics
        /// If this machine does not have the instruction set.
        pub(super) fn $name(machine: Machine, $($argument: $type),*) {
            assert!(machine.is_there(), "this machine has no {}", machine.name());
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx2,fma")]
                fn avx512($($argument: $type),*) {
                    $kernel::<Avx512>($($argument),*);
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2($($argument: $type),*) {
                    $kernel::<Avx2>($($argument),*);
                }
                match machine {
                    // SAFETY: the machine has it, as was just asserted.
                    Machine::Avx512 => return unsafe { avx512($($argument),*) },
                    // SAFETY: as above.
                    Machine::Avx2 => return unsafe { avx2($($argument),*) },
                    Machine::Baseline => {}
                }
            }
            $kernel::<Baseline>($($argument),*);
        }
    };
}

compilations! {
    /// Blends the splats over the patch, front to back.
    forward(splats: &[Splat], patch: &mut Patch) = forward_kernel
}

compilations! {
    /// Takes the splats out of the patch, back to front, and writes nine sums for each.
    backward(splats: &[Splat], patch: &mut Patch, sums: &mut [[f32; 9]]) = backward_kernel
}

compilations! {
    /// One step of Adam over arrays of one length; what is left over at the end of a register stays.
    adam(values: &mut [f32], gradient: &[f32], first: &mut [f32], second: &mut [f32]) = adam_kernel
}
