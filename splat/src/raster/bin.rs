//! Stage 2: depth order, and which footprints each band of rows sees.

use super::project::Footprint;

/// Rows per band: the unit of parallel work, independent of the number of threads.
pub const BAND_ROWS: usize = 16;

/// Footprints in depth order and, per band, the positions in that order.
#[derive(Clone, Debug, Default)]
pub struct Bins {
    /// Footprints by camera z, ties in index order.
    pub footprints: Vec<Footprint>,
    /// `entries[starts[b]..starts[b + 1]]` belong to band `b`.
    pub starts: Vec<usize>,
    /// Positions in `footprints`, ascending within a band.
    pub entries: Vec<u32>,
    /// Where the entries of footprint `f` are: `slots[first_slot[f] + band - first_band]`.
    pub slots: Vec<u32>,
    /// First slot per footprint, and the number of slots at the end.
    pub first_slot: Vec<u32>,
    keys: Vec<(u64, u32)>,
    unsorted: Vec<Footprint>,
}

impl Bins {
    /// The buffer that projection fills; [`Bins::sort`] empties it.
    pub fn unsorted(&mut self) -> &mut Vec<Footprint> {
        &mut self.unsorted
    }

    /// Entries of one band.
    pub fn band(&self, band: usize) -> &[u32] {
        &self.entries[self.starts[band]..self.starts[band + 1]]
    }

    /// Number of bands.
    pub fn bands(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// Sorts the projected footprints by depth and distributes them over the bands of an image of `height` rows.
    pub fn sort(&mut self, height: u32) {
        self.keys.clear();
        // Depths are positive, so their bits order as they do.
        self.keys
            .extend(self.unsorted.iter().enumerate().map(|(place, f)| (f.depth.to_bits(), place as u32)));
        self.keys.sort_unstable();
        self.footprints.clear();
        self.footprints.extend(self.keys.iter().map(|&(_, place)| self.unsorted[place as usize]));
        self.distribute((height as usize).div_ceil(BAND_ROWS));
    }

    fn distribute(&mut self, bands: usize) {
        self.starts.clear();
        self.starts.resize(bands + 1, 0);
        self.first_slot.clear();
        let mut slots = 0;
        for footprint in &self.footprints {
            self.first_slot.push(slots);
            slots += footprint.end_band - footprint.first_band;
            for band in footprint.first_band..footprint.end_band {
                self.starts[band as usize + 1] += 1;
            }
        }
        self.first_slot.push(slots);
        for band in 0..bands {
            self.starts[band + 1] += self.starts[band];
        }
        self.entries.clear();
        self.entries.resize(slots as usize, 0);
        self.slots.clear();
        let mut next = self.starts.clone();
        for (position, footprint) in self.footprints.iter().enumerate() {
            for band in footprint.first_band as usize..footprint.end_band as usize {
                self.entries[next[band]] = position as u32;
                self.slots.push(next[band] as u32);
                next[band] += 1;
            }
        }
    }

    /// Entry numbers of the footprint at `position`, in band order.
    pub fn entries_of(&self, position: usize) -> &[u32] {
        &self.slots[self.first_slot[position] as usize..self.first_slot[position + 1] as usize]
    }
}
