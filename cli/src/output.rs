//! Words to the terminal, and folders to write to.

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use raygrad::nerf::imaging::colormap;
use raygrad::nerf::{Error, Image, Render, Result};

/// Writes to standard output. A reader that has gone away, as in `raygrad eval run | head -1`, is no error, and a terminal that
/// was closed is none.
pub fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if !is_gone(&e, is_device(&out)) => Err(Error::setting("stdout", format!("cannot be written: {e}"))),
        _ => Ok(()),
    }
}

/// Whether nobody is there any more to read what is written to standard output, which may be a device.
fn is_gone(error: &std::io::Error, is_device: bool) -> bool {
    /// What a terminal says that was hung up, on all kinds of Unix.
    const EIO: i32 = 5;
    error.kind() == ErrorKind::BrokenPipe || (cfg!(unix) && is_device && error.raw_os_error() == Some(EIO))
}

/// Whether this is a device, as terminals are. That they are terminals they say no more when they are hung up.
#[cfg(unix)]
fn is_device(out: &impl std::os::fd::AsFd) -> bool {
    use std::os::unix::fs::FileTypeExt;
    let file = out.as_fd().try_clone_to_owned().map(std::fs::File::from);
    file.and_then(|file| file.metadata()).is_ok_and(|about| about.file_type().is_char_device())
}

#[cfg(not(unix))]
fn is_device<T>(_: &T) -> bool {
    false
}

/// Writes a line to standard error. If that is closed there is nobody to tell; `eprintln` would panic.
pub fn note(line: &str) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// Writes a line about something that is wrong to standard error.
pub fn complain(line: &str) {
    note(&format!("raygrad: {line}"));
}

/// The folder that a file is in.
pub fn parent(file: &Path) -> &Path {
    file.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Whether files can be made in a folder: asked before the work that they will hold.
pub fn check_writable(folder: &Path) -> Result<()> {
    tempfile::tempfile_in(folder).map(drop).map_err(|e| Error::file(folder, format!("cannot be written to: {e}")))
}

/// The CRC-32 of a file, by which records say which one it was.
pub fn checksum(path: &Path) -> Result<String> {
    let bytes = std::fs::read(path).map_err(|e| Error::file(path, format!("cannot be read: {e}")))?;
    Ok(format!("{:08x}", crc32fast::hash(&bytes)))
}

/// The paths of what is in a folder, by name.
pub fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).and_then(|all| all.map(|entry| Ok(entry?.path())).collect());
    let mut paths: Vec<PathBuf> = entries.map_err(|e| Error::file(folder, format!("cannot be read: {e}")))?;
    paths.sort();
    Ok(paths)
}

/// Makes a folder and those above it, and sees that files can be made in it.
pub fn make_folder(folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(|e| Error::file(folder, format!("cannot be created: {e}")))?;
    check_writable(folder)
}

/// The files in a folder named as pictures by number, `digits` long at least, other than those of the numbers in `written`:
/// what a longer row of pictures has left there.
pub fn other_numbered(folder: &Path, digits: usize, written: &[usize]) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let other = |entry: &std::fs::DirEntry| {
        let name = entry.file_name().to_string_lossy().into_owned();
        let number = name.strip_suffix(".png").and_then(|stem| stem.parse::<usize>().ok());
        number.is_some_and(|n| name == numbered(n, digits) && !written.contains(&n))
            && entry.file_type().is_ok_and(|kind| kind.is_file())
    };
    entries.filter(other).map(|entry| entry.path()).collect()
}

/// The name of a picture by its number.
pub fn numbered(number: usize, digits: usize) -> String {
    format!("{number:0digits$}.png")
}

/// Removes pictures of an earlier, longer row. One that stays is no error: what was asked for is written.
pub fn remove(files: &[PathBuf]) {
    for file in files {
        if let Err(e) = std::fs::remove_file(file) {
            complain(&format!("{}: cannot be removed: {e}", file.display()));
        }
    }
}

/// How many times farther than it begins a scene ends, for its distances to be shown by their logarithms.
const DEEP: f64 = 100.0;

/// The depth of a picture in false colour: yellow near, violet far, black where there is nothing to see. That of a scene which
/// goes on and on by its logarithm, from twice the near distance to two hundred times it.
pub fn depth_colors(picture: &Render, [near, far]: [f64; 2]) -> Image {
    let mut depth = picture.depth.clone();
    for (depth, &opacity) in depth.data.iter_mut().zip(&picture.opacity.data) {
        if opacity < 0.5 {
            *depth = 0.0;
        }
    }
    // It may be 0.
    let near = near.max(1e-5 * far);
    if far <= DEEP * near {
        return colormap::depth_map(&depth, near, far);
    }
    let ends = [2.0 * near, far.min(2.0 * DEEP * near)].map(f64::ln);
    let share = |depth: f32| ((f64::from(depth).ln() - ends[0]) / (ends[1] - ends[0])).clamp(0.0, 1.0) as f32;
    // Shown from 1 to 2, as 0 is nothing.
    depth.data.iter_mut().filter(|depth| **depth > 0.0).for_each(|depth| *depth = 1.0 + share(*depth));
    colormap::depth_map(&depth, 1.0, 2.0)
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn output_to_who_is_gone_is_no_error() {
        let error = |number: i32| std::io::Error::from_raw_os_error(number);
        // A pipe without a reader, a terminal that was hung up; a disk that fails, and one that is full.
        for (number, is_device, gone) in [(32, false, true), (5, true, true), (5, false, false), (28, true, false)] {
            assert_eq!(is_gone(&error(number), is_device), gone, "{number} {is_device}");
        }
        let device = std::fs::File::open("/dev/null").unwrap();
        assert!(is_device(&device) && !is_device(&tempfile::tempfile().unwrap()));
    }
}
