//! Captures: cameras and image paths, before any pixel is read.

use super::Split;
use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use glam::{DAffine3, DVec3};
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// The file format of a capture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// NeRF-synthetic: `transforms_train.json`, `.._val.json`, `.._test.json`, written by Blender (Mildenhall et al.
    /// 2020).
    Blender,
    /// `transforms.json` of instant-ngp and nerfstudio.
    Transforms,
    /// COLMAP's `sparse/0`, binary or text.
    Colmap,
    /// `poses_bounds.npy` of LLFF (Mildenhall et al. 2019).
    Llff,
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Format::Blender => "Blender",
            Format::Transforms => "transforms.json",
            Format::Colmap => "COLMAP",
            Format::Llff => "LLFF",
        })
    }
}

impl Format {
    /// All formats.
    pub const ALL: [Format; 4] = [Format::Transforms, Format::Blender, Format::Colmap, Format::Llff];

    /// The word that [`from_str`](Self::from_str) reads: `transforms`, `blender`, `colmap` or `llff`.
    pub fn word(self) -> &'static str {
        match self {
            Format::Transforms => "transforms",
            Format::Blender => "blender",
            Format::Colmap => "colmap",
            Format::Llff => "llff",
        }
    }
}

impl FromStr for Format {
    type Err = Error;

    /// Reads a [word](Self::word).
    fn from_str(text: &str) -> Result<Self> {
        let found = Format::ALL.into_iter().find(|format| format.word() == text);
        let wrong = || Error::setting("format", format!("is `{text}`; use transforms, blender, colmap or llff"));
        found.ok_or_else(wrong)
    }
}

/// A capture as its files describe it. Cameras and points are in the capture's own coordinates.
#[derive(Debug, Clone, PartialEq)]
pub struct Capture {
    /// The folder.
    pub folder: PathBuf,
    /// The file with the cameras, which errors name.
    pub file: PathBuf,
    /// The file format.
    pub format: Format,
    /// The images in the order of the file, including those whose file does not exist.
    pub views: Vec<View>,
    /// Sparse points of the scene; may be empty.
    pub points: Vec<Point>,
    /// The file of the points, if there is one.
    pub points_file: Option<PathBuf>,
    /// instant-ngp's `aabb_scale`, if given: the side of its scene box, in sides of its unit cube. It is kept for
    /// export, and does not affect raygrad's own box.
    pub aabb_scale: Option<f64>,
    /// The transform that was applied to the original (COLMAP) coordinates: nerfstudio's `applied_transform` and
    /// `applied_scale`. The identity if not given.
    pub applied: DAffine3,
    /// Assumptions of the reader where the files are unclear, one sentence each without a full stop; callers should
    /// report them.
    pub assumptions: Vec<String>,
}

impl Capture {
    /// Creates a capture of these images, without points.
    pub fn new(folder: &Path, file: PathBuf, format: Format, views: Vec<View>) -> Self {
        Capture {
            folder: folder.to_owned(),
            file,
            format,
            views,
            points: vec![],
            points_file: None,
            aabb_scale: None,
            applied: DAffine3::IDENTITY,
            assumptions: vec![],
        }
    }
}

/// An image of a capture, not yet read.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// The name: the image path as in the file, without a leading `./`.
    pub name: String,
    /// The entry in the file, for errors: `frames[3]` or `image 17`.
    pub field: String,
    /// The image file, if it exists.
    pub image: Option<PathBuf>,
    /// The camera, for the image size in the file; width and height are 0 if it gives none.
    pub camera: Camera,
    /// The split, if the file gives it.
    pub split: Option<Split>,
    /// The mask file, if there is one: black where pixels are not used.
    pub mask: Option<PathBuf>,
    /// Whether the mask is a dynamic mask of instant-ngp: black where pixels are used. Such masks cut out no object.
    pub mask_is_dynamic: bool,
    /// A depth file (along the optical axis), and the length of its unit in units of the capture.
    pub depth: Option<(PathBuf, f64)>,
    /// The sharpness in the file, in the writing program's unit; more is sharper.
    pub sharpness: Option<f64>,
    /// The nearest and farthest depth of visible points, if the file gives them, in units of the capture.
    pub bounds: Option<[f64; 2]>,
}

impl View {
    /// Creates a view with a name, an entry for errors and a camera, and nothing else.
    pub fn new(name: impl Into<String>, field: impl Into<String>, camera: Camera) -> Self {
        let (image, split, mask, depth, sharpness, bounds) = (None, None, None, None, None, None);
        let (name, field, mask_is_dynamic) = (name.into(), field.into(), false);
        View { name, field, image, camera, split, mask, mask_is_dynamic, depth, sharpness, bounds }
    }
}

/// A sparse point of the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// The position, in the capture's coordinates.
    pub position: DVec3,
    /// The colour, RGB.
    pub color: [u8; 3],
    /// The mean reprojection error in pixels.
    pub error: f64,
    /// Number of images that show it.
    pub views: u32,
}
