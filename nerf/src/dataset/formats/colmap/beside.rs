//! The images and masks of a model.

use crate::dataset::capture::Capture;
use crate::dataset::formats::masks;
use std::path::{Path, PathBuf};

/// Names of image folders.
const IMAGES: [&str; 4] = ["images", "image", "rgb", "input"];

/// Sets the existing image and mask of each view. `model` is the folder of the model.
pub(super) fn attach(capture: &mut Capture, model: &Path) {
    let mut roots = vec![capture.folder.clone()];
    if model == capture.folder {
        // The capture's folder may be `sparse` or `sparse/0` itself.
        roots.extend([model.join(".."), model.join("..").join("..")]);
    }
    let folders = roots.iter().flat_map(|root| IMAGES.map(|name| root.join(name)));
    let mut images: Vec<PathBuf> = folders.filter(|folder| folder.is_dir()).collect();
    // All images come from one folder, since others may hold the same names at another size. Names may also be relative
    // to the folder of the capture.
    images.push(capture.folder.clone());
    let has_any = |folder: &&PathBuf| capture.views.iter().any(|view| folder.join(&view.name).is_file());
    let images = images.iter().find(has_any).cloned();
    for view in &mut capture.views {
        view.image = images.as_ref().map(|folder| folder.join(&view.name)).filter(|path| path.is_file());
    }
    masks::attach(capture, &roots);
}
