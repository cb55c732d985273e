//! Lift of prescribed footprints: number of views, baselines, fields of view, world scale and origin, principal
//! planes, displacements, track noise, wrong views.

use glam::{DMat3, DVec3};
use rand::RngExt;
use splat::cameras::Camera;

use super::{
    judge::{FIELD, LIFT, Verdict, lone, table, together},
    prescribed::{Noise, Scene},
    scene::{Rig, Rigid, direction, discs, random},
};
use crate::row::Row;

/// A body of discs of 0.6 px, exactly tracked, that moves some 50 px.
pub(super) fn body(rig: Rig, count: usize, seed: u64) -> Scene {
    let mut random = random(seed);
    let half_width = rig.length_of(320.0);
    let radius = (0.15 * half_width).min(0.3 * rig.distance);
    let gaussians = discs(&mut random, count, rig.target, radius, rig.length_of(0.6));
    let degrees = random.random_range(1.0..20.0);
    let motion = Rigid::random(&mut random, rig.target, degrees, radius);
    Scene {
        gaussians,
        cameras: rig.cameras(),
        motion,
        noise: Noise::Independent(0.0),
        outliers: 0.0,
        stray: None,
        seed,
    }
}

/// A row for lone Gaussians and one for bodies, over the scenes that `alter` makes of the usual one.
fn pair(extreme: &'static str, rig: Rig, alter: impl Fn(&mut Scene) + Sync) -> [Verdict; 2] {
    let altered = |seed| {
        let mut scene = body(rig, 25, seed);
        alter(&mut scene);
        scene
    };
    [
        Verdict::of_seeds("motion: lift", extreme, LIFT, 8, |verdict, seed| lone(verdict, &altered(seed))),
        Verdict::of_seeds("motion: field", extreme, FIELD, 8, |verdict, seed| {
            together(verdict, &altered(seed))
        }),
    ]
}

fn rigs() -> Vec<(&'static str, Rig)> {
    let usual = Rig::USUAL;
    let views = |views| Rig { views, ..usual };
    let baseline = |views, baseline_degrees| Rig { views, baseline_degrees, ..usual };
    let field = |fov_degrees| Rig { fov_degrees, ..usual };
    let scale = |scale: f64| Rig { distance: usual.distance * scale, ..usual };
    let origin = |offset: f64| Rig { target: DVec3::new(0.6, -0.64, 0.48) * offset, ..usual };
    vec![
        ("0 views", views(0)),
        ("1 view", views(1)),
        ("2 views", views(2)),
        ("3 views", views(3)),
        ("12 views", views(12)),
        ("64 views", views(64)),
        ("baseline 0.05°, 2 views", baseline(2, 0.05)),
        ("baseline 0.05°, 12 views", baseline(12, 0.05)),
        ("baseline 0.5°, 3 views", baseline(3, 0.5)),
        ("baseline 5°, 3 views", baseline(3, 5.0)),
        ("baseline 120°, 2 views", baseline(2, 120.0)),
        ("baseline 180°, 2 views (opposite cameras)", baseline(2, 180.0)),
        ("baseline 180°, 3 views", baseline(3, 180.0)),
        ("identical cameras, 5 views", baseline(5, 0.0)),
        ("field of view 2°", field(2.0)),
        ("field of view 20°", field(20.0)),
        ("field of view 120°", field(120.0)),
        ("field of view 170°", field(170.0)),
        ("world units 1e-7 of the usual", scale(1e-7)),
        ("world units 1e-3 of the usual", scale(1e-3)),
        ("world units 1e4 of the usual", scale(1e4)),
        ("world origin 1e3 away", origin(1e3)),
        ("world origin 1e6 away", origin(1e6)),
    ]
}

fn noises() -> Vec<(&'static str, Rig, Noise)> {
    let usual = Rig::USUAL;
    let many = Rig { views: 64, ..usual };
    let narrow = Rig { views: 5, baseline_degrees: 0.05, ..usual };
    vec![
        ("independent noise 0.1 px", usual, Noise::Independent(0.1)),
        ("independent noise 1 px", usual, Noise::Independent(1.0)),
        ("independent noise 5 px", usual, Noise::Independent(5.0)),
        ("independent noise 5 px, 64 views", many, Noise::Independent(5.0)),
        ("independent noise 5 px, baseline 0.05°", narrow, Noise::Independent(5.0)),
        ("noise 0.1 px, alike over a footprint", usual, Noise::Alike(0.1)),
        ("noise 1 px, alike over a footprint", usual, Noise::Alike(1.0)),
        ("noise 5 px, alike over a footprint", usual, Noise::Alike(5.0)),
        ("noise 5 px, alike over a footprint, 64 views", many, Noise::Alike(5.0)),
    ]
}

/// Shares of the views whose track leads anywhere.
const OUTLIERS: [(&str, f64); 4] = [
    ("wrong tracks in 1 of 12 views", 0.1),
    ("wrong tracks in 3 of 12 views", 0.3),
    ("wrong tracks in 6 of 12 views", 0.5),
    ("wrong tracks in 8 of 12 views", 0.7),
];

/// Displacements of the whole body, pixels in the middle view; the image is 640 px wide.
const DISPLACEMENTS: [(&str, f64); 7] = [
    ("displacement 0", 0.0),
    ("displacement 0.1 px", 0.1),
    ("displacement 2 px", 2.0),
    ("displacement 150 px", 150.0),
    ("displacement 300 px (half leave the image)", 300.0),
    ("displacement of the image width (all leave the image: fallback)", 640.0),
    ("displacement of twice the image width (all leave the image: fallback)", 1280.0),
];

/// Displacements from one side of the image to the other, shares of its width, and the angle between the first and the last
/// of twelve views: those to the sides lose the body first.
const CROSSINGS: [(&str, f64, f64); 4] = [
    ("displacement of 0.8 image widths, all views keep it", 0.8, 10.0),
    ("displacement of 0.94 image widths, most views keep it", 0.94, 20.0),
    ("displacement of 0.97 image widths, few views keep it", 0.97, 20.0),
    ("displacement of 1.05 image widths, no view keeps it: fallback", 1.05, 20.0),
];

/// A body of 4 px radius that crosses the images from side to side.
fn crossing(share: f64) -> impl Fn(&mut Scene) + Sync {
    move |scene| {
        let rig = Rig::USUAL;
        let across = DVec3::Y * rig.length_of(640.0 * share);
        let mut random = random(scene.seed);
        scene.gaussians = discs(&mut random, 25, across * -0.5, rig.length_of(4.0), rig.length_of(0.6));
        let turned = Rigid::random(&mut random, across * -0.5, 10.0, 0.0);
        scene.motion = Rigid { shift: across, ..turned };
    }
}

/// Depth of the Gaussian before an additional camera, world units, before the motion.
const DEPTHS: [(&str, f64); 6] = [
    ("on the principal plane of a view", 0.0),
    ("1e-12 units before the principal plane of a view", 1e-12),
    ("1e-6 units before the principal plane of a view", 1e-6),
    ("0.01 units before the principal plane of a view", 1e-2),
    ("1e-9 units behind the principal plane of a view", -1e-9),
    ("1 unit behind a view", -1.0),
];

/// A camera that looks along +x and has `mean` at this depth, on its axis.
fn camera_at_depth(mean: DVec3, depth: f64, model: &Camera) -> Camera {
    // Rows are the camera's axes; a permutation of the world's, so that nothing is rounded.
    let rotation = DMat3::from_cols(DVec3::Z, DVec3::X, DVec3::Y);
    let eye = mean - DVec3::X * depth;
    Camera { rotation, translation: -(rotation * eye), ..model.clone() }
}

fn planes(extreme: &'static str, depth: f64) -> Verdict {
    Verdict::of_seeds("motion: lift", extreme, LIFT, 8, |verdict, seed| {
        let scene = body(Rig::USUAL, 25, seed);
        for index in 0..scene.gaussians.len() {
            let mut alone = Scene { gaussians: scene.gaussians.select(&[index]), ..scene.clone() };
            alone.cameras.push(camera_at_depth(alone.gaussians.mean(0), depth, &scene.cameras[0]));
            if index % 2 == 0 {
                // Straight ahead, so that the view keeps seeing it.
                alone.motion = Rigid { shift: DVec3::X * 0.5, ..Rigid::REST };
                alone.noise = Noise::Independent(if index % 4 == 0 { 0.5 } else { 0.0 });
            }
            together(verdict, &alone);
        }
    })
}

fn displacement(pixels: f64) -> impl Fn(&mut Scene) + Sync {
    move |scene| {
        let across = direction(&mut random(scene.seed)) * DVec3::new(0.1, 1.0, 1.0);
        let shift = across.normalize() * Rig::USUAL.length_of(pixels);
        scene.motion = Rigid { shift, ..Rigid::REST };
    }
}

/// Bodies of which every so many-th Gaussian is seen, all others being transparent, and the noise of their tracks.
const UNSEEN: [(&str, usize, f64); 4] = [
    ("every other Gaussian unseen", 2, 0.0),
    ("every other Gaussian unseen, noise 1 px", 2, 1.0),
    ("four of five Gaussians unseen", 5, 0.0),
    ("four of five Gaussians unseen, noise 1 px", 5, 1.0),
];

fn followers((extreme, seen, noise): (&'static str, usize, f64)) -> Verdict {
    Verdict::of_seeds("motion: field", extreme, FIELD, 8, |verdict, seed| {
        if seen > 2 && noise > 0.0 {
            verdict.expect_few();
        }
        let mut scene = body(Rig::USUAL, 25, seed);
        scene.noise = Noise::Independent(noise);
        for (index, opacity) in scene.gaussians.logit_opacities.iter_mut().enumerate() {
            *opacity = if index % seen == 0 { *opacity } else { -1e30 };
        }
        together(verdict, &scene);
    })
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let twelve = Rig { views: 12, ..Rig::USUAL };
    let mut rows = Vec::new();
    for (extreme, rig) in rigs() {
        rows.extend(pair(extreme, rig, |_| {}));
    }
    rows.extend(DEPTHS.map(|(extreme, depth)| planes(extreme, depth)));
    for (extreme, pixels) in DISPLACEMENTS {
        rows.extend(pair(extreme, Rig::USUAL, displacement(pixels)));
    }
    for (extreme, share, baseline_degrees) in CROSSINGS {
        rows.extend(pair(extreme, Rig { baseline_degrees, ..twelve }, crossing(share)));
    }
    for (extreme, rig, noise) in noises() {
        rows.extend(pair(extreme, rig, |scene| scene.noise = noise));
    }
    for (extreme, share) in OUTLIERS {
        rows.extend(pair(extreme, twelve, |scene| {
            (scene.outliers, scene.noise) = (share, Noise::Independent(0.3));
        }));
    }
    let followers = UNSEEN.map(followers);
    let led = followers.clone().map(|verdict| verdict.led);
    rows.extend(followers);
    [table(rows), led.into()].concat()
}
