//! Ten thousand steps of a session on a loss that nothing can lower: finite, bounded by what Adam can do, the same twice.

use std::sync::Arc;

use splat::{
    engine::{Engine, SessionInput, TrainingView},
    gaussians::Gaussians,
    image::Image,
    optim::LearningRates,
    raster::CpuEngine,
    simd::Instructions,
};

use crate::{
    row::{Bar, EXACT, Row},
    scenes::{blobs, camera},
};

/// No step of Adam exceeds its rate times `(1 - β₁) / √(1 - β₂)` (Kingma and Ba 2015, section 2.1).
const WAY: Bar = Bar {
    unit: "of the farthest Adam can go",
    factor: 1.0,
    why: "10 000 steps × rate × (1 - β₁) / √(1 - β₂)",
};

const STEPS: usize = 10_000;

const RATES: LearningRates = LearningRates {
    mean: 1e-3,
    rotation: 1e-3,
    log_scale: 5e-3,
    logit_opacity: 0.05,
    sh_dc: 5e-3,
    sh_rest: 2.5e-4,
    sh_degree: 1,
};

fn optimised(gaussians: &Gaussians, target: f32, instructions: Instructions) -> (Gaussians, Vec<f32>) {
    let input = SessionInput {
        gaussians: gaussians.clone(),
        views: vec![TrainingView {
            camera: camera(6, 5, 7.0),
            image: Arc::new(Image::filled(6, 5, [target; 3])),
            mask: None,
        }],
        background: [0.0; 3],
        dssim_weight: 0.2,
        frozen: Vec::new(),
    };
    let mut session = CpuEngine::new(instructions).session(input).unwrap();
    let losses = (0..STEPS).map(|_| session.step(0, &RATES).unwrap().loss).collect();
    (session.gaussians().unwrap(), losses)
}

/// Parameters with the rate of each.
fn parameters(gaussians: &Gaussians) -> Vec<(f64, f32)> {
    let with = |values: &[f32], rate: f32| values.iter().map(|&v| (f64::from(v), rate)).collect::<Vec<_>>();
    let mut all = with(gaussians.means.as_flattened(), RATES.mean);
    all.extend(with(gaussians.rotations.as_flattened(), RATES.rotation));
    all.extend(with(gaussians.log_scales.as_flattened(), RATES.log_scale));
    all.extend(with(&gaussians.logit_opacities, RATES.logit_opacity));
    let sh = gaussians.sh.iter().enumerate();
    all.extend(sh.map(|(k, &v)| (f64::from(v), if k % 12 < 3 { RATES.sh_dc } else { RATES.sh_rest })));
    all
}

fn rows_of(extreme: &'static str, remark: &str, target: f32, change: fn(&mut Gaussians)) -> [Row; 2] {
    let mut way = Row::new("session", extreme, WAY).remark(remark);
    let mut same = Row::new("session", extreme, EXACT).remark("twice the same bytes, every loss a number");
    let mut start = blobs(5, 31);
    change(&mut start);
    let farthest = |rate: f32| STEPS as f64 * f64::from(rate) * (1.0 - 0.9) / (1.0_f64 - 0.999).sqrt();
    for instructions in Instructions::available() {
        let (end, losses) = optimised(&start, target, instructions);
        let ways = parameters(&start).into_iter().zip(parameters(&end));
        way.case_of(ways.map(|((from, rate), (to, _))| ((to - from).abs() / farthest(rate), 1.0)));
        same.exact(losses.iter().all(|loss| loss.is_finite()));
        same.exact(optimised(&start, target, instructions) == (end, losses));
    }
    [way, same]
}

/// Every row of this sweep.
pub(crate) fn rows() -> Vec<Row> {
    let opaque = rows_of(
        "10 000 steps, target brighter than any",
        "harmonics grow at full rate, opacity stays saturated",
        1e6,
        |set| {
            set.logit_opacities.fill(50.0);
        },
    );
    let black = rows_of(
        "10 000 steps, black Gaussians before a white target",
        "nothing moves: no gradient passes the clamps of colour and alpha",
        1.0,
        |set| {
            set.logit_opacities.fill(50.0);
            set.sh.fill(-3.0);
        },
    );
    let reached = rows_of("10 000 steps, target reached by the background", "", 0.0, |set| {
        set.logit_opacities.fill(-3.0)
    });
    let pile = rows_of("10 000 steps, identical opaque Gaussians", "", 0.5, |set| {
        set.means.fill([0.0; 3]);
        set.log_scales.fill([0.5; 3]);
        set.logit_opacities.fill(12.0);
    });
    [opaque, black, reached, pile].into_iter().flatten().collect()
}
