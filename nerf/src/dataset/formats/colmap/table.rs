//! A capture as the tables that COLMAP's files are.

use super::super::models::Model;
use super::super::rigid;
use super::encoding::Encoding;
use super::models::{self, model_of};
use super::pose;
use crate::camera::pinhole::Camera;
use crate::dataset::capture::{Capture, Point, View};
use crate::error::{Error, Result};
use std::collections::{HashMap, HashSet};

pub(super) struct CameraRow {
    pub id: u32,
    pub model: &'static Model,
    pub size: [u64; 2],
    pub params: Vec<f64>,
}

pub(super) struct ImageRow<'a> {
    pub id: u32,
    /// The quaternion, real part first.
    pub q: [f64; 4],
    pub t: [f64; 3],
    pub camera: u32,
    pub name: &'a str,
}

/// The common content of both encodings.
pub(super) struct Table<'a> {
    pub cameras: Vec<CameraRow>,
    pub images: Vec<ImageRow<'a>>,
    pub points: &'a [Point],
}

impl<'a> Table<'a> {
    /// The table of a capture; or an error that names what COLMAP's files cannot hold.
    pub fn new(capture: &'a Capture, encoding: Encoding) -> Result<Self> {
        if capture.views.is_empty() {
            return Err(Error::file(&capture.file, "has no images to write: add at least one"));
        }
        let (mut cameras, mut ids, mut names) = (vec![], HashMap::new(), HashSet::new());
        let mut images = Vec::with_capacity(capture.views.len());
        for (id, view) in (1_u32..).zip(&capture.views) {
            let bad =
                |member: &str, what: String| Error::field(&capture.file, format!("{}.{member}", view.field), what);
            check_name(view, encoding).map_err(|what| bad("name", what))?;
            if !names.insert(&view.name) {
                return Err(bad("name", format!("`{}` is there twice: rename one", view.name)));
            }
            let row = CameraRow::new(&view.camera).map_err(|what| bad("camera", what))?;
            let key = row.key();
            let camera = *ids.entry(key).or_insert_with(|| {
                let id = cameras.len() as u32 + 1;
                cameras.push(CameraRow { id, ..row });
                id
            });
            rigid::pose(&view.camera.pose).map_err(|what| bad("pose", what))?;
            let (q, t) = pose::to_file(&view.camera.pose);
            pose::from_file(q, t).map_err(|(_, what)| bad("pose", what))?;
            images.push(ImageRow { id, q, t, camera, name: &view.name });
        }
        if let Some(index) = capture.points.iter().position(|p| !p.position.is_finite() || !p.error.is_finite()) {
            return Err(Error::field(
                &capture.file,
                format!("points[{index}]"),
                "has a non-finite number: remove the point",
            ));
        }
        Ok(Table { cameras, images, points: &capture.points })
    }
}

impl CameraRow {
    /// The row of a camera, without its number; or an error message.
    fn new(camera: &Camera) -> std::result::Result<Self, String> {
        let (model, params) = model_of(camera)?;
        let size = [camera.width as u64, camera.height as u64];
        if let Some((name, value)) = models::params(model).zip(&params).find(|(_, value)| !value.is_finite()) {
            return Err(format!("{name}: must be a finite number, is {value}"));
        }
        // The reader's checks: a written camera must be readable.
        models::camera(model, size, &params).map_err(|(member, what)| format!("{member}: {what}"))?;
        Ok(CameraRow { id: 0, model, size, params })
    }

    /// Cameras with equal keys share a row.
    fn key(&self) -> (&'static str, [u64; 2], Vec<u64>) {
        (self.model.name, self.size, self.params.iter().map(|param| param.to_bits()).collect())
    }
}

/// Checks that a written name can be read again.
fn check_name(view: &View, encoding: Encoding) -> std::result::Result<(), String> {
    let name = &view.name;
    if name.is_empty() || name.starts_with("./") || name.contains(char::is_control) || name.trim() != name {
        return Err(format!("{name:?} is not a valid image name: rename the file"));
    }
    // raygrad could read it, but COLMAP ends a name at its first space.
    if encoding == Encoding::Text && name.contains(char::is_whitespace) {
        return Err(format!("`{name}` has a space, which COLMAP's text files do not support: write binary files"));
    }
    Ok(())
}
