//! Datasets that `raygrad train` prepares beside a video or images without cameras.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use raygrad::nerf::Error;
use raygrad::nerf::dataset::Capture;

use super::workplace::others;
use super::{Glass, Input, make, photographs, poses, video};
use crate::interrupt::{self, Work};
use crate::output::{complain, entries, print};

/// End of the folder's name.
const ENDING: &str = "-prepared";
/// Ways to camera poses without COLMAP.
const WITHOUT: &str = "has no camera poses. Without COLMAP: scan with Polycam or Record3D and convert the scan with \
                       nerfstudio's ns-process-data, or run COLMAP on another machine; then train on that folder";

/// Returns true for a video, and for a folder of images without a description of their cameras.
pub fn is_unprepared(input: &Path) -> bool {
    match input.is_file() {
        true => video::is_video(input),
        false => input.is_dir() && !Capture::is_described(input) && photographs::are_in(input),
    }
}

/// Makes the dataset of an input beside it, or finds the one that was made before. Returns its folder.
pub fn dataset(input: &Path) -> Work<PathBuf> {
    // The input may be `.`.
    let named = if input.file_name().is_some() { Ok(input.to_owned()) } else { input.canonicalize() };
    let named = named.map_err(|e| Error::file(input, format!("cannot be read: {e}")))?;
    let mut name = OsString::from(named.file_name().unwrap_or_default());
    name.push(ENDING);
    let out = named.with_file_name(name);
    if others(&out).is_ok_and(|others| !others.is_empty()) {
        check_made_from(input, &out)?;
        print(&format!("prepared {}, made before from {}\n", out.display(), input.display()))?;
        return Ok(out);
    }
    if poses::check().is_err() {
        // The error says how to install it.
        complain(&format!("{}: {WITHOUT}", input.display()));
    } else {
        print(&format!("prepare  {} has no camera poses: making {} with COLMAP\n", input.display(), out.display()))?;
    }
    interrupt::listen_to_remove();
    make(&Input { path: input, frames: super::FRAMES, lens: Glass::default(), allow_outside: false }, &out)?;
    interrupt::listen();
    Ok(out)
}

/// Fails unless a folder is a dataset of the images of the input. Frames of a video are not compared.
fn check_made_from(input: &Path, out: &Path) -> Work<()> {
    let what = format!("was not made from {}: remove or rename it, or train on it", input.display());
    if let Err(error) = Capture::read(out) {
        complain(&error.to_string());
        return Err(Error::file(out, what).into());
    }
    // Conversion may replace an extension, or add one.
    let names = |files: Vec<PathBuf>| {
        let mut names: Vec<OsString> = files.iter().filter_map(|file| photographs::stem(file)).collect();
        names.sort();
        names
    };
    if input.is_dir() && names(photographs::find(input)?) != names(entries(&out.join("images"))?) {
        return Err(Error::file(out, what).into());
    }
    Ok(())
}
