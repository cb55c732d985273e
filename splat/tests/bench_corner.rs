//! The corner of the benchmarks of motion compensation.
#![allow(clippy::unwrap_used, reason = "tests")]

#[path = "../benches/corner/mod.rs"]
mod corner;
#[path = "../benches/lift_table/fits.rs"]
#[allow(dead_code, reason = "the benchmark uses the rest")]
mod fits;

use corner::{Motion, arc, gaussians, tracks};
use fits::NoisyFits;
use glam::{DMat2, DMat3, DVec2, DVec3};
use splat::engine::Engine;

const IMAGE: (u32, u32) = (160, 90);

#[test]
fn every_camera_sees_the_corner() {
    let gaussians = gaussians(300, 1);
    for camera in arc(12, 40.0, IMAGE) {
        assert!((0..300).all(|index| camera.contains(camera.project_world(gaussians.mean(index)).unwrap())));
    }
}

#[test]
fn tracks_follow_the_motion_of_the_walls() {
    let camera = &arc(3, 20.0, IMAGE)[0];
    for motion in [Motion::Rigid, Motion::Bend] {
        let field = tracks(camera, motion, None, 0.1);
        let mut followed = 0;
        for index in (0..300).filter(|index| index % 3 == 2) {
            // On the floor, which nothing hides.
            let mean = gaussians(300, 2).mean(index);
            let [from, to] = [mean, motion.of(mean)].map(|x| camera.project_world(x).unwrap());
            let pixel = from.y as usize * 160 + from.x as usize;
            let [x, y] = field.positions[pixel].map(f64::from);
            let centre = DVec2::new(from.x.floor() + 0.5, from.y.floor() + 0.5);
            // Up to half a pixel beside the mean: the motion's gradient is close to the identity.
            let error = DVec2::new(x, y) - centre - (to - from);
            followed += usize::from(error.length() < 0.35);
        }
        assert!(followed > 90, "{followed} of 100");
    }
    let still = tracks(camera, Motion::Rigid, Some(1), 0.1);
    let stays = |&(pixel, [x, y]): &(usize, &[f32; 2])| {
        (*x, *y) == ((pixel % 160) as f32 + 0.5, (pixel / 160) as f32 + 0.5)
    };
    let at_rest = still.positions.iter().enumerate().filter(stays).count();
    assert!((3000..13_000).contains(&at_rest), "{at_rest} of {}", 160 * 90);
}

#[test]
fn surfaces_turn_with_the_motion() {
    let point = DVec3::new(0.3, 0.9, 1.2);
    let rigid = Motion::Rigid.turn(point, DVec3::X);
    assert!((rigid.to_axis_angle().1.to_degrees() - 8.0).abs() < 1e-6);
    assert!((Motion::Rigid.gradient(point) - DMat3::from_quat(rigid)).x_axis.length() < 1e-8);
    for normal in DVec3::AXES {
        // The turned normal stays at right angles to what the tangents become.
        let turned = Motion::Bend.turn(point, normal) * normal;
        let (u, v) = normal.any_orthonormal_pair();
        let gradient = Motion::Bend.gradient(point);
        assert!(turned.dot(gradient * u).abs() < 1e-6 && turned.dot(gradient * v).abs() < 1e-6);
    }
}

#[test]
fn moments_without_noise_have_the_motion_of_the_surface_and_noise_has_its_deviation() {
    let (mut set, camera) = (gaussians(600, 3), arc(1, 0.0, (640, 360)));
    for scales in &mut set.log_scales {
        scales[2] = -12.0;
    }
    for noise in [0.0, 0.1] {
        let engine = NoisyFits::new(&set, &camera, Motion::Bend, noise, 3).unwrap();
        let tracks = engine.tracks().next().unwrap();
        let moments = engine.footprint_moments(&set, &camera[0], &tracks, None).unwrap();
        let (mut squares, mut shifts) = (0.0, 0.0);
        for (index, m) in moments.iter().enumerate() {
            let [uu, uv, vv] = m.source;
            let source = DMat2::from_cols(DVec2::new(uu, uv), DVec2::new(uv, vv));
            let [xx, xy, yx, yy] = m.cross;
            let gradient = DMat2::from_cols(DVec2::new(xx, yx), DVec2::new(xy, yy)) * source.inverse();
            // The image of a step along the wall.
            let step = set.rotation(index) * DVec3::X * 1e-5;
            let at = |x: DVec3| camera[0].project_world(x).unwrap();
            let mean = set.mean(index);
            let before = (at(mean + step) - at(mean - step)).normalize();
            let length = (at(mean + step) - at(mean - step)).length();
            let after = (at(Motion::Bend.of(mean + step)) - at(Motion::Bend.of(mean - step))) / length;
            let error = gradient * before - after;
            let target = at(Motion::Bend.of(mean));
            let radius = (source.determinant() / m.weight.powi(2)).powf(0.25);
            squares += error.length_squared() / 1200.0;
            shifts += (DVec2::from_array(m.tracked_centroid) - target).length_squared()
                / (1200.0 * radius * radius);
        }
        let [gradient, shift] = [squares, shifts].map(f64::sqrt);
        // 1200 draws: 2 % of their deviation, five times over.
        assert!((gradient - noise).abs() < 0.1 * noise + 1e-5, "{noise}: {gradient}");
        assert!((shift - noise).abs() < 0.1 * noise + 1e-9, "{noise}: {shift}");
    }
}
