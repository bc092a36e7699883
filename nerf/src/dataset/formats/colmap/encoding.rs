//! COLMAP's binary and text encodings.

use std::path::{Path, PathBuf};

/// The encoding of COLMAP's files. Both hold the same numbers, bit for bit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// `.bin`, little-endian, COLMAP's default.
    Binary,
    /// `.txt`.
    Text,
}

impl Encoding {
    /// The first has priority if a folder has both.
    pub(super) const ALL: [Encoding; 2] = [Encoding::Binary, Encoding::Text];

    pub(super) fn extension(self) -> &'static str {
        match self {
            Encoding::Binary => "bin",
            Encoding::Text => "txt",
        }
    }

    /// The files of a model in `folder`: cameras, images and points.
    pub(super) fn files(self, folder: &Path) -> [PathBuf; 3] {
        ["cameras", "images", "points3D"].map(|stem| folder.join(stem).with_extension(self.extension()))
    }
}
