#![allow(clippy::unwrap_used, reason = "tests")]
//! Tracks of sequences rendered here, whose motion is known exactly.

use std::{convert::Infallible, sync::Arc};

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::{image::Image, settings::Quality};

mod extremes;
mod pair;
mod windows;

/// What any error says.
#[derive(Debug)]
pub(super) struct Failed(pub(super) String);

impl From<StateMisfit> for Failed {
    fn from(error: StateMisfit) -> Self {
        Self(error.to_string())
    }
}

impl From<learned::LearnedError> for Failed {
    fn from(error: learned::LearnedError) -> Self {
        Self(error.to_string())
    }
}

/// Smooth colour noise over the plane: band-limited enough that bilinear interpolation errs by a few grey levels.
#[derive(Clone)]
struct Texture {
    cell: f32,
    values: Vec<[f32; 3]>,
}

impl Texture {
    const SIDE: usize = 64;

    fn new(seed: u64, cell: f32) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let values = (0..Self::SIDE * Self::SIDE).map(|_| random.random::<[f32; 3]>()).collect();
        Self { cell, values }
    }

    fn at(&self, x: f32, y: f32) -> [f32; 3] {
        let (x, y) = (x / self.cell, y / self.cell);
        let ease = |t: f32| t * t * (3.0 - 2.0 * t);
        let (fx, fy) = (ease(x - x.floor()), ease(y - y.floor()));
        let wrap = |v: f32| (v as i64).rem_euclid(Self::SIDE as i64) as usize;
        let node = |dx: f32, dy: f32| self.values[wrap(y.floor() + dy) * Self::SIDE + wrap(x.floor() + dx)];
        let corners = [node(0.0, 0.0), node(1.0, 0.0), node(0.0, 1.0), node(1.0, 1.0)];
        [0, 1, 2].map(|c: usize| {
            let above = corners[0][c] + fx * (corners[1][c] - corners[0][c]);
            let below = corners[2][c] + fx * (corners[3][c] - corners[2][c]);
            above + fy * (below - above)
        })
    }
}

fn render(width: u32, height: u32, colour: impl Fn(f32, f32) -> [f32; 3]) -> Arc<Image> {
    let centres = (0..height).flat_map(|y| (0..width).map(move |x| (x as f32 + 0.5, y as f32 + 0.5)));
    Arc::new(Image { width, height, pixels: centres.flat_map(|(x, y)| colour(x, y)).collect() })
}

fn noisy(image: &Image, deviation: f32, seed: u64) -> Arc<Image> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    // A uniform variable of half width √3 σ has standard deviation σ.
    let half = deviation * 3.0f32.sqrt();
    let pixels = image.pixels.iter().map(|value| value + random.random_range(-half..half)).collect();
    Arc::new(Image { pixels, ..image.clone() })
}

fn track(images: &[Arc<Image>], settings: &TrackingSettings) -> Vec<TrackField> {
    let mut fields = Vec::new();
    let load = &mut |i: usize| Ok::<_, Infallible>(images[i].clone());
    track_view(images.len(), load, settings, &mut |i, field| {
        assert_eq!(i, fields.len() + 1, "fields come in ascending order");
        assert_sound(&field, &images[0]);
        fields.push(field);
        Ok(())
    })
    .unwrap();
    assert_eq!(fields.len(), images.len() - 1);
    fields
}

fn assert_sound(field: &TrackField, key: &Image) {
    assert_eq!((field.width, field.height), (key.width, key.height));
    for length in [field.positions.len(), field.visible.len(), field.sigma.len()] {
        assert_eq!(length, key.pixel_count());
    }
    assert!(field.positions.iter().flatten().all(|value| value.is_finite()));
    assert!(field.sigma.iter().all(|sigma| sigma.is_finite() && *sigma > 0.0));
}

/// Distance of every track from `truth`, which maps a key-frame position to the exact one.
fn errors(field: &TrackField, truth: impl Fn([f32; 2]) -> [f32; 2]) -> Vec<f32> {
    let exact =
        |i: usize| truth([(i % field.width as usize) as f32 + 0.5, (i / field.width as usize) as f32 + 0.5]);
    let distance = |(i, at): (usize, &[f32; 2])| (at[0] - exact(i)[0]).hypot(at[1] - exact(i)[1]);
    field.positions.iter().enumerate().map(distance).collect()
}

fn quantile(mut values: Vec<f32>, fraction: f64) -> f32 {
    values.sort_by(f32::total_cmp);
    values[((values.len() - 1) as f64 * fraction) as usize]
}

fn fraction(of: impl Iterator<Item = bool>) -> f64 {
    let (mut yes, mut all) = (0u32, 0u32);
    of.for_each(|holds| (yes, all) = (yes + u32::from(holds), all + 1));
    f64::from(yes) / f64::from(all)
}

fn balanced() -> TrackingSettings {
    TrackingSettings::preset(Quality::Balanced)
}

#[test]
fn identical_frames_stay_exactly_where_they_are() {
    let texture = Texture::new(1, 5.0);
    let image = render(96, 64, |x, y| texture.at(x, y));
    for field in track(&[image.clone(), image.clone(), image], &balanced()) {
        assert_eq!(quantile(errors(&field, |at| at), 1.0), 0.0);
        assert!(field.visible.iter().all(|&visible| visible));
    }
}

#[test]
fn subpixel_shifts_are_followed_with_honest_sigma() {
    let texture = Texture::new(2, 5.0);
    let shift = [0.3f32, -1.7];
    let frames: Vec<_> = (0..4)
        .map(|t| {
            let t = t as f32;
            let clean = render(128, 96, |x, y| texture.at(x - t * shift[0], y - t * shift[1]));
            noisy(&clean, 0.015, t as u64)
        })
        .collect();
    for (t, field) in track(&frames, &balanced()).iter().enumerate() {
        let t = (t + 1) as f32;
        let errors = errors(field, |at| [at[0] + t * shift[0], at[1] + t * shift[1]]);
        let seen: Vec<usize> = (0..errors.len()).filter(|&i| field.visible[i]).collect();
        assert!(seen.len() as f64 > 0.85 * errors.len() as f64, "{} of {}", seen.len(), errors.len());
        // Noise of 4 grey levels against gradients of about 20 per pixel over a window: a few hundredths.
        assert!(quantile(seen.iter().map(|&i| errors[i]).collect(), 0.5) < 0.06);
        assert!(quantile(seen.iter().map(|&i| errors[i]).collect(), 0.95) < 0.25);
        let honest = fraction(seen.iter().map(|&i| errors[i] < 3.0 * field.sigma[i]));
        assert!(honest > 0.97, "{honest}");
        // A Gaussian has 39 % of its errors in the plane within one standard deviation per axis.
        let modest = fraction(seen.iter().map(|&i| errors[i] < field.sigma[i]));
        assert!((0.1..0.8).contains(&modest), "{modest}");
    }
}

/// A textured square that jumps in front of a textured wall; `at` is its top-left corner.
fn square_scene(at: [f32; 2], side: f32) -> Arc<Image> {
    let (wall, square) = (Texture::new(3, 7.0), Texture::new(4, 6.0));
    render(192, 128, |x, y| {
        let (inside_x, inside_y) = (x - at[0], y - at[1]);
        let covered = (0.0..side).contains(&inside_x) && (0.0..side).contains(&inside_y);
        if covered { square.at(inside_x, inside_y) } else { wall.at(x, y) }
    })
}

#[test]
fn jumps_larger_than_the_object_are_followed_and_what_they_cover_is_hidden() {
    let corners = [[24.0f32, 20.0], [92.0, 66.0], [133.5, 11.25]];
    let side = 40.0;
    let within = |x: f32, y: f32, corner: [f32; 2], margin: f32| {
        (x - corner[0]).min(corner[0] + side - x).min(y - corner[1]).min(corner[1] + side - y) > margin
    };
    let frames: Vec<_> = corners.iter().map(|&corner| square_scene(corner, side)).collect();
    for (field, &corner) in track(&frames, &balanced()).iter().zip(&corners[1..]) {
        let moved = [corner[0] - corners[0][0], corner[1] - corners[0][1]];
        let errors_moved = errors(field, |at| [at[0] + moved[0], at[1] + moved[1]]);
        let errors_still = errors(field, |at| at);
        let pixels = || (0..192 * 128).map(|i| (i, (i % 192) as f32 + 0.5, (i / 192) as f32 + 0.5));

        // The outermost pixels share their windows with the wall.
        let square: Vec<usize> =
            pixels().filter(|&(_, x, y)| within(x, y, corners[0], 3.0)).map(|p| p.0).collect();
        assert!(fraction(square.iter().map(|&i| field.visible[i])) > 0.9);
        assert!(quantile(square.iter().map(|&i| errors_moved[i]).collect(), 0.9) < 0.3);

        // So do those that the square's edge covers.
        let covered =
            pixels().filter(|&(_, x, y)| within(x, y, corner, 3.0) && !within(x, y, corners[0], -6.0));
        let seen = fraction(covered.map(|(i, ..)| field.visible[i]));
        // What is covered here and what is uncovered there may look alike, and then they match each other both ways.
        assert!(seen < 0.1, "{seen}");

        let wall: Vec<usize> = pixels()
            .filter(|&(_, x, y)| !within(x, y, corner, -8.0) && !within(x, y, corners[0], -8.0))
            .map(|p| p.0)
            .collect();
        assert!(fraction(wall.iter().map(|&i| field.visible[i])) > 0.95);
        assert!(quantile(wall.iter().map(|&i| errors_still[i]).collect(), 0.95) < 0.1);
        // The worst that can happen: a confident claim that the moved square is where it was.
        assert!(square.iter().all(|&i| !(field.visible[i] && errors_still[i] < 2.0 && field.sigma[i] < 2.0)));
    }
}

#[test]
fn what_moves_slowly_does_not_rest() {
    // What rests is smoothed more; a tenth of a pixel per frame must not drown in the wall's rest.
    let step = [0.1f32, -0.06];
    let at = |t: usize| [70.0 + t as f32 * step[0], 40.0 + t as f32 * step[1]];
    let frames: Vec<_> = (0..8).map(|t| noisy(&square_scene(at(t), 44.0), 0.01, 40 + t as u64)).collect();
    let fields = track(&frames, &balanced());
    let inside = |i: &usize| (78..106).contains(&(i % 192)) && (48..76).contains(&(i / 192));
    for t in [1usize, 4, 7] {
        let moved = [t as f32 * step[0], t as f32 * step[1]];
        let errors = errors(&fields[t - 1], |at| [at[0] + moved[0], at[1] + moved[1]]);
        let error = quantile((0..errors.len()).filter(inside).map(|i| errors[i]).collect(), 0.5);
        // Noise of 2.5 grey levels: some hundredths, as for what moves fast.
        assert!(error < 0.05, "frame {t}: {error}");
    }
}

#[test]
fn exposure_changes_are_not_motion() {
    let texture = Texture::new(5, 6.0);
    let key = render(96, 64, |x, y| texture.at(x, y));
    let darker = render(96, 64, |x, y| texture.at(x - 2.0, y + 1.0).map(|value| 0.75 * value + 0.03));
    let field = track(&[key, darker], &balanced()).remove(0);
    let errors = errors(&field, |at| [at[0] + 2.0, at[1] - 1.0]);
    assert!(fraction(field.visible.iter().copied()) > 0.85);
    let seen = errors.iter().zip(&field.visible).filter(|(_, visible)| **visible).map(|(error, _)| *error);
    // The gain is found from quantiles, which the offset disturbs.
    assert!(quantile(seen.collect(), 0.9) < 0.25);
}

#[test]
fn chaining_bridges_a_large_change_of_shape() {
    // Half a turn in steps: the last frame resembles the key frame only through those between.
    let texture = Texture::new(6, 6.0);
    let centre = [48.0f32, 48.0];
    let turned = |x: f32, y: f32, angle: f32| {
        let (dx, dy) = (x - centre[0], y - centre[1]);
        [centre[0] + dx * angle.cos() - dy * angle.sin(), centre[1] + dx * angle.sin() + dy * angle.cos()]
    };
    let angle = |t: usize| 0.2 * t as f32;
    let frames: Vec<_> = (0..9)
        .map(|t| {
            render(96, 96, |x, y| {
                let [x, y] = turned(x, y, -angle(t));
                texture.at(x, y)
            })
        })
        .collect();
    let last = track(&frames, &balanced()).pop().unwrap();
    let errors = errors(&last, |at| turned(at[0], at[1], angle(8)));
    let disc: Vec<usize> = (0..96 * 96)
        .filter(|&i| ((i % 96) as f32 - centre[0]).hypot((i / 96) as f32 - centre[1]) < 30.0)
        .collect();
    let seen: Vec<usize> = disc.iter().copied().filter(|&i| last.visible[i]).collect();
    assert!(seen.len() as f64 > 0.6 * disc.len() as f64, "{} of {}", seen.len(), disc.len());
    // Eight steps of up to 6 px, each with an error of some tenths; a direct match finds 10 px or nothing.
    assert!(quantile(seen.iter().map(|&i| errors[i]).collect(), 0.5) < 1.0);
    assert!(quantile(seen.iter().map(|&i| errors[i]).collect(), 0.9) < 2.0);
}

/// Errors of what is called visible that its standard deviation cannot explain, as a share of all pixels.
fn dishonest(field: &TrackField, truth: impl Fn([f32; 2]) -> [f32; 2]) -> f64 {
    let errors = errors(field, truth);
    fraction((0..errors.len()).map(|i| field.visible[i] && errors[i] > 4.0 * field.sigma[i]))
}

#[test]
fn what_half_a_turn_makes_of_a_frame_is_not_claimed_to_be_known() {
    let texture = Texture::new(12, 6.0);
    let key = render(80, 64, |x, y| texture.at(x, y));
    let turned = render(80, 64, |x, y| texture.at(80.0 - x, 64.0 - y));
    let field = track(&[key, turned], &balanced()).remove(0);
    // Patches are not turned: what is called visible, a pixel in eighteen, matches elsewhere by chance.
    let wrong = dishonest(&field, |at| [80.0 - at[0], 64.0 - at[1]]);
    assert!(wrong < 0.08, "{wrong}");
    assert!(fraction(field.visible.iter().copied()) < 0.08);
}

#[test]
fn a_stop_more_or_less_is_not_motion() {
    let texture = Texture::new(13, 6.0);
    // Half the range, so that the brighter frame is not clipped.
    let scene = |x: f32, y: f32| texture.at(x, y).map(|value| 0.5 * value);
    let key = render(96, 64, scene);
    for gain in [0.5f32, 2.0] {
        let other = render(96, 64, |x, y| scene(x - 2.0, y + 1.0).map(|value| gain * value));
        let field = track(&[key.clone(), other], &balanced()).remove(0);
        let truth = |at: [f32; 2]| [at[0] + 2.0, at[1] - 1.0];
        assert!(dishonest(&field, truth) < 0.02, "gain {gain}");
        let errors = errors(&field, truth);
        let followed = (0..errors.len()).map(|i| field.visible[i] && errors[i] < 0.5);
        // As without the change: what the border hides is missing.
        let followed = fraction(followed);
        assert!(followed > 0.85, "gain {gain}: {followed}");
    }
}

#[test]
fn what_leaves_the_image_is_hidden() {
    let texture = Texture::new(14, 5.0);
    let frames = [0.0, 30.0, 60.0].map(|shift| render(96, 64, |x, y| texture.at(x + shift, y)));
    for (field, shift) in track(&frames, &balanced()).iter().zip([30.0, 60.0]) {
        // The columns at the border see half of their windows.
        let outside = (0..96 * 64).filter(|i| ((i % 96) as f32) < shift - 3.0);
        assert!(fraction(outside.map(|i| field.visible[i])) < 0.05, "{shift}");
        assert!(dishonest(field, |at| [at[0] - shift, at[1]]) < 0.02, "{shift}");
    }
}

#[test]
fn what_reappears_is_found_again_by_the_direct_match() {
    // A bar covers the square in frames 2 and 3: no chain of gap 1 or 2 leads through both.
    let (wall, square, bar) = (Texture::new(15, 7.0), Texture::new(16, 5.0), Texture::new(17, 9.0));
    let scene = |t: usize| {
        let (left, covered) = (30.0 + 3.0 * t as f32, t == 2 || t == 3);
        render(128, 80, |x, y| {
            if covered && (20.0..80.0).contains(&x) {
                return bar.at(x, y).map(|value| 1.0 - value);
            }
            let inside = (left..left + 32.0).contains(&x) && (24.0..56.0).contains(&y);
            if inside { square.at(x - left, y) } else { wall.at(x, y) }
        })
    };
    let frames: Vec<_> = (0..5).map(scene).collect();
    let fields = track(&frames, &balanced());
    let core = || (0..128 * 80).filter(|i| (36..56).contains(&(i % 128)) && (30..50).contains(&(i / 128)));
    for covered in [1, 2] {
        assert!(fraction(core().map(|i| fields[covered].visible[i])) < 0.05);
    }
    let errors = errors(&fields[3], |at| [at[0] + 12.0, at[1]]);
    assert!(fraction(core().map(|i| fields[3].visible[i] && errors[i] < 0.5)) > 0.9);
}

#[test]
fn frames_beyond_the_longest_gap_are_forgotten() {
    let texture = Texture::new(18, 5.0);
    let settings = TrackingSettings { gaps: vec![1, 3], ..balanced() };
    let key = render(24, 16, |x, y| texture.at(x, y));
    let mut tracker = view::Tracker::new(&key, &settings, &matcher::PatchSearch);
    for index in 1..12 {
        tracker.track(index, &key).unwrap();
        assert_eq!(tracker.remembered(), index.min(3));
    }
}

#[test]
fn reduced_resolution_gives_full_resolution_positions() {
    let texture = Texture::new(10, 12.0);
    // Odd sizes: halving rounds up, and positions must not scale with the rounding.
    let frames = [0.0, 5.0].map(|shift| render(171, 101, |x, y| texture.at(x - shift, y - 0.5 * shift)));
    let settings = TrackingSettings { max_side: 90, ..balanced() };
    let field = track(&frames, &settings).remove(0);
    let errors = errors(&field, |at| [at[0] + 5.0, at[1] + 2.5]);
    assert!(fraction(field.visible.iter().copied()) > 0.85);
    assert!(quantile(errors, 0.8) < 0.2);
}

#[test]
fn a_frame_of_another_size_is_hidden_and_later_frames_are_not() {
    let texture = Texture::new(11, 5.0);
    let key = render(64, 48, |x, y| texture.at(x, y));
    let other = render(60, 48, |x, y| texture.at(x, y));
    let fields = track(&[key.clone(), other, key], &balanced());
    assert!(fields[0].visible.iter().all(|visible| !visible));
    assert!(fields[1].visible.iter().all(|visible| *visible));
}

#[test]
fn bytes_do_not_depend_on_the_number_of_threads() {
    let frames = [[20.0, 30.0], [70.0, 40.0], [110.0, 50.0]].map(|corner| square_scene(corner, 36.0));
    let in_pool = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| track(&frames, &balanced()))
    };
    assert_eq!(in_pool(1), in_pool(3));
}

#[test]
fn the_first_error_ends_the_work() {
    let image = Arc::new(Image::filled(16, 16, [0.5; 3]));
    let mut emitted = Vec::new();
    let failing_load = &mut |i: usize| if i == 2 { Err("load 2") } else { Ok(image.clone()) };
    let result = track_view(4, failing_load, &balanced(), &mut |i, _| {
        emitted.push(i);
        Ok(())
    });
    assert_eq!((result, emitted), (Err("load 2"), vec![1]));
    let result = track_view(4, &mut |_| Ok(image.clone()), &balanced(), &mut |i, _| {
        if i == 2 { Err(i) } else { Ok(()) }
    });
    assert_eq!(result, Err(2));
    let nothing = &mut |_: usize| -> Result<Arc<Image>, ()> { panic!("no frame to load") };
    assert_eq!(track_view(0, nothing, &balanced(), &mut |_, _| Ok(())), Ok(()));
    assert_eq!(track_view(1, nothing, &balanced(), &mut |_, _| Ok(())), Ok(()));
}

#[test]
fn settings_survive_a_round_trip_and_refuse_unknown_keys() {
    for quality in [Quality::Draft, Quality::Balanced, Quality::Best] {
        let settings = TrackingSettings::preset(quality);
        let text = serde_json::to_string(&settings).unwrap();
        assert_eq!(serde_json::from_str::<TrackingSettings>(&text).unwrap(), settings);
    }
    for (wrong, said) in [
        (r#"{"smothness": 3}"#, "smothness"),
        (r#"{"smoothness": -1}"#, "between 0 and"),
        (r#"{"smoothness": 1e18}"#, "between 0 and"),
        (r#"{"patch_stride": 0}"#, "between 1 and 8"),
        (r#"{"patch_stride": 9}"#, "between 1 and 8"),
        (r#"{"search_side": 1600}"#, "between 16 and 256"),
        (r#"{"max_side": 2}"#, "between 16 and 65536"),
        (r#"{"smoothing_iterations": 4294967295}"#, "between 0 and 1000"),
        (r#"{"correlation": 2}"#, "between -1 and 1"),
        (r#"{"consistency": 0}"#, "above 0"),
        (r#"{"sigma_floor": 0}"#, "above 0"),
        (r#"{"gaps": [1, 0]}"#, "between 1 and 1000"),
        (r#"{"gaps": [2, 1, 2]}"#, "different distances"),
        (r#"{"window": 0}"#, "between 1 and 100000"),
    ] {
        let error = serde_json::from_str::<TrackingSettings>(wrong).unwrap_err().to_string();
        assert!(error.contains(said), "{wrong}: {error}");
    }
}
