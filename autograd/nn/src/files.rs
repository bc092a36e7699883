//! Files that are whole or untouched.

use std::collections::HashSet;
use std::io::{Result, Write};
use std::path::Path;

/// Writes `bytes` to the file `path`, which afterwards holds all of them or is untouched.
///
/// The bytes go to a temporary file in the same folder, reach the disk, and only then take the name `path`: an
/// interruption or a full disk never leaves a partial file, nor harms one that was there before.
///
/// # Errors
/// If the folder does not exist or the file cannot be written.
pub fn write_atomic(path: impl AsRef<Path>, bytes: &[u8]) -> Result<()> {
    let path = path.as_ref();
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // Temporary files are private by default; this one becomes an ordinary file, as far as the umask allows.
    #[cfg(unix)]
    let mut file = tempfile::Builder::new()
        .permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666))
        .tempfile_in(folder)?;
    #[cfg(not(unix))]
    let mut file = tempfile::NamedTempFile::new_in(folder)?;
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    file.persist(path).map_err(|error| error.error)?;
    Ok(())
}

/// Whether names can be those of the entries of a safetensors file; the first that cannot.
pub(crate) fn bad_entry<'a>(names: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let mut seen = HashSet::new();
    // What the format calls its metadata.
    names.into_iter().find(|name| *name == "__metadata__" || !seen.insert(*name))
}

/// A name from a file as a message repeats it: on one line, and not all of a long one.
pub(crate) fn shown(name: &str) -> String {
    name.chars().take(200).flat_map(char::escape_debug).collect()
}
