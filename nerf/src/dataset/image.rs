//! Float images in memory.

use super::average::average;

/// An image of f32 values, row by row from the top, `[height, width, channels]`.
///
/// Colours keep the transfer curve of their file (sRGB for PNG and JPEG) and lie in 0 to 1; NeRF is trained and
/// evaluated in that space. Alpha, the fourth channel, is straight (not premultiplied).
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Values per pixel: 1 grey, 3 RGB, 4 RGBA.
    pub channels: usize,
    /// `height * width * channels` values.
    pub data: Vec<f32>,
}

/// The row-major index of a pixel, which must lie within the `noun`.
#[inline]
#[track_caller]
pub(super) fn pixel_index([width, height]: [usize; 2], x: usize, y: usize, noun: &str) -> usize {
    assert!(x < width && y < height, "pixel ({x}, {y}) is outside of the {width}x{height} {noun}");
    y * width + x
}

impl Image {
    /// Creates an image of zeros.
    pub fn new(width: usize, height: usize, channels: usize) -> Self {
        Image { width, height, channels, data: vec![0.0; width * height * channels] }
    }

    /// Returns the channels of the pixel in column `x` and row `y`.
    ///
    /// # Panics
    /// If the pixel lies outside the image.
    pub fn pixel(&self, x: usize, y: usize) -> &[f32] {
        let start = self.channels * pixel_index([self.width, self.height], x, y, "image");
        &self.data[start..start + self.channels]
    }

    /// Returns the channels of the pixel in column `x` and row `y`, mutably.
    ///
    /// # Panics
    /// If the pixel lies outside the image.
    pub fn pixel_mut(&mut self, x: usize, y: usize) -> &mut [f32] {
        let start = self.channels * pixel_index([self.width, self.height], x, y, "image");
        &mut self.data[start..start + self.channels]
    }

    /// Downscales by an integer factor: each pixel is the average of `factor x factor` pixels.
    ///
    /// RGBA colours are weighted by alpha, so colours of transparent pixels do not bleed. A fully transparent box
    /// becomes zero.
    ///
    /// # Panics
    /// If `factor` is 0 or does not divide both the width and the height. (Cropping would change the camera's field of
    /// view.)
    #[track_caller]
    pub fn downscaled(&self, factor: usize) -> Image {
        let divides = factor > 0 && self.width.is_multiple_of(factor) && self.height.is_multiple_of(factor);
        assert!(divides, "the factor {factor} must divide both sides of a {}x{} image", self.width, self.height);
        if factor == 1 {
            return self.clone();
        }
        let Image { width, height, channels, .. } = *self;
        let small = [width / factor, height / factor];
        let data = average(&self.data, channels, [width, height], small);
        Image { width: small[0], height: small[1], channels, data }
    }

    /// Concatenates images side by side, from left to right.
    ///
    /// # Panics
    /// If there are none, or if their heights or channels differ.
    #[track_caller]
    pub fn hconcat(images: &[&Image]) -> Image {
        assert!(!images.is_empty(), "there must be at least one image");
        let (height, channels) = (images[0].height, images[0].channels);
        for other in images {
            assert!(
                other.height == height && other.channels == channels,
                "images side by side must have one height and one number of channels"
            );
        }
        let width = images.iter().map(|i| i.width).sum();
        let mut data = Vec::with_capacity(width * height * channels);
        for y in 0..height {
            for image in images {
                let row = image.width * channels;
                data.extend_from_slice(&image.data[y * row..(y + 1) * row]);
            }
        }
        Image { width, height, channels, data }
    }

    /// Panics at the caller's line unless both images have one shape.
    #[track_caller]
    pub(crate) fn assert_same_shape(&self, other: &Image) {
        let shape = |i: &Image| [i.height, i.width, i.channels];
        assert_eq!(shape(self), shape(other), "images must have the same height, width and channels");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(width: usize, height: usize, channels: usize, data: &[f32]) -> Image {
        assert_eq!(data.len(), width * height * channels);
        Image { width, height, channels, data: data.to_vec() }
    }

    #[test]
    fn downscaling_averages_boxes() {
        let grey = image(4, 2, 1, &[0.0, 1.0, 0.25, 0.25, 0.5, 0.5, 0.25, 0.25]);
        assert_eq!(grey.downscaled(2), image(2, 1, 1, &[0.5, 0.25]));
        assert_eq!(grey.downscaled(1), grey);
    }

    #[test]
    fn downscaling_keeps_a_constant_exactly() {
        for value in [0.1f32, 1.0 / 3.0, 0.6, 0.9999999] {
            let rgba: Vec<f32> = (0..36).flat_map(|_| [value, 1.0 - value, value * value, 0.7]).collect();
            let small = image(6, 6, 4, &rgba).downscaled(3);
            assert_eq!(small.data, rgba[..16]);
        }
    }

    #[test]
    fn transparent_colours_do_not_bleed() {
        // One opaque red pixel, one half transparent blue, two invisible green ones.
        let rgba = image(2, 2, 4, &[1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.5, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]);
        assert_eq!(rgba.downscaled(2).data, [2.0 / 3.0, 0.0, 1.0 / 3.0, 0.375]);
        let invisible = image(2, 2, 4, &[0.3, 0.4, 0.5, 0.0].repeat(4));
        assert_eq!(invisible.downscaled(2).data, [0.0; 4]);
    }

    #[test]
    #[should_panic(expected = "the factor 3 must divide both sides of a 4x6 image")]
    fn downscaling_does_not_crop() {
        Image::new(4, 6, 3).downscaled(3);
    }

    #[test]
    fn hconcat_joins_rows() {
        let (a, b) = (image(1, 2, 1, &[1.0, 2.0]), image(2, 2, 1, &[3.0, 4.0, 5.0, 6.0]));
        assert_eq!(Image::hconcat(&[&a, &b]), image(3, 2, 1, &[1.0, 3.0, 4.0, 2.0, 5.0, 6.0]));
    }

    #[test]
    #[should_panic(expected = "one height")]
    fn hconcat_refuses_other_heights() {
        Image::hconcat(&[&Image::new(1, 2, 1), &Image::new(1, 3, 1)]);
    }

    #[test]
    fn open_names_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("noise.png");
        let missing = Image::open(&path).unwrap_err().to_string();
        assert!(missing.contains("noise.png: cannot be read"), "{missing}");
        std::fs::write(&path, b"not a picture").unwrap();
        let garbage = Image::open(&path).unwrap_err().to_string();
        assert!(garbage.contains("noise.png: cannot be decoded"), "{garbage}");
    }
}
