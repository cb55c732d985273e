//! Whole images, pixel by pixel, Gaussian by Gaussian.

use splat::{cameras::Camera, gaussians::Gaussians};

use super::{
    blend::{Close, Pixel, pixel},
    project::{Shape, plain, project},
};

/// Shapes in order of depth, ties by number, each with its Gaussian's number.
pub(crate) fn shapes(gaussians: &Gaussians, camera: &Camera) -> (Vec<usize>, Vec<Shape<f64>>) {
    let mut all: Vec<(usize, Shape<f64>)> = (0..gaussians.len())
        .filter_map(|index| Some((index, project(&plain(gaussians, index), gaussians, index, camera)?)))
        .collect();
    all.sort_by(|(_, a), (_, b)| a.depth.total_cmp(&b.depth));
    all.into_iter().unzip()
}

/// Every pixel of the image, row by row.
pub(crate) fn render(
    gaussians: &Gaussians,
    camera: &Camera,
    background: [f32; 3],
    close: Close,
) -> Vec<Pixel> {
    let (_, shapes) = shapes(gaussians, camera);
    let background = background.map(f64::from);
    let row = |y: u32| (0..camera.width).map(move |x| (f64::from(x) + 0.5, f64::from(y) + 0.5));
    (0..camera.height).flat_map(row).map(|(x, y)| pixel(&shapes, background, x, y, close)).collect()
}

#[cfg(test)]
mod tests {
    use trackersplat_tests::golden::{Golden, largest_difference};

    use super::*;

    #[test]
    fn images_are_those_of_the_golden_data() {
        for scene in ["basic", "degree0", "needles", "opaque", "near", "faint", "unnormalised"] {
            let golden = Golden::open(&format!("raster_{scene}_cam0"));
            let background = std::array::from_fn(|channel| golden.values("background")[channel] as f32);
            let pixels = render(&golden.gaussians(), &golden.camera(), background, Close::AsComputed);
            let image = pixels.iter().flat_map(|pixel| pixel.colour);
            // Both work in double precision; thresholds are single-precision constants here and exact ones there.
            let difference = largest_difference(image, golden.values("image"));
            assert!(difference < 1e-7, "{scene}: {difference:e}");
        }
    }
}
