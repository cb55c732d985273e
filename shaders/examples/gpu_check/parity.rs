//! The GPU engine against the CPU engine on generated scenes.

use std::sync::Arc;

use anyhow::Result;
use splat::{
    engine::{Engine, SessionInput, TrainingView},
    gaussians::Gaussians,
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    optim::LearningRates,
    raster::CpuEngine,
};
use splat_shaders::GpuEngine;

use crate::{
    doubts::Doubts,
    report::Check,
    scene::{self, Scene, SceneSize},
    tracks::rough,
};

const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.3];

/// Single precision keeps a value within this of the CPU engine's where every decision is the same.
const CLOSE: f64 = 2e-5;

/// What a footprint at the threshold of alpha adds to a pixel, and a little more.
const STEP: f64 = 6e-3;

/// Share of the pixels that may be left out, as single precision cannot decide on them.
const DOUBTFUL: f64 = 1e-2;

const SIZES: [SceneSize; 3] = [
    SceneSize { gaussians: 2_000, width: 333, height: 187, sh_degree: 3 },
    SceneSize { gaussians: 10_000, width: 320, height: 180, sh_degree: 0 },
    SceneSize { gaussians: 300, width: 17, height: 13, sh_degree: 1 },
];

const REWEIGHTING: Reweighting = Reweighting { passes: 3, noise_correlation_area: 16.0, noise_floor: 0.05 };

const STEPS: usize = 20;

/// Every check, printed as it is made; `other` runs the other form of the kernels, with or without subgroups.
pub(crate) fn run(engine: &GpuEngine, other: Option<&GpuEngine>) -> Result<Vec<Check>> {
    let mut checks = Vec::new();
    let mut add = |check: Check| {
        println!("{check}");
        checks.push(check);
    };
    for size in SIZES {
        let scene = scene::generate(size);
        let SceneSize { gaussians, width, height, sh_degree } = size;
        let name = format!("{gaussians} in {width}x{height}, SH {sh_degree}");
        let doubts = Doubts::new(&scene.gaussians, &scene.camera);
        images(engine, &scene, &doubts, &name)?.into_iter().for_each(&mut add);
        gradients(engine, &scene, &doubts, &name)?.into_iter().for_each(&mut add);
        for reweighting in [None, Some(&REWEIGHTING)] {
            moments(engine, &scene, &doubts, &name, reweighting)?.into_iter().for_each(&mut add);
        }
    }
    session(engine, other)?.into_iter().for_each(&mut add);
    Ok(checks)
}

fn images(engine: &GpuEngine, scene: &Scene, doubts: &Doubts, name: &str) -> Result<[Check; 4]> {
    let ours = engine.render(&scene.gaussians, &scene.camera, BACKGROUND)?;
    let theirs = CpuEngine::default().render(&scene.gaussians, &scene.camera, BACKGROUND)?;
    let (mut worst, mut worst_sure, mut decided_otherwise) = (0.0_f64, 0.0_f64, 0_u64);
    for pixel in 0..ours.alpha.len() {
        let colour = 3 * pixel..3 * pixel + 3;
        let apart = |ours: f32, theirs: f32| f64::from((ours - theirs).abs());
        let difference = colour
            .map(|place| apart(ours.image.pixels[place], theirs.image.pixels[place]))
            .fold(apart(ours.alpha[pixel], theirs.alpha[pixel]), worse);
        worst = worse(worst, difference);
        if !doubts.is_open(pixel) {
            worst_sure = worse(worst_sure, difference);
        } else if !(difference < CLOSE) {
            decided_otherwise += 1;
            println!("       {name}: pixel {pixel} differs by {difference:.1e}: {}", doubts.nearest[pixel]);
        }
    }
    let share = decided_otherwise as f64 / doubts.pairs.max(1) as f64;
    Ok([
        Check::new(name, "image: share of pixels in doubt", doubts.share(), DOUBTFUL),
        Check::new(name, "image: worst where there is no doubt", worst_sure, CLOSE),
        Check::new(name, "image: worst", worst, STEP),
        Check::new(name, "image: pixels decided otherwise, of all pairs", share, 1e-5),
    ])
}

/// The larger of two errors; what is not a number is the worst.
fn worse(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() { f64::NAN } else { a.max(b) }
}

/// By the pixels that are not in doubt.
fn gradients(engine: &GpuEngine, scene: &Scene, doubts: &Doubts, name: &str) -> Result<Vec<Check>> {
    let Scene { gaussians, camera, .. } = scene;
    let pixels = camera.width as usize * camera.height as usize;
    let seed = |place: usize, pixel: usize| {
        if doubts.is_open(pixel) { 0.0 } else { (place as f32 * 12.9898).sin() }
    };
    let seeds: Vec<f32> = (0..3 * pixels).map(|place| seed(place, place / 3)).collect();
    let alpha: Vec<f32> = (0..pixels).map(|pixel| seed(pixel, pixel)).collect();
    let ours = engine.render_backward(gaussians, camera, BACKGROUND, &seeds, &alpha)?;
    let theirs = CpuEngine::default().render_backward(gaussians, camera, BACKGROUND, &seeds, &alpha);
    let check = |array: &str, ours: &[f32], theirs: &[f32]| {
        let [far, relative] = apart(ours, theirs);
        [
            Check::new(name, &format!("gradient by {array}: share of values off by 1e-3"), far, 5e-4),
            Check::new(name, &format!("gradient by {array}: relative norm"), relative, 2e-4),
        ]
    };
    Ok([
        check("means", ours.means.as_flattened(), theirs.means.as_flattened()),
        check("rotations", ours.rotations.as_flattened(), theirs.rotations.as_flattened()),
        check("log scales", ours.log_scales.as_flattened(), theirs.log_scales.as_flattened()),
        check("opacities", &ours.logit_opacities, &theirs.logit_opacities),
        check("harmonics", &ours.sh, &theirs.sh),
    ]
    .into_iter()
    .flatten()
    .collect())
}

/// Share of values that differ by more than a thousandth of themselves and of the root mean square; relative norm of the difference.
fn apart(ours: &[f32], theirs: &[f32]) -> [f64; 2] {
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>().sqrt();
    let difference = |(&a, &b): (&f32, &f32)| f64::from(a) - f64::from(b);
    let of_theirs = norm(&mut theirs.iter().map(|&value| f64::from(value)));
    let typical = of_theirs / (theirs.len() as f64).sqrt();
    let is_far =
        |pair: &(&f32, &f32)| !(difference(*pair).abs() <= 1e-3 * (typical + f64::from(pair.1.abs())));
    let far = ours.iter().zip(theirs).filter(is_far).count() as f64 / theirs.len() as f64;
    [far, norm(&mut ours.iter().zip(theirs).map(difference)) / of_theirs]
}

/// By the pixels that are not in doubt.
fn moments(
    engine: &GpuEngine,
    scene: &Scene,
    doubts: &Doubts,
    name: &str,
    reweighting: Option<&Reweighting>,
) -> Result<[Check; 2]> {
    let Scene { gaussians, camera, .. } = scene;
    let mut tracks = rough(camera, 3);
    tracks.visible.iter_mut().enumerate().for_each(|(pixel, visible)| *visible &= !doubts.is_open(pixel));
    let ours = engine.footprint_moments(gaussians, camera, &tracks, reweighting)?;
    let theirs = CpuEngine::default().footprint_moments(gaussians, camera, &tracks, reweighting)?;
    // A reweighted pixel multiplies the error of alpha by its exponent, and passes pass it on.
    let (kind, factor) = if reweighting.is_some() { ("reweighted moments", 100.0) } else { ("moments", 1.0) };
    // Projection in single precision moves a footprint by 1e-7 of the image's size, and so changes a pixel's weight by up to six
    // times that: the steepest footprint falls by six of its weight per pixel.
    let place = 1e-7 * f64::from(camera.width.max(camera.height));
    let [mean_limit, second_limit] = [2e-5 + 3.0 * place, 5e-6 + 6.0 * place].map(|limit| limit * factor);
    let (mut off, mut worst) = (0, 0.0_f64);
    for (found, exact) in ours.iter().zip(&theirs) {
        if exact.pixels == 0 && found.pixels == 0 {
            continue;
        }
        let [mean, second] = difference(found, exact);
        off += u32::from(found.pixels != exact.pixels || !(mean < mean_limit && second < second_limit));
        worst = worse(worst, mean);
    }
    Ok([
        Check::new(name, &format!("{kind}: footprints off"), off.into(), 0.5),
        Check::new(name, &format!("{kind}: worst mean, px"), worst, mean_limit),
    ])
}

/// Of the means, px per `1 px + a tenth of the footprint's extent`, and of the second moments, relative.
fn difference(found: &FootprintMoments, exact: &FootprintMoments) -> [f64; 2] {
    if found.weight == 0.0 || exact.weight == 0.0 {
        // Seen by one alone.
        return [0.0; 2];
    }
    let largest = |found: &[f64], exact: &[f64]| {
        found.iter().zip(exact).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    let first = |m: &FootprintMoments| [m.centroid, m.tracked_centroid].concat();
    let second = |m: &FootprintMoments| [m.source.as_slice(), &m.cross, &[m.target]].concat();
    let scale = exact.target + exact.source[0] + exact.source[2] + exact.weight;
    let extent = (scale / exact.weight - 1.0).max(0.0).sqrt();
    [
        largest(&first(found), &first(exact)) / (1.0 + 0.1 * extent),
        largest(&second(found), &second(exact)) / scale,
    ]
}

/// The same optimisation on both engines, on the device twice, and once more on the other form of its kernels.
fn session(engine: &GpuEngine, other: Option<&GpuEngine>) -> Result<Vec<Check>> {
    let scene = scene::generate(SceneSize { gaussians: 3_000, width: 160, height: 90, sh_degree: 3 });
    let (ours, our_losses) = optimised(engine, &scene)?;
    let (_, losses) = optimised(&CpuEngine::default(), &scene)?;
    let apart = |step: usize| f64::from((our_losses[step] / losses[step] - 1.0).abs());
    let mut checks = vec![
        Check::new("session", "first loss, relative", apart(0), 1e-5),
        // Adam's first steps are of the sign of the gradient alone, whatever its size.
        Check::new("session", "loss after 20 steps, relative", apart(STEPS - 1), 1e-2),
    ];
    let others =
        [(Some(engine), "second run has other bytes"), (other, "other form of the kernels has other bytes")];
    for (engine, what) in others {
        let Some(engine) = engine else { continue };
        let (again, _) = optimised(engine, &scene)?;
        checks.push(Check::new("session", what, f64::from(u8::from(ours != again)), 0.5));
    }
    Ok(checks)
}

fn optimised(engine: &dyn Engine, scene: &Scene) -> Result<(Gaussians, Vec<f32>)> {
    let view =
        TrainingView { camera: scene.camera.clone(), image: Arc::new(scene.target.clone()), mask: None };
    let rates = LearningRates {
        mean: 1e-4,
        rotation: 1e-3,
        log_scale: 5e-3,
        logit_opacity: 2e-2,
        sh_dc: 2.5e-3,
        sh_rest: 1e-4,
        sh_degree: scene.gaussians.sh_degree,
    };
    let mut session = engine.session(SessionInput {
        gaussians: scene.gaussians.clone(),
        views: vec![view],
        background: BACKGROUND,
        dssim_weight: 0.2,
        frozen: Vec::new(),
    })?;
    for _ in 0..STEPS {
        session.step(0, &rates)?;
    }
    let losses = session.take_losses()?;
    Ok((session.gaussians()?, losses))
}
