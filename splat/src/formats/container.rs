//! The envelope of our own blobs: magic, version, a fixed header, and a compressed body under one checksum.
//!
//! ```text
//! 7 bytes   magic
//! 1 byte    version
//! 32 bytes  BLAKE3 of all that follows
//! h bytes   header of the format
//! 8 bytes   length of the body, little endian
//! rest      the body, zstd
//! ```

use std::io::Read;

use thiserror::Error;

/// A fixed level, so that equal content has equal bytes. 3 is where size stops falling quickly on our blobs.
const ZSTD_LEVEL: i32 = 3;

const MAGIC: usize = 7;
const CHECKSUM_END: usize = MAGIC + 1 + blake3::OUT_LEN;

/// Why bytes are not a blob of the expected kind.
#[derive(Debug, Error)]
pub enum ContainerError {
    /// Not this kind of blob at all.
    #[error("not a {expected} blob; give the file that trackersplat wrote")]
    Magic {
        /// The expected kind.
        expected: String,
    },
    /// Written by another version.
    #[error(
        "the blob has format version {found}, this program reads version {expected}; use matching versions"
    )]
    Version {
        /// What the blob says.
        found: u8,
        /// What this program reads.
        expected: u8,
    },
    /// Cut short.
    #[error("the blob is truncated at {0} bytes; fetch it again")]
    Truncated(usize),
    /// The checksum does not match.
    #[error("the blob is corrupted (checksum mismatch); fetch it again")]
    Corrupted,
    /// The body is not what the header says it must be.
    #[error("the blob's body is invalid: {0}; fetch it again")]
    Body(String),
}

/// Wraps a body. Equal input gives equal bytes.
pub(crate) fn seal(magic: &[u8; MAGIC], version: u8, header: &[u8], body: &[u8]) -> Vec<u8> {
    let compressed = zstd::bulk::compress(body, ZSTD_LEVEL)
        // The output buffer is sized by zstd's own bound and the level is a constant.
        .unwrap_or_else(|error| unreachable!("compressing in memory at a valid level: {error}"));
    let mut content = Vec::with_capacity(header.len() + 8 + compressed.len());
    content.extend(header);
    content.extend((body.len() as u64).to_le_bytes());
    content.extend(compressed);

    let mut bytes = Vec::with_capacity(CHECKSUM_END + content.len());
    bytes.extend(magic);
    bytes.push(version);
    bytes.extend(blake3::hash(&content).as_bytes());
    bytes.extend(content);
    bytes
}

/// An envelope whose checksum is right; its body is still compressed.
#[derive(Debug)]
pub(crate) struct Sealed<'a> {
    pub(crate) header: &'a [u8],
    body_size: u64,
    compressed: &'a [u8],
}

impl<'a> Sealed<'a> {
    /// Opens an envelope of the given kind.
    pub(crate) fn open(
        magic: &[u8; MAGIC],
        version: u8,
        header_size: usize,
        bytes: &'a [u8],
    ) -> Result<Self, ContainerError> {
        if !bytes.starts_with(magic) {
            return Err(ContainerError::Magic { expected: String::from_utf8_lossy(magic).into_owned() });
        }
        if bytes.len() < CHECKSUM_END + header_size + 8 {
            return Err(ContainerError::Truncated(bytes.len()));
        }
        if bytes[MAGIC] != version {
            return Err(ContainerError::Version { found: bytes[MAGIC], expected: version });
        }
        let content = &bytes[CHECKSUM_END..];
        if blake3::hash(content).as_bytes() != &bytes[MAGIC + 1..CHECKSUM_END] {
            return Err(ContainerError::Corrupted);
        }
        let (header, content) = content.split_at(header_size);
        let (size, compressed) = content.split_at(8);
        // The slice has the array's length, so the default is never taken.
        let body_size = u64::from_le_bytes(size.try_into().unwrap_or_default());
        Ok(Self { header, body_size, compressed })
    }

    /// The body; at most `limit` bytes are ever decompressed.
    pub(crate) fn body(&self, limit: usize) -> Result<Vec<u8>, ContainerError> {
        if self.body_size > limit as u64 {
            return Err(ContainerError::Body(format!(
                "{} bytes, at most {limit} are possible",
                self.body_size
            )));
        }
        let broken = |error: std::io::Error| ContainerError::Body(error.to_string());
        let mut body = Vec::with_capacity(self.body_size as usize);
        zstd::Decoder::with_buffer(self.compressed)
            .map_err(broken)?
            .take(self.body_size + 1)
            .read_to_end(&mut body)
            .map_err(broken)?;
        if body.len() as u64 != self.body_size {
            return Err(ContainerError::Body(format!("not of the stated {} bytes", self.body_size)));
        }
        Ok(body)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KIND: &[u8; 7] = b"TESTING";

    #[test]
    fn what_is_sealed_is_opened() {
        for body in [&b""[..], b"body", &[7; 100_000]] {
            let bytes = seal(KIND, 3, b"head", body);
            let sealed = Sealed::open(KIND, 3, 4, &bytes).expect("just sealed");
            assert_eq!(sealed.header, b"head");
            assert_eq!(sealed.body(body.len()).expect("within the limit"), body);
        }
    }

    #[test]
    fn every_changed_or_missing_byte_is_found() {
        let bytes = seal(KIND, 3, b"head", b"some body");
        for index in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[index] ^= 0x10;
            assert!(Sealed::open(KIND, 3, 4, &changed).is_err(), "byte {index}");
            assert!(Sealed::open(KIND, 3, 4, &bytes[..index]).is_err(), "length {index}");
        }
        assert!(matches!(
            Sealed::open(KIND, 4, 4, &bytes),
            Err(ContainerError::Version { found: 3, expected: 4 })
        ));
        assert!(matches!(Sealed::open(b"ANOTHER", 3, 4, &bytes), Err(ContainerError::Magic { .. })));
    }

    /// An envelope with a valid checksum around whatever a hostile writer puts there.
    fn forged(body_size: u64, compressed: &[u8]) -> Vec<u8> {
        let content = [b"head", &body_size.to_le_bytes()[..], compressed].concat();
        [KIND, &[3][..], blake3::hash(&content).as_bytes(), &content].concat()
    }

    #[test]
    fn bombs_do_not_go_off() {
        let bomb = zstd::bulk::compress(&vec![0; 50_000_000], 3).expect("compresses");
        assert!(bomb.len() < 10_000);
        for stated in [10, 50_000_000, u64::MAX] {
            let bytes = forged(stated, &bomb);
            let sealed = Sealed::open(KIND, 3, 4, &bytes).expect("valid checksum");
            assert!(matches!(sealed.body(1000), Err(ContainerError::Body(_))));
        }
        let bytes = forged(4, b"not zstd");
        let sealed = Sealed::open(KIND, 3, 4, &bytes).expect("valid checksum");
        assert!(matches!(sealed.body(1000), Err(ContainerError::Body(_))));
    }
}
