//! Whether a frame shows the key frame again: hardly anything moves, and the light is the same.

use super::FrameView;
use crate::{
    engine::{Engine, EngineError},
    gaussians::Gaussians,
    image::Image,
    motion::MotionOrigin,
    refine::RefineSettings,
};

/// Side of the blocks whose mean colours are compared, pixels: noise and blur average out, shadows do not.
const BLOCK: usize = 16;

/// Which Gaussians refinement leaves as they are; empty: none.
///
/// Static Gaussians are frozen if the settings ask for it, or if the frame is at rest: what is left to learn from it
/// is its noise.
pub(super) fn frozen(
    engine: &dyn Engine,
    gaussians: &Gaussians,
    origin: &[MotionOrigin],
    views: &[FrameView],
    background: [f32; 3],
    settings: &RefineSettings,
) -> Result<Vec<bool>, EngineError> {
    let is_static: Vec<bool> = origin.iter().map(|&origin| origin == MotionOrigin::Static).collect();
    if settings.freeze_static {
        return Ok(is_static);
    }
    let at_rest = is_static.iter().filter(|&&at_rest| at_rest).count() as f32;
    if at_rest < settings.rest_share * is_static.len() as f32 {
        return Ok(Vec::new());
    }
    let (mut difference, mut blocks) = (0.0, 0usize);
    for view in views {
        let rendered = engine.render(gaussians, &view.camera, background)?.image;
        let (sum, count) = block_difference(&rendered, &view.image);
        difference += sum;
        blocks += count;
    }
    let same_light = difference <= f64::from(settings.rest_light) * blocks as f64;
    Ok(if same_light { is_static } else { Vec::new() })
}

/// Sum over blocks and channels of the absolute difference of their mean colours, and the number of terms.
fn block_difference(a: &Image, b: &Image) -> (f64, usize) {
    let (width, height) = (a.width as usize, a.height as usize);
    let (mut sum, mut count) = (0.0, 0);
    for top in (0..height).step_by(BLOCK) {
        for left in (0..width).step_by(BLOCK) {
            let (bottom, right) = ((top + BLOCK).min(height), (left + BLOCK).min(width));
            let mut difference = [0.0f64; 3];
            for y in top..bottom {
                for x in left..right {
                    let (a, b) = (a.at(x, y), b.at(x, y));
                    for channel in 0..3 {
                        difference[channel] += f64::from(a[channel].clamp(0.0, 1.0) - b[channel]);
                    }
                }
            }
            let pixels = ((bottom - top) * (right - left)) as f64;
            sum += difference.iter().map(|value| (value / pixels).abs()).sum::<f64>();
            count += 3;
        }
    }
    (sum, count)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_averages_out_and_light_does_not() {
        let flat = Image::filled(40, 33, [0.5; 3]);
        let mut noisy = flat.clone();
        for (number, value) in noisy.pixels.iter_mut().enumerate() {
            *value += if (number / 3 + number / 120) % 2 == 0 { 0.1 } else { -0.1 };
        }
        let (sum, count) = block_difference(&noisy, &flat);
        assert_eq!(count, 3 * 3 * 3);
        assert!(sum / (count as f64) < 0.01, "noise of 0.1 leaves {}", sum / count as f64);
        let (sum, count) = block_difference(&Image::filled(40, 33, [0.6; 3]), &flat);
        assert!((sum / count as f64 - 0.1).abs() < 1e-6, "light of 0.1 leaves {}", sum / count as f64);
    }
}
