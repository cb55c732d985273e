//! The 11-tap Gaussian window of SSIM and its separable application to rows.

/// Taps of the window.
pub(crate) const TAPS: usize = 11;

/// Taps on either side of the centre.
pub(crate) const RADIUS: usize = TAPS / 2;

/// The taps up to and including the centre; the others mirror them.
pub(super) type HalfWindow = [f32; RADIUS + 1];

/// One source row per tap, all of the same length.
pub(super) type TapRows<'a> = [&'a [f32]; TAPS];

/// Normalised Gaussian of standard deviation 1.5 at the integers from -5 to 5 (Wang et al. 2004).
pub(crate) fn gaussian_taps() -> [f64; TAPS] {
    const SIGMA: f64 = 1.5;
    let taps: [f64; TAPS] = std::array::from_fn(|tap| {
        let distance = tap as f64 - RADIUS as f64;
        (-distance * distance / (2.0 * SIGMA * SIGMA)).exp()
    });
    let sum: f64 = taps.iter().sum();
    taps.map(|tap| tap / sum)
}

/// [`gaussian_taps`] in single precision, without the mirrored half.
pub(super) fn half_window() -> HalfWindow {
    let taps = gaussian_taps();
    std::array::from_fn(|tap| taps[tap] as f32)
}

/// Windowed sums of a row, symmetric taps added first.
///
/// The rows are taken apart and cut to one length so that the loop has neither bounds checks nor aliases: LLVM
/// vectorises it.
#[inline(always)]
pub(super) fn blur(out: &mut [f32], rows: TapRows<'_>, window: &HalfWindow) {
    let length = out.len();
    let [a, b, c, d, e, centre, f, g, h, i, j] = rows.map(|row| &row[..length]);
    let [w0, w1, w2, w3, w4, w5] = *window;
    for at in 0..length {
        out[at] = w5 * centre[at]
            + w4 * (e[at] + f[at])
            + w3 * (d[at] + g[at])
            + w2 * (c[at] + h[at])
            + w1 * (b[at] + i[at])
            + w0 * (a[at] + j[at]);
    }
}

/// The tap rows of a horizontal window over a row that has [`RADIUS`] zeros on either side.
#[inline(always)]
pub(super) fn horizontal_taps(padded: &[f32]) -> TapRows<'_> {
    let width = padded.len() - 2 * RADIUS;
    std::array::from_fn(|tap| &padded[tap..][..width])
}

/// The tap rows of a vertical window centred on row `row`: `zeros.len()` values at `offset` of each record of
/// `stride` values. Rows outside the image are `zeros`.
#[inline(always)]
pub(super) fn vertical_taps<'a>(
    records: &'a [f32],
    stride: usize,
    row: usize,
    offset: usize,
    zeros: &'a [f32],
) -> TapRows<'a> {
    let height = records.len() / stride;
    std::array::from_fn(|tap| match (row + tap).checked_sub(RADIUS) {
        Some(source) if source < height => &records[source * stride + offset..][..zeros.len()],
        _ => zeros,
    })
}
