//! Moments of every footprint under a track field.
//!
//! The weight of a pixel is its blending weight `alpha · T` (TrackerSplat, section on parallel weighted incremental least
//! squares), divided by the variance of its track; pixels without a usable track have none. Reweighting passes repeat
//! the sums over the same lists for the footprints that ask for it.

use rayon::prelude::*;

use super::{
    bin::Bins,
    blend::Band,
    block_moments::{Sums, add_moments},
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
    simd::Instructions,
    tracking::TrackField,
};

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
    let mut moments: Vec<FootprintMoments> =
        view.sums(gaussians.len(), &[]).par_iter().map(Sums::centred).collect();
    let Some(reweighting) = reweighting else { return Ok(moments) };
    for _ in 0..reweighting.passes {
        let expected: Vec<Option<ExpectedMotion>> =
            moments.par_iter().map(|moments| reweighting.expected(moments)).collect();
        if expected.iter().all(Option::is_none) {
            break;
        }
        let sums = view.sums(gaussians.len(), &expected);
        moments.par_iter_mut().zip(&sums).zip(&expected).for_each(|((moments, sums), expected)| {
            if expected.is_some() {
                moments.reweigh(sums.centred());
            }
        });
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

    /// One pass: the sums of every footprint, of those with an expected motion only if any is given.
    fn sums(&self, count: usize, expected: &[Option<ExpectedMotion>]) -> Vec<Sums> {
        let by_band: Vec<Vec<Sums>> = self
            .bands
            .par_iter()
            .enumerate()
            .map(|(number, band)| {
                let indices = self.bins.band(number);
                let of_entries: Vec<Option<ExpectedMotion>> = match expected.is_empty() {
                    true => Vec::new(),
                    false => indices.iter().map(|&index| expected[index as usize]).collect(),
                };
                let mut sums = vec![Sums::default(); indices.len()];
                add_moments(self.instructions, band, self.tracks, &of_entries, &mut sums);
                sums
            })
            .collect();
        (0..count)
            .into_par_iter()
            .map(|index| {
                let (first_band, places) = self.bins.places_of(index);
                let mut total = Sums::default();
                for (band, &place) in by_band[first_band..].iter().zip(places) {
                    total.add(&band[place as usize]);
                }
                total
            })
            .collect()
    }
}

impl Sums {
    /// Central moments, by the parallel-axis theorem. Double precision holds image coordinates to 1e-12 px, so what
    /// cancels is far below a footprint's spread.
    fn centred(&self) -> FootprintMoments {
        let mut moments = FootprintMoments { blend_weight: self.blend_weight, ..Default::default() };
        if !(self.weight > 0.0) {
            return moments;
        }
        let w = self.weight;
        let [u, v] = self.position.map(|sum| sum / w);
        let [a, b] = self.displacement.map(|sum| sum / w);
        let source = [
            (self.source[0] - w * u * u).max(0.0),
            self.source[1] - w * u * v,
            (self.source[2] - w * v * v).max(0.0),
        ];
        let strain = [
            self.cross[0] - w * a * u,
            self.cross[1] - w * a * v,
            self.cross[2] - w * b * u,
            self.cross[3] - w * b * v,
        ];
        let power = (self.power - w * (a * a + b * b)).max(0.0);
        moments.weight = w;
        moments.weight_squared = self.weight_squared;
        moments.pixels = self.pixels as u32;
        moments.centroid = [u, v];
        moments.tracked_centroid = [u + a, v + b];
        moments.source = source;
        // The tracked position is the pixel plus its displacement.
        moments.cross = [
            source[0] + strain[0],
            source[1] + strain[1],
            source[1] + strain[2],
            source[2] + strain[3],
        ];
        moments.target = source[0] + source[2] + 2.0 * (strain[0] + strain[3]) + power;
        moments.variance = self.visible;
        moments.visible = self.visible;
        moments
    }
}
