use super::decode::is_progressive;
use super::*;
use image::ImageFormat;
use proptest::prelude::*;

fn bytes(width: usize, height: usize, channels: usize, values: &[u8]) -> Photo {
    assert_eq!(values.len(), width * height * channels);
    Photo { width, height, channels, values: Values::Bytes(values.to_vec()) }
}

#[test]
fn every_pixel_format_becomes_rgb_or_rgba() {
    for byte in 0..=255 {
        let value = f32::from(byte) / 255.0;
        let grey = DynamicImage::ImageLuma8(image::GrayImage::from_raw(1, 1, vec![byte]).unwrap());
        assert_eq!(Photo::from_decoded(grey).to_image().data, [value; 3]);
        let clear = DynamicImage::ImageLumaA8(image::ImageBuffer::from_raw(1, 1, vec![byte, 51]).unwrap());
        assert_eq!(Photo::from_decoded(clear).pixel(0, 0), [value, value, value, 0.2]);
    }
    let deep = DynamicImage::ImageRgba16(image::ImageBuffer::from_raw(1, 1, vec![0, 65535, 13107, 65535]).unwrap());
    let deep = Photo::from_decoded(deep);
    assert_eq!((deep.to_image().data, deep.bytes()), (vec![0.0, 1.0, 0.2, 1.0], 8));
}

#[test]
fn image_takes_as_many_bytes_as_its_file_has_values() {
    assert_eq!(bytes(4, 3, 3, &[7; 36]).bytes(), 36);
    assert_eq!(bytes(4, 3, 3, &[7; 36]).resized([2, 1]).bytes(), 6);
    assert_eq!(Photo::from(Image::new(4, 3, 1)).bytes(), 4 * 36);
}

#[test]
fn resizing_to_other_ratios_shares_pixels() {
    let line = bytes(3, 1, 3, &[0, 0, 0, 90, 90, 90, 240, 240, 240]);
    // Two pixels that cover one and a half each: (0 + 90 / 2) / 1.5 and (90 / 2 + 240) / 1.5.
    assert_eq!(line.resized([2, 1]), bytes(2, 1, 3, &[30, 30, 30, 190, 190, 190]));
    assert_eq!(line.resized([3, 1]), line);
    // Transparent pixels do not bleed into opaque ones.
    let rgba = bytes(3, 1, 4, &[200, 0, 0, 255, 9, 9, 9, 0, 0, 100, 0, 255]);
    assert_eq!(rgba.resized([1, 1]), bytes(1, 1, 4, &[100, 50, 0, 170]));
    assert_eq!((rgba.transparent_share(), line.transparent_share()), (1.0 / 3.0, 0.0));
    assert_eq!(bytes(1, 2, 4, &[1, 2, 3, 255, 1, 2, 3, 0]).transparent_share(), 0.5);
    // Rows and columns keep their order, and 16-bit values stay 16-bit.
    let words = Photo { width: 4, height: 2, channels: 3, values: Values::Words((0..24).map(|i| i * 2000).collect()) };
    let Values::Words(small) = words.resized([2, 1]).values else { panic!("no words") };
    assert_eq!(small, [15000, 17000, 19000, 27000, 29000, 31000]);
}

/// Rows of letters as an image: `#` is opaque, others are transparent.
fn shape(rows: &[&str]) -> Photo {
    let values: Vec<u8> =
        rows.iter().flat_map(|row| row.bytes()).flat_map(|c| [9, 9, 9, 255 * u8::from(c == b'#')]).collect();
    bytes(rows[0].len(), rows.len(), 4, &values)
}

#[test]
fn hollow_alpha_is_told_from_objects_that_touch_an_edge() {
    // 20 by 20 pixels, where this box is transparent.
    let cut = |x: std::ops::Range<usize>, y: std::ops::Range<usize>| {
        let pixel = |i: usize| if x.contains(&(i % 20)) && y.contains(&(i / 20)) { b'.' } else { b'#' };
        let rows: Vec<String> = (0..20).map(|j| (0..20).map(|i| pixel(20 * j + i) as char).collect()).collect();
        shape(&rows.iter().map(String::as_str).collect::<Vec<_>>())
    };
    let inverted = |photo: Photo| {
        let Values::Bytes(mut values) = photo.values else { panic!("no bytes") };
        values.chunks_exact_mut(4).for_each(|pixel| pixel[3] = 255 - pixel[3]);
        Photo { values: Values::Bytes(values), ..photo }
    };
    // An inverted object: within the image, and a standing person whose feet are over the edge.
    for (x, y) in [(8..13, 8..13), (2..18, 2..18), (8..13, 3..20), (7..13, 1..20)] {
        assert!(cut(x.clone(), y.clone()).is_hollow(), "{x:?} {y:?}");
        assert!(!inverted(cut(x.clone(), y.clone())).is_hollow(), "the object itself, {x:?} {y:?}");
    }
    // An object with a small hole, a gate and a table over three edges, and skies over a skyline and a street.
    for (x, y) in [(8..12, 8..12), (4..16, 8..20), (0..20, 0..8), (4..16, 0..14), (9..11, 2..20)] {
        assert!(!cut(x.clone(), y.clone()).is_hollow(), "{x:?} {y:?}");
    }
    for (x, y) in [(0..0, 0..0), (0..20, 0..20), (0..1, 0..1)] {
        assert!(!cut(x.clone(), y.clone()).is_hollow(), "{x:?} {y:?}");
    }
    assert!(!Photo::from(Image::new(8, 6, 3)).is_hollow() && !bytes(1, 1, 4, &[0; 4]).is_hollow());
}

#[test]
fn downsized_image_keeps_its_aspect() {
    let cases = [([3200, 100], [1600, 50]), ([20, 1700], [19, 1600]), ([1601, 1], [1600, 1]), ([9, 8], [9, 8])];
    for ([width, height], expected) in cases {
        let small = Photo::from(Image::new(width, height, 3)).at_most(1600);
        assert_eq!([small.width, small.height], expected);
    }
}

#[test]
fn masks_multiply_alpha() {
    let mask = bytes(2, 1, 3, &[255, 0, 0, 51, 255, 255]);
    assert_eq!(bytes(2, 1, 3, &[1, 2, 3, 4, 5, 6]).masked(&mask), bytes(2, 1, 4, &[1, 2, 3, 255, 4, 5, 6, 51]));
    let rgba = bytes(2, 1, 4, &[1, 2, 3, 100, 4, 5, 6, 100]);
    assert_eq!(rgba.masked(&mask), bytes(2, 1, 4, &[1, 2, 3, 100, 4, 5, 6, 20]));
    let words = Photo { width: 2, height: 1, channels: 3, values: Values::Words(vec![9; 6]) };
    assert_eq!(words.masked(&mask).values, Values::Words(vec![9, 9, 9, 65535, 9, 9, 9, 13107]));
}

#[test]
#[should_panic(expected = "cannot be downsized to 4x1")]
fn resizing_does_not_enlarge() {
    bytes(3, 1, 3, &[0; 9]).resized([4, 1]);
}

/// A JPEG of 16 x 8 pixels with this EXIF orientation. Its upper left quarter is white.
pub(crate) fn jpeg(orientation: u8) -> Vec<u8> {
    let mut plain = vec![];
    let picture = image::RgbImage::from_fn(16, 8, |x, y| image::Rgb([if x < 8 && y < 4 { 255 } else { 0 }; 3]));
    picture.write_to(&mut Cursor::new(&mut plain), ImageFormat::Jpeg).unwrap();
    // An APP1 segment with a directory of one entry: tag 0x0112, a short.
    let mut exif = b"\xff\xe1\x00\x22Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0".to_vec();
    exif.extend([orientation, 0, 0, 0, 0, 0, 0]);
    [&plain[..2], &exif, &plain[2..]].concat()
}

#[test]
fn images_are_turned_upright_unless_calibrated() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("photo.jpg");
    let white = |photo: &Photo, x: usize, y: usize| photo.pixel(x, y)[0] > 0.5;
    // The corner that the white one moves to: upper left, upper right, lower left, lower right.
    for (orientation, size, corner) in [
        (1, [16, 8], 0),
        (2, [16, 8], 1),
        (3, [16, 8], 3),
        (4, [16, 8], 2),
        (5, [8, 16], 0),
        (6, [8, 16], 1),
        (7, [8, 16], 3),
        (8, [8, 16], 2),
    ] {
        std::fs::write(&path, jpeg(orientation)).unwrap();
        assert_eq!(Photo::size_of_file(&path).unwrap(), [[16, 8], size]);
        let camera = if size == [16, 8] { None } else { Some(size) };
        for asked in [None, camera] {
            let photo = Photo::open(&path, asked).unwrap();
            let [right, bottom] = [photo.width - 1, photo.height - 1];
            assert_eq!([photo.width, photo.height], size);
            let seen = [[0, 0], [right, 0], [0, bottom], [right, bottom]].map(|[x, y]| white(&photo, x, y));
            assert_eq!(seen, [0, 1, 2, 3].map(|i| i == corner), "orientation {orientation}");
        }
        // A camera with the stored size keeps the stored orientation, also if turning would not change the size.
        let stored = Photo::open(&path, Some([16, 8])).unwrap();
        assert!([stored.width, stored.height] == [16, 8] && white(&stored, 0, 0) && !white(&stored, 15, 0));
    }
}

#[test]
fn formats_are_detected_by_content() {
    let folder = tempfile::tempdir().unwrap();
    let picture = image::RgbaImage::from_fn(5, 4, |x, y| image::Rgba([x as u8 * 50, y as u8 * 60, 7, 255 - x as u8]));
    for format in [ImageFormat::Png, ImageFormat::WebP] {
        let path = folder.path().join("picture.JPG");
        picture.save_with_format(&path, format).unwrap();
        let photo = Photo::open(&path, None).unwrap();
        assert_eq!((Photo::file_has_alpha(&path).unwrap(), photo.has_alpha()), (true, true));
        assert_eq!(photo.pixel(4, 3), [200.0 / 255.0, 180.0 / 255.0, 7.0 / 255.0, 251.0 / 255.0]);
    }
}

#[test]
fn jpeg_that_ends_within_its_pixels_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.jpg");
    let open = |bytes: &[u8]| {
        std::fs::write(&path, bytes).unwrap();
        Photo::open(&path, None).map(drop).map_err(|error| error.to_string())
    };
    let noise = image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([(x * x * 31 + y * y * 17 + x * y) as u8; 3]));
    let mut plain = vec![];
    noise.write_to(&mut Cursor::new(&mut plain), ImageFormat::Jpeg).unwrap();
    // A thumbnail in EXIF has an end of its own.
    let thumbnail = [&[0xff, 0xe1, 0, 8, 0xff, 0xd9][..], b"more"].concat();
    let with_thumbnail = [&plain[..2], &thumbnail[..8 + 2], &plain[2..]].concat();
    for whole in [&plain, &with_thumbnail] {
        assert_eq!(open(whole), Ok(()));
        assert_eq!(open(&[whole, &b"a video behind the image"[..]].concat()), Ok(()));
        for end in [whole.len() / 2, whole.len() - 300, whole.len() - 2, whole.len() - 1] {
            let message = open(&whole[..end]).unwrap_err();
            assert!(message.contains("cut.jpg: ends within its pixels: copy it again"), "{end}: {message}");
        }
    }
}

#[test]
fn oversized_header_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("picture.png");
    std::fs::write(&path, jpeg(1)).unwrap();
    assert!(!Photo::file_has_alpha(&path).unwrap() && Photo::open(&path, None).is_ok());
    // A PNG header of 2^20 x 2^20 pixels, with a valid checksum.
    let head: &[u8] = b"IHDR\0\x10\0\0\0\x10\0\0\x08\x02\0\0\0";
    let checksum = head.iter().fold(!0_u32, |sum, byte| {
        (0..8).fold(sum ^ u32::from(*byte), |sum, _| if sum & 1 == 1 { 0xedb8_8320 ^ (sum >> 1) } else { sum >> 1 })
    });
    let file = [b"\x89PNG\r\n\x1a\n\0\0\0\x0d", head, &(!checksum).to_be_bytes(), &[0, 0, 0, 0], b"IDAT"].concat();
    std::fs::write(&path, file).unwrap();
    let message = Photo::open(&path, None).unwrap_err().to_string();
    assert!(message.contains("picture.png: cannot be decoded"), "{message}");
}

proptest! {
    #[test]
    fn resizing_keeps_the_mean(
        [width, height] in prop::array::uniform2(1..12_usize), to in prop::array::uniform2(1..12_usize), seed in any::<u8>(),
    ) {
        let to = [to[0].min(width), to[1].min(height)];
        let data = (0..3 * width * height).map(|i| ((i as u8).wrapping_mul(37).wrapping_add(seed)) as f32 / 255.0).collect();
        let photo = Photo::from(Image { width, height, channels: 3, data });
        let mean = |photo: &Photo| {
            let data = photo.to_image().data;
            data.iter().map(|x| f64::from(*x)).sum::<f64>() / data.len() as f64
        };
        let small = photo.resized(to);
        prop_assert_eq!([small.width, small.height], to);
        prop_assert!((mean(&small) - mean(&photo)).abs() < 1e-6);
    }
}

#[test]
fn decoding_takes_at_most_the_announced_memory() {
    use raygrad_test_support::memory::peak;
    let folder = tempfile::tempdir().unwrap();
    let (width, height) = (300, 200);
    let noise = |i: usize| ((i * 2_654_435_761) >> 7) as u8;
    let grey = image::GrayImage::from_vec(width, height, (0..60_000).map(noise).collect()).unwrap();
    let grey = DynamicImage::ImageLuma8(grey);
    let all = [
        ("grey.png", grey.clone()),
        ("rgb.png", DynamicImage::ImageRgb8(grey.to_rgb8())),
        ("rgba.png", DynamicImage::ImageRgba8(grey.to_rgba8())),
        ("deep.png", DynamicImage::ImageRgba16(grey.to_rgba16())),
        ("grey16.png", DynamicImage::ImageLuma16(grey.to_luma16())),
        ("rgb.jpg", DynamicImage::ImageRgb8(grey.to_rgb8())),
        ("rgb.webp", DynamicImage::ImageRgb8(grey.to_rgb8())),
        ("rgb.tif", DynamicImage::ImageRgb8(grey.to_rgb8())),
        ("deep.tiff", DynamicImage::ImageRgba16(grey.to_rgba16())),
        ("grey.bmp", grey.clone()),
        ("rgb.bmp", DynamicImage::ImageRgb8(grey.to_rgb8())),
    ];
    for (name, image) in all {
        let path = folder.path().join(name);
        image.save(&path).unwrap();
        let announced = Photo::decoding_memory(&path).unwrap();
        let (photo, taken) = peak(|| Photo::open(&path, None).unwrap());
        // Buffers of the decoders come in addition.
        let buffers = 1 << 19;
        assert!(taken as u64 <= announced + buffers, "{name}: {taken} of {announced}");
        assert!(announced <= 4 * photo.bytes() as u64 + 200_000, "{name}: {announced} for {}", photo.bytes());
        let header = Header::read(&path).unwrap();
        assert_eq!(header.pixel * 60_000, photo.bytes() as u64, "{name}");
    }
}

#[test]
fn header_of_jpeg_is_read_from_its_start() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long.jpg");
    let mut bytes = jpeg(6);
    bytes.resize(3 << 20, 0);
    std::fs::write(&path, &bytes).unwrap();
    let (sizes, taken) = raygrad_test_support::memory::peak(|| Photo::size_of_file(&path).unwrap());
    assert_eq!(sizes, [[16, 8], [8, 16]]);
    assert!(taken < 5 << 19, "{taken} bytes for the header");
    // A file without an end is refused before it is read.
    File::options().write(true).open(&path).unwrap().set_len(3 << 30).unwrap();
    let error = Photo::open(&path, None).unwrap_err().to_string();
    assert!(error.contains("long.jpg: has 3.2 GB; the limit for an image is 2.1 GB"), "{error}");
    // The marker of the frame, after segments of any length.
    let segments =
        |frame: u8| [&[0xff, 0xd8, 0xff, 0xe1, 0, 4, 1, 2, 0xff, frame, 0, 4, 0, 0][..], &[0xff, 0xda, 0, 2]].concat();
    assert_eq!([0xc0, 0xc1, 0xc2, 0xca].map(|frame| is_progressive(&segments(frame))), [false, false, true, true]);
    assert!(!is_progressive(b"\x89PNG") && !is_progressive(&segments(0xc2)[..8]));
}
