//! Reading vertices block by block.

use std::{
    fs::File,
    io::{BufRead, BufReader, Read},
    path::Path,
};

use super::{
    PlyError,
    header::{Element, Header, Scalar, read_header},
    parameter_names,
};
use crate::gaussians::{Gaussians, sh};

/// Vertices per read; also what is reserved at most before a byte of them has been seen.
const BLOCK: usize = 4096;

/// Reads a Gaussian PLY file.
pub fn read_ply(path: &Path) -> Result<Gaussians, PlyError> {
    let read = || read_gaussians(&mut BufReader::new(File::open(path)?));
    read().map_err(|source| PlyError::File { path: path.into(), source: Box::new(source) })
}

/// Reads a Gaussian PLY from memory.
pub fn parse_ply(mut bytes: &[u8]) -> Result<Gaussians, PlyError> {
    read_gaussians(&mut bytes)
}

/// Where a parameter lies in a row.
struct Column {
    name: String,
    offset: usize,
    double: bool,
}

impl Column {
    /// The value in a row that is at least as long as the layout says.
    fn value(&self, row: &[u8]) -> f64 {
        // The slices have the length of the arrays, so the defaults are never taken.
        if self.double {
            return f64::from_le_bytes(row[self.offset..][..8].try_into().unwrap_or_default());
        }
        f32::from_le_bytes(row[self.offset..][..4].try_into().unwrap_or_default()).into()
    }
}

fn read_gaussians(reader: &mut impl BufRead) -> Result<Gaussians, PlyError> {
    let Header { vertices, skip } = read_header(reader)?;
    let (degree, columns) = columns(&vertices)?;
    let truncated = |found| PlyError::Truncated { stated: vertices.count, found };
    if std::io::copy(&mut reader.by_ref().take(skip), &mut std::io::sink())? < skip {
        return Err(truncated(0));
    }

    let mut gaussians = Gaussians::empty(degree);
    let mut block = vec![0; BLOCK * vertices.stride];
    let mut values = vec![0.0_f32; columns.len()];
    let mut done = 0_u64;
    while done < vertices.count {
        let rows = (vertices.count - done).min(BLOCK as u64) as usize;
        let bytes = &mut block[..rows * vertices.stride];
        let filled = fill(reader, bytes)?;
        if filled < bytes.len() {
            return Err(truncated(done + (filled / vertices.stride) as u64));
        }
        for (row, bytes) in bytes.chunks_exact(vertices.stride).enumerate() {
            for (value, column) in values.iter_mut().zip(&columns) {
                let stored = column.value(bytes);
                *value = stored as f32;
                if !value.is_finite() {
                    return Err(PlyError::NotFinite {
                        vertex: done + row as u64,
                        property: column.name.clone(),
                        value: stored,
                    });
                }
            }
            push(&mut gaussians, &values);
        }
        done += rows as u64;
    }
    Ok(gaussians)
}

/// Degree and columns of the parameters, in the order of [`parameter_names`].
fn columns(vertices: &Element) -> Result<(u32, Vec<Column>), PlyError> {
    let has = |name: &str| vertices.properties.iter().any(|property| property.name == name);
    if has("packed_position") {
        return Err(PlyError::Compressed);
    }
    let rest = vertices.properties.iter().filter(|property| property.name.starts_with("f_rest_")).count();
    let degree = (0..=sh::MAX_DEGREE)
        .find(|&degree| 3 * (sh::coefficients(degree) - 1) == rest)
        .ok_or(PlyError::HarmonicCount(rest))?;
    let column = |name: String| {
        let Some(property) = vertices.properties.iter().find(|property| property.name == name) else {
            return Err(PlyError::MissingProperty(name));
        };
        let double = match property.scalar {
            Scalar::Float32 => false,
            Scalar::Float64 => true,
            other => return Err(PlyError::WrongType { property: name, found: other.name().into() }),
        };
        Ok(Column { name, offset: property.offset, double })
    };
    let columns = parameter_names(degree).into_iter().map(column).collect::<Result<_, _>>()?;
    Ok((degree, columns))
}

/// Appends one Gaussian given in the order of [`parameter_names`].
fn push(gaussians: &mut Gaussians, values: &[f32]) {
    let coefficients = gaussians.sh_coefficients();
    let rest = coefficients - 1;
    let (harmonics, tail) = values[3..].split_at(3 * coefficients);
    gaussians.means.push([values[0], values[1], values[2]]);
    gaussians.sh.extend_from_slice(&harmonics[..3]);
    for coefficient in 0..rest {
        gaussians.sh.extend((0..3).map(|channel| harmonics[3 + channel * rest + coefficient]));
    }
    gaussians.logit_opacities.push(tail[0]);
    gaussians.log_scales.push([tail[1], tail[2], tail[3]]);
    gaussians.rotations.push([tail[4], tail[5], tail[6], tail[7]]);
}

/// Reads until the buffer is full or the input ends; the number of bytes read.
fn fill(reader: &mut impl Read, buffer: &mut [u8]) -> std::io::Result<usize> {
    let mut filled = 0;
    while filled < buffer.len() {
        match reader.read(&mut buffer[filled..]) {
            Ok(0) => break,
            Ok(count) => filled += count,
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(filled)
}
