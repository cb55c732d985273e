//! What the rasterizer does with input that no equation covers: not drawn, taken as something else, or refused; always
//! the same on every instruction set.

use std::sync::Arc;

use splat::{
    engine::{Engine, EngineError, SessionInput, TrainingView},
    gaussians::{Gaussians, gradients::GaussianGradients},
    image::Image,
    raster::CpuEngine,
    simd::Instructions,
};

use crate::{
    row::{EXACT, Row},
    scenes::{blobs, camera},
};

const STAGE: &str = "render, render_backward";
const COUNT: usize = 12;
const BACKGROUND: [f32; 3] = [0.2, 0.1, 0.3];

/// What a Gaussian with a broken parameter is drawn as.
enum DrawnAs {
    /// Not at all.
    Nothing,
    /// With another value in that place.
    Instead(f32),
}

/// Sets one parameter of Gaussian 3.
type Set = fn(&mut Gaussians, f32);

fn image(engine: CpuEngine, gaussians: &Gaussians) -> Image {
    engine.render(gaussians, &camera(26, 19, 30.0), BACKGROUND).unwrap().image
}

fn gradients(engine: CpuEngine, gaussians: &Gaussians) -> GaussianGradients {
    let weights: Vec<f32> = (0..3 * 26 * 19).map(|place| (place as f32 * 0.3).sin()).collect();
    engine.render_backward(gaussians, &camera(26, 19, 30.0), BACKGROUND, &weights, &[])
}

fn is_finite(gradients: &GaussianGradients) -> bool {
    let GaussianGradients { means, rotations, log_scales, logit_opacities, sh } = gradients;
    let all =
        [means.as_flattened(), rotations.as_flattened(), log_scales.as_flattened(), logit_opacities, sh];
    all.concat().iter().all(|value| value.is_finite())
}

fn is_zero_of_third(gradients: &GaussianGradients) -> bool {
    gradients.means[3] == [0.0; 3]
        && gradients.log_scales[3] == [0.0; 3]
        && gradients.logit_opacities[3] == 0.0
}

/// Draws a set with one broken parameter and what it is to be drawn as.
fn add(row: &mut Row, set: Set, value: f32, drawn_as: &DrawnAs) {
    let whole = blobs(COUNT, 21);
    let mut broken = whole.clone();
    set(&mut broken, value);
    let expected = match *drawn_as {
        DrawnAs::Nothing => whole.select(&(0..COUNT).filter(|&index| index != 3).collect::<Vec<_>>()),
        DrawnAs::Instead(other) => {
            let mut replaced = whole;
            set(&mut replaced, other);
            replaced
        }
    };
    for instructions in Instructions::available() {
        let engine = CpuEngine::new(instructions);
        let found = gradients(engine, &broken);
        let is_gone = matches!(drawn_as, DrawnAs::Instead(_)) || is_zero_of_third(&found);
        row.exact(image(engine, &broken) == image(engine, &expected) && is_finite(&found) && is_gone);
    }
}

fn row(extreme: &'static str, remark: &str, set: Set, drawn: &[(f32, DrawnAs)]) -> Row {
    let mut row = Row::new(STAGE, extreme, EXACT).remark(remark);
    drawn.iter().for_each(|(value, drawn_as)| add(&mut row, set, *value, drawn_as));
    row
}

const NAN: f32 = f32::NAN;
const INFINITY: f32 = f32::INFINITY;

fn broken_parameters() -> Vec<Row> {
    use DrawnAs::{Instead, Nothing};
    vec![
        row(
            "mean of NaN, ±infinity, ±3e38",
            "not drawn; zero gradient",
            |set, value| set.means[3][1] = value,
            &[NAN, INFINITY, -INFINITY, 3e38, -3e38].map(|value| (value, Nothing)),
        ),
        row(
            "quaternion of NaN, ±infinity",
            "not rotated",
            |set, value| {
                set.rotations[3] = if value == 0.0 { [1.0, 0.0, 0.0, 0.0] } else { [0.3, value, 0.1, 0.2] }
            },
            &[NAN, INFINITY, -INFINITY].map(|value| (value, Instead(0.0))),
        ),
        row(
            "quaternion of zeros",
            "not rotated; its own gradient is zero",
            |set, value| set.rotations[3] = [value, 0.0, 0.0, -0.0],
            &[(0.0, Instead(1.0))],
        ),
        row(
            "log scale of NaN, infinity, 3e38",
            "not drawn; zero gradient",
            |set, value| set.log_scales[3][0] = value,
            &[NAN, INFINITY, 3e38].map(|value| (value, Nothing)),
        ),
        row(
            "log scale of −infinity, −3e38",
            "as flat as any",
            |set, value| set.log_scales[3][0] = value,
            &[-INFINITY, -3e38].map(|value| (value, Instead(-1000.0))),
        ),
        row(
            "logit of the opacity of NaN, −infinity, −3e38",
            "not drawn; zero gradient",
            |set, value| set.logit_opacities[3] = value,
            &[NAN, -INFINITY, -3e38].map(|value| (value, Nothing)),
        ),
        row(
            "logit of the opacity of infinity, 3e38",
            "opacity 1",
            |set, value| set.logit_opacities[3] = value,
            &[INFINITY, 3e38].map(|value| (value, Instead(100.0))),
        ),
        row(
            "harmonic of NaN, infinity",
            "not drawn; zero gradient",
            |set, value| set.sh[3 * 12] = value,
            &[NAN, INFINITY].map(|value| (value, Nothing)),
        ),
        row(
            "harmonic of −infinity, −3e38",
            "black in that channel",
            |set, value| set.sh[3 * 12] = value,
            &[-INFINITY, -3e38].map(|value| (value, Instead(-1e6))),
        ),
    ]
}

/// Whole sets of one kind.
fn whole_sets() -> Vec<Row> {
    let mut empty =
        Row::new(STAGE, "no Gaussian, all behind, all transparent", EXACT).remark("the background");
    let mut threads =
        Row::new(STAGE, "1 and 3 threads, 3000 Gaussians at one depth", EXACT).remark("the same bytes");
    let mut hidden = blobs(COUNT, 22);
    hidden.means.iter_mut().for_each(|mean| mean[2] -= 20.0);
    let mut faint = blobs(COUNT, 23);
    faint.logit_opacities.fill(-50.0);
    let mut level = blobs(3000, 24);
    level.means.iter_mut().for_each(|mean| mean[2] = 0.5);
    for instructions in Instructions::available() {
        let engine = CpuEngine::new(instructions);
        for set in [&Gaussians::empty(3), &hidden, &faint] {
            let is_background = image(engine, set) == Image::filled(26, 19, BACKGROUND);
            empty.exact(is_background && gradients(engine, set) == GaussianGradients::zeros(set));
        }
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| (image(engine, &level), gradients(engine, &level)))
        };
        threads.exact(on(1) == on(3));
    }
    vec![empty, threads]
}

/// What a session refuses instead of optimising it.
fn refusals() -> Vec<Row> {
    let input = |gaussians: Gaussians, (width, height): (u32, u32)| SessionInput {
        gaussians,
        views: vec![TrainingView {
            camera: camera(width, height, 30.0),
            image: Arc::new(Image::filled(width, height, BACKGROUND)),
            mask: None,
        }],
        background: BACKGROUND,
        dssim_weight: 0.2,
        frozen: Vec::new(),
    };
    let is_refused = |input: SessionInput, named: &str| match CpuEngine::default().session(input).err() {
        Some(EngineError::InvalidInput(problem)) => problem.contains(named),
        _ => false,
    };
    let mut values = Row::new("session", "NaN and ±infinity in every parameter, the zero quaternion", EXACT)
        .remark("refused; the Gaussian and the parameter are named");
    let sets: [(&str, Set); 5] = [
        ("means", |set, value| set.means[3][2] = value),
        ("rotations", |set, value| set.rotations[3][0] = value),
        ("log_scales", |set, value| set.log_scales[3][1] = value),
        ("logit_opacities", |set, value| set.logit_opacities[3] = value),
        ("sh", |set, value| set.sh[3 * 12 + 5] = value),
    ];
    for (name, set) in sets {
        for value in [NAN, INFINITY, -INFINITY] {
            let mut gaussians = blobs(COUNT, 25);
            set(&mut gaussians, value);
            values.exact(is_refused(input(gaussians, (8, 8)), &format!("Gaussian 3, `{name}`")));
        }
    }
    let mut gaussians = blobs(COUNT, 26);
    gaussians.rotations[3] = [0.0; 4];
    values.exact(is_refused(input(gaussians, (8, 8)), "Gaussian 3, `rotations` is the zero quaternion"));
    let mut sizes = Row::new("render, session", "cameras of 0×0, 0×8, 8×0 pixels", EXACT)
        .remark("refused; the size is named");
    for size in [(0, 0), (0, 8), (8, 0)] {
        let named = format!("{}x{}", size.0, size.1);
        sizes.exact(is_refused(input(blobs(COUNT, 27), size), &named));
        let rendered = CpuEngine::default().render(&blobs(1, 27), &camera(size.0, size.1, 30.0), BACKGROUND);
        sizes.exact(rendered.is_err_and(|error| error.to_string().contains(&named)));
    }
    vec![values, sizes]
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    broken_parameters().into_iter().chain(whole_sets()).chain(refusals()).collect()
}
