//! Terminal output, and output folders.

use std::borrow::Cow;
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use raygrad::nerf::imaging::colormap;
use raygrad::nerf::{Error, Image, Render, Result, create_folder};

use super::ranks;

/// Writes to standard output, on rank 0 alone. A closed pipe (`raygrad eval run | head -1`) or a closed terminal is not an error.
pub fn print(text: &str) -> Result<()> {
    if ranks::is_silent() {
        return Ok(());
    }
    let text = printable(text);
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if !is_gone(&e, is_device(&out)) => Err(Error::setting("stdout", format!("cannot be written: {e}"))),
        _ => Ok(()),
    }
}

/// Returns true if the reader of standard output has gone. `is_device` tells whether it is a device.
fn is_gone(error: &std::io::Error, is_device: bool) -> bool {
    /// Error number of writing to a closed terminal, the same on all Unix systems.
    const EIO: i32 = 5;
    error.kind() == ErrorKind::BrokenPipe || (cfg!(unix) && is_device && error.raw_os_error() == Some(EIO))
}

/// Returns true for a device, as terminals are. After a hang-up, `is_terminal` is false.
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

/// Lists at most `most` names, and counts the others: `a, b and 3 more`.
pub fn listed(names: &[String], most: usize) -> String {
    let (named, rest) = names.split_at(most.min(names.len()));
    let more = if rest.is_empty() { String::new() } else { format!(" and {} more", rest.len()) };
    named.join(", ") + &more
}

/// A path as a shell takes it, for commands in messages: in quotes if it has other characters than those of plain names.
/// One that begins like a flag becomes `./-name`.
pub fn quoted(path: &Path) -> String {
    let start = if path.to_string_lossy().starts_with('-') { "./" } else { "" };
    let path = format!("{start}{}", path.display());
    let is_plain = |c: char| c.is_alphanumeric() || "._-/:+@,".contains(c) || cfg!(windows) && c == '\\';
    match path.chars().all(is_plain) {
        true => path,
        false if cfg!(windows) => format!("\"{path}\""),
        false => format!("'{}'", path.replace('\'', r"'\''")),
    }
}

/// Writes a line to standard error, on rank 0 alone. Ignores errors, unlike `eprintln`, which panics if standard error is closed.
pub fn note(line: &str) {
    if !ranks::is_silent() {
        write(line);
    }
}

fn write(line: &str) {
    let _ = writeln!(std::io::stderr(), "{}", printable(line));
}

/// The text with escapes in place of control characters, which a terminal would obey. Names of files have any.
fn printable(text: &str) -> Cow<'_, str> {
    let is_obeyed = |c: char| c.is_control() && !"\n\t".contains(c);
    if !text.contains(is_obeyed) {
        return text.into();
    }
    text.chars()
        .fold(String::new(), |mut text, c| {
            if is_obeyed(c) {
                text.extend(c.escape_default())
            } else {
                text.push(c)
            }
            text
        })
        .into()
}

/// Writes a warning or an error to standard error.
pub fn complain(line: &str) {
    note(&format!("raygrad: {line}"));
}

/// Writes the error that ends this process to standard error, with the rank if there are several.
pub fn complain_of(error: &Error) {
    let rank = ranks::own().map_or(String::new(), |(rank, _)| format!("rank {rank}: "));
    write(&format!("raygrad: {rank}{error}"));
}

/// The parent folder of a file.
pub fn parent(file: &Path) -> &Path {
    file.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Fails if files cannot be created in a folder. Called before long work.
pub fn check_writable(folder: &Path) -> Result<()> {
    tempfile::tempfile_in(folder).map(drop).map_err(|e| Error::file(folder, format!("cannot be written to: {e}")))
}

/// The CRC-32 of a file, which identifies it in records.
pub fn checksum(path: &Path) -> Result<String> {
    let bytes = std::fs::read(path).map_err(|e| Error::file(path, format!("cannot be read: {e}")))?;
    Ok(format!("{:08x}", crc32fast::hash(&bytes)))
}

/// The paths in a folder, sorted by name.
pub fn entries(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).and_then(|all| all.map(|entry| Ok(entry?.path())).collect());
    let mut paths: Vec<PathBuf> = entries.map_err(|e| Error::file(folder, format!("cannot be read: {e}")))?;
    paths.sort();
    Ok(paths)
}

/// Notes that there are fewer of something than a flag asks for.
pub fn note_fewer(flag: &str, asked: Option<usize>, there: usize, what: &str) {
    if let Some(asked) = asked.filter(|asked| *asked > there) {
        note(&format!("--{flag} {asked}: there are only {there} {what}"));
    }
}

/// Returns true for a file that is not empty. Some file systems leave an empty one after a loss of power.
pub fn is_written(file: &Path) -> bool {
    file.metadata().is_ok_and(|about| about.is_file() && about.len() > 0)
}

/// Creates a folder with its parents and checks that it is writable.
pub fn make_folder(folder: &Path) -> Result<()> {
    create_folder(folder)?;
    check_writable(folder)
}

/// Numbered images of an earlier, longer sequence: files with at least `digits` digits that are not in `written`.
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

/// The file name of a numbered image.
pub fn numbered(number: usize, digits: usize) -> String {
    format!("{number:0digits$}.png")
}

/// Removes images of an earlier, longer sequence. Failures are not errors, since the new images are complete.
pub fn remove(files: &[PathBuf]) {
    for file in files {
        if let Err(e) = std::fs::remove_file(file) {
            complain(&format!("{}: cannot be removed: {e}", file.display()));
        }
    }
}

/// If far is more than this many times near, depth maps are logarithmic.
const DEEP: f64 = 100.0;

/// The depth of a render in false colour: yellow near, violet far, black where it is empty. For unbounded scenes the
/// scale is logarithmic, from 2 to 200 times the near distance.
pub fn depth_colors(picture: &Render, [near, far]: [f64; 2]) -> Image {
    let mut depth = picture.depth.clone();
    for (depth, &opacity) in depth.data.iter_mut().zip(&picture.opacity.data) {
        if opacity < 0.5 {
            *depth = 0.0;
        }
    }
    // Near may be 0.
    let near = near.max(1e-5 * far);
    if far <= DEEP * near {
        return colormap::depth_map(&depth, near, far);
    }
    let ends = [2.0 * near, far.min(2.0 * DEEP * near)].map(f64::ln);
    let share = |depth: f32| ((f64::from(depth).ln() - ends[0]) / (ends[1] - ends[0])).clamp(0.0, 1.0) as f32;
    // The scale is 1 to 2, since 0 marks empty pixels.
    depth.data.iter_mut().filter(|depth| **depth > 0.0).for_each(|depth| *depth = 1.0 + share(*depth));
    colormap::depth_map(&depth, 1.0, 2.0)
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn quoted_paths_are_no_flags() {
        for (path, expected) in
            [("run", "run"), ("my run", "'my run'"), ("-run", "./-run"), ("--a b", "'./--a b'"), ("a/-b", "a/-b")]
        {
            // Windows has other quotation marks.
            assert_eq!(quoted(Path::new(path)).replace('"', "'"), expected);
        }
    }

    #[test]
    fn printable_text_commands_no_terminal() {
        assert_eq!(printable("a\tb\nä\u{1b}[2J\u{7}\u{9b}\r"), "a\tb\nä\\u{1b}[2J\\u{7}\\u{9b}\\r");
        assert!(matches!(printable("plain"), Cow::Borrowed("plain")));
    }

    #[test]
    fn is_gone_for_closed_pipe_or_terminal_only() {
        let error = |number: i32| std::io::Error::from_raw_os_error(number);
        // A closed pipe, a closed terminal, a failing disk, and a full one.
        for (number, is_device, gone) in [(32, false, true), (5, true, true), (5, false, false), (28, true, false)] {
            assert_eq!(is_gone(&error(number), is_device), gone, "{number} {is_device}");
        }
        let device = std::fs::File::open("/dev/null").unwrap();
        assert!(is_device(&device) && !is_device(&tempfile::tempfile().unwrap()));
    }
}
