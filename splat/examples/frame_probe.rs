//! Scratch: whole pipeline on a clip, in one process.
use std::{ops::ControlFlow, sync::Arc, time::Instant};
use rayon::prelude::*;
use splat::{clip::*, engine::*, formats::*, frame::*, raster::*, settings::*, static_model::*};
fn set(v: &mut serde_json::Value, key: &str, value: &str) {
    let mut at = v;
    for k in key.split('.') { at = at.get_mut(k).unwrap_or_else(|| panic!("{key}")); }
    *at = serde_json::from_str(value).unwrap();
}
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let clip = Clip::open(args[1].as_ref(), &ClipOptions::default()).unwrap();
    let source = args[2].as_str(); // exact | own | none
    let frames: Vec<usize> = args[3].split(',').map(|x| x.parse::<usize>().unwrap() - 1).collect();
    let mut v = serde_json::to_value(Settings::preset(Quality::Balanced)).unwrap();
    for kv in &args[4..] { let (k, x) = kv.split_once('=').unwrap(); set(&mut v, k, x); }
    let mut settings: Settings = serde_json::from_value(v).unwrap();
    if source == "none" { settings.motion_source = MotionSource::None; }
    let key = blake3::hash(format!("{} {:?}", args[1], settings.static_model).as_bytes()).to_hex()[..12].to_string();
    let ply = format!("/tmp/probe-{key}.ply");
    let train: Vec<usize> = (0..clip.views().len()).filter(|&v| clip.views()[v].split == Split::Train).collect();
    let test: Vec<usize> = (0..clip.views().len()).filter(|&v| clip.views()[v].split == Split::Test).collect();
    let t = Instant::now();
    if !std::path::Path::new(&ply).exists() {
        let views = train.iter().map(|&v| TrainingView { camera: clip.views()[v].camera.clone(), image: clip.image(v, 0).unwrap(), mask: None }).collect();
        let g = reconstruct(&CpuEngine, &StaticModelInput { views, points: clip.points().to_vec(), background: [0.0; 3], seed: 0, settings: settings.static_model.clone() }, &mut |_| ControlFlow::Continue(())).unwrap();
        std::fs::write(&ply, ply::write_ply(&g)).unwrap();
        println!("static {:.1}s", t.elapsed().as_secs_f64());
    }
    let model = Arc::new(ply::read_ply(ply.as_ref()).unwrap());
    println!("n={} degree={}", model.len(), model.sh_degree);
    let t = Instant::now();
    let fields: Vec<Vec<splat::tracking::TrackField>> = match source {
        "exact" => train.iter().map(|&v| track_npz::read_exact_flow(&clip.exact_flow_path(v)).unwrap()).collect(),
        "own" => train.par_iter().map(|&v| {
            let p = format!("/tmp/probe-tracks-{}-{}.bin", blake3::hash(args[1].as_bytes()).to_hex().to_string().split_at(8).0, v);
            let last = *frames.iter().max().unwrap() + 1;
            let _ = &p;
            let mut out = vec![];
            splat::tracking::track_view::<ClipError>(last, &mut |i| clip.image(v, i), &settings.tracking, &mut |_, f| { out.push(f); Ok(()) }).unwrap();
            out
        }).collect(),
        _ => vec![],
    };
    println!("tracks {:.1}s", t.elapsed().as_secs_f64());
    let mut sum = [0.0; 4];
    let mut n = 0.0;
    for &f in &frames {
        let view = |&v: &usize, i: Option<usize>| FrameView { name: clip.views()[v].name.clone(), camera: clip.views()[v].camera.clone(), image: clip.image(v, f).unwrap(), mask: clip.mask(v, f).unwrap(), tracks: i.filter(|_| f > 0 && !fields.is_empty()).map(|i| Arc::new(fields[i][f - 1].clone())) };
        let input = FrameInput { static_model: model.clone(), training_views: train.iter().enumerate().map(|(i, v)| view(v, Some(i))).collect(), test_views: test.iter().map(|v| view(v, None)).collect(), settings: settings.clone(), is_key_frame: f == 0 };
        let mut stages: Vec<(&str, Instant)> = vec![];
        let r = reconstruct_frame(&CpuEngine, &input, &mut |p| { if stages.last().is_none_or(|s| s.0 != p.stage) { stages.push((p.stage, Instant::now())); } ControlFlow::Continue(()) }).unwrap();
        let end = Instant::now();
        let times: Vec<String> = stages.iter().enumerate().map(|(i, s)| format!("{} {:.1}", s.0, (stages.get(i + 1).map_or(end, |n| n.1) - s.1).as_secs_f64())).collect();
        let (b, a) = (r.report.before.last().unwrap(), r.report.after.last().unwrap());
        println!("frame {:2} {:.2}/{:.2} -> {:.2}/{:.2} {:?} rb={} steps={} loss={:?} {}", f + 1, b.psnr, b.moving_psnr.unwrap_or(0.0), a.psnr, a.moving_psnr.unwrap_or(0.0), r.report.motion, r.report.rolled_back, r.report.refine_steps, r.report.refine_loss, times.join(", "));
        for (i, v) in input.test_views.iter().enumerate() { let im = render(&r.gaussians, &v.camera, [0.0; 3]).image; std::fs::write(format!("/tmp/probe_f{}_{i}.png", f + 1), im.encode_png()).unwrap(); std::fs::write(format!("/tmp/probe_t{}_{i}.png", f + 1), v.image.encode_png()).unwrap(); }
        if f > 0 { for (s, x) in sum.iter_mut().zip([b.psnr, b.moving_psnr.unwrap_or(0.0), a.psnr, a.moving_psnr.unwrap_or(0.0)]) { *s += x; } n += 1.0; }
    }
    println!("mean 2..: before {:.2}/{:.2} after {:.2}/{:.2}", sum[0] / n, sum[1] / n, sum[2] / n, sum[3] / n);
}
