#![allow(clippy::all, clippy::unwrap_used, clippy::print_stdout, missing_docs)]
use npyz::npz::NpzArchive;
use splat::{
    cameras::Camera,
    gaussians::{Gaussians, gradients::GaussianGradients},
    image::Image,
    loss::*,
    optim::*,
    raster::Pass,
};
use std::time::Instant;
fn v(a: &mut NpzArchive<std::io::BufReader<std::fs::File>>, n: &str) -> Vec<f32> {
    a.by_name(n).unwrap().unwrap().into_vec::<f32>().unwrap()
}
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let reps: usize = args[2].parse().unwrap();
    let threads: usize = args.get(3).map_or(1, |t| t.parse().unwrap());
    let mut a = NpzArchive::open(&args[1]).unwrap();
    let c3 = |x: Vec<f32>| x.as_chunks::<3>().0.to_vec();
    let sh = v(&mut a, "sh");
    let means = c3(v(&mut a, "mean"));
    let n = means.len();
    let degree = match sh.len() / n {
        48 => 3,
        3 => 0,
        _ => panic!(),
    };
    let g = Gaussians {
        means,
        rotations: v(&mut a, "rotation").as_chunks::<4>().0.to_vec(),
        log_scales: c3(v(&mut a, "log_scale")),
        logit_opacities: v(&mut a, "logit_opacity"),
        sh,
        sh_degree: degree,
    };
    let k = v(&mut a, "intrinsics");
    let target = v(&mut a, "target");
    let (w, h) = ((k[2] * 2.0) as u32, (k[3] * 2.0) as u32);
    let camera = Camera {
        width: w,
        height: h,
        fx: k[0].into(),
        fy: k[1].into(),
        cx: k[2].into(),
        cy: k[3].into(),
        rotation: glam::DMat3::IDENTITY,
        translation: glam::DVec3::ZERO,
    };
    let target = Image { width: w, height: h, pixels: target };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| {
        let loss = PhotometricLoss::new(&target, None, 0.2);
        let mut ws = LossWorkspace::default();
        let mut pass = Pass::default();
        let mut order = vec![];
        let mut g2 = g.clone();
        let mut adam = Adam::new(&g2);
        let mut grads = GaussianGradients::zeros(&g2);
        let mut image = Image::filled(w, h, [0.0; 3]);
        let mut ig = vec![0.0; image.pixels.len()];
        let rates = LearningRates {
            mean: 1e-7,
            rotation: 1e-7,
            log_scale: 1e-7,
            logit_opacity: 1e-7,
            sh_dc: 1e-7,
            sh_rest: 1e-7,
            sh_degree: degree,
        };
        let mut t = vec![vec![]; 8];
        for _ in 0..reps {
            let all = Instant::now();
            let mut s = Instant::now();
            let mut lap = |i: usize, t: &mut Vec<Vec<f64>>| {
                t[i].push(s.elapsed().as_secs_f64() * 1e3);
                s = Instant::now();
            };
            pass.project(&g2, &camera, degree);
            lap(0, &mut t);
            pass.bin(&camera, &mut order);
            lap(1, &mut t);
            pass.blend(&camera, [0.0; 3], &[], &mut image, &mut []);
            lap(2, &mut t);
            loss.evaluate(&image, &mut ws, &mut ig);
            lap(3, &mut t);
            pass.blend_backward([0.0; 3], &ig, &[]);
            lap(4, &mut t);
            pass.project_backward(&g2, &camera, degree, &[], &mut grads);
            lap(5, &mut t);
            adam.step(&mut g2, &grads, &rates, None);
            lap(6, &mut t);
            t[7].push(all.elapsed().as_secs_f64() * 1e3);
        }
        for (name, t) in
            ["project", "bin", "blend", "loss", "blend_bw", "project_bw", "adam", "all"].iter().zip(&mut t)
        {
            t.sort_by(f64::total_cmp);
            println!("{name:12} median {:8.2}  min {:8.2}", t[t.len() / 2], t[0]);
        }
    });
}
