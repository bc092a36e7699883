//! The images and masks of a model.

use super::super::locate::locate;
use crate::dataset::capture::Capture;
use crate::error::{Error, Result};
use std::path::{Path, PathBuf};

/// Names of image folders.
const IMAGES: [&str; 4] = ["images", "image", "rgb", "input"];
/// Names of mask folders.
const MASKS: [&str; 2] = ["masks", "mask"];

/// Sets the existing image and mask of each view. `model` is the folder of the model.
///
/// # Errors
/// If two files fit the name of an image.
pub(super) fn attach(capture: &mut Capture, model: &Path) -> Result<()> {
    let root = if model == capture.folder { root(model) } else { capture.folder.clone() };
    let folders = |names: &[&str]| -> Vec<PathBuf> {
        names.iter().map(|name| root.join(name)).filter(|folder| folder.is_dir()).collect()
    };
    // All images come from one folder, since others may hold the same names at another size. Names may also be relative
    // to the folder of the capture.
    let mut images = folders(&IMAGES);
    if model.components().any(|part| part.as_os_str() == "distorted") {
        // 3D Gaussian Splatting keeps undistorted images in `images`, and those of this model in `input`.
        images.reverse();
    }
    images.extend([root.clone(), capture.folder.clone()]);
    let has_any = |folder: &&PathBuf| capture.views.iter().any(|view| folder.join(&view.name).is_file());
    let (folder, below) = match images.iter().find(has_any) {
        Some(folder) => (folder.clone(), ""),
        // Names of a model are relative to its folder of images.
        None => (root.clone(), "images/"),
    };
    let names: Vec<String> = capture.views.iter().map(|view| format!("{below}{}", view.name)).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let found = locate(&folder, &names, &mut capture.assumptions);
    let found = found.map_err(|(i, what)| Error::field(&capture.file, &capture.views[i].field, what))?;
    let masks = folders(&MASKS);
    for (view, image) in capture.views.iter_mut().zip(found) {
        let exists = |path: &PathBuf| path.is_file();
        view.image = image.map(|image| image.path);
        // COLMAP's own naming comes first.
        let names = [PathBuf::from(format!("{}.png", view.name)), Path::new(&view.name).with_extension("png")];
        view.mask = masks.iter().flat_map(|folder| names.iter().map(move |name| folder.join(name))).find(exists);
    }
    Ok(())
}

/// The folder of the capture of a model: that of `sparse` for the model `sparse/0`, also in `colmap` or `distorted`.
pub(in super::super) fn root(model: &Path) -> PathBuf {
    let sparse = model.ancestors().take(2).find(|folder| folder.ends_with("sparse"));
    let Some(parent) = sparse.and_then(Path::parent) else { return model.to_owned() };
    let is_inner = ["colmap", "distorted"].iter().any(|name| parent.ends_with(name));
    parent.parent().filter(|_| is_inner).unwrap_or(parent).to_owned()
}
