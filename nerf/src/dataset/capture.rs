//! A capture as its files describe it: cameras and where their images are, before any pixel is read.

use super::Split;
use crate::camera::pinhole::Camera;
use glam::{DAffine3, DVec3};
use std::fmt;
use std::path::{Path, PathBuf};

/// A way to write cameras and images to a folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// NeRF-synthetic: `transforms_train.json` and its like, written by Blender (Mildenhall et al. 2020).
    Blender,
    /// `transforms.json` of instant-ngp and nerfstudio.
    Transforms,
    /// COLMAP's `sparse/0`, binary or text.
    Colmap,
    /// `poses_bounds.npy` of local light field fusion (Mildenhall et al. 2019).
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

/// What the files of a capture say. Cameras and points are in the capture's own coordinates.
#[derive(Debug, Clone, PartialEq)]
pub struct Capture {
    /// The folder.
    pub folder: PathBuf,
    /// The file that holds the cameras: errors name it.
    pub file: PathBuf,
    /// How it is written.
    pub format: Format,
    /// Photographs, in the order of the file; those whose image is absent too.
    pub views: Vec<View>,
    /// Points of the scene that were found when its cameras were, if there are any.
    pub points: Vec<Point>,
    /// The file that they were read from, if there is one.
    pub points_file: Option<PathBuf>,
    /// Half the side of the box that holds the scene, in units of instant-ngp's unit cube, if the file says so
    /// (`aabb_scale`).
    pub aabb_scale: Option<f64>,
    /// From coordinates of before (COLMAP's) to those of this file (nerfstudio's `applied_transform` and `applied_scale`);
    /// the identity where nothing is said.
    pub applied: DAffine3,
}

impl Capture {
    /// These photographs, and nothing else.
    pub fn new(folder: &Path, file: PathBuf, format: Format, views: Vec<View>) -> Self {
        let (points, points_file, aabb_scale, applied) = (vec![], None, None, DAffine3::IDENTITY);
        Capture { folder: folder.to_owned(), file, format, views, points, points_file, aabb_scale, applied }
    }
}

/// One photograph, not yet read.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// Its name: the path of its image as the file has it, without a leading `./`.
    pub name: String,
    /// Where the file speaks of it, for errors: `frames[3]`, or `image 17` where there are no names.
    pub field: String,
    /// Its image, if that exists.
    pub image: Option<PathBuf>,
    /// The camera, for an image of the size that the file speaks of; width and height are 0 where it speaks of none.
    pub camera: Camera,
    /// The split that the file puts it in, if it says.
    pub split: Option<Split>,
    /// An image that is black where the photograph is not to be used.
    pub mask: Option<PathBuf>,
    /// A file of depths along the optical axis, and the length of one of its units in those of the capture.
    pub depth: Option<(PathBuf, f64)>,
    /// How sharp the photograph is, in a unit of the program that wrote the file; more is sharper.
    pub sharpness: Option<f64>,
    /// The nearest and farthest depth of points that it shows, if the file says.
    pub bounds: Option<[f64; 2]>,
}

impl View {
    /// A photograph of which nothing is known but its name, where the file speaks of it, and its camera.
    pub fn new(name: impl Into<String>, field: impl Into<String>, camera: Camera) -> Self {
        let (image, split, mask, depth, sharpness, bounds) = (None, None, None, None, None, None);
        View { name: name.into(), field: field.into(), image, camera, split, mask, depth, sharpness, bounds }
    }
}

/// A point of the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Where it is.
    pub position: DVec3,
    /// Its colour.
    pub color: [u8; 3],
    /// How far, in pixels on average, it is from where the photographs show it.
    pub error: f64,
    /// How many photographs show it.
    pub views: u32,
}
