//! Folders of images without cameras.

use std::path::{Path, PathBuf};

use raygrad::nerf::dataset::{Photo, copy_upright};
use raygrad::nerf::{Error, Result};

use super::root::Root;
use super::workplace::Workplace;
use crate::interrupt::Work;
use crate::output::complain;
use crate::progress::Progress;

/// File extensions that raygrad reads.
const READ: [&str; 4] = ["png", "jpg", "jpeg", "webp"];
/// File extensions that raygrad does not read.
const NOT_READ: [&str; 9] = ["heic", "heif", "avif", "tif", "tiff", "dng", "cr2", "nef", "arw"];

/// Copies the images `found` in a folder to `images` and applies their EXIF orientation. `outside` allows links to
/// other folders.
pub fn copy(folder: &Path, found: &[PathBuf], outside: bool, place: &Workplace) -> Work<usize> {
    if !outside {
        let root = Root::new(folder)?;
        found.iter().try_for_each(|path| root.check(path)).map_err(|what| Error::file(folder, what))?;
    }
    let to = place.make("images")?;
    Progress::new().each(&decoding_memory(found), "images copied", |i| {
        Ok(copy_upright(&found[i], to.join(found[i].file_name().unwrap_or_default()))?)
    })?;
    Ok(found.len())
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
    match ends(file, &READ) || ends(file, &NOT_READ) {
        true => Err(Error::file(file, "is a single image: name the folder that holds the images")),
        false => Ok(()),
    }
}

/// Returns true if [`find`] finds images in a folder, or some that raygrad cannot read.
pub fn are_in(folder: &Path) -> bool {
    let files = [folder, &folder.join("images")].map(std::fs::read_dir).into_iter().flatten().flatten().flatten();
    files.map(|entry| entry.path()).any(|path| ends(&path, &READ) || ends(&path, &NOT_READ))
}

/// The images in a folder, unsorted. Warns of images that raygrad cannot read.
pub fn find(folder: &Path) -> Result<Vec<PathBuf>> {
    let inner = folder.join("images");
    for folder in [folder, &inner] {
        let Ok(entries) = std::fs::read_dir(folder) else { continue };
        // Hidden files, such as the `._` twins of macOS, are no images.
        let shown = entries.flatten().filter(|entry| !entry.file_name().as_encoded_bytes().starts_with(b"."));
        let files: Vec<PathBuf> = shown.map(|entry| entry.path()).filter(|path| path.is_file()).collect();
        let others = files.iter().filter(|path| ends(path, &NOT_READ)).count();
        let found: Vec<PathBuf> = files.into_iter().filter(|path| ends(path, &READ)).collect();
        if others > 0 {
            let what = "images are HEIC, TIFF or raw, which raygrad cannot read: convert them to JPEG or PNG";
            if found.is_empty() {
                return Err(Error::file(folder, format!("{others} {what}")));
            }
            complain(&format!("warning: {}: {others} {what}", folder.display()));
        }
        if !found.is_empty() {
            return Ok(found);
        }
    }
    Err(Error::file(folder, "holds no images: put .jpg, .png or .webp files in it or in its folder `images`"))
}
