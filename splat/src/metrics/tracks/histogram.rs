//! Counts of values by magnitude.

/// Bits of an f32 that do not tell bins apart; nine bits of the significand remain.
const DROPPED_BITS: u32 = 14;
/// Every finite value that is not negative has its bin.
const BINS: usize = (f32::INFINITY.to_bits() >> DROPPED_BITS) as usize;

/// Values that are not negative, counted in bins 0.1 to 0.2 % wide.
#[derive(Clone, Debug)]
pub(super) struct Histogram {
    counts: Vec<u64>,
    count: u64,
    sum: f64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { counts: vec![0; BINS], count: 0, sum: 0.0 }
    }
}

impl Histogram {
    /// Counts a value; it must be finite and not negative.
    pub(super) fn add(&mut self, value: f32) {
        // Adding zero makes the negative zero the positive one.
        let bin = ((value + 0.0).to_bits() >> DROPPED_BITS) as usize;
        self.counts[bin.min(BINS - 1)] += 1;
        self.count += 1;
        self.sum += f64::from(value);
    }

    pub(super) fn merge(&mut self, other: &Self) {
        for (count, other) in self.counts.iter_mut().zip(&other.counts) {
            *count += other;
        }
        self.count += other.count;
        self.sum += other.sum;
    }

    pub(super) fn mean(&self) -> Option<f64> {
        super::share(self.sum, self.count as f64)
    }

    /// The smallest value that at least `fraction` of all values do not exceed, as the middle of its bin.
    pub(super) fn quantile(&self, fraction: f64) -> Option<f64> {
        let rank = ((self.count as f64 * fraction).ceil() as u64).clamp(1, self.count.max(1));
        let mut below = 0;
        let bin = self.counts.iter().position(|count| {
            below += count;
            below >= rank
        })?;
        if bin == 0 {
            return Some(0.0);
        }
        let middle = ((bin as u32) << DROPPED_BITS) + (1 << (DROPPED_BITS - 1));
        Some(f64::from(f32::from_bits(middle)))
    }
}
