//! Photographs with camera poses, read from a folder.
//!
//! Each format has a file of its own here, and [`load`] recognises which one a folder holds.

pub mod background;
pub(crate) mod batch;
mod blender;
pub(crate) mod color_space;
mod embedded;
pub(crate) mod image;
pub mod scene;

pub use self::image::Image;
pub use background::Background;
pub use color_space::{SrgbDecode, SrgbEncode, srgb_decode, srgb_encode};
pub use embedded::embedded;

use std::fmt;
use std::path::Path;
use std::str::FromStr;

use glam::DVec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::camera::bounds::clip_span;
use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};

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
        let named = Split::ALL.into_iter().find(|split| split.name() == text);
        named.ok_or_else(|| Error::setting("split", format!("must be train, val or test, is `{text}`")))
    }
}

/// One photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Its name in the dataset, such as `train/r_0`.
    pub name: String,
    /// The camera that took it, for the size that the image has here.
    pub camera: Camera,
    /// The picture: RGB or RGBA as in the file, values in 0..=1.
    pub image: Image,
}

/// The photographs of one split, all of one size, and the region of space that they show.
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
    /// Names of photographs that the dataset lists but whose image files are absent. They were left out; a caller
    /// should say so.
    pub skipped: Vec<String>,
}

impl Dataset {
    /// Whether some image has transparency and so needs a [background](crate::dataset::background).
    pub fn has_alpha(&self) -> bool {
        self.frames.iter().any(|frame| frame.image.channels == 4)
    }

    /// Whether the photographs show anything of the scene's box at all.
    ///
    /// # Errors
    /// If no ray of any photograph meets the box between `near` and `far`: nothing could ever be learned.
    pub fn check_reach(&self) -> Result<()> {
        /// Rays that are tried along each side of an image, before all.
        const RAYS: usize = 32;
        let meets = |camera: &Camera, [columns, rows]: [usize; 2]| {
            let place = |i: usize, n: usize, size: usize| (i as f64 + 0.5) / n as f64 * size as f64;
            (0..columns * rows).any(|i| {
                let [x, y] = [place(i % columns, columns, camera.width), place(i / columns, rows, camera.height)];
                let [enter, leave] = clip_span(&camera.ray(x, y), self.bounds, [self.near, self.far]);
                enter < leave
            })
        };
        let some = self.frames.iter().any(|frame| meets(&frame.camera, [RAYS; 2]));
        // A small box may lie between the rays.
        if some || self.frames.par_iter().any(|Frame { camera, .. }| meets(camera, [camera.width, camera.height])) {
            return Ok(());
        }
        let [low, high] = self.bounds;
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

/// Reads one split of the dataset in `folder`, its images [averaged](Image::downscaled) down by the integer factor
/// `downscale` (1 keeps them).
///
/// Recognised is the NeRF-synthetic format: `transforms_train.json`, `transforms_val.json`, `transforms_test.json`,
/// written by Blender. Its scenes lie within +-1.5 of the origin, between distances 2 and 6 of the cameras.
///
/// # Errors
/// If the folder is absent or of no known format, lacks the split, has a file with a bad field or an image that cannot
/// be decoded or differs in size from the others, or if no image is left; if `downscale` is 0 or does not divide the
/// width and the height. Every error names the file and the field. A single absent image is no error: see
/// [`Dataset::skipped`].
pub fn load(folder: impl AsRef<Path>, split: Split, downscale: usize) -> Result<Dataset> {
    load_views(folder, split, downscale, usize::MAX)
}

/// As [`load`], but reads only `views` [evenly spaced](evenly_spaced) photographs of those that exist.
///
/// # Errors
/// As [`load`], where photographs that are not read cannot be at fault; if `views` is 0.
pub fn load_views(folder: impl AsRef<Path>, split: Split, downscale: usize, views: usize) -> Result<Dataset> {
    let folder = folder.as_ref();
    if views == 0 {
        return Err(Error::setting("views", "must be 1 or more, is 0"));
    }
    if downscale == 0 {
        return Err(Error::setting("downscale", "must be 1 or more, is 0"));
    }
    if !folder.is_dir() {
        let what = if folder.exists() { "is not a folder" } else { "there is no such folder" };
        return Err(Error::file(folder, what));
    }
    if Split::ALL.into_iter().any(|split| blender::transforms_file(folder, split).is_file()) {
        return blender::load(folder, split, downscale, views);
    }
    let what = match folder.join("transforms.json").is_file() {
        true => "is in the format of instant-ngp and nerfstudio (transforms.json), whose cameras are not supported yet",
        false => "is not a dataset: expected a file transforms_train.json, transforms_val.json or transforms_test.json",
    };
    Err(Error::file(folder, what))
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

    #[test]
    fn evenly_spaced_items_start_with_the_first() {
        let of_ten = |count| evenly_spaced((0..10).collect(), count);
        assert_eq!(of_ten(3), [0, 3, 6]);
        assert_eq!(of_ten(5), [0, 2, 4, 6, 8]);
        assert_eq!(of_ten(1), [0]);
        assert!(of_ten(0).is_empty());
        assert_eq!(of_ten(11), of_ten(10));
        assert_eq!(of_ten(10).len(), 10);
    }

    #[test]
    fn split_names_round_trip() {
        for split in Split::ALL {
            assert_eq!(split.to_string().parse::<Split>().unwrap(), split);
            assert_eq!(serde_json::to_string(&split).unwrap(), format!("\"{split}\""));
        }
        let message = "Train".parse::<Split>().unwrap_err().to_string();
        assert_eq!(message, "`split`: must be train, val or test, is `Train`");
    }

    #[test]
    fn folders_of_no_known_format_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let fails = |path: &Path, expected: &str| {
            let message = load(path, Split::Train, 1).unwrap_err().to_string();
            assert!(message.contains(&path.display().to_string()) && message.contains(expected), "{message}");
            assert!(!message.contains('\n'), "{message}");
        };
        fails(&folder.path().join("absent"), "there is no such folder");
        fails(folder.path(), "is not a dataset");
        let file = folder.path().join("transforms.json");
        std::fs::write(&file, "{}").unwrap();
        fails(&file, "is not a folder");
        fails(folder.path(), "instant-ngp");
    }

    #[test]
    fn a_downscale_of_zero_is_named() {
        let message = load(".", Split::Train, 0).unwrap_err().to_string();
        assert_eq!(message, "`downscale`: must be 1 or more, is 0");
    }
}
