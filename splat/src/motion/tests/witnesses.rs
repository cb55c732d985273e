//! Views that are sure of what is wrong, and what the other views make of it.

use glam::DVec2;

use super::*;
use crate::motion::sightings::Sightings;

/// How far the lying tracks are off, pixels; they claim 0.05.
const LIE: f32 = 8.0;
const CLAIM: f32 = 0.05;

fn lie(view: &mut MotionView, towards: [f32; 2]) {
    for [x, y] in &mut Arc::make_mut(&mut view.tracks).positions {
        (*x, *y) = (*x + LIE * towards[0], *y + LIE * towards[1]);
    }
}

/// Six views of a moving corner; those named lie, all alike, as what moves with a camera's picture does.
fn views_with_liars(liars: &[usize]) -> Vec<MotionView> {
    let mut views = views(&cameras(6), |x| turn().of(x), CLAIM);
    for &liar in liars {
        lie(&mut views[liar], [0.6, -0.8]);
    }
    views
}

#[test]
fn sure_liars_among_six_views_do_not_pull() {
    let gaussians = corner(150, 60);
    // The middle and the end of the arc; a pair side by side, whose lies nearly agree on a place.
    for liars in [&[2][..], &[5], &[0, 4], &[2, 3]] {
        let views = views_with_liars(liars);
        let settings = settings();
        let sightings = Sightings::gather(&DenseEngine, &gaussians, &views, &settings).unwrap();
        let verdicts = (0..150).filter_map(|gaussian| sightings.verdict(gaussian, |_| true));
        let (believed, lies): (usize, usize) = verdicts
            .map(|verdict| {
                let lies = verdict.believed.iter().filter(|&view| liars.contains(view)).count();
                (verdict.believed.len(), lies)
            })
            .fold((0, 0), |sum, of| (sum.0 + of.0, sum.1 + of.1));
        assert!(believed > 400 && 100 * lies < believed, "{liars:?}: {lies} lies among {believed} believed");

        let (position, _) = errors(&gaussians, &run(&gaussians, &views), turn(), MotionOrigin::Solved);
        assert!(position.len() > 120, "{liars:?}: {} solved", position.len());
        // A pixel is 0.05 units here: a lie that is believed is off by 0.4, one that pulls a sixth as hard as the others by 0.07.
        let ninth = position[position.len() * 9 / 10];
        assert!(ninth < 2e-3, "{liars:?}: 90 % within {ninth}");
    }
}

#[test]
fn sure_liars_do_not_move_what_rests() {
    let gaussians = corner(150, 61);
    let mut views = views(&cameras(6), |x| x, CLAIM);
    for liar in [1, 4] {
        lie(&mut views[liar], [0.6, -0.8]);
    }
    let field = run(&gaussians, &views);
    assert!(share(&field, MotionOrigin::Static) > 0.98, "{}", share(&field, MotionOrigin::Static));
}

/// What two of six cameras see of the surroundings of a point is all that is known of them, and the second is wrong about
/// it, in a direction of its picture that depends on the point.
fn views_of_a_contested_spot(spot: DVec3, radius: f64, towards: impl Fn(DVec3) -> DVec2) -> Vec<MotionView> {
    let mut views = views(&cameras(6), |x| turn().of(x), CLAIM);
    for (index, MotionView { camera, tracks }) in views.iter_mut().enumerate() {
        let tracks = Arc::make_mut(tracks);
        for pixel in 0..tracks.visible.len() {
            let (column, row) = (pixel as u32 % camera.width, pixel as u32 / camera.width);
            let on_spot = |x: &DVec3| x.distance(spot) < radius;
            let Some(point) = scenes::surface(camera, column, row).filter(on_spot) else { continue };
            tracks.visible[pixel] &= index < 2;
            if index == 1 {
                let [x, y] = &mut tracks.positions[pixel];
                let off = (towards(turn().of(point)) * f64::from(LIE)).as_vec2();
                (*x, *y) = (*x + off.x, *y + off.y);
            }
        }
    }
    views
}

/// The direction in the second camera's picture along which a point moves that the first sees at rest.
fn epipolar(point: DVec3) -> DVec2 {
    let rig = cameras(6);
    let farther = point + (point - rig[0].centre()) * 1e-3;
    let pixel = |x: DVec3| rig[1].project_world(x).unwrap();
    (pixel(farther) - pixel(point)).normalize()
}

#[test]
fn two_views_that_disagree_leave_it_to_the_neighbours() {
    let gaussians = corner(150, 62);
    let spot = DVec3::new(0.0, 0.9, 0.9);
    let nearest = |&a: &usize, &b: &usize| {
        let distance = |i: usize| gaussians.mean(i).distance(spot);
        distance(a).total_cmp(&distance(b))
    };
    let middle = (0..150).min_by(nearest).unwrap();
    let spot = gaussians.mean(middle);
    // Across the epipolar line the two contradict each other; along it they agree on a place that is wrong.
    let across = |point: DVec3| epipolar(point).perp();
    for (name, views) in [
        ("across", views_of_a_contested_spot(spot, 0.25, across)),
        ("along", views_of_a_contested_spot(spot, 0.25, epipolar)),
    ] {
        let settings = settings();
        let sightings = Sightings::gather(&DenseEngine, &gaussians, &views, &settings).unwrap();
        let seen: Vec<usize> = sightings.of(middle).map(|seen| seen.view).collect();
        assert_eq!(seen, [0, 1], "{name}");
        let verdict = sightings.verdict(middle, |_| true);
        match name {
            "across" => assert_eq!(verdict, None),
            _ => assert_eq!(verdict.unwrap().origin, MotionOrigin::Solved, "nothing of its own tells"),
        }
        let field = run(&gaussians, &views);
        assert_eq!(field.origin[middle], MotionOrigin::Propagated, "{name}");
        let error = (spot + field.translation[middle] - turn().of(spot)).length();
        // The lie is off by 0.4 units and more.
        assert!(error < 0.02, "{name}: {error}");
    }
}

#[test]
fn two_views_that_disagree_about_everything_are_not_believed() {
    let gaussians = corner(90, 63);
    let mut views = views(&cameras(2), |x| turn().of(x), CLAIM);
    lie(&mut views[1], [0.0, 1.0]);
    let field = run(&gaussians, &views);
    assert!(share(&field, MotionOrigin::Solved) < 0.05, "{}", share(&field, MotionOrigin::Solved));
}

#[test]
fn a_view_that_hardly_saw_it_is_no_witness_for_what_is_hidden_from_the_others() {
    let rig = cameras(6);
    let mut gaussians = corner(2, 64);
    // A plate a third of the way to the last camera lets a twentieth of the light through.
    let before = gaussians.mean(0).lerp(rig[5].centre(), 0.3);
    gaussians.means[1] = before.as_vec3().to_array();
    gaussians.log_scales[1] = [0.2f32.ln(); 3];
    gaussians.logit_opacities[1] = 19f32.ln();
    let shift = DVec3::new(0.0, 0.1, 0.0);
    let mut views = views(&rig, |x| x + shift, CLAIM);
    let settings = settings();
    let witnesses = |views: &[MotionView]| {
        let sightings = Sightings::gather(&DenseEngine, &gaussians, views, &settings).unwrap();
        [0, 1].map(|gaussian| sightings.of(gaussian).map(|seen| seen.view).collect::<Vec<_>>())
    };
    assert_eq!(witnesses(&views)[0], [0, 1, 2, 3, 4]);
    for view in &mut views[..5] {
        Arc::make_mut(&mut view.tracks).visible.fill(false);
    }
    assert_eq!(witnesses(&views), [vec![], vec![5]]);
    let field = run(&gaussians, &views);
    assert_eq!(field.information[0], DMat3::ZERO);
    // Where no view sees it better, one that looks through the plate is all there is.
    let [behind, _] = witnesses(&views[5..]);
    assert_eq!(behind, [0]);
}

#[test]
fn all_sightings_kept_give_the_motion_of_the_whole() {
    let gaussians = corner(120, 66);
    let mut views = views_with_liars(&[3]);
    scenes::add_noise(&mut views, 0.3, 67);
    let settings = settings();
    let sightings = Sightings::gather(&DenseEngine, &gaussians, &views, &settings).unwrap();
    let (kept, whole) = (sightings.field(|_, _| true).unwrap(), run(&gaussians, &views));
    assert_eq!(kept.origin, whole.origin);
    for (kept, whole) in kept.translation.iter().zip(&whole.translation) {
        // Neighbours are summed in another order.
        assert!((*kept - *whole).length() < 1e-9, "{kept} {whole}");
    }
    let none = sightings.field(|_, _| false).unwrap();
    assert_eq!(share(&none, MotionOrigin::Unsolved), 1.0);
}
