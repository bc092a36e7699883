//! Writing of images to files.

use super::decode::decoder_within_memory;
use super::{Photo, Values};
use crate::error::{Error, Result};
use crate::files::write_atomic;
use image::codecs::bmp::BmpEncoder;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::codecs::tiff::TiffEncoder;
use image::codecs::webp::WebPEncoder;
use image::metadata::Orientation;
use image::{DynamicImage, ImageBuffer, ImageDecoder, ImageEncoder, ImageError};
use std::io::Cursor;
use std::path::Path;

/// Of 100. The loss is not visible.
const JPEG_QUALITY: u8 = 95;

/// The metadata of a file.
#[derive(Default)]
struct About {
    exif: Option<Vec<u8>>,
    icc: Option<Vec<u8>>,
}

impl Photo {
    /// Writes the image in the format of the file extension: PNG or TIFF (16 bits where it has them), JPEG of quality
    /// 95, lossless WebP, or BMP.
    ///
    /// # Errors
    /// If the extension is another, a JPEG would need an alpha channel, or the file cannot be written.
    pub fn save(&self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        let [width, height] = [self.width as u32, self.height as u32];
        let of_bytes = |bytes: Vec<u8>| match self.channels {
            3 => ImageBuffer::from_raw(width, height, bytes).map(DynamicImage::ImageRgb8),
            _ => ImageBuffer::from_raw(width, height, bytes).map(DynamicImage::ImageRgba8),
        };
        let decoded = match (&self.values, self.channels) {
            (Values::Bytes(v), _) => of_bytes(v.clone()),
            (Values::Words(v), 3) => ImageBuffer::from_raw(width, height, v.clone()).map(DynamicImage::ImageRgb16),
            (Values::Words(v), _) => ImageBuffer::from_raw(width, height, v.clone()).map(DynamicImage::ImageRgba16),
            // Floats become bytes.
            (Values::Floats(v), _) => of_bytes(v.iter().map(|x| (x.clamp(0.0, 1.0) * 255.0).round() as u8).collect()),
        };
        let decoded = decoded.ok_or_else(|| Error::file(path, "has a number of values that does not fit its size"))?;
        save(&decoded, path, About::default())
    }
}

/// Copies an image file and applies its EXIF orientation to the pixels.
///
/// Other EXIF data, such as the focal length, stays, but for that of rotated TIFF. Without a rotation, the file is copied byte for byte if it can be
/// decoded.
///
/// # Errors
/// If the file cannot be read, decoded or written.
pub fn copy_upright(from: impl AsRef<Path>, to: impl AsRef<Path>) -> Result<()> {
    let (from, to) = (from.as_ref(), to.as_ref());
    let bad = |e: ImageError| Error::file(from, format!("cannot be decoded: {e}"));
    let (mut decoder, _) = decoder_within_memory(from)?;
    let turn = decoder.orientation().unwrap_or(Orientation::NoTransforms);
    if turn == Orientation::NoTransforms {
        DynamicImage::from_decoder(decoder).map_err(bad)?;
        return std::fs::copy(from, to).map(drop).map_err(|e| Error::file(to, format!("cannot be written: {e}")));
    }
    let mut about = About { exif: decoder.exif_metadata().ok().flatten(), icc: decoder.icc_profile().ok().flatten() };
    about.exif = about.exif.filter(|exif| Orientation::from_exif_chunk(exif).is_some());
    if let Some(exif) = &mut about.exif {
        let _ = Orientation::remove_from_exif_chunk(exif);
    }
    let mut decoded = DynamicImage::from_decoder(decoder).map_err(bad)?;
    decoded.apply_orientation(turn);
    save(&decoded, to, about)
}

/// Copies an image file whose pixels are upright already, and sets its EXIF orientation, if it has one, to 1.
///
/// Converters of HEIC turn the pixels, but some keep the orientation of the original. Nothing else changes.
///
/// # Errors
/// If the file cannot be read, decoded or written.
pub fn copy_cleared(from: impl AsRef<Path>, to: impl AsRef<Path>) -> Result<()> {
    let (from, to) = (from.as_ref(), to.as_ref());
    let (mut decoder, _) = decoder_within_memory(from)?;
    let exif = decoder.exif_metadata().ok().flatten().filter(|exif| Orientation::from_exif_chunk(exif).is_some());
    DynamicImage::from_decoder(decoder).map_err(|e| Error::file(from, format!("cannot be decoded: {e}")))?;
    let mut bytes = std::fs::read(from).map_err(|e| Error::file(from, format!("cannot be read: {e}")))?;
    if let Some(exif) = exif {
        // The decoder returns bytes of the file.
        let Some(at) = bytes.windows(exif.len()).position(|window| window == exif) else {
            return Err(Error::file(from, "has EXIF data that cannot be changed: remove its orientation"));
        };
        let _ = Orientation::remove_from_exif_chunk(&mut bytes[at..at + exif.len()]);
    }
    write_atomic(to, &bytes)
}

fn save(decoded: &DynamicImage, path: &Path, about: About) -> Result<()> {
    let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default().to_ascii_lowercase();
    let mut bytes = vec![];
    let encoded = match ending.as_str() {
        "png" => encode(decoded, PngEncoder::new(&mut bytes), about),
        "jpg" | "jpeg" | "jfif" | "jpe" if decoded.color().has_alpha() => {
            return Err(Error::file(path, "cannot be written: JPEG has no alpha channel; name the images .png"));
        }
        "jpg" | "jpeg" | "jfif" | "jpe" => {
            encode(decoded, JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY), about)
        }
        "webp" => encode(decoded, WebPEncoder::new_lossless(&mut bytes), about),
        // The encoder has no place for EXIF data.
        "tif" | "tiff" => encode(decoded, TiffEncoder::new(Cursor::new(&mut bytes)), About { exif: None, ..about }),
        "bmp" => encode(decoded, BmpEncoder::new(&mut bytes), About::default()),
        _ => return Err(Error::file(path, "cannot be written: name it .png, .jpg, .webp or .tif")),
    };
    encoded.map_err(|e| Error::file(path, format!("cannot be encoded: {e}")))?;
    write_atomic(path, &bytes)
}

fn encode(decoded: &DynamicImage, mut encoder: impl ImageEncoder, about: About) -> image::ImageResult<()> {
    if let Some(exif) = about.exif {
        encoder.set_exif_metadata(exif).map_err(ImageError::Unsupported)?;
    }
    if let Some(icc) = about.icc {
        encoder.set_icc_profile(icc).map_err(ImageError::Unsupported)?;
    }
    decoded.write_with_encoder(encoder)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn saved_files_keep_the_bit_depth() {
        let folder = tempfile::tempdir().unwrap();
        let words = |channels: usize| (0..channels as u16 * 6).map(|i| i * 2700).collect::<Vec<u16>>();
        for (channels, values) in [
            (3, Values::Words(words(3))),
            (4, Values::Words(words(4))),
            (3, Values::Bytes(words(3).iter().map(|x| (x >> 8) as u8).collect())),
            (4, Values::Bytes(words(4).iter().map(|x| (x >> 8) as u8).collect())),
        ] {
            let photo = Photo { width: 3, height: 2, channels, values };
            let path = folder.path().join("photo.PNG");
            for path in [&path, &folder.path().join("photo.tif")] {
                photo.save(path).unwrap();
                assert_eq!(Photo::open(path, None).unwrap(), photo);
            }
            if let Values::Bytes(_) = photo.values {
                photo.save(folder.path().join("photo.bmp")).unwrap();
                assert_eq!(Photo::open(folder.path().join("photo.bmp"), None).unwrap(), photo);
            }
            if let (Values::Bytes(_), true) = (&photo.values, channels == 4) {
                photo.save(folder.path().join("photo.webp")).unwrap();
                assert_eq!(Photo::open(folder.path().join("photo.webp"), None).unwrap(), photo);
                let message = photo.save(folder.path().join("photo.jpg")).unwrap_err().to_string();
                assert!(message.contains("photo.jpg: cannot be written: JPEG has no alpha"), "{message}");
            }
        }
        let grey = Photo { width: 16, height: 8, channels: 3, values: Values::Bytes(vec![90; 384]) };
        grey.save(folder.path().join("grey.jpeg")).unwrap();
        assert_eq!(Photo::open(folder.path().join("grey.jpeg"), None).unwrap(), grey);
        assert!(grey.save(folder.path().join("grey.gif")).unwrap_err().to_string().contains("name it .png"));
    }

    #[test]
    fn upright_copies_keep_metadata() {
        let folder = tempfile::tempdir().unwrap();
        let [from, to] = ["from.jpg", "to.jpg"].map(|name| folder.path().join(name));
        // Two entries: the orientation, and the focal length in 35 mm equivalents.
        let exif = |turn: u8| {
            let mut exif = b"MM\0*\0\0\0\x08\0\x02\x01\x12\0\x03\0\0\0\x01\0".to_vec();
            exif.extend([turn, 0, 0]);
            exif.extend(b"\xa4\x05\0\x03\0\0\0\x01\0\x1c\0\0\0\0\0\0");
            exif
        };
        let picture = image::RgbImage::from_fn(16, 8, |x, _| image::Rgb([if x < 8 { 255 } else { 0 }; 3]));
        for turn in [1, 6] {
            let about = About { exif: Some(exif(turn)), icc: Some(vec![7; 300]) };
            save(&picture.clone().into(), &from, about).unwrap();
            // Upright already: the orientation changes alone.
            copy_cleared(&from, &to).unwrap();
            assert_eq!(Photo::open(&from, Some([16, 8])).unwrap(), Photo::open(&to, None).unwrap());
            let (mut decoder, _) = decoder_within_memory(&to).unwrap();
            assert_eq!(decoder.exif_metadata().unwrap(), Some(exif(1)));
            assert_eq!(std::fs::read(&from).unwrap() == std::fs::read(&to).unwrap(), turn == 1);
            copy_upright(&from, &to).unwrap();
            if turn == 1 {
                assert_eq!(std::fs::read(&from).unwrap(), std::fs::read(&to).unwrap());
                continue;
            }
            assert_eq!(Photo::size_of_file(&to).unwrap(), [[8, 16]; 2], "it needs no turning any more");
            assert_eq!(
                Photo::open(&to, None).unwrap().resized([1, 2]),
                Photo::open(&from, None).unwrap().resized([1, 2])
            );
            let (mut decoder, _) = decoder_within_memory(&to).unwrap();
            assert_eq!(decoder.exif_metadata().unwrap(), Some(exif(1)));
            assert_eq!(decoder.icc_profile().unwrap(), Some(vec![7; 300]));
        }
        std::fs::write(&from, b"no picture").unwrap();
        assert!(copy_cleared(&from, &to).unwrap_err().to_string().contains("from.jpg: cannot be decoded"));
        assert!(copy_upright(&from, &to).unwrap_err().to_string().contains("from.jpg: cannot be decoded"));
    }
}
