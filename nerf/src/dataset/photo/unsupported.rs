//! Image formats that are recognised but not decoded.

use super::start::start_of;
use crate::error::Result;
use std::io::{BufRead, Read, Result as IoResult, Seek, SeekFrom};
use std::path::Path;

/// The brands of still images in ISO base media files: HEIC, other HEIF and AVIF.
const BRANDS: [&[u8; 4]; 12] =
    [b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"mif2", b"mif3", b"msf1", b"avif", b"avis"];
/// The first bytes of an EXR file.
pub(in crate::dataset) const EXR: &[u8] = b"\x76\x2f\x31\x01";
/// The transfer curves of high dynamic range in `cICP` (ITU-T H.273): perceptual quantisation and hybrid log-gamma.
const HDR: [(u8, &str); 2] = [(16, "PQ"), (18, "HLG")];

/// Returns the width and height that a HEIC, HEIF or AVIF file states, before rotations; `None` for other files. They
/// are 0 if the start of the file does not state them.
///
/// raygrad does not decode these files: see `raygrad prepare`.
///
/// # Errors
/// If the file cannot be read.
pub fn heif_size(path: impl AsRef<Path>) -> Result<Option<[u64; 2]>> {
    let (start, _) = start_of(path.as_ref())?;
    if !is_heif(&start) {
        return Ok(None);
    }
    // The property `ispe`: a name, a version with flags, width and height. Tiles and previews are smaller.
    let number = |bytes: &[u8]| bytes.iter().fold(0, |number, byte| number << 8 | u64::from(*byte));
    let sizes = start.windows(16).filter(|window| window.starts_with(b"ispe\0\0\0\0"));
    let sizes = sizes.map(|window| [number(&window[8..12]), number(&window[12..])]);
    Ok(Some(sizes.max_by_key(|[width, height]| width * height).unwrap_or_default()))
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
        let what = "is EXR, which raygrad does not decode: convert it with `ffmpeg -apply_trc iec61966_2_1 -i 0.exr \
                    0.png`, which clips values above 1";
        return Ok(Some(what.to_owned()));
    }
    if !start.starts_with(b"\x89PNG") {
        return Ok(None);
    }
    let transfer = transfer_of_png(reader);
    reader.rewind()?;
    let Some(transfer) = transfer? else { return Ok(None) };
    let curve = HDR.iter().find(|(code, _)| *code == transfer);
    Ok(curve.map(|(_, curve)| {
        format!(
            "is HDR ({curve}), which raygrad does not decode: convert it to sRGB, such as by the filter `tonemap` of \
             ffmpeg"
        )
    }))
}

/// The code of the transfer curve of a PNG file in its chunk `cICP`, which is before the pixels.
fn transfer_of_png(reader: &mut (impl Read + Seek)) -> IoResult<Option<u8>> {
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
                return Ok(reader.read_exact(&mut codes).ok().map(|()| codes[1]));
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
    fn heif_is_recognised_by_content() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("0.jpg");
        let of = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            heif_size(&path).unwrap()
        };
        let size =
            |[width, height]: [u32; 2]| [b"ispe\0\0\0\0", &width.to_be_bytes()[..], &height.to_be_bytes()].concat();
        let heic =
            [b"\0\0\0\x18ftypheic\0\0\0\0mif1heic", &size([512, 512])[..], &size([4032, 3024]), &size([320, 240])]
                .concat();
        assert_eq!(of(&heic), Some([4032, 3024]));
        assert_eq!(of(b"\0\0\0\x18ftypABCD\0\0\0\0MiHEavif"), Some([0, 0]), "a compatible brand");
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
            (b"II*\0\x08\0\0\0", "is no PNG, JPEG or WebP file: convert it"),
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
        }
        for bytes in [with(13), plain.clone()] {
            assert!(error(&bytes).is_ok());
        }
    }

    fn crc32(data: &[u8]) -> u32 {
        !data.iter().fold(!0_u32, |sum, byte| {
            (0..8).fold(sum ^ u32::from(*byte), |sum, _| if sum & 1 == 1 { 0xedb8_8320 ^ (sum >> 1) } else { sum >> 1 })
        })
    }
}
