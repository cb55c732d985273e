//! Moments of every footprint under a track field, in one forward pass.
//!
//! The weight of a pixel is its blending weight `alpha · T` (TrackerSplat, section on parallel weighted incremental
//! least squares), times visibility, divided by the variance of its track. Sums are taken in f64 relative to the
//! projected mean and moved to the weighted centroids at the end, so nothing cancels.

use rayon::prelude::*;

use super::{
    ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN,
    bin::{BAND_ROWS, Bins},
    project::{Footprint, project},
    rows::{rows, span},
};
use crate::{
    cameras::Camera, engine::EngineError, gaussians::Gaussians, motion::moments::FootprintMoments,
    simd::Instructions, tracking::TrackField,
};

/// Raw sums of one footprint in one band, positions relative to the projected mean.
#[derive(Clone, Copy, Debug, Default)]
struct RawMoments {
    blend_weight: f64,
    weight: f64,
    weight_squared: f64,
    pixels: u32,
    position: [f64; 2],
    tracked: [f64; 2],
    source: [f64; 3],
    cross: [f64; 4],
    target: f64,
    variance: f64,
}

impl RawMoments {
    fn add_pixel(&mut self, weight: f64, variance: f64, [u, v]: [f64; 2], [tu, tv]: [f64; 2]) {
        self.weight += weight;
        self.weight_squared += weight * weight;
        self.pixels += 1;
        self.position[0] += weight * u;
        self.position[1] += weight * v;
        self.tracked[0] += weight * tu;
        self.tracked[1] += weight * tv;
        self.source[0] += weight * u * u;
        self.source[1] += weight * u * v;
        self.source[2] += weight * v * v;
        self.cross[0] += weight * tu * u;
        self.cross[1] += weight * tu * v;
        self.cross[2] += weight * tv * u;
        self.cross[3] += weight * tv * v;
        self.target += weight * (tu * tu + tv * tv);
        self.variance += weight * variance;
    }

    fn add(&mut self, other: &Self) {
        self.blend_weight += other.blend_weight;
        self.weight += other.weight;
        self.weight_squared += other.weight_squared;
        self.pixels += other.pixels;
        self.target += other.target;
        self.variance += other.variance;
        for (sum, value) in self.position.iter_mut().zip(other.position) {
            *sum += value;
        }
        for (sum, value) in self.tracked.iter_mut().zip(other.tracked) {
            *sum += value;
        }
        for (sum, value) in self.source.iter_mut().zip(other.source) {
            *sum += value;
        }
        for (sum, value) in self.cross.iter_mut().zip(other.cross) {
            *sum += value;
        }
    }

    /// Central moments, by the parallel-axis theorem; `tracked` was taken relative to the mean plus the first
    /// displacement, so both means are of the order of the footprint.
    fn centred(&self, mean: [f64; 2], shift: [f64; 2]) -> FootprintMoments {
        let mut moments = FootprintMoments { blend_weight: self.blend_weight, ..Default::default() };
        if !(self.weight > 0.0) {
            return moments;
        }
        let [u, v] = self.position.map(|sum| sum / self.weight);
        let [tu, tv] = self.tracked.map(|sum| sum / self.weight);
        let w = self.weight;
        moments.weight = w;
        moments.weight_squared = self.weight_squared;
        moments.pixels = self.pixels;
        moments.centroid = [mean[0] + u, mean[1] + v];
        moments.tracked_centroid = [mean[0] + shift[0] + tu, mean[1] + shift[1] + tv];
        moments.source = [
            (self.source[0] - w * u * u).max(0.0),
            self.source[1] - w * u * v,
            (self.source[2] - w * v * v).max(0.0),
        ];
        moments.cross = [
            self.cross[0] - w * tu * u,
            self.cross[1] - w * tu * v,
            self.cross[2] - w * tv * u,
            self.cross[3] - w * tv * v,
        ];
        moments.target = (self.target - w * (tu * tu + tv * tv)).max(0.0);
        moments.variance = self.variance;
        moments
    }
}

/// Moments of every Gaussian's footprint, one entry per Gaussian; all zero for those that no pixel sees.
pub(super) fn footprint_moments(
    instructions: Instructions,
    gaussians: &Gaussians,
    camera: &Camera,
    tracks: &TrackField,
) -> Result<Vec<FootprintMoments>, EngineError> {
    let pixels = camera.width as usize * camera.height as usize;
    let fits = tracks.width == camera.width
        && tracks.height == camera.height
        && [tracks.positions.len(), tracks.visible.len(), tracks.sigma.len()] == [pixels; 3];
    if !fits {
        return Err(EngineError::InvalidInput(format!(
            "a track field of {}x{} for a camera of {}x{}; give tracks of the camera's size",
            tracks.width, tracks.height, camera.width, camera.height
        )));
    }
    let mut bins = Bins::default();
    project(instructions, gaussians, camera, 0, &mut bins.projection);
    bins.sort(camera.height, &mut Vec::new());
    let footprints = &bins.projection.footprints;
    let shifts: Vec<[f64; 2]> =
        footprints.iter().map(|footprint| first_displacement(footprint, camera, tracks)).collect();
    let by_band: Vec<Vec<RawMoments>> = (0..bins.bands())
        .into_par_iter()
        .map(|band| band_moments(&bins, band, camera, tracks, &shifts))
        .collect();
    let moments = footprints.iter().zip(shifts).enumerate().map(|(index, (footprint, shift))| {
        let (first_band, places) = bins.places_of(index);
        let mut total = RawMoments::default();
        for (band, &place) in by_band[first_band..].iter().zip(places) {
            total.add(&band[place as usize]);
        }
        total.centred(footprint.mean, shift)
    });
    Ok(moments.collect())
}

/// Displacement of the pixel nearest to the projected mean: a reference point, not an estimate.
fn first_displacement(footprint: &Footprint, camera: &Camera, tracks: &TrackField) -> [f64; 2] {
    let nearest = |value: f64, size: u32| (value.max(0.0) as usize).min(size as usize - 1);
    let (x, y) = (nearest(footprint.mean[0], camera.width), nearest(footprint.mean[1], camera.height));
    let [tx, ty] = tracks.positions[y * camera.width as usize + x];
    let shift = [f64::from(tx) - (x as f64 + 0.5), f64::from(ty) - (y as f64 + 0.5)];
    if shift[0].is_finite() && shift[1].is_finite() { shift } else { [0.0; 2] }
}

fn band_moments(
    bins: &Bins,
    band: usize,
    camera: &Camera,
    tracks: &TrackField,
    shifts: &[[f64; 2]],
) -> Vec<RawMoments> {
    let width = camera.width as usize;
    let first_row = band * BAND_ROWS;
    let row_count = BAND_ROWS.min(camera.height as usize - first_row);
    let mut transmittance = vec![1.0f32; width * row_count];
    let mut moments = vec![RawMoments::default(); bins.band(band).len()];
    for (sums, &index) in moments.iter_mut().zip(bins.band(band)) {
        let footprint = &bins.projection.footprints[index as usize];
        let shift = shifts[index as usize];
        for row in rows(footprint, first_row, row_count) {
            let Some(span) = span(footprint, row, width) else { continue };
            for x in span.first..span.end {
                let d = span.offset + (x - span.first) as f32;
                let alpha = (span.peak - span.curvature * d * d).exp2().min(ALPHA_MAX);
                let left = &mut transmittance[(row - first_row) * width + x];
                let after = *left - *left * alpha;
                if alpha < ALPHA_MIN || *left <= 0.0 {
                    continue;
                }
                if after < TRANSMITTANCE_MIN {
                    *left = -*left;
                    continue;
                }
                let blend_weight = f64::from(*left * alpha);
                *left = after;
                sums.blend_weight += blend_weight;
                let pixel = row * width + x;
                let [tx, ty] = tracks.positions[pixel].map(f64::from);
                let sigma = f64::from(tracks.sigma[pixel]);
                let usable = tracks.visible[pixel]
                    && tx.is_finite()
                    && ty.is_finite()
                    && sigma.is_finite()
                    && sigma > 0.0;
                if !usable {
                    continue;
                }
                let offset = [x as f64 + 0.5 - footprint.mean[0], row as f64 + 0.5 - footprint.mean[1]];
                let tracked = [tx - footprint.mean[0] - shift[0], ty - footprint.mean[1] - shift[1]];
                let variance = sigma * sigma;
                sums.add_pixel(blend_weight / variance, variance, offset, tracked);
            }
        }
    }
    moments
}
