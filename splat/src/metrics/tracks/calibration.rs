//! Whether stated standard deviations are those of the errors.

use serde::Serialize;

use super::share;

/// Bits of an f32 that do not tell bins apart: bins of at most 0.8 %.
const DROPPED_BITS: u32 = 16;
/// Every finite standard deviation that is not negative has its bin.
const BINS: usize = (f32::INFINITY.to_bits() >> DROPPED_BITS) as usize;

/// Errors per axis, counted by the standard deviation stated for them.
#[derive(Clone, Debug)]
pub struct Calibration {
    bins: Vec<Bin>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Bin {
    axes: u64,
    within: [u64; 2],
}

/// Axes of one tenth of all tracks, in order of their standard deviation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SigmaDecile {
    /// Smallest standard deviation, pixels.
    pub from: f64,
    /// Largest standard deviation, pixels.
    pub to: f64,
    /// Share of errors per axis of at most one standard deviation; 0.683 for a Gaussian.
    pub within_1: f64,
    /// Share of errors per axis of at most two standard deviations; 0.954 for a Gaussian.
    pub within_2: f64,
}

impl Default for Calibration {
    fn default() -> Self {
        Self { bins: vec![Bin::default(); BINS] }
    }
}

impl Calibration {
    /// Counts the errors of a track along both axes. What is not a number is never within; a standard deviation that
    /// is none counts as 0.
    pub fn add(&mut self, error: [f32; 2], sigma: f32) {
        // Adding zero makes the negative zero the positive one, whose bits are a bin.
        let sigma = if sigma.is_finite() { sigma.max(0.0) + 0.0 } else { 0.0 };
        let bin = &mut self.bins[(sigma.to_bits() >> DROPPED_BITS) as usize];
        for error in error {
            bin.axes += 1;
            bin.within[0] += u64::from(error.abs() <= sigma);
            bin.within[1] += u64::from(error.abs() <= 2.0 * sigma);
        }
    }

    /// Adds the counts of another.
    pub fn merge(&mut self, other: &Self) {
        for (bin, other) in self.bins.iter_mut().zip(&other.bins) {
            bin.axes += other.axes;
            bin.within[0] += other.within[0];
            bin.within[1] += other.within[1];
        }
    }

    /// Shares of all errors within one and two standard deviations.
    pub fn overall(&self) -> Option<[f64; 2]> {
        let axes: u64 = self.bins.iter().map(|bin| bin.axes).sum();
        let within = |times: usize| self.bins.iter().map(|bin| bin.within[times]).sum::<u64>() as f64;
        Some([share(within(0), axes as f64)?, share(within(1), axes as f64)?])
    }

    /// Ten groups of equal size, from the smallest standard deviations to the largest; none without tracks. A bin
    /// that spans a border is divided in proportion.
    pub fn deciles(&self) -> Vec<SigmaDecile> {
        let tenth = self.bins.iter().map(|bin| bin.axes).sum::<u64>() as f64 / 10.0;
        if tenth == 0.0 {
            return Vec::new();
        }
        let mut deciles = Vec::with_capacity(10);
        let mut open = Open::default();
        for (index, bin) in self.bins.iter().enumerate().filter(|(_, bin)| bin.axes > 0) {
            let mut left = bin.axes as f64;
            while left > 0.0 {
                let taken = left.min(tenth - open.axes);
                open.take(index, bin, taken);
                left -= taken;
                // Sums of fractions may miss the border by rounding; the last decile takes what is left.
                if open.axes >= tenth * (1.0 - 1e-9) && deciles.len() < 9 {
                    deciles.push(std::mem::take(&mut open).closed(tenth));
                } else if taken <= 0.0 {
                    open.take(index, bin, left);
                    left = 0.0;
                }
            }
        }
        let axes = open.axes;
        deciles.push(open.closed(axes));
        deciles
    }
}

/// A decile that is being filled.
#[derive(Default)]
struct Open {
    axes: f64,
    within: [f64; 2],
    bins: Option<[usize; 2]>,
}

impl Open {
    fn take(&mut self, index: usize, bin: &Bin, axes: f64) {
        self.axes += axes;
        for (sum, within) in self.within.iter_mut().zip(bin.within) {
            *sum += within as f64 * axes / bin.axes as f64;
        }
        self.bins = Some([self.bins.map_or(index, |[first, _]| first), index]);
    }

    fn closed(self, axes: f64) -> SigmaDecile {
        let edge = |bin: usize| f64::from(f32::from_bits((bin as u32) << DROPPED_BITS));
        let [first, last] = self.bins.unwrap_or_default();
        SigmaDecile {
            from: edge(first),
            to: edge(last + 1),
            within_1: self.within[0] / axes,
            within_2: self.within[1] / axes,
        }
    }
}
