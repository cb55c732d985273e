//! Footprints and lists of the tiles against double precision.

use glam::{DMat2, DVec2};
use splat::{cameras::Camera, gaussians::Gaussians, raster};

use super::support::{self, arc, blobs};
use crate::{
    buffers::Buffers,
    layout::{TILE, View},
    stages::{ViewBuffer, sorted_slots, tile_passes},
    transfer::read,
};

/// The ellipse of a Gaussian whose Jacobian is not clamped.
pub(super) struct Reference {
    pub mean: DVec2,
    pub covariance: DMat2,
    depth: f64,
    pub opacity: f64,
}

pub(super) fn reference(gaussians: &Gaussians, index: usize, camera: &Camera) -> Reference {
    let point = camera.to_camera(gaussians.mean(index));
    let [across, along] = camera.world_jacobian(point);
    let covariance = gaussians.covariance(index);
    let xy = across.dot(covariance * along);
    let xx = across.dot(covariance * across) + raster::LOW_PASS;
    let yy = along.dot(covariance * along) + raster::LOW_PASS;
    Reference {
        mean: camera.project(point).unwrap(),
        covariance: DMat2::from_cols(DVec2::new(xx, xy), DVec2::new(xy, yy)),
        depth: point.z,
        opacity: gaussians.opacity(index),
    }
}

impl Reference {
    /// What a pixel's centre sees of it.
    pub(super) fn alpha(&self, at: DVec2) -> f64 {
        let offset = at - self.mean;
        self.opacity * (-0.5 * offset.dot(self.covariance.inverse() * offset)).exp()
    }
}

/// Needles of aspect ratios to 1e4 among the others.
fn needles(seed: u64) -> Gaussians {
    let mut gaussians = blobs(400, 0, seed);
    for (index, scales) in gaussians.log_scales.iter_mut().enumerate() {
        scales[index % 3] += 2.5;
        scales[(index + 1) % 3] -= (index % 8) as f32;
    }
    gaussians
}

fn drawn(gaussians: &Gaussians, camera: &Camera) -> Option<(ViewBuffer, Buffers)> {
    let engine = support::engine()?;
    let view = ViewBuffer::new(&engine.context.device, View::new(camera, [0.0; 3])).unwrap();
    let buffers = engine.buffers(gaussians, &view.data, false).unwrap();
    let buffers = engine.draw(gaussians, &view, buffers).unwrap();
    Some((view, buffers))
}

#[test]
fn footprints_are_those_of_double_precision() {
    let (gaussians, camera) = (needles(3), &arc(3, 64, 48)[2]);
    let Some((_, buffers)) = drawn(&gaussians, camera) else { return };
    let device = &support::engine().unwrap().context.device;
    let footprints: Vec<[[f32; 4]; 3]> =
        read(device, &buffers.footprints.footprints, gaussians.len()).unwrap();
    let ranges: Vec<[u32; 2]> = read(device, &buffers.footprints.ranges, gaussians.len()).unwrap();
    let (mut mean_error, mut shape_error, mut seen) = (0.0_f64, 0.0_f64, 0);
    for index in 0..gaussians.len() {
        if ranges[index][0] == u32::MAX {
            continue;
        }
        seen += 1;
        let expected = reference(&gaussians, index, camera);
        let [[x, y, peak, _], [a, b, c, d], _] = footprints[index].map(|row| row.map(f64::from));
        mean_error = mean_error.max((DVec2::new(x, y) - expected.mean).abs().max_element());
        // L Σ Lᵀ is the identity, in units of base-2 exponents.
        let whitening = DMat2::from_cols(DVec2::new(a, c), DVec2::new(b, d));
        let unit = whitening * expected.covariance * whitening.transpose() / (0.5 * std::f64::consts::LOG2_E);
        let off = unit - DMat2::IDENTITY;
        shape_error = off.to_cols_array().iter().fold(shape_error, |worst, value| worst.max(value.abs()));
        assert!((peak - expected.opacity.log2()).abs() < 1e-6, "peak of {index}");
    }
    println!("{seen} seen: mean {mean_error:e} px, shape {shape_error:e}");
    assert!(seen > 300, "{seen} are no test");
    // A position is three roundings of numbers up to the image's width; the shape a dozen of the scales' squares.
    assert!(mean_error < 2e-5, "{mean_error}");
    assert!(shape_error < 2e-5, "{shape_error}");
}

#[test]
fn every_tile_with_a_pixel_in_reach_is_listed_nearest_first_and_few_others() {
    for (width, height, seed) in [(64, 48, 4), (70, 45, 5), (17, 13, 6)] {
        let (gaussians, camera) = (needles(seed), &arc(3, width, height)[1]);
        let Some((view, buffers)) = drawn(&gaussians, camera) else { return };
        let device = &support::engine().unwrap().context.device;
        let counts: Vec<u32> = read(device, &buffers.footprints.counts, gaussians.len() + 1).unwrap();
        let total = counts[gaussians.len()] as usize;
        let at = tile_passes(&view.data) as usize % 2;
        let keys: Vec<u32> = read(device, &buffers.intersections.tiles.keys[at], total).unwrap();
        let slots: Vec<u32> = read(device, sorted_slots(&buffers.intersections, &view.data), total).unwrap();
        let owners: Vec<u32> = read(device, &buffers.intersections.owners, total).unwrap();
        let bounds: Vec<[u32; 2]> =
            read(device, &buffers.images.bounds, view.data.tile_count() as usize).unwrap();
        let references: Vec<_> =
            (0..gaussians.len()).map(|index| reference(&gaussians, index, camera)).collect();
        let (mut needed, mut listed) = (0, 0);
        for (tile, &[first, end]) in bounds.iter().enumerate() {
            let places = first as usize..end as usize;
            assert!(keys[places.clone()].iter().all(|&key| key as usize == tile));
            let list: Vec<usize> = slots[places].iter().map(|&slot| owners[slot as usize] as usize).collect();
            // Depths that differ by less than single precision tells apart may stand either way.
            let depth = |index: usize| references[index].depth;
            assert!(list.windows(2).all(|pair| depth(pair[0]) < depth(pair[1]) + 1e-6), "nearest first");
            listed += list.len();
            let corner = [tile as u32 % view.data.tiles[0] * TILE, tile as u32 / view.data.tiles[0] * TILE];
            for (index, reference) in references.iter().enumerate() {
                if reaches(reference, corner, [width, height]) {
                    needed += 1;
                    assert!(list.contains(&index), "Gaussian {index} misses tile {tile}");
                }
            }
        }
        assert_eq!(listed, total);
        println!("{width}x{height}: {listed} listed, {needed} needed");
        // An ellipse may pass between pixel centres.
        assert!(listed <= needed + needed / 20 + 5, "{listed} listed, {needed} needed");
        assert!(needed > 300, "the test would show nothing with {needed}");
    }
}

/// Whether the alpha of a pixel of the tile reaches the threshold.
fn reaches(reference: &Reference, corner: [u32; 2], size: [u32; 2]) -> bool {
    let [columns, rows] = [0, 1].map(|axis| corner[axis]..(corner[axis] + TILE).min(size[axis]));
    rows.into_iter().any(|y| {
        columns.clone().any(|x| {
            let at = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
            reference.alpha(at) >= f64::from(raster::ALPHA_MIN)
        })
    })
}
