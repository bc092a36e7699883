//! Datasets that `raygrad train` prepares beside a video or images without cameras.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use raygrad::nerf::dataset::Capture;
use raygrad::nerf::{Error, Result, write_atomic};

use super::workplace::others;
use super::{Glass, Input, make, photographs, poses, video};
use crate::interrupt::{self, Work};
use crate::output::{complain, print};

/// The sources of a dataset, in its folder.
const SOURCES: &str = "sources.json";
/// End of the folder's name.
const ENDING: &str = "-prepared";
/// Ways to camera poses without COLMAP.
const WITHOUT: &str = "has no camera poses. Without COLMAP: scan with Polycam or Record3D and convert the scan with \
                       nerfstudio's ns-process-data, or run COLMAP on another machine; then train on that folder";

/// Returns true for a video, and for a folder of images without a description of their cameras.
pub fn is_unprepared(input: &Path) -> bool {
    match input.is_file() {
        true => video::is_video(input),
        false if Capture::is_described(input) => false,
        false => photographs::are_in(input) || photographs::are_below(input),
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
    let sources = sources(input)?;
    make(&Input { path: input, frames: super::FRAMES, lens: Glass::default(), allow_outside: false }, &out)?;
    let text = serde_json::to_string_pretty(&sources).map_err(|e| Error::file(out.join(SOURCES), e))?;
    write_atomic(out.join(SOURCES), text.as_bytes())?;
    interrupt::listen();
    Ok(out)
}

/// A file of an input: its name, its bytes, and the seconds since 1970 when it was modified.
type Source = (String, u64, u64);

/// The video, or the images of a folder.
fn sources(input: &Path) -> Result<Vec<Source>> {
    let files = if input.is_dir() { photographs::find(input)? } else { vec![input.to_owned()] };
    let source = |file: PathBuf| {
        let about = file.metadata().map_err(|e| Error::file(&file, format!("cannot be read: {e}")))?;
        let modified = about.modified().ok().and_then(|time| time.duration_since(UNIX_EPOCH).ok());
        let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Ok((name, about.len(), modified.map_or(0, |time| time.as_secs())))
    };
    files.into_iter().map(source).collect()
}

/// Fails unless a folder is a dataset of the images or the video of the input, unchanged.
fn check_made_from(input: &Path, out: &Path) -> Work<()> {
    let what = format!("was not made from {}: remove or rename it, or train on it", input.display());
    if let Err(error) = Capture::read(out) {
        complain(&error.to_string());
        return Err(Error::file(out, what).into());
    }
    let made = std::fs::read_to_string(out.join(SOURCES)).ok();
    let made: Option<Vec<Source>> = made.and_then(|text| serde_json::from_str(&text).ok());
    if made != Some(sources(input)?) {
        return Err(Error::file(out, what).into());
    }
    Ok(())
}
