//! Training images as the loss reads them.

use splat::{engine::TrainingView, image::Image};

/// A training image and its mask.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct WantedImage {
    /// Per pixel the colour, and 1 if the pixel counts or 0: one byte each if packed, one number each if not.
    pub words: Vec<u32>,
    /// Whether the image has 8 bits per channel, as most files do: a quarter of the memory.
    pub is_packed: bool,
    /// Pixels that count.
    pub counted: usize,
}

impl WantedImage {
    /// Packs the image if nothing is lost.
    pub(crate) fn new(training: &TrainingView) -> Self {
        let counts = |pixel: usize| training.mask.as_ref().is_none_or(|mask| mask.inside[pixel]);
        let pixels = training.image.pixels.as_chunks::<3>().0;
        let counted = (0..pixels.len()).filter(|&pixel| counts(pixel)).count();
        let is_packed = is_eight_bits(&training.image);
        let colours = pixels.iter().enumerate();
        let words = if is_packed {
            let byte = |value: f32| (value * 255.0).round() as u8;
            let last = |pixel: usize| if counts(pixel) { u8::MAX } else { 0 };
            colours
                .map(|(pixel, &[red, green, blue])| {
                    u32::from_le_bytes([byte(red), byte(green), byte(blue), last(pixel)])
                })
                .collect()
        } else {
            let last = |pixel: usize| f32::from(u8::from(counts(pixel)));
            colours
                .flat_map(|(pixel, &[red, green, blue])| [red, green, blue, last(pixel)].map(f32::to_bits))
                .collect()
        };
        Self { words, is_packed, counted }
    }
}

/// Whether every value is a multiple of 1/255 in `[0, 1]`.
pub(crate) fn is_eight_bits(image: &Image) -> bool {
    image.pixels.iter().all(|&value| (0.0..=1.0).contains(&value) && (value * 255.0).round() / 255.0 == value)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use splat::image::Mask;

    use super::*;
    use crate::tests::support::arc;

    fn wanted(pixels: Vec<f32>, inside: Vec<bool>) -> WantedImage {
        let (width, height) = (inside.len() as u32, 1);
        WantedImage::new(&TrainingView {
            camera: arc(1, width, height).swap_remove(0),
            image: Arc::new(Image { width, height, pixels }),
            mask: Some(Arc::new(Mask { width, height, inside })),
        })
    }

    #[test]
    fn eight_bits_take_a_word_per_pixel_and_other_images_four() {
        let bytes: Vec<f32> = (0..=254_u8).map(|byte| f32::from(byte) / 255.0).collect();
        let packed = wanted(bytes.clone(), (0..85).map(|pixel| pixel != 1).collect());
        assert!(packed.is_packed);
        assert_eq!(packed.counted, 84);
        assert_eq!(packed.words[..3], [0xff02_0100, 0x0005_0403, 0xff08_0706]);
        for odd in [0.5, -1.0 / 255.0, 256.0 / 255.0] {
            let mut values = bytes.clone();
            values[7] = odd;
            let whole = wanted(values, vec![true; 85]);
            assert!(!whole.is_packed, "{odd}");
            assert_eq!(whole.words.len(), 4 * 85);
            assert_eq!(whole.words[9..12], [odd.to_bits(), (8.0_f32 / 255.0).to_bits(), 1.0_f32.to_bits()]);
        }
    }
}
