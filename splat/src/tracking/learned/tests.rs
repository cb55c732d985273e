#![allow(clippy::unwrap_used, reason = "tests")]
//! Networks that measure motion exactly on images whose colours are coordinates.

use std::sync::Arc;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{test_model::Net, *};
use crate::tracking::{Tracker, tests::Failed};

/// Change of red per pixel along x, and of green per pixel along y.
const SLOPE: f32 = 0.01;
const OFFSET: f32 = 0.2;

/// Frame `t` of a surface that moves by `motion` per frame; blue is 1 left of column `edge` of the surface, else 0.
fn frame(size: (u32, u32), motion: [f32; 2], edge: f32, t: usize) -> Arc<Image> {
    let mut image = Image::filled(size.0, size.1, [0.0; 3]);
    for y in 0..size.1 {
        for x in 0..size.0 {
            let (sx, sy) = (x as f32 - t as f32 * motion[0], y as f32 - t as f32 * motion[1]);
            let first = (y * size.0 + x) as usize * 3;
            image.pixels[first] = OFFSET + SLOPE * sx;
            image.pixels[first + 1] = OFFSET + SLOPE * sy;
            image.pixels[first + 2] = f32::from(u8::from(sx < edge));
        }
    }
    Arc::new(image)
}

/// `flow = (image1 - image2) / slope`: what moved to the right is darker where it was. `slope` per pixel of the
/// network, in the values that it sees.
fn coordinates(net: Net, slope: f32) -> Net {
    let gain = 1.0 / slope;
    net.node("Sub", &["image1", "image2"], "change", &[]).pointwise(
        "change",
        "flow",
        &[&[gain, 0.0, 0.0], &[0.0, gain, 0.0]],
        &[0.0, 0.0],
    )
}

fn pair_net(slope: f32) -> Net {
    coordinates(Net::of_images(None), slope).output("flow")
}

/// Visible where blue of the key frame is 0, standard deviation 0.25.
fn key_net(slope: f32) -> Net {
    coordinates(Net::of_images(None), slope)
        .pointwise("image1", "visibility_logits", &[&[0.0, 0.0, -0.1]], &[12.0])
        .pointwise("image1", "sigma", &[&[0.0; 3]], &[0.25])
        .output("flow")
        .output("visibility_logits")
        .output("sigma")
}

fn load(net: Net) -> Result<LearnedTracker, LearnedError> {
    LearnedTracker::from_onnx(net.bytes(), "net.onnx", &OnnxSettings::default())
}

fn settings(onnx: OnnxSettings) -> TrackingSettings {
    TrackingSettings { onnx, ..TrackingSettings::default() }
}

/// The fields of `frames` frames.
fn track(
    tracker: &LearnedTracker,
    frames: usize,
    image: impl Fn(usize) -> Arc<Image>,
) -> Result<Vec<TrackField>, LearnedError> {
    let mut fields = Vec::new();
    tracker.track_view::<LearnedError>(
        frames,
        &mut |index| Ok(image(index)),
        &settings(OnnxSettings::default()),
        &mut |index, field| {
            assert_eq!(index, fields.len() + 1);
            fields.push(field);
            Ok(())
        },
    )?;
    Ok(fields)
}

/// Largest distance of visible tracks from a motion, and the share of visible pixels.
fn error_and_visible(field: &TrackField, motion: [f32; 2]) -> (f32, f32) {
    let mut worst = 0.0f32;
    let mut visible = 0;
    for (index, position) in field.positions.iter().enumerate() {
        assert!(position[0].is_finite() && position[1].is_finite() && field.sigma[index] > 0.0);
        if field.visible[index] {
            let (x, y) = (index as u32 % field.width, index as u32 / field.width);
            let expected = [x as f32 + 0.5 + motion[0], y as f32 + 0.5 + motion[1]];
            worst = worst.max((position[0] - expected[0]).abs().max((position[1] - expected[1]).abs()));
            visible += 1;
        }
    }
    (worst, visible as f32 / field.visible.len() as f32)
}

fn refusal(net: Net) -> String {
    let message = load(net).unwrap_err().to_string();
    assert!(message.starts_with("net.onnx: "), "{message}");
    message
}

#[test]
fn pair_flow_is_chained_and_judged() {
    let tracker = load(pair_net(255.0 * SLOPE)).unwrap();
    assert_eq!(tracker.signature(), Signature::PairFlow);
    let motion = [1.5, -0.75];
    let fields = track(&tracker, 4, |t| frame((64, 48), motion, 30.0, t)).unwrap();
    assert_eq!(fields.len(), 3);
    for (t, field) in (1..).zip(&fields) {
        let (error, visible) = error_and_visible(field, motion.map(|step| t as f32 * step));
        // Values of up to 200 in f32, times a gain of 0.4.
        assert!(error < 1e-3, "frame {t}: {error}");
        assert!(visible > 0.7, "frame {t}: {visible}");
        // The last column moves out of the image.
        assert!(!field.visible[63]);
    }
}

#[test]
fn a_pair_network_sees_what_its_own_settings_say() {
    // Frames of 200 pixels; the built-in tracker would see 25. A network that sees fewer pixels than the slope is for
    // measures a motion that is wrong by their ratio.
    let [full_side, quarter_side, max_side] = [32; 3];
    let chains = TrackingSettings { full_side, quarter_side, max_side, ..TrackingSettings::default() };
    let motion = [3.0, -1.0];
    let seen_whole = (pair_net(255.0 * SLOPE), OnnxSettings::default());
    let seen_halved =
        (pair_net(2.0 * 255.0 * SLOPE), OnnxSettings { max_side: 100, ..OnnxSettings::default() });
    let for_one_size = coordinates(Net::of_images(Some([48, 100])), 2.0 * 255.0 * SLOPE).output("flow");
    for (net, onnx) in [seen_whole, seen_halved, (for_one_size, OnnxSettings::default())] {
        let tracker = LearnedTracker::from_onnx(net.bytes(), "net.onnx", &onnx).unwrap();
        let mut fields = Vec::new();
        let mut emit = |_, field| {
            fields.push(field);
            Ok(())
        };
        let mut load = |t| Ok(frame((200, 96), motion, 60.0, t));
        tracker.track_view::<LearnedError>(2, &mut load, &chains, &mut emit).unwrap();
        let (error, visible) = error_and_visible(&fields[0], motion);
        // A tenth of what a halving too many would cost: half of 3 pixels.
        assert!(error < 0.15, "{onnx:?}: {error}");
        assert!(visible > 0.8, "{onnx:?}: {visible}");
    }
}

#[test]
fn fields_that_exist_cost_a_key_to_frame_network_nothing() {
    let net = key_net(255.0 * SLOPE).bytes();
    let tracker = Tracker::new(Some((net, "net.onnx")), &TrackingSettings::default()).unwrap();
    let image = |t: usize| frame((32, 24), [1.0, 0.5], 0.0, t);
    let missing = |wanted: &[usize]| {
        let (mut loaded, mut made) = (Vec::new(), Vec::new());
        let mut load = |index| {
            loaded.push(index);
            Ok::<_, Failed>(image(index))
        };
        let mut emit = |index, field| {
            made.push((index, field));
            Ok(())
        };
        let settings = TrackingSettings::default();
        let is_wanted = |index: usize| wanted.contains(&index);
        let window =
            tracker.track_window(TrackState::default(), 1..6, &is_wanted, &mut load, &settings, &mut emit);
        assert_eq!(window.unwrap(), TrackState::default());
        (loaded, made)
    };
    let (loaded, all) = missing(&[1, 2, 3, 4, 5]);
    assert_eq!(loaded, [0, 1, 2, 3, 4, 5]);
    let (loaded, some) = missing(&[2, 4]);
    assert_eq!(loaded, [0, 2, 4]);
    assert_eq!(some, [all[1].clone(), all[3].clone()]);
    let (loaded, none) = missing(&[]);
    assert!(loaded.is_empty() && none.is_empty());
}

#[test]
fn a_pair_network_goes_on_from_a_state_to_the_same_bytes() {
    let tracker =
        Tracker::new(Some((pair_net(255.0 * SLOPE).bytes(), "net.onnx")), &TrackingSettings::default());
    let tracker = tracker.unwrap();
    let settings = TrackingSettings::default();
    let mut load = |t: usize| Ok::<_, Failed>(frame((32, 24), [1.0, 0.5], 0.0, t));
    let mut whole = Vec::new();
    let mut emit = |_, field| {
        whole.push(field);
        Ok(())
    };
    tracker.track_view(6, &mut load, &settings, &mut emit).unwrap();
    for cuts in [&[1, 2, 3, 4, 5, 6][..], &[1, 3, 5, 6], &[1, 4, 6]] {
        let mut fields = Vec::new();
        let mut state = TrackState::default();
        for window in cuts.windows(2) {
            let mut emit = |_, field| {
                fields.push(field);
                Ok(())
            };
            let frames = window[0]..window[1];
            state = tracker.track_window(state, frames, &|_| true, &mut load, &settings, &mut emit).unwrap();
            assert!(state.indices().count() == 2.min(window[1] - 1));
        }
        assert_eq!(fields, whole, "{cuts:?}");
    }
}

#[test]
fn a_network_that_errs_is_not_believed() {
    // Three times the true motion: consistent both ways, but the images disagree.
    let tracker = load(pair_net(255.0 * SLOPE / 3.0)).unwrap();
    let textured = |t: usize| {
        let mut image = Image::clone(&frame((64, 48), [4.0, 0.0], 0.0, t));
        for (index, pixel) in image.pixels.chunks_exact_mut(3).enumerate() {
            let x = (index % 64) as f32 - 4.0 * t as f32;
            pixel[2] = 0.5 + 0.5 * (0.7 * x).sin();
        }
        Arc::new(image)
    };
    let field = &track(&tracker, 2, textured).unwrap()[0];
    let (_, visible) = error_and_visible(field, [4.0, 0.0]);
    assert!(visible < 0.1, "{visible}");
}

#[test]
fn large_images_are_reduced_and_the_flow_scaled_back() {
    // The network sees half the resolution: the slope per pixel of its own is twice as large.
    let onnx = OnnxSettings { max_side: 48, ..OnnxSettings::default() };
    let motion = [3.0, 1.0];
    for net in [pair_net(2.0 * 255.0 * SLOPE), key_net(2.0 * 255.0 * SLOPE)] {
        let tracker = LearnedTracker::from_onnx(net.bytes(), "net.onnx", &onnx).unwrap();
        let field = &track(&tracker, 2, |t| frame((96, 64), motion, 0.0, t)).unwrap()[0];
        let (error, visible) = error_and_visible(field, motion);
        assert!(error < 0.01, "{error}");
        assert!(visible > 0.8, "{visible}");
    }
}

#[test]
fn key_to_frame_is_taken_as_it_is() {
    let tracker = load(key_net(255.0 * SLOPE)).unwrap();
    assert_eq!(tracker.signature(), Signature::KeyToFrame);
    let motion = [2.0, 1.0];
    let fields = track(&tracker, 3, |t| frame((40, 24), motion, 12.0, t)).unwrap();
    for (t, field) in (1..).zip(&fields) {
        let (error, _) = error_and_visible(field, motion.map(|step| t as f32 * step));
        assert!(error < 1e-3, "{error}");
        for y in 0..24 {
            for x in 0..40 {
                let index = y * 40 + x;
                let inside = x + 2 * t < 40 && y + t < 24;
                assert_eq!(field.visible[index], x >= 12 && inside, "frame {t} at {x}, {y}");
                let expected = if field.visible[index] { 0.25 } else { 0.25 + 16.0 };
                assert!((field.sigma[index] - expected).abs() < 1e-5);
            }
        }
    }
}

#[test]
fn visibility_and_doubt_have_two_forms() {
    let net = |visibility: &str, value: f32, doubt: &str, stated: f32| {
        let net = coordinates(Net::of_images(None), 255.0 * SLOPE)
            .pointwise("image1", visibility, &[&[0.0; 3]], &[value])
            .pointwise("image1", doubt, &[&[0.0; 3]], &[stated]);
        net.output("flow").output(visibility).output(doubt)
    };
    let still = |_| frame((16, 16), [0.0, 0.0], 0.0, 0);
    for (visibility, value, doubt, stated, seen, sigma) in [
        ("visibility", 0.6, "sigma", 0.75, true, 0.75),
        ("visibility", 0.4, "sigma", 0.75, false, 16.0),
        // ln(4): a variance of 4. No standard deviation is wider than the image.
        ("visibility_logits", 0.4, "log_variance", 4.0f32.ln(), true, 2.0),
        ("visibility_logits", -0.1, "log_variance", 4.0f32.ln(), false, 16.0),
    ] {
        let tracker = load(net(visibility, value, doubt, stated)).unwrap();
        let field = &track(&tracker, 2, still).unwrap()[0];
        assert!(field.visible.iter().all(|&visible| visible == seen), "{visibility} {value}");
        assert!(field.sigma.iter().all(|found| (found - sigma).abs() < 1e-5), "{doubt}: {}", field.sigma[0]);
    }
}

#[test]
fn networks_of_one_size_see_the_image_stretched() {
    // 60 x 20 to 40 x 40: 1.5 image pixels per column of the network, half of one per row.
    let net = Net::of_images(Some([40, 40])).node("Sub", &["image1", "image2"], "change", &[]).pointwise(
        "change",
        "flow",
        &[&[1.0 / (1.5 * 255.0 * SLOPE), 0.0, 0.0], &[0.0, 1.0 / (0.5 * 255.0 * SLOPE), 0.0]],
        &[0.0, 0.0],
    );
    let tracker = load(net.output("flow")).unwrap();
    let field = &track(&tracker, 2, |t| frame((60, 20), [3.0, -1.0], 0.0, t)).unwrap()[0];
    let (error, visible) = error_and_visible(field, [3.0, -1.0]);
    assert!(error < 0.01 && visible > 0.7, "{error} {visible}");
}

#[test]
fn the_range_is_the_models_or_the_settings() {
    let moved = |tracker: &LearnedTracker| {
        let fields = track(tracker, 2, |t| frame((32, 32), [t as f32, 0.0], 0.0, t)).unwrap();
        fields[0].positions[16 * 32 + 16][0] - 16.5
    };
    let model = pair_net(SLOPE).metadata("trackersplat.range", "0..1");
    assert!((moved(&load(model.clone()).unwrap()) - 1.0).abs() < 1e-3);
    let onnx = OnnxSettings { range: Some(ValueRange::Symmetric), ..OnnxSettings::default() };
    let tracker = LearnedTracker::from_onnx(model.bytes(), "net.onnx", &onnx).unwrap();
    assert!((moved(&tracker) - 2.0).abs() < 1e-3);
    let message = refusal(pair_net(SLOPE).metadata("trackersplat.range", "0..2"));
    assert!(message.contains("trackersplat.range") && message.contains("'0..2'"), "{message}");
    let message = refusal(pair_net(SLOPE).metadata("trackersplat.multiple", "0"));
    assert!(message.contains("trackersplat.multiple"), "{message}");
}

#[test]
fn every_size_is_padded_and_cropped() {
    for net in [pair_net(255.0 * SLOPE), key_net(255.0 * SLOPE)] {
        let tracker = load(net.metadata("trackersplat.multiple", "8")).unwrap();
        for size in [(1, 1), (2, 1), (7, 9), (8, 8), (37, 23), (0, 5)] {
            let fields = track(&tracker, 3, |t| frame(size, [0.0, 0.0], 0.0, t)).unwrap();
            for field in fields {
                assert_eq!((field.width, field.height), size);
                let (error, _) = error_and_visible(&field, [0.0, 0.0]);
                assert!(error < 1e-4);
                assert_eq!(field.positions.len(), (size.0 * size.1) as usize);
            }
        }
        // A frame of another size: nothing is known, but tracking goes on.
        let other = |t| frame(if t == 1 { (9, 9) } else { (16, 12) }, [0.0, 0.0], 0.0, 0);
        let fields = track(&tracker, 3, other).unwrap();
        assert!(fields[0].visible.iter().all(|visible| !visible));
        assert!(fields[1].visible.iter().any(|&visible| visible));
    }
}

#[test]
fn what_is_no_number_is_hidden_and_too_much_of_it_refused() {
    // The root of blue minus a quarter is no number right of the edge.
    let with_holes = |net: Net| {
        net.node("Sub", &["image1", "image2"], "change", &[])
            .pointwise("image1", "blue", &[&[0.0, 0.0, 1.0], &[0.0, 0.0, 1.0]], &[-63.75, -63.75])
            .node("Sqrt", &["blue"], "root", &[])
            .constant("zero", &[1], &[0.0])
            .node("Mul", &["root", "zero"], "hole", &[])
            .pointwise("change", "motion", &[&[1.0, 0.0, 0.0], &[0.0, 1.0, 0.0]], &[0.0, 0.0])
            .node("Add", &["motion", "hole"], "flow", &[])
            .pointwise("image1", "visibility", &[&[0.0; 3]], &[1.0])
    };
    let pair = || with_holes(Net::of_images(None)).output("flow");
    let key = || pair().output("visibility");
    for net in [pair(), key()] {
        let tracker = load(net).unwrap();
        let fields = track(&tracker, 3, |_| frame((40, 24), [0.0, 0.0], 30.0, 0)).unwrap();
        for field in fields {
            error_and_visible(&field, [0.0, 0.0]);
            for (index, &visible) in field.visible.iter().enumerate() {
                assert_eq!(visible, index % 40 < 30, "{}", index % 40);
            }
        }
        let error = track(&tracker, 2, |_| frame((40, 24), [0.0, 0.0], 10.0, 0)).unwrap_err().to_string();
        assert!(error.contains("net.onnx") && error.contains("not finite in 720 of 960"), "{error}");
    }
}

#[test]
fn what_is_no_tracker_is_refused_with_what_was_found() {
    let message = refusal(coordinates(Net::of_images(None), 1.0).output("change"));
    assert!(message.contains("no output flow") && message.contains("change"), "{message}");
    assert!(message.contains("image1 [1, 3, height, width]"), "{message}");
    let message = refusal(
        Net::default().input("frames", 3, None).node("Relu", &["frames"], "flow", &[]).output("flow"),
    );
    assert!(message.contains("no input image1") && message.contains("frames"), "{message}");
    let message = refusal(
        coordinates(Net::default().input("image1", 4, None).input("image2", 3, None), 1.0).output("flow"),
    );
    assert!(message.contains("three channels"), "{message}");
    let message = refusal(pair_net(1.0).input("image3", 3, None));
    assert!(message.contains("3 inputs"), "{message}");
    let message = refusal(key_net(1.0).node("Relu", &["image1"], "visibility", &[]).output("visibility"));
    assert!(message.contains("both visibility and visibility_logits"), "{message}");
    let message = refusal(pair_net(1.0).node("Relu", &["image1"], "sigma", &[]).output("sigma"));
    assert!(message.contains("no visibility"), "{message}");
    let message = refusal(coordinates(Net::of_images(Some([9000, 8])), 1.0).output("flow"));
    assert!(message.contains("8 x 9000"), "{message}");
    let message =
        refusal(Net::of_images(None).node("NoSuchLayer", &["image1", "image2"], "flow", &[]).output("flow"));
    assert!(message.contains("NoSuchLayer") && message.contains("docs/trackers.md"), "{message}");
}

#[test]
fn outputs_of_another_shape_are_refused_when_they_appear() {
    let failure = |net: Net| {
        let tracker = load(net.output("flow")).unwrap();
        let message = track(&tracker, 2, |t| frame((32, 24), [0.0, 0.0], 0.0, t)).unwrap_err().to_string();
        assert!(message.starts_with("net.onnx: "), "{message}");
        message
    };
    let halved = Net::of_images(None).constant("kernel", &[2, 3, 2, 2], &[0.0; 24]).convolution(
        &["image1", "kernel"],
        "flow",
        2,
        0,
    );
    let message = failure(halved);
    assert!(message.contains("[1, 2, 12, 16]") && message.contains("[1, 2, 24, 32]"), "{message}");
    let three = Net::of_images(None).node("Sub", &["image1", "image2"], "flow", &[]);
    assert!(failure(three).contains("[1, 3, 24, 32]"));
    // Channels that do not fit the kernel: the runtime's own complaint, with the size.
    let mismatch = Net::of_images(None).pointwise("image1", "flow", &[&[0.0; 5], &[0.0; 5]], &[0.0, 0.0]);
    let message = failure(mismatch);
    assert!(message.contains("32 x 24") && message.contains("tracking.onnx"), "{message}");
}

#[test]
fn broken_files_are_refused() {
    let whole = key_net(1.0).metadata("trackersplat.range", "0..1").bytes();
    let onnx = OnnxSettings::default();
    assert!(LearnedTracker::from_onnx(whole.clone(), "net.onnx", &onnx).is_ok());
    for length in 0..whole.len() {
        if let Err(error) = LearnedTracker::from_onnx(whole[..length].to_vec(), "net.onnx", &onnx) {
            assert!(error.to_string().starts_with("net.onnx: "), "{error}");
        }
    }
    assert!(LearnedTracker::from_onnx(b"RTEN and more".to_vec(), "net.onnx", &onnx).is_err());
    assert!(LearnedTracker::from_onnx(Vec::new(), "net.onnx", &onnx).is_err());
    // Whatever a damaged file is taken for, it must not end the process.
    let mut random = ChaCha8Rng::seed_from_u64(3);
    for _ in 0..2000 {
        let mut damaged = whole.clone();
        for _ in 0..random.random_range(1..4) {
            let at = random.random_range(0..damaged.len());
            damaged[at] = random.random();
        }
        if let Ok(tracker) = LearnedTracker::from_onnx(damaged, "net.onnx", &onnx) {
            let _ = track(&tracker, 2, |t| frame((8, 8), [0.0, 0.0], 0.0, t));
        }
    }
}

#[test]
fn the_number_of_threads_does_not_show() {
    // Wide enough layers that the runtime would divide their products.
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let mut weights =
        |count: usize| -> Vec<f32> { (0..count).map(|_| random.random_range(-0.05..0.05)).collect() };
    let net = Net::of_images(None)
        .node("Sub", &["image1", "image2"], "change", &[])
        .constant("first", &[16, 3, 3, 3], &weights(16 * 27))
        .convolution(&["change", "first"], "hidden", 1, 1)
        .node("Relu", &["hidden"], "active", &[])
        .constant("second", &[2, 16, 3, 3], &weights(2 * 144))
        .convolution(&["active", "second"], "flow", 1, 1)
        .output("flow");
    let tracker = load(net).unwrap();
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| track(&tracker, 4, |t| frame((90, 70), [1.0, 2.0], 40.0, t)).unwrap())
    };
    let alone = on(1);
    assert!(alone[0].positions[40 * 90 + 40] != [40.5, 40.5]);
    assert_eq!(alone, on(4));
}

#[test]
fn settings_are_checked_where_they_are_read() {
    for (json, said) in [
        (r#"{"max_side":5000}"#, "5000"),
        (r#"{"max_side":4}"#, "between 16"),
        (r#"{"multiple":0}"#, "between 1 and 256"),
        (r#"{"range":"0..2"}"#, "0..2"),
        (r#"{"side":100}"#, "side"),
    ] {
        let error = serde_json::from_str::<OnnxSettings>(json).unwrap_err().to_string();
        assert!(error.contains(said), "{json}: {error}");
    }
    let chosen = OnnxSettings { range: Some(ValueRange::ImageNet), multiple: Some(16), max_side: 512 };
    let json = serde_json::to_string(&chosen).unwrap();
    assert_eq!(serde_json::from_str::<OnnxSettings>(&json).unwrap(), chosen);
}
