//! Readers and writers of capture formats: [`blender`], [`transforms`], [`colmap`] and [`llff`].
//!
//! Start with [`read`], which recognises the format. Each module's `read` parses cameras without decoding images; its
//! `write` writes everything but the images.

pub mod blender;
pub mod colmap;
mod frames;
mod intrinsics;
mod json;
mod layers;
mod lens;
mod limits;
pub mod llff;
mod masks;
mod matrix;
mod models;
pub(super) mod npy;
mod paths;
mod ply;
mod points;
pub mod rigid;
pub mod transforms;

use super::capture::Capture;
use crate::error::{Error, Result};
use std::path::Path;

/// Reads the capture in a folder, in whatever format it has.
///
/// If there are several, it takes the first of `transforms.json`, Blender, COLMAP and LLFF: earlier ones hold more, and
/// are usually derived from later ones.
///
/// # Errors
/// If the folder holds none of them, or as the format's own `read`.
pub fn read(folder: &Path) -> Result<Capture> {
    type Known = (fn(&Path) -> bool, fn(&Path) -> Result<Capture>);
    const KNOWN: [Known; 4] = [
        (transforms::detect, transforms::read),
        (blender::detect, blender::read),
        (colmap::detect, colmap::read),
        (llff::detect, llff::read),
    ];
    let known = |folder: &Path| KNOWN.iter().find(|(detect, _)| detect(folder));
    match (known(folder), folder.parent()) {
        (Some((_, read)), _) => read(folder),
        (None, Some(parent)) if known(parent).is_some() => {
            Err(Error::file(folder, format!("is not a dataset, but `{}` is: use that folder", parent.display())))
        }
        (None, _) => Err(Error::file(
            folder,
            "is not a dataset: expected transforms.json (instant-ngp, nerfstudio), transforms_train.json (Blender), \
            sparse/0/cameras.bin or .txt (COLMAP) or poses_bounds.npy (LLFF); `raygrad prepare` makes one from a video or \
            images",
        )),
    }
}

#[cfg(test)]
mod kit;

/// The number of damaged files that a test tries: `PROPTEST_CASES` if it is set, otherwise `short`.
#[cfg(test)]
fn cases(short: u32) -> proptest::prelude::ProptestConfig {
    let cases = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(short);
    proptest::prelude::ProptestConfig { cases, ..Default::default() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::capture::Format;

    #[test]
    fn earlier_formats_have_priority() {
        let folder = tempfile::tempdir().unwrap();
        let message = read(folder.path()).unwrap_err().to_string();
        for expected in ["is not a dataset", "transforms.json", "transforms_train.json", "sparse/0", "poses_bounds.npy"]
        {
            assert!(message.contains(expected), "{message}");
        }
        // Written from the last format to the first: each has priority over the existing ones.
        let capture = kit::picture_with_camera(folder.path());
        llff::write(&capture, folder.path()).unwrap();
        assert_eq!(read(folder.path()).unwrap().format, Format::Llff);
        colmap::write(&capture, folder.path(), colmap::Encoding::Text).unwrap();
        assert_eq!(read(folder.path()).unwrap().format, Format::Colmap);
        blender::write(&capture, folder.path()).unwrap();
        assert_eq!(read(folder.path()).unwrap().format, Format::Blender);
        transforms::write(&capture, folder.path()).unwrap();
        assert_eq!(read(folder.path()).unwrap().format, Format::Transforms);
    }
}
