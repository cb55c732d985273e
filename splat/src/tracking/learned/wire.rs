//! A check of ONNX files before they are parsed: the parser reserves memory by the lengths that a file claims, and
//! recurses as deep as the file does.

/// Deepest nesting of messages; control flow of exported networks needs a few levels.
const MAX_DEPTH: usize = 64;

/// The messages of onnx.proto whose fields are read.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Message {
    Model,
    Graph,
    Node,
    Attribute,
    Value,
    Type,
    TensorType,
    Sequence,
    Shape,
    Tensor,
    /// Holds numbers and texts only.
    Plain,
}

impl Message {
    /// The message in a field of this one; `None` for fields that hold numbers, texts or bytes.
    fn child(self, field: u64) -> Option<Self> {
        Some(match (self, field) {
            (Self::Model, 7) | (Self::Attribute, 6 | 11) => Self::Graph,
            (Self::Model, 8 | 14) | (Self::Graph, 16) | (Self::Node, 9) | (Self::Value, 4) => Self::Plain,
            (Self::Graph, 1) => Self::Node,
            (Self::Graph, 5) | (Self::Attribute, 5 | 10) => Self::Tensor,
            (Self::Graph, 11..=13) => Self::Value,
            (Self::Node, 5) => Self::Attribute,
            (Self::Value, 2) | (Self::Attribute, 14 | 15) | (Self::Sequence, 1) => Self::Type,
            (Self::Type, 1) => Self::TensorType,
            (Self::Type, 4 | 9) => Self::Sequence,
            (Self::TensorType, 2) => Self::Shape,
            (Self::Shape, 1) | (Self::Tensor, 3 | 13) => Self::Plain,
            _ => return None,
        })
    }
}

/// Whether every length in an ONNX file stays within what holds it; the reason if not.
pub(super) fn check(bytes: &[u8]) -> Result<(), &'static str> {
    check_message(bytes, Message::Model, 0)
}

fn check_message(mut rest: &[u8], message: Message, depth: usize) -> Result<(), &'static str> {
    const CUT: &str = "it is no ONNX file, or was cut short";
    if depth > MAX_DEPTH {
        return Err("its graphs are nested too deeply");
    }
    while !rest.is_empty() {
        let tag = varint(&mut rest).ok_or(CUT)?;
        let length = match tag & 7 {
            0 => {
                varint(&mut rest).ok_or(CUT)?;
                continue;
            }
            1 => 8,
            2 => varint(&mut rest).ok_or(CUT)?,
            5 => 4,
            _ => return Err(CUT),
        };
        let length = usize::try_from(length).map_err(|_| CUT)?;
        let (value, after) = rest.split_at_checked(length).ok_or(CUT)?;
        rest = after;
        if let (2, Some(child)) = (tag & 7, message.child(tag >> 3)) {
            check_message(value, child, depth + 1)?;
        }
    }
    Ok(())
}

fn varint(rest: &mut &[u8]) -> Option<u64> {
    let mut value = 0;
    for shift in (0..64).step_by(7) {
        let (&byte, after) = rest.split_first()?;
        *rest = after;
        value |= u64::from(byte & 0x7f) << shift;
        if byte < 0x80 {
            return Some(value);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_must_stay_within_their_message() {
        // A model whose graph (field 7) has a node (field 1) with a name (field 3).
        let whole = [0x08, 8, 0x3a, 6, 0x0a, 4, 0x1a, 2, b'a', b'b'];
        assert_eq!(check(&whole), Ok(()));
        for length in [3, 5, 7, 8, 9] {
            assert!(check(&whole[..length]).is_err(), "{length}");
        }
        for at in [3, 5, 7] {
            let mut longer = whole;
            longer[at] += 1;
            assert!(check(&longer).is_err(), "{at}");
        }
        let huge = [0x3a, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x7f];
        assert!(check(&huge).is_err());
        assert!(check(&[0x3b]).is_err(), "groups are no part of ONNX");
    }

    #[test]
    fn nesting_is_bounded() {
        let nested = |levels: usize| {
            let mut graph = Vec::new();
            for _ in 0..levels {
                // The graph in an attribute (field 6) of a node's attribute (field 5) of a graph's node (field 1).
                for field in [6u8, 5, 1] {
                    let mut outer = vec![field << 3 | 2];
                    let length = graph.len() as u32;
                    outer.extend([length as u8 | 0x80, (length >> 7) as u8 | 0x80, (length >> 14) as u8]);
                    outer.extend(graph);
                    graph = outer;
                }
            }
            let length = graph.len() as u32;
            let mut model = vec![0x3a, length as u8 | 0x80, (length >> 7) as u8 | 0x80, (length >> 14) as u8];
            model.extend(graph);
            model
        };
        assert_eq!(check(&nested(10)), Ok(()));
        assert!(check(&nested(1000)).is_err_and(|reason| reason.contains("nested")));
    }
}
