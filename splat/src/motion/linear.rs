//! Small matrices that `glam` has no names for.

use glam::{DMat3, DVec3};

/// `a bᵀ`.
pub(super) fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

/// Sum of the diagonal.
pub(super) fn trace(m: DMat3) -> f64 {
    m.x_axis.x + m.y_axis.y + m.z_axis.z
}

/// `[v]×`, so that `cross_matrix(v) * w = v × w`.
pub(super) fn cross_matrix(v: DVec3) -> DMat3 {
    DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0))
}

/// Solves `matrix x = right` for a symmetric positive definite matrix by Cholesky decomposition, which stays
/// accurate where one direction is known a billion times better than another. `None` if it is not positive
/// definite.
pub(super) fn solve(matrix: DMat3, right: DVec3) -> Option<DVec3> {
    let [a, b, c] = [matrix.x_axis, matrix.y_axis, matrix.z_axis];
    let root = |pivot: f64| (pivot > 0.0).then(|| pivot.sqrt());
    let xx = root(a.x)?;
    let (yx, zx) = (a.y / xx, a.z / xx);
    let yy = root(b.y - yx * yx)?;
    let zy = (b.z - zx * yx) / yy;
    let zz = root(c.z - zx * zx - zy * zy)?;
    let x = right.x / xx;
    let y = (right.y - yx * x) / yy;
    let z = (right.z - zx * x - zy * y) / zz;
    let z = z / zz;
    let y = (y - zy * z) / yy;
    let solution = DVec3::new((x - yx * y - zx * z) / xx, y, z);
    solution.is_finite().then_some(solution)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solve_inverts_what_is_positive_definite() {
        let [u, v] = [DVec3::new(1.0, 2.0, -0.5), DVec3::new(0.3, -1.0, 2.0)];
        for weak in [1.0, 1e-6, 1e-12] {
            // Known along two directions, hardly along the third.
            let matrix = outer(u, u) + outer(v, v) + DMat3::from_diagonal(DVec3::splat(weak));
            let expected = DVec3::new(0.2, -3.0, 1.5);
            let found = solve(matrix, matrix * expected).expect("positive definite");
            // Backward stable: rounding of the matrix moves the solution along the weak direction by its share.
            assert!((found - expected).length() < 1e-15 * 100.0 / weak, "{weak}: {found}");
            assert!((matrix * (found - expected)).length() < 1e-13, "{weak}: {found}");
        }
        assert_eq!(solve(outer(u, u), u), None);
        assert_eq!(solve(DMat3::from_diagonal(DVec3::new(1.0, -1.0, 1.0)), u), None);
        assert_eq!(solve(DMat3::IDENTITY * f64::NAN, u), None);
        assert_eq!(solve(DMat3::IDENTITY * 1e-300, DVec3::splat(1e300)), None);
    }
}
