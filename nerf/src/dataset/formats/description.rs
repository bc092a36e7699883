//! Which files of a folder describe a capture.

use super::exports::{self, is_archive};
use super::locate::{IMAGES, factor_in, shown, walk};
use super::paths::folded;
use super::{blender, colmap, llff, paths, transforms};
use crate::camera::lens::Lens;
use crate::dataset::capture::{Capture, Format, View};
use crate::dataset::frames::Split;
use crate::error::{Error, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The deepest folders that are searched for a description in an unusual place: the first, and if these hold none.
const DEEPEST: [usize; 2] = [3, 4];

/// The files that describe a capture.
#[derive(Debug, Clone, PartialEq)]
struct Description {
    format: Format,
    /// The folder of the capture.
    folder: PathBuf,
    /// The file with the cameras.
    file: PathBuf,
}

impl Description {
    fn new(format: Format, folder: &Path, file: PathBuf) -> Self {
        Description { format, folder: folder.to_owned(), file }
    }

    /// The COLMAP model with this file of images. Where `folder` is the model's or its `sparse`, the capture is around it.
    fn of_model(folder: &Path, file: PathBuf) -> Self {
        let root = colmap::root(folder);
        let is_inside = file.parent().is_some_and(|model| colmap::root(model) == root);
        Description::new(Format::Colmap, if is_inside { &root } else { folder }, file)
    }

    /// The description that a file is part of.
    fn of_file(file: &Path) -> Option<Self> {
        // The parent of a bare name is empty.
        let folder = file.parent().map(|folder| if folder.as_os_str().is_empty() { Path::new(".") } else { folder })?;
        let (name, ending) = (file.file_name()?.to_str()?, file.extension()?.to_str()?);
        let format = match (name, ending) {
            _ if Split::ALL.iter().any(|split| name == blender::name_of(*split)) => Format::Blender,
            (_, "json") => Format::Transforms,
            _ if is_transforms(name) => Format::Transforms,
            ("poses_bounds.npy", _) => Format::Llff,
            _ => return Some(Description::of_model(folder, colmap::images_beside(&folder.join(name))?)),
        };
        Some(Description::new(format, folder, file.to_owned()))
    }

    /// Reads the capture; splits of its files must be right only if they are `needed`.
    fn read(&self, needed: bool) -> Result<Capture> {
        let Description { format, folder, file } = self;
        let mut capture = match format {
            Format::Blender => return blender::read_files(folder, folder, needed),
            Format::Transforms => transforms::read_file(folder, file, needed)?,
            Format::Colmap => colmap::read_model(folder, file, needed)?,
            Format::Llff => llff::read(folder)?,
        };
        if needed && capture.views.iter().all(|view| view.split.is_none()) {
            self.split_as_blender(&mut capture);
        }
        Ok(capture)
    }

    /// Sets the splits of a capture without any to those that Blender's files beside it give the same images.
    fn split_as_blender(&self, capture: &mut Capture) {
        let beside = self.file.parent().filter(|_| self.format == Format::Transforms).unwrap_or(&self.folder);
        let Some(file) = blender::file(beside) else { return };
        let name = below(beside, &file);
        let known = match blender::read_files(beside, &self.folder, true) {
            Ok(capture) => capture,
            Err(error) => {
                capture.assumptions.push(format!("the splits of `{name}` and the files like it are not used: {error}"));
                return;
            }
        };
        let known = splits(&known);
        let of = |view: &View| known.get(view.image.as_deref()?).copied().flatten();
        let present: Vec<Option<Split>> = capture.present().map(of).collect();
        // Where all images are of one, it says nothing.
        if present.iter().all(|split| *split == present[0]) {
            return;
        }
        capture.views.iter_mut().for_each(|view| view.split = of(view));
        capture.assumptions.push(format!("the splits are those of `{name}` and the files like it"));
    }

    /// The path below the capture's folder, of a COLMAP model without its file unless that has a twin in the other
    /// encoding.
    fn name(&self) -> String {
        let inside = self.file.strip_prefix(&self.folder).unwrap_or(&self.file);
        let is_alone = ["bin", "txt"].iter().any(|ending| !self.file.with_extension(ending).is_file());
        let is_model = self.format == Format::Colmap && is_alone;
        let inside = if is_model { inside.parent().unwrap_or(inside) } else { inside };
        let name = inside.display().to_string();
        if name.is_empty() { self.format.to_string() } else { name }
    }
}

/// Reads the capture of a folder that a file describes; its splits must be right only if they are `needed`.
///
/// # Errors
/// If the file is not a description, or as the format's own `read`.
pub(in crate::dataset) fn read_file(folder: &Path, file: &Path, needed: bool) -> Result<Capture> {
    let description = Description::of_file(file).ok_or_else(|| Error::file(file, "does not describe a capture"))?;
    Description { folder: folder.to_owned(), ..description }.read(needed)
}

/// The descriptions in a folder: `transforms.json`, Blender, COLMAP's models, and LLFF. Earlier ones hold more, and are
/// usually derived from later ones.
fn descriptions(folder: &Path) -> Vec<Description> {
    let mut out = vec![];
    let file = transforms::file(folder);
    if file.is_file() {
        out.push(Description::new(Format::Transforms, folder, file));
    }
    if let Some(file) = blender::file(folder) {
        out.push(Description::new(Format::Blender, folder, file));
    }
    out.extend(colmap::models(folder).into_iter().map(|file| Description::of_model(folder, file)));
    let file = llff::file(folder);
    if file.is_file() {
        out.push(Description::new(Format::Llff, folder, file));
    }
    out
}

/// Returns true for a name like transforms.json: in any case, with more words, or with `.txt`, as Windows may add.
fn is_transforms(name: &str) -> bool {
    let lower = name.to_lowercase();
    let is_split = Split::ALL.iter().any(|split| name == blender::name_of(*split));
    let lower = lower.strip_suffix(".txt").unwrap_or(&lower);
    lower == "transform.json" || lower.starts_with("transforms") && lower.ends_with(".json") && !is_split
}

/// The descriptions in unusual places in or below a folder without [usual ones](descriptions).
fn elsewhere(folder: &Path) -> Vec<Description> {
    DEEPEST.into_iter().map(|deepest| within(folder, deepest)).find(|found| !found.is_empty()).unwrap_or_default()
}

/// The descriptions in a folder and `deepest` levels below it.
fn within(folder: &Path, deepest: usize) -> Vec<Description> {
    let mut out = vec![];
    for directory in walk(folder, deepest) {
        let place = folder.join(&directory.inside);
        let names = directory.names().into_iter().filter(|name| name.to_str().is_some_and(is_transforms));
        out.extend(names.map(|name| Description::new(Format::Transforms, &place, place.join(name))));
        out.extend(blender::file(&place).map(|file| Description::new(Format::Blender, &place, file)));
        let model = |file| Description::new(Format::Colmap, &colmap::root_below(folder, &place), file);
        out.extend(colmap::models_in(&place).into_iter().map(model));
        let file = llff::file(&place);
        if file.is_file() {
            out.push(Description::new(Format::Llff, &place, file));
        }
    }
    out
}

/// Fails if descriptions are those of several captures: of several folders, or several files like transforms.json.
fn check_single(folder: &Path, all: &[Description]) -> Result<()> {
    const NAMED: usize = 4;
    let mut captures: Vec<&Description> = vec![];
    for one in all {
        let is_twin = |other: &&Description| one.format == Format::Transforms && other.format == one.format;
        if captures.iter().all(|other| other.folder != one.folder || is_twin(other)) {
            captures.push(one);
        }
    }
    if captures.len() < 2 {
        return Ok(());
    }
    let named: Vec<String> = captures.iter().take(NAMED).map(|one| format!("`{}`", below(folder, &one.file))).collect();
    let others = captures.len().saturating_sub(NAMED);
    let others = if others > 0 { format!(" and {others} others") } else { String::new() };
    let what = format!("holds several captures, {}{others}: name one of them", named.join(", "));
    Err(Error::file(folder, what))
}

/// A path below a folder, for messages.
fn below(folder: &Path, file: &Path) -> String {
    shown(file.strip_prefix(folder).unwrap_or(file))
}

/// Reads the capture in a folder, or that of a file that describes one. `asked` limits the formats. Splits must be
/// right only if they are `needed`.
///
/// Of several descriptions, the one with most existing images counts; of equally many, the first. Unusual places count
/// if the usual ones hold no description.
///
/// # Errors
/// If there is no description, unusual places hold several captures, a description before the best cannot be read, or as
/// the format's own `read`.
pub(in crate::dataset) fn read(path: &Path, asked: Option<Format>, needed: bool) -> Result<Capture> {
    if !path.exists() {
        return Err(Error::file(path, "there is no such folder"));
    }
    if path.is_file() {
        if is_archive(path) {
            return Err(Error::file(path, "is an archive: unpack it, and name the folder"));
        }
        if let Some(what) = exports::of_file(path) {
            return Err(Error::file(path, what));
        }
        let what = "does not describe a capture: name a folder, a .json file, poses_bounds.npy, or images.bin of a COLMAP \
                    model";
        let description = Description::of_file(path).ok_or_else(|| Error::file(path, what))?;
        if let Some(asked) = asked.filter(|asked| *asked != description.format) {
            return Err(Error::file(
                path,
                format!("describes a capture in the format {}, not {asked}", description.format),
            ));
        }
        let capture = description.read(needed)?;
        if let Some(inner) = undistorted_within(&capture, needed)? {
            let what = format!(
                "has a lens, and the only images found for it, in `{}`, are without: name `{}`, or put the images of \
                 this model beside it",
                below(&capture.folder, &inner.folder),
                below(&capture.folder, &inner.file)
            );
            return Err(Error::file(path, what));
        }
        return with_images_beside(capture, needed);
    }
    let mut all = descriptions(path);
    let is_usual = !all.is_empty();
    if !is_usual {
        all = elsewhere(path);
    }
    all.retain(|description| asked.is_none_or(|format| description.format == format));
    if all.is_empty() {
        return Err(unknown(path, asked));
    }
    if is_usual {
        let capture = most_complete(&all, needed)?;
        let Some(mut inner) = undistorted_within(&capture, needed)? else {
            return with_images_beside(capture, needed);
        };
        let [own, other] = [&capture, &inner].map(|capture| below(path, &capture.file));
        let what = format!("`{own}` has a lens, and its images were undistorted for `{other}`: used this");
        inner.assumptions.insert(0, what);
        return Ok(inner);
    }
    check_single(path, &all)?;
    let capture = most_complete(&all, needed)?;
    let model = below(path, &capture.file);
    let roots = capture.folder.ancestors().skip(1).take_while(|root| root.starts_with(path));
    let roots: Vec<PathBuf> = roots.map(Path::to_owned).collect();
    let mut capture = with_images_around(&roots, capture, needed)?;
    capture.assumptions.insert(0, format!("the usual places hold no capture: used `{model}`"));
    Ok(capture)
}

/// The capture of a transforms.json with images in the folder around its own, if it has no images itself.
///
/// # Errors
/// As the format's own `read`.
fn with_images_beside(capture: Capture, needed: bool) -> Result<Capture> {
    let around = above(&capture.folder).filter(|_| capture.format == Format::Transforms);
    with_images_around(around.as_slice(), capture, needed)
}

/// The capture with images in one of the folders around its own, if it has no images itself.
///
/// # Errors
/// If it is a COLMAP model that may have images of its own, or as the format's own `read`.
fn with_images_around(roots: &[PathBuf], capture: Capture, needed: bool) -> Result<Capture> {
    let may_be = matches!(capture.format, Format::Colmap | Format::Transforms);
    let Some(top) = roots.last().filter(|_| may_be && capture.present().next().is_none()) else { return Ok(capture) };
    for root in roots {
        // Other folders may hold images of the same names.
        let is_near = |view: &View| near(root, &view.name);
        if capture.format == Format::Transforms && !capture.views.iter().any(is_near) {
            continue;
        }
        let mut around = Description::new(capture.format, root, capture.file.clone()).read(needed)?;
        // Images farther below may be those of other captures.
        let is_near = |view: &View| {
            let inside = view.image.as_ref().and_then(|image| image.strip_prefix(root).ok());
            inside.is_some_and(|inside| inside.components().count() <= 2 || inside == Path::new(&view.name))
        };
        let is_own = capture.format == Format::Colmap || around.present().all(is_near);
        let first = around.present().next().filter(|_| is_own);
        let Some(image) = first.and_then(|view| Some(below(top, view.image.as_ref()?))) else { continue };
        // Undistorted models have images of their own.
        let is_pinhole = |view: &View| view.camera.lens == Lens::Pinhole;
        if capture.format == Format::Colmap && around.views.iter().all(is_pinhole) {
            let what = format!(
                "has no images, and may have undistorted ones of its own: copy those to `{}` or, to use others, such \
                 as `{image}`, move the model to `sparse/0`",
                below(top, &capture.folder.join("images"))
            );
            return Err(Error::file(&capture.file, what));
        }
        let file = below(top, &capture.file);
        around.assumptions.push(format!("no images are beside `{file}`: used others, such as `{image}`"));
        return Ok(around);
    }
    Ok(capture)
}

/// Returns true if an image is at its listed path below a folder, in that folder itself, or in one in it with the name of
/// the listed folder or of a folder of images. If only its name is listed, any folder that is no capture counts.
fn near(root: &Path, name: &str) -> bool {
    let (place, last) = name.rsplit_once('/').unwrap_or(("", name));
    let listed = place.rsplit('/').next().map(folded).unwrap_or_default();
    let is_named = |folder: &PathBuf| {
        let own = folder.file_name().map(|name| folded(&name.to_string_lossy())).unwrap_or_default();
        let is_listed = if listed.is_empty() { descriptions(folder).is_empty() } else { own == listed };
        is_listed || IMAGES.contains(&&*own) || factor_in(&own, "images").is_some()
    };
    let folders = std::fs::read_dir(root).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut places = [root.to_owned()].into_iter().chain(folders.filter(is_named));
    paths::find(root, name).is_some() || places.any(|place| paths::find(&place, last).is_some())
}

/// The capture of pinhole cameras in a folder of a COLMAP model with a lens, if the images that were found for the model
/// are those of that capture: COLMAP undistorts to `dense/0`, under the same names.
fn undistorted_within(capture: &Capture, needed: bool) -> Result<Option<Capture>> {
    let is_pinhole = |view: &View| view.camera.lens == Lens::Pinhole;
    let Some(image) = capture.present().next().and_then(|view| view.image.as_deref()) else { return Ok(None) };
    if capture.format != Format::Colmap || capture.views.iter().all(is_pinhole) {
        return Ok(None);
    }
    let is_below = |folder: &&Path| folder.starts_with(&capture.folder) && *folder != capture.folder;
    for folder in image.ancestors().skip(1).take_while(is_below) {
        for file in colmap::models(folder) {
            let inner = Description::of_model(folder, file).read(needed)?;
            if inner.present().any(|view| view.image.as_deref() == Some(image)) && inner.views.iter().all(is_pinhole) {
                return Ok(Some(inner));
            }
        }
    }
    Ok(None)
}

/// Reads the capture of the description with most existing images.
fn most_complete(all: &[Description], needed: bool) -> Result<Capture> {
    if let [one] = all {
        return one.read(needed);
    }
    let mut captures: Vec<(&Description, Result<Capture>)> = all.iter().map(|one| (one, one.read(needed))).collect();
    let present = |capture: &Result<Capture>| capture.as_ref().map_or(0, |capture| capture.present().count());
    // The first of the best.
    let most = captures.iter().map(|(_, capture)| present(capture)).max().unwrap_or(0);
    let best = captures.iter().position(|(_, capture)| present(capture) == most).unwrap_or(0);
    if let Some(damaged) = captures[..=best].iter().position(|(_, capture)| capture.is_err()) {
        let (_, capture) = captures.swap_remove(damaged);
        let other = captures.iter().find(|(_, capture)| present(capture) > 0).map(|(other, _)| *other);
        let advice = other.map(|other| format!("to use `{}` instead, name {}", other.name(), other.file.display()));
        return capture.map_err(|error| match advice {
            Some(advice) => error.with(&advice),
            None => error,
        });
    }
    let count = |(description, capture): &(&Description, Result<Capture>)| match capture {
        Ok(capture) => format!("`{}` {} of {}", description.name(), capture.present().count(), capture.views.len()),
        Err(_) => format!("`{}` is damaged", description.name()),
    };
    let others: Vec<_> = captures.iter().enumerate().filter(|(i, _)| *i != best).collect();
    // The usual case: one description was made from the other.
    let is_twin = |(other, capture): &(&Description, Result<Capture>)| match (capture, &captures[best].1) {
        (Ok(own), Ok(first)) if other.format == Format::Blender => splits(own).keys().eq(splits(first).keys()),
        _ => present(capture) == most,
    };
    let is_usual = best == 0 && others.iter().all(|(_, other)| is_twin(other));
    let used = count(&captures[best]);
    let others: Vec<String> = others.into_iter().map(|(_, other)| count(other)).collect();
    let mut capture = captures.swap_remove(best).1?;
    if !is_usual {
        let what = format!("images found: {used}, {}; used the first", others.join(", "));
        capture.assumptions.insert(0, what);
    }
    Ok(capture)
}

/// The files of a capture's images, with their splits.
fn splits(capture: &Capture) -> BTreeMap<&Path, Option<Split>> {
    capture.present().filter_map(|view| Some((view.image.as_deref()?, view.split))).collect()
}

/// Returns true if a folder or its parent has a description, or if the folder is an export of another program or holds
/// captures in unusual places.
pub(in crate::dataset) fn is_described(folder: &Path) -> bool {
    let above = above(folder);
    let is_near = [Some(folder), above.as_deref()].into_iter().flatten().any(|near| !descriptions(near).is_empty());
    is_near || exports::of_folder(folder).is_some() || !elsewhere(folder).is_empty()
}

/// The folder that holds a folder.
fn above(folder: &Path) -> Option<PathBuf> {
    // `.` has no parent in its path.
    let whole = if folder.file_name().is_some() { folder.to_owned() } else { folder.canonicalize().ok()? };
    let parent = whole.parent()?;
    Some(if parent.as_os_str().is_empty() { PathBuf::from(".") } else { parent.to_owned() })
}

/// The error of a folder without a description.
fn unknown(folder: &Path, asked: Option<Format>) -> Error {
    if let Some(format) = asked {
        let mut found: Vec<String> = descriptions(folder).iter().map(Description::name).collect();
        if found.is_empty() {
            found = elsewhere(folder).iter().map(|one| below(folder, &one.file)).collect();
        }
        let found: Vec<String> = found.into_iter().map(|name| format!("`{name}`")).collect();
        let found = if found.is_empty() { "no capture".to_owned() } else { found.join(", ") };
        return Error::file(folder, format!("holds no capture in the format {format}, but {found}"));
    }
    if let Some(parent) = above(folder).filter(|parent| !descriptions(parent).is_empty()) {
        return Error::file(folder, format!("is not a dataset, but `{}` is: use that folder", parent.display()));
    }
    if let Some(what) = exports::of_folder(folder) {
        return Error::file(folder, what);
    }
    if let Some((inside, what)) = exports::below(folder) {
        return Error::file(folder, format!("is not a dataset, and its folder `{}` {what}", shown(&inside)));
    }
    let files = std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path());
    if let Some(archive) = files.filter(|path| is_archive(path)).min() {
        return Error::file(
            folder,
            format!("is not a dataset, but holds the archive `{}`: unpack it", below(folder, &archive)),
        );
    }
    let what = "is not a dataset: expected transforms.json (instant-ngp, nerfstudio), transforms_train.json (Blender), \
        sparse/0/cameras.bin or .txt (COLMAP) or poses_bounds.npy (LLFF); `raygrad prepare` makes one from a video or \
        images";
    Error::file(folder, what)
}

#[cfg(test)]
mod tests;
