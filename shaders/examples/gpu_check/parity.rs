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
    report::Check,
    scene::{self, Scene, SceneSize},
    tracks::rough,
};

const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.3];

/// Single precision keeps a value within this of the CPU engine's, unless a pixel rounds across a threshold.
const CLOSE: f32 = 2e-5;

/// What a footprint at the threshold of alpha adds to a pixel, and a little more.
const STEP: f64 = 6e-3;

const SIZES: [SceneSize; 3] = [
    SceneSize { gaussians: 2_000, width: 333, height: 187, sh_degree: 3 },
    SceneSize { gaussians: 10_000, width: 320, height: 180, sh_degree: 0 },
    SceneSize { gaussians: 300, width: 17, height: 13, sh_degree: 1 },
];

const REWEIGHTING: Reweighting = Reweighting { passes: 3, noise_correlation_area: 16.0, noise_floor: 0.05 };

const STEPS: usize = 20;

/// Every check, printed as it is made.
pub(crate) fn run(engine: &GpuEngine) -> Result<Vec<Check>> {
    let mut checks = Vec::new();
    let mut add = |check: Check| {
        println!("{check}");
        checks.push(check);
    };
    for size in SIZES {
        let scene = scene::generate(size);
        let SceneSize { gaussians, width, height, sh_degree } = size;
        let name = format!("{gaussians} in {width}x{height}, SH {sh_degree}");
        images(engine, &scene, &name)?.into_iter().for_each(&mut add);
        gradients(engine, &scene, &name)?.into_iter().for_each(&mut add);
        for reweighting in [None, Some(&REWEIGHTING)] {
            moments(engine, &scene, &name, reweighting)?.into_iter().for_each(&mut add);
        }
    }
    session(engine)?.into_iter().for_each(&mut add);
    Ok(checks)
}

fn images(engine: &GpuEngine, scene: &Scene, name: &str) -> Result<[Check; 2]> {
    let ours = engine.render(&scene.gaussians, &scene.camera, BACKGROUND)?;
    let theirs = CpuEngine::default().render(&scene.gaussians, &scene.camera, BACKGROUND)?;
    let values =
        |rendering: &splat::engine::Rendering| [&rendering.image.pixels[..], &rendering.alpha].concat();
    let (ours, theirs) = (values(&ours), values(&theirs));
    let difference = |(a, b): (&f32, &f32)| (a - b).abs();
    let far = ours.iter().zip(&theirs).filter(|&pair| !(difference(pair) < CLOSE)).count();
    let worst = ours.iter().zip(&theirs).map(difference).fold(0.0, f32::max);
    Ok([
        Check::new(name, "image: share of values off by 2e-5", far as f64 / ours.len() as f64, 5e-3),
        Check::new(name, "image: worst", f64::from(worst), STEP),
    ])
}

fn gradients(engine: &GpuEngine, scene: &Scene, name: &str) -> Result<[Check; 5]> {
    let Scene { gaussians, camera, .. } = scene;
    let pixels = camera.width as usize * camera.height as usize;
    let seeds: Vec<f32> = (0..3 * pixels).map(|place| (place as f32 * 12.9898).sin()).collect();
    let alpha = &seeds[..pixels];
    let ours = engine.render_backward(gaussians, camera, BACKGROUND, &seeds, alpha)?;
    let theirs = CpuEngine::default().render_backward(gaussians, camera, BACKGROUND, &seeds, alpha);
    let check = |array: &str, ours: &[f32], theirs: &[f32]| {
        // A pixel that rounds across the cut-off changes a gradient by its share of 1/255.
        Check::new(name, &format!("gradient by {array}: relative norm"), relative(ours, theirs), 1e-3)
    };
    Ok([
        check("means", ours.means.as_flattened(), theirs.means.as_flattened()),
        check("rotations", ours.rotations.as_flattened(), theirs.rotations.as_flattened()),
        check("log scales", ours.log_scales.as_flattened(), theirs.log_scales.as_flattened()),
        check("opacities", &ours.logit_opacities, &theirs.logit_opacities),
        check("harmonics", &ours.sh, &theirs.sh),
    ])
}

fn relative(ours: &[f32], theirs: &[f32]) -> f64 {
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|value| value * value).sum::<f64>().sqrt();
    let differences = ours.iter().zip(theirs).map(|(&a, &b)| f64::from(a) - f64::from(b));
    norm(&mut { differences }) / norm(&mut theirs.iter().map(|&value| f64::from(value)))
}

fn moments(
    engine: &GpuEngine,
    scene: &Scene,
    name: &str,
    reweighting: Option<&Reweighting>,
) -> Result<[Check; 3]> {
    let Scene { gaussians, camera, .. } = scene;
    let tracks = rough(camera, 3);
    let ours = engine.footprint_moments(gaussians, camera, &tracks, reweighting)?;
    let theirs = CpuEngine::default().footprint_moments(gaussians, camera, &tracks, reweighting)?;
    let (mut seen, mut compared, mut means, mut seconds) = (0, 0, 0.0_f64, 0.0_f64);
    for (found, exact) in ours.iter().zip(&theirs) {
        seen += usize::from(exact.pixels > 0);
        // A pixel at a threshold may be seen by one engine and not by the other.
        if found.pixels != exact.pixels || !(exact.weight_squared > 0.0) {
            continue;
        }
        compared += 1;
        let [mean, second] = difference(found, exact);
        means = means.max(mean);
        seconds = seconds.max(second);
    }
    // A reweighted pixel multiplies the error of alpha by its exponent, and passes pass it on.
    let (kind, factor) = if reweighting.is_some() { ("reweighted moments", 100.0) } else { ("moments", 1.0) };
    let missed = 1.0 - compared as f64 / f64::from(seen.max(1) as u32);
    Ok([
        Check::new(name, &format!("{kind}: footprints of other pixels"), missed, 0.05),
        Check::new(name, &format!("{kind}: means, px"), means, 4e-5 * factor),
        Check::new(name, &format!("{kind}: second, relative"), seconds, 1e-5 * factor),
    ])
}

fn difference(found: &FootprintMoments, exact: &FootprintMoments) -> [f64; 2] {
    let largest = |found: &[f64], exact: &[f64]| {
        found.iter().zip(exact).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    let first = |m: &FootprintMoments| [m.centroid, m.tracked_centroid].concat();
    let second = |m: &FootprintMoments| [m.source.as_slice(), &m.cross, &[m.target]].concat();
    let scale = exact.target + exact.source[0] + exact.source[2] + exact.weight;
    [largest(&first(found), &first(exact)), largest(&second(found), &second(exact)) / scale]
}

/// The same optimisation on both engines, and on the device twice.
fn session(engine: &GpuEngine) -> Result<[Check; 3]> {
    let scene = scene::generate(SceneSize { gaussians: 3_000, width: 160, height: 90, sh_degree: 3 });
    let [(ours, our_losses), (again, _), (_, losses)] =
        [optimised(engine, &scene)?, optimised(engine, &scene)?, optimised(&CpuEngine::default(), &scene)?];
    let apart = |step: usize| f64::from((our_losses[step] / losses[step] - 1.0).abs());
    let changed = ours.means != again.means || ours.sh != again.sh || ours.rotations != again.rotations;
    Ok([
        Check::new("session", "first loss, relative", apart(0), 1e-5),
        // Adam's first steps are of the sign of the gradient alone, whatever its size.
        Check::new("session", "loss after 20 steps, relative", apart(STEPS - 1), 1e-2),
        Check::new("session", "second run has other bytes", f64::from(u8::from(changed)), 0.5),
    ])
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
