//! What a device has to give, and what is held of it.

use std::sync::{Arc, Mutex, PoisonError};

use splat::engine::EngineError;

/// The bytes of one opened device that its buffers may take together.
#[derive(Debug)]
pub(crate) struct Account {
    /// `None` where nobody knows.
    limit: Option<u64>,
    held: Mutex<u64>,
}

/// Bytes that are taken from an [`Account`], and go back to it when this is dropped.
#[derive(Debug)]
pub(crate) struct Reservation {
    account: Arc<Account>,
    bytes: u64,
}

impl Account {
    pub(crate) fn new(limit: Option<u64>) -> Arc<Self> {
        Arc::new(Self { limit, held: Mutex::new(0) })
    }

    /// Bytes that are taken.
    pub(crate) fn held(&self) -> u64 {
        *self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether so many bytes are there once `returned` of those that are taken have come back.
    pub(crate) fn admit(&self, bytes: u64, returned: u64) -> Result<(), EngineError> {
        self.check(bytes, self.held().saturating_sub(returned))
    }

    /// Takes so many bytes, or none.
    pub(crate) fn reserve(self: &Arc<Self>, bytes: u64) -> Result<Reservation, EngineError> {
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        self.check(bytes, *held)?;
        *held = held.saturating_add(bytes);
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
        let mut held = self.account.held.lock().unwrap_or_else(PoisonError::into_inner);
        *held = held.saturating_sub(self.bytes);
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
        assert_eq!(account.held(), 0);
        account.admit(100, 0).unwrap();
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
