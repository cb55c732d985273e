//! Results on standard output, whose reader may leave at any time: `| head` does.

use std::{
    fmt,
    io::{self, ErrorKind, Write},
};

/// Prints a line; whether somebody still reads. Output that cannot be written for another reason, such as a full
/// disk, ends the process: a result that is cut short must not look like success.
pub(crate) fn line(text: impl fmt::Display) -> bool {
    match write_line(&mut io::stdout().lock(), &text) {
        Ok(is_read) => is_read,
        Err(error) => {
            eprintln!("error: standard output: {error}");
            std::process::exit(1)
        }
    }
}

fn write_line(to: &mut impl Write, text: &impl fmt::Display) -> io::Result<bool> {
    match writeln!(to, "{text}").and_then(|()| to.flush()) {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(error),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Fails(ErrorKind);

    impl Write for Fails {
        fn write(&mut self, _: &[u8]) -> io::Result<usize> {
            Err(self.0.into())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_reader_that_left_is_no_error_and_a_full_disk_is() {
        let mut read = Vec::new();
        assert!(matches!(write_line(&mut read, &"a"), Ok(true)));
        assert_eq!(read, b"a\n");
        assert!(matches!(write_line(&mut Fails(ErrorKind::BrokenPipe), &"a"), Ok(false)));
        assert!(write_line(&mut Fails(ErrorKind::StorageFull), &"a").is_err());
    }
}
