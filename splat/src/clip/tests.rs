#![allow(clippy::unwrap_used, reason = "tests")]

use std::{fs, thread};

use super::{
    testing::{Synthetic, assert_same_content, same_camera, skip},
    *,
};

fn transforms() -> Synthetic {
    let clip = Synthetic::new();
    clip.write_transforms();
    clip
}

fn options(change: impl FnOnce(&mut ClipOptions)) -> ClipOptions {
    let mut options = ClipOptions::default();
    change(&mut options);
    options
}

#[test]
fn every_layout_states_the_same_clip() {
    let clip = Synthetic::centred();
    clip.write_llff();
    let cameras: Vec<_> =
        clip.views.iter().map(|view| serde_json::json!({ "name": view.name, "split": view.split })).collect();
    clip.write("cameras.json", serde_json::json!({ "cameras": cameras }).to_string());
    // Each write adds a layout that is preferred to those before.
    let opened = clip.open().unwrap();
    assert_eq!(opened.layout(), Layout::Llff);
    assert_same_content(&opened, &clip);

    clip.write_colmap();
    let opened = clip.open().unwrap();
    assert_eq!(opened.layout(), Layout::Colmap);
    assert_same_content(&opened, &clip);
    assert_eq!(opened.points(), clip.points);

    clip.write_transforms_pair();
    let opened = clip.open().unwrap();
    assert_eq!(opened.layout(), Layout::Transforms);
    assert_same_content(&opened, &clip);
    clip.write("transforms_train.json", "broken");
    clip.error(&["transforms_train.json"]);

    clip.write_transforms();
    assert_same_content(&clip.open().unwrap(), &clip);
}

#[test]
fn clips_are_shared_between_threads() {
    fn shareable<T: Send + Sync + Clone>() {}
    shareable::<Clip>();
    let clip = transforms();
    let opened = clip.open().unwrap();
    thread::scope(|scope| {
        for _ in 0..4 {
            scope.spawn(|| assert_same_content(&opened.clone(), &clip));
        }
    });
    assert!(
        Arc::ptr_eq(&opened.image(0, 0).unwrap(), &opened.clone().image(0, 0).unwrap()),
        "clones share a cache"
    );
    let uncached = Clip::open(clip.root(), &options(|o| o.cache_bytes = 0)).unwrap();
    assert!(!Arc::ptr_eq(&uncached.image(0, 0).unwrap(), &uncached.image(0, 0).unwrap()));
}

#[test]
fn an_unknown_layout_says_what_was_looked_for() {
    let clip = Synthetic::new();
    let error = clip.error(&["transforms/*.json", "transforms_train.json", "sparse/0", "poses_bounds.npy"]);
    assert!(matches!(error, ClipError::UnknownLayout { .. }));
    let error = Clip::open(&clip.path("nowhere"), &ClipOptions::default()).unwrap_err();
    assert!(matches!(&error, ClipError::NoFolder { path } if path.ends_with("nowhere")));
    let error = Clip::open(&clip.path("images/cam00/frame_0001.png"), &ClipOptions::default()).unwrap_err();
    assert!(matches!(error, ClipError::NoFolder { .. }));
}

#[test]
fn missing_frames_and_images_are_named() {
    let clip = Synthetic::new();
    clip.write_colmap();
    fs::remove_file(clip.path("images/cam01/frame_0003.png")).unwrap();
    let error = clip.error(&["cam01", "frame 3", "images/cam01"]);
    assert!(matches!(error, ClipError::MissingFrame { frame: 3, .. }));
    let fewer = Clip::open(clip.root(), &options(|o| o.frames = Some((1, 2)))).unwrap();
    assert_eq!(fewer.frames(), [1, 2]);
    fs::remove_dir_all(clip.path("images/cam01")).unwrap();
    let error = clip.error(&["cam01", "images/cam01"]);
    assert!(matches!(error, ClipError::NoImages { .. }), "{error}");
}

#[test]
fn frame_ranges() {
    let clip = transforms();
    let frames = |range| Clip::open(clip.root(), &options(|o| o.frames = Some(range)));
    let middle = frames((2, 3)).unwrap();
    assert_eq!(middle.frames(), [2, 3]);
    assert_eq!(*middle.image(2, 0).unwrap(), clip.image(2, 2));
    for range in [(0, 2), (2, 4), (3, 2), (7, 9)] {
        let error = frames(range).unwrap_err();
        assert!(matches!(error, ClipError::FrameRange { .. }), "{error}");
        assert!(error.to_string().contains("1 to 3"), "{error}");
    }
}

#[test]
fn held_out_views() {
    let clip = transforms();
    let held_out = |names: &[&str]| {
        Clip::open(clip.root(), &options(|o| o.test_views = names.iter().map(ToString::to_string).collect()))
    };
    let splits: Vec<Split> =
        held_out(&["cam01", "cam00"]).unwrap().views().iter().map(|view| view.split).collect();
    assert_eq!(splits, [Split::Test, Split::Test, Split::Train, Split::Train]);
    let error = held_out(&["cam01", "cam1", "x"]).unwrap_err();
    assert!(matches!(error, ClipError::UnknownTestViews { .. }));
    assert!(
        error.to_string().contains("no view cam1, x")
            && error.to_string().contains("cam00, cam01, cam02, test00")
    );
    let error = held_out(&["cam00", "cam01", "cam02"]).unwrap_err();
    assert!(matches!(error, ClipError::TooFewTrainingViews { training: 1, views: 4, .. }), "{error}");
}

#[test]
fn images_of_another_size_are_refused_when_opening() {
    let clip = transforms();
    clip.write("images/cam02/frame_0002.png", Image::filled(17, 12, [0.5; 3]).encode_png());
    let error = clip.error(&["images/cam02/frame_0002.png", "17x12", "16x12", "cam02"]);
    assert!(matches!(error, ClipError::ImageSize { .. }));
    clip.write("images/cam02/frame_0002.png", clip.image(2, 2).encode_png());
    clip.write("masks/cam02/frame_0002.png", Image::filled(16, 11, [0.5; 3]).encode_png());
    clip.error(&["masks/cam02/frame_0002.png", "16x11"]);
}

#[test]
fn damaged_images_are_refused() {
    let clip = transforms();
    let whole = fs::read(clip.path("images/cam02/frame_0002.png")).unwrap();
    clip.write("images/cam02/frame_0002.png", &whole[..whole.len() - 30]);
    // The header is whole, so the damage shows when the image is read.
    let opened = clip.open().unwrap();
    for error in [opened.image(2, 1).unwrap_err(), opened.encoded_image(2, 1).unwrap_err()] {
        assert!(matches!(&error, ClipError::Undecodable { .. }));
        let message = error.to_string();
        assert!(message.contains("images/cam02/frame_0002.png") && message.contains("complete"), "{message}");
    }
    assert!(opened.image(2, 0).is_ok());
    for content in [&whole[..10], b"", b"plain text"] {
        clip.write("images/cam02/frame_0002.png", content);
        let error = clip.error(&["images/cam02/frame_0002.png"]);
        assert!(matches!(error, ClipError::Undecodable { .. }), "{error}");
    }
}

#[test]
fn images_that_change_after_opening_are_refused() {
    let clip = transforms();
    let opened = clip.open().unwrap();
    clip.write("images/cam00/frame_0001.png", Image::filled(8, 8, [0.5; 3]).encode_png());
    assert!(matches!(opened.image(0, 0), Err(ClipError::ImageSize { width: 8, .. })));
    assert!(matches!(opened.encoded_image(0, 0), Err(ClipError::ImageSize { width: 8, .. })));
    fs::remove_file(clip.path("images/cam00/frame_0001.png")).unwrap();
    assert!(matches!(opened.image(0, 0), Err(ClipError::Io { .. })));
}

#[test]
fn indices_past_the_end_are_errors() {
    let opened = transforms().open().unwrap();
    for (view, frame) in [(4, 0), (0, 3), (usize::MAX, usize::MAX)] {
        assert!(matches!(opened.image(view, frame), Err(ClipError::OutOfRange { .. })));
        assert!(matches!(opened.mask(view, frame), Err(ClipError::OutOfRange { .. })));
        assert!(matches!(opened.encoded_image(view, frame), Err(ClipError::OutOfRange { .. })));
        assert!(matches!(opened.encoded_mask(view, frame), Err(ClipError::OutOfRange { .. })));
    }
}

#[test]
fn masks_are_found_by_the_stem_of_the_image() {
    let clip = transforms();
    assert_eq!(clip.open().unwrap().mask(0, 0).unwrap(), None);
    assert_eq!(clip.open().unwrap().encoded_mask(0, 0).unwrap(), None);
    clip.write_masks();
    fs::remove_file(clip.path("masks/cam01/frame_0002.png")).unwrap();
    let opened = clip.open().unwrap();
    assert_eq!(opened.mask(1, 1).unwrap(), None);
    assert_eq!(*opened.mask(3, 2).unwrap().unwrap(), clip.mask(3, 3));
    let stored = fs::read(clip.path("masks/test00/frame_0003.png")).unwrap();
    assert_eq!(opened.encoded_mask(3, 2).unwrap(), Some(stored));
}

#[test]
fn formats_are_told_by_content() {
    use ::image::{ImageFormat, RgbImage};
    let clip = transforms();
    let picture = clip.image(0, 1);
    for format in [ImageFormat::Jpeg, ImageFormat::WebP] {
        let mut bytes = std::io::Cursor::new(Vec::new());
        RgbImage::from_raw(16, 12, picture.to_rgb8()).unwrap().write_to(&mut bytes, format).unwrap();
        clip.write("images/cam00/frame_0001.png", bytes.get_ref());
        let opened = clip.open().unwrap();
        let decoded = opened.image(0, 0).unwrap();
        let worst =
            picture.pixels.iter().zip(&decoded.pixels).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        // JPEG is lossy at the sawtooth's edges; WebP is written lossless.
        assert!(worst < if format == ImageFormat::WebP { 1e-6 } else { 0.5 }, "{format:?}: {worst}");
        assert_eq!(opened.encoded_image(0, 0).unwrap(), bytes.into_inner(), "the file passes through");
    }
}

#[test]
fn distorted_views_are_undistorted_for_everyone_alike() {
    let clip = Synthetic::new();
    clip.write_colmap();
    clip.write_masks();
    let pinhole = clip.open().unwrap();
    let passed = pinhole.encoded_image(0, 0).unwrap();
    assert_eq!(passed, fs::read(clip.path("images/cam00/frame_0001.png")).unwrap());

    clip.edit("sparse/0/cameras.txt", "1 PINHOLE 16 12 20 20 8 6", "1 SIMPLE_RADIAL 16 12 20 8 6 0");
    assert_eq!(
        clip.open().unwrap().encoded_image(0, 0).unwrap(),
        passed,
        "zero coefficients pass the file through"
    );
    assert_eq!(clip.open().unwrap().digest().unwrap(), pinhole.digest().unwrap());

    clip.edit("sparse/0/cameras.txt", "SIMPLE_RADIAL 16 12 20 8 6 0", "SIMPLE_RADIAL 16 12 20 8 6 -0.6");
    let opened = clip.open().unwrap();
    assert!(same_camera(&opened.views()[0].camera, &clip.views[0].camera), "intrinsics stay");
    let image = opened.image(0, 0).unwrap();
    assert_ne!(*image, clip.image(0, 1));
    assert_eq!(Image::decode(&opened.encoded_image(0, 0).unwrap()).unwrap(), *image);
    let mask = opened.mask(0, 0).unwrap().unwrap();
    assert_ne!(*mask, clip.mask(0, 1));
    assert_eq!(Mask::decode(&opened.encoded_mask(0, 0).unwrap().unwrap()).unwrap(), *mask);
    assert_eq!(*opened.image(1, 0).unwrap(), clip.image(1, 1), "other lenses are untouched");
    assert_ne!(opened.digest().unwrap(), pinhole.digest().unwrap());

    clip.edit("sparse/0/cameras.txt", "8 6 -0.6", "8 6 -30");
    let error = clip.error(&["cam00", "folds"]);
    assert!(matches!(error, ClipError::FoldingLens { .. }));
}

#[test]
fn the_digest_is_of_the_content() {
    let clip = transforms();
    clip.write_masks();
    let digest = || clip.open().unwrap().digest().unwrap();
    let original = digest();
    assert_eq!(original.len(), 64);
    assert_eq!(digest(), original);
    let elsewhere = transforms();
    elsewhere.write_masks();
    assert_eq!(elsewhere.open().unwrap().digest().unwrap(), original, "the folder's name does not matter");

    let mut seen = vec![original.clone()];
    let mut expect_new = |digest: String| {
        assert!(!seen.contains(&digest));
        seen.push(digest);
    };
    let opened_with = |options| Clip::open(clip.root(), &options).unwrap().digest().unwrap();
    expect_new(opened_with(options(|o| o.test_views = vec!["cam00".to_owned()])));
    expect_new(opened_with(options(|o| o.frames = Some((1, 2)))));
    expect_new(opened_with(options(|o| o.frames = Some((2, 3)))));
    assert_eq!(opened_with(options(|o| o.cache_bytes = 0)), original);

    clip.write("images/cam00/frame_0002.png", clip.image(0, 3).encode_png());
    expect_new(digest());
    clip.write("images/cam00/frame_0002.png", clip.image(0, 2).encode_png());
    assert_eq!(digest(), original);

    let mask = fs::read(clip.path("masks/cam01/frame_0001.png")).unwrap();
    fs::remove_file(clip.path("masks/cam01/frame_0001.png")).unwrap();
    expect_new(digest());
    clip.write("masks/cam01/frame_0001.png", mask);

    clip.edit("points3D.ply", "0.5 -1.25", "0.5 -1.26");
    expect_new(digest());
    clip.edit("points3D.ply", "0.5 -1.26", "0.5 -1.25");
    clip.edit("transforms/frame_0001.json", "\"cx\":7.25", "\"cx\":7.250001");
    expect_new(digest());
}

#[test]
fn exact_flow_is_beside_the_images() {
    let opened = transforms().open().unwrap();
    assert_eq!(opened.exact_flow_path(3), opened.root().join("flow/test00.npz"));
    assert!(!opened.exact_flow_path(99).exists());
}

/// The folder of shared clips beside the workspace, if this checkout has one.
fn shared() -> Option<PathBuf> {
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2)?.join("shared");
    shared.is_dir().then_some(shared)
}

#[test]
#[cfg(unix)]
fn the_shared_clips_say_the_same_in_every_layout() {
    use std::os::unix::fs::symlink;
    let Some(clips) = shared().map(|shared| shared.join("clips")) else {
        skip("no shared clips beside the workspace");
        return;
    };
    let root = clips.join("dev-slide");
    let reference = Clip::open(&root, &ClipOptions::default()).unwrap();
    assert_eq!(reference.frames(), (1..=10).collect::<Vec<_>>());
    assert_eq!(reference.points().len(), 8000);
    assert_eq!(reference.views().iter().filter(|view| view.split == Split::Test).count(), 2);
    assert!(reference.mask(0, 0).unwrap().is_some_and(|mask| mask.inside.contains(&true)));
    assert!(reference.exact_flow_path(0).is_file());
    let layouts: [(&[&str], Layout); 4] = [
        (&["transforms_train.json", "transforms_test.json", "points3D.ply"], Layout::Transforms),
        (&["transforms", "points3D.ply"], Layout::Transforms),
        (&["sparse", "sparse_test"], Layout::Colmap),
        (&["poses_bounds.npy", "cameras.json"], Layout::Llff),
    ];
    for (files, layout) in layouts {
        let folder = tempfile::tempdir().unwrap();
        for name in files.iter().chain(&["images", "masks"]) {
            symlink(root.join(name), folder.path().join(name)).unwrap();
        }
        let clip = Clip::open(folder.path(), &ClipOptions::default()).unwrap();
        assert_eq!(clip.layout(), layout);
        assert_eq!(clip.frames(), reference.frames());
        for (view, wanted) in clip.views().iter().zip(reference.views()) {
            assert_eq!((&view.name, view.split), (&wanted.name, wanted.split));
            // Text files keep 9 to 12 digits, transforms single precision: far below a pixel at this focal length.
            for (point, _) in reference.points().iter().zip(0..100) {
                let pixels =
                    [&view.camera, &wanted.camera].map(|camera| camera.project_world(point.position));
                assert!(
                    matches!(pixels, [Some(a), Some(b)] if (a - b).length() < 1e-3),
                    "{files:?} {pixels:?}"
                );
            }
        }
        assert_eq!(*clip.image(9, 9).unwrap(), *reference.image(9, 9).unwrap());
    }
}

#[test]
fn points_project_onto_their_own_colour() {
    // Right axes and pixel centres in one: the exact points of the shared clip carry the colour of the surface.
    let Some(root) = shared().map(|shared| shared.join("clips/dev-slide")) else {
        skip("no shared clips beside the workspace");
        return;
    };
    let clip = Clip::open(&root, &ClipOptions::default()).unwrap();
    let image = clip.image(0, 0).unwrap();
    let camera = &clip.views()[0].camera;
    let mut differences: Vec<f32> = clip
        .points()
        .iter()
        .filter_map(|point| {
            let pixel = camera.project_world(point.position)?;
            let inside = camera.contains(pixel) && pixel.x < 320.0 && pixel.y < 180.0;
            let seen = inside.then(|| image.at(pixel.x as usize, pixel.y as usize))?;
            Some((0..3).map(|c| (seen[c] - point.colour[c]).abs()).sum::<f32>() / 3.0)
        })
        .collect();
    differences.sort_by(f32::total_cmp);
    // Some points are hidden in this view; the median is not, and a mirrored or shifted camera gives about 0.2.
    assert!(
        differences.len() > 4000 && differences[differences.len() / 2] < 0.06,
        "{:?}",
        differences.get(differences.len() / 2)
    );
}

#[test]
fn real_data_opens() {
    let Some(real) = shared().map(|shared| shared.join("real")) else {
        skip("no shared data beside the workspace");
        return;
    };
    let rats = Clip::open(&real.join("dannce"), &ClipOptions::default()).unwrap();
    assert_eq!((rats.views().len(), rats.frames().len(), rats.points().len()), (5, 12, 0));
    assert!(rats.views().iter().all(|view| view.split == Split::Train));
    assert_eq!(rats.image(1, 11).unwrap().width, 664);
    let plush =
        Clip::open(&real.join("miku_plush"), &options(|o| o.test_views = vec!["20240212_003919".to_owned()]))
            .unwrap();
    assert_eq!((plush.views().len(), plush.frames(), plush.points().len()), (97, &[1][..], 25_784));
    assert_eq!(plush.views()[0].split, Split::Test);
    assert_eq!(plush.image(0, 0).unwrap().height, 742);
}
