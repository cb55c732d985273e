//! Image files to images, refusing what decoders would quietly complete.

use std::{io::Cursor, path::Path};

use image::{ExtendedColorType, ImageEncoder, ImageReader, codecs::png::PngEncoder};

use super::ClipError;
use crate::image::{DecodeError, Image, Mask};

/// Start-of-scan and end-of-image markers; neither occurs inside a JPEG's compressed data.
const JPEG_SCAN: [u8; 2] = [0xFF, 0xDA];
const JPEG_END: [u8; 2] = [0xFF, 0xD9];

/// Decodes the image file `path` that holds `bytes`.
pub(super) fn image(path: &Path, bytes: &[u8]) -> Result<Image, ClipError> {
    refuse_cut_jpeg(path, bytes)?;
    Image::decode(bytes).map_err(|source| ClipError::Undecodable { path: path.to_owned(), source })
}

/// Decodes the mask file `path` that holds `bytes`.
pub(super) fn mask(path: &Path, bytes: &[u8]) -> Result<Mask, ClipError> {
    refuse_cut_jpeg(path, bytes)?;
    Mask::decode(bytes).map_err(|source| ClipError::Undecodable { path: path.to_owned(), source })
}

/// A mask as an 8-bit PNG, 255 inside.
pub(super) fn mask_png(mask: &Mask) -> Vec<u8> {
    let values: Vec<u8> = mask.inside.iter().map(|&inside| if inside { 255 } else { 0 }).collect();
    let mut bytes = Cursor::new(Vec::new());
    PngEncoder::new(&mut bytes)
        .write_image(&values, mask.width, mask.height, ExtendedColorType::L8)
        // Writing to memory has no I/O to fail, and the buffer has the size the header states.
        .unwrap_or_else(|error| unreachable!("an in-memory PNG of the stated size: {error}"));
    bytes.into_inner()
}

/// Columns and rows from the file's header alone.
pub(super) fn image_size(path: &Path) -> Result<[u32; 2], ClipError> {
    let reader =
        ImageReader::open(path).and_then(ImageReader::with_guessed_format).map_err(ClipError::io(path))?;
    let (width, height) = reader.into_dimensions().map_err(|source| ClipError::Undecodable {
        path: path.to_owned(),
        source: DecodeError::Corrupt(source),
    })?;
    Ok([width, height])
}

fn refuse_cut_jpeg(path: &Path, bytes: &[u8]) -> Result<(), ClipError> {
    let is_jpeg = bytes.starts_with(&[0xFF, 0xD8, 0xFF]);
    if !is_jpeg {
        return Ok(());
    }
    let last_scan = bytes.windows(2).rposition(|pair| pair == JPEG_SCAN).unwrap_or(0);
    let ends = bytes[last_scan..].windows(2).any(|pair| pair == JPEG_END);
    if ends { Ok(()) } else { Err(ClipError::Truncated { path: path.to_owned() }) }
}

#[cfg(test)]
mod tests {
    use image::ImageFormat;

    use super::*;

    fn encoded(format: ImageFormat) -> Vec<u8> {
        let picture = image::RgbImage::from_fn(40, 30, |x, y| {
            image::Rgb([(x * 6) as u8, (y * 8) as u8, (x * y) as u8])
        });
        let mut bytes = Cursor::new(Vec::new());
        picture.write_to(&mut bytes, format).expect("encoded");
        bytes.into_inner()
    }

    #[test]
    fn every_format_is_read_whole_and_refused_cut() {
        let path = Path::new("frame_0001.png");
        for format in [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::WebP] {
            let bytes = encoded(format);
            let picture = image(path, &bytes).expect("complete");
            assert_eq!([picture.width, picture.height], [40, 30], "{format:?} by content, not by name");
            for kept in [0, 1, 10, bytes.len() / 4, bytes.len() / 2, bytes.len() * 3 / 4, bytes.len() - 13] {
                let error = image(path, &bytes[..kept]).err();
                let error =
                    error.unwrap_or_else(|| panic!("{format:?} cut to {kept} of {} bytes", bytes.len()));
                assert!(error.to_string().contains("frame_0001.png"));
                assert!(mask(path, &bytes[..kept]).is_err());
            }
        }
    }

    #[test]
    fn jpeg_with_a_thumbnail_and_a_tail_is_whole() {
        let jpeg = encoded(ImageFormat::Jpeg);
        // An APP1 segment holding a whole JPEG, as cameras write thumbnails, must not stand for the image's end.
        let mut with_thumbnail = jpeg[..2].to_vec();
        with_thumbnail.extend([0xFF, 0xE1]);
        with_thumbnail.extend((jpeg.len() as u16 + 2).to_be_bytes());
        with_thumbnail.extend(&jpeg);
        with_thumbnail.extend(&jpeg[2..]);
        let path = Path::new("a.jpg");
        assert!(image(path, &with_thumbnail).is_ok());
        let cut = &with_thumbnail[..with_thumbnail.len() - 20];
        assert!(matches!(image(path, cut), Err(ClipError::Truncated { .. })));
        with_thumbnail.extend([0; 64]);
        assert!(image(path, &with_thumbnail).is_ok(), "padding after the end is harmless");
    }

    #[test]
    fn masks_survive_encoding() {
        let original = Mask { width: 5, height: 3, inside: (0..15).map(|i| i % 4 == 1).collect() };
        assert_eq!(mask(Path::new("m.png"), &mask_png(&original)).expect("decoded"), original);
    }
}
