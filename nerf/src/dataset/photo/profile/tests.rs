use super::*;
use crate::dataset::color_space::SrgbDecode;
use crate::dataset::photo::{Photo, Values};
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::codecs::webp::WebPEncoder;
use image::{DynamicImage, ImageEncoder, RgbImage};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// The columns of Apple's profile Display P3.
const P3: [[f64; 3]; 3] = [[0.51512, 0.24120, -0.00105], [0.29198, 0.69225, 0.04189], [0.15710, 0.06657, 0.78407]];

fn fixed_bytes(numbers: &[f64]) -> Vec<u8> {
    numbers.iter().flat_map(|x| ((x * 65536.0).round() as i32).to_be_bytes()).collect()
}

fn parametric(form: u8, numbers: &[f64]) -> Vec<u8> {
    [b"para\0\0\0\0\0".as_slice(), &[form, 0, 0], &fixed_bytes(numbers)].concat()
}

fn table(values: &[u16]) -> Vec<u8> {
    let values: Vec<u8> = values.iter().flat_map(|x| x.to_be_bytes()).collect();
    [b"curv\0\0\0\0".as_slice(), &((values.len() / 2) as u32).to_be_bytes(), &values].concat()
}

/// sRGB's curve as Apple and the ICC store it.
fn srgb_curve() -> Vec<u8> {
    parametric(3, &[2.4, 1.0 / 1.055, 0.055 / 1.055, 1.0 / 12.92, 0.04045])
}

/// sRGB's curve at even steps.
fn srgb_table(count: usize) -> Vec<u8> {
    let light = |i: usize| SrgbDecode.f([i as f64 / (count - 1) as f64]);
    table(&(0..count).map(|i| (65535.0 * light(i)).round() as u16).collect::<Vec<_>>())
}

/// A profile with these columns of the matrix, and one curve for all channels.
fn profile(columns: [[f64; 3]; 3], curve: &[u8]) -> Vec<u8> {
    profile_of(columns, [curve; 3])
}

fn profile_of(columns: [[f64; 3]; 3], curves: [&[u8]; 3]) -> Vec<u8> {
    let colors = columns.map(|column| [b"XYZ \0\0\0\0".as_slice(), &fixed_bytes(&column)].concat());
    let [red, green, blue] = &colors;
    let tags: [(&[u8; 4], &[u8]); 6] = [
        (b"rXYZ", red),
        (b"rTRC", curves[0]),
        (b"gXYZ", green),
        (b"gTRC", curves[1]),
        (b"bXYZ", blue),
        (b"bTRC", curves[2]),
    ];
    let mut bytes = vec![0; 128];
    bytes[16..24].copy_from_slice(b"RGB XYZ ");
    bytes[36..40].copy_from_slice(b"acsp");
    bytes.extend(6_u32.to_be_bytes());
    let mut at = 132 + 12 * tags.len();
    for (name, data) in tags {
        bytes.extend([name.as_slice(), &(at as u32).to_be_bytes(), &(data.len() as u32).to_be_bytes()].concat());
        at += data.len();
    }
    tags.iter().for_each(|(_, data)| bytes.extend(*data));
    bytes
}

fn srgb_columns() -> [[f64; 3]; 3] {
    SRGB.to_cols_array_2d()
}

/// The matrix to linear sRGB from the published primaries of Display P3; both have the white D65.
fn published() -> DMat3 {
    let xyz = |[x, y]: [f64; 2]| DVec3::new(x / y, 1.0, (1.0 - x - y) / y);
    let to_xyz = |primaries: [[f64; 2]; 3]| {
        let [r, g, b] = primaries.map(xyz);
        let columns = DMat3::from_cols(r, g, b);
        columns * DMat3::from_diagonal(columns.inverse() * xyz([0.3127, 0.3290]))
    };
    let srgb = to_xyz([[0.64, 0.33], [0.30, 0.60], [0.15, 0.06]]);
    srgb.inverse() * to_xyz([[0.680, 0.320], [0.265, 0.690], [0.150, 0.060]])
}

#[test]
fn display_p3_becomes_srgb() {
    let space = RgbSpace::parse(&profile(P3, &srgb_curve())).unwrap();
    assert!(!space.is_srgb());
    let bytes = |pixel: [u8; 3]| {
        let mut pixel = pixel;
        space.convert(&mut pixel, 3, 255, byte);
        pixel
    };
    // The primaries are outside of sRGB; greys stay.
    assert_eq!(bytes([255, 0, 0]), [255, 0, 0]);
    assert_eq!(bytes([0, 255, 0]), [0, 255, 0]);
    assert_eq!(bytes([0, 0, 255]), [0, 0, 255]);
    (0..=255).for_each(|grey| assert_eq!(bytes([grey; 3]), [grey; 3]));
    let matrix = published();
    let codes = (0..=15).map(|i| i * 17);
    for (r, g, b) in codes.clone().flat_map(|r| codes.clone().flat_map(move |g| [0, 90, 201, 255].map(|b| (r, g, b)))) {
        let linear = DVec3::from([r, g, b].map(|x: u8| SrgbDecode.f([f64::from(x) / 255.0])));
        let exact = (matrix * linear).to_array().map(|x| x.clamp(0.0, 1.0));
        let mut words = [r, g, b].map(|x| u16::from(x) * 257);
        space.convert(&mut words, 3, 65535, |value| value);
        for i in 0..3 {
            let [byte, word] = [f64::from(bytes([r, g, b])[i]), SrgbDecode.f([f64::from(words[i]) / 65535.0])];
            let code = 255.0 * SrgbEncode.f([exact[i]]);
            assert!((byte - code).abs() < 1.1, "{:?}: {byte} for {code}", [r, g, b]);
            // The digits of the profile's matrix.
            assert!((word - exact[i]).abs() < 2e-4, "{:?}: {word} for {}", [r, g, b], exact[i]);
        }
    }
    // Alpha stays.
    let mut rgba = [200, 30, 30, 77, 30, 200, 30, 201];
    space.convert(&mut rgba, 4, 255, byte);
    assert_eq!(rgba.as_slice(), [&bytes([200, 30, 30])[..], &[77], &bytes([30, 200, 30]), &[201]].concat());
}

/// An image of 16 x 8 pixels in a file of this type, with a profile.
fn written(ending: &str, icc: Option<&[u8]>) -> (tempfile::TempDir, std::path::PathBuf) {
    fn encode(image: &DynamicImage, mut encoder: impl ImageEncoder, icc: Option<&[u8]>) {
        if let Some(icc) = icc {
            encoder.set_icc_profile(icc.to_vec()).unwrap();
        }
        image.write_with_encoder(encoder).unwrap();
    }
    let image = RgbImage::from_fn(16, 8, |x, y| image::Rgb([x as u8 * 17, y as u8 * 30, 255 - x as u8 * 9]));
    let image = DynamicImage::ImageRgb8(image);
    let mut bytes = vec![];
    match ending {
        "png" => encode(&image, PngEncoder::new(&mut bytes), icc),
        "png16" => encode(&DynamicImage::ImageRgba16(image.to_rgba16()), PngEncoder::new(&mut bytes), icc),
        "jpg" => encode(&image, JpegEncoder::new_with_quality(&mut bytes, 95), icc),
        _ => encode(&image, WebPEncoder::new_lossless(&mut bytes), icc),
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(format!("a.{ending}"));
    std::fs::write(&path, bytes).unwrap();
    (folder, path)
}

const TYPES: [&str; 4] = ["png", "png16", "jpg", "webp"];

#[test]
fn images_are_converted_by_their_profiles() {
    let p3 = profile(P3, &srgb_curve());
    let space = Profile::Rgb(Box::new(RgbSpace::parse(&p3).unwrap()));
    for ending in TYPES {
        let (_folder, path) = written(ending, Some(&p3));
        let (_plain, plain) = written(ending, None);
        let plain = Photo::open(plain, None).unwrap();
        let mut expected = plain.clone();
        match &mut expected.values {
            Values::Bytes(values) => space.convert_bytes(values, expected.channels),
            Values::Words(values) => space.convert_words(values, expected.channels),
            Values::Floats(_) => panic!("files hold integers"),
        }
        let photo = Photo::open(&path, None).unwrap();
        assert_eq!(photo, expected, "{ending}");
        assert_ne!(photo, plain, "{ending}");
        assert!(!Photo::has_unread_profile(&path).unwrap());
    }
}

#[test]
fn images_in_srgb_stay_bit_for_bit() {
    let gamma = table(&[(2.2_f64 * 256.0).round() as u16]);
    let cases = [
        ("parametric", profile(srgb_columns(), &srgb_curve()), true),
        ("table", profile(srgb_columns(), &srgb_table(1024)), true),
        ("short table", profile(srgb_columns(), &srgb_table(42)), true),
        (
            "other digits",
            profile([[0.4361, 0.2225, 0.0139], [0.3851, 0.7169, 0.0971], [0.1431, 0.0606, 0.7141]], &srgb_curve()),
            true,
        ),
        ("gamma 2.2", profile(srgb_columns(), &gamma), false),
        ("Display P3", profile(P3, &srgb_curve()), false),
    ];
    for (name, icc, is_srgb) in cases {
        assert_eq!(RgbSpace::parse(&icc).unwrap().is_srgb(), is_srgb, "{name}");
        for ending in TYPES {
            let (_folder, path) = written(ending, Some(&icc));
            let (_plain, plain) = written(ending, None);
            assert_eq!(
                Photo::open(path, None).unwrap() == Photo::open(plain, None).unwrap(),
                is_srgb,
                "{name} {ending}"
            );
        }
    }
}

#[test]
fn curves_are_those_of_the_specification() {
    let at = |data: &[u8], x: f64| Curve::parse(data).unwrap().at(x);
    let close = |a: f64, b: f64| assert!((a - b).abs() < 1e-4, "{a} {b}");
    close(at(&table(&[]), 0.3), 0.3);
    close(at(&table(&[512]), 0.3), 0.09);
    close(at(&table(&[0, 13107, 65535]), 0.75), 0.6);
    close(at(&parametric(0, &[2.0]), 0.3), 0.09);
    close(at(&parametric(1, &[2.0, 1.25, -0.25]), 0.6), 0.25);
    close(at(&parametric(1, &[2.0, 1.25, -0.25]), 0.1), 0.0);
    close(at(&parametric(2, &[2.0, 1.0, -0.1, 0.05]), 0.6), 0.3);
    close(at(&parametric(2, &[2.0, 1.0, -0.1, 0.05]), 0.1), 0.05);
    close(at(&parametric(3, &[2.0, 1.0, 0.0, 0.1, 0.2]), 0.1), 0.01);
    close(at(&parametric(4, &[2.0, 0.9, 0.0, 0.1, 0.2, 0.1, 0.02]), 0.1), 0.03);
    close(at(&parametric(4, &[2.0, 0.9, 0.0, 0.1, 0.2, 0.1, 0.02]), 0.5), 0.3025);
    for bad in [
        table(&[65535, 0]),
        table(&[7, 7]),
        parametric(0, &[]),
        parametric(5, &[1.0; 7]),
        parametric(4, &[1.0; 6]),
        parametric(1, &[2.0, 0.0, 0.0]),
        parametric(0, &[-1.0]),
        b"mft2".to_vec(),
        vec![],
    ] {
        assert_eq!(Curve::parse(&bad), None, "{bad:?}");
    }
}

#[test]
fn other_profiles_leave_pixels_as_they_are() {
    let good = profile(P3, &srgb_curve());
    let with = |at: usize, name: &[u8]| {
        let mut bytes = good.clone();
        bytes[at..at + name.len()].copy_from_slice(name);
        bytes
    };
    // CMYK, Lab as the connection space, no signature, lookup tables in place of a matrix, a white other than D50.
    let white = profile([[0.4124, 0.2126, 0.0193], [0.3576, 0.7152, 0.1192], [0.1805, 0.0722, 0.9505]], &srgb_curve());
    let mut long = good.clone();
    long.resize(LONGEST + 1, 0);
    for icc in [with(16, b"CMYK"), with(20, b"Lab "), with(36, b"____"), with(132, b"A2B0"), white, vec![7; 300], long]
    {
        let (_folder, path) = written("png", Some(&icc));
        let (_plain, plain) = written("png", None);
        assert_eq!(Photo::open(&path, None).unwrap(), Photo::open(plain, None).unwrap());
        assert!(Photo::has_unread_profile(&path).unwrap());
    }
    let (_plain, plain) = written("png", None);
    assert!(!Photo::has_unread_profile(plain).unwrap());
}

/// Damaged profiles neither panic nor take long.
#[test]
fn damaged_profiles_are_harmless() {
    let mut rng = Pcg64Mcg::seed_from_u64(7);
    let whole = [profile(P3, &srgb_curve()), profile(P3, &srgb_table(33)), profile(P3, &table(&[512]))];
    let mut read = 0;
    for round in 0..4000 {
        let mut bytes = whole[round % 3].clone();
        for _ in 0..rng.random_range(1..4) {
            let at = rng.random_range(0..bytes.len() - 4);
            match rng.random_range(0..4) {
                0 => bytes[at] = rng.random(),
                1 => bytes[at] ^= 1 << rng.random_range(0..8),
                2 => bytes[at..at + 4]
                    .copy_from_slice(&[[0; 4], [0xff; 4], [0x7f, 0xff, 0xff, 0xff]][rng.random_range(0..3)]),
                _ => bytes.truncate(at.max(8)),
            }
        }
        let Some(space) = RgbSpace::parse(&bytes) else { continue };
        read += 1;
        space.is_srgb();
        let mut pixels: Vec<u8> = (0..=254).collect();
        space.convert(&mut pixels, 3, 255, byte);
    }
    assert!((500..3500).contains(&read), "{read} of 4000 are read");
    for end in 0..whole[0].len() {
        assert!(RgbSpace::parse(&whole[0][..end]).is_none());
    }
}

#[test]
fn each_channel_has_its_own_curve() {
    let gamma = |tenths: u16| [&b"curv\0\0\0\0\0\0\0\x01"[..], &(tenths * 256 / 10).to_be_bytes()].concat();
    let [one, two, three] = [10, 20, 30].map(gamma);
    let space = RgbSpace::parse(&profile_of(srgb_columns(), [&one, &two, &three])).unwrap();
    let mut pixel = [32768_u16; 3];
    space.convert(&mut pixel, 3, 65535, |value| value);
    for (value, linear) in pixel.into_iter().zip([0.5, 0.25, 0.125]) {
        let exact = SrgbEncode.f([linear]);
        assert!((f64::from(value) / 65535.0 - exact).abs() < 2e-3, "{pixel:?}");
    }
}
