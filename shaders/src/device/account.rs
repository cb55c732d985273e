//! What a device has to give, and what is held of it.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use splat::engine::EngineError;

/// The bytes of one opened device that its buffers may take together.
#[derive(Debug)]
pub(crate) struct Account {
    /// `None` where nobody knows.
    limit: Option<u64>,
    taken: Mutex<Taken>,
}

#[derive(Debug, Default)]
struct Taken {
    held: u64,
    /// What was held, and with it what was asked for last: what a refusal of the driver is about.
    last_asked: u64,
}

/// Bytes that are taken from an [`Account`], and go back to it when this is dropped.
#[derive(Debug)]
pub(crate) struct Reservation {
    account: Arc<Account>,
    bytes: u64,
}

impl Account {
    pub(crate) fn new(limit: Option<u64>) -> Arc<Self> {
        Arc::new(Self { limit, taken: Mutex::default() })
    }

    /// Of at most so many bytes, of a device that has `memory`, where that is known.
    pub(crate) fn limited(bytes: u64, memory: Option<u64>) -> Arc<Self> {
        Self::new(Some(memory.map_or(bytes, |memory| memory.min(bytes))))
    }

    /// Bytes that are taken.
    pub(crate) fn held(&self) -> u64 {
        self.taken().held
    }

    /// Bytes that were taken when somebody last asked for some, those included.
    pub(crate) fn last_asked(&self) -> u64 {
        self.taken().last_asked
    }

    fn taken(&self) -> MutexGuard<'_, Taken> {
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether so many bytes are there once `returned` of those that are taken have come back.
    pub(crate) fn admit(&self, bytes: u64, returned: u64) -> Result<(), EngineError> {
        self.check(bytes, self.held().saturating_sub(returned))
    }

    /// Takes so many bytes, or none.
    pub(crate) fn reserve(self: &Arc<Self>, bytes: u64) -> Result<Reservation, EngineError> {
        let mut taken = self.taken();
        taken.last_asked = taken.held.saturating_add(bytes);
        self.check(bytes, taken.held)?;
        taken.held = taken.last_asked;
        Ok(Reservation { account: Arc::clone(self), bytes })
    }

    fn check(&self, needed: u64, held: u64) -> Result<(), EngineError> {
        let available = self.limit.map_or(u64::MAX, |limit| limit.saturating_sub(held));
        if needed > available {
            return Err(EngineError::OutOfResources { needed, available });
        }
        Ok(())
    }
}

impl Reservation {
    /// Parts with so many of its bytes, at most all.
    pub(crate) fn split(&mut self, bytes: u64) -> Self {
        let bytes = bytes.min(self.bytes);
        self.bytes -= bytes;
        Self { account: Arc::clone(&self.account), bytes }
    }
}

impl Drop for Reservation {
    fn drop(&mut self) {
        let mut taken = self.account.taken();
        taken.held = taken.held.saturating_sub(self.bytes);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "tests")]

    use super::*;

    #[test]
    fn what_is_held_is_not_given_twice_and_comes_back() {
        let account = Account::new(Some(100));
        let mut first = account.reserve(60).unwrap();
        let refused = account.reserve(41).err();
        assert!(matches!(refused, Some(EngineError::OutOfResources { needed: 41, available: 40 })));
        let second = account.reserve(40).unwrap();
        assert_eq!(account.held(), 100);
        let part = first.split(25);
        assert_eq!(account.held(), 100, "a part is still taken");
        drop(first);
        assert_eq!(account.held(), 65);
        assert!(account.admit(36, 0).is_err());
        account.admit(36, 1).unwrap();
        drop((part, second));
        assert_eq!((account.held(), account.last_asked()), (0, 100), "what was asked for stays known");
        account.admit(100, 0).unwrap();
    }

    #[test]
    fn nobody_is_promised_more_than_the_device_has() {
        let limit = |bytes, memory| Account::limited(bytes, memory).limit;
        assert_eq!(limit(70, Some(100)), Some(70));
        assert_eq!(limit(170, Some(100)), Some(100));
        assert_eq!(limit(170, None), Some(170));
    }

    #[test]
    fn where_no_limit_is_known_everything_is_counted_and_nothing_refused() {
        let account = Account::new(None);
        let all = account.reserve(u64::MAX).unwrap();
        assert_eq!(account.held(), u64::MAX);
        assert_eq!(all.bytes, u64::MAX);
        account.admit(u64::MAX, 0).unwrap();
    }
}
