//! Frames and settings that no one should bring, and someone will.

use super::*;

#[test]
fn textureless_frames_admit_that_they_know_nothing() {
    let grey = Arc::new(Image::filled(64, 48, [0.5; 3]));
    let field = track(&[grey.clone(), grey], &balanced()).remove(0);
    assert!(field.sigma.iter().all(|&sigma| sigma > 10.0));
}

#[test]
fn unrelated_noise_is_not_tracked() {
    let grey = Image::filled(96, 64, [0.5; 3]);
    let frames = [noisy(&grey, 0.2, 1), noisy(&grey, 0.2, 2), noisy(&grey, 0.2, 3)];
    for field in track(&frames, &balanced()) {
        let confident =
            field.visible.iter().zip(&field.sigma).map(|(&visible, &sigma)| visible && sigma < 1.0);
        assert!(fraction(confident) < 0.02);
    }
}

#[test]
fn a_black_frame_hides_everything_and_the_next_frame_recovers() {
    let texture = Texture::new(7, 5.0);
    let key = render(80, 60, |x, y| texture.at(x, y));
    let moved = render(80, 60, |x, y| texture.at(x - 3.0, y));
    let black = Arc::new(Image::filled(80, 60, [0.0; 3]));
    let fields = track(&[key, black, moved], &balanced());
    assert!(fraction(fields[0].visible.iter().copied()) < 0.01);
    assert!(fraction(fields[1].visible.iter().copied()) > 0.85);
    assert!(quantile(errors(&fields[1], |at| [at[0] + 3.0, at[1]]), 0.8) < 0.1);
}

#[test]
fn tiny_images_and_broken_values_give_finite_tracks() {
    let texture = Texture::new(8, 3.0);
    for (width, height) in [(8, 8), (1, 1), (3, 5), (1, 40), (200, 2), (0, 0)] {
        let key = render(width, height, |x, y| texture.at(x, y));
        let other = render(width, height, |x, y| texture.at(x - 1.0, y));
        track(&[key, other.clone(), other], &balanced());
    }
    let broken = render(40, 30, |x, y| {
        let value = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30, 1e-40];
        [value[(x as usize + y as usize) % 6], value[x as usize % 6], 0.5]
    });
    let sound = render(40, 30, |x, y| texture.at(x, y));
    track(&[sound.clone(), broken.clone(), sound.clone()], &balanced());
    track(&[broken, sound], &balanced());
}

#[test]
fn extreme_settings_give_finite_tracks() {
    let texture = Texture::new(9, 5.0);
    let frames = [0.0, 2.0, 4.0].map(|shift| render(64, 48, |x, y| texture.at(x - shift, y)));
    // No file may say these, but a caller may.
    let all_zero = TrackingSettings {
        full_side: 0,
        quarter_side: 0,
        max_side: 0,
        search_side: 0,
        search_radius: 0.0,
        colour: false,
        gaps: vec![0],
        window: 1,
        patch_side: 0,
        patch_stride: 0,
        patch_iterations: 0,
        smoothness: 0.0,
        smoothing_warps: 0,
        smoothing_window: 0,
        smoothing_iterations: 0,
        consistency: 0.0,
        correlation: 0.0,
        sigma_floor: 0.01,
        hidden_sigma: 0.0,
        onnx: Default::default(),
    };
    track(&frames, &all_zero);
    let huge =
        TrackingSettings { search_radius: 1e9, smoothness: 1e30, smoothing_window: 1000, ..balanced() };
    track(&frames, &huge);
    let not_numbers = TrackingSettings { search_radius: f32::NAN, smoothness: f32::NAN, ..balanced() };
    track(&frames, &not_numbers);
}
