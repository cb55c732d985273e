//! Stage 2: depth order, and which footprints each band of rows sees.

use super::{depth_order::DepthOrder, project::Projection};

/// Rows per band: the unit of parallel work, independent of the number of threads.
pub(super) const BAND_ROWS: usize = 16;

/// Footprints of a view and, per band, those that touch it in depth order.
#[derive(Clone, Debug, Default)]
pub(super) struct Bins {
    /// What [`Bins::sort`] sorts.
    pub projection: Projection,
    /// `entries[starts[b]..starts[b + 1]]` belong to band `b`.
    starts: Vec<u32>,
    /// Gaussians, by depth within a band.
    entries: Vec<u32>,
    /// Where Gaussian `g` is among the entries of band `b`: `places[first_place[g] + b - first_band]`.
    places: Vec<u32>,
    /// First place per Gaussian, and the number of places at the end.
    first_place: Vec<u32>,
    next: Vec<u32>,
    depth_order: DepthOrder,
}

impl Bins {
    /// Number of bands.
    pub(super) fn bands(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Gaussians that touch a band, nearest first.
    pub(super) fn band(&self, band: usize) -> &[u32] {
        &self.entries[self.starts[band] as usize..self.starts[band + 1] as usize]
    }

    /// The places of Gaussian `index` in the lists of the bands that it touches, and the first of these bands.
    pub(super) fn places_of(&self, index: usize) -> (usize, &[u32]) {
        let places = self.first_place[index] as usize..self.first_place[index + 1] as usize;
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
            places += range.end - range.first;
            for band in range.first..range.end {
                self.starts[band as usize + 1] += 1;
            }
        }
        self.first_place.push(places);
        for band in 0..bands {
            self.starts[band + 1] += self.starts[band];
        }
        self.entries.resize(places as usize, 0);
        self.places.resize(places as usize, 0);
        self.next.clone_from(&self.starts);
        for &index in order {
            let range = self.projection.bands[index as usize];
            let first_place = self.first_place[index as usize];
            for band in range.first..range.end {
                let next = &mut self.next[band as usize];
                self.entries[*next as usize] = index;
                let place = *next - self.starts[band as usize];
                self.places[(first_place + band - range.first) as usize] = place;
                *next += 1;
            }
        }
    }
}
