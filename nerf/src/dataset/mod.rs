//! Photographs with camera poses, read from a folder.
//!
//! Each format has a file of its own here, and [`load`] recognises which one a folder holds.

pub mod background;
pub(crate) mod batch;
mod blender;
pub mod capture;
pub(crate) mod color_space;
mod embedded;
mod frames;
pub(crate) mod image;
pub mod scene;

pub use self::image::Image;
pub use background::Background;
pub use batch::Batch;
pub use color_space::{SrgbDecode, SrgbEncode, srgb_decode, srgb_encode};
pub use embedded::embedded;
pub use frames::{Dataset, Frame, Split, evenly_spaced};

use std::path::Path;

use crate::error::{Error, Result};

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
