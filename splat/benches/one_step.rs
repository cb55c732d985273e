//! One optimisation step for a simulator that counts instructions. `cargo xtask bench instructions` runs it.
//!
//! The simulator writes and resets its counters at the end of each function whose name starts with `counted_`; what
//! follows is the stage's name. Nothing else runs between two of them, but before `counted_nothing`.
#![allow(missing_docs, reason = "a program")]

#[path = "scene/mod.rs"]
mod scene;
#[path = "step/mod.rs"]
mod step;

use splat::{engine::Session, optim::LearningRates};

use self::{
    scene::{SceneSize, generate},
    step::{Stages, rates, session},
};

/// The scene of the record: small, as the simulator is fifty times slower than the machine.
const SIZE: SceneSize = SceneSize { gaussians: 2000, width: 160, height: 90, sh_degree: 3 };

fn main() {
    // The pool of one: everything runs on this thread, and counts are the same every time.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build();
    let _pool = pool.unwrap_or_else(|error| panic!("a pool of this thread: {error}"));
    let scene = generate(SIZE);
    let mut stages = Stages::new(&scene);
    // The first step allocates, and all others are like the second.
    stages.run();
    counted_nothing();
    counted_project(&mut stages);
    counted_bin(&mut stages);
    counted_blend(&mut stages);
    counted_loss(&mut stages);
    counted_blend_backward(&mut stages);
    counted_descend(&mut stages);

    let mut session = session(&scene).unwrap_or_else(|error| panic!("a generated scene: {error}"));
    let rates = rates(SIZE.sh_degree);
    session.step(0, &rates).unwrap_or_else(|error| panic!("the first step: {error}"));
    counted_nothing();
    counted_step(session.as_mut(), &rates);
}

/// Ends what is not counted.
#[inline(never)]
fn counted_nothing() {
    std::hint::black_box(());
}

macro_rules! counted {
    ($($name:ident = $stage:ident),*) => {
        $(
            #[inline(never)]
            fn $name(stages: &mut Stages) {
                stages.$stage();
            }
        )*
    };
}

counted!(
    counted_project = project,
    counted_bin = bin,
    counted_blend = blend,
    counted_loss = loss,
    counted_blend_backward = blend_backward,
    counted_descend = descend
);

#[inline(never)]
fn counted_step(session: &mut dyn Session, rates: &LearningRates) {
    if let Err(error) = session.step(0, rates) {
        panic!("the second step: {error}");
    }
}
