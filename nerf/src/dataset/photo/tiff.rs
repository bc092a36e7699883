//! The first directory of TIFF files (TIFF 6.0), for what the decoder does not tell.

use std::fs::File;
use std::io::{BufRead, ErrorKind, Read, Result as IoResult, Seek, SeekFrom};
use std::path::Path;

/// Tags of the directory.
const NEW_SUBFILE_TYPE: u16 = 254;
const EXTRA_SAMPLES: u16 = 338;
const SAMPLE_FORMAT: u16 = 339;
const DNG_VERSION: u16 = 50706;

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
    let entries = match entries(reader) {
        // The decoder says it.
        Err(e) if e.kind() == ErrorKind::UnexpectedEof => vec![],
        other => other?,
    };
    reader.rewind()?;
    let value = |tag| entries.iter().find(|entry| entry.0 == tag).map(|entry| entry.1);
    let is_preview = value(NEW_SUBFILE_TYPE).is_some_and(|bits| bits & 1 == 1);
    let what = if is_canon || is_preview || value(DNG_VERSION).is_some() {
        "is a raw image, which raygrad does not develop: export it as JPEG, or as TIFF of 8 or 16 bits"
    } else if value(SAMPLE_FORMAT) == Some(3) {
        FLOATS
    } else if value(EXTRA_SAMPLES) == Some(1) {
        "is TIFF with premultiplied alpha: save it as PNG"
    } else {
        return Ok(None);
    };
    Ok(Some(what.to_owned()))
}

/// A TIFF file in which all is 0 but its start, its end and what is around its directories: the first one, and those of
/// camera and place that this names.
pub(super) fn without_pixels(path: &Path) -> IoResult<Vec<u8>> {
    /// Bytes of each part.
    const PART: usize = 1 << 18;
    /// Tags of entries with the place of a directory.
    const DIRECTORIES: [u16; 2] = [0x8769, 0x8825];
    let mut file = File::open(path)?;
    let length = usize::try_from(file.metadata()?.len()).unwrap_or(usize::MAX).min(1 << 31);
    let entries = entries(&mut file).unwrap_or_default();
    let is_one = |entry: &&(u16, u32)| DIRECTORIES.contains(&entry.0);
    let places = entries.iter().filter(is_one).map(|entry| entry.1 as usize);
    let mut head = [0; 8];
    file.rewind()?;
    file.read_exact(&mut head)?;
    let [order @ .., a, b, c, d] = head;
    let first = if order[0] == b'I' { u32::from_le_bytes([a, b, c, d]) } else { u32::from_be_bytes([a, b, c, d]) };
    let mut bytes = vec![0; length];
    for place in places.chain([first as usize, 0, length]) {
        let start = place.min(length).saturating_sub(PART / 2);
        let part = &mut bytes[start..start.saturating_add(PART).min(length)];
        file.seek(SeekFrom::Start(start as u64))?;
        file.read_exact(part)?;
    }
    Ok(bytes)
}

/// The tag of each entry, and its value if that is a single number of 16 or 32 bits; otherwise 0.
fn entries(reader: &mut (impl Read + Seek)) -> IoResult<Vec<(u16, u32)>> {
    let mut head = [0; 8];
    reader.read_exact(&mut head)?;
    let is_little = head[0] == b'I';
    let short = |bytes: [u8; 2]| if is_little { u16::from_le_bytes(bytes) } else { u16::from_be_bytes(bytes) };
    let long = |bytes: [u8; 4]| if is_little { u32::from_le_bytes(bytes) } else { u32::from_be_bytes(bytes) };
    let [.., a, b, c, d] = head;
    reader.seek(SeekFrom::Start(long([a, b, c, d]).into()))?;
    let mut count = [0; 2];
    reader.read_exact(&mut count)?;
    let entry = |_| {
        let mut entry = [0; 12];
        reader.read_exact(&mut entry)?;
        let [tag @ .., _, _, _, _, _, _, _, _, _, _] = entry;
        let [_, _, kind @ .., _, _, _, _, _, _, _, _] = entry;
        let [_, _, _, _, values @ .., a, b, c, d] = entry;
        let value = match (short(kind), long(values)) {
            (3, 1) => short([a, b]).into(),
            (4, 1) => long([a, b, c, d]),
            _ => 0,
        };
        Ok((short(tag), value))
    };
    (0..short(count)).map(entry).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{Photo, copy_upright};
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
            assert_eq!(Photo::exif_of_file(&path).unwrap(), Some(tiff(is_little, &[])));
            // Directories far from the first one and from both ends.
            let far = 1 << 20;
            let mut long = tiff(is_little, &[(0x8769, 4, far), (0x8825, 4, 2 * far)]);
            long.resize(3 << 20, 7);
            std::fs::write(&path, &long).unwrap();
            let read = Photo::exif_of_file(&path).unwrap().unwrap();
            let far = far as usize;
            for place in [0..1000, far..far + 1000, 2 * far..2 * far + 1000, 3 * far - 1000..3 * far] {
                assert_eq!(read[place.clone()], long[place]);
            }
            assert!(read.len() == long.len() && read[far / 2] == 0, "pixels are not read");
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
