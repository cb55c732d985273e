//! Scratch: static model of frame 1 and held-out PSNR.
use glam::{DMat3, DVec3};
use splat::{cameras::Camera, engine::*, image::*, raster::*, settings::*, static_model::*};
use std::{ops::ControlFlow, sync::Arc, time::Instant};
fn psnr(a: &Image, b: &Image, m: Option<&Mask>) -> f64 {
    let mut s = 0.0;
    let mut n = 0.0;
    for p in 0..a.pixel_count() {
        if m.is_some_and(|m| !m.inside[p]) {
            continue;
        }
        for c in 0..3 {
            let d = (a.pixels[3 * p + c].clamp(0., 1.) - b.pixels[3 * p + c]) as f64;
            s += d * d;
            n += 1.0;
        }
    }
    -10.0 * (s / n).log10()
}
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let root = std::path::PathBuf::from(&args[1]);
    let mut settings = serde_json::to_value(StaticModelSettings::preset(Quality::Balanced)).unwrap();
    for kv in &args[2..] {
        let (k, v) = kv.split_once('=').unwrap();
        assert!(settings.get(k).is_some(), "{k}");
        settings[k] = serde_json::from_str(v).unwrap();
    }
    let settings: StaticModelSettings = serde_json::from_value(settings).unwrap();
    let cams: serde_json::Value =
        serde_json::from_slice(&std::fs::read(root.join("cameras.json")).unwrap()).unwrap();
    let mut train = vec![];
    let mut test = vec![];
    for c in cams["cameras"].as_array().unwrap() {
        let name = c["name"].as_str().unwrap();
        let m = |i: usize, j: usize| c["w2c_opencv"][i][j].as_f64().unwrap();
        let camera = Camera {
            width: cams["width"].as_u64().unwrap() as u32,
            height: cams["height"].as_u64().unwrap() as u32,
            fx: c["fx"].as_f64().unwrap(),
            fy: c["fy"].as_f64().unwrap(),
            cx: c["cx"].as_f64().unwrap(),
            cy: c["cy"].as_f64().unwrap(),
            rotation: DMat3::from_cols(
                DVec3::new(m(0, 0), m(1, 0), m(2, 0)),
                DVec3::new(m(0, 1), m(1, 1), m(2, 1)),
                DVec3::new(m(0, 2), m(1, 2), m(2, 2)),
            ),
            translation: DVec3::new(m(0, 3), m(1, 3), m(2, 3)),
        };
        let image =
            Image::decode(&std::fs::read(root.join(format!("images/{name}/frame_0001.png"))).unwrap())
                .unwrap();
        if c["split"] == "train" {
            train.push(TrainingView { camera, image: Arc::new(image), mask: None });
        } else {
            let mask =
                Mask::decode(&std::fs::read(root.join(format!("masks/{name}/frame_0001.png"))).unwrap())
                    .unwrap();
            test.push((camera, image, mask));
        }
    }
    let mut points = vec![];
    for line in std::fs::read_to_string(root.join("sparse/0/points3D.txt"))
        .unwrap()
        .lines()
        .filter(|l| !l.starts_with('#'))
    {
        let f: Vec<f64> = line.split_whitespace().take(7).map(|x| x.parse().unwrap()).collect();
        points.push(SfmPoint {
            position: DVec3::new(f[1], f[2], f[3]),
            colour: [f[4] as f32 / 255., f[5] as f32 / 255., f[6] as f32 / 255.],
        });
    }
    let start = Instant::now();
    let input = StaticModelInput { views: train.clone(), points, background: [0.0; 3], seed: 0, settings };
    let mut ema = 0.0f32;
    let g = reconstruct(&CpuEngine, &input, &mut |p| {
        ema = if p.step == 1 { p.loss } else { ema * 0.98 + 0.02 * p.loss };
        if p.step % 250 == 0 {
            eprintln!("{} {:.1}s n={} loss={:.4}", p.step, start.elapsed().as_secs_f64(), p.gaussians, ema);
        }
        ControlFlow::Continue(())
    })
    .unwrap();
    let t = start.elapsed().as_secs_f64();
    let (mut a, mut b, mut tr) = (0.0, 0.0, 0.0);
    for (c, i, m) in &test {
        let r = render(&g, c, [0.0; 3]);
        a += psnr(&r.image, i, None);
        b += psnr(&r.image, i, Some(m));
    }
    for v in &train {
        tr += psnr(&render(&g, &v.camera, [0.0; 3]).image, &v.image, None);
    }
    println!(
        "n={} time={t:.1}s test={:.2} moving={:.2} train={:.2}",
        g.len(),
        a / test.len() as f64,
        b / test.len() as f64,
        tr / train.len() as f64
    );
}
