//! Depth images: reading measured depths, and writing rendered ones.

use super::formats::npy::Matrix;
use super::image::Image;
use super::photo::unsupported::EXR;
use super::photo::{Header, decoder_of};
use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use image::{DynamicImage, ImageBuffer, ImageFormat, Luma};
use raygrad_nn::npy;
use std::fs::File;
use std::io::{Cursor, Read};
use std::path::Path;

/// Reads depths along the optical axis in multiples of `unit` scene units: a PNG of integers or a `.npy` array of
/// floats.
///
/// Returns distances along the rays through the camera's pixel centres, in scene units; 0 where nothing was measured.
/// Other sizes are resampled by nearest neighbour: an average of a near and a far depth would be wrong.
pub(super) fn distances(path: &Path, unit: f64, camera: &Camera) -> Result<Image> {
    let ([width, height], depths) = decoded(path)?;
    check_shape(path, [width, height], camera)?;
    let Camera { width: columns, height: rows, .. } = *camera;
    let axis = -camera.pose.matrix3.z_axis;
    let mut out = Image::new(columns, rows, 1);
    for (i, distance) in out.data.iter_mut().enumerate() {
        let (x, y) = (i % columns, i / columns);
        let at = |i: usize, of: usize, count: usize| ((2 * i + 1) * count / (2 * of)).min(count - 1);
        let depth = unit * depths[at(y, rows, height) * width + at(x, columns, width)];
        let ray = camera.ray(x as f64 + 0.5, y as f64 + 0.5);
        let found = depth / ray.direction.dot(axis);
        *distance = if depth > 0.0 && found > 0.0 && found <= f64::from(f32::MAX) { found as f32 } else { 0.0 };
    }
    Ok(out)
}

/// Checks that depths of a size cover the image of a camera.
fn check_shape(path: &Path, [width, height]: [usize; 2], camera: &Camera) -> Result<()> {
    let Camera { width: columns, height: rows, .. } = *camera;
    // The aspect ratios may differ by the rounding of a side.
    let apart = 2 * (width * rows).abs_diff(height * columns);
    if width == 0 || height == 0 || apart > (width + height).max(rows + columns) {
        let what = format!("has {width}x{height} depths but the image {columns}x{rows} pixels; use one aspect ratio");
        return Err(Error::file(path, what));
    }
    Ok(())
}

/// What is wrong with depths in EXR. The remedy for images would encode them as colours.
const NOT_DECODED: &str = "is EXR, which raygrad does not decode: write depths as PNG of 16 bits or as .npy";

/// The width, height and row-major values of a depth file.
fn decoded(path: &Path) -> Result<([usize; 2], Vec<f64>)> {
    let wrong = |what: String| Error::file(path, what);
    let bytes = std::fs::read(path).map_err(|error| Error::file(path, error))?;
    if bytes.starts_with(npy::MAGIC) {
        let Matrix { rows, columns, values } = Matrix::read(&bytes).map_err(wrong)?;
        return Ok(([columns, rows], values));
    }
    if bytes.starts_with(EXR) {
        return Err(wrong(NOT_DECODED.into()));
    }
    let (decoder, _) = decoder_of(Cursor::new(&bytes), bytes.len() as u64, path)?;
    let decoded = DynamicImage::from_decoder(decoder);
    let decoded = decoded.map_err(|error| wrong(format!("cannot be decoded: {error}")))?;
    let size = [decoded.width() as usize, decoded.height() as usize];
    let values = match decoded {
        DynamicImage::ImageLuma8(image) => image.into_raw().into_iter().map(f64::from).collect(),
        DynamicImage::ImageLuma16(image) => image.into_raw().into_iter().map(f64::from).collect(),
        decoded => grey(&decoded).ok_or_else(|| {
            let what = "has colours, so it is a picture of depths: write the depths themselves, as PNG of one channel \
                        with 8 or 16 bits, or as .npy";
            wrong(what.to_owned())
        })?,
    };
    Ok((size, values))
}

/// The values of an image with several channels whose pixels are grey; 0 where it is transparent, unless it is so
/// everywhere. `None` if it has colours.
fn grey(image: &DynamicImage) -> Option<Vec<f64>> {
    fn values<T: Copy + Into<f64>>(values: &[T], channels: usize) -> Option<Vec<f64>> {
        let split = |pixel| <[T]>::split_at(pixel, channels - usize::from(channels.is_multiple_of(2)));
        let is_clear = |pixel| split(pixel).1.iter().any(|alpha| (*alpha).into() == 0.0);
        // Some programs leave alpha at 0.
        let has_alpha = !values.chunks_exact(channels).all(is_clear);
        let pixel = |pixel| {
            let (is_hidden, [first, others @ ..]) = (has_alpha && is_clear(pixel), split(pixel).0) else { return None };
            let value = (*first).into();
            let is_grey = others.iter().all(|color| (*color).into() == value);
            (is_grey || is_hidden).then_some(if is_hidden { 0.0 } else { value })
        };
        values.chunks_exact(channels).map(pixel).collect()
    }
    let channels = usize::from(image.color().channel_count());
    match image {
        DynamicImage::ImageLumaA8(image) => values(image, channels),
        DynamicImage::ImageLumaA16(image) => values(image, channels),
        DynamicImage::ImageRgb8(image) => values(image, channels),
        DynamicImage::ImageRgb16(image) => values(image, channels),
        DynamicImage::ImageRgba8(image) => values(image, channels),
        DynamicImage::ImageRgba16(image) => values(image, channels),
        _ => None,
    }
}

/// A depth image along the optical axis, as [`View::depth`](super::View::depth) reads it; 0 where there is no depth.
#[derive(Debug, Clone, PartialEq)]
pub struct Depths {
    size: [usize; 2],
    /// Row-major.
    values: Vec<f32>,
}

impl Depths {
    /// Checks that training can read a depth file.
    ///
    /// # Errors
    /// If it cannot be read or decoded.
    pub fn check_file(path: impl AsRef<Path>) -> Result<()> {
        decoded(path.as_ref()).map(drop)
    }

    /// Reads a depth file, in its own unit, for a camera; one without a size fits any.
    pub(crate) fn read(path: &Path, camera: &Camera) -> Result<Self> {
        let (size, values) = decoded(path)?;
        if camera.width > 0 {
            check_shape(path, size, camera)?;
        }
        Ok(Depths { size, values: values.into_iter().map(|depth| depth as f32).collect() })
    }

    /// The depth at a place, in shares of the sides; `None` outside of the image.
    pub(crate) fn at(&self, place: [f64; 2]) -> Option<f64> {
        let [width, height] = self.size;
        let inside = place.iter().all(|share| (0.0..1.0).contains(share));
        let [x, y] = [place[0] * width as f64, place[1] * height as f64].map(|x| x as usize);
        inside.then(|| self.values.get(y * width + x).map(|depth| f64::from(*depth)))?
    }

    /// The most bytes of memory while a depth file is decoded, from its header.
    pub(super) fn decoding_memory(path: impl AsRef<Path>) -> Result<u64> {
        let path = path.as_ref();
        let bad = |error| Error::file(path, error);
        let (mut start, mut file) = ([0; npy::MAGIC.len()], File::open(path).map_err(bad)?);
        if file.read_exact(&mut start).is_ok() && start == npy::MAGIC {
            // The file, and 8 bytes for each of its 4.
            return Ok(file.metadata().map_err(bad)?.len().saturating_mul(3));
        }
        if start.starts_with(EXR) {
            return Err(Error::file(path, NOT_DECODED));
        }
        let header = Header::read(path)?;
        let [width, height] = header.sizes[0];
        Ok(header.decoding + 8 * (width * height) as u64)
    }

    /// Converts distances along rays, as a [`Render`](crate::Render) has them, to depths, and multiplies them by
    /// `scale`.
    ///
    /// A `scale` of 1 over [`SceneTransform::scale`](super::SceneTransform::scale) gives units of the capture.
    ///
    /// # Panics
    /// If the image is not one channel of the camera's size.
    #[track_caller]
    pub fn new(distances: &Image, camera: &Camera, scale: f64) -> Self {
        distances.assert_same_shape(&Image::new(camera.width, camera.height, 1));
        let axis = -camera.pose.matrix3.z_axis;
        let along = |(pixel, distance): (usize, &f32)| {
            let [x, y] = camera.place_of(pixel);
            let depth = scale * f64::from(*distance) * camera.pixel_ray(x, y).direction.dot(axis);
            // A wide lens also sees behind the camera, where depth is undefined.
            if depth > 0.0 { depth as f32 } else { 0.0 }
        };
        let values = distances.data.iter().enumerate().map(along).collect();
        Depths { size: [camera.width, camera.height], values }
    }

    /// Encodes a 16-bit PNG of one channel, in multiples of `unit`, rounded. Also returns the number of depths that do
    /// not fit and are written as 0.
    ///
    /// # Panics
    /// If it has no pixels.
    #[track_caller]
    pub fn to_png(&self, unit: f64) -> (Vec<u8>, usize) {
        let [width, height] = self.size.map(|side| side as u32);
        let mut beyond = 0;
        let whole = |depth: &f32| {
            let units = (f64::from(*depth) / unit).round();
            if units <= f64::from(u16::MAX) {
                return units as u16;
            }
            beyond += 1;
            0
        };
        let values = self.values.iter().map(whole).collect();
        let mut bytes = Cursor::new(vec![]);
        ImageBuffer::<Luma<u16>, Vec<u16>>::from_raw(width, height, values)
            .expect("there are as many depths as pixels")
            .write_to(&mut bytes, ImageFormat::Png)
            .expect("an image with pixels is written to memory");
        (bytes.into_inner(), beyond)
    }

    /// Encodes a `.npy` file of an f32 array `[height, width]`.
    pub fn to_npy(&self) -> Vec<u8> {
        let [width, height] = self.size;
        npy::encode(&[height, width], &self.values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DAffine3, DVec3};
    use image::{LumaA, Rgb, Rgba};

    /// The remedy for images is wrong for depths: it clips them and applies a curve.
    #[test]
    fn exr_depths_have_their_own_remedy() {
        let file = tempfile::Builder::new().suffix(".exr").tempfile().unwrap();
        std::fs::write(file.path(), [EXR, &[0; 60]].concat()).unwrap();
        let camera = Camera::from_angle(5, 3, 1.4, DAffine3::IDENTITY);
        let [one, other] =
            [Depths::decoding_memory(file.path()).map(drop), distances(file.path(), 1.0, &camera).map(drop)];
        for message in [one, other].map(|result| result.unwrap_err().to_string()) {
            assert!(message.ends_with(NOT_DECODED) && !message.contains("ffmpeg"), "{message}");
        }
    }

    #[test]
    fn depth_files_round_trip() {
        let folder = tempfile::tempdir().unwrap();
        let pose = Camera::look_at(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DVec3::Z);
        let camera = Camera::from_angle(5, 3, 1.4, pose);
        // A wall at depth 4.5 with two unknown pixels; and one whose depth does not fit into 16 bits.
        let wall = |depth: f64| {
            let mut image = Image::new(5, 3, 1);
            for pixel in 0..15 {
                let ray = camera.pixel_ray(pixel % 5, pixel / 5);
                image.data[pixel] = (depth / ray.direction.dot(-pose.matrix3.z_axis)) as f32;
            }
            (image.data[1], image.data[13]) = (0.0, 0.0);
            image
        };
        let depths = Depths::new(&wall(4.5), &camera, 0.5);
        let none = |pixel: usize| pixel == 1 || pixel == 13;
        assert!((0..15).all(|i| (depths.values[i] - if none(i) { 0.0 } else { 2.25 }).abs() < 1e-6), "{depths:?}");
        let (png, beyond) = depths.to_png(0.001);
        assert_eq!(beyond, 0);
        for (name, bytes, unit, error) in [("a.png", png, 0.002, 1e-6), ("a.npy", depths.to_npy(), 2.0, 1e-6)] {
            let path = folder.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            let found = distances(&path, unit, &camera).unwrap();
            let worst = found.data.iter().zip(wall(4.5).data).map(|(a, b)| (a - b).abs());
            assert!(worst.fold(0.0, raygrad_tensor::Real::maximum) < error && found.data[2] > 4.5, "{name}: {found:?}");
        }
        let pixels = |bytes: &[u8]| image::load_from_memory(bytes).unwrap().into_luma16().into_raw();
        assert_eq!(pixels(&depths.to_png(0.001).0)[..3], [2250, 0, 2250]);
        assert_eq!(pixels(&depths.to_png(0.004).0)[0], 563, "to the nearest");
        let (far, beyond) = Depths::new(&wall(65.6), &camera, 1.0).to_png(0.001);
        assert_eq!((pixels(&far), beyond), (vec![0; 15], 13));
        assert_eq!(pixels(&Depths::new(&wall(65.535), &camera, 1.0).to_png(0.001).0)[0], u16::MAX);
    }

    #[test]
    fn depths_become_distances_and_are_not_averaged() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("depth.png");
        // Twice the size of the image; 0 is unknown.
        let values = [0_u16, 1000, 2000, 3000, 4000, 5000, 6000, 65535];
        let picture = ImageBuffer::<Luma<u16>, _>::from_fn(8, 4, |x, y| Luma([values[((x + 8 * y) / 4) as usize]]));
        picture.save(&path).unwrap();
        let pose = Camera::look_at(DVec3::new(1.0, 2.0, 3.0), DVec3::ZERO, DVec3::Z);
        let camera = Camera::from_angle(4, 2, 1.0, pose);
        let found = distances(&path, 0.002, &camera).unwrap();
        assert_eq!([found.width, found.height, found.channels], [4, 2, 1]);
        for (i, distance) in found.data.iter().enumerate() {
            let (x, y) = (i % 4, i / 4);
            let depth = 0.002 * f64::from(values[(2 * x + 1 + 8 * (2 * y + 1)) / 4]);
            let place = camera.ray(x as f64 + 0.5, y as f64 + 0.5).at(f64::from(*distance));
            let along = -(camera.pose.inverse().transform_point3(place)).z;
            assert!((along - depth).abs() < 1e-5 && (*distance == 0.0) == (depth == 0.0), "{i}: {along} {depth}");
        }
    }

    #[test]
    fn float_arrays_are_read_unknown_depth_is_zero() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("depth.npy");
        let values = vec![1.0, f64::NAN, -1.0, f64::INFINITY, 2.5, 1e300];
        std::fs::write(&path, Matrix { rows: 2, columns: 3, values }.write()).unwrap();
        let camera = Camera::from_angle(3, 2, 0.1, DAffine3::IDENTITY);
        let found = distances(&path, 2.0, &camera).unwrap();
        assert!((found.data[0] - 2.0).abs() < 0.01 && (found.data[4] - 5.0).abs() < 0.02, "{found:?}");
        assert_eq!([1, 2, 3, 5].map(|i| found.data[i]), [0.0; 4]);
    }

    #[test]
    fn low_resolution_depth_is_looked_up_per_ray() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("depth.png");
        ImageBuffer::<Luma<u8>, _>::from_fn(2, 1, |x, _| Luma([[0, 200][x as usize]])).save(&path).unwrap();
        let camera = Camera::from_angle(8, 4, 0.1, DAffine3::IDENTITY);
        let found = distances(&path, 0.01, &camera).unwrap();
        assert!((0..32).all(|i| if i % 8 < 4 { found.data[i] == 0.0 } else { (found.data[i] - 2.0).abs() < 0.01 }));
        let lens = crate::camera::lens::Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] };
        let wide = Camera { lens, focal: [1.5; 2], ..camera };
        let behind = |i: usize| wide.ray((i % 8) as f64 + 0.5, (i / 8) as f64 + 0.5).direction.z > 0.0;
        ImageBuffer::<Luma<u8>, _>::from_pixel(8, 4, Luma([200])).save(&path).unwrap();
        let found = distances(&path, 0.01, &wide).unwrap();
        assert!((0..32).any(behind) && (0..32).all(|i| (found.data[i] == 0.0) == behind(i)), "{found:?}");
        // Downscaling rounded both sides of the image.
        ImageBuffer::<Luma<u8>, _>::new(1002, 753).save(&path).unwrap();
        distances(&path, 1.0, &Camera::from_angle(251, 188, 0.5, DAffine3::IDENTITY)).unwrap();
    }

    #[test]
    fn grey_pixels_in_several_channels_are_depths() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("depth.png");
        let value = |x: u32, y: u32| 1000 * x + 300 * y;
        let wide = |x: u32, y: u32| [value(x, y) as u16; 3];
        let expected: Vec<f64> = (0..6).map(|i| f64::from(value(i % 3, i / 3))).collect();
        ImageBuffer::<Rgb<u16>, _>::from_fn(3, 2, |x, y| Rgb(wide(x, y))).save(&path).unwrap();
        assert_eq!(decoded(&path).unwrap(), ([3, 2], expected.clone()));
        let with_alpha = |x: u32, y: u32| {
            let [r, g, b] = if x == 1 { [5000, 0, 9] } else { wide(x, y) };
            Rgba([r, g, b, if x == 1 { 0 } else { 7 }])
        };
        ImageBuffer::<Rgba<u16>, _>::from_fn(3, 2, with_alpha).save(&path).unwrap();
        let hidden: Vec<f64> = (0..6).map(|i| if i % 3 == 1 { 0.0 } else { expected[i] }).collect();
        assert_eq!(decoded(&path).unwrap().1, hidden, "nothing is measured where it is transparent");
        for alpha in [255, 0] {
            ImageBuffer::<LumaA<u8>, _>::from_fn(3, 2, |x, _| LumaA([x as u8, alpha])).save(&path).unwrap();
            assert_eq!(decoded(&path).unwrap().1, [0.0, 1.0, 2.0, 0.0, 1.0, 2.0], "alpha {alpha}");
        }
        ImageBuffer::<Rgba<u8>, _>::from_pixel(3, 2, Rgba([1, 2, 3, 0])).save(&path).unwrap();
        assert!(decoded(&path).unwrap_err().to_string().contains("has colours"));
    }

    #[test]
    fn depth_file_of_other_form_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let camera = Camera::from_angle(3, 2, 0.1, DAffine3::IDENTITY);
        let fails = |name: &str, expected: &str| {
            let message = distances(&folder.path().join(name), 1.0, &camera).unwrap_err().to_string();
            assert!(message.contains(name) && message.contains(expected), "{message}");
        };
        fails("absent.png", "");
        std::fs::write(folder.path().join("broken.png"), b"x").unwrap();
        fails("broken.png", "cannot be decoded");
        std::fs::write(folder.path().join("0.exr"), [EXR, b"\x02\0\0\0"].concat()).unwrap();
        fails("0.exr", "is EXR, which raygrad does not decode: write depths as PNG of 16 bits or as .npy");
        // The colours of a map, but for one grey pixel.
        let map = |x: u32, y: u32| Rgb(if x + y == 0 { [7; 3] } else { [7, 8, 7] });
        ImageBuffer::<Rgb<u8>, _>::from_fn(3, 2, map).save(folder.path().join("color.png")).unwrap();
        fails("color.png", "has colours, so it is a picture of depths: write the depths themselves, as PNG of one");
        ImageBuffer::<Luma<u8>, _>::new(2, 3).save(folder.path().join("turned.png")).unwrap();
        ImageBuffer::<Luma<u8>, _>::new(9, 3).save(folder.path().join("wide.png")).unwrap();
        fails("turned.png", "has 2x3 depths");
        fails("wide.png", "has 9x3 depths but the image 3x2 pixels; use one aspect ratio");
    }
}
