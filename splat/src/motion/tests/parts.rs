//! The parts on their own: affine fits, positions, rotations.

use glam::{DMat2, DMat3, DVec2};

use super::{
    super::{
        fit2d, lift,
        rotation::{Deformation, Expectation, Member, fit_rigid_motion, lift_axes},
    },
    dense::{Blend, moments, weights},
    *,
};
use crate::tracking::TrackField;

fn affine_tracks(camera: &Camera, gradient: DMat2, shift: DVec2, sigma: f32) -> TrackField {
    let pixels = (0..camera.height).flat_map(|row| (0..camera.width).map(move |column| (column, row)));
    let positions: Vec<[f32; 2]> = pixels
        .map(|(column, row)| {
            let x = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
            (gradient * x + shift).as_vec2().to_array()
        })
        .collect();
    let count = positions.len();
    TrackField {
        width: camera.width,
        height: camera.height,
        positions,
        visible: vec![true; count],
        sigma: vec![sigma; count],
    }
}

#[test]
fn affine_field_gives_back_its_affine_map() {
    let gradient = DMat2::from_cols(DVec2::new(1.04, 0.17), DVec2::new(-0.21, 0.93));
    let shift = DVec2::new(7.5, -3.25);
    let (gaussians, camera) = (corner(60, 1), &cameras(1)[0]);
    let tracks = affine_tracks(camera, gradient, shift, 1e-4);
    let mut fitted = 0;
    for (i, blend) in weights(&gaussians, camera).iter().enumerate() {
        let mean = camera.project_world(gaussians.mean(i)).unwrap();
        let Some(fit) = fit2d::fit(&moments(blend, &tracks), mean, &settings()) else { continue };
        fitted += 1;
        let target = gradient * mean + shift;
        // Tracks are stored in single precision, 4e-6 px at this size.
        assert!((fit.target - target).length() < 2e-5, "{i}: {} {target}", fit.target);
        let error = fit.gradient - gradient;
        assert!(error.x_axis.length().max(error.y_axis.length()) < 2e-5, "{i}: {error}");
    }
    assert!(fitted > 50, "{fitted}");
}

#[test]
fn noisy_small_footprints_are_fitted_as_translations() {
    let (mut gaussians, camera) = (corner(30, 2), &cameras(1)[0]);
    gaussians.log_scales.fill([-9.0; 3]); // a tenth of a millipixel: only the low-pass filter remains
    let still = Rigid { shift: DVec3::new(0.1, 0.0, 0.05), ..Rigid::REST };
    let mut noisy = views(std::slice::from_ref(camera), |x| still.of(x), 1.0);
    scenes::add_noise(&mut noisy, 1.0, 9);
    for (i, blend) in weights(&gaussians, camera).iter().enumerate() {
        let mean = camera.project_world(gaussians.mean(i)).unwrap();
        let Some(fit) = fit2d::fit(&moments(blend, &noisy[0].tracks), mean, &settings()) else {
            continue;
        };
        let strain = fit.gradient - DMat2::IDENTITY;
        // An unregularised fit of 0.3 px² under 1 px of noise would be off by about one.
        assert!(strain.x_axis.length().max(strain.y_axis.length()) < 0.5, "{i}: {strain}");
        assert!(fit.variance > 0.1 && fit.variance < 4.0, "{}", fit.variance);
    }
}

#[test]
fn far_displacements_are_triangulated() {
    let rig = cameras(8);
    let (from, to) = (DVec3::new(0.2, 0.3, 0.1), DVec3::new(1.1, 0.9, 0.6));
    for count in [2, 3, 8] {
        let sightings: Vec<lift::Sighting<'_>> = rig[..count]
            .iter()
            .map(|camera| lift::Sighting {
                camera,
                pixel: camera.project_world(to).unwrap(),
                variance: 0.01,
                doubt: 0.0,
            })
            .collect();
        let lift = lift::solve(&sightings, from, &settings()).unwrap();
        assert!((from + lift.translation - to).length() < 1e-6, "{count}: {}", lift.translation);
        assert!(lift.is_determined);
    }
}

#[test]
fn few_views_say_what_they_know() {
    let rig = cameras(2);
    let (from, to) = (DVec3::splat(0.3), DVec3::new(0.4, 0.35, 0.2));
    assert_eq!(lift::solve(&[], from, &settings()), None);
    let sighting = |camera| lift::Sighting {
        camera,
        pixel: rig[0].project_world(to).unwrap(),
        variance: 0.01,
        doubt: 0.0,
    };
    for same in [vec![sighting(&rig[0])], vec![sighting(&rig[0]), sighting(&rig[0])]] {
        let lift = lift::solve(&same, from, &settings()).unwrap();
        assert!(!lift.is_determined, "depth is not seen");
        let ray = (to - rig[0].centre()).normalize();
        assert!(ray.dot(lift.information * ray) < 1e-6 * lift.information.x_axis.length());
        // Across the ray the position is exact; along it the old depth stays.
        let across = from + lift.translation - to;
        assert!((across - ray * across.dot(ray)).length() < 1e-3, "{across}");
    }
}

#[test]
fn contradicting_pair_is_refused() {
    let rig = cameras(2);
    let to = DVec3::splat(0.4);
    let wrong = rig[1].project_world(to).unwrap() + DVec2::new(0.0, 20.0);
    let sightings = [(&rig[0], rig[0].project_world(to).unwrap()), (&rig[1], wrong)]
        .map(|(camera, pixel)| lift::Sighting { camera, pixel, variance: 0.01, doubt: 0.0 });
    assert_eq!(lift::solve(&sightings, DVec3::splat(0.3), &settings()), None);
}

#[test]
fn neighbours_and_axes_find_large_rotations() {
    for degrees in [0.5, 20.0, 90.0, 120.0] {
        let axis = DVec3::new(1.0, 2.0, -0.5).normalize();
        let truth = DQuat::from_axis_angle(axis, f64::to_radians(degrees));
        let members: Vec<Member> = (0..8)
            .map(|k| {
                let angle = f64::from(k) * 2.4;
                let offset = DVec3::new(angle.cos(), angle.sin(), 0.2 * angle.sin() * angle) * 0.1;
                Member {
                    offset,
                    translation: DVec3::X + truth * offset - offset,
                    information: DMat3::from_diagonal(DVec3::new(1e8, 1e8, 1e6)),
                    affinity: 1.0,
                }
            })
            .chain([Member {
                offset: DVec3::ZERO,
                translation: DVec3::X,
                information: DMat3::from_diagonal(DVec3::splat(1e8)),
                affinity: 1.0,
            }])
            .collect();
        let motion =
            fit_rigid_motion(&members, &[], &Expectation::unturned(DVec3::X, &settings()), 0.1, &settings());
        let error = motion.rotation.angle_between(truth).to_degrees();
        assert!(error < 0.05, "{degrees}°: {error}°");
        assert!((motion.translation - DVec3::X).length() < 1e-4);
    }
}

#[test]
fn flat_gaussian_alone_turns_by_its_footprints() {
    let (gaussians, rig, truth) = (corner(30, 5), cameras(6), turn());
    let fits: Vec<Vec<Option<fit2d::Fit>>> = rig
        .iter()
        .map(|camera| {
            let tracks = scenes::tracks(camera, |x| truth.of(x), 0.01);
            let fit = |(i, blend): (usize, &Blend)| {
                let mean = camera.project_world(gaussians.mean(i)).unwrap();
                fit2d::fit(&moments(blend, &tracks), mean, &settings())
            };
            weights(&gaussians, camera).iter().enumerate().map(fit).collect()
        })
        .collect();
    let mut errors = Vec::new();
    for i in 0..gaussians.len() {
        let seen: Vec<Deformation<'_>> = rig
            .iter()
            .zip(&fits)
            .filter_map(|(camera, fits)| Some(Deformation { camera, fit: fits[i].as_ref()? }))
            .collect();
        let translation = truth.of(gaussians.mean(i)) - gaussians.mean(i);
        let axes = lift_axes(&gaussians, i, translation, &seen);
        assert_eq!(axes.len(), 2);
        let motion =
            fit_rigid_motion(&[], &axes, &Expectation::unturned(translation, &settings()), 0.1, &settings());
        errors.push(motion.rotation.angle_between(truth.turn).to_degrees());
    }
    errors.sort_by(f64::total_cmp);
    // Six degrees without any lift.
    assert!(errors[errors.len() / 2] < 0.3, "median {}°", errors[errors.len() / 2]);
}
