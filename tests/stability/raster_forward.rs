//! `project`, `bin` and `blend` through [`Engine::render`], on every instruction set.

use splat::{
    engine::{Engine, Rendering},
    raster::CpuEngine,
    simd::Instructions,
};

use crate::{
    reference::{
        blend::{Close, Pixel},
        render::render,
    },
    row::{Bar, Row, excess},
    scenes::{Extreme, Scene, extremes, pile, typical},
};

const BAR: Bar = Bar {
    unit: "of the largest colour, at least 1",
    factor: 2.0,
    why: "2⁻²⁴ through exponent, alpha, transmittance and sum of the pixel",
};

/// Errors and predictions of the values of a pixel.
fn of_pixel(rendering: &Rendering, place: usize, pixel: &Pixel) -> [(f64, f64); 4] {
    std::array::from_fn(|value| match value {
        3 => ((f64::from(rendering.alpha[place]) - pixel.alpha).abs(), pixel.alpha_error),
        channel => {
            let found = f64::from(rendering.image.pixels[3 * place + channel]);
            ((found - pixel.colour[channel]).abs(), pixel.colour_error[channel])
        }
    })
}

/// Every pixel against the decision that suits it best: one nearer to its threshold than its rounding may fall either way.
fn of_scene(scene: &Scene, references: &[Vec<Pixel>; 3], engine: &dyn Engine) -> Vec<(f64, f64)> {
    let rendering = engine.render(&scene.gaussians, &scene.camera, scene.background).unwrap();
    let best = |place: usize| {
        let tries = references.each_ref().map(|reference| of_pixel(&rendering, place, &reference[place]));
        tries.into_iter().min_by(|a, b| excess(a).total_cmp(&excess(b))).unwrap()
    };
    let brightest = references[0].iter().flat_map(|pixel| pixel.colour).fold(1.0, f64::max);
    let pixels = (0..references[0].len()).flat_map(best);
    pixels.map(|(error, predicted)| (error / brightest, predicted / brightest)).collect()
}

/// One row on these engines; it is held to so many times the bound of the processor's.
pub(crate) fn row(extreme: &Extreme, engines: &[&dyn Engine], factor: f64) -> Row {
    let bar = Bar { factor: factor * BAR.factor, ..BAR };
    let mut row = Row::new("project, bin, blend", extreme.name, bar);
    for scene in &extreme.scenes {
        let references =
            Close::ALL.map(|close| render(&scene.gaussians, &scene.camera, scene.background, close));
        for engine in engines {
            row.case_of(of_scene(scene, &references, *engine));
        }
    }
    row
}

/// What is swept.
pub(crate) fn sweeps() -> Vec<Extreme> {
    let pile = pile("100 000 Gaussians on one pixel, opacity 0.0039 to 1", 100_000, 5);
    [typical()].into_iter().chain(extremes()).chain([pile]).collect()
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let engines: Vec<CpuEngine> = Instructions::available().map(CpuEngine::new).collect();
    let engines: Vec<&dyn Engine> = engines.iter().map(|engine| engine as &dyn Engine).collect();
    sweeps().iter().map(|extreme| row(extreme, &engines, 1.0)).collect()
}
