//! Point clouds in PLY files: ASCII or binary little endian, `x y z` and, if there, `red green blue`.

use std::{fs, path::Path};

use glam::DVec3;

use super::ClipError;
use crate::static_model::SfmPoint;

/// Colour of points without one.
const GREY: [f32; 3] = [0.5; 3];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Encoding {
    Ascii,
    LittleEndian,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn from_name(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The value at the start of `bytes`; `None` if they are too few.
    fn read(self, bytes: &[u8]) -> Option<f64> {
        Some(match self {
            Self::I8 => i8::from_le_bytes(*bytes.first_chunk()?).into(),
            Self::U8 => u8::from_le_bytes(*bytes.first_chunk()?).into(),
            Self::I16 => i16::from_le_bytes(*bytes.first_chunk()?).into(),
            Self::U16 => u16::from_le_bytes(*bytes.first_chunk()?).into(),
            Self::I32 => i32::from_le_bytes(*bytes.first_chunk()?).into(),
            Self::U32 => u32::from_le_bytes(*bytes.first_chunk()?).into(),
            Self::F32 => f32::from_le_bytes(*bytes.first_chunk()?).into(),
            Self::F64 => f64::from_le_bytes(*bytes.first_chunk()?),
        })
    }

    /// What full intensity of a colour channel is in this type.
    fn white(self) -> f64 {
        match self {
            Self::F32 | Self::F64 => 1.0,
            Self::U16 | Self::I16 => 65535.0,
            _ => 255.0,
        }
    }
}

#[derive(Debug)]
struct Header {
    encoding: Encoding,
    vertices: usize,
    /// Name and type of each vertex property, in file order.
    properties: Vec<(String, Scalar)>,
    /// Bytes before the first vertex.
    length: usize,
}

/// Columns of the properties that make a point.
struct Columns {
    position: [usize; 3],
    colour: Option<[(usize, f64); 3]>,
}

/// Reads all points of a file.
pub(super) fn read(path: &Path) -> Result<Vec<SfmPoint>, ClipError> {
    let bytes = fs::read(path).map_err(ClipError::io(path))?;
    let header = header(path, &bytes)?;
    let columns = columns(path, &header)?;
    let body = &bytes[header.length..];
    match header.encoding {
        Encoding::Ascii => read_ascii(path, &header, &columns, body),
        Encoding::LittleEndian => read_binary(path, &header, &columns, body),
    }
}

fn header(path: &Path, bytes: &[u8]) -> Result<Header, ClipError> {
    let malformed = |found: &str, expected: &str| {
        ClipError::malformed(path, "PLY header", format!("`{found}`"), expected)
    };
    let mut encoding = None;
    let mut vertices = None;
    let mut properties = Vec::new();
    // Only what comes before and in the vertex element decides where vertices lie.
    let mut element: Option<bool> = None;
    let mut length = 0;
    for (number, raw) in bytes.split_inclusive(|&byte| byte == b'\n').enumerate() {
        length += raw.len();
        let line = String::from_utf8_lossy(raw);
        let line = line.trim();
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["ply"] if number == 0 => {}
            _ if number == 0 => return Err(malformed(line, "`ply`")),
            ["format", "ascii", _] => encoding = Some(Encoding::Ascii),
            ["format", "binary_little_endian", _] => encoding = Some(Encoding::LittleEndian),
            ["format", ..] => return Err(malformed(line, "format ascii or binary_little_endian")),
            ["element", "vertex", count] => {
                vertices = Some(count.parse().map_err(|_| malformed(line, "a number of vertices"))?);
                element = Some(true);
            }
            ["element", ..] if vertices.is_none() => return Err(malformed(line, "the vertex element first")),
            ["element", ..] => element = Some(false),
            ["property", "list", ..] if element == Some(true) => {
                return Err(malformed(line, "scalar vertex properties only"));
            }
            ["property", kind, name] if element == Some(true) => {
                let scalar = Scalar::from_name(kind).ok_or_else(|| malformed(line, "a PLY scalar type"))?;
                properties.push(((*name).to_owned(), scalar));
            }
            ["property", ..] | ["comment", ..] | ["obj_info", ..] => {}
            ["end_header"] => {
                let encoding = encoding.ok_or_else(|| malformed(line, "a format line before"))?;
                let vertices = vertices.ok_or_else(|| malformed(line, "a vertex element before"))?;
                return Ok(Header { encoding, vertices, properties, length });
            }
            _ => return Err(malformed(line, "a PLY header line")),
        }
    }
    Err(malformed("the end of the file", "end_header"))
}

fn columns(path: &Path, header: &Header) -> Result<Columns, ClipError> {
    let find = |name: &str| header.properties.iter().position(|(known, _)| known == name);
    let position = |name: &str| {
        find(name).ok_or_else(|| {
            ClipError::malformed(path, "PLY header", format!("no property {name}"), "x, y and z")
        })
    };
    let channel = |name: &str| find(name).map(|index| (index, header.properties[index].1.white()));
    let colour = match ["red", "green", "blue"].map(channel) {
        [Some(red), Some(green), Some(blue)] => Some([red, green, blue]),
        _ => None,
    };
    Ok(Columns { position: [position("x")?, position("y")?, position("z")?], colour })
}

fn read_binary(
    path: &Path,
    header: &Header,
    columns: &Columns,
    body: &[u8],
) -> Result<Vec<SfmPoint>, ClipError> {
    let stride: usize = header.properties.iter().map(|(_, scalar)| scalar.size()).sum();
    let complete = body.len() / stride.max(1);
    if complete < header.vertices {
        return Err(cut_short(path, complete, header.vertices));
    }
    let mut offset = 0;
    let mut fields = Vec::with_capacity(header.properties.len());
    for &(_, scalar) in &header.properties {
        fields.push((offset, scalar));
        offset += scalar.size();
    }
    body.chunks_exact(stride)
        .take(header.vertices)
        .enumerate()
        .map(|(index, record)| {
            let value = |column: usize| {
                let (offset, scalar) = fields[column];
                scalar.read(&record[offset..])
            };
            point(path, index, columns, value)
        })
        .collect()
}

fn read_ascii(
    path: &Path,
    header: &Header,
    columns: &Columns,
    body: &[u8],
) -> Result<Vec<SfmPoint>, ClipError> {
    let text = String::from_utf8_lossy(body);
    let lines = text.lines().map(str::trim).filter(|line| !line.is_empty());
    let points = lines
        .take(header.vertices)
        .enumerate()
        .map(|(index, line)| {
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            point(path, index, columns, |column| words.get(column)?.parse().ok())
        })
        .collect::<Result<Vec<_>, _>>()?;
    if points.len() < header.vertices {
        return Err(cut_short(path, points.len(), header.vertices));
    }
    Ok(points)
}

fn point(
    path: &Path,
    index: usize,
    columns: &Columns,
    value: impl Fn(usize) -> Option<f64>,
) -> Result<SfmPoint, ClipError> {
    let number = |column: usize| {
        value(column).filter(|number| number.is_finite()).ok_or_else(|| {
            ClipError::malformed(
                path,
                format!("vertex {index}, property {column}"),
                "no finite number",
                "a finite number",
            )
        })
    };
    let [x, y, z] = columns.position;
    let position = DVec3::new(number(x)?, number(y)?, number(z)?);
    let Some(channels) = columns.colour else {
        return Ok(SfmPoint { position, colour: GREY });
    };
    let mut colour = GREY;
    for (channel, (column, white)) in colour.iter_mut().zip(channels) {
        *channel = (number(column)? / white).clamp(0.0, 1.0) as f32;
    }
    Ok(SfmPoint { position, colour })
}

fn cut_short(path: &Path, found: usize, expected: usize) -> ClipError {
    ClipError::malformed(path, "vertices", format!("{found}, then the end of the file"), expected)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(bytes: &[u8]) -> Result<Vec<SfmPoint>, ClipError> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("points.ply");
        fs::write(&path, bytes).expect("a file");
        read(&path)
    }

    const ASCII: &str = "ply\nformat ascii 1.0\ncomment two points\nelement vertex 2\nproperty float x\nproperty float y\n\
        property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nelement face 0\n\
        property list uchar int vertex_indices\nend_header\n1 2 3 255 0 51\n-1.5 0 1e3 0 0 0\n";

    fn expected() -> Vec<SfmPoint> {
        vec![
            SfmPoint { position: DVec3::new(1.0, 2.0, 3.0), colour: [1.0, 0.0, 0.2] },
            SfmPoint { position: DVec3::new(-1.5, 0.0, 1000.0), colour: [0.0; 3] },
        ]
    }

    fn binary(header_kind: &str, vertices: usize) -> Vec<u8> {
        let mut bytes = format!(
            "ply\r\nformat {header_kind} 1.0\r\nelement vertex {vertices}\r\nproperty double x\r\nproperty float y\r\nproperty float nx\r\n\
             property float z\r\nproperty uchar blue\r\nproperty uchar green\r\nproperty uchar red\r\nend_header\r\n"
        )
        .into_bytes();
        for (x, y, z, bgr) in [(1.0_f64, 2.0_f32, 3.0_f32, [51_u8, 0, 255]), (-1.5, 0.0, 1000.0, [0; 3])] {
            bytes.extend(x.to_le_bytes());
            bytes.extend(y.to_le_bytes());
            bytes.extend(f32::NAN.to_le_bytes());
            bytes.extend(z.to_le_bytes());
            bytes.extend(bgr);
        }
        bytes
    }

    #[test]
    fn ascii_and_binary_agree() {
        assert_eq!(parse(ASCII.as_bytes()).expect("points"), expected());
        assert_eq!(parse(&binary("binary_little_endian", 2)).expect("points"), expected());
    }

    #[test]
    fn colours_are_optional_and_floats_are_already_scaled() {
        let plain = "ply\nformat ascii 1.0\nelement vertex 1\nproperty double x\nproperty double y\nproperty double z\nend_header\n1 2 3";
        assert_eq!(parse(plain.as_bytes()).expect("a point")[0].colour, GREY);
        let floats = plain
            .replace(
                "end_header",
                "property float red\nproperty float green\nproperty float blue\nend_header",
            )
            .replace("1 2 3", "1 2 3 0.25 2 -1");
        assert_eq!(parse(floats.as_bytes()).expect("a point")[0].colour, [0.25, 1.0, 0.0]);
        let none = plain.replace("vertex 1", "vertex 0").replace("1 2 3", "");
        assert!(parse(none.as_bytes()).expect("no points").is_empty());
    }

    #[test]
    fn damage_is_named() {
        let message = |bytes: &[u8]| parse(bytes).expect_err("damaged").to_string();
        let whole = binary("binary_little_endian", 2);
        assert!(message(&whole[..whole.len() - 1]).contains("found 1, then the end of the file, expected 2"));
        assert!(message(&binary("binary_little_endian", usize::MAX)).contains("end of the file"));
        assert!(message(&binary("binary_big_endian", 2)).contains("binary_big_endian"));
        let header_only = ASCII.split("end_header").next().expect("a header");
        assert!(message(header_only.as_bytes()).contains("end_header"));
        assert!(message(b"solid cube").contains("`ply`"));
        assert!(message(ASCII.replace("1 2 3 255", "nan 2 3 255").as_bytes()).contains("vertex 0"));
        assert!(message(ASCII.replace("-1.5 0 1e3 0 0 0\n", "").as_bytes()).contains("found 1"));
        assert!(message(ASCII.replace("property float z\n", "").as_bytes()).contains("no property z"));
        assert!(message(ASCII.replace("uchar red", "colour red").as_bytes()).contains("scalar type"));
    }
}
