//! COLMAP's sparse reconstructions (Schönberger and Frahm 2016): `cameras`, `images` and `points3D`, each a `.bin` or
//! a `.txt` file.
//!
//! Poses are world-to-camera, a quaternion (real part first) and a translation, for a camera that looks along `+z` with
//! `+y` down. Pixel coordinates are those of [`Camera`]. `rigs` and `frames` of version 3.12 and later are not read:
//! image poses are still in `images`.

mod beside;
mod binary;
mod encoding;
mod entries;
mod models;
mod pose;
mod splits;
mod table;
mod text;

use super::limits::{leave_out, start};
use super::points::Points;
use crate::camera::pinhole::Camera;
use crate::dataset::capture::{Capture, Format, View};
use crate::error::{Error, Result};
use crate::files::write_atomic;
use entries::{ImageEntry, Place};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use table::Table;

pub(super) use beside::{root, root_below};
pub use encoding::Encoding;

/// Folders of models within a capture, in the order of the search. In those of `true`, each model has a folder with its
/// number.
const PLACES: [(&str, bool); 5] =
    [("sparse", true), ("sparse", false), ("", false), ("colmap/sparse", true), ("distorted/sparse", true)];

/// The files of images of all models in a capture's folder.
pub(super) fn models(folder: &Path) -> Vec<PathBuf> {
    let mut folders = vec![];
    for (place, is_numbered) in PLACES {
        let place = if place.is_empty() { folder.to_owned() } else { folder.join(place) };
        if !is_numbered {
            folders.push(place);
            continue;
        }
        let names = std::fs::read_dir(&place).into_iter().flatten().flatten().map(|entry| entry.file_name());
        let mut numbers: Vec<u64> = names.filter_map(|name| name.to_str()?.parse().ok()).collect();
        numbers.sort_unstable();
        folders.extend(numbers.into_iter().map(|number| place.join(number.to_string())));
    }
    folders.iter().flat_map(|folder| models_in(folder)).collect()
}

/// The files of images of the models in their own folder: one of each encoding that it holds.
pub(super) fn models_in(folder: &Path) -> Vec<PathBuf> {
    let files = Encoding::ALL.into_iter().map(|encoding| encoding.files(folder));
    files.filter(|[cameras, images, _]| cameras.is_file() && images.is_file()).map(|[_, images, _]| images).collect()
}

/// The file of cameras or images of a model without its own, and the missing one.
pub(super) fn half_a_model_in(folder: &Path) -> Option<[PathBuf; 2]> {
    Encoding::ALL.into_iter().map(|encoding| encoding.files(folder)).find_map(|[cameras, images, _]| {
        match (cameras.is_file(), images.is_file()) {
            (true, false) => Some([cameras, images]),
            (false, true) => Some([images, cameras]),
            _ => None,
        }
    })
}

/// The file of images of the model that a file is part of.
pub(super) fn images_beside(file: &Path) -> Option<PathBuf> {
    let mut files = Encoding::ALL.into_iter().map(|encoding| encoding.files(file.parent().unwrap_or(Path::new(""))));
    files.find(|files| files.iter().any(|other| other == file)).map(|[_, images, _]| images)
}

/// Reads the cameras and points of `folder`, views in the order of their names. No image is decoded. Damaged points are
/// left out, which [`Capture::assumptions`] says.
///
/// # Errors
/// If a file of cameras or images is absent or damaged, an image has no camera, an identifier or name is duplicated, a
/// camera model is not supported, or a number is not finite. The error names the file and the entry or line. Single
/// images with an invalid camera or pose are no error: they are left out with an [assumption](Capture::assumptions).
pub fn read(folder: &Path) -> Result<Capture> {
    let what = "has no COLMAP model: expected cameras.bin and images.bin, or both as .txt, in sparse/0";
    let model = models(folder).into_iter().next().ok_or_else(|| Error::file(folder, what))?;
    read_model(folder, &model, true)
}

/// Reads the model with this file of images. Lists of splits are read only if they are `needed`.
pub(super) fn read_model(folder: &Path, images: &Path, needed: bool) -> Result<Capture> {
    let model = images.parent().unwrap_or(folder);
    let is_own = |encoding: &Encoding| encoding.files(model)[1] == images;
    let encoding = Encoding::ALL.into_iter().find(is_own).unwrap_or(Encoding::Binary);
    let files = encoding.files(model);
    let content = |file: &Path| std::fs::read(file).map_err(|e| Error::file(file, format!("cannot be read: {e}")));
    let [cameras, images, points] = &files;
    // Models with known cameras may have no points.
    let points = points.is_file().then(|| std::fs::read(points));
    let mut capture = parse(folder, encoding, &files, [&content(cameras)?, &content(images)?], points)?;
    beside::attach(&mut capture, model)?;
    if needed {
        splits::attach(&mut capture, model)?;
    }
    Ok(capture)
}

/// Writes the cameras and points of `capture` to `sparse/0` in `folder`, and nerfstudio's lists of splits beside it, if
/// there are splits.
///
/// The caller puts each image in `images` under the name of its view. Views with equal cameras share an entry. Tracks
/// of points are not written.
///
/// # Errors
/// If COLMAP has no model for a camera, or a name or number cannot be written. If the folder holds another model that
/// would be read instead, or a file cannot be written. The error names the view or the file.
pub fn write(capture: &Capture, folder: &Path, encoding: Encoding) -> Result<()> {
    let table = Table::new(capture, encoding)?;
    let (root, folder) = (folder, folder.join("sparse").join("0"));
    let mut others = ["rigs.bin", "frames.bin", "rigs.txt", "frames.txt"].map(|name| folder.join(name)).to_vec();
    Encoding::ALL.iter().filter(|other| **other != encoding).for_each(|other| others.extend(other.files(&folder)));
    if let Some(other) = others.iter().find(|file| file.exists()) {
        return Err(Error::file(other, "belongs to another model in this folder: move that away first"));
    }
    std::fs::create_dir_all(&folder).map_err(|e| Error::file(&folder, format!("cannot be made: {e}")))?;
    let bytes = match encoding {
        Encoding::Binary => binary::encode(&table),
        Encoding::Text => text::encode(&table),
    };
    encoding.files(&folder).iter().zip(bytes).try_for_each(|(file, bytes)| write_atomic(file, &bytes))?;
    splits::write(capture, root)
}

/// Parses the contents of the files, without reading any other file.
fn parse(
    folder: &Path,
    encoding: Encoding,
    files: &[PathBuf; 3],
    [cameras, images]: [&[u8]; 2],
    points: Option<std::io::Result<Vec<u8>>>,
) -> Result<Capture> {
    let [cameras_file, images_file, points_file] = files;
    let (cameras, images) = match encoding {
        Encoding::Binary => (binary::cameras(cameras_file, cameras)?, binary::images(images_file, images)?),
        Encoding::Text => (text::cameras(cameras_file, cameras)?, text::images(images_file, images)?),
    };
    distinct(cameras_file, "camera_id", cameras.iter().map(|entry| (entry.id, entry.place)))?;
    distinct(images_file, "image_id", images.iter().map(|entry| (entry.id, entry.place)))?;
    distinct(images_file, "name", images.iter().map(|entry| (entry.name.as_str(), entry.place)))?;
    if images.is_empty() {
        return Err(Error::field(images_file, "images", "is empty: add at least one image"));
    }
    let cameras: HashMap<u32, Result<Camera>> = cameras.into_iter().map(|entry| (entry.id, entry.camera)).collect();
    let (mut views, mut left_out, mut error) = (vec![], vec![], None);
    for ImageEntry { place, pose, name, camera: id, .. } in images {
        match (pose, cameras.get(&id)) {
            (_, None) => {
                let what = format!("is {id}, but {} has no camera with this id", cameras_file.display());
                return Err(place.error(images_file, "camera_id", what));
            }
            (Ok(pose), Some(Ok(camera))) => {
                views.push(View::new(name, place.name(), Camera { pose, ..camera.clone() }))
            }
            (pose, _) => {
                error = error.or(pose.err());
                left_out.push(name);
            }
        }
    }
    let mut errors: Vec<(u32, Error)> =
        cameras.into_iter().filter_map(|(id, camera)| Some((id, camera.err()?))).collect();
    errors.sort_by_key(|(id, _)| *id);
    let error = error.or_else(|| errors.into_iter().next().map(|(_, error)| error));
    let mut assumptions = vec![];
    let count = left_out.len();
    if let Some(first) = left_out.into_iter().next().zip(error) {
        leave_out(count, views.len(), first, &mut assumptions)?;
    }
    views.sort_by(|a, b| a.name.cmp(&b.name));
    let capture = Capture::new(folder, images_file.clone(), Format::Colmap, views);
    let mut capture = Capture { assumptions, ..capture };
    let points = points.map(|bytes| match (bytes, encoding) {
        (Err(error), _) => Points::unreadable(format!("cannot be read: {error}")),
        (Ok(bytes), Encoding::Binary) => binary::points(points_file, &bytes),
        (Ok(bytes), Encoding::Text) => text::points(points_file, &bytes),
    });
    points.unwrap_or_default().attach(&mut capture, points_file);
    Ok(capture)
}

/// Checks that no two entries of a list have the same key.
fn distinct<K: Eq + std::hash::Hash + std::fmt::Display>(
    file: &Path,
    member: &str,
    entries: impl Iterator<Item = (K, Place)>,
) -> Result<()> {
    let mut seen: HashMap<K, Place> = HashMap::new();
    for (key, place) in entries {
        if let Some(before) = seen.get(&key) {
            return Err(place.error(
                file,
                member,
                format!("is `{}`, as that of {} is", start(&key.to_string()), before.name()),
            ));
        }
        seen.insert(key, place);
    }
    Ok(())
}

#[cfg(test)]
mod tests;
