//! TIFF structures (TIFF 6.0): files, for what the decoder does not tell, and EXIF data.

use std::io::{BufRead, Read, Result as IoResult, Seek, SeekFrom};

/// Tags of the first directory.
const NEW_SUBFILE_TYPE: u16 = 254;
const EXTRA_SAMPLES: u16 = 338;
const SAMPLE_FORMAT: u16 = 339;
const DNG_VERSION: u16 = 50706;
/// The most bytes of a value that are read.
pub(super) const LONGEST: usize = 64;

/// Why TIFF files of floats are not decoded, with the fix.
pub(super) const FLOATS: &str =
    "is TIFF of floats, whose white is unknown: save images with 8 or 16 bits, and depths as .npy";

/// Returns true for TIFF files and raw images that begin as such, by their first bytes.
pub(super) fn is_tiff(start: &[u8]) -> bool {
    start.starts_with(b"II*\0") || start.starts_with(b"MM\0*")
}

/// Returns why a [TIFF](is_tiff) file is not decoded, with the fix. The reader is at the start, before and after.
///
/// Raw images are TIFF files whose first image may be a small preview.
pub(super) fn refusal(reader: &mut (impl BufRead + Seek)) -> IoResult<Option<String>> {
    // Canon's raw format has a name and a version before its directory, which follows at once.
    let is_canon = reader.fill_buf()?.get(4..11) == Some(b"\x10\0\0\0CR\x02");
    let mut tiff = Tiff::new(&mut *reader);
    let entries = tiff.as_mut().map_or(vec![], |tiff| tiff.directory(tiff.first));
    let mut value = |tag| tiff.as_mut()?.number(*entries.iter().find(|entry| entry.tag == tag)?);
    let is_preview = value(NEW_SUBFILE_TYPE).is_some_and(|bits| bits & 1 == 1);
    let what = if is_canon || is_preview || value(DNG_VERSION).is_some() {
        Some("is a raw image, which raygrad does not develop: export it as JPEG, or as TIFF of 8 or 16 bits")
    } else if value(SAMPLE_FORMAT) == Some(3) {
        Some(FLOATS)
    } else if value(EXTRA_SAMPLES) == Some(1) {
        Some("is TIFF with premultiplied alpha: save it as PNG")
    } else {
        None
    };
    reader.rewind()?;
    Ok(what.map(str::to_owned))
}

/// A TIFF structure. What is absent, damaged or cannot be read is left out.
pub(super) struct Tiff<R> {
    reader: R,
    is_little: bool,
    /// The place of the first directory.
    pub first: u64,
}

/// An entry of a directory.
#[derive(Clone, Copy)]
pub(super) struct Entry {
    pub tag: u16,
    kind: u16,
    count: u32,
    /// Its values, or their place.
    field: [u8; 4],
}

impl<R: Read + Seek> Tiff<R> {
    /// Reads the head.
    pub fn new(reader: R) -> Option<Self> {
        let mut tiff = Tiff { reader, is_little: true, first: 0 };
        let head = tiff.bytes(0, 8);
        tiff.is_little = head.starts_with(b"II");
        tiff.first = tiff.long(head.get(4..8)?)?.into();
        is_tiff(&head).then_some(tiff)
    }

    /// So many bytes from a place, or fewer.
    fn bytes(&mut self, at: u64, count: usize) -> Vec<u8> {
        let mut bytes = vec![];
        // What was read before an error counts.
        let _ = self.reader.seek(SeekFrom::Start(at)).map(|_| {
            let _ = self.reader.by_ref().take(count as u64).read_to_end(&mut bytes);
        });
        bytes
    }

    fn short(&self, bytes: &[u8]) -> Option<u16> {
        let bytes = bytes.first_chunk().copied()?;
        Some(if self.is_little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) })
    }

    fn long(&self, bytes: &[u8]) -> Option<u32> {
        let bytes = bytes.first_chunk().copied()?;
        Some(if self.is_little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) })
    }

    /// The entries of the directory at a place.
    pub fn directory(&mut self, at: u64) -> Vec<Entry> {
        let count = self.bytes(at, 2);
        let bytes = self.bytes(at.saturating_add(2), 12 * usize::from(self.short(&count).unwrap_or(0)));
        let entry = |bytes: &[u8]| {
            let (tag, kind, count) = (self.short(bytes)?, self.short(&bytes[2..])?, self.long(&bytes[4..])?);
            Some(Entry { tag, kind, count, field: bytes[8..].first_chunk().copied()? })
        };
        bytes.chunks_exact(12).filter_map(entry).collect()
    }

    /// The bytes of an entry's values, which have this `size`, if they are of this `kind`; at most [`LONGEST`].
    fn values(&mut self, entry: Entry, kind: u16, size: usize) -> Vec<u8> {
        if entry.kind != kind {
            return vec![];
        }
        // Values of up to four bytes are in the entry itself.
        match (entry.count as usize).saturating_mul(size) {
            length @ 0..=4 => entry.field[..length].to_vec(),
            length => self.long(&entry.field).map_or(vec![], |at| self.bytes(at.into(), length.min(LONGEST))),
        }
    }

    /// The first number of 16 or 32 bits.
    pub fn number(&mut self, entry: Entry) -> Option<u32> {
        let (short, long) = (self.values(entry, 3, 2), self.values(entry, 4, 4));
        self.short(&short).map(u32::from).or_else(|| self.long(&long))
    }

    /// The ratio number `i`, if it is finite.
    pub fn ratio(&mut self, entry: Entry, i: usize) -> Option<f64> {
        let bytes = self.values(entry, 5, 8);
        let parts = bytes.chunks_exact(8).nth(i)?;
        let ratio = f64::from(self.long(parts)?) / f64::from(self.long(&parts[4..])?);
        ratio.is_finite().then_some(ratio)
    }

    /// A text up to its first zero.
    pub fn text(&mut self, entry: Entry) -> Option<String> {
        let bytes = self.values(entry, 2, 1);
        let text = bytes.split(|byte| *byte == 0).next().unwrap_or_default();
        (entry.kind == 2).then(|| String::from_utf8_lossy(text).trim().to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{Exif, Photo, copy_upright};
    use image::{DynamicImage, Rgb32FImage};

    /// A grey image of 3 x 2 pixels, 0 and 10 to 50, with more entries: tag, type and value.
    fn tiff(is_little: bool, more: &[(u16, u16, u32)]) -> Vec<u8> {
        let short = |value: u16| if is_little { value.to_le_bytes() } else { value.to_be_bytes() };
        let long = |value: u32| if is_little { value.to_le_bytes() } else { value.to_be_bytes() };
        // Width, height, bits of a sample, compression, colours, place, samples and bytes of the pixels.
        let all =
            [(256, 3, 3), (257, 3, 2), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 8), (277, 3, 1), (279, 4, 6)];
        let mut entries = [&all[..], more].concat();
        entries.sort_by_key(|entry| entry.0);
        let mut out = [if is_little { *b"II" } else { *b"MM" }, short(42)].concat();
        out.extend([long(16), long(u32::from_be_bytes([0, 10, 20, 30])), [40, 50, 0, 0]].concat());
        // The place of the pixels is 8 in files of both byte orders; their bytes are not swapped.
        out[8..14].copy_from_slice(&[0, 10, 20, 30, 40, 50]);
        out.extend(short(entries.len() as u16));
        for (tag, kind, value) in entries {
            let field = if kind == 3 { [short(value as u16), [0; 2]].concat() } else { long(value).to_vec() };
            out.extend([&short(tag)[..], &short(kind), &long(1), &field].concat());
        }
        out.extend([0; 4]);
        out
    }

    #[test]
    fn tiff_is_decoded_and_raw_images_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let [path, copy] = ["0.jpg", "1.tif"].map(|name| folder.path().join(name));
        for is_little in [false, true] {
            let of = |more: &[(u16, u16, u32)]| {
                std::fs::write(&path, tiff(is_little, more)).unwrap();
                Photo::open(&path, None)
            };
            let photo = of(&[]).unwrap();
            assert_eq!([photo.width, photo.height, photo.channels], [3, 2, 3]);
            let red: Vec<f32> = photo.pixels().map(|pixel| (255.0 * pixel[0]).round()).collect();
            assert_eq!(red, [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]);
            assert_eq!(Photo::exif_of_file(&path).unwrap(), Exif::default());
            // A directory far from the first one, and an image that ends before another.
            let far = 1 << 20;
            let mut long = tiff(is_little, &[(0x8769, 4, far), (0x8825, 4, 3 << 20)]);
            long.resize(2 << 20, 7);
            let directory = if is_little {
                b"\x01\0\x05\xa4\x03\0\x01\0\0\0\x1c\0\0\0"
            } else {
                b"\0\x01\xa4\x05\0\x03\0\0\0\x01\0\x1c\0\0"
            };
            long[far as usize..][..14].copy_from_slice(directory);
            std::fs::write(&path, &long).unwrap();
            let read = Photo::exif_of_file(&path).unwrap();
            assert_eq!((read.lens.unwrap().focal_35mm, read.place), (28, None));
            // A full image, an orientation of 90 degrees, and straight alpha that no pixel has.
            let turned = of(&[(254, 4, 2), (274, 3, 6)]).unwrap();
            assert_eq!([turned.width, turned.height], [2, 3]);
            assert_eq!((turned.pixel(0, 0)[0] * 255.0).round(), 30.0);
            copy_upright(&path, &copy).unwrap();
            assert_eq!(Photo::open(&copy, Some([2, 3])).unwrap(), turned);
            for (entry, expected) in [
                ((254, 4, 1), "0.jpg: is a raw image, which raygrad does not develop"),
                ((254, 3, 5), "0.jpg: is a raw image"),
                ((50706, 4, 0x0104_0000), "0.jpg: is a raw image"),
                ((339, 3, 3), "0.jpg: is TIFF of floats, whose white is unknown"),
                ((338, 3, 1), "0.jpg: is TIFF with premultiplied alpha: save it as PNG"),
            ] {
                let message = of(&[entry]).unwrap_err().to_string();
                assert!(message.contains(expected), "{message}");
            }
        }
        let mut canon = tiff(true, &[]);
        canon.splice(8..12, *b"CR\x02\0");
        // The same bytes as pixels of a file whose directory is at its end.
        let mut pixels = canon.clone();
        pixels.splice(4..8, [18, 0, 0, 0]);
        pixels.splice(16..16, [0, 0]);
        assert_eq!(refusal(&mut std::io::Cursor::new(pixels)).unwrap(), None);
        assert!(refusal(&mut std::io::Cursor::new(canon)).unwrap().unwrap().contains("raw image"));
        for cut in [8, 17, 30] {
            assert_eq!(refusal(&mut std::io::Cursor::new(&tiff(true, &[])[..cut])).unwrap(), None, "{cut}");
        }
        DynamicImage::from(Rgb32FImage::new(2, 2)).save_with_format(&path, image::ImageFormat::Tiff).unwrap();
        let message = Photo::open(&path, None).unwrap_err().to_string();
        assert!(message.contains("0.jpg: is TIFF of floats"), "{message}");
    }
}
