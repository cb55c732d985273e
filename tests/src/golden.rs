//! Reads the float64 golden data of `tests/golden` (conventions in the README there) and holds engines against it.
#![allow(clippy::print_stdout, reason = "`--nocapture` shows the errors that were found")]

use std::{collections::BTreeMap, fs::File, path::PathBuf};

use splat::{
    cameras::Camera,
    engine::Engine,
    gaussians::{Gaussians, gradients::GaussianGradients},
    motion::moments::FootprintMoments,
    tracking::TrackField,
};

/// Rasterized scenes, each with two cameras.
const SCENES: [&str; 7] = ["basic", "degree0", "needles", "opaque", "near", "faint", "unnormalised"];

/// Track fields over one scene.
const TRACK_FIELDS: [&str; 3] = ["affine", "noisy", "bent"];

/// Single precision carries a pixel's few hundred blends to about 1e-6; the bound leaves room for one pixel whose
/// alpha rounds across the cut-off at a transmittance of one percent.
const IMAGE_TOLERANCE: f64 = 2e-5;

/// Relative norm per gradient array in single precision.
const GRADIENT_TOLERANCE: f64 = 1e-4;

/// Relative norm of the Gaussians' blending weights: alpha is good to 1e-6, and so are sums of it.
const WEIGHT_TOLERANCE: f64 = 1e-5;

/// Second moments relative to the footprint's own spread, plus the tracks' rounding to single precision (4e-6 px) on a
/// footprint of one pixel.
const SECOND_MOMENT_TOLERANCE: f64 = 1e-5;

/// Means, pixels: those 4e-6 px, and alpha's 1e-6 times the footprint's extent.
const MEAN_TOLERANCE: f64 = 2e-5;

/// The arrays of one golden file, flattened in C order.
pub struct Golden {
    arrays: BTreeMap<String, (Vec<u64>, Vec<f64>)>,
}

impl Golden {
    /// Opens `tests/golden/<name>.npz`.
    ///
    /// # Panics
    /// If the file is missing or no npz of numbers: the repository itself is broken then.
    pub fn open(name: &str) -> Self {
        let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("golden").join(format!("{name}.npz"));
        let file = File::open(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let mut archive = npyz::npz::NpzArchive::new(file).expect("a golden file is an npz archive");
        let names: Vec<String> = archive.array_names().map(str::to_owned).collect();
        let mut arrays = BTreeMap::new();
        for name in names {
            let array = archive.by_name(&name).expect("a readable array").expect("a listed array");
            let shape = array.shape().to_vec();
            let values = match array.dtype().descr().as_str() {
                "'<f8'" => array.into_vec::<f64>().expect("f64 values"),
                "'<i8'" => array
                    .into_vec::<i64>()
                    .expect("i64 values")
                    .into_iter()
                    .map(|value| value as f64)
                    .collect(),
                other => panic!("{name}: golden data of type {other}"),
            };
            arrays.insert(name, (shape, values));
        }
        Self { arrays }
    }

    /// The values of an array.
    ///
    /// # Panics
    /// If the array is not there.
    pub fn values(&self, name: &str) -> &[f64] {
        &self.arrays.get(name).unwrap_or_else(|| panic!("no golden array {name}")).1
    }

    fn rows<const WIDTH: usize>(&self, name: &str) -> Vec<[f32; WIDTH]> {
        self.values(name)
            .chunks_exact(WIDTH)
            .map(|row| std::array::from_fn(|column| row[column] as f32))
            .collect()
    }

    /// The input Gaussians.
    pub fn gaussians(&self) -> Gaussians {
        let coefficients = self.arrays["in_sh"].0[1];
        Gaussians {
            means: self.rows("in_mean"),
            rotations: self.rows("in_rotation"),
            log_scales: self.rows("in_log_scale"),
            logit_opacities: self.values("in_logit_opacity").iter().map(|&value| value as f32).collect(),
            sh: self.values("in_sh").iter().map(|&value| value as f32).collect(),
            sh_degree: coefficients.isqrt() as u32 - 1,
        }
    }

    /// The camera.
    pub fn camera(&self) -> Camera {
        let pose = self.values("w2c");
        let intrinsics = self.values("intrinsics");
        let size = self.values("size");
        let row = |row: usize| glam::DVec3::new(pose[4 * row], pose[4 * row + 1], pose[4 * row + 2]);
        Camera {
            width: size[0] as u32,
            height: size[1] as u32,
            fx: intrinsics[0],
            fy: intrinsics[1],
            cx: intrinsics[2],
            cy: intrinsics[3],
            rotation: glam::DMat3::from_cols(row(0), row(1), row(2)).transpose(),
            translation: glam::DVec3::new(pose[3], pose[7], pose[11]),
        }
    }
}

/// Every rasterized scene by its name.
pub fn for_each_scene(check: impl Fn(&str, &Golden)) {
    for scene in SCENES {
        for camera in 0..2 {
            let name = format!("raster_{scene}_cam{camera}");
            check(&name, &Golden::open(&name));
        }
    }
}

impl Golden {
    fn narrow(&self, name: &str) -> Vec<f32> {
        self.values(name).iter().map(|&value| value as f32).collect()
    }

    /// Colour behind everything.
    pub fn background(&self) -> [f32; 3] {
        std::array::from_fn(|channel| self.values("background")[channel] as f32)
    }

    /// What [`Golden::check_gradients`] takes the gradient of: weights of every image value, and of every alpha.
    pub fn seeds(&self) -> [Vec<f32>; 2] {
        ["seed_image", "seed_alpha"].map(|name| self.narrow(name))
    }

    /// Asserts that the engine draws the scene as the dense reference does.
    ///
    /// # Panics
    /// If it does not; so do the other checks.
    pub fn check_image(&self, name: &str, engine: &dyn Engine) {
        let rendering = engine
            .render(&self.gaussians(), &self.camera(), self.background())
            .expect("golden scenes can be drawn");
        let image = largest_difference(wide(&rendering.image.pixels), self.values("image"));
        let alpha = largest_difference(wide(&rendering.alpha), self.values("alpha"));
        println!("{name}: image {image:.1e}, alpha {alpha:.1e}");
        assert!(image < IMAGE_TOLERANCE, "{name}: image differs by {image:e}");
        assert!(alpha < IMAGE_TOLERANCE, "{name}: alpha differs by {alpha:e}");
    }

    /// Asserts that gradients under the [`Golden::seeds`] are those of automatic differentiation.
    ///
    /// # Panics
    /// If they are not.
    pub fn check_gradients(&self, name: &str, gradients: GaussianGradients) {
        let arrays: [(&str, Vec<f32>); 5] = [
            ("mean", gradients.means.into_flattened()),
            ("rotation", gradients.rotations.into_flattened()),
            ("log_scale", gradients.log_scales.into_flattened()),
            ("logit_opacity", gradients.logit_opacities),
            ("sh", gradients.sh),
        ];
        for (array, ours) in arrays {
            let error = relative_norm(wide(&ours), self.values(&format!("grad_{array}")));
            println!("{name}: {array} {error:.1e}");
            assert!(error < GRADIENT_TOLERANCE, "{name}: gradient by {array} off by {error:e}");
        }
    }

    /// Asserts that footprints under tracks that stand still have the reference's blending weights.
    ///
    /// # Panics
    /// If they have not.
    pub fn check_blending_weights(&self, name: &str, engine: &dyn Engine) {
        let camera = self.camera();
        let positions = vec![[0.0; 2]; camera.width as usize * camera.height as usize];
        let moments = engine
            .footprint_moments(&self.gaussians(), &camera, &visible_tracks(&camera, positions), None)
            .expect("golden scenes can be measured");
        let error = relative_norm(moments.iter().map(|m| m.blend_weight), self.values("weight_sum"));
        println!("{name}: weights {error:.1e}");
        assert!(error < WEIGHT_TOLERANCE, "{name}: weights off by {error:e}");
    }

    fn check_footprint(&self, name: &str, index: usize, found: &FootprintMoments) {
        let pixels = self.values("pixel_count")[index];
        assert_eq!(f64::from(found.pixels), pixels, "{name}: pixels of Gaussian {index}");
        if found.pixels == 0 {
            return;
        }
        let central = &self.values("central_moments")[8 * index..8 * index + 8];
        let ours = [found.source.as_slice(), &found.cross, &[found.target]].concat();
        let scale = central.iter().fold(0.0f64, |largest, value| largest.max(value.abs()));
        let error = largest_difference(ours, central);
        assert!(
            error < SECOND_MOMENT_TOLERANCE * (scale + found.weight),
            "{name}: moments of {index} off by {error:e}"
        );
        for (ours, mean) in [(found.centroid, "centroid"), (found.tracked_centroid, "tracked_centroid")] {
            let error = largest_difference(ours, &self.values(mean)[2 * index..2 * index + 2]);
            assert!(error < MEAN_TOLERANCE, "{name}: {mean} of {index} off by {error:e} px");
        }
    }
}

/// Asserts that the engine's footprint moments are the reference's under every track field.
///
/// # Panics
/// If they are not.
pub fn check_moments(engine: &dyn Engine) {
    for field in TRACK_FIELDS {
        let golden = Golden::open(&format!("motion_{field}"));
        let camera = golden.camera();
        let positions = golden.rows("track");
        let moments = engine
            .footprint_moments(&golden.gaussians(), &camera, &visible_tracks(&camera, positions), None)
            .expect("golden scenes can be measured");
        for (index, found) in moments.iter().enumerate() {
            golden.check_footprint(field, index, found);
        }
    }
}

/// Tracks that are all seen, to one pixel.
fn visible_tracks(camera: &Camera, positions: Vec<[f32; 2]>) -> TrackField {
    let (visible, sigma) = (vec![true; positions.len()], vec![1.0; positions.len()]);
    TrackField { width: camera.width, height: camera.height, positions, visible, sigma }
}

fn wide(values: &[f32]) -> impl Iterator<Item = f64> + '_ {
    values.iter().map(|&value| f64::from(value))
}

/// Largest absolute difference.
pub fn largest_difference(ours: impl IntoIterator<Item = f64>, golden: &[f64]) -> f64 {
    ours.into_iter().zip(golden).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Norm of the difference over the norm of the golden array; 0 when both are zero.
pub fn relative_norm(ours: impl IntoIterator<Item = f64>, golden: &[f64]) -> f64 {
    let difference: f64 = ours.into_iter().zip(golden).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
    let norm = golden.iter().map(|value| value * value).sum::<f64>().sqrt();
    if difference == 0.0 { 0.0 } else { difference / norm }
}
