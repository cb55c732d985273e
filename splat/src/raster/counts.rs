//! How much work a view is: the pairs of pixel and footprint behind the figures of a benchmark.

use std::ops::Add;

use rayon::prelude::*;

use super::{
    TRANSMITTANCE_MIN,
    bin::{BAND_ROWS, Bins},
    blend::BATCH,
    blocks::{BLOCKS, BandView, RoundLimit, TileLists, fill},
    project::project,
    rows::{rows, span},
    tile::{Offsets, Tile},
};
use crate::{
    cameras::Camera,
    gaussians::Gaussians,
    simd::{Instructions, LANES, Plain, Simd},
};

/// Work of one view. A pair is a pixel and a footprint.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PairCounts {
    /// Footprints that reach a pixel.
    pub footprints: u64,
    /// Footprints times bands that they touch.
    pub entries: u64,
    /// Footprints times rows on which they reach a pixel.
    pub spans: u64,
    /// Pairs in those spans: the exact ellipses, whether the pixel is still open or not.
    pub span_pairs: u64,
    /// Blocks of [`PairCounts::lanes_per_group`] pixels times footprints that are evaluated for them.
    pub groups: u64,
    /// Those in which at least one open pixel sees the footprint: the ones that blending must touch.
    pub live_groups: u64,
    /// Pairs that are blended.
    pub blended_pairs: u64,
}

impl PairCounts {
    /// Pixels of one block.
    pub const fn lanes_per_group() -> u64 {
        LANES as u64
    }

    /// Share of the evaluated lanes that blend.
    pub fn lane_occupancy(&self) -> f64 {
        self.blended_pairs as f64 / (Self::lanes_per_group() * self.groups).max(1) as f64
    }
}

impl Add for PairCounts {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            footprints: self.footprints + other.footprints,
            entries: self.entries + other.entries,
            spans: self.spans + other.spans,
            span_pairs: self.span_pairs + other.span_pairs,
            groups: self.groups + other.groups,
            live_groups: self.live_groups + other.live_groups,
            blended_pairs: self.blended_pairs + other.blended_pairs,
        }
    }
}

/// Counts the pairs of a view, one pixel at a time: too slow for anything but benchmarks.
pub fn pair_counts(gaussians: &Gaussians, camera: &Camera) -> PairCounts {
    let instructions = Instructions::detect();
    let mut bins = Bins::default();
    project(instructions, gaussians, camera, gaussians.sh_degree, &mut bins.projection);
    let mut order = Vec::new();
    bins.sort(camera.height, &mut order);
    let (width, height) = (camera.width as usize, camera.height as usize);
    let in_bands = (0..bins.bands())
        .into_par_iter()
        .map(|number| {
            let limit = RoundLimit::default();
            let view = BandView { bins: &bins, number, width, height, active: &[], limit };
            count_spans(&bins, number, width, height) + count_band(instructions, &view)
        })
        .reduce(PairCounts::default, Add::add);
    PairCounts { footprints: order.len() as u64, ..in_bands }
}

fn count_spans(bins: &Bins, number: usize, width: usize, height: usize) -> PairCounts {
    let first_row = number * BAND_ROWS;
    let band_rows = BAND_ROWS.min(height - first_row);
    let mut counts = PairCounts { entries: bins.band(number).len() as u64, ..PairCounts::default() };
    for &index in bins.band(number) {
        let footprint = &bins.projection.footprints[index as usize];
        for span in rows(footprint, first_row, band_rows).filter_map(|row| span(footprint, row, width)) {
            counts.spans += 1;
            counts.span_pairs += (span.end - span.first) as u64;
        }
    }
    counts
}

fn count_band(instructions: Instructions, view: &BandView<'_>) -> PairCounts {
    let (mut lists, mut tile) = (TileLists::default(), Tile::default());
    let mut open: Vec<_> =
        (0..view.tiles() * BLOCKS).map(|number| open(view, number / BLOCKS, number % BLOCKS)).collect();
    let mut counts = PairCounts::default();
    let mut first = 0;
    while first < view.footprints() {
        fill(instructions, &mut lists, view, first);
        first += lists.entries.len();
        for (number, open) in open.chunks_mut(BLOCKS).enumerate() {
            tile.gather(&lists, number, view.centre(number));
            for (block, open) in open.iter_mut().enumerate() {
                counts = counts + count_block(&mut tile, block, open);
            }
        }
    }
    counts
}

/// Transmittance per pixel; `None` outside the image and once blending has stopped.
type OpenPixels = [Option<f32>; LANES];

fn open(view: &BandView<'_>, tile: usize, block: usize) -> OpenPixels {
    let mut open = [None; LANES];
    view.pixels(tile, block).for_each(|(lane, _)| open[lane] = Some(1.0));
    open
}

fn count_block(tile: &mut Tile, block: usize, open: &mut OpenPixels) -> PairCounts {
    let mut counts = PairCounts::default();
    let offsets = Offsets::<Plain>::new(block);
    let count = tile.list::<Plain>(block);
    for (place, &seen) in tile.listed(count).iter().enumerate() {
        // As the kernel does, which looks before every batch.
        if place % BATCH == 0 && open.iter().all(Option::is_none) {
            break;
        }
        let mut alphas = [0.0; LANES];
        tile.seen[seen as usize].alpha(&offsets).store(&mut alphas);
        let mut is_live = false;
        for (pixel, alpha) in open.iter_mut().zip(alphas) {
            let Some(before) = *pixel else { continue };
            if alpha == 0.0 {
                continue;
            }
            is_live = true;
            let after = before - before * alpha;
            let blends = after >= TRANSMITTANCE_MIN;
            *pixel = blends.then_some(after);
            counts.blended_pairs += u64::from(blends);
        }
        counts.groups += 1;
        counts.live_groups += u64::from(is_live);
    }
    counts
}

#[cfg(test)]
mod tests {
    use glam::{DMat2, DVec2};

    use super::*;
    use crate::{
        raster::{ALPHA_MAX, ALPHA_MIN, LOW_PASS},
        testing::{arc, blobs, on_threads},
    };

    /// The definition, pixel by pixel in f64 over all Gaussians of the set, without spans, bands or groups.
    fn blended_by_definition(gaussians: &Gaussians, camera: &Camera) -> u64 {
        let mut order: Vec<usize> = (0..gaussians.len()).collect();
        let depth = |index: usize| camera.to_camera(gaussians.mean(index)).z;
        order.sort_by(|&a, &b| depth(a).total_cmp(&depth(b)));
        let projected: Vec<(DVec2, DMat2, f64)> = order
            .iter()
            .map(|&index| {
                let point = camera.to_camera(gaussians.mean(index));
                let [x, y] = camera.world_jacobian(point);
                let covariance = gaussians.covariance(index);
                let (cx, cy) = (covariance * x, covariance * y);
                let xy = x.dot(cy);
                let blurred = DMat2::from_cols_array(&[x.dot(cx) + LOW_PASS, xy, xy, y.dot(cy) + LOW_PASS]);
                (
                    camera.project(point).expect("in front of the camera"),
                    blurred.inverse(),
                    gaussians.opacity(index),
                )
            })
            .collect();
        let mut blended = 0;
        for pixel in 0..camera.width * camera.height {
            let centre =
                DVec2::new(f64::from(pixel % camera.width) + 0.5, f64::from(pixel / camera.width) + 0.5);
            let mut transmittance = 1.0;
            for (mean, inverse, opacity) in &projected {
                let d = centre - *mean;
                let alpha = (opacity * (-0.5 * d.dot(*inverse * d)).exp()).min(ALPHA_MAX.into());
                if alpha < ALPHA_MIN.into() {
                    continue;
                }
                let after = transmittance * (1.0 - alpha);
                if after < f64::from(TRANSMITTANCE_MIN) {
                    break;
                }
                transmittance = after;
                blended += 1;
            }
        }
        blended
    }

    #[test]
    fn blended_pairs_are_those_of_the_definition() {
        // Crowded and opaque, so that pixels stop; all in view, so that the frustum clamp of the projection is not active.
        let (gaussians, camera) = (blobs(300, 21), &arc(1, 70, 45)[0]);
        let counts = pair_counts(&gaussians, camera);
        let expected = blended_by_definition(&gaussians, camera);
        assert!(expected > 20_000, "{expected} pairs are no test");
        // Single precision decides otherwise than double only where alpha or the transmittance is within about 1e-6 of its
        // threshold, which one pair in 1e5 is.
        assert!(counts.blended_pairs.abs_diff(expected) <= 2, "{} of {expected}", counts.blended_pairs);
    }

    #[test]
    fn counts_nest() {
        let (gaussians, camera) = (blobs(300, 22), &arc(1, 70, 45)[0]);
        let counts = pair_counts(&gaussians, camera);
        let lanes = PairCounts::lanes_per_group();
        assert!(counts.blended_pairs < counts.span_pairs);
        assert!(counts.span_pairs <= lanes * counts.groups, "every pixel in reach lies in a listed block");
        assert!(counts.live_groups < counts.groups, "some pixels stop");
        assert!(counts.blended_pairs <= lanes * counts.live_groups);
        assert!(counts.footprints <= counts.entries && counts.entries <= counts.spans);
        assert!(counts.lane_occupancy() > 0.0 && counts.lane_occupancy() < 1.0);
    }

    #[test]
    fn one_gaussian_on_one_pixel_is_one_pair() {
        let mut gaussians = blobs(1, 23);
        gaussians.means[0] = [0.0; 3];
        gaussians.logit_opacities[0] = 0.0;
        let camera = &arc(1, 1, 1)[0];
        let expected = PairCounts {
            footprints: 1,
            entries: 1,
            spans: 1,
            span_pairs: 1,
            groups: 1,
            live_groups: 1,
            blended_pairs: 1,
        };
        assert_eq!(pair_counts(&gaussians, camera), expected);
    }

    #[test]
    fn nothing_is_no_work() {
        let counts = pair_counts(&Gaussians::empty(0), &arc(1, 20, 20)[0]);
        assert_eq!(counts, PairCounts::default());
        assert_eq!(counts.lane_occupancy(), 0.0);
    }

    #[test]
    fn any_number_of_threads_counts_the_same() {
        let (gaussians, camera) = (blobs(200, 24), &arc(1, 70, 45)[0]);
        let count = |threads| on_threads(threads, || pair_counts(&gaussians, camera));
        assert_eq!(count(1), count(3));
    }
}
