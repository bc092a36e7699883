//! The images and masks of a model.

use crate::dataset::capture::Capture;
use std::path::{Path, PathBuf};

/// Names of image folders.
const IMAGES: [&str; 4] = ["images", "image", "rgb", "input"];
/// Names of mask folders.
const MASKS: [&str; 2] = ["masks", "mask"];

/// Sets the existing image and mask of each view. `model` is the folder of the model.
pub(super) fn attach(capture: &mut Capture, model: &Path) {
    let mut roots = vec![capture.folder.clone()];
    if model == capture.folder {
        // The capture's folder may be `sparse` or `sparse/0` itself.
        roots.extend([model.join(".."), model.join("..").join("..")]);
    }
    let folders = |names: &[&str]| -> Vec<PathBuf> {
        roots.iter().flat_map(|root| names.iter().map(move |name| root.join(name))).filter(|f| f.is_dir()).collect()
    };
    // All images come from one folder, since others may hold the same names at another size. Names may also be relative
    // to the folder of the capture.
    let mut images = folders(&IMAGES);
    images.push(capture.folder.clone());
    let has_any = |folder: &&PathBuf| capture.views.iter().any(|view| folder.join(&view.name).is_file());
    let images = images.iter().find(has_any).cloned();
    let masks = folders(&MASKS);
    for view in &mut capture.views {
        let exists = |path: &PathBuf| path.is_file();
        view.image = images.as_ref().map(|folder| folder.join(&view.name)).filter(exists);
        // COLMAP's own naming comes first.
        let names = [PathBuf::from(format!("{}.png", view.name)), Path::new(&view.name).with_extension("png")];
        view.mask = masks.iter().flat_map(|folder| names.iter().map(move |name| folder.join(name))).find(exists);
    }
}
