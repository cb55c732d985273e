//! Degenerate input: no panic, no NaN, and a stated fallback.

use super::*;

fn assert_finite(field: &MotionField, count: usize) {
    assert_eq!(
        [field.translation.len(), field.rotation.len(), field.origin.len(), field.information.len()],
        [count; 4]
    );
    assert!(field.translation.iter().all(|d| d.is_finite()));
    assert!(field.rotation.iter().all(|q| q.is_finite() && q.is_normalized()));
    assert!(field.information.iter().all(|h| h.is_finite()));
    assert_eq!(field.log_scale.len(), count);
    assert!(field.log_scale.iter().all(|s| s.abs().max_element() <= settings().max_log_strain));
}

#[test]
fn empty_set_and_no_views() {
    let none = run(&Gaussians::empty(0), &views(&cameras(2), |x| x, 0.1));
    assert_finite(&none, 0);
    assert!(apply(&Gaussians::empty(3), &none).is_empty());
    let gaussians = corner(12, 30);
    let unseen = run(&gaussians, &[]);
    assert_finite(&unseen, 12);
    assert_eq!(share(&unseen, MotionOrigin::Unsolved), 1.0);
    assert_eq!(apply(&gaussians, &unseen), gaussians);
}

#[test]
fn one_and_two_views() {
    let gaussians = corner(60, 31);
    let one = run(&gaussians, &views(&cameras(1), |x| turn().of(x), 0.05));
    assert_finite(&one, 60);
    assert_eq!(share(&one, MotionOrigin::Solved), 0.0);
    let two = run(&gaussians, &views(&cameras(2), |x| turn().of(x), 0.05));
    assert_finite(&two, 60);
    let (position, _) = errors(&gaussians, &two, turn(), MotionOrigin::Solved);
    assert!(position.len() > 25, "{}", position.len());
    assert!(position[position.len() / 2] < 5e-3, "{}", position[position.len() / 2]);
}

#[test]
fn all_tracks_invisible_or_not_a_number() {
    let gaussians = corner(30, 32);
    let mut blind = views(&cameras(3), |x| x, 0.1);
    for view in &mut blind {
        let field = Arc::make_mut(&mut view.tracks);
        field.positions.fill([f32::NAN, f32::INFINITY]);
        field.visible.fill(false);
    }
    let field = run(&gaussians, &blind);
    assert_finite(&field, 30);
    assert_eq!(share(&field, MotionOrigin::Unsolved), 1.0);
    // Tracks that claim to be visible all the same must not spread.
    for view in &mut blind {
        Arc::make_mut(&mut view.tracks).visible.fill(true);
    }
    assert_finite(&run(&gaussians, &blind), 30);
}

#[test]
fn gaussians_behind_on_and_far_from_the_cameras() {
    let mut gaussians = corner(60, 33);
    gaussians.means[0] = [40.0, 40.0, 1.0];
    gaussians.means[1] = cameras(3)[0].centre().as_vec3().to_array();
    gaussians.means[2] = [-1e6, -1e6, -1e6];
    gaussians.means[3] = [f32::NAN, 0.0, 0.0];
    let field = run(&gaussians, &views(&cameras(3), |x| turn().of(x), 0.05));
    assert_finite(&field, 60);
    for i in [0, 2, 3] {
        assert_eq!(field.origin[i], MotionOrigin::Unsolved, "{i}");
    }
    // The one on a camera has neighbours to follow, but nothing of its own.
    assert_ne!(field.origin[1], MotionOrigin::Solved);
}

#[test]
fn needles_dust_and_giants() {
    let mut gaussians = corner(90, 34);
    for i in 0..90 {
        gaussians.log_scales[i] = match i % 9 {
            0 => [-2.5, -16.0, -16.0],
            1 => [-16.0; 3],
            2 => [3.0, 3.0, -16.0],
            3 => [-40.0; 3],
            _ => gaussians.log_scales[i],
        };
    }
    gaussians.rotations[4] = [0.0; 4];
    gaussians.rotations[5] = [1e-20, 0.0, 1e-20, 0.0];
    let views = views(&cameras(4), |x| turn().of(x), 0.05);
    let field = run(&gaussians, &views);
    assert_finite(&field, 90);
    let moved = apply(&gaussians, &field);
    assert!(moved.means.iter().flatten().all(|c| c.is_finite()));
    assert!(moved.rotations.iter().flatten().all(|c| c.is_finite()));
    assert!(moved.sh.iter().all(|c| c.is_finite()));
}

#[test]
fn identical_gaussians_move_together() {
    let gaussians = corner(1, 35).select(&[0; 60]);
    let field = run(&gaussians, &views(&cameras(4), |x| turn().of(x), 0.05));
    assert_finite(&field, 60);
    let expected = turn().of(gaussians.mean(0)) - gaussians.mean(0);
    for (i, translation) in field.translation.iter().enumerate() {
        if field.origin[i] != MotionOrigin::Unsolved {
            assert!((*translation - expected).length() < 5e-3, "{i}: {translation} {expected}");
        }
    }
}

#[test]
fn tracks_of_another_size_are_refused() {
    let mut wrong = views(&cameras(1), |x| x, 0.1);
    wrong[0].camera.width = 95;
    let error = estimate(&DenseEngine, &corner(3, 36), &wrong, &settings()).unwrap_err();
    assert!(error.to_string().contains("96×64"), "{error}");
}

#[test]
fn far_world_origin_costs_no_accuracy() {
    // 2^10 units: means in single precision still resolve 1e-4.
    let far = DVec3::splat(1024.0);
    let mut gaussians = corner(60, 37);
    for mean in &mut gaussians.means {
        *mean = mean.map(|c| c + 1024.0);
    }
    let near_cameras = cameras(4);
    let mut shifted = views(&near_cameras, |x| turn().of(x), 0.05);
    for view in &mut shifted {
        view.camera.translation -= view.camera.rotation * far;
    }
    let field = run(&gaussians, &shifted);
    let mut errors: Vec<f64> = (0..60)
        .filter(|&i| field.origin[i] == MotionOrigin::Solved)
        .map(|i| {
            let mean = gaussians.mean(i) - far;
            (mean + field.translation[i] - turn().of(mean)).length()
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    assert!(errors.len() > 40 && errors[errors.len() / 2] < 1e-3, "{}", errors[errors.len() / 2]);
}
