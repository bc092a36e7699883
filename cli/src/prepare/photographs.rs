//! Folders of images without cameras.

use std::collections::HashSet;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};

use raygrad::nerf::dataset::formats::is_layer;
use raygrad::nerf::dataset::{Photo, copy_upright};
use raygrad::nerf::{Error, Result};

use super::foreign::Foreign;
use super::root::Root;
use super::video::is_video;
use super::workplace::Workplace;
use crate::interrupt::Work;
use crate::output::{complain, entries, listed, quoted};
use crate::progress::Progress;

/// File extensions of images that raygrad reads.
const READ: [&str; 6] = ["png", "jpg", "jpeg", "webp", "jfif", "jpe"];
/// File extensions of images that other programs convert; the content decides.
const CONVERTED: [&str; 4] = ["heic", "heif", "hif", "avif"];
/// File extensions of images that count where others are fewer: beside as many they are often depths, or copies.
const ALONE: [&str; 4] = ["tif", "tiff", "bmp", "exr"];
/// File extensions of images that raygrad does not read.
const NOT_READ: [&str; 9] = ["dng", "cr2", "cr3", "nef", "arw", "orf", "raf", "rw2", "gif"];

/// Copies the images `found` in a folder to `images`. Applies their EXIF orientation, and converts HEIC, AVIF
/// and those of high dynamic range to JPEG. `outside` allows links to other folders.
pub fn copy(folder: &Path, found: &[PathBuf], outside: bool, place: &Workplace) -> Work<usize> {
    if !outside {
        let root = Root::new(folder)?;
        found.iter().try_for_each(|path| root.check(path)).map_err(|what| Error::file(folder, what))?;
    }
    let foreign = Foreign::find(found)?;
    let (to, names) = (place.make("images")?, names(found, &foreign)?);
    let costs: Vec<u64> =
        decoding_memory(found).into_iter().zip(foreign.memory()).map(|(own, other)| own.max(other)).collect();
    Progress::new().each(&costs, "images copied", |i| {
        let to = to.join(&names[i]);
        if foreign.convert(i, &found[i], &to, place)? { Ok(()) } else { Ok(copy_upright(&found[i], &to)?) }
    })?;
    Ok(found.len())
}

/// The names of the copies: those of the images, but `.jpg` for converted ones, or `.heic.jpg` and the like beside an
/// image with that name.
fn names(found: &[PathBuf], foreign: &Foreign) -> Result<Vec<PathBuf>> {
    /// Endings of JPEG files.
    const JPEG: [&str; 4] = ["jpg", "jpeg", "jfif", "jpe"];
    let lower = |name: &Path| name.to_string_lossy().to_lowercase();
    let own = |path: &PathBuf| PathBuf::from(path.file_name().unwrap_or_default());
    let is_renamed = |i: usize| ends(&found[i], &CONVERTED) || foreign.contains(i) && !ends(&found[i], &JPEG);
    let mut taken: HashSet<String> =
        (0..found.len()).filter(|i| !is_renamed(*i)).map(|i| lower(&own(&found[i]))).collect();
    let name = |(i, path): (usize, &PathBuf)| {
        let own = own(path);
        if !is_renamed(i) {
            return Ok(own);
        }
        let long = PathBuf::from([own.as_os_str(), OsStr::new(".jpg")].join(OsStr::new("")));
        let free = [own.with_extension("jpg"), long].into_iter().find(|name| taken.insert(lower(name)));
        free.ok_or_else(|| Error::file(path, "would replace another image as JPEG: rename it"))
    };
    found.iter().enumerate().map(name).collect()
}

/// Bytes of memory while each image is decoded; 0 if its header cannot be read, as decoding reports the error.
pub fn decoding_memory(images: &[PathBuf]) -> Vec<u64> {
    images.iter().map(|image| Photo::decoding_memory(image).unwrap_or(0)).collect()
}

/// Returns true if the file name has one of these extensions.
pub fn ends(path: &Path, endings: &[&str]) -> bool {
    let ending = path.extension().and_then(|ending| ending.to_str()).unwrap_or_default();
    endings.iter().any(|known| known.eq_ignore_ascii_case(ending))
}

/// Refuses a single image as the input.
pub fn check_no_image(file: &Path) -> Result<()> {
    match is_image(file) {
        true => Err(Error::file(file, "is a single image: name the folder that holds the images")),
        false => Ok(()),
    }
}

/// Folders of images in a folder. Programs for 3D Gaussians use `input`.
const FOLDERS: [&str; 4] = ["images", "image", "rgb", "input"];

/// The folders in which [`find`] looks for images.
fn places(folder: &Path) -> impl Iterator<Item = PathBuf> {
    std::iter::once(folder.to_owned()).chain(FOLDERS.map(|name| folder.join(name)))
}

/// Returns true if [`find`] finds images in a folder, or some that raygrad cannot read.
pub fn are_in(folder: &Path) -> bool {
    let files = places(folder).filter_map(|place| std::fs::read_dir(place).ok()).flatten().flatten();
    files.map(|entry| entry.path()).any(|path| is_image(&path))
}

/// Returns true if the file name has the extension of an image, also of one that raygrad cannot read.
fn is_image(path: &Path) -> bool {
    [&READ[..], &CONVERTED, &ALONE, &NOT_READ].iter().any(|endings| ends(path, endings))
}

/// The images in a folder.
struct Images {
    /// Sorted by name.
    found: Vec<PathBuf>,
    /// What is said of those that are not used.
    aside: Option<String>,
    /// The number of those that raygrad cannot read.
    unread: usize,
}

impl Images {
    fn of(folder: &Path) -> Self {
        let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
        // Hidden files, such as the `._` twins of macOS, are no images.
        let shown = entries.filter(|entry| !entry.file_name().as_encoded_bytes().starts_with(b"."));
        let mut files: Vec<PathBuf> = shown.map(|entry| entry.path()).filter(|path| path.is_file()).collect();
        files.sort();
        let unread = files.iter().filter(|path| ends(path, &NOT_READ)).count();
        let alone: Vec<PathBuf> = files.iter().filter(|path| ends(path, &ALONE)).cloned().collect();
        files.retain(|path| ends(path, &READ) || ends(path, &CONVERTED));
        let some = |count: usize, what: String| (count > 0).then_some(what);
        if files.len() < alone.len() {
            let what = format!("{} images are not used: TIFF, BMP and EXR files are more", files.len());
            return Images { aside: some(files.len(), what), found: alone, unread };
        }
        let what = format!("{} TIFF, BMP and EXR files are not used: other images are as many or more", alone.len());
        Images { aside: some(alone.len(), what), found: files, unread }
    }

    /// The number of all images, also of those that raygrad cannot read.
    fn count(&self) -> usize {
        self.found.len() + self.unread
    }

    /// The error of images that raygrad cannot read.
    fn unreadable(&self, place: &Path) -> Error {
        let what = "images are raw or GIF, which raygrad cannot read: convert them to JPEG, PNG or TIFF";
        Error::file(place, format!("{} {what}", self.unread))
    }

    /// Warns of images that are not used.
    fn report(&self, place: &Path) {
        if self.unread > 0 {
            complain(&format!("warning: {}", self.unreadable(place)));
        }
        if let Some(aside) = &self.aside {
            complain(&format!("note: {}: {aside}", place.display()));
        }
    }
}

/// The deepest folder below a folder that [`below`] looks at: those of cameras are such as `DCIM/100APPLE`.
const DEEPEST: usize = 3;
/// Folders in a message. Further ones are counted.
const NAMED: usize = 4;

/// The folders with images below one without any.
fn below(folder: &Path, deepest: usize) -> Vec<(PathBuf, Images)> {
    let mut inside = entries(folder).unwrap_or_default();
    let is_other = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with('.') || is_layer(&name)
    };
    inside.retain(|path| path.is_dir() && !is_other(path));
    let of = |path: PathBuf| {
        let further = if deepest > 1 { below(&path, deepest - 1) } else { vec![] };
        let images = Images::of(&path);
        [(path, images)].into_iter().filter(|(_, images)| images.count() > 0).chain(further)
    };
    inside.into_iter().flat_map(of).collect()
}

/// Returns true if [`find`] finds the images of a single folder below one without any.
pub fn are_below(folder: &Path) -> bool {
    let has_video = entries(folder).unwrap_or_default().iter().any(|path| is_video(path));
    !has_video && matches!(&below(folder, DEEPEST)[..], [(_, images)] if !images.found.is_empty())
}

/// The images of the only folder with some below one without any.
fn find_below(folder: &Path) -> Result<Vec<PathBuf>> {
    let found = below(folder, DEEPEST);
    let videos: Vec<PathBuf> = entries(folder)?.into_iter().filter(|path| is_video(path)).collect();
    let what = match (&found[..], &videos[..]) {
        ([(place, images)], []) if images.found.is_empty() => return Err(images.unreadable(place)),
        ([(place, images)], []) => {
            let (count, at) = (images.found.len(), place.display());
            complain(&format!("note: {}: holds no images itself: used the {count} of {at}", folder.display()));
            images.report(place);
            return Ok(images.found.clone());
        }
        ([], []) => {
            "holds no images: put .jpg, .png, .tif, .webp or .heic files in it or in its folder `images`".to_owned()
        }
        ([], [video]) => {
            format!("holds no images, but a video: name that, as `raygrad prepare {}`", quoted(video))
        }
        _ => {
            let folders = found.iter().map(|(place, images)| format!("{} ({})", place.display(), images.count()));
            let all: Vec<String> = folders.chain(videos.iter().map(|video| video.display().to_string())).collect();
            format!("holds no images itself, but others do, {}: name one of them", listed(&all, NAMED))
        }
    };
    Err(Error::file(folder, what))
}

/// The images of a folder or of a folder of images in it: the first of those that have most; without any, those of the
/// only folder below. Warns of images that raygrad cannot read, and names the other folders.
pub fn find(folder: &Path) -> Result<Vec<PathBuf>> {
    let all: Vec<_> = places(folder).map(|place| (Images::of(&place), place)).collect();
    let best = all.iter().rev().max_by_key(|(images, _)| images.found.len());
    let Some((images, place)) = best.filter(|(images, _)| !images.found.is_empty()) else {
        if let Some((images, place)) = all.iter().find(|(images, _)| images.unread > 0) {
            return Err(images.unreadable(place));
        }
        return find_below(folder);
    };
    images.report(place);
    for (others, other) in all.iter().filter(|(others, other)| !others.found.is_empty() && other != place) {
        let (used, left) = (images.found.len(), others.found.len());
        complain(&format!(
            "note: used the {used} images of {}, not the {left} of {}",
            place.display(),
            other.display()
        ));
    }
    Ok(images.found.clone())
}
