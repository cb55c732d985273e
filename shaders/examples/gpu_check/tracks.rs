//! Seeded track fields.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use splat::{cameras::Camera, tracking::TrackField};

/// Bent, noisy tracks with two motions 11 px apart, one pixel in ten hidden, claims from 0.01 to 3 px.
pub(crate) fn rough(camera: &Camera, seed: u64) -> TrackField {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let (width, height) = (camera.width, camera.height);
    let count = width as usize * height as usize;
    let mut field = TrackField {
        width,
        height,
        positions: Vec::with_capacity(count),
        visible: Vec::with_capacity(count),
        sigma: Vec::with_capacity(count),
    };
    let middle = 0.5 * f64::from(width);
    for (row, column) in (0..height).flat_map(|row| (0..width).map(move |column| (row, column))) {
        let (x, y) = (f64::from(column) + 0.5, f64::from(row) + 0.5);
        let sigma = 0.01 * 300f64.powf(random.random_range(0.0..1.0));
        let jump = if x + 0.3 * y > middle { 11.0 } else { 0.0 };
        let mut noise = || sigma * random.random_range(-1.7..1.7);
        let bend = 1e-5 * (x - middle) * (x - middle);
        let target = [x + 3.0 + 0.02 * y + bend + jump + noise(), y - 2.0 - 0.01 * x + noise()];
        field.positions.push(target.map(|value| value as f32));
        field.visible.push(random.random_range(0.0..1.0) > 0.1);
        field.sigma.push(sigma as f32);
    }
    field
}
