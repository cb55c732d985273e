//! Small seeded scenes at the extremes of every input of the rasterizer.

use glam::{DMat3, DVec3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use splat::{cameras::Camera, gaussians::Gaussians};

/// What a renderer is given.
#[derive(Clone)]
pub(crate) struct Scene {
    pub gaussians: Gaussians,
    pub camera: Camera,
    pub background: [f32; 3],
}

/// Scenes that sweep one input over its range.
pub(crate) struct Extreme {
    pub name: &'static str,
    pub scenes: Vec<Scene>,
}

const WIDTH: u32 = 26;
const HEIGHT: u32 = 19;
/// Distance of the camera from the middle of the scene.
const DISTANCE: f64 = 4.0;
/// Focal length, pixels.
const FOCAL: f64 = 30.0;
const COUNT: usize = 12;

/// Looks along z at the origin from [`DISTANCE`] units away.
pub(crate) fn camera(width: u32, height: u32, focal: f64) -> Camera {
    Camera {
        width,
        height,
        fx: focal,
        fy: 1.03 * focal,
        cx: 0.48 * f64::from(width),
        cy: 0.53 * f64::from(height),
        rotation: DMat3::IDENTITY,
        translation: DVec3::new(0.0, 0.0, DISTANCE),
    }
}

/// Coloured Gaussians of many shapes and opacities before the camera, spherical harmonics of degree 1.
pub(crate) fn blobs(count: usize, seed: u64) -> Gaussians {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut draw = |low: f32, high: f32| random.random_range(low..high);
    let mut gaussians = Gaussians::empty(1);
    for _ in 0..count {
        gaussians.means.push([draw(-1.2, 1.2), draw(-0.9, 0.9), draw(-1.0, 1.0)]);
        gaussians.rotations.push(std::array::from_fn(|_| draw(-1.0, 1.0)));
        gaussians.log_scales.push(std::array::from_fn(|_| draw(-3.0, -0.5)));
        gaussians.logit_opacities.push(draw(-2.0, 3.0));
        gaussians.sh.extend((0..12).map(|k| if k < 3 { draw(-1.0, 1.5) } else { draw(-0.3, 0.3) }));
    }
    gaussians
}

fn scene(seed: u64) -> Scene {
    Scene { gaussians: blobs(COUNT, seed), camera: camera(WIDTH, HEIGHT, FOCAL), background: [0.2, 0.1, 0.3] }
}

/// Scenes per value of a sweep.
const SEEDS: u64 = 4;

/// Scenes for every value, changed by `change`.
fn sweep<T: Copy>(name: &'static str, values: &[T], change: impl Fn(&mut Scene, T)) -> Extreme {
    let changed = |(place, &value): (usize, &T)| {
        let seeds = (0..SEEDS).map(|seed| 100 + SEEDS * place as u64 + seed);
        let scenes = seeds.map(|seed| {
            let mut scene = scene(seed);
            change(&mut scene, value);
            scene
        });
        scenes.collect::<Vec<_>>()
    };
    Extreme { name, scenes: values.iter().enumerate().flat_map(changed).collect() }
}

/// Scenes without anything extreme about them.
pub(crate) fn typical() -> Extreme {
    sweep("nothing extreme", &[0; 6], |_, _| {})
}

/// Every extreme of which the result is determined by the equations.
pub(crate) fn extremes() -> Vec<Extreme> {
    vec![
        footprints(),
        aspects_by_thinning(),
        aspects_by_length(),
        scales(),
        offsets(),
        fields_of_view(),
        plane(),
        opacities(),
        norms(),
        harmonics(),
        ties(),
        identical(),
        sizes(),
        numbers(),
    ]
}

fn footprints() -> Extreme {
    let pixels = [0.05, 0.3, 1.0, 5.0, 25.0, 200.0];
    sweep("footprints of 0.05 pixels to 8 × the image", &pixels, |scene, pixels: f64| {
        for scales in &mut scene.gaussians.log_scales {
            *scales = scales.map(|scale| (pixels * DISTANCE / FOCAL).ln() as f32 + 0.2 * (scale + 1.7));
        }
    })
}

fn aspects_by_thinning() -> Extreme {
    let aspects = [1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6];
    sweep("aspect ratio 1 to 1e6, by thinning", &aspects, |scene, aspect: f64| {
        for scales in &mut scene.gaussians.log_scales {
            let (long, thin) = (0.5_f64.ln(), (0.5 / aspect).ln());
            *scales = [long as f32, thin as f32, thin as f32];
        }
    })
}

fn aspects_by_length() -> Extreme {
    let aspects = [1.0, 1e1, 1e2, 1e3, 1e4, 1e5, 1e6];
    sweep("aspect ratio 1 to 1e6, by lengthening to 400 000 pixels", &aspects, by_length)
}

fn by_length(scene: &mut Scene, aspect: f64) {
    for (place, scales) in scene.gaussians.log_scales.iter_mut().enumerate() {
        let (long, thin) = ((0.05 * aspect).ln() as f32, 0.05_f32.ln());
        *scales = if place % 2 == 0 { [thin, long, thin] } else { [long, thin, long] };
    }
}

fn scales() -> Extreme {
    let scales = [1e-7, 1e-5, 1e-3, 1e-1, 1e1, 1e3, 1e4];
    sweep("scales of 1e-7 to 1e4 world units", &scales, |scene, scale: f64| {
        for scales in &mut scene.gaussians.log_scales {
            *scales = scales.map(|value| scale.ln() as f32 + 0.3 * (value + 1.7));
        }
    })
}

/// The camera is where it would be without the offset, so that what is lost lies in the single-precision means, which
/// both sides share.
fn offsets() -> Extreme {
    sweep("world origin 0 to 1e6 units away", &[0.0, 1e2, 1e4, 1e6], |scene, offset: f64| {
        let offset = DVec3::new(offset, -0.7 * offset, 0.4 * offset);
        for mean in &mut scene.gaussians.means {
            let moved = DVec3::new(mean[0].into(), mean[1].into(), mean[2].into()) + offset;
            *mean = moved.as_vec3().to_array();
        }
        scene.camera.translation -= scene.camera.rotation * offset;
    })
}

fn fields_of_view() -> Extreme {
    let degrees = [2.0, 10.0, 60.0, 120.0, 150.0, 170.0];
    sweep("field of view 2° to 170°", &degrees, |scene, degrees: f64| {
        let focal = 0.5 * f64::from(WIDTH) / (degrees.to_radians() / 2.0).tan();
        (scene.camera.fx, scene.camera.fy) = (focal, focal);
        // As far to the sides as the view is wide.
        let share = (FOCAL / focal).min(3.0);
        for mean in &mut scene.gaussians.means {
            (mean[0], mean[1]) = ((f64::from(mean[0]) * share) as f32, (f64::from(mean[1]) * share) as f32);
        }
    })
}

fn plane() -> Extreme {
    let depths = [-1.0, -1e-6, 0.0, 1e-6, 0.0099, 0.01, 0.0101, 0.02, 0.1];
    sweep(
        "means behind, on and just before the camera's plane and the near plane",
        &depths,
        |scene, z: f64| {
            for (place, mean) in
                scene.gaussians.means.iter_mut().enumerate().filter(|(place, _)| place % 3 != 0)
            {
                let side = z.abs().max(1e-3) as f32;
                *mean = [
                    side * (place as f32 * 0.7).sin(),
                    side * (place as f32 * 1.1).cos(),
                    (z - DISTANCE) as f32,
                ];
            }
        },
    )
}

fn opacities() -> Extreme {
    let logits = [-50.0, -20.0, -6.0, -5.54, -5.5, 0.0, 4.6, 10.0, 20.0, 50.0];
    sweep("logits of the opacity −50 to 50 (opacity 0 to 1)", &logits, |scene, logit: f64| {
        for (place, value) in scene.gaussians.logit_opacities.iter_mut().enumerate() {
            *value = if place % 4 == 3 { *value } else { logit as f32 };
        }
    })
}

fn norms() -> Extreme {
    let norms = [1e-20, 1e-10, 1e-3, 1.0, 1e3, 1e10, 1e20];
    sweep("quaternion norms 1e-20 to 1e20", &norms, |scene, norm: f64| {
        for rotation in &mut scene.gaussians.rotations {
            *rotation = rotation.map(|value| (f64::from(value) * norm) as f32);
        }
    })
}

fn harmonics() -> Extreme {
    let cases = [(0, 1.0), (1, 1e-6), (2, 1.0), (3, 1.0), (3, 1e3), (3, 1e6)];
    sweep("harmonics of degree 0 to 3, coefficients of 1e-6 to 1e6", &cases, |scene, (degree, size)| {
        let set = &mut scene.gaussians;
        let count = 3 * (degree as usize + 1).pow(2);
        set.sh_degree = degree;
        set.sh = (0..COUNT * count).map(|k| size * (k as f32 * 7.3 + set.means[0][0]).sin()).collect();
    })
}

fn ties() -> Extreme {
    sweep("all means at one depth", &[0.0, 1.0, -0.5], |scene, z: f64| {
        for mean in &mut scene.gaussians.means {
            mean[2] = z as f32;
        }
    })
}

fn identical() -> Extreme {
    sweep("300 identical Gaussians, faint to opaque", &[-4.0, -2.0, 0.0, 4.0, 50.0], |scene, logit: f64| {
        scene.gaussians = scene.gaussians.select(&[0; 300]);
        scene.gaussians.means.fill([0.05, 0.02, 0.0]);
        scene.gaussians.logit_opacities.fill(logit as f32);
    })
}

fn sizes() -> Extreme {
    let sizes = [(1, 1), (17, 13), (3, 200), (1, 4096), (8192, 1)];
    sweep("images of 1×1, 17×13, 3×200, 1×4096 and 8192×1 pixels", &sizes, |scene, (width, height)| {
        scene.camera = camera(width, height, 0.6 * f64::from(width.max(height)));
    })
}

fn numbers() -> Extreme {
    sweep("no Gaussian, one, 2000", &[0, 1, 2000], |scene, count: usize| {
        scene.gaussians = blobs(count, 7);
    })
}

/// So many Gaussians on one spot that their lists are as long as the set: nearly transparent ones, all of which a pixel
/// blends, and opaque ones, of which it blends two. The image is square.
pub(crate) fn pile(name: &'static str, count: usize, side: u32) -> Extreme {
    let pile = |logit: f32| {
        let mut random = ChaCha8Rng::seed_from_u64(5);
        let mut gaussians = blobs(1, 5).select(&vec![0; count]);
        for (index, mean) in gaussians.means.iter_mut().enumerate() {
            *mean = [0.02, -0.01, (index % 977) as f32 * 1e-3];
        }
        gaussians.log_scales.fill([-2.0, -2.5, -3.0]);
        gaussians.logit_opacities.fill_with(|| logit + random.random_range(0.0..0.1));
        Scene { gaussians, camera: camera(side, side, 6.0), background: [0.1, 0.2, 0.4] }
    };
    Extreme { name, scenes: [-5.52, 0.0, 9.0].map(pile).into() }
}
