//! Preview renders of one view during training.

use std::sync::Arc;

use raygrad::nerf::dataset::{Dataset, Frame, Mask, Split};
use raygrad::nerf::imaging::metrics::{psnr_from_mse, weighted_mse};
use raygrad::nerf::{Camera, Image, Model};

use super::output::complain;
use super::scene::Opened;

/// Longest side of a preview in pixels, for speed.
const LONGEST: usize = 128;

/// The image whose view is rendered repeatedly.
pub struct Preview {
    /// The image over the background, and its camera, at the size of the preview.
    frame: Frame,
    /// Index of the image, if it is a training image.
    number: Option<usize>,
    background: [f32; 3],
}

impl Preview {
    /// Chooses a held-out image: of the validation split or else of the test split. Without held-out images, uses a
    /// training image.
    pub fn choose(scene: &Opened, downscale: usize, train: &Dataset, background: [f32; 3]) -> Self {
        // Absent images of these splits are reported when they are evaluated.
        let held_out = scene.load_quietly(Split::Val, downscale, 1);
        let held_out = held_out.or_else(|error| scene.load_quietly(Split::Test, downscale, 1).map_err(|_| error));
        match held_out {
            Ok(data) => Self::new(&data.frames[0], None, background),
            Err(error) => {
                complain(&format!(
                    "warning: previews show a training image, because no held-out image can be used: {error}"
                ));
                Self::new(&train.frames[0], Some(0), background)
            }
        }
    }

    fn new(frame: &Frame, number: Option<usize>, background: [f32; 3]) -> Self {
        let [width, height] = [frame.image.width, frame.image.height];
        let factor = width.max(height).div_ceil(LONGEST);
        let truth = cropped_to_multiple(&frame.image.to_image(), factor).downscaled(factor).over(background);
        let scale = 1.0 / factor as f64;
        // Cropping at the right and at the bottom keeps the principal point.
        let camera = Camera {
            width: truth.width,
            height: truth.height,
            focal: frame.camera.focal.map(|f| f * scale),
            centre: frame.camera.centre.map(|c| c * scale),
            ..frame.camera
        };
        // Pixels that a masked one contributes to are not compared.
        let mask = frame.mask.as_ref().map(|mask| {
            let uses = |x: usize, y: usize| mask.uses(x.min(width - 1), y.min(height - 1));
            let block = |x, y| (0..factor * factor).all(|i| uses(factor * x + i % factor, factor * y + i / factor));
            Arc::new(Mask::new(truth.width, truth.height, block))
        });
        let frame = Frame { name: frame.name.clone(), camera, image: truth.into(), mask, distances: None };
        Preview { frame, number, background }
    }

    /// Returns the name of the image.
    pub fn name(&self) -> &str {
        &self.frame.name
    }

    /// Returns true if the image is held out.
    pub fn is_held_out(&self) -> bool {
        self.number.is_none()
    }

    /// Renders the view beside the image, and returns its PSNR in dB, as `eval` defines it; NaN if no pixel is compared.
    pub fn show(&self, model: &Model<f32>) -> (Image, f64) {
        let Frame { camera, image, .. } = &self.frame;
        // For a training image, the camera with pose refinement.
        let camera = match self.number {
            Some(number) => model.learned_camera(number, camera),
            None => model.other_camera(camera),
        };
        let (color, truth) = (model.render(&camera, self.background).color, image.to_image());
        (Image::hconcat(&[&color, &truth]), self.psnr(&color))
    }

    fn psnr(&self, color: &Image) -> f64 {
        psnr_from_mse(weighted_mse(color, &self.frame.image.to_image(), |x, y| self.frame.weight(x, y)))
    }
}

/// Crops columns at the right and rows at the bottom to a multiple of `factor`.
fn cropped_to_multiple(image: &Image, factor: usize) -> Image {
    // A side shorter than the factor becomes one pixel, by repetition.
    let side = |length: usize| (length / factor).max(1) * factor;
    let mut out = Image::new(side(image.width), side(image.height), image.channels);
    for y in 0..out.height {
        for x in 0..out.width {
            out.pixel_mut(x, y).copy_from_slice(image.pixel(x.min(image.width - 1), y.min(image.height - 1)));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::Lens;
    use raygrad::nerf::glam::DAffine3;
    use raygrad_scenes::embedded;
    use std::f64::consts::PI;

    #[test]
    fn preview_camera_matches_the_image() {
        let frame = &embedded(Split::Val, 300).frames[0];
        let preview = Preview::new(frame, None, [1.0; 3]);
        assert_eq!([preview.frame.image.width, preview.frame.image.height], [100, 100]);
        let (large, small) = (frame.camera.ray(30.0, 90.0), preview.frame.camera.ray(10.0, 30.0));
        assert!(large.direction.distance(small.direction) < 1e-12);
    }

    #[test]
    fn preview_psnr_leaves_out_masked_pixels_and_weights_panoramas() {
        // 260 x 130 pixels become 86 x 43, of 3 x 3 each.
        let image = Image { data: vec![0.5; 260 * 130 * 3], ..Image::new(260, 130, 3) };
        let camera = Camera::from_angle(260, 130, 0.8, DAffine3::IDENTITY);
        let mask = Mask::new(260, 130, |x, y| [x, y] != [31, 61]);
        let mut frame =
            Frame { name: "0".into(), camera, image: image.into(), mask: Some(Arc::new(mask)), distances: None };
        let mut color = Image { data: vec![0.6; 86 * 43 * 3], ..Image::new(86, 43, 3) };
        let psnr = |frame: &Frame, color: &Image| Preview::new(frame, None, [1.0; 3]).psnr(color);
        assert!((psnr(&frame, &color) - 20.0).abs() < 1e-5);
        color.pixel_mut(10, 20).fill(9.0);
        assert!((psnr(&frame, &color) - 20.0).abs() < 1e-5, "the masked pixel counts");
        color.pixel_mut(11, 20).fill(9.0);
        assert!(psnr(&frame, &color) < 19.0, "its neighbour does not");
        // A panorama that is wrong in its first row alone.
        frame.camera = Camera { lens: Lens::Equirectangular, focal: [130.0 / PI; 2], ..frame.camera };
        frame.mask = None;
        color.data.fill(0.5);
        color.data[..3 * 86].fill(0.6);
        let row = |y: usize| ((3.0 * y as f64 + 1.5 - 65.0) / (130.0 / PI)).cos();
        let expected = 0.01 * row(0) / (0..43).map(row).sum::<f64>();
        assert!((psnr(&frame, &color) + 10.0 * expected.log10()).abs() < 1e-4, "{}", psnr(&frame, &color));
    }

    #[test]
    fn crop_odd_size_is_a_multiple() {
        let mut image = Image::new(5, 1, 1);
        image.data = vec![1.0, 2.0, 3.0, 4.0, 5.0];
        let cropped = cropped_to_multiple(&image, 2);
        assert_eq!([cropped.width, cropped.height], [4, 2]);
        assert_eq!(cropped.data, [1.0, 2.0, 3.0, 4.0, 1.0, 2.0, 3.0, 4.0]);
    }
}
