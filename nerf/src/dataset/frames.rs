//! Photographs with their cameras, and the region that they show.

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

/// What the images of a part of a dataset are for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Split {
    /// Images to fit.
    Train,
    /// Images to watch progress and choose settings by.
    Val,
    /// Images to report results on.
    Test,
}

impl Split {
    /// All splits.
    pub const ALL: [Split; 3] = [Split::Train, Split::Val, Split::Test];

    /// The name that files and the command line use: `train`, `val` or `test`.
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
        let wrong = || Error::setting("split", format!("must be train, val or test, is `{text}`"));
        by_name(text).ok_or_else(wrong)
    }
}

/// One photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Its name in the dataset, such as `train/r_0`.
    pub name: String,
    /// The camera that took it, for the size that the image has here.
    pub camera: Camera,
    /// The picture: RGB or RGBA as in the file.
    pub image: Photo,
    /// Which of its pixels are used; all, where there is none.
    pub mask: Option<Arc<Mask>>,
    /// What was measured beside it, if anything, for the term [`depth`](crate::losses::DepthConfig) of the loss: one channel
    /// of the same size, the distance along the ray through each pixel's centre in scene units, and 0 where it is not known.
    pub distances: Option<Image>,
}

/// The photographs of one split, and the region of space that they show.
#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// At least one photograph, in the order of the file.
    pub frames: Vec<Frame>,
    /// Least and greatest corner of an axis-aligned box that holds the scene, in scene units.
    pub bounds: [DVec3; 2],
    /// Distance along a ray, in scene units, before which there is nothing.
    pub near: f64,
    /// Distance along a ray, in scene units, beyond which there is nothing.
    pub far: f64,
    /// How far the scene goes.
    pub scope: SceneType,
    /// What all photographs of the capture show, those of other splits too, where they [look the same way](SceneType::ForwardFacing).
    pub ndc: Option<Ndc>,
    /// From the coordinates of the files to those of the scene, in which everything here is.
    pub placement: SceneTransform,
    /// Names of photographs that the dataset lists but whose image files are absent. They were left out; a caller
    /// should say so.
    pub skipped: Vec<String>,
}

impl Dataset {
    /// How many pixels of the photographs lie side by side along the longest side of the scene's box where they show its middle:
    /// the median over photographs. One that was taken from within the box counts as if its camera stood at its side. Where
    /// all [look the same way](Self::ndc), those are counted that lie across the picture of all they see, at that depth.
    pub fn pixels_per_side(&self) -> f64 {
        let [lower, upper] = self.bounds;
        let (middle, side) = (0.5 * (lower + upper), (upper - lower).max_element());
        let each = self.frames.iter().map(|Frame { camera, .. }| {
            if let Some(ndc) = self.ndc.filter(|_| self.scope == SceneType::ForwardFacing) {
                return ndc.pixels(camera, middle);
            }
            let distance = camera.pose.translation.distance(middle).max(0.5 * side);
            // Of a panorama, a radian is so many pixels.
            let focal = match camera.lens {
                Lens::Equirectangular => camera.width as f64 / std::f64::consts::TAU,
                _ => camera.focal[0].max(camera.focal[1]),
            };
            side * focal / distance
        });
        median(each)
    }

    /// Whether some image has transparency and so needs a [background](crate::dataset::background).
    pub fn has_alpha(&self) -> bool {
        self.frames.iter().any(|frame| frame.image.has_alpha())
    }

    /// Whether [distances](Frame::distances), where there are some, fit their photographs, and there are some if they are
    /// `needed`.
    ///
    /// # Errors
    /// If they are of another size, have several channels, or are no lengths; or are needed and there are none.
    pub fn check_distances(&self, needed: bool) -> Result<()> {
        let mut found = false;
        for Frame { name, image, distances, .. } in &self.frames {
            let Some(distances) = distances else { continue };
            found = true;
            let [own, other] =
                [[image.width, image.height, 1], [distances.width, distances.height, distances.channels]];
            if own != other {
                let what = format!("has distances of {other:?} columns, rows and channels, and not {own:?}");
                return Err(Error::setting(name.clone(), what));
            }
            if let Some(bad) = distances.data.iter().find(|x| !(x.is_finite() && **x >= 0.0)) {
                let what = format!("has the distance {bad}; use lengths in scene units, and 0 where nothing is known");
                return Err(Error::setting(name.clone(), what));
            }
        }
        if needed && !found {
            let what = "one needs photographs with depths that were measured, and there are none: `depth_file_path` of \
                        transforms.json names their files, and a program sets `Frame::distances`";
            return Err(Error::setting("loss_terms", what));
        }
        Ok(())
    }

    /// Whether the photographs show anything of the box `bounds` at all, within which rays are sampled.
    ///
    /// # Errors
    /// If no ray of any photograph meets the box between `near` and `far`: nothing could ever be learned.
    pub fn check_reach(&self, bounds: [DVec3; 2]) -> Result<()> {
        /// Rays that are tried along each side of an image, before all.
        const RAYS: usize = 32;
        let meets = |camera: &Camera, rays: [usize; 2]| camera.meets(bounds, [self.near, self.far], rays);
        let some = self.frames.iter().any(|frame| meets(&frame.camera, [RAYS; 2]));
        // A small box may lie between the rays.
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
        let distances = self.frames.iter().map(|frame| frame.camera.pose.translation.distance(0.5 * (low + high)));
        let mean = distances.sum::<f64>() / self.frames.len().max(1) as f64;
        let what = format!(
            "no ray of the {} photographs meets the box from {low} to {high} between the distances {} and {} from its \
             camera; the cameras are {mean:.3} from its middle on average: scale and move their positions to where the \
             scene lies in the box",
            self.frames.len(),
            self.near,
            self.far
        );
        Err(Error::setting("dataset", what))
    }
}

/// At most `count` of the items, in order and evenly spaced from the first: of `n` items those numbered `i n / count`,
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
    fn footprints_are_pixels_side_by_side_where_photographs_show_the_middle() {
        let mut data = ball(Split::Train, 8);
        data.frames.truncate(3);
        data.bounds = [DVec3::new(-1.0, -2.0, -1.0), DVec3::new(1.0, 2.0, 3.0)];
        // The middle is one above the origin, the longest side 4.
        let camera = |distance: f64| {
            let pose = Camera::look_at(DVec3::new(0.0, 0.0, 1.0 + distance), DVec3::Z, DVec3::Y);
            Camera { focal: [90.0, 100.0], ..Camera::from_angle(75, 50, 0.8, pose) }
        };
        for (frame, distance) in data.frames.iter_mut().zip([8.0, 5.0, 40.0]) {
            frame.camera = camera(distance);
        }
        assert!((data.pixels_per_side() - 4.0 * 100.0 / 8.0).abs() < 1e-9, "{}", data.pixels_per_side());
        // Inside, as from a side.
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
    fn a_small_box_anywhere_in_the_picture_is_found_and_one_beside_it_is_not() {
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
