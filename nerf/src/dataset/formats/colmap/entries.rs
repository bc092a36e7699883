//! The entries of COLMAP's files, and where they are.

use super::super::limits::start;
use super::pose;
use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use glam::DAffine3;
use std::path::Path;

/// The position of an entry in a file, for errors.
#[derive(Debug, Clone, Copy)]
pub(super) enum Place {
    /// An entry of a binary file: the list and the index.
    Item(&'static str, usize),
    /// A line of a text file, from 1.
    Line(usize),
}

impl Place {
    pub(super) fn name(self) -> String {
        match self {
            Place::Item(list, index) => format!("{list}[{index}]"),
            Place::Line(line) => format!("line {line}"),
        }
    }

    /// An error about a member of the entry.
    pub(super) fn error(self, file: &Path, member: &str, what: impl ToString) -> Error {
        match self {
            Place::Item(..) => Error::field(file, format!("{}.{member}", self.name()), what),
            Place::Line(_) => Error::field(file, self.name(), format!("{member}: {}", what.to_string())),
        }
    }
}

/// A camera of the file, with the identity as its pose.
pub(super) struct CameraEntry {
    pub(super) place: Place,
    pub(super) id: u32,
    /// An error leaves out the images of this camera.
    pub(super) camera: Result<Camera>,
}

/// An image of the file.
pub(super) struct ImageEntry {
    pub(super) place: Place,
    pub(super) id: u32,
    /// An error leaves out this image.
    pub(super) pose: Result<DAffine3>,
    pub(super) camera: u32,
    pub(super) name: String,
}

impl ImageEntry {
    /// `q` is a quaternion with the real part first.
    pub(super) fn new(
        file: &Path,
        place: Place,
        id: u32,
        q: [f64; 4],
        t: [f64; 3],
        camera: u32,
        name: &str,
    ) -> Result<Self> {
        let pose = pose::from_file(q, t).map_err(|(member, what)| place.error(file, member, what));
        // Models that were made on Windows.
        let name = name.replace('\\', "/");
        let name = name.strip_prefix("./").unwrap_or(&name).to_owned();
        if name.is_empty() {
            return Err(place.error(file, "name", "is empty"));
        }
        if name.chars().any(char::is_control) {
            return Err(place.error(
                file,
                "name",
                format!("`{}` has a control character: rename the image", start(&name)),
            ));
        }
        Ok(ImageEntry { place, id, pose, camera, name })
    }
}
