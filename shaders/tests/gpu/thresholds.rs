//! Pixels on which the engines differ are those on which single precision cannot decide.

use splat::{
    cameras::Camera,
    engine::Engine,
    gaussians::Gaussians,
    raster::{CpuEngine, pair_counts},
};

use crate::{
    doubts::{Decision, Doubts},
    scene::{SceneSize, generate},
    support::{arc, blobs, engine},
};

const BLACK: [f32; 3] = [0.0; 3];

/// Without a difference in any decision, values differ by some units in the last place of 1: a tenth of what the other tests
/// let pass, so that the effect of a footprint of 1/255 is seen through all but the last thousandth of transmittance.
const CLOSE: f32 = 2e-6;

/// Returns how many pixels differ.
fn assert_only_doubtful_pixels_differ(name: &str, gaussians: &Gaussians, camera: &Camera) -> usize {
    let Some(gpu) = engine() else { return 0 };
    let doubts = Doubts::new(gaussians, camera);
    let ours = gpu.render(gaussians, camera, BLACK).unwrap();
    let theirs = CpuEngine::default().render(gaussians, camera, BLACK).unwrap();
    let mut differing = 0;
    for pixel in 0..ours.alpha.len() {
        let off =
            |ours: &[f32], theirs: &[f32]| ours.iter().zip(theirs).any(|(a, b)| !((a - b).abs() < CLOSE));
        let colour = 3 * pixel..3 * pixel + 3;
        if off(&ours.image.pixels[colour.clone()], &theirs.image.pixels[colour])
            || off(&[ours.alpha[pixel]], &[theirs.alpha[pixel]])
        {
            differing += 1;
            println!("{name}: pixel {pixel}: {}", doubts.nearest[pixel]);
            assert!(doubts.is_open(pixel), "{name}: pixel {pixel} differs, {}", doubts.nearest[pixel]);
        }
    }
    // Of some hundred pixels in doubt few are decided differently: doubt is wider than errors are.
    assert!(doubts.share() < 0.01, "{name}: {} of the pixels are in doubt", doubts.share());
    let counted = pair_counts(gaussians, camera).blended_pairs;
    let open = doubts.share() * doubts.nearest.len() as f64;
    assert!(counted.abs_diff(doubts.pairs) as f64 <= open, "{name}: {counted} pairs, {} here", doubts.pairs);
    differing
}

#[test]
fn only_pixels_at_a_threshold_differ() {
    for (gaussians, width, height) in [(10_000, 320, 180), (2_000, 333, 187), (20_000, 200, 120)] {
        let scene = generate(SceneSize { gaussians, width, height, sh_degree: 0 });
        let differing = assert_only_doubtful_pixels_differ("scene", &scene.gaussians, &scene.camera);
        println!("{gaussians} in {width}x{height}: {differing} pixels differ");
    }
    for seed in 0..4 {
        let camera = &arc(3, 96, 64)[seed as usize % 3];
        assert_only_doubtful_pixels_differ("blobs", &blobs(600, 0, 80 + seed), camera);
    }
}

#[test]
fn doubt_is_found_where_a_decision_stands_at_its_threshold() {
    let camera = &arc(1, 9, 9)[0];
    let centre = 4 * 9 + 4;
    // On the axis of the camera, whose principal point is the centre of the middle pixel: alpha there is the opacity.
    let one = |opacity: f64| {
        let mut gaussian = blobs(1, 0, 1);
        gaussian.means[0] = [0.0; 3];
        gaussian.logit_opacities[0] = (opacity / (1.0 - opacity)).ln() as f32;
        gaussian
    };
    let camera = &Camera { rotation: glam::DMat3::IDENTITY, ..camera.clone() };
    for (opacity, decision) in [(1.0 / 255.0, Decision::LeastAlpha), (0.99, Decision::LargestAlpha)] {
        let at = Doubts::new(&one(opacity), camera);
        assert!(at.is_open(centre) && at.nearest[centre].decision == decision, "{}", at.nearest[centre]);
        let above = Doubts::new(&one(opacity * 1.0001), camera);
        assert!(!above.is_open(centre), "{}", above.nearest[centre]);
    }
    let mut two = one(0.5);
    two.means.push([0.0, 0.0, 1e-7]);
    two.rotations.push(two.rotations[0]);
    two.log_scales.push(two.log_scales[0]);
    two.logit_opacities.push(0.0);
    two.sh.extend([1.0; 3]);
    let at = Doubts::new(&two, camera);
    assert!(at.is_open(centre) && at.nearest[centre].decision == Decision::Order, "{}", at.nearest[centre]);
    two.means[1][2] = 1e-3;
    assert!(!Doubts::new(&two, camera).is_open(centre));
}
