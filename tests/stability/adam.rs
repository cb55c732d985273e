//! Adam in single precision against the same recurrence in double precision, over ten thousand steps.

use splat::{
    gaussians::{Gaussians, gradients::GaussianGradients},
    optim::{Adam, LearningRates},
};

use crate::{
    reference::ROUNDOFF_32,
    row::{Bar, EXACT, Row},
};

const BAR: Bar = Bar {
    unit: "of the parameter's largest value",
    factor: 1.0,
    why: "2⁻²⁴ (1 / (1 - β₁) + 1 / (2 (1 - β₂)) roundings of every step, and one of the parameter per step)",
};

const STEPS: usize = 10_000;
const RATE: f32 = 1e-3;
const COUNT: usize = 16;

/// Gradient of parameter `index` at a step.
type Gradient = fn(index: usize, step: usize) -> f32;

fn rates() -> LearningRates {
    LearningRates {
        mean: 0.0,
        rotation: 0.0,
        log_scale: 0.0,
        logit_opacity: RATE,
        sh_dc: 0.0,
        sh_rest: 0.0,
        sh_degree: 0,
    }
}

fn gaussians(start: f32) -> Gaussians {
    Gaussians {
        means: vec![[0.0; 3]; COUNT],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; COUNT],
        log_scales: vec![[0.0; 3]; COUNT],
        logit_opacities: (0..COUNT).map(|index| start * (1.0 + index as f32)).collect(),
        sh: vec![0.0; 3 * COUNT],
        sh_degree: 0,
    }
}

/// The shipped parameters after every step, given to `look`.
fn shipped(start: f32, gradient: Gradient, mut look: impl FnMut(usize, &[f32])) {
    let mut gaussians = gaussians(start);
    let mut adam = Adam::new(&gaussians);
    let mut gradients = GaussianGradients::zeros(&gaussians);
    for step in 0..STEPS {
        for (index, slope) in gradients.logit_opacities.iter_mut().enumerate() {
            *slope = gradient(index, step);
        }
        adam.step(&mut gaussians, &gradients, &rates(), None);
        look(step, &gaussians.logit_opacities);
    }
}

/// Kingma and Ba's recurrence for one parameter: its value after every step, and how far it has gone.
fn reference(start: f32, index: usize, gradient: Gradient) -> Vec<(f64, f64)> {
    let mut value = f64::from(start) * (1.0 + index as f64);
    let (mut first, mut second, mut way) = (0.0, 0.0, 0.0);
    (0..STEPS)
        .map(|step| {
            let slope = f64::from(gradient(index, step));
            first = 0.9 * first + 0.1 * slope;
            second = 0.999 * second + 0.001 * slope * slope;
            let power = step as i32 + 1;
            let root = (second / (1.0 - 0.999_f64.powi(power))).sqrt();
            let change = f64::from(RATE) * first / (1.0 - 0.9_f64.powi(power)) / (root + 1e-15);
            value -= change;
            way += change.abs();
            (value, way)
        })
        .collect()
}

fn row(extreme: &'static str, start: f32, gradient: Gradient) -> Row {
    let mut row = Row::new("adam", extreme, BAR);
    let expected: Vec<Vec<(f64, f64)>> = (0..COUNT).map(|index| reference(start, index, gradient)).collect();
    let mut errors = vec![Vec::new(); COUNT];
    shipped(start, gradient, |step, values| {
        for (index, &value) in values.iter().enumerate() {
            let (exact, way) = expected[index][step];
            let scale = exact.abs().max(f64::from(start) * (1.0 + index as f64)).max(way);
            let relative = 1.0 / (1.0 - 0.9) + 0.5 / (1.0 - 0.999) + 4.0;
            let predicted = ROUNDOFF_32 * (way * relative + (step as f64 + 1.0) * scale);
            errors[index].push(((f64::from(value) - exact).abs() / scale, predicted / scale));
        }
    });
    errors.into_iter().for_each(|errors| row.case_of(errors));
    row
}

/// Alternates, so that the first moment almost vanishes while the second does not.
fn alternating(index: usize, step: usize) -> f32 {
    let size = 10.0_f32.powi(-(index as i32));
    if step.is_multiple_of(2) { size } else { -size }
}

fn random_signs(index: usize, step: usize) -> f32 {
    let hash = (step as u32 * 16 + index as u32).wrapping_mul(2_654_435_761);
    (f64::from(hash) / f64::from(u32::MAX) - 0.5) as f32
}

/// One spike in silence: the second moment decays over thousands of steps.
fn spike(index: usize, step: usize) -> f32 {
    if step == 100 { 10.0_f32.powi(index as i32) } else { 1e-6 }
}

/// Gradients whose square is no number of single precision stop their parameter: no step is better than one of unknown
/// size, and nothing that is not a number comes of it.
fn overflow() -> Row {
    let mut row = Row::new("adam", "gradients of 1e20 to 3e38, whose square overflows", EXACT)
        .remark("the parameter stops where it is");
    let gradient: Gradient = |index, step| if step == 10 { 1e20 * 10.0_f32.powi(index as i32) } else { 1e-3 };
    let mut stopped = [0.0; COUNT];
    let mut right = [true; COUNT];
    shipped(1.0, gradient, |step, values| {
        for (index, &value) in values.iter().enumerate() {
            if step == 10 {
                stopped[index] = value;
            }
            // Powers of ten beyond 1e38 are infinite.
            right[index] &= index > 18 || value.is_finite() && (step <= 10 || value == stopped[index]);
        }
    });
    right.into_iter().for_each(|right| row.exact(right));
    row
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    vec![
        row("10 000 steps of one gradient, 1 to 1e-15", 1.0, |index, _| 10.0_f32.powi(-(index as i32))),
        row("10 000 steps of gradients of 1e-20 to 1e-35, below ε", 1.0, |index, _| {
            10.0_f32.powi(-20 - index as i32)
        }),
        row("10 000 steps of gradients of 1 to 1e15", 1.0, |index, _| 10.0_f32.powi(index as i32)),
        row("10 000 steps of alternating sign, 1 to 1e-15", 1.0, alternating),
        row("10 000 steps of random gradients", 1.0, random_signs),
        row("10 000 steps after one spike of 1 to 1e15", 1.0, spike),
        row("10 000 steps of zero gradients", 1.0, |_, _| 0.0),
        row("10 000 steps of a parameter of 1e6 to 1.6e7", 1e6, |index, _| 10.0_f32.powi(-(index as i32)))
            .remark("steps below 2⁻²⁵ of the parameter are lost, all of them here"),
        overflow(),
    ]
}
