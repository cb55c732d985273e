//! The text header: elements, their counts and the byte layout of their rows.

use std::io::{BufRead, Read};

use super::PlyError;

/// More than any Gaussian file needs; bounds what a hostile file can make us read.
const MAX_HEADER_BYTES: u64 = 64 * 1024;

/// A scalar type of the format.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    Int8,
    Uint8,
    Int16,
    Uint16,
    Int32,
    Uint32,
    Float32,
    Float64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::Int8,
            "uchar" | "uint8" => Self::Uint8,
            "short" | "int16" => Self::Int16,
            "ushort" | "uint16" => Self::Uint16,
            "int" | "int32" => Self::Int32,
            "uint" | "uint32" => Self::Uint32,
            "float" | "float32" => Self::Float32,
            "double" | "float64" => Self::Float64,
            _ => return None,
        })
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Int8 => "char",
            Self::Uint8 => "uchar",
            Self::Int16 => "short",
            Self::Uint16 => "ushort",
            Self::Int32 => "int",
            Self::Uint32 => "uint",
            Self::Float32 => "float",
            Self::Float64 => "double",
        }
    }

    fn size(self) -> usize {
        match self {
            Self::Int8 | Self::Uint8 => 1,
            Self::Int16 | Self::Uint16 => 2,
            Self::Int32 | Self::Uint32 | Self::Float32 => 4,
            Self::Float64 => 8,
        }
    }
}

/// One property of the vertices.
#[derive(Clone, Debug)]
pub(super) struct Property {
    pub(super) name: String,
    pub(super) scalar: Scalar,
    /// Bytes from the start of the row.
    pub(super) offset: usize,
}

/// One element of the file.
#[derive(Clone, Debug)]
pub(super) struct Element {
    pub(super) name: String,
    pub(super) count: u64,
    pub(super) properties: Vec<Property>,
    /// Bytes per row.
    pub(super) stride: usize,
}

/// What of the header matters for reading vertices.
#[derive(Clone, Debug)]
pub(super) struct Header {
    pub(super) vertices: Element,
    /// Bytes between the header and the first vertex.
    pub(super) skip: u64,
}

/// Reads the header and leaves the reader at the first byte after it.
pub(super) fn read_header(reader: &mut impl BufRead) -> Result<Header, PlyError> {
    let mut lines = Lines { reader: reader.take(MAX_HEADER_BYTES), number: 0 };
    if lines.first()? != "ply" {
        return Err(PlyError::NotPly);
    }
    let mut elements: Vec<Element> = Vec::new();
    let mut encoding = None;
    loop {
        let text = lines.next()?;
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["end_header"] => break,
            [] | ["comment" | "obj_info", ..] => {}
            ["format", name, ..] => encoding = Some(String::from(*name)),
            ["element", name, count] => {
                let count = count
                    .parse()
                    .map_err(|_| lines.problem(format!("`{count}` is not a count of elements")))?;
                elements.push(Element { name: (*name).into(), count, properties: Vec::new(), stride: 0 });
            }
            ["property", words @ ..] => {
                let element =
                    elements.last_mut().ok_or_else(|| lines.problem("property before any element".into()))?;
                add_property(element, words).map_err(|problem| lines.problem(problem))?;
            }
            _ => return Err(lines.problem(format!("`{text}` is no header statement"))),
        }
    }

    if elements.iter().any(|element| element.name == "chunk") {
        return Err(PlyError::Compressed);
    }
    match encoding.as_deref() {
        Some("binary_little_endian") => {}
        Some(other) => return Err(PlyError::Encoding(other.into())),
        None => return Err(lines.problem("no `format` statement".into())),
    }
    let Some(position) = elements.iter().position(|element| element.name == "vertex") else {
        return Err(lines.problem("no element `vertex`".into()));
    };
    let skip = elements[..position]
        .iter()
        .try_fold(0_u64, |sum, element| sum.checked_add(element.count.checked_mul(element.stride as u64)?));
    let skip = skip.ok_or_else(|| lines.problem("the stated counts exceed any file".into()))?;
    Ok(Header { vertices: elements.swap_remove(position), skip })
}

/// Adds `property <words>` to the element's row layout.
fn add_property(element: &mut Element, words: &[&str]) -> Result<(), String> {
    let &[scalar, name] = words else {
        return Err(format!("`property {}` of `{}` is not a single value", words.join(" "), element.name));
    };
    let scalar = Scalar::parse(scalar).ok_or_else(|| format!("unknown type `{scalar}`"))?;
    if element.properties.iter().any(|property| property.name == name) {
        return Err(format!("property `{name}` appears twice"));
    }
    element.properties.push(Property { name: name.into(), scalar, offset: element.stride });
    element.stride += scalar.size();
    Ok(())
}

/// Header lines with a bound on their total size.
struct Lines<R> {
    reader: std::io::Take<R>,
    number: usize,
}

impl<R: BufRead> Lines<R> {
    /// The first line; a file without text is not a PLY, whatever it is.
    fn first(&mut self) -> Result<String, PlyError> {
        match self.next() {
            Err(PlyError::Header { .. }) => Err(PlyError::NotPly),
            other => other,
        }
    }

    fn next(&mut self) -> Result<String, PlyError> {
        self.number += 1;
        let mut line = Vec::new();
        self.reader.read_until(b'\n', &mut line)?;
        if line.pop() != Some(b'\n') {
            return Err(self.problem("the header does not end".into()));
        }
        if line.last() == Some(&b'\r') {
            line.pop();
        }
        String::from_utf8(line).map_err(|_| self.problem("not text".into()))
    }

    fn problem(&self, problem: String) -> PlyError {
        PlyError::Header { line: self.number, problem }
    }
}
