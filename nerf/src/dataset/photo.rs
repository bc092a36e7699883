//! Images in memory with the integers of their files.

use super::average::{Stored, average};
use super::background::over;
use super::image::{Image, pixel_index};
use crate::error::{Error, Result};
use crate::memory::{available_memory, gigabytes};
use image::metadata::Orientation;
use image::{ColorType, DynamicImage, ImageDecoder, ImageFormat, ImageReader};
use raygrad_tensor::simd;
use std::fs::File;
use std::hash::{Hash, Hasher};
use std::io::{BufRead, BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::Path;

use profile::Profile;
use start::start_of;

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

    /// Reads the EXIF data of an image file, a TIFF structure, if it has any. A TIFF file is one itself: most of its
    /// pixels are then 0.
    ///
    /// # Errors
    /// If the file cannot be read or is not an image.
    pub fn exif_of_file(path: impl AsRef<Path>) -> Result<Option<Vec<u8>>> {
        let path = path.as_ref();
        let (start, length) = start_of(path)?;
        if tiff::is_tiff(&start) {
            return tiff::without_pixels(path).map(Some).map_err(|e| Error::file(path, format!("cannot be read: {e}")));
        }
        // As for the header, the start of a JPEG suffices.
        if start.starts_with(JPEG)
            && let Ok((mut decoder, _)) = decoder_of(Cursor::new(&start), length, path)
        {
            return Ok(decoder.exif_metadata().ok().flatten());
        }
        Ok(decoder(path)?.0.exif_metadata().ok().flatten())
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

    /// Converts a dynamic mask of instant-ngp to one of used pixels: black pixels become white, and others black.
    pub(super) fn inverted(mut self) -> Photo {
        match &mut self.values {
            Values::Bytes(values) => invert(values, self.channels),
            Values::Words(values) => invert(values, self.channels),
            Values::Floats(values) => invert(values, self.channels),
        }
        self
    }

    /// Converts a mask to grey values whose brightest is white. Transparent pixels become black. A mask may have one value
    /// besides black, such as the number or the colour of an object.
    ///
    /// `None` if it has several values or colours, and no white: programs that number objects write 1, 2, 3.
    pub(super) fn into_mask(mut self) -> Option<Photo> {
        let is_clear = match &mut self.values {
            Values::Bytes(values) => whiten(values, self.channels),
            Values::Words(values) => whiten(values, self.channels),
            Values::Floats(values) => whiten(values, self.channels),
        };
        is_clear.then_some(self)
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

/// Makes black pixels white and others black, without transparency: instant-ngp ignores that of its masks.
fn invert<S: Stored>(values: &mut [S], channels: usize) {
    for pixel in values.chunks_exact_mut(channels) {
        let is_used = pixel[..3].iter().all(|value| value.unit() == 0.0);
        pixel.fill(S::nearest(f64::from(u8::from(is_used))));
        pixel[3..].fill(S::nearest(1.0));
    }
}

/// The least value of the brightest pixel of a mask with grey values.
const LEAST_WHITE: f32 = 0.9;
/// The largest difference of the channels of grey, which JPEG colours a little.
const GREY: f32 = 0.1;

/// Makes all pixels grey and opaque, and the brightest white; returns false where [`Photo::into_mask`] has no answer.
fn whiten<S: Stored>(values: &mut [S], channels: usize) -> bool {
    let color = |pixel: &[S]| {
        let [red, green, blue, alpha] = rgba(pixel);
        [red, green, blue].map(|value| value * alpha)
    };
    let brightness = |color: [f32; 3]| color.into_iter().fold(0.0, f32::max);
    let all = || values.chunks_exact(channels).map(color);
    let most = all().map(brightness).fold(0.0, f32::max);
    let first = all().find(|color| brightness(*color) > 0.0);
    let is_black = |color: [f32; 3]| brightness(color) == 0.0;
    let is_single = all().any(is_black) && all().all(|color| is_black(color) || Some(color) == first);
    let is_grey = |color: [f32; 3]| color.into_iter().all(|value| brightness(color) - value <= GREY);
    if !is_single && (most < LEAST_WHITE || !all().all(is_grey)) {
        return false;
    }
    for pixel in values.chunks_exact_mut(channels) {
        let value = brightness(color(pixel));
        pixel.fill(S::nearest(f64::from(if value == 0.0 { 0.0 } else { value / most })));
        pixel[3..].fill(S::nearest(1.0));
    }
    true
}

/// RGBA of pixels, with their alpha times another.
fn with_alpha<S: Stored>(values: &[S], channels: usize, alpha: impl Iterator<Item = f32>) -> Vec<S> {
    let mut out = Vec::with_capacity(values.len() / channels * 4);
    for (pixel, alpha) in values.chunks_exact(channels).zip(alpha) {
        let own = pixel.get(3).map_or(1.0, |own| own.unit());
        out.extend([pixel[0], pixel[1], pixel[2], S::nearest(f64::from(own * alpha))]);
    }
    out
}

/// The header of an image file.
pub(super) struct Header {
    /// Width and height as stored, and after the EXIF orientation.
    pub sizes: [[usize; 2]; 2],
    /// Values per pixel of the [`Photo`].
    pub channels: u64,
    /// Bytes of a pixel of the [`Photo`].
    pub pixel: u64,
    /// The most bytes of memory while it is decoded.
    pub decoding: u64,
}

impl Header {
    pub fn read(path: &Path) -> Result<Self> {
        let (start, length) = start_of(path)?;
        // The decoder of JPEG reads its input to the end; the header is at its start.
        if start.starts_with(JPEG)
            && let Ok((mut decoder, stored)) = decoder_of(Cursor::new(&start), length, path)
        {
            return Ok(Self::of(&mut decoder, stored, &start, length));
        }
        let (mut decoder, stored) = decoder(path)?;
        Ok(Self::of(&mut decoder, stored, &start, length))
    }

    fn of(decoder: &mut impl ImageDecoder, stored: [usize; 2], start: &[u8], length: u64) -> Self {
        let turn = decoder.orientation().unwrap_or(Orientation::NoTransforms);
        let (color, pixels) = (decoder.color_type(), (stored[0] * stored[1]) as u64);
        let channels = if color.has_alpha() { 4 } else { 3 };
        let pixel = channels * if color.bytes_per_pixel() == color.channel_count() { 1 } else { 2 };
        let decoded = decoder.total_bytes();
        // A copy in other channels, and one that is turned; both formats hold pixels as the photo does if they agree.
        let converted = if u64::from(color.bytes_per_pixel()) == pixel { 0 } else { pixel * pixels };
        let turned = if turn == Orientation::NoTransforms { 0 } else { decoded };
        // What decoders hold beside: the file, and coefficients or planes.
        let inner = match start {
            start if is_progressive(start) => length + 2 * channels * pixels,
            start if start.starts_with(JPEG) => length,
            [b'R', b'I', b'F', b'F', ..] => length + 4 * pixels,
            // All pixels; those of CMYK have four values for three.
            start if tiff::is_tiff(start) => decoded + decoded / 3,
            _ => 0,
        };
        let decoding = decoded + converted.max(turned).max(inner);
        Header { sizes: [stored, turned_size(stored, turn)], channels, pixel, decoding }
    }
}

/// The first bytes of a JPEG file.
const JPEG: &[u8] = b"\xff\xd8\xff";
/// Returns true for a progressive JPEG, by the marker of its frame: its decoder holds all coefficients.
fn is_progressive(start: &[u8]) -> bool {
    if !start.starts_with(JPEG) {
        return false;
    }
    let mut at = 2;
    while let Some(&[0xff, marker, high, low]) = start.get(at..at + 4) {
        match marker {
            // Frames with progressive coding.
            0xc2 | 0xc6 | 0xca | 0xce => return true,
            // Other frames, and the start of the pixels.
            0xc0 | 0xc1 | 0xda => return false,
            _ => at += 2 + usize::from(u16::from_be_bytes([high, low])),
        }
    }
    false
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

/// The size of an image after an orientation.
fn turned_size([width, height]: [usize; 2], turn: Orientation) -> [usize; 2] {
    match turn {
        Orientation::Rotate90 | Orientation::Rotate270 | Orientation::Rotate90FlipH | Orientation::Rotate270FlipH => {
            [height, width]
        }
        _ => [width, height],
    }
}

/// Images whose decoding takes at most this many bytes are decoded whatever memory is free.
const LARGE: u64 = 1 << 26;
/// More pixels than any camera has. A file that claims more is damaged, and decoding it would exhaust memory.
const MOST_PIXELS: usize = 1 << 28;
/// The most decoded bytes: so many per byte of the file, plus a constant. PNG files of one colour with one bit per
/// pixel reach half of the former; damaged headers can claim any size.
const MOST_BYTES: [u64; 2] = [1 << 14, 1 << 26];

/// The formats that are decoded.
const FORMATS: [ImageFormat; 5] =
    [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::WebP, ImageFormat::Tiff, ImageFormat::Bmp];
/// The most bytes of a file.
const LONGEST: u64 = 1 << 31;

/// [`decoder`], if decoding needs no more memory than is free.
fn decoder_within_memory(path: &Path) -> Result<(impl ImageDecoder, [usize; 2])> {
    let need = Header::read(path)?.decoding;
    match available_memory() {
        Some(free) if need > LARGE && need > free => {
            let [need, free] = [need, free].map(gigabytes);
            let what = format!("needs {need} of memory to be decoded, but {free} are free: make the image smaller");
            Err(Error::file(path, what))
        }
        _ => decoder(path),
    }
}

/// The decoder of a file, and the stored size of its pixels.
fn decoder(path: &Path) -> Result<(impl ImageDecoder, [usize; 2])> {
    let bad = |e: std::io::Error| Error::file(path, format!("cannot be read: {e}"));
    let file = File::open(path).map_err(bad)?;
    let length = file.metadata().map_err(bad)?.len();
    if length > LONGEST {
        let [own, limit] = [length, LONGEST].map(gigabytes);
        return Err(Error::file(path, format!("has {own}; the limit for an image is {limit}")));
    }
    decoder_of(BufReader::new(file), length, path)
}

/// [`decoder`] for the contents of a file of `length` bytes.
pub(super) fn decoder_of<'a, R: BufRead + Seek + 'a>(
    mut reader: R,
    length: u64,
    path: &Path,
) -> Result<(impl ImageDecoder + use<'a, R>, [usize; 2])> {
    let bad = |what: String| Error::file(path, format!("cannot be decoded: {what}"));
    let unread = |e| Error::file(path, format!("cannot be read: {e}"));
    if let Some(what) = unsupported::refusal(&mut reader).map_err(unread)? {
        return Err(Error::file(path, what));
    }
    let mut reader = ImageReader::new(reader).with_guessed_format().map_err(unread)?;
    if !reader.format().is_some_and(|format| FORMATS.contains(&format)) {
        return Err(bad("it is no PNG, JPEG, WebP, TIFF or BMP file: convert it".into()));
    }
    if reader.format() == Some(ImageFormat::WebP) {
        let mut inner = reader.into_inner();
        if !chunks_fit(&mut inner, length).map_err(unread)? {
            return Err(bad("it ends within its last chunk: copy it again".into()));
        }
        reader = ImageReader::with_format(inner, ImageFormat::WebP);
    }
    let decoder = reader.into_decoder().map_err(|e| bad(e.to_string()))?;
    let (width, height) = decoder.dimensions();
    let size = [width as usize, height as usize];
    if size[0].saturating_mul(size[1]) > MOST_PIXELS {
        return Err(bad(format!("{width}x{height} pixels are more than the limit of 2^28")));
    }
    if matches!(decoder.color_type(), ColorType::Rgb32F | ColorType::Rgba32F) {
        return Err(Error::file(path, tiff::FLOATS));
    }
    if decoder.total_bytes() > MOST_BYTES[0].saturating_mul(length).saturating_add(MOST_BYTES[1]) {
        return Err(bad(format!("{width}x{height} pixels cannot come from {length} bytes: copy it again")));
    }
    Ok((decoder, size))
}

/// Returns true for a JPEG file without the marker that ends its pixels: decoders invent what is missing.
fn is_cut_jpeg(path: &Path) -> Result<bool> {
    let (start, _) = start_of(path)?;
    if !start.starts_with(JPEG) {
        return Ok(false);
    }
    let bytes = std::fs::read(path).map_err(|e| Error::file(path, format!("cannot be read: {e}")))?;
    let mut at = 2;
    // Segments start with a marker and their length. Pixels between them have no markers but those of restarts.
    let is_marker = |pair: &[u8]| pair[0] == 0xff && !matches!(pair[1], 0 | 1 | 0xff | 0xd0..=0xd8);
    while let Some(found) = bytes.get(at..).and_then(|rest| rest.windows(2).position(is_marker)) {
        at += found + 2;
        match bytes.get(at..at + 2) {
            _ if bytes[at - 1] == 0xd9 => return Ok(false),
            Some(&[high, low]) => at += usize::from(u16::from_be_bytes([high, low])),
            _ => break,
        }
    }
    Ok(true)
}

/// Returns true if the chunks of a WebP file fit into `length` bytes: the decoder allocates as much memory as a chunk's
/// header claims. The reader is at the start, before and after.
fn chunks_fit(reader: &mut (impl Read + Seek), length: u64) -> std::io::Result<bool> {
    // `RIFF`, the length of the rest and `WEBP`; then chunks with a name and a length.
    let mut size = [0; 4];
    reader.seek(SeekFrom::Start(4))?;
    reader.read_exact(&mut size)?;
    let end = length.min(8 + u64::from(u32::from_le_bytes(size)));
    let mut at = 12;
    while at + 8 <= end {
        reader.seek(SeekFrom::Start(at + 4))?;
        reader.read_exact(&mut size)?;
        at += 8 + u64::from(u32::from_le_bytes(size)).next_multiple_of(2);
    }
    reader.rewind()?;
    // A last chunk of odd length may lack its padding byte.
    Ok(at <= length + 1)
}

#[cfg(test)]
pub(crate) mod tests;
