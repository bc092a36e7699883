//! Image output: 8-bit quantisation, PNG and JPEG.

use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};

use crate::dataset::image::Image;
use crate::error::Result;
use crate::files::write_atomic;

/// Quantises a value to a byte: `round(255 clamp(x, 0, 1))`. NaN becomes 0.
pub fn quantise(value: f32) -> u8 {
    // A cast from float to integer turns NaN into 0.
    (value.clamp(0.0, 1.0) * 255.0).round() as u8
}

impl Image {
    /// Encodes an 8-bit PNG file in memory: grey, RGB or RGBA by its channels, each value [quantised](quantise).
    ///
    /// # Panics
    /// If the image has no pixels, another number of channels than 1, 3 or 4, or a number of values that does not fit
    /// its size.
    #[track_caller]
    pub fn to_png(&self) -> Vec<u8> {
        let colour = match self.channels {
            1 => ExtendedColorType::L8,
            3 => ExtendedColorType::Rgb8,
            4 => ExtendedColorType::Rgba8,
            other => panic!("a PNG needs 1, 3 or 4 channels, not {other}"),
        };
        assert!(
            self.width > 0 && self.height > 0,
            "a PNG needs at least one pixel, not {}x{}",
            self.width,
            self.height
        );
        let mut png = Vec::new();
        self.encode(PngEncoder::new(&mut png), colour);
        png
    }

    #[track_caller]
    fn encode(&self, encoder: impl ImageEncoder, colour: ExtendedColorType) {
        let bytes: Vec<u8> = self.data.iter().map(|&value| quantise(value)).collect();
        encoder
            .write_image(&bytes, self.width as u32, self.height as u32, colour)
            .expect("the shape is checked before, and writing to memory does not fail");
    }

    /// Encodes a JPEG file in memory: grey or RGB by its channels, each value [quantised](quantise). `quality` is 1 to
    /// 100.
    ///
    /// # Panics
    /// If the image has no pixels, a side above 65535, another number of channels than 1 or 3, or a number of values
    /// that does not fit its size.
    #[track_caller]
    pub fn to_jpeg(&self, quality: u8) -> Vec<u8> {
        let colour = match self.channels {
            1 => ExtendedColorType::L8,
            3 => ExtendedColorType::Rgb8,
            other => panic!("a JPEG needs 1 or 3 channels, not {other}"),
        };
        let sides = 1..=usize::from(u16::MAX);
        let fits = sides.contains(&self.width) && sides.contains(&self.height);
        assert!(fits, "a JPEG needs sides of 1 to 65535 pixels, not {}x{}", self.width, self.height);
        let mut jpeg = Vec::new();
        self.encode(JpegEncoder::new_with_quality(&mut jpeg, quality), colour);
        jpeg
    }

    /// Writes the image to `path` as [PNG](Self::to_png), [atomically](write_atomic).
    ///
    /// # Errors
    /// If the file cannot be written; the error names it.
    ///
    /// # Panics
    /// As [`to_png`](Self::to_png).
    #[track_caller]
    pub fn save_png(&self, path: impl AsRef<Path>) -> Result<()> {
        write_atomic(path, &self.to_png())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_rounded_to_nearest() {
        let cases = [(0.0, 0), (1.0, 255), (-0.5, 0), (7.0, 255), (0.5, 128), (0.499 / 255.0, 0), (0.501 / 255.0, 1)];
        for (value, byte) in cases {
            assert_eq!(quantise(value), byte, "{value}");
        }
        assert_eq!([f32::NAN, f32::INFINITY, f32::NEG_INFINITY].map(quantise), [0, 255, 0]);
        assert!((0..=255).all(|byte| quantise(f32::from(byte) / 255.0) == byte));
    }

    #[test]
    fn jpeg_of_unsupported_size_or_channels_panics() {
        for channels in [1, 3] {
            // Constant areas, of which JPEG loses only the last digit.
            let data = [0.25, 0.75].iter().flat_map(|value| vec![*value; 8 * 8 * channels]).collect();
            let jpeg = Image { width: 8, height: 16, channels, data }.to_jpeg(95);
            let read = image::load_from_memory_with_format(&jpeg, image::ImageFormat::Jpeg).unwrap().to_rgb8();
            assert_eq!((read.width(), read.height()), (8, 16));
            for (row, expected) in [(0, 64_i32), (15, 191)] {
                assert!(read.get_pixel(3, row).0.iter().all(|x| (i32::from(*x) - expected).abs() < 4), "{channels}");
            }
        }
        let refused = |[width, height]: [usize; 2], channels: usize| {
            let image = Image { width, height, channels, data: vec![] };
            std::panic::catch_unwind(move || image.to_jpeg(90)).unwrap_err().downcast::<String>().unwrap()
        };
        for size in [[0, 1], [1, 0], [1 << 16, 1], [1, 1 << 16]] {
            assert!(refused(size, 3).contains("a JPEG needs sides of 1 to 65535 pixels"), "{size:?}");
        }
        assert!(refused([1, 1], 4).contains("1 or 3 channels"));
    }

    #[test]
    fn png_round_trip_is_exact_for_bytes() {
        let folder = tempfile::tempdir().unwrap();
        for channels in [3, 4] {
            let data = (0..5 * 3 * channels).map(|i| (i * 4 % 256) as f32 / 255.0).collect();
            let image = Image { width: 5, height: 3, channels, data };
            let path = folder.path().join("image.png");
            image.save_png(&path).unwrap();
            assert_eq!(Image::open(&path).unwrap(), image);
        }
        // A reader returns grey as RGB.
        let path = folder.path().join("grey.png");
        Image { width: 2, height: 1, channels: 1, data: vec![0.0, 1.0] }.save_png(&path).unwrap();
        assert_eq!(Image::open(&path).unwrap().data, [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2, "no temporary file stays behind");
    }

    #[test]
    #[should_panic(expected = "1, 3 or 4 channels, not 2")]
    fn png_of_two_channels_panics() {
        Image::new(1, 1, 2).to_png();
    }
}
