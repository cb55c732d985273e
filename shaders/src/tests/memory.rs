//! What is held of a device's memory, and that it comes back.

use splat::{
    engine::{Engine, EngineError, SessionInput},
    gaussians::Gaussians,
};

use super::{
    BLACK, RATES, black_view,
    support::{arc, blobs, engine, open, rough_tracks},
};
use crate::{
    GpuEngine,
    buffers::{Buffers, total},
    layout::View,
    moments::taken_over,
};

fn input(gaussians: Gaussians) -> SessionInput {
    black_view(gaussians, 40, 30)
}

fn held(engine: &GpuEngine) -> u64 {
    engine.context.device.account().held()
}

/// What the driver has given to buffers; `None` where the backend does not say.
fn allocated(engine: &GpuEngine) -> Option<u64> {
    engine.context.device.device.generate_allocator_report().map(|report| report.total_allocated_bytes)
}

/// What a session of so many Gaussians holds.
fn bytes_of_a_session(count: usize) -> u64 {
    let engine = GpuEngine::new(open()).unwrap();
    let _session = engine.session(input(blobs(count, 1, 1))).unwrap();
    held(&engine)
}

#[test]
fn sessions_share_what_the_device_has() {
    if engine().is_none() {
        return;
    }
    let one = bytes_of_a_session(2000);
    let limit = one + one / 2;
    let engine = GpuEngine::new(open().with_memory_limit(limit)).unwrap();
    let input = || input(blobs(2000, 1, 1));
    let mut first = engine.session(input()).unwrap();
    assert_eq!(held(&engine), one);
    match engine.session(input()).err() {
        Some(EngineError::OutOfResources { needed, available }) => {
            assert!(available == limit - one && needed > available, "{needed} of {available}");
        }
        other => panic!("{other:?}"),
    }
    assert_eq!(held(&engine), one, "a refused session holds nothing");
    // In the middle of its work.
    (0..5).for_each(|_| first.step(0, &RATES).unwrap());
    drop(first);
    assert_eq!(held(&engine), 0);
    let mut second = engine.session(input()).unwrap();
    second.step(0, &RATES).unwrap();
    assert_eq!(second.take_losses().unwrap().len(), 1);
}

#[test]
fn what_a_dropped_session_held_is_free_on_the_device() {
    if engine().is_none() {
        return;
    }
    let engine = GpuEngine::new(open()).unwrap();
    let round = || {
        let mut session = engine.session(input(blobs(20_000, 1, 2))).unwrap();
        session.step(0, &RATES).unwrap();
        let during = allocated(&engine)?;
        drop(session);
        Some((during, allocated(&engine)?))
    };
    let Some((during, after)) = round() else { return };
    assert!(during > after + 10_000_000, "{during} bytes, then {after}");
    assert_eq!(round().map(|(_, after)| after), Some(after), "nothing stays behind");
}

#[test]
fn passes_give_back_what_they_took() {
    if engine().is_none() {
        return;
    }
    let engine = GpuEngine::new(open()).unwrap();
    let (gaussians, camera) = (blobs(500, 1, 3), arc(1, 64, 45).swap_remove(0));
    engine.render(&gaussians, &camera, BLACK).unwrap();
    engine.render_backward(&gaussians, &camera, BLACK, &vec![1.0; 3 * 64 * 45], &[]).unwrap();
    engine.render_rgb8(&gaussians, &camera, BLACK).unwrap();
    assert_eq!(held(&engine), 0);
    // The set that was measured last stays, for the next view of the same moment.
    let tracks = rough_tracks(&camera, 3.0, 3);
    engine.footprint_moments(&gaussians, &camera, &tracks, None).unwrap();
    let kept = held(&engine);
    assert!((1..100_000).contains(&kept), "{kept}");
    let session = engine.session(input(gaussians)).unwrap();
    drop(session);
    assert_eq!(held(&engine), 0, "until the set is optimised");
}

#[test]
fn the_second_view_of_a_set_needs_no_more_room_than_the_first() {
    let Some(any) = engine() else { return };
    let gaussians = blobs(3000, 0, 7);
    let views: Vec<View> = arc(2, 20, 15).iter().map(|camera| View::new(camera, BLACK)).collect();
    let needed = total(&Buffers::requests(&any.size(gaussians.len(), 1, &views[0], false).unwrap()));
    for (limit, is_enough) in [(needed, true), (needed - 1, false)] {
        let engine = GpuEngine::new(open().with_memory_limit(limit)).unwrap();
        for view in &views {
            let outcome = taken_over(&engine, &gaussians, view);
            assert_eq!(outcome.is_ok(), is_enough, "{limit} bytes of {needed}: {:?}", outcome.err());
        }
    }
}

#[test]
fn a_set_is_replaced_in_the_room_of_one() {
    if engine().is_none() {
        return;
    }
    let one = bytes_of_a_session(3000);
    // Three quarters of it are by Gaussian: two of them would not fit.
    let engine = GpuEngine::new(open().with_memory_limit(one + one / 4)).unwrap();
    let mut session = engine.session(input(blobs(3000, 1, 4))).unwrap();
    session.step(0, &RATES).unwrap();
    let kept: Vec<_> = (0..3000).map(|index| (index % 3 != 0).then_some(index)).collect();
    session.replace(blobs(3000, 1, 5), &kept).unwrap();
    assert_eq!(held(&engine), one);
    session.step(0, &RATES).unwrap();
    assert_eq!(session.take_losses().unwrap().len(), 2);
    let before = session.gaussians().unwrap();
    let refused = session.replace(blobs(9000, 1, 6), &vec![None; 9000]).err();
    assert!(matches!(refused, Some(EngineError::OutOfResources { .. })), "{refused:?}");
    assert_eq!(session.gaussians().unwrap(), before, "what is refused changes nothing");
}
