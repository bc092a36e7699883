//! Words to the terminal, and folders to write to.

use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use raygrad::nerf::{Error, Image, Picture, Result, colormap};

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

/// Whether files can be made in a folder: asked before the work that they will hold.
pub fn check_writable(folder: &Path) -> Result<()> {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    tempfile::tempfile_in(folder).map(drop).map_err(|e| Error::file(folder, format!("cannot be written to: {e}")))
}

/// Makes a folder and those above it, and sees that files can be made in it.
pub fn make_folder(folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder).map_err(|e| Error::file(folder, format!("cannot be created: {e}")))?;
    check_writable(folder)
}

/// The pictures in a folder whose names are numbers, other than those that are `written`: what a longer row of pictures has
/// left there.
pub fn other_numbered(folder: &Path, written: &[String]) -> Result<Vec<PathBuf>> {
    let error = |e: std::io::Error| Error::file(folder, format!("cannot be read: {e}"));
    let mut others = vec![];
    for entry in std::fs::read_dir(folder).map_err(error)? {
        let name = entry.map_err(error)?.file_name().to_string_lossy().into_owned();
        let stem = name.strip_suffix(".png").unwrap_or_default();
        if !stem.is_empty() && stem.bytes().all(|b| b.is_ascii_digit()) && !written.contains(&name) {
            others.push(folder.join(name));
        }
    }
    Ok(others)
}

/// Removes files that are of no more use.
pub fn remove(files: &[PathBuf]) -> Result<()> {
    files.iter().try_for_each(|file| {
        std::fs::remove_file(file).map_err(|e| Error::file(file, format!("cannot be removed: {e}")))
    })
}

/// The depth of a picture in false colour: yellow near, violet far, black where there is nothing to see.
pub fn depth_colors(picture: &Picture, [near, far]: [f64; 2]) -> Image {
    let mut depth = picture.depth.clone();
    for (depth, &opacity) in depth.data.iter_mut().zip(&picture.opacity.data) {
        if opacity < 0.5 {
            *depth = 0.0;
        }
    }
    colormap::depth_map(&depth, near, far)
}
