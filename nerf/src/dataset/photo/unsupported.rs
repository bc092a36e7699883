//! Image formats that are recognised but not decoded.

use super::{start::start_of, tiff};
use crate::error::Result;
use std::io::{BufRead, Cursor, Read, Result as IoResult, Seek, SeekFrom};
use std::path::Path;

/// The brands of still images in ISO base media files: HEIC, other HEIF and AVIF.
const BRANDS: [&[u8; 4]; 12] =
    [b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"mif2", b"mif3", b"msf1", b"avif", b"avis"];
/// The first bytes of an EXR file.
pub(in crate::dataset) const EXR: &[u8] = b"\x76\x2f\x31\x01";
/// The transfer curves of high dynamic range in `cICP` (ITU-T H.273): perceptual quantisation and hybrid log-gamma.
const HDR: [(u8, &str); 2] = [(16, "PQ"), (18, "HLG")];
/// The first bytes of a PNG file.
const PNG: &[u8] = b"\x89PNG\r\n\x1a\n";

/// A format of images that raygrad does not decode: `raygrad prepare` has other programs convert them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ForeignFormat {
    /// HEIC, other HEIF and AVIF.
    Heif,
    /// EXR: linear light, whose white is 1.
    Exr,
    /// PNG of high dynamic range, by its codes of ITU-T H.273.
    Png {
        /// Such as 1 for BT.709, 9 for BT.2020 and 12 for Display P3.
        primaries: u8,
        /// 16 for perceptual quantisation, 18 for hybrid log-gamma.
        transfer: u8,
    },
}

/// An image in a format that raygrad does not decode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ForeignImage {
    /// Its format.
    pub format: ForeignFormat,
    /// Width and height in pixels before rotations; 0 if the start of the file does not state them.
    pub size: [u64; 2],
}

impl ForeignImage {
    /// Recognises an image by its content; `None` for other files.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn find(path: impl AsRef<Path>) -> Result<Option<Self>> {
        let (start, _) = start_of(path.as_ref())?;
        let number = |bytes: &[u8]| bytes.iter().fold(0, |number, byte| number << 8 | u64::from(*byte));
        if is_heif(&start) {
            // The property `ispe`: a name, a version with flags, width and height. Tiles and previews are smaller.
            let sizes = start.windows(16).filter(|window| window.starts_with(b"ispe\0\0\0\0"));
            let sizes = sizes.map(|window| [number(&window[8..12]), number(&window[12..])]);
            let size = sizes.max_by_key(|[width, height]| width * height).unwrap_or_default();
            return Ok(Some(ForeignImage { format: ForeignFormat::Heif, size }));
        }
        if start.starts_with(EXR) {
            // The attribute `dataWindow`: its name, type and length, and the first and last column and row.
            const WINDOW: &[u8] = b"dataWindow\0box2i\0\x10\0\0\0";
            let at = start.windows(WINDOW.len()).position(|window| window == WINDOW).map(|at| at + WINDOW.len());
            let place = |i: usize| {
                let bytes = start.get(at? + 4 * i..at? + 4 * i + 4)?;
                Some(i64::from(i32::from_le_bytes(bytes.try_into().ok()?)))
            };
            let side = |axis| Some(u64::try_from(place(axis + 2)? - place(axis)? + 1).unwrap_or(0));
            return Ok(Some(ForeignImage {
                format: ForeignFormat::Exr,
                size: [0, 1].map(|axis| side(axis).unwrap_or(0)),
            }));
        }
        let is_png = start.starts_with(PNG);
        let codes = if is_png { codes_of_png(&mut Cursor::new(&start)).ok().flatten() } else { None };
        let codes = codes.filter(|codes| HDR.iter().any(|(code, _)| *code == codes[1]));
        let format = codes.map(|[primaries, transfer]| ForeignFormat::Png { primaries, transfer });
        // The chunk `IHDR` is first.
        let side = |at: usize| start.get(at..at + 4).map_or(0, number);
        Ok(format.map(|format| ForeignImage { format, size: [side(16), side(20)] }))
    }
}

/// Returns true for HEIC, HEIF and AVIF, by the first bytes of a file: the box `ftyp` with the main brand, a version
/// and compatible brands.
fn is_heif(start: &[u8]) -> bool {
    let Some((length, rest)) = start.split_first_chunk() else { return false };
    let end = (u32::from_be_bytes(*length) as usize).min(start.len());
    let brands = start.get(8..end).unwrap_or_default().chunks_exact(4);
    rest.starts_with(b"ftyp") && brands.into_iter().any(|brand| BRANDS.iter().any(|known| *known == brand))
}

/// Returns why a file cannot be decoded, with the fix, if it has a known format that is not supported. The reader is at
/// the start, before and after.
pub(super) fn refusal(reader: &mut (impl BufRead + Seek)) -> IoResult<Option<String>> {
    let start = reader.fill_buf()?;
    for (is_so, what) in [
        (start.is_empty(), "is empty: copy it again"),
        (start.starts_with(b"version https://git-lfs"), "is a pointer of Git LFS: run `git lfs pull`"),
        (start.trim_ascii_start().starts_with(b"<"), "is a page of HTML or XML, not an image: download it again"),
    ] {
        if is_so {
            return Ok(Some(what.to_owned()));
        }
    }
    if is_heif(start) {
        let what = "is HEIC or AVIF, which `raygrad prepare` converts: in a capture with poses, convert it with \
                    `heif-convert 0.heic 0.jpg` and name the JPEG";
        return Ok(Some(what.to_owned()));
    }
    if start.starts_with(EXR) {
        let what = "is EXR, which `raygrad prepare` converts: in a capture with poses, convert it with `ffmpeg -apply_trc \
                    iec61966_2_1 -i 0.exr 0.png`, which clips values above 1, and name the PNG";
        return Ok(Some(what.to_owned()));
    }
    if tiff::is_tiff(start) {
        return tiff::refusal(reader);
    }
    if !start.starts_with(PNG) {
        return Ok(None);
    }
    let codes = codes_of_png(reader);
    reader.rewind()?;
    let Some([_, transfer]) = codes? else { return Ok(None) };
    let curve = HDR.iter().find(|(code, _)| *code == transfer);
    Ok(curve.map(|(_, curve)| {
        format!(
            "is HDR ({curve}), which `raygrad prepare` converts: in a capture with poses, convert it to sRGB, such as by \
             the filter `tonemap` of ffmpeg"
        )
    }))
}

/// The codes of the primaries and the transfer curve of a PNG file in its chunk `cICP`, which is before the pixels.
fn codes_of_png(reader: &mut (impl Read + Seek)) -> IoResult<Option<[u8; 2]>> {
    reader.seek(SeekFrom::Start(8))?;
    let mut head = [0; 8];
    loop {
        // The length of the data, and a name; then the data and a checksum.
        match reader.read_exact(&mut head) {
            Err(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => return Ok(None),
            other => other?,
        }
        let [length @ .., _, _, _, _] = head;
        match &head[4..] {
            b"IDAT" => return Ok(None),
            b"cICP" => {
                let mut codes = [0; 2];
                return Ok(reader.read_exact(&mut codes).ok().map(|()| codes));
            }
            _ => reader.seek_relative(i64::from(u32::from_be_bytes(length)) + 4)?,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::Photo;
    use image::codecs::png::PngEncoder;
    use image::{ImageEncoder, RgbImage};

    #[test]
    fn foreign_images_are_recognised_by_content() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("0.jpg");
        let of = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            ForeignImage::find(&path).unwrap()
        };
        let size =
            |[width, height]: [u32; 2]| [b"ispe\0\0\0\0", &width.to_be_bytes()[..], &height.to_be_bytes()].concat();
        let heic =
            [b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", &size([512, 512])[..], &size([4032, 3024]), &size([320, 240])]
                .concat();
        let some = |format, size| Some(ForeignImage { format, size });
        assert_eq!(of(&heic), some(ForeignFormat::Heif, [4032, 3024]));
        let compatible = b"\0\0\0\x18ftypABCD\0\0\0\0MiHEavif";
        assert_eq!(of(compatible), some(ForeignFormat::Heif, [0, 0]), "a compatible brand");
        let window: Vec<u8> = [-2_i32, 5, 17, 24].into_iter().flat_map(i32::to_le_bytes).collect();
        let exr = [EXR, b"\x02\0\0\0dataWindow\0box2i\0\x10\0\0\0", &window].concat();
        assert_eq!(of(&exr), some(ForeignFormat::Exr, [20, 20]));
        assert_eq!(of(&exr[..30]), some(ForeignFormat::Exr, [0, 0]));
        for other in [
            &b"\0\0\0\x14ftypisom\0\0\0\0mp41heic"[..],
            b"\0\0\0\x18moovheic\0\0\0\0mif1heic",
            b"\0\0\0\x18ftyp",
            b"\xff\xd8\xff\xe0",
            b"\0\0",
            b"",
        ] {
            assert_eq!(of(other), None, "{other:?}");
        }
        of(&heic);
        for error in [Photo::open(&path, None).err(), Photo::size_of_file(&path).err()] {
            let message = error.unwrap().to_string();
            assert!(message.contains("0.jpg: is HEIC or AVIF") && message.contains("raygrad prepare"), "{message}");
        }
    }

    #[test]
    fn what_is_no_image_is_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("0.jpg");
        for (bytes, expected) in [
            (&b""[..], "is empty: copy it again"),
            (b"version https://git-lfs.github.com/spec/v1\noid", "is a pointer of Git LFS: run `git lfs pull`"),
            (b"\n<!DOCTYPE html><html>", "is a page of HTML or XML, not an image: download it again"),
            (b"II*\0\x08\0\0\0", "cannot be decoded: failed to fill whole buffer"),
            (b"GIF89a\x08\0\0\0", "is no PNG, JPEG, WebP, TIFF or BMP file: convert it"),
        ] {
            std::fs::write(&path, bytes).unwrap();
            for message in [Photo::open(&path, None).err(), Photo::size_of_file(&path).err()] {
                let message = message.unwrap().to_string();
                assert!(message.contains("0.jpg: ") && message.contains(expected), "{message}");
            }
        }
    }

    #[test]
    fn images_of_high_range_name_their_conversion() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("0.png");
        let error = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            Photo::open(&path, None).map_err(|error| error.to_string())
        };
        let message = error(b"\x76\x2f\x31\x01\x02\0\0\0").unwrap_err();
        assert!(message.contains("0.png: is EXR") && message.contains("-apply_trc iec61966_2_1"), "{message}");
        let mut plain = vec![];
        // A profile before the chunk that is longer than a buffer.
        let mut encoder = PngEncoder::new(&mut plain);
        encoder
            .set_icc_profile(
                (0..40_000_u32).map(|i| (i.wrapping_mul(i).wrapping_mul(2_654_435_761) >> 13) as u8).collect(),
            )
            .unwrap();
        encoder.write_image(&RgbImage::new(4, 4), 4, 4, image::ExtendedColorType::Rgb8).unwrap();
        let pixels = plain.windows(4).position(|name| name == b"IDAT").unwrap() - 4;
        assert!(pixels > 20_000);
        let with = |transfer: u8| {
            let data = [b"cICP", &[9, transfer, 0, 1][..]].concat();
            let chunk = [&[0, 0, 0, 4], &data[..], &crc32(&data).to_be_bytes()].concat();
            [&plain[..pixels], &chunk, &plain[pixels..]].concat()
        };
        for (transfer, curve) in [(16, "PQ"), (18, "HLG")] {
            let message = error(&with(transfer)).unwrap_err();
            assert!(message.contains(&format!("0.png: is HDR ({curve})")) && message.contains("tonemap"), "{message}");
            let message = Photo::size_of_file(&path).unwrap_err().to_string();
            assert!(message.contains("is HDR"), "{message}");
            let image = ForeignImage { format: ForeignFormat::Png { primaries: 9, transfer }, size: [4, 4] };
            assert_eq!(ForeignImage::find(&path).unwrap(), Some(image));
        }
        for bytes in [with(13), plain.clone()] {
            assert!(error(&bytes).is_ok());
            assert_eq!(ForeignImage::find(&path).unwrap(), None);
        }
    }

    fn crc32(data: &[u8]) -> u32 {
        !data.iter().fold(!0_u32, |sum, byte| {
            (0..8).fold(sum ^ u32::from(*byte), |sum, _| if sum & 1 == 1 { 0xedb8_8320 ^ (sum >> 1) } else { sum >> 1 })
        })
    }
}
