//! Images in memory with the integers of their files.

use super::average::{Stored, average};
use super::background::over;
use super::image::{Image, pixel_index};
use crate::error::{Error, Result};
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder};
use raygrad_tensor::simd;
use std::fs::File;
use std::hash::{Hash, Hasher};
use std::io::{BufReader, Cursor};
use std::path::Path;

pub(super) use decode::{Header, decoder_of};
use decode::{JPEG, decoder, decoder_within_memory, is_cut_jpeg};
pub use exif::{Exif, ExifLens};
use profile::Profile;
use start::start_of;

mod decode;
mod exif;
mod profile;
mod resample;
pub(crate) mod save;
pub(crate) mod sharpness;
mod start;
mod tiff;
pub(crate) mod unsupported;

/// The least alpha of an opaque pixel: 8-bit rounding may leave 254 of 255.
pub(super) const OPAQUE: f32 = 0.99;

/// An RGB or RGBA image with the integers of its file: three or four bytes per pixel, twice that for 16 bits.
///
/// Colours are sRGB values. Alpha is straight (not premultiplied).
#[derive(Debug, Clone, PartialEq)]
pub struct Photo {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Values per pixel: 3 for RGB, 4 for RGBA.
    pub channels: usize,
    values: Values,
}

/// The row-major values.
#[derive(Debug, Clone, PartialEq)]
enum Values {
    Bytes(Vec<u8>),
    Words(Vec<u16>),
    Floats(Vec<f32>),
}

impl Photo {
    /// Adds the size and all values to a hash.
    pub(crate) fn hash_values(&self, hasher: &mut impl Hasher) {
        [self.width, self.height, self.channels].hash(hasher);
        match &self.values {
            Values::Bytes(bytes) => hasher.write(bytes),
            Values::Words(words) => words.hash(hasher),
            Values::Floats(floats) => floats.iter().for_each(|x| hasher.write_u32(x.to_bits())),
        }
    }
}

impl From<Image> for Photo {
    /// Converts an image, keeping floats (12 or 16 bytes per pixel). Grey becomes three equal channels.
    ///
    /// # Panics
    /// If the image has not 1, 3 or 4 channels.
    fn from(image: Image) -> Self {
        let Image { width, height, channels, data } = image;
        let (channels, data) = match channels {
            1 => (3, data.into_iter().flat_map(|x| [x; 3]).collect()),
            3 | 4 => (channels, data),
            _ => panic!("an image needs 1, 3 or 4 channels, not {channels}"),
        };
        Photo { width, height, channels, values: Values::Floats(data) }
    }
}

impl Photo {
    /// Reads a PNG, JPEG, WebP, TIFF or BMP file, by its contents: RGBA if it has transparency, otherwise RGB.
    ///
    /// It applies the EXIF orientation, unless `size`, the width and height of the camera, is that of the stored
    /// pixels: programs that calibrate cameras use these.
    ///
    /// It converts colours to sRGB by an ICC profile with a matrix and curves, such as Display P3, and clips them.
    /// Without such a profile colours [count as sRGB](Self::has_unread_profile).
    ///
    /// # Errors
    /// If the file cannot be read or decoded, or ends within its pixels. If it claims more than 2^28 pixels or more than
    /// 64 MiB plus 16 KiB per byte of the file, or needs more memory than is free. The error names it.
    pub fn open(path: impl AsRef<Path>, size: Option<[usize; 2]>) -> Result<Self> {
        let path = path.as_ref();
        let (mut decoder, stored) = decoder_within_memory(path)?;
        if is_cut_jpeg(path)? {
            let what = "ends within its pixels: copy it again, or save it again with another program";
            return Err(Error::file(path, what));
        }
        let turn = decoder.orientation().unwrap_or(Orientation::NoTransforms);
        let profile = Profile::of(&mut decoder);
        let decoded = DynamicImage::from_decoder(decoder);
        let mut decoded = decoded.map_err(|e| Error::file(path, format!("cannot be decoded: {e}")))?;
        if size != Some(stored) {
            decoded.apply_orientation(turn);
        }
        let mut photo = Self::from_decoded(decoded);
        match &mut photo.values {
            Values::Bytes(values) => profile.convert_bytes(values, photo.channels),
            Values::Words(values) => profile.convert_words(values, photo.channels),
            // Decoded files hold integers.
            Values::Floats(_) => {}
        }
        Ok(photo)
    }

    fn from_decoded(decoded: DynamicImage) -> Self {
        let (width, height) = (decoded.width() as usize, decoded.height() as usize);
        let format = decoded.color();
        let eight_bits = format.bytes_per_pixel() == format.channel_count();
        let (channels, values) = match (format.has_alpha(), eight_bits) {
            (false, true) => (3, Values::Bytes(decoded.into_rgb8().into_raw())),
            (true, true) => (4, Values::Bytes(decoded.into_rgba8().into_raw())),
            (false, false) => (3, Values::Words(decoded.into_rgb16().into_raw())),
            (true, false) => (4, Values::Words(decoded.into_rgba16().into_raw())),
        };
        Photo { width, height, channels, values }
    }

    /// Reads `[width, height]` of an image file from its header: as stored, and after the EXIF orientation.
    ///
    /// # Errors
    /// If the file cannot be read, is not an image or has more than 2^28 pixels.
    pub fn size_of_file(path: impl AsRef<Path>) -> Result<[[usize; 2]; 2]> {
        Ok(Header::read(path.as_ref())?.sizes)
    }

    /// Returns the most bytes of memory while a file is [opened](Self::open), from its header.
    ///
    /// # Errors
    /// As [`size_of_file`](Self::size_of_file).
    pub fn decoding_memory(path: impl AsRef<Path>) -> Result<u64> {
        Ok(Header::read(path.as_ref())?.decoding)
    }

    /// Reads from its header whether an image file has an alpha channel.
    ///
    /// # Errors
    /// If the file cannot be read or is not an image.
    pub fn file_has_alpha(path: impl AsRef<Path>) -> Result<bool> {
        Ok(decoder(path.as_ref())?.0.color_type().has_alpha())
    }

    /// Reads the EXIF data of an image file. A file without any has the default.
    ///
    /// # Errors
    /// If the file cannot be read or is not an image.
    pub fn exif_of_file(path: impl AsRef<Path>) -> Result<Exif> {
        let path = path.as_ref();
        let (start, length) = start_of(path)?;
        if tiff::is_tiff(&start) {
            let file = File::open(path).map_err(|e| Error::file(path, format!("cannot be read: {e}")))?;
            return Ok(Exif::read(BufReader::new(file)));
        }
        let read = |decoder: &mut dyn ImageDecoder| {
            let bytes = decoder.exif_metadata().ok().flatten().unwrap_or_default();
            Exif::read(Cursor::new(bytes.strip_prefix(b"Exif\0\0").unwrap_or(&bytes)))
        };
        // As for the header, the start of a JPEG suffices.
        if start.starts_with(JPEG)
            && let Ok((mut decoder, _)) = decoder_of(Cursor::new(&start), length, path)
        {
            return Ok(read(&mut decoder));
        }
        Ok(read(&mut decoder(path)?.0))
    }

    /// Reads whether an image file has a colour profile that [`open`](Self::open) cannot read: lookup tables, grey,
    /// CMYK or damage. Its colours then count as sRGB.
    ///
    /// # Errors
    /// If the file cannot be read or is not an image.
    pub fn has_unread_profile(path: impl AsRef<Path>) -> Result<bool> {
        Ok(matches!(Profile::of(&mut decoder(path.as_ref())?.0), Profile::Unread))
    }

    /// Returns the share of fully transparent pixels, 0 to 1.
    pub fn transparent_share(&self) -> f64 {
        let clear = self.pixels().filter(|pixel| pixel[3] == 0.0);
        if self.has_alpha() { clear.count() as f64 / (self.width * self.height).max(1) as f64 } else { 0.0 }
    }

    /// The least and the largest alpha, 0 to 1; 1 without an alpha channel.
    pub(super) fn alpha_range(&self) -> (f32, f32) {
        let alphas = self.pixels().map(|pixel| pixel[3]);
        let range = |(least, most): (f32, f32), alpha: f32| (least.min(alpha), most.max(alpha));
        if self.has_alpha() { alphas.fold((1.0, 0.0), range) } else { (1.0, 1.0) }
    }

    /// The largest value of a 16-bit image whose colours need 12 bits or fewer, unless it is black.
    pub(super) fn unscaled_bits(&self) -> Option<u16> {
        let Values::Words(values) = &self.values else { return None };
        let most = values.chunks_exact(self.channels).flat_map(|pixel| &pixel[..3]).max()?;
        (1..1 << 12).contains(most).then_some(*most)
    }

    /// The share of the one-pixel border that is white, up to JPEG errors: 0 to 1.
    pub(super) fn white_border(&self) -> f64 {
        /// The least value of a white channel.
        const WHITE: f32 = 0.97;
        self.border(|pixel| pixel[..3].iter().all(|value| *value >= WHITE))
    }

    /// Returns true if alpha is transparent inside an opaque border, as if it were inverted. An object that touches the
    /// border may be transparent there too; then most of the middle must be.
    pub(crate) fn is_hollow(&self) -> bool {
        /// The least opaque share of the border, and the least transparent share of the image.
        const WHOLE: [f64; 2] = [0.98, 0.05];
        /// The same where an object touches the border: of the border, and of the middle half of both sides. A cut-out
        /// object that reaches over its edges covers less of the border, or more of the middle.
        const TOUCHED: [f64; 2] = [0.9, 0.4];
        if !self.has_alpha() {
            return false;
        }
        let border = self.border(|pixel| pixel[3] >= OPAQUE);
        let middle = || {
            let [columns, rows] = [self.width, self.height].map(|side| side / 4..side - side / 4);
            let clear = rows.clone().flat_map(|y| columns.clone().map(move |x| (x, y)));
            let clear = clear.filter(|(x, y)| self.pixel(*x, *y)[3] == 0.0).count();
            clear as f64 / (columns.len() * rows.len()).max(1) as f64
        };
        border > WHOLE[0] && self.transparent_share() > WHOLE[1] || border > TOUCHED[0] && middle() > TOUCHED[1]
    }

    /// The share of the pixels of the border that pass a test: 0 to 1.
    fn border(&self, passes: impl Fn([f32; 4]) -> bool) -> f64 {
        let Photo { width, height, .. } = *self;
        let across = (0..width).flat_map(|x| [(x, 0), (x, height - 1)]);
        let down = (1..height.saturating_sub(1)).flat_map(|y| [(0, y), (width - 1, y)]);
        let (count, passed) = across
            .chain(down)
            .fold((0, 0), |(count, passed), (x, y)| (count + 1, passed + u32::from(passes(self.pixel(x, y)))));
        f64::from(passed) / f64::from(count.max(1))
    }

    /// Returns a pixel as RGBA, 0 to 1; alpha is 1 without an alpha channel.
    ///
    /// # Panics
    /// If the pixel lies outside of the image.
    pub fn pixel(&self, x: usize, y: usize) -> [f32; 4] {
        let start = self.channels * pixel_index([self.width, self.height], x, y, "image");
        match &self.values {
            Values::Bytes(values) => rgba(&values[start..start + self.channels]),
            Values::Words(values) => rgba(&values[start..start + self.channels]),
            Values::Floats(values) => rgba(&values[start..start + self.channels]),
        }
    }

    /// Asks for the memory of a pixel ahead of time.
    pub(super) fn prefetch(&self, x: usize, y: usize) {
        let place = (y * self.width + x) * self.channels;
        match &self.values {
            Values::Bytes(values) => simd::prefetch(values.as_ptr().wrapping_add(place)),
            Values::Words(values) => simd::prefetch(values.as_ptr().wrapping_add(place)),
            Values::Floats(values) => simd::prefetch(values.as_ptr().wrapping_add(place)),
        }
    }

    /// Returns all [pixels](Self::pixel), row by row.
    pub fn pixels(&self) -> impl Iterator<Item = [f32; 4]> {
        (0..self.height).flat_map(move |y| (0..self.width).map(move |x| self.pixel(x, y)))
    }

    /// Returns whether there is an alpha channel.
    pub fn has_alpha(&self) -> bool {
        self.channels == 4
    }

    /// Returns the size of the pixels in bytes.
    pub fn bytes(&self) -> usize {
        match &self.values {
            Values::Bytes(values) => values.len(),
            Values::Words(values) => 2 * values.len(),
            Values::Floats(values) => 4 * values.len(),
        }
    }

    /// Converts to floats, 0 to 1.
    pub fn to_image(&self) -> Image {
        let data = match &self.values {
            Values::Bytes(values) => values.iter().map(|x| x.unit()).collect(),
            Values::Words(values) => values.iter().map(|x| x.unit()).collect(),
            Values::Floats(values) => values.clone(),
        };
        Image { width: self.width, height: self.height, channels: self.channels, data }
    }

    /// Composites over a background colour: returns RGB of the same size.
    pub fn over(&self, background: [f32; 3]) -> Image {
        let data = self.pixels().flat_map(|pixel| over(&pixel, background)).collect();
        Image { width: self.width, height: self.height, channels: 3, data }
    }

    /// Downsizes by area averaging, rounded to the integers of the file.
    ///
    /// RGBA colours are weighted by alpha, so colours of transparent pixels do not bleed. Fully transparent areas
    /// become zero.
    ///
    /// # Panics
    /// If a side is 0 or longer than before.
    #[track_caller]
    pub fn resized(&self, [width, height]: [usize; 2]) -> Photo {
        let fits = (1..=self.width).contains(&width) && (1..=self.height).contains(&height);
        assert!(fits, "a {}x{} image cannot be downsized to {width}x{height}", self.width, self.height);
        if [width, height] == [self.width, self.height] {
            return self.clone();
        }
        let from = [self.width, self.height];
        let values = match &self.values {
            Values::Bytes(values) => Values::Bytes(average(values, self.channels, from, [width, height])),
            Values::Words(values) => Values::Words(average(values, self.channels, from, [width, height])),
            Values::Floats(values) => Values::Floats(average(values, self.channels, from, [width, height])),
        };
        Photo { width, height, channels: self.channels, values }
    }

    /// [Downsizes](Self::resized) to a longest side of at most `longest` pixels.
    ///
    /// # Panics
    /// If the image has no pixels.
    #[track_caller]
    pub fn at_most(&self, longest: usize) -> Photo {
        let share = (longest as f64 / self.width.max(self.height) as f64).min(1.0);
        self.resized([self.width, self.height].map(|side| ((side as f64 * share).round() as usize).max(1)))
    }

    /// Converts a dynamic mask of instant-ngp to one of used pixels: black pixels become white, and others black, without
    /// transparency, which instant-ngp ignores.
    pub(super) fn inverted(mut self) -> Photo {
        self.map(|[red, green, blue, _]| {
            let value = f32::from(u8::from([red, green, blue] == [0.0; 3]));
            [value, value, value, 1.0]
        });
        self
    }

    /// Converts a mask to grey values whose brightest is white. Transparent pixels become black. A mask may have one value,
    /// besides black or alone, such as the number or the colour of an object.
    ///
    /// `None` if it has several values or colours, and no white: programs that number objects write 1, 2, 3.
    pub(super) fn into_mask(mut self) -> Option<Photo> {
        let color = |[red, green, blue, alpha]: [f32; 4]| [red, green, blue].map(|value| value * alpha);
        let brightness = |color: [f32; 3]| color.into_iter().fold(0.0, f32::max);
        let all = || self.pixels().map(color);
        let most = all().map(brightness).fold(0.0, f32::max);
        let first = all().find(|color| brightness(*color) > 0.0);
        let is_black = |color: [f32; 3]| brightness(color) == 0.0;
        let is_single = all().all(|color| is_black(color) || Some(color) == first);
        let is_grey = |color: [f32; 3]| color.into_iter().all(|value| brightness(color) - value <= GREY);
        if !is_single && (most < LEAST_WHITE || !all().all(is_grey)) {
            return None;
        }
        self.map(|pixel| match brightness(color(pixel)) {
            0.0 => [0.0, 0.0, 0.0, 1.0],
            value => [value / most, value / most, value / most, 1.0],
        });
        Some(self)
    }

    /// Replaces each pixel, given and returned as RGBA.
    fn map(&mut self, map: impl Fn([f32; 4]) -> [f32; 4]) {
        fn each<S: Stored>(values: &mut [S], channels: usize, map: impl Fn([f32; 4]) -> [f32; 4]) {
            for pixel in values.chunks_exact_mut(channels) {
                let new = map(rgba(pixel));
                pixel.iter_mut().zip(new).for_each(|(value, new)| *value = S::nearest(f64::from(new)));
            }
        }
        match &mut self.values {
            Values::Bytes(values) => each(values, self.channels, map),
            Values::Words(values) => each(values, self.channels, map),
            Values::Floats(values) => each(values, self.channels, map),
        }
    }

    /// Multiplies alpha by the values of a [mask](Self::into_mask) of the same size: its black pixels become transparent.
    pub(super) fn masked(&self, mask: &Photo) -> Photo {
        let alpha = mask.pixels().map(|pixel| pixel[0]);
        let values = match &self.values {
            Values::Bytes(values) => Values::Bytes(with_alpha(values, self.channels, alpha)),
            Values::Words(values) => Values::Words(with_alpha(values, self.channels, alpha)),
            Values::Floats(values) => Values::Floats(with_alpha(values, self.channels, alpha)),
        };
        Photo { width: self.width, height: self.height, channels: 4, values }
    }
}

/// The least value of the brightest pixel of a mask with grey values.
const LEAST_WHITE: f32 = 0.9;
/// The largest difference of the channels of grey, which JPEG colours a little.
const GREY: f32 = 0.1;

/// RGBA of pixels, with their alpha times another.
fn with_alpha<S: Stored>(values: &[S], channels: usize, alpha: impl Iterator<Item = f32>) -> Vec<S> {
    let mut out = Vec::with_capacity(values.len() / channels * 4);
    for (pixel, alpha) in values.chunks_exact(channels).zip(alpha) {
        let own = pixel.get(3).map_or(1.0, |own| own.unit());
        out.extend([pixel[0], pixel[1], pixel[2], S::nearest(f64::from(own * alpha))]);
    }
    out
}

fn rgba<S: Stored>(pixel: &[S]) -> [f32; 4] {
    let alpha = pixel.get(3).map_or(1.0, |alpha| alpha.unit());
    [pixel[0].unit(), pixel[1].unit(), pixel[2].unit(), alpha]
}

impl Image {
    /// Reads an image file as [`Photo::open`] does, into floats.
    ///
    /// # Errors
    /// If the file cannot be read or decoded; the error names it.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        Ok(Photo::open(path, None)?.to_image())
    }
}

#[cfg(test)]
pub(crate) mod tests;
