//! Datasets: images with cameras, read from a folder.
//!
//! Start with [`load`], which recognises the [format](formats). [`Capture::read`] reads only cameras, to be analysed
//! ([`Capture::analyze_scene`]) and loaded ([`Capture::load`]) step by step.

mod average;
pub mod background;
mod background_analysis;
pub(crate) mod batch;
pub mod capture;
pub(crate) mod color_space;
mod depth;
mod downscale;
pub mod formats;
mod frames;
mod hold_out;
pub(crate) mod image;
pub(crate) mod image_size;
mod lens_mask;
pub(crate) mod load;
mod mask;
pub(crate) mod photo;
mod read;
#[cfg(test)]
pub(crate) mod sample;
pub(crate) mod scene_analysis;
pub(crate) mod scene_transform;
pub(crate) mod scene_type;
mod undistort;

pub use self::image::Image;
pub use background::Background;
pub use batch::Batch;
pub use capture::{Capture, Format, Point, View};
pub use color_space::{SrgbDecode, SrgbEncode, srgb_decode, srgb_encode};
pub use depth::Depths;
pub use downscale::{AutomaticDownscale, DownscaleLimit};
pub use frames::{Dataset, Frame, Split, evenly_spaced};
pub use hold_out::HoldOut;
pub use load::LoadOptions;
pub use mask::Mask;
pub use photo::save::{copy_cleared, copy_upright};
pub use photo::unsupported::{ForeignFormat, ForeignImage};
pub use photo::{Exif, ExifLens, Photo};
pub use scene_analysis::{EmptyBackground, SceneAnalysis};
pub use scene_transform::SceneTransform;
pub use scene_type::SceneType;

use std::path::Path;

use crate::error::Result;

/// Reads one split of the dataset in `folder`, with images [averaged](Photo::resized) down by the factor `downscale` (1
/// keeps them).
///
/// It combines [`Capture::read`], [`Capture::analyze_scene`] and [`Capture::load`].
///
/// # Errors
/// As these; every error names the file and the field. Single absent images are not an error: see [`Dataset::skipped`].
pub fn load(folder: impl AsRef<Path>, split: Split, downscale: usize) -> Result<Dataset> {
    let reading = LoadOptions { downscale, ..LoadOptions::default() };
    reading.check()?;
    let capture = Capture::read(folder)?;
    capture.load(split, &capture.analyze_scene(None)?, &reading)
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
        assert_eq!(message, "`split`: is `Train`; use train, val or test");
    }

    #[test]
    fn unknown_formats_name_the_folder() {
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
        fails(&file, "`frames`: is missing");
        fails(folder.path(), "`frames`: is missing");
        let images = folder.path().join("images");
        std::fs::create_dir(&images).unwrap();
        fails(&images, &format!("is not a dataset, but `{}` is: use that folder", folder.path().display()));
    }
}
