//! `--frames 1..10`: first and last frame number, both included.

use std::str::FromStr;

/// First and last frame number, both included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct FrameRange {
    pub(crate) first: u32,
    pub(crate) last: u32,
}

impl FromStr for FrameRange {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |part: &str| {
            part.trim().parse::<u32>().map_err(|_| format!("'{part}' is no frame number; write 1..10 or 7"))
        };
        let (first, last) = match text.split_once("..") {
            // 1..=10 is what a Rust programmer writes for the same.
            Some((first, last)) => (number(first)?, number(last.trim_start_matches('='))?),
            None => (number(text)?, number(text)?),
        };
        if first == 0 {
            return Err("frames count from 1; write 1..10 or 7".to_owned());
        }
        if last < first {
            return Err(format!(
                "the range ends at {last}, before it begins at {first}; write {last}..{first}"
            ));
        }
        Ok(Self { first, last })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_includes_both_ends() {
        assert_eq!("1..10".parse(), Ok(FrameRange { first: 1, last: 10 }));
        assert_eq!("3..=4".parse(), Ok(FrameRange { first: 3, last: 4 }));
        assert_eq!("7".parse(), Ok(FrameRange { first: 7, last: 7 }));
        assert_eq!(" 2 .. 2 ".parse(), Ok(FrameRange { first: 2, last: 2 }));
    }

    #[test]
    fn a_wrong_range_says_what_to_write() {
        for wrong in ["", "..", "1..", "..4", "a..b", "-1..3", "1-3", "1..99999999999", "0..3", "0"] {
            let error = wrong.parse::<FrameRange>().expect_err(wrong);
            assert!(error.contains("1..10"), "{wrong}: {error}");
        }
        let error = "5..2".parse::<FrameRange>().expect_err("runs backwards");
        assert!(error.contains("2..5"), "{error}");
    }
}
