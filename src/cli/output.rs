//! Words to the terminal, and folders to write to.

use std::fs::{File, TryLockError};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use raygrad::nerf::pictures::colormap;
use raygrad::nerf::{Error, Image, Picture, Result};

/// Writes to standard output. A reader that has gone away, as in `raygrad eval run | head -1`, is no error.
pub fn print(text: &str) -> Result<()> {
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() != ErrorKind::BrokenPipe => Err(Error::setting("stdout", format!("cannot be written: {e}"))),
        _ => Ok(()),
    }
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

/// Keeps other programs out, until the file is dropped or this program ends, however it does; `busy` says what to do if one is in.
pub fn lock(path: &Path, busy: impl FnOnce() -> Error) -> Result<File> {
    let bad = |e: std::io::Error| Error::file(path, format!("cannot be locked: {e}"));
    let file = File::options().create(true).truncate(false).write(true).open(path).map_err(bad)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(busy()),
        Err(TryLockError::Error(e)) => Err(bad(e)),
    }
}

/// The CRC-32 of a file, by which records say which one it was.
pub fn checksum(path: &Path) -> Result<String> {
    let bytes = std::fs::read(path).map_err(|e| Error::file(path, format!("cannot be read: {e}")))?;
    Ok(format!("{:08x}", crc32fast::hash(&bytes)))
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
pub fn depth_colors(picture: &Picture, [near, far]: [f64; 2]) -> Image {
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
