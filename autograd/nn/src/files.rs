//! Atomic file writes.

use std::collections::HashSet;
use std::io::{Result, Write};
use std::path::Path;

/// Writes `bytes` to the file `path` atomically: the file then has all of them, or is unchanged.
///
/// The bytes go to a temporary file in the same folder and are flushed to the disk. Then the file is renamed to `path`.
/// An interruption or a full disk leaves no partial file, and does not damage an existing one.
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

/// The first name that cannot be an entry of a safetensors file, if any.
pub(crate) fn bad_entry<'a>(names: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let mut seen = HashSet::new();
    // The format's name for its metadata.
    names.into_iter().find(|name| *name == "__metadata__" || !seen.insert(*name))
}

/// A name from a file for a message: on one line, and cut if it is long.
pub(crate) fn shown(name: &str) -> String {
    name.chars().take(200).flat_map(char::escape_debug).collect()
}
