//! Names that cross the wire, checked before they become paths or table keys.

use thiserror::Error;

/// Longest worker id.
pub const MAX_WORKER_ID: usize = 128;

/// A name that does not have the form of its kind.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum InvalidId {
    /// Not the name of a blob.
    #[error("'{0}' is no blob digest; give the 64 lower-case hexadecimal digits of a BLAKE3 digest")]
    Digest(String),
    /// Not the name of a worker.
    #[error("'{0}' is no worker id; give 1 to 128 letters, digits, '-', '_' or '.'")]
    Worker(String),
}

/// Checks the name of a blob: 64 lower-case hexadecimal digits.
pub fn check_digest(digest: &str) -> Result<(), InvalidId> {
    let is_hexadecimal = digest.bytes().all(|c| matches!(c, b'0'..=b'9' | b'a'..=b'f'));
    if digest.len() == 64 && is_hexadecimal { Ok(()) } else { Err(InvalidId::Digest(excerpt(digest))) }
}

/// Checks the name of a worker.
pub fn check_worker_id(id: &str) -> Result<(), InvalidId> {
    let is_plain = id.bytes().all(|c| c.is_ascii_alphanumeric() || matches!(c, b'-' | b'_' | b'.'));
    if is_plain && (1..=MAX_WORKER_ID).contains(&id.len()) {
        Ok(())
    } else {
        Err(InvalidId::Worker(excerpt(id)))
    }
}

/// The beginning of a hostile name, short enough for an error message.
fn excerpt(text: &str) -> String {
    text.chars().take(80).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_digest_is_64_lower_case_hexadecimal_digits() {
        assert_eq!(check_digest(&"0a".repeat(32)), Ok(()));
        for wrong in ["", "0a", &"0A".repeat(32), &"zz".repeat(32), &"0a".repeat(33), "../../etc/passwd"] {
            assert!(check_digest(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_worker_id_cannot_be_empty_long_or_a_path() {
        assert_eq!(check_worker_id("worker-1.local_A"), Ok(()));
        for wrong in ["", "a/b", "a b", "ä", &"a".repeat(129)] {
            assert!(check_worker_id(wrong).is_err(), "{wrong}");
        }
    }
}
