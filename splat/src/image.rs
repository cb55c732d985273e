//! Colour images and masks in memory.

use thiserror::Error;

/// An RGB image, `height × width × 3`, row by row, sRGB values in `[0, 1]`.
///
/// Renderings may leave that range; only decoded files are bound to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `height * width * 3` values, channel fastest.
    pub pixels: Vec<f32>,
}

/// Which pixels count, `height × width`, row by row.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mask {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// One flag per pixel.
    pub inside: Vec<bool>,
}

/// Why encoded bytes did not become an image.
#[derive(Debug, Error)]
pub enum DecodeError {
    /// Not a PNG, JPEG or WebP, or cut short.
    #[error("cannot decode the image: {0}; give a complete PNG, JPEG or WebP file")]
    Corrupt(#[from] ::image::ImageError),
}

impl Image {
    /// An image of one colour.
    pub fn filled(width: u32, height: u32, colour: [f32; 3]) -> Self {
        let pixels = std::iter::repeat_n(colour, width as usize * height as usize).flatten().collect();
        Self { width, height, pixels }
    }

    /// Number of pixels.
    pub fn pixel_count(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The colour at column `x`, row `y`.
    pub fn at(&self, x: usize, y: usize) -> [f32; 3] {
        let first = (y * self.width as usize + x) * 3;
        [self.pixels[first], self.pixels[first + 1], self.pixels[first + 2]]
    }

    /// Decodes a PNG, JPEG or WebP; 16-bit files keep their precision, alpha is dropped.
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let decoded = ::image::load_from_memory(bytes)?.into_rgb32f();
        let (width, height) = decoded.dimensions();
        Ok(Self { width, height, pixels: decoded.into_raw() })
    }

    /// Encodes as an 8-bit PNG, values rounded and clamped to `[0, 1]`.
    pub fn encode_png(&self) -> Vec<u8> {
        let mut bytes = std::io::Cursor::new(Vec::new());
        let encoder = ::image::codecs::png::PngEncoder::new(&mut bytes);
        ::image::ImageEncoder::write_image(
            encoder,
            &self.to_rgb8(),
            self.width,
            self.height,
            ::image::ExtendedColorType::Rgb8,
        )
        // Writing to memory has no I/O to fail, and the buffer has the size the header states.
        .unwrap_or_else(|error| unreachable!("an in-memory PNG of the stated size: {error}"));
        bytes.into_inner()
    }

    /// 8-bit RGB, values rounded and clamped to `[0, 1]`.
    pub fn to_rgb8(&self) -> Vec<u8> {
        self.pixels.iter().map(|&value| (value.clamp(0.0, 1.0) * 255.0).round() as u8).collect()
    }

    /// Luma per pixel on the 0 to 255 scale that dense-flow parameters are stated in.
    pub fn to_grey_255(&self) -> Vec<f32> {
        // Rec. 601 luma, as other dense-flow programs use.
        self.pixels
            .chunks_exact(3)
            .map(|rgb| 255.0 * (0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2]))
            .collect()
    }
}

impl Mask {
    /// Decodes a PNG, JPEG or WebP mask: a pixel is inside where any channel is not zero.
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let decoded = ::image::load_from_memory(bytes)?.into_luma16();
        let (width, height) = decoded.dimensions();
        let inside = decoded.into_raw().iter().map(|&value| value > 0).collect();
        Ok(Self { width, height, inside })
    }
}
