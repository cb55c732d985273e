//! Moments of every footprint under a track field.
//!
//! The weight of a pixel is its blending weight `alpha · T` (TrackerSplat, section on parallel weighted incremental least
//! squares), divided by the variance of its track; pixels without a usable track have none. Reweighting passes repeat
//! the sums over the same lists for the footprints that ask for it.

use rayon::prelude::*;

use super::{
    bin::Bins,
    block_moments::{NONE, PIXELS, Scratch, Slots, Sums, WEIGHT_SQUARED, add_moments, feature},
    blocks::{BandView, RoundLimit},
    project::project,
};
use crate::{
    cameras::Camera,
    engine::{EngineError, check_tracks},
    gaussians::Gaussians,
    motion::{
        moments::FootprintMoments,
        reweighting::{ExpectedMotion, Reweighting},
    },
    simd::{Instructions, prefetch},
    tracking::TrackField,
};

/// Gaussians whose sums are asked for ahead.
const AHEAD: usize = 8;

/// Moments of every Gaussian's footprint, one entry per Gaussian; all zero for those that no pixel sees.
pub(super) fn footprint_moments(
    instructions: Instructions,
    gaussians: &Gaussians,
    camera: &Camera,
    tracks: &TrackField,
    reweighting: Option<&Reweighting>,
) -> Result<Vec<FootprintMoments>, EngineError> {
    check_tracks(camera, tracks)?;
    let mut bins = Bins::default();
    project(instructions, gaussians, camera, 0, &mut bins.projection);
    bins.sort(camera.height, &mut Vec::new());
    let view = View { instructions, bins: &bins, camera, tracks };
    let of_bands = view.sums();
    let count = gaussians.len();
    let mut moments: Vec<FootprintMoments> =
        (0..count).into_par_iter().map(|index| centred(&view.total(&of_bands, index))).collect();
    drop(of_bands);
    if let Some(reweighting) = reweighting {
        reweighting.apply(&mut moments, |expected| {
            Ok::<_, EngineError>(view.reweighted_sums(count, expected).iter().map(centred).collect())
        })?;
    }
    Ok(moments)
}

/// What all passes over a view share.
struct View<'a> {
    instructions: Instructions,
    bins: &'a Bins,
    camera: &'a Camera,
    tracks: &'a TrackField,
}

impl View<'_> {
    fn band(&self, number: usize) -> BandView<'_> {
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        BandView { bins: self.bins, number, width, height, active: &[], limit: RoundLimit::default() }
    }

    /// The sums of each band's footprints.
    fn sums(&self) -> Vec<Vec<Sums>> {
        let slots = Slots { of_footprint: &[], expected: &[] };
        let of_band = |scratch: &mut Scratch, number: usize| {
            let mut sums = vec![ZERO; self.bins.band(number).len()];
            add_moments(self.instructions, scratch, &self.band(number), self.tracks, slots, &mut sums);
            sums
        };
        (0..self.bins.bands()).into_par_iter().map_init(Scratch::default, of_band).collect()
    }

    /// The sums of the Gaussians, of `count`, whose pixels are reweighted by an expected motion; in their order.
    fn reweighted_sums(&self, count: usize, expected: &[(u32, ExpectedMotion)]) -> Vec<Sums> {
        let mut expectation_of = vec![NONE; count];
        for (number, (index, _)) in expected.iter().enumerate() {
            expectation_of[*index as usize] = number as u32;
        }
        let of_band = |scratch: &mut Scratch, number: usize| {
            let (mut slots, mut numbers, mut motions) = (Vec::new(), Vec::new(), Vec::new());
            for &index in self.bins.band(number) {
                let expectation = expectation_of[index as usize];
                slots.push(if expectation == NONE { NONE } else { numbers.len() as u32 });
                if expectation != NONE {
                    numbers.push(expectation as usize);
                    motions.push(expected[expectation as usize].1);
                }
            }
            let mut sums = vec![ZERO; motions.len()];
            if !motions.is_empty() {
                let slots = Slots { of_footprint: &slots, expected: &motions };
                add_moments(self.instructions, scratch, &self.band(number), self.tracks, slots, &mut sums);
            }
            (numbers, sums)
        };
        let of_bands: Vec<(Vec<usize>, Vec<Sums>)> =
            (0..self.bins.bands()).into_par_iter().map_init(Scratch::default, of_band).collect();
        let mut totals = vec![ZERO; expected.len()];
        for (numbers, sums) in &of_bands {
            for (&number, sums) in numbers.iter().zip(sums) {
                add(&mut totals[number], sums);
            }
        }
        totals
    }

    /// The sums of one footprint over all bands.
    fn total(&self, of_bands: &[Vec<Sums>], index: usize) -> Sums {
        // Depth order is no order in memory.
        if index + AHEAD < self.bins.projection.bands.len() {
            let (first_band, places) = self.bins.places_of(index + AHEAD);
            for (band, &place) in of_bands[first_band..].iter().zip(places) {
                prefetch(&band[place as usize]);
            }
        }
        let (first_band, places) = self.bins.places_of(index);
        let mut total = ZERO;
        for (band, &place) in of_bands[first_band..].iter().zip(places) {
            add(&mut total, &band[place as usize]);
        }
        total
    }
}

const ZERO: Sums = [0.0; size_of::<Sums>() / size_of::<f64>()];

fn add(sums: &mut Sums, values: &Sums) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum += value;
    }
}

/// Central moments, by the parallel-axis theorem. Double precision holds image coordinates to 1e-12 px, so what
/// cancels is far below a footprint's spread.
fn centred(of: &Sums) -> FootprintMoments {
    let mut moments = FootprintMoments { blend_weight: of[feature::BLEND_WEIGHT], ..Default::default() };
    let w = of[feature::WEIGHT];
    if !(w > 0.0) {
        return moments;
    }
    let [u, v, a, b] = [0, 1, 2, 3].map(|k| of[feature::POSITION + k] / w);
    let [uu, uv, vv] = [0, 1, 2].map(|k| of[feature::SOURCE + k]);
    let [au, av, bu, bv] = [0, 1, 2, 3].map(|k| of[feature::CROSS + k]);
    let source = [(uu - w * u * u).max(0.0), uv - w * u * v, (vv - w * v * v).max(0.0)];
    let strain = [au - w * a * u, av - w * a * v, bu - w * b * u, bv - w * b * v];
    let power = of[feature::POWER] + of[feature::POWER + 1] - w * (a * a + b * b);
    moments.weight = w;
    moments.weight_squared = of[WEIGHT_SQUARED];
    moments.pixels = of[PIXELS] as u32;
    moments.centroid = [u, v];
    moments.tracked_centroid = [u + a, v + b];
    moments.source = source;
    // The tracked position is the pixel plus its displacement.
    moments.cross =
        [source[0] + strain[0], source[1] + strain[1], source[1] + strain[2], source[2] + strain[3]];
    moments.target = source[0] + source[2] + 2.0 * (strain[0] + strain[3]) + power.max(0.0);
    moments.variance = of[feature::VISIBLE];
    moments.visible = of[feature::VISIBLE];
    moments
}
