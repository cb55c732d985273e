//! Stage 2: depth order, and which footprints each band of rows sees.

use super::{depth_order::DepthOrder, project::Projection};
use crate::simd::prefetch;

/// Rows per band: the unit of parallel work, independent of the number of threads.
pub(super) const BAND_ROWS: usize = 16;

/// Gaussians whose memory is asked for ahead: depth order is no order in memory.
const AHEAD: usize = 16;

/// Footprints of a view and, per band, those that touch it in depth order.
#[derive(Clone, Debug, Default)]
pub(super) struct Bins {
    /// What [`Bins::sort`] sorts.
    pub projection: Projection,
    /// `entries[starts[b]..starts[b + 1]]` belong to band `b`.
    starts: Vec<usize>,
    /// Gaussians, by depth within a band.
    entries: Vec<u32>,
    /// Where Gaussian `g` is among the entries of band `b`: `places[first_place[g] + b - first_band]`.
    places: Vec<u32>,
    /// First place per Gaussian, and the number of places at the end.
    first_place: Vec<usize>,
    next: Vec<usize>,
    depth_order: DepthOrder,
}

impl Bins {
    /// Number of bands.
    pub(super) fn bands(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Gaussians that touch a band, nearest first.
    pub(super) fn band(&self, band: usize) -> &[u32] {
        &self.entries[self.starts[band]..self.starts[band + 1]]
    }

    /// The places of Gaussian `index` in the lists of the bands that it touches, and the first of these bands.
    pub(super) fn places_of(&self, index: usize) -> (usize, &[u32]) {
        let places = self.first_place[index]..self.first_place[index + 1];
        (self.projection.bands[index].first as usize, &self.places[places])
    }

    /// Sorts the visible Gaussians by depth, ties in index order, and distributes them over the bands of an image of
    /// `height` rows. `order` is what it was after an earlier step of the same view, or empty: it saves time, and
    /// becomes the new order.
    pub(super) fn sort(&mut self, height: u32, order: &mut Vec<u32>) {
        self.depth_order.sort(&self.projection.depths, order);
        self.distribute((height as usize).div_ceil(BAND_ROWS), order);
    }

    fn distribute(&mut self, bands: usize, order: &[u32]) {
        self.starts.clear();
        self.starts.resize(bands + 1, 0);
        self.first_place.clear();
        let mut places = 0;
        for range in &self.projection.bands {
            self.first_place.push(places);
            places += (range.end - range.first) as usize;
            for band in range.first..range.end {
                self.starts[band as usize + 1] += 1;
            }
        }
        self.first_place.push(places);
        for band in 0..bands {
            self.starts[band + 1] += self.starts[band];
        }
        self.entries.resize(places, 0);
        self.places.resize(places, 0);
        self.next.clone_from(&self.starts);
        for (number, &index) in order.iter().enumerate() {
            if let Some(&later) = order.get(number + AHEAD) {
                prefetch(&self.projection.bands[later as usize]);
                prefetch(&self.first_place[later as usize]);
            }
            let range = self.projection.bands[index as usize];
            let first_place = self.first_place[index as usize];
            for band in range.first..range.end {
                let next = &mut self.next[band as usize];
                self.entries[*next] = index;
                // Fits, as no band has more places than there are Gaussians.
                let place = (*next - self.starts[band as usize]) as u32;
                self.places[first_place + (band - range.first) as usize] = place;
                *next += 1;
            }
        }
    }
}
