//! Who rests: by how many views, against which noise, and what neighbours have to say.

use super::*;
use crate::raster::CpuEngine;

/// The shipped engine, whose reweighting the dense one does not have.
fn estimated(gaussians: &Gaussians, views: &[MotionView], settings: &MotionSettings) -> MotionField {
    estimate(&CpuEngine::default(), gaussians, views, settings).unwrap()
}

#[test]
fn resting_gaussians_rest_even_if_tracks_err_by_twice_their_claim() {
    let gaussians = corner(150, 50);
    let mut noisy = views(&cameras(6), |x| x, 0.5);
    scenes::add_noise(&mut noisy, 1.0, 51);
    for view in &mut noisy {
        Arc::make_mut(&mut view.tracks).sigma.fill(0.5);
    }
    let field = estimated(&gaussians, &noisy, &settings());
    assert!(share(&field, MotionOrigin::Static) > 0.95, "{}", share(&field, MotionOrigin::Static));
}

#[test]
fn one_view_is_enough_to_rest_where_nobody_knows_better() {
    let gaussians = corner(60, 52);
    let field = estimated(&gaussians, &views(&cameras(1), |x| x, 0.05), &settings());
    assert_eq!(share(&field, MotionOrigin::Static), 1.0);
    assert_eq!(apply(&gaussians, &field), gaussians);
    let camera = &cameras(1)[0];
    for (index, information) in field.information.iter().enumerate() {
        let ray = (gaussians.mean(index) - camera.centre()).normalize();
        let along = ray.dot(*information * ray);
        assert!(along < 1e-9 * information.x_axis.length(), "{index}: {along} along the ray");
    }
}

#[test]
fn motion_along_the_only_ray_is_left_to_neighbours() {
    let gaussians = corner(150, 53);
    let rig = cameras(6);
    let forward = rig[0].rotation.transpose() * DVec3::Z;
    let slide = |x: DVec3| x + forward * 0.04;
    let mut views = views(&rig, slide, 0.05);
    let is_on_wall = |x: DVec3| x.x.abs() < 1e-9;
    // Only the first camera sees the wall x = 0.
    for view in &mut views[1..] {
        let (camera, field) = (&view.camera, Arc::make_mut(&mut view.tracks));
        for pixel in 0..field.visible.len() {
            let (column, row) = (pixel as u32 % camera.width, pixel as u32 / camera.width);
            field.visible[pixel] &= !scenes::surface(camera, column, row).is_some_and(is_on_wall);
        }
    }
    // So many that those at the crease count some beyond it.
    let settings = MotionSettings { neighbours: 60, ..settings() };
    let field = estimated(&gaussians, &views, &settings);
    let on_wall: Vec<usize> = (0..gaussians.len()).filter(|&i| is_on_wall(gaussians.mean(i))).collect();
    let frozen = on_wall.iter().filter(|&&i| field.origin[i] == MotionOrigin::Static).count();
    assert!(10 * frozen < on_wall.len(), "{frozen} of {} are frozen", on_wall.len());
    let mut errors: Vec<f64> =
        on_wall.iter().map(|&i| (field.translation[i] - forward * 0.04).length()).collect();
    errors.sort_by(f64::total_cmp);
    // A quarter of the motion; a frozen wall would be off by all of it.
    assert!(errors[errors.len() / 2] < 0.01, "median error {}", errors[errors.len() / 2]);
}

#[test]
fn a_few_biased_views_move_nobody() {
    let gaussians = corner(90, 54);
    let mut views = views(&cameras(12), |x| x, 0.05);
    for view in views.iter_mut().rev().take(3) {
        for [x, y] in &mut Arc::make_mut(&mut view.tracks).positions {
            (*x, *y) = (*x + 0.35, *y - 0.2);
        }
    }
    let field = estimated(&gaussians, &views, &settings());
    assert!(share(&field, MotionOrigin::Static) > 0.98, "{}", share(&field, MotionOrigin::Static));
}

#[test]
fn what_most_views_see_along_their_rays_moves_for_the_others() {
    let gaussians = corner(150, 55);
    let rig = cameras(6);
    // Two thirds of the cameras stand in one place.
    let rig = [0, 0, 0, 0, 2, 5].map(|k| rig[k].clone());
    let forward = rig[0].rotation.transpose() * DVec3::Z;
    let field = estimated(&gaussians, &views(&rig, |x| x + forward * 0.06, 0.05), &settings());
    let resting = share(&field, MotionOrigin::Static);
    assert!(resting < 0.05, "{resting} at rest");
}

#[test]
fn turning_footprints_of_noisier_tracks_than_claimed_keep_most_of_their_information() {
    let mut gaussians = corner(60, 56);
    gaussians.log_scales.iter_mut().for_each(|scales| *scales = [0.15f32.ln(), 0.15f32.ln(), 1e-3f32.ln()]);
    let truth = Rigid { turn: DQuat::from_rotation_z(0.25), shift: DVec3::ZERO };
    let claimed = |claim: f32| {
        let mut views = views(&cameras(6), |x| truth.of(x), 0.25);
        scenes::add_noise(&mut views, 0.25, 57);
        for view in &mut views {
            Arc::make_mut(&mut view.tracks).sigma.fill(claim);
        }
        super::super::observe::observe(&CpuEngine::default(), &gaussians, &views, &settings()).unwrap()
    };
    let median = |observed: Vec<Vec<super::super::observe::Observation>>| {
        let mut all: Vec<f64> = observed.iter().flatten().map(|seen| seen.fit.variance).collect();
        all.sort_by(f64::total_cmp);
        all[all.len() / 2]
    };
    let (honest, modest) = (median(claimed(0.25)), median(claimed(0.1)));
    // Reweighting takes pixels that turning moves off the mean for another surface's, two in three; the noise stays.
    assert!(modest < 4.0 * honest, "variance {modest} px² instead of {honest} px²");
}
