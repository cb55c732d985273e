//! Reads a scene that another program wrote, so that figures of both are of the same scene.

use std::{fs::File, io::BufReader, path::Path};

use anyhow::{Context, Result, bail, ensure};
use glam::{DMat3, DVec3};
use npyz::{DType, NpyFile, TypeChar, npz::NpzArchive};
use splat::{cameras::Camera, gaussians::Gaussians, image::Image};

use super::Scene;

/// Reads `mean [N, 3]`, `rotation [N, 4]`, `log_scale [N, 3]`, `logit_opacity [N]`, `sh [N, K, 3]`, `w2c [4, 4]`,
/// `intrinsics [4]` (fx, fy, cx, cy), `size [2]` (width, height) and `target [H, W, 3]`.
///
/// # Errors
/// If the file is no npz, an array is missing, or shapes do not fit each other.
pub(crate) fn read(path: &Path) -> Result<Scene> {
    read_scene(path).with_context(|| format!("{}: not a benchmark scene", path.display()))
}

fn read_scene(path: &Path) -> Result<Scene> {
    let file = File::open(path).context("cannot open the file")?;
    let mut arrays = Arrays(NpzArchive::new(BufReader::new(file)).context("the file is not an npz archive")?);
    let (shape, sh) = arrays.any("sh")?;
    let &[count, coefficients, 3] = shape.as_slice() else {
        bail!("array `sh` has shape {shape:?}, expected [N, K, 3]");
    };
    let Some(sh_degree) = (0..=3u32).find(|degree| u64::from((degree + 1) * (degree + 1)) == coefficients)
    else {
        bail!("array `sh` has {coefficients} coefficients, expected 1, 4, 9 or 16");
    };
    let size = arrays.shaped("size", &[2])?;
    let side = |value: f64| (1.0..=65_536.0).contains(&value).then_some(value as u32);
    let (Some(width), Some(height)) = (side(size[0]), side(size[1])) else {
        bail!("array `size` is {} by {}, expected sides of 1 to 65536", size[0], size[1]);
    };
    let pose = arrays.shaped("w2c", &[4, 4])?;
    let intrinsics = arrays.shaped("intrinsics", &[4])?;
    let pixels = arrays.shaped("target", &[height.into(), width.into(), 3])?;
    let pose_row = |row: usize| DVec3::new(pose[4 * row], pose[4 * row + 1], pose[4 * row + 2]);
    Ok(Scene {
        gaussians: Gaussians {
            means: rows(&arrays.shaped("mean", &[count, 3])?),
            rotations: rows(&arrays.shaped("rotation", &[count, 4])?),
            log_scales: rows(&arrays.shaped("log_scale", &[count, 3])?),
            logit_opacities: single(&arrays.shaped("logit_opacity", &[count])?),
            sh: single(&sh),
            sh_degree,
        },
        camera: Camera {
            width,
            height,
            fx: intrinsics[0],
            fy: intrinsics[1],
            cx: intrinsics[2],
            cy: intrinsics[3],
            rotation: DMat3::from_cols(pose_row(0), pose_row(1), pose_row(2)).transpose(),
            translation: DVec3::new(pose[3], pose[7], pose[11]),
        },
        target: Image { width, height, pixels: single(&pixels) },
    })
}

fn single(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&value| value as f32).collect()
}

fn rows<const WIDTH: usize>(values: &[f64]) -> Vec<[f32; WIDTH]> {
    values.as_chunks().0.iter().map(|row| row.map(|value| value as f32)).collect()
}

struct Arrays(NpzArchive<BufReader<File>>);

impl Arrays {
    fn any(&mut self, name: &str) -> Result<(Vec<u64>, Vec<f64>)> {
        let Some(array) = self.0.by_name(name).with_context(|| format!("array `{name}`"))? else {
            bail!("array `{name}` is missing");
        };
        let shape = array.shape().to_vec();
        let values = numbers(array).with_context(|| format!("array `{name}`"))?;
        Ok((shape, values))
    }

    fn shaped(&mut self, name: &str, expected: &[u64]) -> Result<Vec<f64>> {
        let (shape, values) = self.any(name)?;
        ensure!(shape == expected, "array `{name}` has shape {shape:?}, expected {expected:?}");
        Ok(values)
    }
}

fn numbers<R: std::io::Read>(array: NpyFile<R>) -> Result<Vec<f64>> {
    ensure!(array.order() == npyz::Order::C || array.shape().len() < 2, "it is not in C order");
    let kind = match array.dtype() {
        DType::Plain(kind) => (kind.type_char(), kind.size_field()),
        other => bail!("its type is {}, expected numbers", other.descr()),
    };
    Ok(match kind {
        (TypeChar::Float, 4) => array.into_vec::<f32>()?.into_iter().map(f64::from).collect(),
        (TypeChar::Float, 8) => array.into_vec::<f64>()?,
        (TypeChar::Int, 8) => array.into_vec::<i64>()?.into_iter().map(|value| value as f64).collect(),
        (kind, bytes) => bail!("its type is {kind:?} of {bytes} bytes, expected f32, f64 or i64"),
    })
}
