//! The scenes of the benchmarks, generated and read.
#![allow(clippy::unwrap_used, reason = "tests")]

#[path = "../benches/scene/mod.rs"]
mod scene;

use std::path::Path;

use npyz::WriterBuilder;
use scene::{Scene, SceneSize, generate, read};
use splat::raster::pair_counts;

const SIZE: SceneSize = SceneSize { gaussians: 2000, width: 64, height: 36, sh_degree: 3 };

#[test]
fn a_scene_is_the_same_each_time() {
    assert_eq!(generate(SIZE), generate(SIZE));
    assert_ne!(generate(SIZE), generate(SceneSize { gaussians: 2001, ..SIZE }));
    assert_eq!(generate(SIZE).size(), SIZE);
}

#[test]
fn the_degree_changes_the_harmonics_alone() {
    let (full, flat) = (generate(SIZE), generate(SceneSize { sh_degree: 0, ..SIZE }));
    assert_eq!(full.gaussians.means, flat.gaussians.means);
    assert_eq!(full.gaussians.log_scales, flat.gaussians.log_scales);
    assert_eq!(full.gaussians.sh_of(7)[..3], *flat.gaussians.sh_of(7));
    assert_eq!(full.gaussians.sh.len(), 2000 * 48);
    assert_eq!(full.target, flat.target);
}

#[test]
fn gaussians_are_distributed_as_stated() {
    let scene = generate(SceneSize { gaussians: 20_000, ..SIZE });
    let set = &scene.gaussians;
    let moments = |values: Vec<f64>| {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let variance = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64;
        (mean, variance.sqrt())
    };
    // Standard errors of 20 000 draws are below a hundredth of each spread; the bounds are about five of them.
    let (mean, spread) = moments(set.logit_opacities.iter().map(|&value| value.into()).collect());
    assert!(mean.abs() < 0.055 && (spread - 1.5).abs() < 0.04, "opacity {mean} {spread}");
    let (mean, spread) = moments(set.log_scales.iter().map(|scales| scales[0].into()).collect());
    let expected = (0.02 * 2.5f64.sqrt()).ln();
    assert!((mean - expected).abs() < 0.02, "log scale {mean}, not {expected}");
    assert!((spread - 0.4 * 2f64.sqrt()).abs() < 0.015, "log scale spread {spread}");
    let (mean, spread) = moments(set.means.iter().map(|mean| mean[2].into()).collect());
    assert!(
        (mean - 4.0).abs() < 0.045 && (spread - 4.0 / 12f64.sqrt()).abs() < 0.03,
        "depth {mean} {spread}"
    );
    assert!(scene.target.pixels.iter().all(|value| (0.0..=1.0).contains(value)));
}

#[test]
fn overdraw_does_not_depend_on_the_number() {
    // The published scene blends 64 per pixel with 10 000 Gaussians and 68 with 50 000, at 320x180; other draws and a
    // smaller image come close to that.
    for gaussians in [5000, 20_000] {
        let scene = generate(SceneSize { gaussians, width: 160, height: 90, sh_degree: 0 });
        let blended = pair_counts(&scene.gaussians, &scene.camera).blended_pairs;
        let per_pixel = blended as f64 / (160.0 * 90.0);
        assert!((55.0..75.0).contains(&per_pixel), "{per_pixel} per pixel with {gaussians}");
    }
}

/// One array of a file: name, shape, values.
type Array = (&'static str, &'static [u64], Vec<f32>);

fn write(path: &Path, arrays: &[Array], size: Option<[i64; 2]>) {
    let mut archive = npyz::npz::NpzWriter::new(std::fs::File::create(path).unwrap());
    for (name, shape, values) in arrays {
        let writer = archive.array(name, Default::default()).unwrap().default_dtype();
        let mut array = writer.shape(shape).begin_nd().unwrap();
        array.extend(values.iter().copied()).unwrap();
        array.finish().unwrap();
    }
    if let Some(size) = size {
        let writer = archive.array("size", Default::default()).unwrap().default_dtype();
        let mut array = writer.shape(&[2]).begin_nd().unwrap();
        array.extend(size).unwrap();
        array.finish().unwrap();
    }
}

/// Two Gaussians, one image of 4x3, values that single precision holds, and a pose that a transposition would change.
fn tiny() -> Scene {
    let mut scene = generate(SceneSize { gaussians: 2, width: 4, height: 3, sh_degree: 1 });
    scene.camera.fx = 3.25;
    scene.camera.fy = 3.5;
    scene.camera.rotation = glam::DMat3::from_cols_array(&[0., 1., 0., -1., 0., 0., 0., 0., 1.]);
    scene.camera.translation = glam::DVec3::new(0.5, -0.25, 2.0);
    scene
}

fn arrays(scene: &Scene) -> Vec<Array> {
    let (set, camera) = (&scene.gaussians, &scene.camera);
    let pose = vec![0., -1., 0., 0.5, 1., 0., 0., -0.25, 0., 0., 1., 2., 0., 0., 0., 1.];
    let intrinsics = [camera.fx, camera.fy, camera.cx, camera.cy].map(|value| value as f32).to_vec();
    vec![
        ("mean", &[2, 3], set.means.as_flattened().to_vec()),
        ("rotation", &[2, 4], set.rotations.as_flattened().to_vec()),
        ("log_scale", &[2, 3], set.log_scales.as_flattened().to_vec()),
        ("logit_opacity", &[2], set.logit_opacities.clone()),
        ("sh", &[2, 4, 3], set.sh.clone()),
        ("w2c", &[4, 4], pose),
        ("intrinsics", &[4], intrinsics),
        ("target", &[3, 4, 3], scene.target.pixels.clone()),
    ]
}

#[test]
fn a_scene_file_is_read_as_it_was_written() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.npz");
    let scene = tiny();
    write(&path, &arrays(&scene), Some([4, 3]));
    assert_eq!(read(&path).unwrap(), scene);
}

#[test]
fn a_file_that_is_no_scene_is_refused_with_its_name_and_the_array() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("broken.npz");
    let refused = |what: &str| {
        let message = format!("{:#}", read(&path).unwrap_err());
        assert!(message.contains("broken.npz") && message.contains(what), "{message}");
    };
    refused("cannot open");
    std::fs::write(&path, b"no archive").unwrap();
    refused("not an npz");
    let whole = arrays(&tiny());
    write(&path, &whole, None);
    refused("`size` is missing");
    write(&path, &whole, Some([3, 4]));
    refused("`target` has shape [3, 4, 3], expected [4, 3, 3]");
    write(&path, &whole, Some([-4, 3]));
    refused("`size` is -4 by 3");
    write(&path, &whole[1..], Some([4, 3]));
    refused("`mean` is missing");
    let mut five = whole;
    five[4] = ("sh", &[2, 5, 3], vec![0.0; 30]);
    write(&path, &five, Some([4, 3]));
    refused("5 coefficients");
}
