//! Lens distortion of OpenCV's radial-tangential model, and its removal from images.
//!
//! COLMAP's `SIMPLE_RADIAL` is `k1` alone, `RADIAL` is `k1, k2`, `OPENCV` is all four.

use glam::DVec2;
use rayon::prelude::*;

use super::Camera;
use crate::image::{Image, Mask};

/// Intervals per axis of the grid on which [`Distortion::fold_within`] looks for folds.
const FOLD_GRID: u32 = 64;

/// Distortion coefficients; all zero means a pinhole lens.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Distortion {
    /// Radial, of the squared radius.
    pub k1: f64,
    /// Radial, of the radius to the fourth.
    pub k2: f64,
    /// Tangential.
    pub p1: f64,
    /// Tangential.
    pub p2: f64,
}

impl Distortion {
    /// Whether the lens is a pinhole.
    pub fn is_identity(&self) -> bool {
        *self == Self::default()
    }

    /// Where the lens images the undistorted normalised position `(x / z, y / z)`, normalised as well.
    pub fn apply(&self, ideal: DVec2) -> DVec2 {
        let DVec2 { x, y } = ideal;
        let r2 = ideal.length_squared();
        let radial = 1.0 + r2 * (self.k1 + r2 * self.k2);
        DVec2::new(
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + 2.0 * self.p2 * x * y + self.p1 * (r2 + 2.0 * y * y),
        )
    }

    /// `[dx'/dx, dx'/dy = dy'/dx, dy'/dy]` of [`Self::apply`]; the matrix is symmetric.
    pub fn jacobian(&self, ideal: DVec2) -> [f64; 3] {
        let DVec2 { x, y } = ideal;
        let r2 = ideal.length_squared();
        let radial = 1.0 + r2 * (self.k1 + r2 * self.k2);
        let slope = self.k1 + 2.0 * self.k2 * r2;
        [
            radial + 2.0 * x * x * slope + 2.0 * self.p1 * y + 6.0 * self.p2 * x,
            2.0 * x * y * slope + 2.0 * self.p1 * x + 2.0 * self.p2 * y,
            radial + 2.0 * y * y * slope + 2.0 * self.p2 * x + 6.0 * self.p1 * y,
        ]
    }

    /// A pixel of `camera` at which the distortion folds the image over itself, so that it cannot be removed.
    ///
    /// The map is one to one where its Jacobian stays positive definite; a fold always has another sign there.
    pub fn fold_within(&self, camera: &Camera) -> Option<DVec2> {
        let step = DVec2::new(f64::from(camera.width), f64::from(camera.height)) / f64::from(FOLD_GRID);
        let corners = 0..=FOLD_GRID;
        corners
            .clone()
            .flat_map(|row| corners.clone().map(move |column| (column, row)))
            .map(|(column, row)| DVec2::new(f64::from(column), f64::from(row)) * step)
            .find(|&pixel| {
                let [a, b, c] = self.jacobian(normalised(camera, pixel));
                let positive_definite = a > 0.0 && a * c - b * b > 0.0;
                !positive_definite
            })
    }
}

fn normalised(camera: &Camera, pixel: DVec2) -> DVec2 {
    DVec2::new((pixel.x - camera.cx) / camera.fx, (pixel.y - camera.cy) / camera.fy)
}

/// Where each pixel of the undistorted image is found in the photograph. Both share the camera's intrinsics.
#[derive(Clone, Debug)]
pub struct UndistortMap {
    width: u32,
    height: u32,
    /// Source positions in pixels counted from the **centre** of the top-left one, `height × width`.
    sources: Vec<[f32; 2]>,
}

impl UndistortMap {
    /// The map of a camera whose intrinsics hold before and after undistortion.
    pub fn new(camera: &Camera, distortion: &Distortion) -> Self {
        let (width, height) = (camera.width, camera.height);
        let row_of = |row: u32| {
            (0..width).map(move |column| {
                let centre = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
                let distorted = distortion.apply(normalised(camera, centre));
                let x = camera.fx * distorted.x + camera.cx - 0.5;
                let y = camera.fy * distorted.y + camera.cy - 0.5;
                [x as f32, y as f32]
            })
        };
        Self { width, height, sources: (0..height).flat_map(row_of).collect() }
    }

    /// The undistorted image, sampled bilinearly; positions outside the photograph take its nearest border pixel.
    pub fn image(&self, photograph: &Image) -> Image {
        let mut undistorted = Image::filled(self.width, self.height, [0.0; 3]);
        if photograph.pixels.is_empty() {
            return undistorted;
        }
        let row_values = (self.width as usize * 3).max(1);
        undistorted.pixels.par_chunks_mut(row_values).enumerate().for_each(|(row, values)| {
            let sources = &self.sources[row * self.width as usize..];
            for (value, &source) in values.chunks_exact_mut(3).zip(sources) {
                value.copy_from_slice(&bilinear(photograph, source));
            }
        });
        undistorted
    }

    /// The undistorted mask, each pixel from the nearest one of the photograph's; outside of it nothing is inside.
    pub fn mask(&self, mask: &Mask) -> Mask {
        let inside = self.sources.iter().map(|&source| nearest(mask, source)).collect();
        Mask { width: self.width, height: self.height, inside }
    }
}

fn bilinear(image: &Image, [x, y]: [f32; 2]) -> [f32; 3] {
    let (left, right, u) = neighbours(x, image.width);
    let (top, bottom, v) = neighbours(y, image.height);
    let corners =
        [image.at(left, top), image.at(right, top), image.at(left, bottom), image.at(right, bottom)];
    std::array::from_fn(|channel| {
        let [a, b, c, d] = corners.map(|colour| colour[channel]);
        let (upper, lower) = (a + u * (b - a), c + u * (d - c));
        upper + v * (lower - upper)
    })
}

/// The two pixels around a position along one axis, clamped to the image, and the weight of the second.
fn neighbours(position: f32, size: u32) -> (usize, usize, f32) {
    let last = size.saturating_sub(1);
    let clamped = position.clamp(0.0, last as f32);
    let first = clamped as usize;
    (first, (first + 1).min(last as usize), clamped - first as f32)
}

fn nearest(mask: &Mask, [x, y]: [f32; 2]) -> bool {
    let (column, row) = (x.round(), y.round());
    let outside = !(column >= 0.0 && row >= 0.0 && column < mask.width as f32 && row < mask.height as f32);
    if outside {
        return false;
    }
    mask.inside[row as usize * mask.width as usize + column as usize]
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec3};

    use super::*;

    fn camera() -> Camera {
        Camera {
            width: 96,
            height: 64,
            fx: 80.0,
            fy: 90.0,
            cx: 41.5,
            cy: 35.25,
            rotation: DMat3::IDENTITY,
            translation: DVec3::ZERO,
        }
    }

    const LENS: Distortion = Distortion { k1: -0.12, k2: 0.03, p1: 0.004, p2: -0.003 };

    /// A scene without edges, so that bilinear sampling errors stay small.
    fn radiance(ideal: DVec2) -> [f32; 3] {
        let DVec2 { x, y } = ideal;
        [0.5 + 0.4 * (3.0 * x).sin(), 0.5 + 0.4 * (2.0 * y).cos(), 0.5 + 0.3 * (2.0 * x * y).sin()]
            .map(|v| v as f32)
    }

    fn picture(camera: &Camera, seen_at: impl Fn(DVec2) -> DVec2) -> Image {
        let mut image = Image::filled(camera.width, camera.height, [0.0; 3]);
        for row in 0..camera.height {
            for column in 0..camera.width {
                let centre = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
                let first = ((row * camera.width + column) * 3) as usize;
                image.pixels[first..first + 3]
                    .copy_from_slice(&radiance(seen_at(normalised(camera, centre))));
            }
        }
        image
    }

    /// Inverse of the distortion by Newton's method, an independent way round.
    fn invert(lens: &Distortion, distorted: DVec2) -> DVec2 {
        let mut ideal = distorted;
        for _ in 0..50 {
            let residual = lens.apply(ideal) - distorted;
            let [a, b, c] = lens.jacobian(ideal);
            let determinant = a * c - b * b;
            ideal -=
                DVec2::new(c * residual.x - b * residual.y, a * residual.y - b * residual.x) / determinant;
        }
        ideal
    }

    #[test]
    fn known_distortion_values() {
        let at = DVec2::new(0.5, -0.25);
        // r² = 0.3125; radial of k1 = 0.1, k2 = 0.01: 1.0322265625.
        let radial = Distortion { k1: 0.1, k2: 0.01, ..Distortion::default() };
        assert!((radial.apply(at) - at * 1.0322265625).length() < 1e-15);
        // Tangential part as OpenCV documents it: 2 p1 x y + p2 (r² + 2x²), 2 p2 x y + p1 (r² + 2y²).
        let tangential = Distortion { p1: 0.01, p2: 0.02, ..Distortion::default() };
        let expected = at + DVec2::new(-0.0025 + 0.02 * 0.8125, -0.005 + 0.01 * 0.4375);
        assert!((tangential.apply(at) - expected).length() < 1e-15);
    }

    #[test]
    fn jacobian_matches_central_differences() {
        let step = 1e-6;
        for at in [DVec2::ZERO, DVec2::new(0.4, -0.3), DVec2::new(-0.7, 0.6)] {
            let [a, b, c] = LENS.jacobian(at);
            let dx = (LENS.apply(at + DVec2::X * step) - LENS.apply(at - DVec2::X * step)) / (2.0 * step);
            let dy = (LENS.apply(at + DVec2::Y * step) - LENS.apply(at - DVec2::Y * step)) / (2.0 * step);
            // Central differences of a quintic at step 1e-6 err by rounding only, about 1e-10.
            for (numeric, analytic) in [(dx.x, a), (dx.y, b), (dy.x, b), (dy.y, c)] {
                assert!((numeric - analytic).abs() < 1e-8, "{numeric} against {analytic} at {at}");
            }
        }
    }

    #[test]
    fn undistorted_photograph_shows_what_a_pinhole_sees() {
        let camera = camera();
        let photograph = picture(&camera, |seen| invert(&LENS, seen));
        let pinhole = picture(&camera, |seen| seen);
        let undistorted = UndistortMap::new(&camera, &LENS).image(&photograph);
        let worst = |image: &Image| {
            // The border may fall outside the photograph; the rest must agree.
            let inner = (3..camera.height as usize - 3)
                .flat_map(|y| (3..camera.width as usize - 3).map(move |x| (x, y)));
            inner
                .flat_map(|(x, y)| {
                    std::array::from_fn::<_, 3, _>(|c| (image.at(x, y)[c] - pinhole.at(x, y)[c]).abs())
                })
                .fold(0.0_f32, f32::max)
        };
        // Bilinear interpolation errs by f'' h²/8 per axis: 3.6 / 80² / 8 = 7e-5 here.
        assert!(worst(&undistorted) < 2e-4, "{}", worst(&undistorted));
        assert!(worst(&photograph) > 0.02, "the lens must be strong enough to notice");
    }

    #[test]
    fn round_trip_of_positions() {
        let camera = camera();
        for row in 0..=8 {
            for column in 0..=8 {
                let pixel = DVec2::new(f64::from(column) * 12.0, f64::from(row) * 8.0);
                let ideal = normalised(&camera, pixel);
                assert!((invert(&LENS, LENS.apply(ideal)) - ideal).length() < 1e-12, "at {pixel}");
            }
        }
    }

    #[test]
    fn without_coefficients_nothing_changes() {
        let camera = camera();
        let none = Distortion::default();
        assert!(none.is_identity());
        let map = UndistortMap::new(&camera, &none);
        let image = picture(&camera, |seen| seen);
        let same = map.image(&image);
        // f32 source positions are off a pixel centre by 4e-6 at most, times a colour slope below 0.1 per pixel.
        for (a, b) in image.pixels.iter().zip(&same.pixels) {
            assert!((a - b).abs() < 1e-6);
        }
        let mask = Mask { width: 96, height: 64, inside: (0..96 * 64).map(|i| i % 7 < 3).collect() };
        assert_eq!(map.mask(&mask), mask);
    }

    #[test]
    fn masks_move_with_the_image() {
        let camera = camera();
        let lens = Distortion { k1: 0.2, ..Distortion::default() };
        let ideal = DVec2::new(0.3, 0.2);
        let at = |position: DVec2| {
            let pixel =
                (DVec2::new(camera.fx, camera.fy) * position + DVec2::new(camera.cx, camera.cy)).floor();
            pixel.y as usize * 96 + pixel.x as usize
        };
        let mut mask = Mask { width: 96, height: 64, inside: vec![false; 96 * 64] };
        mask.inside[at(lens.apply(ideal))] = true;
        let undistorted = UndistortMap::new(&camera, &lens).mask(&mask);
        assert!(undistorted.inside[at(ideal)]);
        assert!(!undistorted.inside[0], "the corner lies outside the photograph");
    }

    #[test]
    fn folds_are_found() {
        let camera = camera();
        assert_eq!(LENS.fold_within(&camera), None);
        assert_eq!(Distortion::default().fold_within(&camera), None);
        // r (1 + k1 r²) turns back at r = 1 / sqrt(3 |k1|) = 0.33, inside this image.
        let folding = Distortion { k1: -3.0, ..Distortion::default() };
        assert!(folding.fold_within(&camera).is_some());
        let broken = Distortion { k2: f64::NAN, ..Distortion::default() };
        assert!(broken.fold_within(&camera).is_some());
        let huge = Distortion { k2: f64::INFINITY, ..Distortion::default() };
        assert!(huge.fold_within(&camera).is_some());
    }

    #[test]
    fn an_empty_photograph_is_no_panic() {
        let empty = Image { width: 0, height: 0, pixels: Vec::new() };
        let map = UndistortMap::new(&camera(), &LENS);
        assert!(map.image(&empty).pixels.iter().all(|&v| v == 0.0));
        let no_mask = Mask { width: 0, height: 0, inside: Vec::new() };
        assert!(map.mask(&no_mask).inside.iter().all(|&inside| !inside));
    }
}
