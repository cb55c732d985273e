//! Moments of every footprint under a track field.
//!
//! The weight of a pixel is its blending weight `alpha · T` (TrackerSplat, section on parallel weighted incremental least
//! squares), divided by the variance of its track; pixels without a usable track have none. Reweighting passes repeat
//! the sums over the same lists for the footprints that ask for it.

use rayon::prelude::*;

use super::{
    bin::Bins,
    blend::Band,
    block_moments::{NONE, PIXELS, Sums, WEIGHT_SQUARED, add_moments, feature},
    project::project,
};
use crate::{
    cameras::Camera,
    engine::EngineError,
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
    check(camera, tracks)?;
    let mut bins = Bins::default();
    project(instructions, gaussians, camera, 0, &mut bins.projection);
    bins.sort(camera.height, &mut Vec::new());
    let mut view = View { instructions, bins: &bins, tracks, bands: Vec::new() };
    view.list(camera);
    let of_bands = view.sums();
    let count = gaussians.len();
    let mut moments: Vec<FootprintMoments> =
        (0..count).into_par_iter().map(|index| centred(&view.total(&of_bands, index))).collect();
    drop(of_bands);
    let Some(reweighting) = reweighting else { return Ok(moments) };
    let expect = |index: u32| Some((index, reweighting.expected(&moments[index as usize])?));
    let mut expected: Vec<(u32, ExpectedMotion)> =
        (0..count as u32).into_par_iter().filter_map(expect).collect();
    for _ in 0..reweighting.passes {
        if expected.is_empty() {
            break;
        }
        for (index, sums) in view.reweighted_sums(count, &expected) {
            moments[index].reweigh(centred(&sums));
        }
        // What stands once, stands.
        let expect = |index: u32| Some((index, reweighting.expected(&moments[index as usize])?));
        expected = expected.into_par_iter().filter_map(|(index, _)| expect(index)).collect();
    }
    Ok(moments)
}

fn check(camera: &Camera, tracks: &TrackField) -> Result<(), EngineError> {
    let pixels = camera.width as usize * camera.height as usize;
    let fits = tracks.width == camera.width
        && tracks.height == camera.height
        && [tracks.positions.len(), tracks.visible.len(), tracks.sigma.len()] == [pixels; 3];
    if fits {
        return Ok(());
    }
    Err(EngineError::InvalidInput(format!(
        "a track field of {}x{} for a camera of {}x{}; give tracks of the camera's size",
        tracks.width, tracks.height, camera.width, camera.height
    )))
}

/// What all passes over a view share.
struct View<'a> {
    instructions: Instructions,
    bins: &'a Bins,
    tracks: &'a TrackField,
    bands: Vec<Band>,
}

impl View<'_> {
    /// Lists the footprints of every block.
    fn list(&mut self, camera: &Camera) {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let (bins, instructions) = (self.bins, self.instructions);
        self.bands.resize_with(bins.bands(), Band::default);
        self.bands
            .par_iter_mut()
            .enumerate()
            .for_each(|(number, band)| band.reset(instructions, bins, number, width, height, &[]));
    }

    /// The sums of each band's footprints.
    fn sums(&self) -> Vec<Vec<Sums>> {
        let of_band = |(number, band): (usize, &Band)| {
            let mut sums = vec![ZERO; self.bins.band(number).len()];
            add_moments(self.instructions, band, self.tracks, &[], &[], &mut sums);
            sums
        };
        self.bands.par_iter().enumerate().map(of_band).collect()
    }

    /// The sums of the Gaussians, of `count`, whose pixels are reweighted by an expected motion; in their order.
    fn reweighted_sums(&self, count: usize, expected: &[(u32, ExpectedMotion)]) -> Vec<(usize, Sums)> {
        let mut expectation_of = vec![NONE; count];
        for (number, (index, _)) in expected.iter().enumerate() {
            expectation_of[*index as usize] = number as u32;
        }
        let of_band = |(number, band): (usize, &Band)| {
            let (mut slots, mut numbers, mut motions) = (Vec::new(), Vec::new(), Vec::new());
            for &index in self.bins.band(number) {
                let number = expectation_of[index as usize];
                slots.push(if number == NONE { NONE } else { numbers.len() as u32 });
                if number != NONE {
                    numbers.push(number as usize);
                    motions.push(expected[number as usize].1);
                }
            }
            let mut sums = vec![ZERO; motions.len()];
            if !motions.is_empty() {
                add_moments(self.instructions, band, self.tracks, &slots, &motions, &mut sums);
            }
            (numbers, sums)
        };
        let of_bands: Vec<(Vec<usize>, Vec<Sums>)> = self.bands.par_iter().enumerate().map(of_band).collect();
        let mut totals: Vec<(usize, Sums)> =
            expected.iter().map(|(index, _)| (*index as usize, ZERO)).collect();
        for (numbers, sums) in &of_bands {
            for (&number, sums) in numbers.iter().zip(sums) {
                add(&mut totals[number].1, sums);
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
