//! A device that goes away or hangs, and one that is asked for what its rules forbid.

use std::{
    sync::{
        Arc, OnceLock,
        atomic::{AtomicU32, Ordering::SeqCst},
    },
    time::Duration,
};

use splat::engine::{Engine, EngineError, Session, SessionInput};

use wgpu::{BufferDescriptor, BufferUsages, PollError, PollType};

use super::{
    BLACK, RATES, black_view,
    support::{arc, blobs, engine, open},
};
use crate::{
    GpuEngine,
    buffers::{Request, allocate},
    session::GpuSession,
    transfer::read,
};

fn input() -> SessionInput {
    black_view(blobs(10, 0, 1), 17, 13)
}

#[test]
fn a_lost_device_is_an_error_of_its_own() {
    if engine().is_none() {
        return;
    }
    // Not the one that other tests use.
    let doomed = GpuEngine::new(open()).unwrap();
    let mut session = doomed.session(input()).unwrap();
    session.step(0, &RATES).unwrap();
    doomed.context.device.device.destroy();
    // A step only submits: what became of it shows where something is read back.
    let outcome = session.step(0, &RATES).and_then(|()| session.take_losses());
    assert!(matches!(outcome, Err(EngineError::DeviceLost(_))), "{outcome:?}");
    let outcome = session.gaussians();
    assert!(matches!(outcome, Err(EngineError::DeviceLost(_))), "{outcome:?}");
    let outcome = doomed.render(&blobs(10, 0, 1), &arc(1, 17, 13)[0], BLACK);
    assert!(matches!(outcome, Err(EngineError::DeviceLost(_))), "{outcome:?}");
}

#[test]
fn a_device_that_hangs_is_lost_after_its_time() {
    if engine().is_none() {
        return;
    }
    // Waits as one does for work without end: until the time is over that the engine gives.
    let device = open().with_patience(Duration::from_secs(7)).with_poll(|_, until| match until {
        PollType::Wait { timeout: Some(patience), .. } if patience == Duration::from_secs(7) => {
            Err(PollError::Timeout)
        }
        other => panic!("waits without end: {other:?}"),
    });
    let hung = GpuEngine::new(device).unwrap();
    let mut session = hung.session(input()).unwrap();
    session.step(0, &RATES).unwrap();
    let outcome = session.take_losses();
    assert!(
        matches!(&outcome, Err(EngineError::DeviceLost(why)) if why.contains("hangs") && why.contains("7 s")),
        "{outcome:?}"
    );
    let outcome = hung.render(&blobs(10, 0, 1), &arc(1, 17, 13)[0], BLACK);
    assert!(matches!(outcome, Err(EngineError::DeviceLost(_))), "{outcome:?}");
    assert!(matches!(hung.check(), Err(EngineError::DeviceLost(_))));
}

#[test]
fn steps_do_not_run_far_ahead_of_the_device() {
    if engine().is_none() {
        return;
    }
    let device = open().with_poll(|_, _| Err(PollError::Timeout));
    let mut session = GpuEngine::new(device).unwrap().session(input()).unwrap();
    let taken = (0..100).take_while(|_| session.step(0, &RATES).is_ok()).count();
    assert_eq!(taken, 16, "the next one waits for the first");
}

#[test]
fn a_broken_rule_fails_who_broke_it_and_nobody_else() {
    let Some(engine) = engine() else { return };
    let device = &engine.context.device;
    let (gaussians, camera) = (blobs(10, 0, 1), arc(1, 17, 13).swap_remove(0));
    let mut good = engine.session(input()).unwrap();
    let mut bad = GpuSession::new(Arc::clone(&engine.context), input()).unwrap();
    bad.break_buffers();
    good.step(0, &RATES).unwrap();
    for _ in 0..2 {
        let outcome = bad.step(0, &RATES).and_then(|()| bad.take_losses());
        assert!(matches!(outcome, Err(EngineError::Internal(_))), "{outcome:?}");
    }
    drop(bad);
    // A copy from a buffer that is not for copies.
    let outcome = device.guarded(|| {
        let usage = BufferUsages::UNIFORM;
        let [closed] = allocate(device, [Request { label: "closed", bytes: 64, usage }])?;
        read::<u32>(device, &closed, 4)
    });
    assert!(matches!(outcome, Err(EngineError::Internal(_))), "{outcome:?}");
    engine.check().unwrap();
    engine.render(&gaussians, &camera, BLACK).unwrap();
    good.step(0, &RATES).unwrap();
    assert_eq!(good.take_losses().unwrap().len(), 2);
}

#[test]
fn a_rule_that_was_broken_elsewhere_fails_no_job() {
    if engine().is_none() {
        return;
    }
    let engine = GpuEngine::new(open()).unwrap();
    let device = &engine.context.device;
    // Outside of every job: a buffer beyond all limits.
    let descriptor = BufferDescriptor {
        label: None,
        size: 1 << 60,
        usage: BufferUsages::STORAGE,
        mapped_at_creation: false,
    };
    drop(device.device.create_buffer(&descriptor));
    engine.render(&blobs(10, 0, 1), &arc(1, 17, 13)[0], BLACK).unwrap();
}

#[test]
fn a_device_that_goes_away_while_it_is_waited_for_is_lost() {
    if engine().is_none() {
        return;
    }
    // As wgpu does where the driver answers a wait with a loss.
    let device = open().with_poll(|_, _| panic!("Error in Device::poll: Parent device is lost"));
    let doomed = GpuEngine::new(device).unwrap();
    let mut session = doomed.session(input()).unwrap();
    session.step(0, &RATES).unwrap();
    for outcome in [session.take_losses().map(drop), session.step(0, &RATES), doomed.check()] {
        assert!(
            matches!(&outcome, Err(EngineError::DeviceLost(why)) if why.contains("Parent device is lost")),
            "{outcome:?}"
        );
    }
}

/// The device of the test below, which its way of waiting must see.
static BUSY: OnceLock<GpuEngine> = OnceLock::new();
static WAITS: AtomicU32 = AtomicU32::new(0);

#[test]
fn a_device_that_does_the_work_of_others_first_is_waited_for() {
    if engine().is_none() {
        return;
    }
    // Three times somebody else's work ends, and ours does not.
    let device = open().with_poll(|device, until| match BUSY.get() {
        Some(busy) if WAITS.fetch_add(1, SeqCst) < 3 => {
            busy.context.device.progress();
            Err(PollError::Timeout)
        }
        _ => device.poll(until),
    });
    let busy = BUSY.get_or_init(|| GpuEngine::new(device).unwrap());
    busy.render(&blobs(10, 0, 1), &arc(1, 17, 13)[0], BLACK).unwrap();
    assert!(WAITS.load(SeqCst) > 3);
}

#[test]
fn a_device_that_is_lost_for_want_of_memory_is_lost() {
    if engine().is_none() {
        return;
    }
    let doomed = GpuEngine::new(open()).unwrap();
    let mut session = doomed.session(input()).unwrap();
    // A few bytes of the queue's own that it did not get say nothing about the job.
    doomed.context.device.lose(&wgpu::hal::DeviceError::OutOfMemory.to_string());
    for outcome in [doomed.check(), session.step(0, &RATES)] {
        assert!(
            matches!(&outcome, Err(EngineError::DeviceLost(why)) if why.contains("memory")),
            "{outcome:?}"
        );
    }
}
