//! The images and masks of a model.

use super::super::locate::{IMAGES, locate, shown};
use crate::dataset::capture::Capture;
use crate::dataset::formats::masks;
use crate::error::{Error, Result};
use std::collections::HashSet;
use std::path::{Path, PathBuf};

/// Sets the existing image and mask of each view. `model` is the folder of the model.
///
/// # Errors
/// If two files fit the name of an image, or a mask fits two images.
pub(super) fn attach(capture: &mut Capture, model: &Path) -> Result<()> {
    let root = if model == capture.folder { root(model) } else { capture.folder.clone() };
    // All images come from one folder, since others may hold the same names at another size. Names may also be relative
    // to the folder of the capture.
    let folders = IMAGES.map(|name| root.join(name));
    let mut images: Vec<PathBuf> = folders.into_iter().filter(|folder| folder.is_dir()).collect();
    if model.strip_prefix(&root).is_ok_and(|inside| inside.iter().any(|part| part == "distorted")) {
        // 3D Gaussian Splatting keeps undistorted images in `images`, and those of this model in `input`.
        images.reverse();
    }
    images.extend([root.clone(), capture.folder.clone()]);
    let names: Vec<&str> = capture.views.iter().map(|view| view.name.as_str()).collect();
    let has_any = |folder: &&PathBuf| names.iter().any(|name| folder.join(name).is_file());
    let (folder, below) = match images.iter().find(has_any) {
        Some(folder) => match fuller(&root, folder, images.iter().cloned(), &names) {
            Some((other, note)) => {
                capture.assumptions.push(note);
                (other, "")
            }
            None => (folder.clone(), ""),
        },
        // Names of a model are relative to its folder of images.
        None => (root.clone(), "images/"),
    };
    let names: Vec<String> = capture.views.iter().map(|view| format!("{below}{}", view.name)).collect();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let found = locate(&folder, &names, &HashSet::new(), &mut capture.assumptions);
    let found = found.map_err(|(i, what)| Error::field(&capture.file, &capture.views[i].field, what))?;
    capture.views.iter_mut().zip(found).for_each(|(view, image)| view.image = image.map(|image| image.path));
    masks::attach(capture, &[root])
}

/// The fullest of `others` and a note, if `folder` is a stale copy of it: with less than half of the files of these
/// names, each as long as in the other. Files of other lengths may be other images, such as undistorted ones.
fn fuller(
    root: &Path,
    folder: &Path,
    others: impl Iterator<Item = PathBuf>,
    names: &[&str],
) -> Option<(PathBuf, String)> {
    let length = |path: PathBuf| path.metadata().ok().filter(|about| about.is_file()).map(|about| about.len());
    let lengths = |folder: &Path| names.iter().map(|name| length(folder.join(name))).collect::<Vec<_>>();
    let own = lengths(folder);
    let held = own.iter().flatten().count();
    if 2 * held >= names.len() {
        return None;
    }
    let rated = others.filter_map(|other| {
        let lengths = lengths(&other);
        let count = lengths.iter().flatten().count();
        let is_copied = own.iter().zip(&lengths).all(|(own, other)| own.is_none() || own == other);
        (is_copied && count > held).then_some((count, other))
    });
    let (count, other) = rated.reduce(|best, next| if next.0 > best.0 { next } else { best })?;
    let [from, to] = [folder, &other].map(|path| shown(path.strip_prefix(root).unwrap_or(path)));
    let total = names.len();
    Some((other, format!("`{from}` holds {held} of {total} files: used `{to}`, which holds {count}")))
}

/// The folder of the capture of a model: that of `sparse` for the model `sparse/0`, or the one around it if that is
/// `colmap` or `distorted` and has no images.
pub(crate) fn root(model: &Path) -> PathBuf {
    // Paths such as `.` and `sparse/0` have a parent only in their absolute form.
    let whole = std::path::absolute(model).unwrap_or_else(|_| model.to_owned());
    let sparse = whole.ancestors().take(2).find(|folder| folder.ends_with("sparse"));
    let Some(parent) = sparse.and_then(Path::parent) else { return model.to_owned() };
    let is_inner = ["colmap", "distorted"].iter().any(|name| parent.ends_with(name)) && !has_images(parent);
    parent.parent().filter(|_| is_inner).unwrap_or(parent).to_owned()
}

/// The folder of the capture of a model somewhere below `folder`: its [`root`], or without one the nearest folder
/// around it with images.
pub(crate) fn root_below(folder: &Path, model: &Path) -> PathBuf {
    let root = root(model);
    let mut around = model.ancestors().take_while(|place| place.starts_with(folder));
    if root == model {
        return around.find(|place| has_images(place)).unwrap_or(folder).to_owned();
    }
    let own = around.find(|place| std::path::absolute(place).is_ok_and(|place| place == root));
    own.map_or(root.clone(), Path::to_owned)
}

fn has_images(folder: &Path) -> bool {
    IMAGES.iter().any(|name| folder.join(name).is_dir())
}
