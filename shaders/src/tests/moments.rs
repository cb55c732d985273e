//! Moments against sums in double precision over the very footprints and lists that the device made: what remains are the
//! errors of the sums and of alpha.

use std::sync::Arc;

use glam::DVec2;
use splat::{
    cameras::Camera,
    engine::Engine,
    gaussians::Gaussians,
    motion::moments::FootprintMoments,
    raster::{ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN},
    tracking::TrackField,
};

use super::support::{self, arc, blobs, rough_tracks};
use crate::{
    GpuEngine,
    layout::{TILE, View},
    moments::LastMeasured,
    stages::{ViewBuffer, sorted_slots},
    transfer::read,
};

/// A pixel of a footprint: its weight `alpha · T`, inverse variance, position and displacement.
type Seen = (f64, f64, DVec2, DVec2);

/// What each footprint sees, blended in double precision; pixels without a track have no inverse variance.
fn seen(engine: &GpuEngine, gaussians: &Gaussians, camera: &Camera, tracks: &TrackField) -> Vec<Vec<Seen>> {
    let device = &engine.context.device;
    let view = ViewBuffer::new(device, View::new(camera, [0.0; 3])).unwrap();
    let buffers = engine.buffers(gaussians, &view.data, false).unwrap();
    let buffers = engine.draw(gaussians, &view, buffers).unwrap();
    let footprints: Vec<[[f32; 4]; 3]> =
        read(device, &buffers.footprints.footprints, gaussians.len()).unwrap();
    let bounds: Vec<[u32; 2]> =
        read(device, &buffers.images.bounds, view.data.tile_count() as usize).unwrap();
    let total = bounds.iter().map(|range| range[1] as usize).max().unwrap();
    let slots: Vec<u32> = read(device, sorted_slots(&buffers.intersections, &view.data), total).unwrap();
    let owners: Vec<u32> = read(device, &buffers.intersections.owners, total).unwrap();
    let mut found = vec![Vec::new(); gaussians.len()];
    for pixel in 0..tracks.positions.len() {
        let (column, row) = (pixel as u32 % camera.width, pixel as u32 / camera.width);
        let x = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
        let target = DVec2::from_array(tracks.positions[pixel].map(f64::from));
        let sigma = f64::from(tracks.sigma[pixel]);
        let inverse = if tracks.visible[pixel] { sigma.powi(-2) } else { 0.0 };
        let [first, end] = bounds[(row / TILE * view.data.tiles[0] + column / TILE) as usize];
        let mut transmittance = 1.0;
        for &slot in &slots[first as usize..end as usize] {
            let owner = owners[slot as usize] as usize;
            let [[cx, cy, peak, _], [a, b, c, d], _] = footprints[owner].map(|row| row.map(f64::from));
            let e = x - DVec2::new(cx, cy);
            let (u, v) = (a * e.x + b * e.y, c * e.x + d * e.y);
            let alpha = (peak - u * u - v * v).exp2().min(f64::from(ALPHA_MAX));
            if alpha < f64::from(ALPHA_MIN) {
                continue;
            }
            let left = transmittance * (1.0 - alpha);
            if left < f64::from(TRANSMITTANCE_MIN) {
                break;
            }
            found[owner].push((transmittance * alpha, inverse, x, target - x));
            transmittance = left;
        }
    }
    found
}

/// In two passes, so that nothing cancels.
fn exact(pixels: &[Seen]) -> FootprintMoments {
    let blend_weight = pixels.iter().map(|(share, ..)| share).sum();
    let usable: Vec<(f64, DVec2, DVec2)> = pixels
        .iter()
        .filter(|seen| seen.1 > 0.0)
        .map(|&(share, inverse, x, a)| (share * inverse, x, a))
        .collect();
    let weight: f64 = usable.iter().map(|(w, ..)| w).sum();
    if usable.is_empty() {
        return FootprintMoments { blend_weight, ..Default::default() };
    }
    let centroid = usable.iter().map(|&(w, x, _)| w * x).sum::<DVec2>() / weight;
    let tracked = usable.iter().map(|&(w, x, a)| w * (x + a)).sum::<DVec2>() / weight;
    let sum = |value: &dyn Fn(DVec2, DVec2) -> f64| -> f64 {
        usable.iter().map(|&(w, x, a)| w * value(x - centroid, x + a - tracked)).sum()
    };
    let visible = pixels.iter().filter(|seen| seen.1 > 0.0).map(|seen| seen.0).sum();
    FootprintMoments {
        blend_weight,
        visible,
        weight,
        weight_squared: usable.iter().map(|(w, ..)| w * w).sum(),
        pixels: usable.len() as u32,
        centroid: centroid.to_array(),
        tracked_centroid: tracked.to_array(),
        source: [sum(&|d, _| d.x * d.x), sum(&|d, _| d.x * d.y), sum(&|d, _| d.y * d.y)],
        cross: [
            sum(&|d, e| e.x * d.x),
            sum(&|d, e| e.x * d.y),
            sum(&|d, e| e.y * d.x),
            sum(&|d, e| e.y * d.y),
        ],
        target: sum(&|_, e| e.length_squared()),
        variance: visible,
        contest: 0.0,
    }
}

#[test]
fn sums_in_single_precision_cost_no_accuracy() {
    let Some(engine) = support::engine() else { return };
    // Giants over many tiles among small ones.
    let mut gaussians = blobs(300, 0, 51);
    for (index, scales) in gaussians.log_scales.iter_mut().enumerate() {
        let change = [-1.5, 0.0, 1.5][index % 3];
        *scales = scales.map(|scale| scale + change);
    }
    gaussians.logit_opacities.iter_mut().for_each(|logit| *logit -= 4.0);
    for (camera, jump) in
        [(&arc(3, 150, 101)[1], 11.0), (&arc(3, 64, 48)[0], 0.0), (&arc(3, 17, 13)[2], 40.0)]
    {
        let [compared, seen_at_all] = check(engine, &gaussians, camera, &rough_tracks(camera, jump, 52));
        assert!(compared > 100, "{compared} of {seen_at_all}");
    }
}

/// Moments of every footprint; says how many were compared, and how many see a pixel.
pub(super) fn check(
    engine: &GpuEngine,
    gaussians: &Gaussians,
    camera: &Camera,
    tracks: &TrackField,
) -> [usize; 2] {
    let ours = engine.footprint_moments(gaussians, camera, tracks, None).unwrap();
    let (mut compared, mut seen_at_all, mut worst) = (0, 0, [0.0_f64; 3]);
    for (found, pixels) in ours.iter().zip(&seen(engine, gaussians, camera, tracks)) {
        let exact = exact(pixels);
        seen_at_all += usize::from(exact.pixels > 0);
        // A pixel at the threshold of alpha or of transmittance may fall either way.
        if found.pixels != exact.pixels || found.pixels == 0 {
            continue;
        }
        compared += 1;
        let errors = errors(found, &exact);
        worst = std::array::from_fn(|k| worst[k].max(errors[k]));
    }
    let [means, seconds, weights] = worst;
    println!(
        "{compared} of {seen_at_all}: means {means:.1e} px, second {seconds:.1e}, weights {weights:.1e}"
    );
    assert!(compared * 20 + 20 >= seen_at_all * 19, "{compared} of {seen_at_all}");
    // What the CPU engine is held to; and an offset from the centre rounds, where the steepest footprint falls by six of
    // its weight per pixel.
    let alpha = 1e-6 + 6.0 * 2f64.powi(-24) * f64::from(camera.width.max(camera.height));
    assert!(means < 2e-5, "means off by {means:e} px");
    assert!(seconds < 5e-6 + alpha, "second moments off by {seconds:e}");
    // The figure adds four of them up.
    assert!(weights < 4.0 * alpha, "weights off by {weights:e}");
    [compared, seen_at_all]
}

/// Of the means, px per `1 px + a tenth of the footprint's extent`; of the second moments and of the weights, relative.
fn errors(found: &FootprintMoments, exact: &FootprintMoments) -> [f64; 3] {
    let largest = |found: &[f64], exact: &[f64]| {
        found.iter().zip(exact).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    let second = |m: &FootprintMoments| [m.source.as_slice(), &m.cross, &[m.target]].concat();
    let first = |m: &FootprintMoments| [m.centroid, m.tracked_centroid].concat();
    let scale = exact.target + exact.source[0] + exact.source[2] + exact.weight;
    let extent = (scale / exact.weight - 1.0).max(0.0).sqrt();
    let ratio = |found: f64, exact: f64| (found / exact - 1.0).abs();
    [
        largest(&first(found), &first(exact)) / (1.0 + 0.1 * extent),
        largest(&second(found), &second(exact)) / scale,
        ratio(found.weight, exact.weight)
            + ratio(found.weight_squared, exact.weight_squared)
            + ratio(found.blend_weight, exact.blend_weight)
            + ratio(found.visible, exact.visible),
    ]
}

#[test]
fn a_set_is_uploaded_once_and_again_when_any_bit_of_it_changes() {
    let Some(engine) = support::engine() else { return };
    let device = &engine.context.device;
    let last = LastMeasured::default();
    let gaussians = blobs(50, 2, 53);
    let first = last.take_over(device, &gaussians).unwrap();
    assert!(Arc::ptr_eq(&first, &last.take_over(device, &gaussians.clone()).unwrap()));
    let changes: [fn(&mut Gaussians); 8] = [
        |g| g.means[49][2] = f32::from_bits(g.means[49][2].to_bits() + 1),
        |g| g.rotations[0][3] *= 1.5,
        |g| g.log_scales[7][1] = -0.0,
        |g| g.log_scales[7][1] = 0.0,
        |g| g.logit_opacities[20] = f32::NAN,
        |g| g.sh[27 * 30 + 2] = f32::NAN,
        |g| *g = g.select(&(0..49).collect::<Vec<_>>()),
        |g| *g = Gaussians::empty(2),
    ];
    let mut changed = gaussians.clone();
    for (number, change) in changes.iter().enumerate() {
        let before = last.take_over(device, &changed).unwrap();
        change(&mut changed);
        let after = last.take_over(device, &changed).unwrap();
        assert!(!Arc::ptr_eq(&before, &after), "change {number}");
        assert!(Arc::ptr_eq(&after, &last.take_over(device, &changed).unwrap()), "change {number}");
    }
    // Colours from the side matter to no footprint.
    let seen = last.take_over(device, &gaussians).unwrap();
    let mut other = gaussians.clone();
    other.sh[27 * 30 + 5] += 1.0;
    assert!(Arc::ptr_eq(&seen, &last.take_over(device, &other).unwrap()));
    other.sh.pop();
    assert!(last.take_over(device, &other).is_err(), "a set without its last coefficient");
}
