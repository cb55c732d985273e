//! Reads the float64 golden data of `tests/golden` (conventions in the README there).

use std::{collections::BTreeMap, fs::File, path::PathBuf};

use splat::{cameras::Camera, gaussians::Gaussians};

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
