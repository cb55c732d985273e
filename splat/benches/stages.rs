//! Criterion benchmarks of each stage of an optimisation step, and of the whole, on one thread.

// criterion's own macros make items without documentation.
#![allow(missing_docs, reason = "macros of criterion")]

#[path = "scene/mod.rs"]
mod scene;
#[path = "step/mod.rs"]
mod step;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};

use self::{
    scene::{Scene, SceneSize, generate},
    step::{STAGES, Stages, rates, session},
};

const SMALL: SceneSize = SceneSize { gaussians: 10_000, width: 320, height: 180, sh_degree: 3 };
const LARGE: SceneSize = SceneSize { gaussians: 100_000, width: 640, height: 360, sh_degree: 3 };

fn stages(criterion: &mut Criterion) {
    // The pool of one: everything below runs on this thread.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build();
    let _pool = pool.unwrap_or_else(|error| panic!("a pool of this thread: {error}"));
    for (size, samples) in [(SMALL, 50), (LARGE, 10)] {
        let scene = generate(size);
        let name = format!("{}k-{}x{}", size.gaussians / 1000, size.width, size.height);
        each_stage(criterion, &scene, &name, samples);
        whole_step(criterion, &scene, &name, samples);
    }
}

fn each_stage(criterion: &mut Criterion, scene: &Scene, name: &str, samples: usize) {
    let mut stages = Stages::new(scene);
    // Each stage finds what the ones before it leave.
    stages.run();
    for (stage, run) in STAGES {
        let mut group = criterion.benchmark_group(stage);
        group.sample_size(samples);
        group.bench_function(BenchmarkId::from_parameter(name), |bencher| bencher.iter(|| run(&mut stages)));
        group.finish();
        stages.run();
    }
}

fn whole_step(criterion: &mut Criterion, scene: &Scene, name: &str, samples: usize) {
    let mut session = session(scene).unwrap_or_else(|error| panic!("a generated scene: {error}"));
    let rates = rates(scene.gaussians.sh_degree);
    let mut group = criterion.benchmark_group("step");
    group.sample_size(samples);
    group.bench_function(BenchmarkId::from_parameter(name), |bencher| {
        bencher.iter(|| session.step(0, &rates).unwrap_or_else(|error| panic!("a step: {error}")));
    });
    group.finish();
}

criterion_group!(benches, stages);
criterion_main!(benches);
