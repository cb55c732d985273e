//! `blend_backward` and `project_backward` through [`CpuEngine::render_backward`], on every instruction set.

use splat::{gaussians::gradients::GaussianGradients, raster::CpuEngine, simd::Instructions};

use crate::{
    reference::{
        blend::Close,
        gradient::{GaussianSlopes, Objective, Slope, gradients},
    },
    row::{Bar, Row, excess},
    scenes::{Extreme, Scene, extremes, pile, typical},
};

const BAR: Bar = Bar {
    unit: "of the class's largest",
    factor: 3.0,
    why: "2⁻²⁴ through every pixel's weight and the moments of it that make the gradient, whose offsets are rounded once more from the tile's centre",
};

/// Parameter classes and their places among the geometry; the harmonics have none.
const CLASSES: [(&str, std::ops::Range<usize>); 5] = [
    ("nothing extreme: means", 0..3),
    ("nothing extreme: rotations", 3..7),
    ("nothing extreme: log scales", 7..10),
    ("nothing extreme: logit opacities", 10..11),
    ("nothing extreme: harmonics", 11..11),
];

fn weights(count: usize) -> Vec<f32> {
    (0..count).map(|place| (place as f32 * 12.9898).sin()).collect()
}

fn values(found: &GaussianGradients, class: usize) -> &[f32] {
    match class {
        0 => found.means.as_flattened(),
        1 => found.rotations.as_flattened(),
        2 => found.log_scales.as_flattened(),
        3 => &found.logit_opacities,
        _ => &found.sh,
    }
}

/// A gradient that single precision cannot hold is given as zero, with all others of that Gaussian.
fn is_representable(slopes: &GaussianSlopes) -> bool {
    slopes.geometry.iter().all(|slope| slope.value.abs() < f32::MAX.into())
}

fn expected(slopes: &[GaussianSlopes], class: usize) -> Vec<Slope> {
    let of_gaussian = |slopes: &GaussianSlopes| -> Vec<Slope> {
        let range = CLASSES[class].1.clone();
        let all = if class == 4 { slopes.sh.clone() } else { slopes.geometry[range].to_vec() };
        if is_representable(slopes) { all } else { vec![Slope::default(); all.len()] }
    };
    slopes.iter().flat_map(of_gaussian).collect()
}

fn all(slopes: &[GaussianSlopes]) -> Vec<Slope> {
    (0..CLASSES.len()).flat_map(|class| expected(slopes, class)).collect()
}

fn largest(slopes: &[Slope]) -> f64 {
    slopes.iter().map(|slope| slope.value.abs()).fold(0.0, f64::max)
}

/// What another engine than the processor's may do beyond its bounds.
#[derive(Clone, Copy)]
pub(crate) struct Allowance {
    /// Times the bound.
    pub factor: f64,
    /// Rounding of a class that symmetry makes zero, of the largest gradient of all classes.
    pub zero: f64,
}

const NOTHING: Allowance = Allowance { factor: 1.0, zero: 0.0 };

/// Errors and predictions of a class, by its largest gradient.
fn of_class(
    found: &GaussianGradients,
    slopes: &[GaussianSlopes],
    class: usize,
    zero: f64,
) -> Vec<(f64, f64)> {
    let expected = expected(slopes, class);
    // Where symmetry makes all of them zero, nothing but rounding is left to compare with.
    let of_all = largest(&all(slopes));
    let zero = if largest(&expected) < 1e-9 * of_all { zero * of_all } else { 0.0 };
    let largest = largest(&expected).max(1e-9 * of_all).max(f64::MIN_POSITIVE);
    let pairs = values(found, class).iter().zip(&expected);
    pairs
        .map(|(&found, slope)| {
            // Beyond the rounding of the result lies only what is too small to be told from zero.
            let rounding = f64::from(f32::EPSILON) * slope.value.abs() + f64::from(f32::MIN_POSITIVE);
            ((f64::from(found) - slope.value).abs() / largest, (slope.error() + rounding + zero) / largest)
        })
        .collect()
}

/// Gradients by weights of the image and of alpha.
pub(crate) type Backward<'a> = &'a dyn Fn(&Scene, &[f32], &[f32]) -> GaussianGradients;

/// Adds a scene on every engine to the rows of the classes.
fn add(rows: &mut [(Row, Vec<usize>)], scene: &Scene, engines: &[Backward<'_>], zero: f64) {
    let pixels = scene.camera.width as usize * scene.camera.height as usize;
    let (image_weights, alpha_weights) = (weights(3 * pixels), weights(pixels));
    let objective = Objective {
        background: scene.background.map(f64::from),
        image_weights: &image_weights,
        alpha_weights: &alpha_weights,
    };
    let references = Close::ALL.map(|close| gradients(&scene.gaussians, &scene.camera, &objective, close));
    for engine in engines {
        let found = engine(scene, &image_weights, &alpha_weights);
        for (row, classes) in &mut *rows {
            let tries = references.each_ref().map(|slopes| -> Vec<(f64, f64)> {
                classes.iter().flat_map(|&class| of_class(&found, slopes, class, zero)).collect()
            });
            row.case_of(tries.into_iter().min_by(|a, b| excess(a).total_cmp(&excess(b))).unwrap());
        }
    }
}

/// One row on these engines.
pub(crate) fn row(extreme: &Extreme, engines: &[Backward<'_>], allowance: Allowance) -> Row {
    let bar = Bar { factor: allowance.factor * BAR.factor, ..BAR };
    let row = Row::new("blend_backward, project_backward", extreme.name, bar);
    let mut rows = [(row, (0..CLASSES.len()).collect())];
    extreme.scenes.iter().for_each(|scene| add(&mut rows, scene, engines, allowance.zero));
    let [(row, _)] = rows;
    row
}

fn rows_per_class(engines: &[Backward<'_>]) -> Vec<Row> {
    let extreme = typical();
    let row =
        |class: usize| (Row::new("blend_backward, project_backward", CLASSES[class].0, BAR), vec![class]);
    let mut rows: Vec<(Row, Vec<usize>)> = (0..CLASSES.len()).map(row).collect();
    extreme.scenes.iter().for_each(|scene| add(&mut rows, scene, engines, NOTHING.zero));
    rows.into_iter().map(|(row, _)| row).collect()
}

/// What is swept beside what is not extreme.
pub(crate) fn sweeps() -> Vec<Extreme> {
    let few = pile("5000 Gaussians on one pixel, opacity 0.0039 to 1", 5000, 5);
    let mut many = pile("100 000 Gaussians on one pixel, opacity 0.0039", 100_000, 1);
    // Nearly transparent, so that most have a gradient.
    many.scenes.truncate(1);
    extremes().into_iter().chain([few, many]).collect()
}

fn on_processor(instructions: Instructions) -> impl Fn(&Scene, &[f32], &[f32]) -> GaussianGradients {
    move |scene, image_weights, alpha_weights| {
        let Scene { gaussians, camera, background } = scene;
        let engine = CpuEngine::new(instructions);
        engine.render_backward(gaussians, camera, *background, image_weights, alpha_weights)
    }
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let engines: Vec<_> = Instructions::available().map(on_processor).collect();
    let engines: Vec<Backward<'_>> = engines.iter().map(|engine| engine as Backward<'_>).collect();
    let extreme = sweeps();
    rows_per_class(&engines)
        .into_iter()
        .chain(extreme.iter().map(|extreme| row(extreme, &engines, NOTHING)))
        .collect()
}
