//! Measurements of the pixels of one image, from a single read at a small size.

use super::picture::{Picture, grey, hide, is_used};
use crate::dataset::image_size::used_size;
use crate::dataset::photo::sharpness::laplacian_variance;
use crate::dataset::{Capture, Image, Photo, View};
use crate::error::Result;
use crate::memory::available_memory;
use raygrad_tensor::parallel;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::atomic::{AtomicUsize, Ordering};

/// The longest side of the images whose blur is measured: smaller ones are always sharp.
const LONGEST: usize = 800;
/// The longest side of the images that are compared with each other.
const SMALL: usize = 200;
/// The least luminance; darker pixels count as this.
const DARK: f64 = 0.01;

/// Measurements of an image.
pub(super) struct Look {
    /// True if a pixel is transparent; `None` without an alpha channel.
    pub transparent: Option<bool>,
    /// True if alpha is transparent inside an opaque border.
    pub hollow: bool,
    /// True if the colour profile cannot be read.
    pub unread_profile: bool,
    /// Equal for equal images.
    pub hash: u64,
    /// The logarithm of the variance of the Laplacian over the variance of the brightness; `None` of a flat image.
    pub sharpness: Option<f64>,
    /// The mean logarithm of the luminance, weighted by alpha; `None` if the image is nearly all transparent.
    pub luminance: Option<f64>,
    /// The logarithms of red and of blue over green, of the means.
    pub balance: [f64; 2],
    /// The share of the pixels that the mask uses, if there is one.
    pub used: Option<f64>,
    /// The image in grey as a small pinhole camera sees it, if its camera fits.
    pub picture: Option<Picture>,
}

/// Measures all images in parallel; the results have the order of the views.
pub(super) fn look_at_all<'a>(
    capture: &'a Capture,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Vec<(&'a View, Result<Look>)> {
    let views: Vec<&View> = capture.present().collect();
    let (done, total) = (AtomicUsize::new(0), views.len());
    let costs: Vec<u64> = views.iter().map(|view| view.decoding_memory()).collect();
    parallel::collect_within(&costs, available_memory().map_or(u64::MAX, |free| free / 2), |i| {
        let look = look_at(views[i]);
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, total);
        (views[i], look)
    })
}

fn look_at(view: &View) -> Result<Look> {
    let path = view.image.clone().unwrap_or_default();
    let size = used_size(Photo::size_of_file(&path)?, &view.camera);
    let photo = Photo::open(&path, size)?;
    let unread_profile = Photo::has_unread_profile(&path)?;
    let transparent = photo.has_alpha().then(|| photo.transparent_share() > 0.0);
    let hollow = photo.is_hollow();
    let [middle, small] = [LONGEST, SMALL].map(|longest| photo.at_most(longest));
    let mask = view.mask_photo(None)?;
    let used = mask
        .as_ref()
        .map(|mask| mask.pixels().filter(|pixel| is_used(*pixel)).count() as f64 / (mask.width * mask.height) as f64);
    let mut hasher = DefaultHasher::new();
    [photo.width, photo.height].hash(&mut hasher);
    middle.to_image().data.iter().for_each(|value| value.to_bits().hash(&mut hasher));
    let picture = size.and_then(|_| Picture::new(&view.camera, &small, mask.as_ref()));
    let small = used_alone(&small, mask.as_ref());
    let (luminance, balance) = light(&small);
    let mut bright = grey(&middle, mean(&small));
    if let Some(mask) = &mask {
        hide(&mut bright, mask);
    }
    let sharpness = sharpness(&bright);
    let hash = hasher.finish();
    Ok(Look { transparent, hollow, unread_profile, hash, sharpness, luminance, balance, used, picture })
}

/// An image whose pixels are transparent where its mask hides them.
fn used_alone(photo: &Photo, mask: Option<&Photo>) -> Image {
    let image = photo.to_image();
    let Some(mask) = mask else { return image };
    let Image { width, height, channels, .. } = image;
    let pixels = image.data.chunks_exact(channels).enumerate().flat_map(|(i, pixel)| {
        let [x, y] = [i % width * mask.width / width, i / width * mask.height / height];
        let alpha = if is_used(mask.pixel(x, y)) { pixel.get(3).copied().unwrap_or(1.0) } else { 0.0 };
        [pixel[0], pixel[1], pixel[2], alpha]
    });
    Image { channels: 4, data: pixels.collect(), ..image }
}

/// See [`Look::sharpness`].
fn sharpness(grey: &Image) -> Option<f64> {
    let Image { width, height, .. } = *grey;
    if width < 8 || height < 8 {
        return None;
    }
    let edges = laplacian_variance([width, height], |y| grey.data[y * width..(y + 1) * width].to_vec());
    let contrast = variance(grey.data.iter().filter(|x| !x.is_nan()).map(|x| f64::from(*x)));
    (contrast > 1e-6 && edges > 0.0).then(|| (edges / contrast).ln())
}

fn variance(values: impl Iterator<Item = f64>) -> f64 {
    let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
    for value in values {
        (count, sum, squares) = (count + 1.0, sum + value, squares + value * value);
    }
    squares / count - (sum / count) * (sum / count)
}

/// The mean colour, weighted by alpha. Behind transparent pixels it makes no edge that depends on the exposure.
fn mean(image: &Image) -> [f32; 3] {
    let (mut sum, mut weights) = ([0.0; 3], f32::MIN_POSITIVE);
    for pixel in image.data.chunks_exact(image.channels) {
        let alpha = pixel.get(3).copied().unwrap_or(1.0);
        weights += alpha;
        (0..3).for_each(|i| sum[i] += alpha * pixel[i]);
    }
    sum.map(|sum| sum / weights)
}

/// See [`Look::luminance`] and [`Look::balance`]: both are of linear light, weighted by alpha.
fn light(image: &Image) -> (Option<f64>, [f64; 2]) {
    let (mut weights, mut logs, mut means) = (0.0, 0.0, [0.0; 3]);
    for pixel in image.data.chunks_exact(image.channels) {
        let alpha = pixel.get(3).map_or(1.0, |alpha| f64::from(*alpha));
        let rgb = [0, 1, 2].map(|i| f64::from(pixel[i]).powf(2.2));
        weights += alpha;
        logs += alpha * (0.2126 * rgb[0] + 0.7152 * rgb[1] + 0.0722 * rgb[2]).max(DARK).ln();
        (0..3).for_each(|i| means[i] += alpha * rgb[i].max(0.1 * DARK));
    }
    if !(weights > 0.01 * (image.width * image.height) as f64) {
        return (None, [0.0; 2]);
    }
    (Some(logs / weights), [(means[0] / means[1]).ln(), (means[2] / means[1]).ln()])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Camera;

    #[test]
    fn black_pixels_of_dynamic_masks_are_used() {
        let folder = tempfile::tempdir().unwrap();
        let [image, mask] = ["0.png", "dynamic_mask_0.png"].map(|name| folder.path().join(name));
        Image::new(8, 6, 3).save_png(&image).unwrap();
        Image::new(8, 6, 1).save_png(&mask).unwrap();
        let camera = Camera::from_angle(8, 6, 0.7, glam::DAffine3::IDENTITY);
        let mut view = View { image: Some(image), mask: Some(mask), ..View::new("0.png", "frames[0]", camera) };
        assert_eq!(look_at(&view).unwrap().used, Some(0.0));
        view.mask_is_dynamic = true;
        assert_eq!(look_at(&view).unwrap().used, Some(1.0));
    }

    #[test]
    fn sharpness_does_not_change_with_brightness() {
        let wave = |shift: f32| {
            let data =
                (0..40 * 30).map(|i| shift + 0.2 * (0.7 * (i % 40) as f32).sin() + 0.1 * (0.4 * (i / 40) as f32).cos());
            Image { width: 40, height: 30, channels: 1, data: data.collect() }
        };
        let [dark, bright] = [0.3, 0.7].map(|shift| sharpness(&wave(shift)).unwrap());
        assert!((dark - bright).abs() < 1e-4, "{dark} {bright}");
        assert!((variance([1.0, 2.0, 6.0].into_iter()) - 14.0 / 3.0).abs() < 1e-12);
        assert_eq!(sharpness(&Image { width: 4, height: 4, channels: 1, data: vec![0.5; 16] }), None);
    }
}
