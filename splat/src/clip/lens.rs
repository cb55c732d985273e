//! Intrinsics and distortion by COLMAP's model names, which nerfstudio shares.

use crate::cameras::distortion::Distortion;

/// Intrinsics of a lens, pixels, and its distortion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lens {
    pub(super) fx: f64,
    pub(super) fy: f64,
    pub(super) cx: f64,
    pub(super) cy: f64,
    pub(super) distortion: Distortion,
}

/// Why parameters make no lens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LensProblem {
    /// No such model here.
    Unsupported,
    /// The model takes this many parameters.
    ParameterCount(usize),
}

impl Lens {
    /// The lens of COLMAP's `model` with its parameters in COLMAP's order.
    pub(super) fn from_colmap(model: &str, parameters: &[f64]) -> Result<Self, LensProblem> {
        let lens = |fx, fy, cx, cy, k1, k2, p1, p2| Self {
            fx,
            fy,
            cx,
            cy,
            distortion: Distortion { k1, k2, p1, p2 },
        };
        match (model, parameters) {
            ("SIMPLE_PINHOLE", &[f, cx, cy]) => Ok(lens(f, f, cx, cy, 0.0, 0.0, 0.0, 0.0)),
            ("PINHOLE", &[fx, fy, cx, cy]) => Ok(lens(fx, fy, cx, cy, 0.0, 0.0, 0.0, 0.0)),
            ("SIMPLE_RADIAL", &[f, cx, cy, k1]) => Ok(lens(f, f, cx, cy, k1, 0.0, 0.0, 0.0)),
            ("RADIAL", &[f, cx, cy, k1, k2]) => Ok(lens(f, f, cx, cy, k1, k2, 0.0, 0.0)),
            ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => Ok(lens(fx, fy, cx, cy, k1, k2, p1, p2)),
            ("SIMPLE_PINHOLE", _) => Err(LensProblem::ParameterCount(3)),
            ("PINHOLE" | "SIMPLE_RADIAL", _) => Err(LensProblem::ParameterCount(4)),
            ("RADIAL", _) => Err(LensProblem::ParameterCount(5)),
            ("OPENCV", _) => Err(LensProblem::ParameterCount(8)),
            _ => Err(LensProblem::Unsupported),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_land_where_colmap_puts_them() {
        let numbers = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0];
        let of = |model: &str, count: usize| Lens::from_colmap(model, &numbers[..count]).expect("supported");
        let read = |lens: Lens| {
            let Distortion { k1, k2, p1, p2 } = lens.distortion;
            [lens.fx, lens.fy, lens.cx, lens.cy, k1, k2, p1, p2]
        };
        assert_eq!(read(of("SIMPLE_PINHOLE", 3)), [1.0, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(read(of("PINHOLE", 4)), [1.0, 2.0, 3.0, 4.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(read(of("SIMPLE_RADIAL", 4)), [1.0, 1.0, 2.0, 3.0, 4.0, 0.0, 0.0, 0.0]);
        assert_eq!(read(of("RADIAL", 5)), [1.0, 1.0, 2.0, 3.0, 4.0, 5.0, 0.0, 0.0]);
        assert_eq!(read(of("OPENCV", 8)), numbers);
        assert_eq!(Lens::from_colmap("OPENCV", &numbers[..4]), Err(LensProblem::ParameterCount(8)));
        assert_eq!(Lens::from_colmap("OPENCV_FISHEYE", &numbers), Err(LensProblem::Unsupported));
    }
}
