//! What goes wrong on a device, and for whom: a lost device is lost for everybody, all else fails the work that it happens in.

use std::{
    sync::{Arc, Mutex, PoisonError},
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

/// Why a device is gone.
#[derive(Clone, Debug)]
enum Loss {
    /// The driver had no memory where it cannot do without.
    Memory,
    Other(String),
}

/// What happened on a device outside of the calls that return errors.
#[derive(Debug, Default)]
pub(super) struct Health {
    lost: Mutex<Option<Loss>>,
    /// What broke a rule outside of [`GpuDevice::guarded`].
    stray: Mutex<Option<String>>,
}

impl Health {
    /// Listens to a device.
    pub(super) fn of(device: &Device) -> Arc<Self> {
        let health = Arc::new(Self::default());
        let lost = Arc::clone(&health);
        device.set_device_lost_callback(move |_, message| lost.lose(Loss::said(message)));
        let failed = Arc::clone(&health);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            let mut stray = failed.stray.lock().unwrap_or_else(PoisonError::into_inner);
            stray.get_or_insert(error.to_string());
        }));
        health
    }

    fn lose(&self, loss: Loss) {
        self.lost.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(loss);
    }

    fn take_stray(&self) -> Option<String> {
        self.stray.lock().unwrap_or_else(PoisonError::into_inner).take()
    }
}

impl Loss {
    /// As the driver's layer words it.
    fn said(message: String) -> Self {
        match message {
            message if message == wgpu::hal::DeviceError::OutOfMemory.to_string() => Self::Memory,
            message => Self::Other(message),
        }
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
            Some(Loss::Memory) => Err(self.out_of_memory()),
            Some(Loss::Other(why)) => {
                Err(EngineError::DeviceLost(format!("{}: {why}", self.description.name)))
            }
        }
    }

    /// Waits for a submission and all before it, or for all there are; the device is lost if one takes longer than it may.
    pub(crate) fn wait(&self, submission: Option<SubmissionIndex>) -> Result<(), EngineError> {
        self.check()?;
        let until = PollType::Wait { submission_index: submission, timeout: Some(self.patience) };
        match (self.poll)(&self.device, until) {
            Ok(_) => {}
            Err(PollError::Timeout) => self.give_up(),
            Err(error @ PollError::WrongSubmissionIndex(..)) => {
                self.check()?;
                return Err(EngineError::Internal(format!("the device refused a submission: {error}")));
            }
        }
        self.check()
    }

    /// As if the driver had said so.
    #[cfg(test)]
    pub(crate) fn lose(&self, said: &str) {
        self.health.lose(Loss::said(said.to_owned()));
    }

    /// Counts the device as lost. To free a queue is to wait for it, so that one which does not end is never freed.
    fn give_up(&self) {
        let seconds = self.patience.as_secs_f64();
        self.health
            .lose(Loss::Other(format!("it hangs: work of one submission is not done after {seconds} s")));
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
        if memory.is_some() {
            return Err(self.out_of_memory());
        }
        // A device that is lost breaks rules by what it cannot do any more.
        self.check()?;
        let broken = validation.or(internal).map(|error| error.to_string());
        match broken.or_else(|| self.health.take_stray()) {
            Some(broken) => Err(EngineError::Internal(broken)),
            None => outcome,
        }
    }

    /// The driver says that it has no more than what is held, not how much it has.
    fn out_of_memory(&self) -> EngineError {
        EngineError::OutOfResources { needed: self.account.held(), available: 0 }
    }
}
