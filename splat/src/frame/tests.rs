#![allow(clippy::unwrap_used, reason = "tests")]

use super::*;
use crate::{
    raster::CpuEngine,
    testing::{arc, blobs, on_threads, render},
};

const BLACK: [f32; 3] = [0.0; 3];

/// Tracks of a scene whose every pixel moves by the same displacement in the image.
fn tracks(camera: &Camera, displacement: [f32; 2]) -> Arc<TrackField> {
    let (width, height) = (camera.width, camera.height);
    let at = |pixel: u32| {
        [(pixel % width) as f32 + 0.5 + displacement[0], (pixel / width) as f32 + 0.5 + displacement[1]]
    };
    let pixels = (width * height) as usize;
    Arc::new(TrackField {
        width,
        height,
        positions: (0..width * height).map(at).collect(),
        visible: vec![true; pixels],
        sigma: vec![0.2; pixels],
    })
}

/// A scene of which frame 2 shows `moved`, with tracks that say `displacement` in every view.
fn input(moved: &Gaussians, displacement: [f32; 2]) -> FrameInput {
    let view = |(number, camera): (usize, Camera), tracks: Option<Arc<TrackField>>| FrameView {
        name: format!("cam{number:02}"),
        image: Arc::new(render(moved, &camera, BLACK).image),
        mask: Some(Arc::new(Mask { width: 80, height: 60, inside: vec![true; 4800] })),
        tracks,
        camera,
    };
    let cameras = arc(5, 80, 60);
    let test = cameras[2].clone();
    let training = cameras.into_iter().enumerate().filter(|(number, _)| *number != 2);
    let mut settings = Settings::default();
    settings.refine.iterations = 12;
    FrameInput {
        static_model: Arc::new(blobs(60, 1)),
        training_views: training
            .map(|(number, camera)| {
                let tracks = tracks(&camera, displacement);
                view((number, camera), Some(tracks))
            })
            .collect(),
        test_views: vec![view((2, test), None)],
        settings,
        is_key_frame: false,
    }
}

/// The scene a tenth of a unit lower; at four units and a focal length of 80 pixels that is two pixels.
fn lowered() -> Gaussians {
    let mut moved = blobs(60, 1);
    for mean in &mut moved.means {
        mean[1] += 0.1;
    }
    moved
}

fn go_on(_: FrameProgress) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

#[test]
fn the_key_frame_is_evaluated_and_left_alone() {
    let mut input = input(&blobs(60, 1), [0.0; 2]);
    input.is_key_frame = true;
    let result = reconstruct_frame(&CpuEngine::default(), &input, &mut go_on).unwrap();
    assert_eq!(result.gaussians, *input.static_model);
    assert_eq!(result.report.before, result.report.after);
    assert_eq!(result.report.after.last().unwrap().view, "mean");
    assert_eq!(result.report.after[0].psnr, metrics::PSNR_CAP);
}

#[test]
fn tracks_move_the_model_before_refinement() {
    let input = input(&lowered(), [0.0, 2.0]);
    let result = reconstruct_frame(&CpuEngine::default(), &input, &mut go_on).unwrap();
    assert!(!result.report.rolled_back);
    let solved = result.report.motion.solved;
    assert!(solved > 30, "{:?}", result.report.motion);
    assert!(result.report.orders.translation > 60, "{:?}", result.report.orders);
    let mut still = input.clone();
    still.settings.motion_source = MotionSource::None;
    let without = reconstruct_frame(&CpuEngine::default(), &still, &mut go_on).unwrap();
    let gain = result.report.before[0].psnr - without.report.before[0].psnr;
    assert!(gain > 3.0, "{gain} dB better than no motion");
    assert_eq!(without.report.motion, MotionCounts::default());
}

#[test]
fn motion_that_renders_worse_is_undone() {
    let input = input(&blobs(60, 1), [0.0, 6.0]);
    let result = reconstruct_frame(&CpuEngine::default(), &input, &mut go_on).unwrap();
    assert!(result.report.rolled_back);
    assert_eq!(result.report.before[0].psnr, metrics::PSNR_CAP, "it starts from the key frame");
}

#[test]
fn resting_tracks_leave_every_gaussian_static() {
    let input = input(&blobs(60, 1), [0.0; 2]);
    let result = reconstruct_frame(&CpuEngine::default(), &input, &mut go_on).unwrap();
    let counts = result.report.motion;
    assert_eq!((counts.solved, counts.propagated), (0, 0), "{counts:?}");
    let orders = result.report.orders;
    assert!(orders.r#static > 100, "{orders:?}");
    assert_eq!((orders.translation, orders.similarity, orders.affine), (0, 0, 0), "{orders:?}");
}

#[test]
fn any_number_of_threads_gives_the_same_bytes() {
    let input = input(&lowered(), [0.0, 2.0]);
    let run = |threads| {
        on_threads(threads, || reconstruct_frame(&CpuEngine::default(), &input, &mut go_on).unwrap())
    };
    let (one, three) = (run(1), run(3));
    assert_eq!(one.gaussians, three.gaussians);
    assert_eq!(one.report, three.report);
}

#[test]
fn it_stops_when_asked() {
    let input = input(&lowered(), [0.0, 2.0]);
    let mut stop = |progress: FrameProgress| {
        if progress.stage == "refine" { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    assert!(matches!(
        reconstruct_frame(&CpuEngine::default(), &input, &mut stop),
        Err(FrameError::Cancelled)
    ));
}

#[test]
fn what_does_not_fit_is_bad_input() {
    let refused = |change: &dyn Fn(&mut FrameInput)| {
        let mut input = input(&lowered(), [0.0; 2]);
        change(&mut input);
        matches!(reconstruct_frame(&CpuEngine::default(), &input, &mut go_on), Err(FrameError::BadInput(_)))
    };
    assert!(refused(&|input| input.training_views.clear()), "no view");
    assert!(refused(&|input| input.test_views[0].image = Arc::new(Image::filled(2, 2, BLACK))), "image");
    let small = Mask { width: 1, height: 1, inside: vec![true] };
    assert!(refused(&|input| input.training_views[1].mask = Some(Arc::new(small.clone()))), "mask");
    assert!(refused(&|input| {
        Arc::make_mut(&mut input.static_model).means[3][0] = f32::NAN;
    }));
}

#[test]
fn tracks_out_of_a_training_mask_move_nothing() {
    let mut input = input(&lowered(), [0.0, 2.0]);
    input.settings.masks = MaskUse::Train;
    let counted = |input: &FrameInput| {
        reconstruct_frame(&CpuEngine::default(), input, &mut go_on).unwrap().report.orders
    };
    let seen = counted(&input);
    for view in &mut input.training_views {
        // The right half.
        let inside = (0..4800).map(|pixel| pixel % 80 >= 40).collect();
        view.mask = Some(Arc::new(Mask { width: 80, height: 60, inside }));
    }
    let half = counted(&input);
    assert!(half.translation * 4 < seen.translation * 3, "{half:?} of {seen:?}");
    input.settings.masks = MaskUse::Evaluate;
    assert_eq!(counted(&input), seen, "masks that only mark what is reported do not matter");
}

#[test]
fn the_mean_over_views_counts_only_views_with_a_moving_region() {
    let view = |psnr, moving_psnr| ViewMetrics { view: "a".into(), psnr, ssim: 0.5, moving_psnr };
    let mean = mean(&[view(20.0, Some(10.0)), view(30.0, None)]).unwrap();
    assert_eq!((mean.psnr, mean.moving_psnr), (25.0, Some(10.0)));
    assert_eq!(super::mean(&[]), None);
}
