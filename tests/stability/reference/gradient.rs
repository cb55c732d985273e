//! Gradients of a weighted sum of pixels by forward differentiation, one Gaussian at a time, and what rounding does to
//! them at first order.

use splat::{cameras::Camera, gaussians::Gaussians};

use super::{
    ROUNDOFF_32, ROUNDOFF_64,
    blend::{Close, Sample, Transmittance, traverse},
    project::{PARAMETERS, Shape, differentiable, project},
    real::Dual,
    render::shapes,
};

/// A gradient and the error that rounding may make in it.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Slope {
    pub value: f64,
    /// Error that is the same wherever a footprint is evaluated, so that it adds up over the pixels.
    systematic: f64,
    /// Sum of the squares of independent errors.
    random: f64,
}

impl Slope {
    /// Both errors together.
    pub(crate) fn error(&self) -> f64 {
        self.systematic + self.random.sqrt()
    }

    fn add(&mut self, other: Self) {
        self.value += other.value;
        self.systematic += other.systematic;
        self.random += other.random;
    }
}

/// Gradient by one Gaussian's parameters, in the order of [`super::project::Parameters`], and by its coefficients.
#[derive(Clone, Debug)]
pub(crate) struct GaussianSlopes {
    pub geometry: [Slope; PARAMETERS - 3],
    /// `K × 3`.
    pub sh: Vec<Slope>,
}

/// What the loss is made of: `Σ image · image_weights + Σ alpha · alpha_weights`.
pub(crate) struct Objective<'a> {
    pub background: [f64; 3],
    pub image_weights: &'a [f32],
    pub alpha_weights: &'a [f32],
}

/// Roundings of double precision between a parameter and its footprint and back.
const DOUBLE: f64 = 16.0 * ROUNDOFF_64;

type Derivative = Dual<PARAMETERS>;

/// Gradients of every Gaussian.
pub(crate) fn gradients(
    gaussians: &Gaussians,
    camera: &Camera,
    objective: &Objective<'_>,
    close: Close,
) -> Vec<GaussianSlopes> {
    let (numbers, shapes) = shapes(gaussians, camera);
    let mut sums = vec![[Slope::default(); PARAMETERS]; gaussians.len()];
    let moving: Vec<Shape<Derivative>> = numbers
        .iter()
        .filter_map(|&index| project(&differentiable(gaussians, index), gaussians, index, camera))
        .collect();
    for row in 0..camera.height as usize {
        for column in 0..camera.width as usize {
            let place = row * camera.width as usize + column;
            let weights = Weights {
                colour: std::array::from_fn(|channel| objective.image_weights[3 * place + channel].into()),
                alpha: objective.alpha_weights.get(place).copied().unwrap_or(0.0).into(),
                background: objective.background,
            };
            let (x, y) = (column as f64 + 0.5, row as f64 + 0.5);
            pixel(&shapes, &moving, (x, y), &weights, close, |place, parameter, slope| {
                sums[numbers[place]][parameter].add(slope);
            });
        }
    }
    let mut all: Vec<GaussianSlopes> = sums
        .iter()
        .map(|slopes| GaussianSlopes {
            geometry: std::array::from_fn(|parameter| slopes[parameter]),
            sh: vec![Slope::default(); 3 * gaussians.sh_coefficients()],
        })
        .collect();
    for (&number, shape) in numbers.iter().zip(&shapes) {
        for (k, slopes) in all[number].sh.chunks_exact_mut(3).enumerate() {
            for (channel, slope) in slopes.iter_mut().enumerate() {
                let Slope { value, systematic, random } = sums[number][PARAMETERS - 3 + channel];
                let basis = shape.basis[k];
                slope.value = basis * value;
                // The direction of view is rounded to single precision before its powers are taken.
                slope.systematic = basis.abs() * systematic + 8.0 * ROUNDOFF_32 * value.abs();
                slope.random = basis * basis * random;
            }
        }
    }
    all
}

/// Weights of one pixel in the objective.
struct Weights {
    colour: [f64; 3],
    alpha: f64,
    background: [f64; 3],
}

/// One blended footprint of a pixel.
struct Blended {
    place: usize,
    sample: Sample<f64>,
    front: Transmittance<f64>,
    light: Light,
    /// All that is behind it, as if nothing were in front.
    behind: Light,
}

/// Light weighted with the objective's weights, and its errors.
#[derive(Clone, Copy)]
struct Light {
    value: f64,
    /// Sum of the sizes of its terms.
    size: f64,
    /// Error that errors of alpha make.
    systematic: f64,
    /// Square of the error that independent roundings make.
    random: f64,
}

impl Light {
    fn new(terms: [f64; 4]) -> Self {
        let size: f64 = terms.iter().map(|term| term.abs()).sum();
        Self { value: terms.iter().sum(), size, systematic: 0.0, random: (2.0 * ROUNDOFF_32 * size).powi(2) }
    }

    /// With a footprint in front of it: `behind + alpha (light - behind)`.
    fn through(self, sample: &Sample<f64>, light: Self) -> Self {
        let (alpha, left) = (sample.alpha, 1.0 - sample.alpha);
        let excess = light.value - self.value;
        let size = left * self.size + alpha * light.size;
        Self {
            value: self.value + alpha * excess,
            size,
            systematic: left * self.systematic + alpha * sample.error * excess.abs(),
            random: left * left * self.random + alpha * alpha * light.random + (ROUNDOFF_32 * size).powi(2),
        }
    }
}

/// Hands out every parameter's share of one pixel.
fn pixel(
    shapes: &[Shape<f64>],
    moving: &[Shape<Derivative>],
    (x, y): (f64, f64),
    weights: &Weights,
    close: Close,
    mut share: impl FnMut(usize, usize, Slope),
) {
    let mut list = Vec::new();
    let [red, green, blue] = [0, 1, 2].map(|channel| weights.background[channel] * weights.colour[channel]);
    let mut behind = Light::new([red, green, blue, -weights.alpha]);
    traverse(shapes, x, y, close, |place, sample, front| {
        let [red, green, blue] =
            [0, 1, 2].map(|channel| shapes[place].colour[channel] * weights.colour[channel]);
        let light = Light::new([red, green, blue, 0.0]);
        list.push(Blended { place, sample: *sample, front: *front, light, behind });
    });
    for blended in list.iter_mut().rev() {
        blended.behind = behind;
        behind = behind.through(&blended.sample, blended.light);
    }
    for Blended { place, sample, front, light, behind } in &list {
        let shape = &moving[*place];
        let alpha = super::blend::sample(shape, x, y).alpha;
        let weight = front.value * sample.alpha;
        // The pixel by this footprint alone: T alpha (light - behind) + rest; of that, v = alpha ∂loss/∂alpha.
        let excess = light.value - behind.value;
        let v = weight * excess.abs();
        let front_random = front.random.sqrt() + 3.0 * ROUNDOFF_32;
        let systematic = v * (sample.error + front.systematic) + weight * behind.systematic;
        let random = v * front_random + weight * (behind.random.sqrt() + light.random.sqrt());
        for parameter in 0..PARAMETERS {
            let by_alpha = front.value * excess * alpha.by[parameter];
            let mut slope = Slope { value: by_alpha, ..Slope::default() };
            if !sample.clamped {
                let [exact, terms] = exponent_terms(shape, sample, parameter);
                let terms_of_double = alpha.size[parameter] / alpha.value;
                slope.systematic += systematic * exact + DOUBLE * v * terms_of_double;
                slope.random += (random * exact + 2.0 * v * terms * ROUNDOFF_32).powi(2);
            }
            for channel in 0..3 {
                let by = weights.colour[channel] * shape.colour[channel].by[parameter];
                slope.value += weight * by;
                slope.systematic += weight * by.abs() * (sample.error + front.systematic);
                slope.random += (weight * by * front_random).powi(2);
            }
            share(*place, parameter, slope);
        }
    }
}

/// Size of the derivative of the logarithm of alpha by a parameter, as the sum of the sizes of its terms in the offsets
/// from the footprint's centre; and the same with the numbers from which the offsets are computed, a block's corner away.
fn exponent_terms(shape: &Shape<Derivative>, sample: &Sample<f64>, parameter: usize) -> [f64; 2] {
    let (k, k_y) = (1.0 / shape.conditional.value, 1.0 / shape.variance_y.value);
    let by_k = k * k * shape.conditional.by[parameter].abs();
    let by_k_y = k_y * k_y * shape.variance_y.by[parameter].abs();
    let by_slope = k * shape.slope.by[parameter].abs();
    let by_mean_y = shape.mean[1].by[parameter].abs();
    let by_mean_x = k * (shape.mean[0].by[parameter].abs() + shape.slope.value.abs() * by_mean_y);
    let opacity =
        if shape.opacity.value > 0.0 { shape.opacity.by[parameter].abs() / shape.opacity.value } else { 0.0 };
    // 1 - opacity is rounded in double precision.
    let opacity = opacity + if parameter == 10 { ROUNDOFF_64 } else { 0.0 };
    let size = |[d, dy]: [f64; 2]| {
        0.5 * by_k * d * d
            + by_slope * d * dy
            + by_mean_x * d
            + 0.5 * by_k_y * dy * dy
            + k_y * by_mean_y * dy
            + opacity
    };
    [size(sample.offset.map(f64::abs)), size(sample.offset_terms)]
}

#[cfg(test)]
mod tests {
    use trackersplat_tests::golden::{Golden, relative_norm};

    use super::*;

    #[test]
    fn gradients_are_those_of_the_golden_data() {
        for scene in ["basic", "needles", "unnormalised"] {
            let golden = Golden::open(&format!("raster_{scene}_cam0"));
            let narrow = |name: &str| -> Vec<f32> { golden.values(name).iter().map(|&v| v as f32).collect() };
            let objective = Objective {
                background: std::array::from_fn(|channel| golden.values("background")[channel]),
                image_weights: &narrow("seed_image"),
                alpha_weights: &narrow("seed_alpha"),
            };
            let slopes = gradients(&golden.gaussians(), &golden.camera(), &objective, Close::AsComputed);
            let class = |range: std::ops::Range<usize>| {
                slopes
                    .iter()
                    .flat_map(move |slopes| slopes.geometry[range.clone()].iter().map(|slope| slope.value))
            };
            let sh = slopes.iter().flat_map(|slopes| slopes.sh.iter().map(|slope| slope.value));
            // Seeds are rounded to single precision here.
            for (name, error) in [
                ("mean", relative_norm(class(0..3), golden.values("grad_mean"))),
                ("rotation", relative_norm(class(3..7), golden.values("grad_rotation"))),
                ("log_scale", relative_norm(class(7..10), golden.values("grad_log_scale"))),
                ("opacity", relative_norm(class(10..11), golden.values("grad_logit_opacity"))),
                ("sh", relative_norm(sh, golden.values("grad_sh"))),
            ] {
                assert!(error < 1e-6, "{scene}: {name} off by {error:e}");
            }
        }
    }
}
