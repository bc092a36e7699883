//! Headers and decoders of image files, within the free memory.

use super::start::start_of;
use super::{tiff, unsupported};
use crate::error::{Error, Result};
use crate::memory::{available_memory, gigabytes};
use image::metadata::Orientation;
use image::{ColorType, ImageDecoder, ImageFormat, ImageReader};
use std::fs::File;
use std::io::{BufRead, BufReader, Cursor, Read, Seek, SeekFrom};
use std::path::Path;

/// The header of an image file.
pub(in super::super) struct Header {
    /// Width and height as stored, and after the EXIF orientation.
    pub sizes: [[usize; 2]; 2],
    /// Values per pixel of the photo.
    pub channels: u64,
    /// Bytes of a pixel of the photo.
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
pub(super) const JPEG: &[u8] = b"\xff\xd8\xff";

/// Returns true for a progressive JPEG, by the marker of its frame: its decoder holds all coefficients.
pub(super) fn is_progressive(start: &[u8]) -> bool {
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
pub(super) fn decoder_within_memory(path: &Path) -> Result<(impl ImageDecoder, [usize; 2])> {
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
pub(super) fn decoder(path: &Path) -> Result<(impl ImageDecoder, [usize; 2])> {
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
pub(in super::super) fn decoder_of<'a, R: BufRead + Seek + 'a>(
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
pub(super) fn is_cut_jpeg(path: &Path) -> Result<bool> {
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
