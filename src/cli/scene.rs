//! Where photographs come from.

use std::ffi::OsString;
use std::fmt;
use std::path::PathBuf;

use raygrad::nerf::dataset::{Dataset, Split, embedded, evenly_spaced, load_views};
use raygrad::nerf::{Error, Result};
use serde::{Deserialize, Serialize};

use super::output::complain;

/// Width and height of the embedded scene's images in pixels.
const EMBEDDED_SIZE: usize = 200;

/// A folder of photographs, or the scene that needs none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Scene {
    /// The bulldozer that is built in.
    Embedded,
    /// A dataset in this folder.
    Folder(PathBuf),
}

impl From<OsString> for Scene {
    /// `embedded` is the built-in scene (a folder of that name is `./embedded`), anything else a folder.
    fn from(text: OsString) -> Self {
        if text == "embedded" { Scene::Embedded } else { Scene::Folder(text.into()) }
    }
}

impl fmt::Display for Scene {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Scene::Embedded => f.write_str("embedded"),
            Scene::Folder(folder) => folder.display().fmt(f),
        }
    }
}

impl Scene {
    /// At most `views` evenly spaced photographs of a split, at `1 / downscale` of their size. Warns of absent images.
    pub fn load(&self, split: Split, downscale: usize, views: usize) -> Result<Dataset> {
        let data = match self {
            Scene::Embedded if !EMBEDDED_SIZE.is_multiple_of(downscale) => {
                let what = format!("{downscale} does not divide the image size {EMBEDDED_SIZE}x{EMBEDDED_SIZE}");
                return Err(Error::setting("downscale", what));
            }
            Scene::Embedded => {
                let data = embedded(split, EMBEDDED_SIZE / downscale);
                Dataset { frames: evenly_spaced(data.frames, views), ..data }
            }
            Scene::Folder(folder) => load_views(folder, split, downscale, views)?,
        };
        for name in &data.skipped {
            complain(&format!("warning: {self}: the {split} image `{name}` is absent and was skipped"));
        }
        Ok(data)
    }

    /// The same scene, found from any working directory.
    pub fn absolute(&self) -> Result<Scene> {
        match self {
            Scene::Embedded => Ok(Scene::Embedded),
            Scene::Folder(folder) => std::path::absolute(folder).map(Scene::Folder).map_err(|e| Error::file(folder, e)),
        }
    }
}
