//! Every stage on random scenes: what it makes of its own input, by the same input in double precision or on the CPU engine.

use std::cell::Cell;

use glam::{DMat3, DVec2, DVec3};
use proptest::prelude::*;
use splat::{
    cameras::Camera,
    gaussians::{Gaussians, sh},
    raster::{ALPHA_MAX, ALPHA_MIN, CpuEngine, NEAR_PLANE, TRANSMITTANCE_MIN},
};

use super::{
    moments, optimisation,
    projection::{Reference, reference},
    run, sorting,
    support::{self, blobs, rough_tracks, seeds},
};
use crate::{
    GpuEngine,
    buffers::{Buffers, GradientBuffers},
    layout::{GEOMETRY, SUMS, TILE, View},
    stages::{Binder, ViewBuffer, sorted_slots, tile_passes},
    transfer::{read, write},
};

const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.3];

/// What a random scene is made from: few numbers, so that it shrinks.
#[derive(Clone, Copy, Debug)]
struct Scene {
    count: usize,
    degree: u32,
    size: [u32; 2],
    /// Of all Gaussians, in natural logarithms.
    growth: f32,
    is_faint: bool,
    seed: u64,
}

fn scenes() -> impl Strategy<Value = Scene> {
    let size = [1_u32..50, 1_u32..40];
    let scene =
        |(count, degree, size, growth, is_faint, seed)| Scene { count, degree, size, growth, is_faint, seed };
    (0_usize..70, 0_u32..4, size, -2.0_f32..1.0, any::<bool>(), 0_u64..1000).prop_map(scene)
}

impl Scene {
    fn gaussians(&self) -> Gaussians {
        let mut gaussians = blobs(self.count, self.degree, self.seed);
        for scales in &mut gaussians.log_scales {
            *scales = scales.map(|scale| scale + self.growth);
        }
        if self.is_faint {
            gaussians.logit_opacities.iter_mut().for_each(|logit| *logit -= 5.0);
        }
        gaussians
    }

    fn camera(&self) -> Camera {
        let [width, height] = self.size;
        Camera {
            width,
            height,
            fx: 34.0,
            fy: 35.0,
            cx: 0.48 * f64::from(width),
            cy: 0.53 * f64::from(height),
            rotation: DMat3::from_rotation_y(0.001 * self.seed as f64 - 0.5),
            translation: DVec3::new(0.0, 0.0, 4.0),
        }
    }
}

/// A footprint as the device has it, in double precision.
#[derive(Clone, Copy)]
struct Footprint {
    mean: DVec2,
    peak: f64,
    whitening: [f64; 4],
    colour: [f64; 3],
}

impl Footprint {
    fn of(rows: [[f32; 4]; 3]) -> Self {
        let [[x, y, peak, _], whitening, [red, green, blue, _]] = rows.map(|row| row.map(f64::from));
        Self { mean: DVec2::new(x, y), peak, whitening, colour: [red, green, blue] }
    }

    /// Whitened offset from the mean.
    fn whitened(&self, at: DVec2) -> [f64; 2] {
        let ([a, b, c, d], e) = (self.whitening, at - self.mean);
        [a * e.x + b * e.y, c * e.x + d * e.y]
    }

    /// Of the two terms of each, which may cancel.
    fn whitened_sizes(&self, at: DVec2) -> [f64; 2] {
        let ([a, b, c, d], e) = (self.whitening.map(f64::abs), (at - self.mean).abs());
        [a * e.x + b * e.y, c * e.x + d * e.y]
    }

    fn alpha(&self, at: DVec2) -> f64 {
        let [u, w] = self.whitened(at);
        (self.peak - u * u - w * w).exp2()
    }
}

/// Everything that the stages of a view have made.
struct Drawn {
    view: ViewBuffer,
    buffers: Buffers,
    /// `None` where a Gaussian is not drawn.
    footprints: Vec<Option<Footprint>>,
    /// Per tile slots and Gaussians, in order.
    lists: Vec<Vec<(usize, usize)>>,
    pixels: Vec<[f32; 4]>,
}

fn drawn(engine: &GpuEngine, gaussians: &Gaussians, camera: &Camera) -> Drawn {
    let device = &engine.context.device;
    let view = ViewBuffer::new(device, View::new(camera, BACKGROUND)).unwrap();
    let buffers = engine.buffers(gaussians, &view.data, true).unwrap();
    let buffers = engine.draw(gaussians, &view, buffers).unwrap();
    let rows: Vec<[[f32; 4]; 3]> = read(device, &buffers.footprints.footprints, gaussians.len()).unwrap();
    let ranges: Vec<[u32; 2]> = read(device, &buffers.footprints.ranges, gaussians.len()).unwrap();
    let seen = rows.iter().zip(&ranges).map(|(rows, range)| (range[1] > 0).then(|| Footprint::of(*rows)));
    let tiles = view.data.tile_count() as usize;
    let bounds: Vec<[u32; 2]> = read(device, &buffers.images.bounds, tiles).unwrap();
    let counts: Vec<u32> = read(device, &buffers.footprints.counts, gaussians.len() + 1).unwrap();
    let total = counts[gaussians.len()] as usize;
    let slots: Vec<u32> = read(device, sorted_slots(&buffers.intersections, &view.data), total).unwrap();
    let owners: Vec<u32> = read(device, &buffers.intersections.owners, total).unwrap();
    let of_slot = |&slot: &u32| (slot as usize, owners[slot as usize] as usize);
    let list = |&[first, end]: &[u32; 2]| slots[first as usize..end as usize].iter().map(of_slot).collect();
    let lists: Vec<Vec<(usize, usize)>> = bounds.iter().map(list).collect();
    assert_eq!(lists.iter().map(Vec::len).sum::<usize>(), total, "every intersection is in one list");
    let pixels = read(device, &buffers.images.rendered, view.data.pixels() as usize).unwrap();
    Drawn { footprints: seen.collect(), lists, pixels, view, buffers }
}

/// Footprints that a pixel blends: slot, Gaussian, alpha and the transmittance before it; and what is left behind them.
struct Blended {
    layers: Vec<(usize, usize, f64, f64)>,
    left: f64,
    /// Whether a decision stands nearer to its threshold than single precision can tell: that of alpha 1e-6 and a few roundings of an
    /// exponent of at most 8, and the product of so many of them.
    is_in_doubt: bool,
}

impl Drawn {
    fn centres(&self) -> impl Iterator<Item = DVec2> {
        let [width, height] = self.view.data.size;
        (0..height)
            .flat_map(move |y| (0..width).map(move |x| DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5)))
    }

    fn tile_of(&self, at: DVec2) -> usize {
        let [column, row] = at.to_array().map(|value| value as u32 / TILE);
        (row * self.view.data.tiles[0] + column) as usize
    }

    fn blended(&self, at: DVec2) -> Blended {
        let mut blended = Blended { layers: Vec::new(), left: 1.0, is_in_doubt: false };
        for &(slot, owner) in &self.lists[self.tile_of(at)] {
            let alpha = self.footprints[owner].map_or(0.0, |footprint| footprint.alpha(at));
            let is_close = |value: f64, threshold: f64| (value / threshold - 1.0).abs() < 3e-5;
            blended.is_in_doubt |= is_close(alpha, ALPHA_MIN.into()) || is_close(alpha, ALPHA_MAX.into());
            if alpha < f64::from(ALPHA_MIN) {
                continue;
            }
            let alpha = alpha.min(ALPHA_MAX.into());
            let left = blended.left * (1.0 - alpha);
            blended.is_in_doubt |= (left / f64::from(TRANSMITTANCE_MIN) - 1.0).abs() < 1e-3;
            if left < f64::from(TRANSMITTANCE_MIN) {
                break;
            }
            blended.layers.push((slot, owner, alpha, blended.left));
            blended.left = left;
        }
        blended
    }

    fn colour(&self, at: DVec2) -> [f64; 3] {
        let blended = self.blended(at);
        std::array::from_fn(|channel| {
            let light = blended.layers.iter().map(|&(_, owner, alpha, before)| {
                alpha * before * self.footprints[owner].map_or(0.0, |it| it.colour[channel])
            });
            light.sum::<f64>() + blended.left * f64::from(BACKGROUND[channel])
        })
    }

    /// Weights of colours and alpha for a gradient: none where a pixel is in doubt.
    fn seeds(&self) -> Vec<[f32; 4]> {
        let seeds = seeds(4 * self.pixels.len());
        let seeds = seeds.as_chunks::<4>().0.iter().zip(self.centres());
        seeds.map(|(&seed, at)| if self.blended(at).is_in_doubt { [0.0; 4] } else { seed }).collect()
    }
}

/// Software takes some hundredths of a second for each.
const CASES: u32 = 48;

fn check(strategy: impl Strategy<Value = Scene>, property: impl Fn(&GpuEngine, &Scene)) {
    let Some(engine) = support::engine() else { return };
    let config = ProptestConfig { cases: CASES, failure_persistence: None, ..ProptestConfig::default() };
    let mut runner = proptest::test_runner::TestRunner::new_with_rng(
        config,
        proptest::test_runner::TestRng::deterministic_rng(proptest::test_runner::RngAlgorithm::ChaCha),
    );
    let outcome = runner.run(&strategy, |scene| {
        property(engine, &scene);
        Ok(())
    });
    outcome.unwrap_or_else(|failure| panic!("{failure}"));
}

/// The ellipse of a Gaussian in double precision; `None` where it is not in front of the camera, or its Jacobian is clamped: golden data
/// has those.
fn ellipse(gaussians: &Gaussians, index: usize, camera: &Camera, view: &View) -> Option<Reference> {
    let point = camera.to_camera(gaussians.mean(index));
    if point.z < 2.0 * NEAR_PLANE {
        return None;
    }
    let slopes = [point.x / point.z, point.y / point.z].map(|slope| slope as f32);
    let is_free = |axis: usize| view.slope_low[axis] < slopes[axis] && slopes[axis] < view.slope_high[axis];
    (is_free(0) && is_free(1)).then(|| reference(gaussians, index, camera))
}

/// Whether a pixel sees the ellipse beyond doubt.
fn is_seen(ellipse: &Reference, at: DVec2) -> bool {
    ellipse.alpha(at) > 1.001 * f64::from(ALPHA_MIN)
}

/// What the harmonics of a Gaussian are towards the camera.
fn shade(gaussians: &Gaussians, index: usize, camera: &Camera) -> [f64; 3] {
    let direction = (gaussians.mean(index) - camera.centre()).normalize();
    let basis = sh::basis(direction, gaussians.sh_degree);
    std::array::from_fn(|channel| {
        let of_channel = gaussians.sh_of(index).iter().skip(channel).step_by(3);
        let sum: f64 = of_channel.zip(basis).map(|(&weight, basis)| f64::from(weight) * basis).sum();
        (sum + 0.5).max(0.0)
    })
}

#[test]
fn project() {
    let seen = Cell::new(0);
    check(scenes(), |engine, scene| {
        let (gaussians, camera) = (scene.gaussians(), scene.camera());
        let drawn = drawn(engine, &gaussians, &camera);
        for (index, footprint) in drawn.footprints.iter().enumerate() {
            let expected = ellipse(&gaussians, index, &camera, &drawn.view.data);
            let is_needed = || expected.as_ref().is_some_and(|it| drawn.centres().any(|at| is_seen(it, at)));
            let Some(Footprint { mean, peak, whitening: [a, b, c, d], colour }) = *footprint else {
                assert!(!is_needed(), "Gaussian {index} is dropped");
                continue;
            };
            seen.set(seen.get() + 1);
            for (found, expected) in colour.into_iter().zip(shade(&gaussians, index, &camera)) {
                // Sixteen terms of a basis and weights of about 1, and a direction rounded to 1e-7.
                assert!((found - expected).abs() < 3e-6, "{index}: {found} for {expected}");
            }
            let Some(expected) = expected else { continue };
            // Three roundings of numbers as large as the position.
            assert!(
                (mean - expected.mean).abs().max_element() < 1e-5 + 4e-7 * expected.mean.abs().max_element()
            );
            assert!((peak - expected.opacity.log2()).abs() < 1e-6 * (1.0 + peak.abs()), "peak of {index}");
            let whitening = glam::DMat2::from_cols(DVec2::new(a, c), DVec2::new(b, d));
            let unit =
                whitening * expected.covariance * whitening.transpose() / (0.5 * std::f64::consts::LOG2_E);
            let off = (unit - glam::DMat2::IDENTITY).to_cols_array();
            assert!(off.iter().all(|value| value.abs() < 2e-5), "shape of {index}: {off:?}");
        }
    });
    assert_some(seen.get(), "Gaussians are seen");
}

/// That a property which skips what it cannot judge has judged some.
fn assert_some(count: usize, what: &str) {
    assert!(count > 200 || support::engine().is_none(), "{count} {what}");
}

#[test]
fn bin() {
    check(scenes(), |engine, scene| {
        let (gaussians, camera) = (scene.gaussians(), scene.camera());
        let drawn = drawn(engine, &gaussians, &camera);
        let depth = |index: usize| camera.to_camera(gaussians.mean(index)).z;
        for list in &drawn.lists {
            let mut owners: Vec<usize> = list.iter().map(|&(_, owner)| owner).collect();
            assert!(owners.windows(2).all(|pair| depth(pair[0]) < depth(pair[1]) + 2e-6), "nearest first");
            owners.sort_unstable();
            assert!(owners.windows(2).all(|pair| pair[0] < pair[1]), "once each");
        }
        let ellipses: Vec<_> =
            (0..gaussians.len()).map(|index| ellipse(&gaussians, index, &camera, &drawn.view.data)).collect();
        for at in drawn.centres() {
            let list = &drawn.lists[drawn.tile_of(at)];
            for (index, footprint) in drawn.footprints.iter().enumerate() {
                let reaches = footprint.is_some_and(|it| it.alpha(at) >= f64::from(ALPHA_MIN) * 1.00001)
                    || ellipses[index].as_ref().is_some_and(|it| is_seen(it, at));
                assert!(!reaches || list.iter().any(|&(_, owner)| owner == index), "{index} misses {at}");
            }
        }
    });
}

#[test]
fn sort() {
    check(scenes(), |engine, scene| {
        let mut state = scene.seed;
        let length = scene.count * scene.size[0] as usize;
        let passes = 1 + scene.degree;
        let keys = (0..length).map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            ((state >> 32) as u32) >> (32 - 8 * passes)
        });
        sorting::check_sort(&engine.context, keys.collect(), passes, scene.size[1]);
    });
}

#[test]
fn blend() {
    let (compared, all) = (Cell::new(0), Cell::new(0));
    check(scenes(), |engine, scene| {
        let drawn = drawn(engine, &scene.gaussians(), &scene.camera());
        for (at, found) in drawn.centres().zip(&drawn.pixels) {
            let blended = drawn.blended(at);
            all.set(all.get() + 1);
            if blended.is_in_doubt {
                continue;
            }
            compared.set(compared.get() + 1);
            assert!((f64::from(found[3]) - blended.left).abs() < 2e-6, "transmittance at {at}");
            for (channel, expected) in drawn.colour(at).into_iter().enumerate() {
                // Exponents of up to 8 rounded a few times, times a colour of at most about 2.
                assert!(
                    (f64::from(found[channel]) - expected).abs() < 6e-6,
                    "{found:?} for {expected} at {at}"
                );
            }
        }
    });
    // The scenes of the backward stages are the same.
    let (compared, all): (usize, usize) = (compared.get(), all.get());
    println!("{compared} of {all} pixels compared");
    assert!(compared * 20 >= all * 19, "{compared} of {all} pixels compared");
    assert_some(compared, "pixels compared");
}

/// Runs the backward stages on seeds.
fn backward(engine: &GpuEngine, drawn: &Drawn, seeds: &[[f32; 4]]) -> GradientBuffers {
    let device = &engine.context.device;
    let gradients = GradientBuffers::new(device, &drawn.buffers.size).unwrap();
    write(device, &gradients.image, seeds).unwrap();
    let binder = Binder { device, kernels: &engine.context.kernels };
    run(&engine.context, &binder.backward(&drawn.buffers, &gradients, &drawn.view));
    gradients
}

/// Nine sums of every slot, and the same of the sizes of what is added.
fn sums_of(drawn: &Drawn, seeds: &[[f32; 4]], slots: usize) -> Vec<[(f64, f64); SUMS]> {
    let mut sums = vec![[(0.0, 0.0); SUMS]; slots];
    for (at, seed) in drawn.centres().zip(seeds) {
        let [red, green, blue, by_alpha] = seed.map(f64::from);
        let by_light = |colour: [f64; 3]| [colour[0] * red, colour[1] * green, colour[2] * blue];
        let blended = drawn.blended(at);
        let background = by_light(BACKGROUND.map(f64::from));
        let mut behind = background.iter().sum::<f64>() - by_alpha;
        let mut size = background.map(f64::abs).iter().sum::<f64>() + by_alpha.abs();
        for &(slot, owner, alpha, before) in blended.layers.iter().rev() {
            let Some(footprint) = drawn.footprints[owner] else { continue };
            let light = by_light(footprint.colour);
            let excess = light.iter().sum::<f64>() - behind;
            let largest = light.map(f64::abs).iter().sum::<f64>() + size;
            behind += alpha * excess;
            size += alpha * largest;
            let follows = if alpha >= f64::from(ALPHA_MAX) { 0.0 } else { before * alpha };
            let powers = |[u, w]: [f64; 2]| [1.0, u, w, u * u, u * w, w * w];
            let sizes = powers(footprint.whitened_sizes(at));
            for (k, by) in powers(footprint.whitened(at)).into_iter().enumerate() {
                sums[slot][k].0 += follows * excess * by;
                sums[slot][k].1 += follows * largest * sizes[k];
            }
            for (k, by) in [red, green, blue].into_iter().enumerate() {
                sums[slot][6 + k].0 += before * alpha * by;
                sums[slot][6 + k].1 += before * alpha * by.abs();
            }
        }
    }
    sums
}

#[test]
fn blend_backward() {
    check(scenes(), |engine, scene| {
        let drawn = drawn(engine, &scene.gaussians(), &scene.camera());
        let seeds = drawn.seeds();
        backward(engine, &drawn, &seeds);
        let slots = drawn.lists.iter().map(Vec::len).sum();
        let found: Vec<[f32; SUMS]> =
            read(&engine.context.device, &drawn.buffers.intersections.sums, slots).unwrap();
        for (slot, (found, expected)) in found.iter().zip(sums_of(&drawn, &seeds, slots)).enumerate() {
            for (k, (expected, size)) in expected.into_iter().enumerate() {
                // Alpha to some 2e-6, the transmittance of some tens of footprints in front divided back to as much.
                let off = (f64::from(found[k]) - expected).abs();
                assert!(off <= 3e-5 * size, "sum {k} of slot {slot}: off by {off:e} of {size:e}");
            }
        }
    });
}

#[test]
fn project_backward() {
    check(scenes(), |engine, scene| {
        let (gaussians, camera) = (scene.gaussians(), scene.camera());
        let drawn = drawn(engine, &gaussians, &camera);
        let seeds = drawn.seeds();
        let gradients = backward(engine, &drawn, &seeds);
        let device = &engine.context.device;
        let ours: Vec<[f32; GEOMETRY]> = read(device, &gradients.geometry, gaussians.len()).unwrap();
        let our_sh: Vec<f32> = read(device, &gradients.sh, gaussians.sh.len()).unwrap();
        let image: Vec<f32> = seeds.iter().flat_map(|seed| [seed[0], seed[1], seed[2]]).collect();
        let alpha: Vec<f32> = seeds.iter().map(|seed| seed[3]).collect();
        let theirs = CpuEngine::default().render_backward(&gaussians, &camera, BACKGROUND, &image, &alpha);
        let column = |first: usize, end: usize| -> Vec<f32> {
            ours.iter().flat_map(|row| row[first..end].to_vec()).collect()
        };
        for (array, ours, theirs) in [
            ("means", column(0, 3), theirs.means.as_flattened()),
            ("rotations", column(3, 7), theirs.rotations.as_flattened()),
            ("log scales", column(7, 10), theirs.log_scales.as_flattened()),
            ("opacities", column(10, 11), &theirs.logit_opacities[..]),
            ("sh", our_sh, &theirs.sh[..]),
        ] {
            let largest = theirs.iter().fold(1e-3_f32, |largest, value| largest.max(value.abs()));
            for (place, (ours, theirs)) in ours.iter().zip(theirs).enumerate() {
                let off = (ours - theirs).abs();
                // A place is held to 3e-5 px (`project`), and the steepest footprint falls by six of its weight per pixel.
                assert!(off <= 2e-4 * largest, "{array} {place}: {ours}, on the CPU {theirs}, of {largest}");
            }
        }
    });
}

#[test]
fn footprint_moments() {
    check(scenes(), |engine, scene| {
        let camera = scene.camera();
        let tracks = rough_tracks(&camera, 5.0, scene.seed);
        moments::check(engine, &scene.gaussians(), &camera, &tracks);
    });
}

#[test]
fn loss() {
    check(scenes(), |engine, scene| {
        let weight = [0.0, 0.2, 0.5, 1.0][scene.degree as usize];
        optimisation::check_loss(engine, scene.size, weight, scene.is_faint, scene.count);
    });
}

#[test]
fn adam() {
    check(scenes(), |engine, scene| {
        optimisation::check_descent(engine, scene.count, scene.degree, scene.seed);
    });
}

#[test]
fn lists_end_where_the_tiles_do() {
    // The key of no tile needs a bit of its own: the sort must see it.
    for (tiles, passes) in [(1, 1), (255, 1), (256, 2), (65_535, 2), (65_536, 3)] {
        let view = View { tiles: [tiles, 1], ..View::default() };
        assert_eq!(tile_passes(&view), passes, "{tiles} tiles");
    }
}

/// A number as sixteen bits hold it, of those that are neither tiny nor huge.
fn in_half_precision(value: f64) -> f64 {
    if value == 0.0 {
        return 0.0;
    }
    let unit = 2f64.powi(value.abs().log2().floor() as i32 - 10);
    (value / unit).round() * unit
}

/// Why no form of the kernels keeps footprints in half precision, see docs/decisions/0008. Pixels that see other footprints after the
/// rounding than before do not count: their change is that of a threshold.
#[test]
fn footprints_in_half_precision_would_break_the_tolerance_of_images() {
    let Some(engine) = support::engine() else { return };
    let (shapes, colours) = (Cell::new(0.0_f64), Cell::new(0.0_f64));
    trackersplat_tests::golden::for_each_scene(|name, golden| {
        let mut drawn = drawn(engine, &golden.gaussians(), &golden.camera());
        let exact = drawn.footprints.clone();
        let before = seen_in_double_precision(&drawn);
        let mut worst = |round: &dyn Fn(Footprint) -> Footprint| {
            drawn.footprints = exact.iter().map(|footprint| footprint.map(round)).collect();
            let after = seen_in_double_precision(&drawn);
            let same = before.iter().zip(&after).filter(|(before, after)| before.0 == after.0);
            let change = same.map(|(before, after)| {
                (0..3).map(|channel| (before.1[channel] - after.1[channel]).abs()).fold(0.0, f64::max)
            });
            change.fold(0.0, f64::max)
        };
        let of_scene = [
            worst(&|it| Footprint { whitening: it.whitening.map(in_half_precision), ..it }),
            worst(&|it| Footprint { colour: it.colour.map(in_half_precision), ..it }),
        ];
        println!("{name}: shapes {:.1e}, colours {:.1e}", of_scene[0], of_scene[1]);
        shapes.set(shapes.get().max(of_scene[0]));
        colours.set(colours.get().max(of_scene[1]));
    });
    // The golden images are held to 2e-5 (`Golden::check_image`).
    let (shapes, colours) = (shapes.get(), colours.get());
    assert!(shapes > 1e-4 && colours > 1e-4, "shapes {shapes:e}, colours {colours:e}");
}

/// Per pixel the slots that it blends, and its colour.
fn seen_in_double_precision(drawn: &Drawn) -> Vec<(Vec<usize>, [f64; 3])> {
    let slots = |at| drawn.blended(at).layers.iter().map(|&(slot, ..)| slot).collect();
    drawn.centres().map(|at| (slots(at), drawn.colour(at))).collect()
}
