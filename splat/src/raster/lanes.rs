//! Vectors, rotations and parameters of eight Gaussians at a time, one per lane.

use std::ops::{Add, Mul, Sub};

use glam::DVec3;

use crate::{
    gaussians::part::Part,
    simd::{Doubles, OCTET},
};

/// A 3-vector per lane.
#[derive(Clone, Copy)]
pub(super) struct Vector<D> {
    pub x: D,
    pub y: D,
    pub z: D,
}

impl<D: Doubles> Vector<D> {
    /// The same in every lane.
    #[inline(always)]
    pub(super) fn splat(vector: DVec3) -> Self {
        Self { x: D::splat(vector.x), y: D::splat(vector.y), z: D::splat(vector.z) }
    }

    #[inline(always)]
    pub(super) fn dot(self, other: Self) -> D {
        self.x.mul_add(other.x, self.y.mul_add(other.y, self.z * other.z))
    }

    #[inline(always)]
    pub(super) fn length_squared(self) -> D {
        self.dot(self)
    }

    #[inline(always)]
    pub(super) fn cross(self, other: Self) -> Self {
        Self {
            x: self.y.mul_sub(other.z, self.z * other.y),
            y: self.z.mul_sub(other.x, self.x * other.z),
            z: self.x.mul_sub(other.y, self.y * other.x),
        }
    }

    /// `self * factor + term`.
    #[inline(always)]
    pub(super) fn scaled_plus(self, factor: D, term: Self) -> Self {
        Self {
            x: self.x.mul_add(factor, term.x),
            y: self.y.mul_add(factor, term.y),
            z: self.z.mul_add(factor, term.z),
        }
    }
}

impl<D: Doubles> Add for Vector<D> {
    type Output = Self;
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Self { x: self.x + other.x, y: self.y + other.y, z: self.z + other.z }
    }
}

impl<D: Doubles> Sub for Vector<D> {
    type Output = Self;
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Self { x: self.x - other.x, y: self.y - other.y, z: self.z - other.z }
    }
}

impl<D: Doubles> Mul<D> for Vector<D> {
    type Output = Self;
    #[inline(always)]
    fn mul(self, factor: D) -> Self {
        Self { x: self.x * factor, y: self.y * factor, z: self.z * factor }
    }
}

/// `Σ vectors[i] · factors[i]`: a matrix of these columns times a vector.
#[inline(always)]
pub(super) fn combine<D: Doubles>(vectors: &[Vector<D>; 3], factors: Vector<D>) -> Vector<D> {
    let [a, b, c] = *vectors;
    a.scaled_plus(factors.x, b.scaled_plus(factors.y, c * factors.z))
}

/// The product of the transpose of a matrix of these columns with a vector.
#[inline(always)]
pub(super) fn dots<D: Doubles>(vectors: &[Vector<D>; 3], other: Vector<D>) -> Vector<D> {
    let [a, b, c] = *vectors;
    Vector { x: a.dot(other), y: b.dot(other), z: c.dot(other) }
}

/// A unit quaternion per lane, and the length of what it was stored as.
#[derive(Clone, Copy)]
pub(super) struct Rotation<D> {
    /// `w, x, y, z`.
    pub unit: [D; 4],
    /// Zero or no finite number where the stored quaternion has no direction.
    pub norm: D,
}

impl<D: Doubles> Rotation<D> {
    /// Of stored quaternions `w, x, y, z`; the identity for those that are zero or no finite number.
    ///
    /// Squares of single-precision numbers neither vanish nor overflow in double precision.
    #[inline(always)]
    pub(super) fn new([w, x, y, z]: [D; 4]) -> Self {
        let (zero, one) = (D::splat(0.0), D::splat(1.0));
        let squared = w.mul_add(w, x.mul_add(x, y.mul_add(y, z * z)));
        let norm = squared.sqrt();
        let inverse = one / norm;
        let has_direction = D::both(norm.gt(zero), norm.is_finite());
        let unit = [
            D::select(has_direction, w * inverse, one),
            D::select(has_direction, x * inverse, zero),
            D::select(has_direction, y * inverse, zero),
            D::select(has_direction, z * inverse, zero),
        ];
        Self { unit, norm }
    }

    /// Columns of the rotation matrix.
    #[inline(always)]
    pub(super) fn columns(&self) -> [Vector<D>; 3] {
        let [w, x, y, z] = self.unit;
        let (one, x2, y2, z2) = (D::splat(1.0), x + x, y + y, z + z);
        let (xx, yy, zz) = (x * x2, y * y2, z * z2);
        let (xy, xz, yz) = (x * y2, x * z2, y * z2);
        let (wx, wy, wz) = (w * x2, w * y2, w * z2);
        [
            Vector { x: one - (yy + zz), y: xy + wz, z: xz - wy },
            Vector { x: xy - wz, y: one - (xx + zz), z: yz + wx },
            Vector { x: xz + wy, y: yz - wx, z: one - (xx + yy) },
        ]
    }

    /// Gradient by the stored quaternions from that by the columns of the rotation matrix; zero where they have no
    /// direction.
    #[inline(always)]
    pub(super) fn gradient(&self, columns: &[Vector<D>; 3]) -> [D; 4] {
        let [w, x, y, z] = self.unit;
        let [a, b, c] = *columns;
        let two = D::splat(2.0);
        // Of row and column of each pair of entries off the diagonal.
        let (yx_less, yx_both) = (a.y - b.x, a.y + b.x);
        let (xz_less, xz_both) = (c.x - a.z, c.x + a.z);
        let (zy_less, zy_both) = (b.z - c.y, b.z + c.y);
        let by_unit = [
            z * yx_less + (y * xz_less + x * zy_less),
            y * yx_both + (z * xz_both + w * zy_less) - x * (two * (b.y + c.z)),
            x * yx_both + (z * zy_both + w * xz_less) - y * (two * (a.x + c.z)),
            x * xz_both + (y * zy_both + w * yx_less) - z * (two * (a.x + b.y)),
        ];
        let along = w * by_unit[0] + x * by_unit[1] + (y * by_unit[2] + z * by_unit[3]);
        let zero = D::splat(0.0);
        let has_direction = D::both(self.norm.gt(zero), self.norm.is_finite());
        let scale = D::select(has_direction, two / self.norm, zero);
        [
            (by_unit[0] - w * along) * scale,
            (by_unit[1] - x * along) * scale,
            (by_unit[2] - y * along) * scale,
            (by_unit[3] - z * along) * scale,
        ]
    }
}

/// Parameters of eight Gaussians but for their colours.
#[derive(Clone, Copy)]
pub(super) struct Geometry<D> {
    pub mean: Vector<D>,
    /// As stored.
    pub rotation: [D; 4],
    pub log_scale: [D; 3],
    pub logit_opacity: D,
}

impl<D: Doubles> Geometry<D> {
    /// Of the Gaussians from `first` on; the last of the part stands in for those beyond.
    #[inline(always)]
    pub(super) fn load(part: &Part<'_>, first: usize) -> Self {
        let [logit_opacity] = columns(part.logit_opacities.as_chunks().0, first);
        Self {
            mean: load_means(part, first),
            rotation: columns(part.rotations, first),
            log_scale: columns(part.log_scales, first),
            logit_opacity,
        }
    }
}

/// World means of the Gaussians from `first` on; the last of the part stands in for those beyond.
#[inline(always)]
pub(super) fn load_means<D: Doubles>(part: &Part<'_>, first: usize) -> Vector<D> {
    let [x, y, z] = columns(part.means, first);
    Vector { x, y, z }
}

/// The columns of eight rows from `first` on; the last row stands in for those beyond.
#[inline(always)]
fn columns<D: Doubles, const WIDTH: usize>(rows: &[[f32; WIDTH]], first: usize) -> [D; WIDTH] {
    let mut singles = [[0.0; OCTET]; WIDTH];
    if let Some(rows) = rows.get(first..).and_then(|rows| rows.first_chunk::<OCTET>()) {
        for column in 0..WIDTH {
            for lane in 0..OCTET {
                singles[column][lane] = rows[lane][column];
            }
        }
    } else {
        for lane in 0..OCTET {
            let row = &rows[(first + lane).min(rows.len() - 1)];
            for column in 0..WIDTH {
                singles[column][lane] = row[column];
            }
        }
    }
    let mut columns = [D::splat(0.0); WIDTH];
    for (column, singles) in columns.iter_mut().zip(&singles) {
        *column = D::load_singles(singles);
    }
    columns
}

/// Writes columns, in single precision, to up to eight rows; zeros where bits of `kept` are.
#[inline(always)]
pub(super) fn store_rows<D: Doubles, const WIDTH: usize>(
    columns: [D; WIDTH],
    kept: u8,
    rows: &mut [[f32; WIDTH]],
) {
    let mut singles = [[0.0; OCTET]; WIDTH];
    for (column, singles) in columns.iter().zip(&mut singles) {
        column.store_singles(singles);
    }
    for (lane, row) in rows.iter_mut().take(OCTET).enumerate() {
        for column in 0..WIDTH {
            row[column] = if kept >> lane & 1 == 0 { 0.0 } else { singles[column][lane] };
        }
    }
}

/// `1 / (1 + exp(-x))`, without overflow at either end.
#[inline(always)]
pub(super) fn sigmoid<D: Doubles>(x: D) -> D {
    let (zero, one) = (D::splat(0.0), D::splat(1.0));
    let small = (-x.abs()).exp();
    D::select(x.ge(zero), one, small) / (one + small)
}
