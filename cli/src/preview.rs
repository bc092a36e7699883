//! Preview renders of one view during training.

use raygrad::nerf::dataset::{Dataset, Frame, Split};
use raygrad::nerf::imaging::metrics::psnr;
use raygrad::nerf::{Camera, Image, Model};

use super::output::complain;
use super::scene::Opened;

/// Longest side of a preview in pixels, for speed.
const LONGEST: usize = 128;

/// The image whose view is rendered repeatedly.
pub struct Preview {
    /// Name of the image.
    pub name: String,
    /// Index of the image, if it is a training image.
    number: Option<usize>,
    camera: Camera,
    truth: Image,
    background: [f32; 3],
}

impl Preview {
    /// Chooses a held-out image: of the validation split or else of the test split. Without held-out images, uses a
    /// training image.
    pub fn choose(scene: &Opened, downscale: usize, train: &Dataset, background: [f32; 3]) -> Self {
        let held_out = scene.load(Split::Val, downscale, 1);
        let held_out = held_out.or_else(|error| scene.load(Split::Test, downscale, 1).map_err(|_| error));
        match held_out {
            Ok(data) => Self::new(&data.frames[0], None, background),
            Err(error) => {
                complain(&format!("warning: previews show a training image, because no image is held out: {error}"));
                Self::new(&train.frames[0], Some(0), background)
            }
        }
    }

    fn new(frame: &Frame, number: Option<usize>, background: [f32; 3]) -> Self {
        let factor = frame.image.width.max(frame.image.height).div_ceil(LONGEST);
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
        Preview { name: frame.name.clone(), number, camera, truth, background }
    }

    /// Returns true if the image is held out.
    pub fn is_held_out(&self) -> bool {
        self.number.is_none()
    }

    /// Renders the view beside the image, and returns its PSNR in dB.
    pub fn show(&self, model: &Model<f32>) -> (Image, f64) {
        // For a training image, the camera with pose refinement.
        let camera = match self.number {
            Some(number) => model.learned_camera(number, &self.camera),
            None => model.other_camera(&self.camera),
        };
        let color = model.render(&camera, self.background).color;
        (Image::hconcat(&[&color, &self.truth]), psnr(&color, &self.truth))
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
    use raygrad_scenes::embedded;

    #[test]
    fn preview_camera_matches_the_image() {
        let frame = &embedded(Split::Val, 300).frames[0];
        let preview = Preview::new(frame, None, [1.0; 3]);
        assert_eq!([preview.truth.width, preview.truth.height], [100, 100]);
        let (large, small) = (frame.camera.ray(30.0, 90.0), preview.camera.ray(10.0, 30.0));
        assert!(large.direction.distance(small.direction) < 1e-12);
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
