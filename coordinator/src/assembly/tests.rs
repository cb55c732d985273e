//! The output folder as a reader finds it.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::fs;

use glam::{DMat3, DVec3};
use splat::{
    engine::{EngineError, Rendering, Session, SessionInput},
    frame::ViewMetrics,
    motion::{moments::FootprintMoments, reweighting::Reweighting},
    tracking::TrackField,
};

use super::{sequence::Sequence, *};

/// Renders everything in the colour of the first Gaussian's x coordinate.
struct FlatEngine;

impl Engine for FlatEngine {
    fn name(&self) -> &str {
        "flat"
    }

    fn render(&self, gaussians: &Gaussians, camera: &Camera, _: [f32; 3]) -> Result<Rendering, EngineError> {
        let image = Image::filled(camera.width, camera.height, [gaussians.means[0][0]; 3]);
        Ok(Rendering { alpha: vec![1.0; image.pixel_count()], image })
    }

    fn footprint_moments(
        &self,
        _: &Gaussians,
        _: &Camera,
        _: &TrackField,
        _: Option<&Reweighting>,
    ) -> Result<Vec<FootprintMoments>, EngineError> {
        Err(EngineError::InvalidInput("not needed here".into()))
    }

    fn session(&self, _: SessionInput) -> Result<Box<dyn Session>, EngineError> {
        Err(EngineError::InvalidInput("not needed here".into()))
    }
}

fn gaussians(x: f32) -> Gaussians {
    Gaussians {
        means: vec![[x, 0.0, 1.0]; 3],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; 3],
        log_scales: vec![[-1.0; 3]; 3],
        logit_opacities: vec![0.0; 3],
        sh: vec![0.0; 9],
        sh_degree: 0,
    }
}

fn digest() -> String {
    "ab".repeat(32)
}

fn delta_of(x: f32) -> Bytes {
    delta::encode(&gaussians(0.25), &[0xab; 32], &gaussians(x)).into()
}

fn camera() -> Camera {
    Camera {
        width: 40,
        height: 20,
        fx: 30.0,
        fy: 30.0,
        cx: 20.0,
        cy: 10.0,
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
    }
}

fn metrics(view: &str, psnr: f64, moving_psnr: Option<f64>) -> ViewMetrics {
    ViewMetrics { view: view.into(), psnr, ssim: 0.9, moving_psnr }
}

fn done_frame(number: u32) -> AssembledFrame {
    AssembledFrame {
        number,
        state: TaskState::Done,
        attempts: 2,
        worker: "worker-a".into(),
        report: Some(FrameReport {
            before: vec![metrics("test00", 20.0, None), metrics("mean", 20.0, None)],
            after: vec![metrics("test00", 30.0, Some(28.5)), metrics("mean", 30.0, Some(28.5))],
            ..FrameReport::default()
        }),
        seconds: 1.5,
        stage_seconds: BTreeMap::from([("refine".to_owned(), 1.25)]),
        delta: Some(delta_of(0.5)),
    }
}

fn failed_frame(number: u32) -> AssembledFrame {
    AssembledFrame { state: TaskState::Failed, report: None, delta: None, ..done_frame(number) }
}

fn grey_truth(_view: &str, _frame: u32) -> Option<Image> {
    Some(Image::filled(40, 20, [0.5; 3]))
}

fn input<'a>(output: &Path, settings: &'a Settings, frames: Vec<AssembledFrame>) -> AssemblyInput<'a> {
    let view = |name: &str, held_out| AssembledView { name: name.into(), held_out, camera: camera() };
    AssemblyInput {
        output: output.to_owned(),
        job_id: "job-1".into(),
        clip: sequence::SequenceClip { path: "clips/slide".into(), url: None, digest: digest() },
        settings,
        static_ply: ply::write_ply(&gaussians(0.25)).into(),
        static_report: serde_json::json!({ "steps": 10 }),
        frames,
        views: vec![view("cam00", false), view("test00", true)],
        test_image: &grey_truth,
        engine: &FlatEngine,
        stage_seconds: BTreeMap::from([("static-model".to_owned(), 4.0)]),
        bytes: BTreeMap::from([("tracks".to_owned(), 99)]),
    }
}

fn write_all(output: &Path, frames: Vec<AssembledFrame>) -> Result<(), AssemblyError> {
    for frame in &frames {
        if let Some(delta) = &frame.delta {
            write_frame(output, frame.number, &gaussians(0.25), &digest(), delta)?;
        }
    }
    write_outputs(&input(output, &Settings::default(), frames))
}

#[test]
fn a_finished_job_is_a_folder_that_reads_back() {
    let output = tempfile::tempdir().unwrap();
    write_all(output.path(), vec![done_frame(1), done_frame(2), failed_frame(3)]).unwrap();

    let sequence = Sequence::read(output.path()).unwrap();
    assert_eq!(sequence.clip.digest, digest());
    assert_eq!(sequence.settings, Settings::default());
    assert_eq!((sequence.static_model.gaussians, sequence.static_model.sh_degree), (3, 0));
    assert_eq!(sequence.views[1].camera, camera());
    assert_eq!(sequence.views[1].split, splat::clip::Split::Test);
    let states: Vec<_> = sequence.frames.iter().map(|frame| frame.state.as_str()).collect();
    assert_eq!(states, ["done", "done", "failed"]);
    assert_eq!(sequence.frames[2].ply, None);
    assert_eq!(sequence.frames[0].report, done_frame(1).report);

    let file = sequence.frames[1].ply.clone().unwrap();
    let bytes = fs::read(output.path().join(&file.path)).unwrap();
    assert_eq!(bytes.len() as u64, file.bytes);
    let frame = ply::parse_ply(&bytes).unwrap();
    assert!((frame.means[0][0] - 0.5).abs() < 1e-3, "{:?}", frame.means);
    assert_eq!(fs::read(output.path().join(delta_path(2))).unwrap(), delta_of(0.5));
    assert!(!output.path().join(frame_path(3)).exists());
}

#[test]
fn the_table_has_a_row_per_frame_and_view() {
    let output = tempfile::tempdir().unwrap();
    write_all(output.path(), vec![done_frame(1), failed_frame(2), done_frame(3)]).unwrap();
    let table = fs::read_to_string(output.path().join(METRICS)).unwrap();
    let rows: Vec<&str> = table.lines().collect();
    assert_eq!(rows.len(), 1 + 2 * 2, "{table}");
    assert!(rows[0].starts_with("frame,view,psnr_before"));
    assert_eq!(rows[1], "1,test00,20.0000,0.900000,,30.0000,0.900000,28.5000");
    assert!(rows[4].starts_with("3,mean,"));
}

#[test]
fn the_contact_sheet_shows_what_was_rendered() {
    let output = tempfile::tempdir().unwrap();
    write_all(output.path(), vec![done_frame(1), done_frame(2)]).unwrap();
    let sheet = Image::decode(&fs::read(output.path().join(CONTACT_SHEET)).unwrap()).unwrap();
    // Three tiles of 40 with four margins of 6; per row 20 and a caption line of 7 + 12, and a last margin.
    assert_eq!((sheet.width, sheet.height), (3 * 40 + 4 * 6, 2 * (20 + 19) + 6));
    let centre = |tile: usize| sheet.at(6 + tile * 46 + 20, 19 + 10)[0];
    // 8 bits: half a step of 1/255.
    assert!((centre(0) - 0.5).abs() < 0.003, "truth {}", centre(0));
    assert!((centre(1) - 0.5).abs() < 0.003, "reconstruction {}", centre(1));
    assert!(centre(2) < 0.01, "difference {}", centre(2));
    let has_caption = (0..40).any(|x| sheet.at(6 + x, 8)[0] > 0.9);
    assert!(has_caption, "the first caption is drawn");
}

#[test]
fn a_job_without_held_out_views_has_no_contact_sheet() {
    let output = tempfile::tempdir().unwrap();
    let settings = Settings::default();
    let mut input = input(output.path(), &settings, vec![failed_frame(1)]);
    input.views.pop();
    write_outputs(&input).unwrap();
    assert!(!output.path().join(CONTACT_SHEET).exists());
    assert!(output.path().join(SEQUENCE).exists());
}

#[test]
fn a_delta_of_another_static_model_writes_nothing() {
    let output = tempfile::tempdir().unwrap();
    let error =
        write_frame(output.path(), 7, &gaussians(0.25), &"cd".repeat(32), &delta_of(0.5)).unwrap_err();
    assert!(matches!(error, AssemblyError::Frame { frame: 7, .. }), "{error}");
    assert_eq!(fs::read_dir(output.path()).unwrap().count(), 0);
}

#[test]
fn a_frame_that_is_done_must_have_its_files() {
    let output = tempfile::tempdir().unwrap();
    let error = write_outputs(&input(output.path(), &Settings::default(), vec![done_frame(4)])).unwrap_err();
    assert!(error.to_string().contains("frame_0004.ply"), "{error}");
    assert!(!output.path().join(SEQUENCE).exists(), "an incomplete folder is not described as complete");
}

#[test]
fn another_schema_version_is_refused() {
    let output = tempfile::tempdir().unwrap();
    write_all(output.path(), vec![done_frame(1)]).unwrap();
    let path = output.path().join(SEQUENCE);
    let text = fs::read_to_string(&path).unwrap().replace("\"schema_version\": 1", "\"schema_version\": 2");
    fs::write(&path, text).unwrap();
    let error = Sequence::read(output.path()).unwrap_err().to_string();
    assert!(error.contains("schema version 2"), "{error}");
    assert!(
        Sequence::read(&output.path().join("elsewhere")).unwrap_err().to_string().contains("sequence.json")
    );
}
