//! Exact depth order, from the order of an earlier step if there is one.
//!
//! Means barely move from step to step, so the last order of a view is almost the next one. Whatever the start, the
//! result is the one order by depth, ties by index: a last pass of insertions leaves nothing out of place.

use crate::simd::prefetch;

/// Insertions may move this many elements per element before a sort from scratch is cheaper.
const MOVES_PER_ELEMENT: usize = 8;

/// Depths that are asked for ahead: depth order is no order in memory.
const AHEAD: usize = 16;

/// Buffers of [`DepthOrder::sort`].
#[derive(Clone, Debug, Default)]
pub(super) struct DepthOrder {
    keys: Vec<Key>,
    buffer: Vec<Key>,
    is_listed: Vec<bool>,
}

/// Depth bits, which order as positive depths do, and index.
type Key = (u64, u32);

impl DepthOrder {
    /// Sorts the indices whose depth is a number by depth, ties by index. `order` is that of an earlier step or empty,
    /// and becomes the new one. Depths are positive; NaN stands for what is not visible.
    pub(super) fn sort(&mut self, depths: &[f64], order: &mut Vec<u32>) {
        self.collect(depths, order);
        let budget = MOVES_PER_ELEMENT * depths.len();
        if !insert(&mut self.keys, budget) {
            // From index order, so that ties are in theirs.
            self.collect(depths, &[]);
            self.radix_sort();
            // Many depths may differ by less than single precision tells.
            if !insert(&mut self.keys, budget) {
                self.keys.sort_unstable();
            }
        }
        order.clear();
        order.extend(self.keys.iter().map(|&(_, index)| index));
    }

    /// Keys of the visible, those of `order` first and in that order.
    fn collect(&mut self, depths: &[f64], order: &[u32]) {
        self.keys.clear();
        self.is_listed.clear();
        self.is_listed.resize(depths.len(), false);
        for (number, &index) in order.iter().enumerate() {
            if let Some(depth) = order.get(number + AHEAD).and_then(|&later| depths.get(later as usize)) {
                prefetch(depth);
            }
            // Gaussians may have been replaced since.
            let Some(depth) = depths.get(index as usize) else { continue };
            if !depth.is_nan() && !std::mem::replace(&mut self.is_listed[index as usize], true) {
                self.keys.push((depth.to_bits(), index));
            }
        }
        for (index, depth) in depths.iter().enumerate() {
            if !(depth.is_nan() || self.is_listed[index]) {
                self.keys.push((depth.to_bits(), index as u32));
            }
        }
    }

    /// Sorts by the depth in single precision, least significant digit first.
    fn radix_sort(&mut self) {
        const DIGIT: u32 = 11;
        let digit = |key: &Key, shift: u32| {
            ((f64::from_bits(key.0) as f32).to_bits() >> shift) as usize & ((1 << DIGIT) - 1)
        };
        self.buffer.resize(self.keys.len(), (0, 0));
        for shift in [0, DIGIT, 2 * DIGIT] {
            let mut next = [0_u32; 1 << DIGIT];
            for key in &self.keys {
                next[digit(key, shift)] += 1;
            }
            let mut start = 0;
            for slot in &mut next {
                start += std::mem::replace(slot, start);
            }
            for key in &self.keys {
                let slot = &mut next[digit(key, shift)];
                self.buffer[*slot as usize] = *key;
                *slot += 1;
            }
            std::mem::swap(&mut self.keys, &mut self.buffer);
        }
    }
}

/// Sorts by insertions; `false`, with the keys in some other order, if more than `budget` moves are needed.
fn insert(keys: &mut [Key], budget: usize) -> bool {
    let mut moves = 0;
    for end in 1..keys.len() {
        let key = keys[end];
        let mut place = end;
        while place > 0 && keys[place - 1] > key {
            keys[place] = keys[place - 1];
            place -= 1;
        }
        keys[place] = key;
        moves += end - place;
        if moves > budget {
            return false;
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn expected(depths: &[f64]) -> Vec<u32> {
        let mut keys: Vec<(u64, u32)> = (0..depths.len())
            .filter(|&index| !depths[index].is_nan())
            .map(|index| (depths[index].to_bits(), index as u32))
            .collect();
        keys.sort_unstable();
        keys.into_iter().map(|(_, index)| index).collect()
    }

    #[test]
    fn every_start_gives_the_one_order() {
        let mut random = ChaCha8Rng::seed_from_u64(4);
        let mut sorter = DepthOrder::default();
        let mut depths: Vec<f64> = (0..5000).map(|_| random.random_range(0.01..1e6)).collect();
        // Closer than single precision can tell, and equal.
        for pair in depths[..1000].chunks_exact_mut(2) {
            pair[1] = pair[0] * (1.0 + 1e-12);
        }
        depths[2000..2100].fill(3.0);
        depths[3000..3500].fill(f64::NAN);
        let reference = expected(&depths);
        let shuffled = (0..5000).map(|_| random.random_range(0..6000)).collect();
        let reversed = reference.iter().rev().copied().collect();
        for start in [Vec::new(), reference.clone(), reversed, shuffled] {
            let mut order = start;
            sorter.sort(&depths, &mut order);
            assert_eq!(order, reference);
        }
        let wall: Vec<f64> = (0..5000).map(|place| 2.0 + f64::from(5000 - place) * 1e-12).collect();
        for start in [Vec::new(), reference.clone()] {
            let mut order = start;
            sorter.sort(&wall, &mut order);
            assert_eq!(order, expected(&wall));
        }
        let mut order = reference;
        for depth in &mut depths {
            *depth *= random.random_range(0.9999..1.0001);
        }
        depths[10] = f64::NAN;
        depths[3001] = 2.0;
        sorter.sort(&depths, &mut order);
        assert_eq!(order, expected(&depths));
    }

    #[test]
    fn nothing_has_no_order() {
        let mut order = vec![3, 1];
        DepthOrder::default().sort(&[], &mut order);
        assert!(order.is_empty());
        DepthOrder::default().sort(&[f64::NAN], &mut order);
        assert!(order.is_empty());
    }
}
