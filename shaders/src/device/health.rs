//! What goes wrong on a device, and for whom: a lost device is lost for everybody, all else fails the work that it happens in.

use std::{
    any::Any,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering::Relaxed},
    },
    time::Duration,
};

use splat::engine::EngineError;
use wgpu::{Device, ErrorFilter, PollError, PollStatus, PollType, Queue, SubmissionIndex};

use super::{DeviceKind, GpuDevice};

/// How long one submission may take. A step on a card takes milliseconds, and drivers that watch their card give it up after
/// some seconds; who waits this long waits for nothing.
const PATIENCE: Duration = Duration::from_secs(120);
/// The same for software, where a step of a million Gaussians is minutes.
const PATIENCE_WITH_SOFTWARE: Duration = Duration::from_secs(1800);

/// How a device is waited for.
pub(super) type Poll = fn(&Device, PollType) -> Result<PollStatus, PollError>;

/// What happened on a device outside of the calls that return errors.
#[derive(Debug, Default)]
pub(super) struct Health {
    /// Why the device is gone.
    lost: Mutex<Option<String>>,
    /// How many waits have ended: as long as this grows, the device works.
    ended: AtomicU64,
}

impl Health {
    /// Listens to a device.
    pub(super) fn of(device: &Device) -> Arc<Self> {
        let health = Arc::new(Self::default());
        let lost = Arc::clone(&health);
        device.set_device_lost_callback(move |_, message| lost.lose(message));
        // What has a result runs in `GpuDevice::guarded`, which collects what it broke. What is left belongs to nobody who could
        // fail by it, and wgpu's own answer to it is a panic.
        device.on_uncaptured_error(Arc::new(|_| {}));
        health
    }

    fn lose(&self, why: String) {
        self.lost.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(why);
    }
}

pub(super) fn patience(kind: DeviceKind) -> Duration {
    match kind {
        DeviceKind::Software => PATIENCE_WITH_SOFTWARE,
        _ => PATIENCE,
    }
}

pub(super) fn poll(device: &Device, until: PollType) -> Result<PollStatus, PollError> {
    device.poll(until)
}

impl GpuDevice {
    /// Whether the device still does what it is told.
    pub fn check(&self) -> Result<(), EngineError> {
        let lost = self.health.lost.lock().unwrap_or_else(PoisonError::into_inner).clone();
        match lost {
            None => Ok(()),
            Some(why) => Err(EngineError::DeviceLost(format!("{}: {why}", self.description.name))),
        }
    }

    /// Waits for a submission and all before it, or for all there are. The device is lost if it takes longer than it may and nothing
    /// else that somebody waited for has ended meanwhile: the queue is everybody's.
    pub(crate) fn wait(&self, submission: Option<SubmissionIndex>) -> Result<(), EngineError> {
        self.check()?;
        let until = PollType::Wait { submission_index: submission, timeout: Some(self.patience) };
        loop {
            let ended = self.health.ended.load(Relaxed);
            // wgpu has no error for a device that goes away while somebody waits: it panics. The device is not used any more.
            let polled = catch_unwind(AssertUnwindSafe(|| (self.poll)(&self.device, until.clone())));
            match polled {
                Ok(Ok(_)) => {
                    self.progress();
                    break;
                }
                Ok(Err(PollError::Timeout)) if self.health.ended.load(Relaxed) != ended => {}
                Ok(Err(PollError::Timeout)) => {
                    let seconds = self.patience.as_secs_f64();
                    self.give_up(format!("it hangs: work of one submission is not done after {seconds} s"));
                    break;
                }
                Ok(Err(error @ PollError::WrongSubmissionIndex(..))) => {
                    self.check()?;
                    return Err(EngineError::Internal(format!("the device refused a submission: {error}")));
                }
                Err(panic) => {
                    self.give_up(said(panic.as_ref()));
                    break;
                }
            }
        }
        self.check()
    }

    /// Something that somebody waited for has ended.
    pub(crate) fn progress(&self) {
        self.health.ended.fetch_add(1, Relaxed);
    }

    /// As if the driver had said so.
    #[cfg(test)]
    pub(crate) fn lose(&self, said: &str) {
        self.health.lose(said.to_owned());
    }

    /// Counts the device as lost. To free a queue is to wait for it, so that one which does not end is never freed.
    fn give_up(&self, why: String) {
        self.health.lose(why);
        std::mem::forget::<Queue>(self.queue.clone());
    }

    /// Does something on the device, and fails if it broke one of the device's rules or took the driver's last memory, whatever it
    /// returns itself: its results would be those of work that was not done. Nobody else fails by it. What is done must
    /// make its calls on the thread of the caller.
    pub(crate) fn guarded<T>(
        &self,
        operation: impl FnOnce() -> Result<T, EngineError>,
    ) -> Result<T, EngineError> {
        self.check()?;
        let [internal, validation, memory] =
            [ErrorFilter::Internal, ErrorFilter::Validation, ErrorFilter::OutOfMemory]
                .map(|filter| self.device.push_error_scope(filter));
        let outcome = operation();
        // The last one first.
        let [memory, validation, internal] =
            [memory, validation, internal].map(|scope| pollster::block_on(scope.pop()));
        // A device that is lost breaks rules by what it cannot do any more.
        self.check()?;
        if memory.is_some() {
            // The driver says that it has no more, not how much it has.
            return Err(EngineError::OutOfResources { needed: self.account.last_asked(), available: 0 });
        }
        match validation.or(internal) {
            Some(broken) => Err(EngineError::Internal(broken.to_string())),
            None => outcome,
        }
    }
}

/// The words of a panic.
fn said(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().cloned();
    text.or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()))
        .unwrap_or_else(|| "the driver's layer gave up".to_owned())
}
