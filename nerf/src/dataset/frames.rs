//! Images with cameras, and the region of the scene that they show.

use super::image::Image;
use super::mask::Mask;
use super::photo::Photo;
use super::scene_transform::SceneTransform;
use super::scene_type::SceneType;
use crate::camera::Ndc;
use crate::camera::lens::Lens;
use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use crate::numbers::median;
use crate::range::by_name;
use glam::DVec3;
use raygrad_tensor::parallel;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// A remedy for wrong splits.
pub(super) const CHOOSE: &str = "`raygrad train --test` chooses other test images";

/// The split of a dataset: training, validation or test.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// Images to train on.
    Train,
    /// Images to validate progress and choose settings.
    Val,
    /// Images to report results on.
    Test,
}

impl Split {
    /// All splits.
    pub const ALL: [Split; 3] = [Split::Train, Split::Val, Split::Test];

    /// Returns the name in files and on the command line: `train`, `val` or `test`.
    pub fn name(self) -> &'static str {
        match self {
            Split::Train => "train",
            Split::Val => "val",
            Split::Test => "test",
        }
    }
}

impl fmt::Display for Split {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Split {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let wrong = || Error::setting("split", format!("is `{text}`; use train, val or test"));
        by_name(text).ok_or_else(wrong)
    }
}

/// An image with its camera.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// The name in the dataset, such as `train/r_0`.
    pub name: String,
    /// The camera, for the size of `image`.
    pub camera: Camera,
    /// The pixels: RGB or RGBA as in the file.
    pub image: Photo,
    /// The mask of used pixels; `None` uses all.
    pub mask: Option<Arc<Mask>>,
    /// Measured distances for the [depth loss](crate::losses::DepthConfig): one channel of the same size, along the ray
    /// through each pixel's centre, in scene units; 0 where unknown.
    pub distances: Option<Image>,
}

impl Frame {
    /// Returns the number of pixels that training and evaluation use.
    pub fn used(&self) -> usize {
        self.mask.as_ref().map_or(self.image.width * self.image.height, |mask| mask.used())
    }

    /// Returns the weight of a pixel in training and evaluation: 0 if it is masked, else its
    /// [solid angle](Camera::row_weight).
    ///
    /// # Panics
    /// If a mask is given and the pixel lies outside of it.
    pub fn weight(&self, x: usize, y: usize) -> f64 {
        let is_used = self.mask.as_ref().is_none_or(|mask| mask.uses(x, y));
        if is_used { self.camera.row_weight(y) } else { 0.0 }
    }
}

/// The images of one split, with the scene box, near and far plane.
#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// The images, at least one, in the order of the file.
    pub frames: Vec<Frame>,
    /// Lower and upper corner of the scene box, in scene units.
    pub bounds: [DVec3; 2],
    /// Near plane: distance along a ray, in scene units.
    pub near: f64,
    /// Far plane: distance along a ray, in scene units.
    pub far: f64,
    /// Bounded, unbounded or forward-facing.
    pub scene_type: SceneType,
    /// The NDC frustum of all images of the capture, other splits included, if it is
    /// [forward-facing](SceneType::ForwardFacing).
    pub ndc: Option<Ndc>,
    /// The transform from the files' coordinates to those of the scene, which all fields use.
    pub transform: SceneTransform,
    /// Names of listed images whose files do not exist. They were left out; callers should report them.
    pub skipped: Vec<String>,
    /// Names of images of which the [mask](Frame::mask) uses no pixel. They were left out; callers should report them.
    pub masked: Vec<String>,
}

impl Dataset {
    /// Returns the number of pixels along the longest side of the scene box, seen at its centre: the median over
    /// images.
    ///
    /// A camera inside the box counts as if it stood at its side. For a forward-facing scene it counts the pixels
    /// across the [NDC frustum](Self::ndc) at that depth.
    pub fn pixels_per_side(&self) -> f64 {
        let ndc = self.ndc.filter(|_| self.scene_type == SceneType::ForwardFacing);
        median(self.frames.iter().map(|frame| pixels_across(&frame.camera, self.bounds, ndc)))
    }

    /// Returns whether an image has an alpha channel and so needs a [background](crate::dataset::background).
    pub fn has_alpha(&self) -> bool {
        self.frames.iter().any(|frame| frame.image.has_alpha())
    }

    /// Checks the [distances](Frame::distances) of all images; with `needed`, at least one image must have some.
    ///
    /// # Errors
    /// If distances have another size than their image or several channels, if one is negative or not finite, or if
    /// they are needed and missing.
    pub fn check_distances(&self, needed: bool) -> Result<()> {
        let mut found = false;
        for Frame { name, image, distances, .. } in &self.frames {
            let Some(distances) = distances else { continue };
            found = true;
            let [own, other] =
                [[image.width, image.height, 1], [distances.width, distances.height, distances.channels]];
            if own != other {
                let what = format!("has distances of shape {other:?} (columns, rows, channels); use {own:?}");
                return Err(Error::setting(name.clone(), what));
            }
            if let Some(bad) = distances.data.iter().find(|x| !(x.is_finite() && **x >= 0.0)) {
                let what = format!("has the distance {bad}; use lengths in scene units, and 0 where unknown");
                return Err(Error::setting(name.clone(), what));
            }
        }
        if needed && !found {
            let what = "a term needs measured depths, but no image has any; name the files in `depth_file_path` of \
            transforms.json, or set `Frame::distances`";
            return Err(Error::setting("loss_terms", what));
        }
        Ok(())
    }

    /// Checks that the images show a part of the box `bounds`, within which rays are sampled.
    ///
    /// # Errors
    /// If no ray of any image meets the box between `near` and `far`, so that nothing could be learned.
    pub fn check_reach(&self, bounds: [DVec3; 2]) -> Result<()> {
        /// Rays along each side of an image in the first, coarse test.
        const RAYS: usize = 32;
        let meets = |camera: &Camera, rays: [usize; 2]| camera.meets(bounds, [self.near, self.far], rays);
        let some = self.frames.iter().any(|frame| meets(&frame.camera, [RAYS; 2]));
        // A small box may lie between the coarse rays.
        let found = AtomicBool::new(some);
        parallel::each_of(&self.frames, |_, Frame { camera, .. }| {
            if !found.load(Ordering::Relaxed) && meets(camera, [camera.width, camera.height]) {
                found.store(true, Ordering::Relaxed);
            }
        });
        if found.into_inner() {
            return Ok(());
        }
        let [low, high] = bounds;
        let offsets =
            self.frames.iter().map(|Frame { camera, .. }| (0.5 * (low + high) - camera.pose.translation, camera));
        let mean = offsets.clone().map(|(offset, _)| offset.length()).sum::<f64>() / self.frames.len().max(1) as f64;
        let away = offsets.filter(|(offset, camera)| offset.dot(camera.pose.matrix3.z_axis) > 0.0).count();
        let advice = match 2 * away > self.frames.len() {
            true => {
                "most cameras look away from it: for matrices with OpenCV's axes, negate the second and third columns"
            }
            false => "scale and move their positions so that the box holds the scene",
        };
        let what = format!(
            "no ray of the {} images meets the box from {low} to {high} between the near plane {} and the far plane {}; \
            the cameras are {mean:.3} from its centre on average: {advice}; `raygrad doctor` checks the poses",
            self.frames.len(),
            self.near,
            self.far
        );
        Err(Error::setting("dataset", what))
    }
}

/// The pixels of a camera along the longest side of the box `bounds`, at its centre, or across the NDC frustum there.
pub(super) fn pixels_across(camera: &Camera, bounds: [DVec3; 2], ndc: Option<Ndc>) -> f64 {
    let [lower, upper] = bounds;
    let (middle, side) = (0.5 * (lower + upper), (upper - lower).max_element());
    if let Some(ndc) = ndc {
        return ndc.pixels(camera, middle);
    }
    let distance = camera.pose.translation.distance(middle).max(0.5 * side);
    // The pixels per radian of a panorama.
    let focal = match camera.lens {
        Lens::Equirectangular => camera.width as f64 / std::f64::consts::TAU,
        _ => camera.focal[0].max(camera.focal[1]),
    };
    side * focal / distance
}

/// Returns at most `count` of the items, in order and evenly spaced: of `n` items those with index `i n / count`,
/// rounded down.
pub fn evenly_spaced<T>(items: Vec<T>, count: usize) -> Vec<T> {
    let (n, count) = (items.len(), count.min(items.len()));
    let mut wanted = (0..count).map(|i| i * n / count).peekable();
    items.into_iter().enumerate().filter(|(i, _)| wanted.next_if_eq(i).is_some()).map(|(_, item)| item).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::sample::ball;

    #[test]
    fn pixels_per_side_counts_pixels_at_the_centre() {
        let mut data = ball(Split::Train, 8);
        data.frames.truncate(3);
        data.bounds = [DVec3::new(-1.0, -2.0, -1.0), DVec3::new(1.0, 2.0, 3.0)];
        // The centre is 1 above the origin; the longest side is 4.
        let camera = |distance: f64| {
            let pose = Camera::look_at(DVec3::new(0.0, 0.0, 1.0 + distance), DVec3::Z, DVec3::Y);
            Camera { focal: [90.0, 100.0], ..Camera::from_angle(75, 50, 0.8, pose) }
        };
        for (frame, distance) in data.frames.iter_mut().zip([8.0, 5.0, 40.0]) {
            frame.camera = camera(distance);
        }
        assert!((data.pixels_per_side() - 4.0 * 100.0 / 8.0).abs() < 1e-9, "{}", data.pixels_per_side());
        // From inside of the box as well.
        data.frames.iter_mut().for_each(|frame| frame.camera = camera(0.5));
        assert!((data.pixels_per_side() - 200.0).abs() < 1e-9, "{}", data.pixels_per_side());
        data.frames.iter_mut().for_each(|frame| frame.camera.lens = Lens::Equirectangular);
        assert!(
            (data.pixels_per_side() - 2.0 * 75.0 / std::f64::consts::TAU).abs() < 1e-9,
            "{}",
            data.pixels_per_side()
        );
    }

    #[test]
    fn small_box_is_found_anywhere_in_the_image() {
        let mut data = ball(Split::Train, 8);
        data.frames.truncate(1);
        let pose = Camera::look_at(DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO, DVec3::Y);
        data.frames[0].camera = Camera::from_angle(75, 50, 0.8, pose);
        let found = |x: f64, y: f64| {
            let middle = DVec3::new(x, y, 0.0);
            data.check_reach([middle - 0.03, middle + 0.03]).is_ok()
        };
        for (x, y) in [(0.0, 0.0), (1.5, 0.3), (-1.5, 0.9), (0.4, -1.0), (1.55, -1.05), (-0.2, 1.05)] {
            assert!(found(x, y), "{x} {y}");
        }
        assert!(!found(1.9, 0.0) && !found(0.0, 1.4) && !found(-1.9, -1.3));
    }
}
