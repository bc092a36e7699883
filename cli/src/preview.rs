//! Pictures of one view while a model learns.

use raygrad::nerf::dataset::{Dataset, Frame, Split};
use raygrad::nerf::imaging::metrics::psnr;
use raygrad::nerf::{Camera, Image, Model};

use super::output::complain;
use super::scene::Opened;

/// Longest side of a preview in pixels: it is to be quick.
const LONGEST: usize = 128;

/// A photograph to render again and again.
pub struct Preview {
    /// The photograph's name.
    pub name: String,
    /// The number of the photograph, if it is trained on.
    number: Option<usize>,
    camera: Camera,
    truth: Image,
    background: [f32; 3],
}

impl Preview {
    /// A photograph that is not trained on: of the validation split or else the test split. If there is neither, one
    /// of the training photographs.
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
        // Columns and rows are cut off at the right and at the bottom, where they do not move the principal point.
        let camera = Camera {
            width: truth.width,
            height: truth.height,
            focal: frame.camera.focal.map(|f| f * scale),
            centre: frame.camera.centre.map(|c| c * scale),
            ..frame.camera
        };
        Preview { name: frame.name.clone(), number, camera, truth, background }
    }

    /// Whether the photograph is not trained on.
    pub fn is_held_out(&self) -> bool {
        self.number.is_none()
    }

    /// What the model sees next to the photograph, and its PSNR in dB.
    pub fn show(&self, model: &Model<f32>) -> (Image, f64) {
        // Where the model has found the camera to be, if it looks for it.
        let camera = match self.number {
            Some(number) => model.learned_camera(number, &self.camera),
            None => model.other_camera(&self.camera),
        };
        let color = model.render(&camera, self.background).color;
        (Image::hconcat(&[&color, &self.truth]), psnr(&color, &self.truth))
    }
}

/// The image without the columns and rows at its right and bottom that are no whole multiple of `factor`.
fn cropped_to_multiple(image: &Image, factor: usize) -> Image {
    // A side shorter than the factor is left to be one pixel, repeated.
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
    fn a_preview_sees_what_the_photograph_saw() {
        let frame = &embedded(Split::Val, 300).frames[0];
        let preview = Preview::new(frame, None, [1.0; 3]);
        assert_eq!([preview.truth.width, preview.truth.height], [100, 100]);
        let (large, small) = (frame.camera.ray(30.0, 90.0), preview.camera.ray(10.0, 30.0));
        assert!(large.direction.distance(small.direction) < 1e-12);
    }

    #[test]
    fn odd_sizes_are_cropped() {
        let mut image = Image::new(5, 1, 1);
        image.data = vec![1.0, 2.0, 3.0, 4.0, 5.0];
        let cropped = cropped_to_multiple(&image, 2);
        assert_eq!([cropped.width, cropped.height], [4, 2]);
        assert_eq!(cropped.data, [1.0, 2.0, 3.0, 4.0, 1.0, 2.0, 3.0, 4.0]);
    }
}
