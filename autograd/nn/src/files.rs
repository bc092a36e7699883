//! Files that are on the disk, or not there at all: whatever ends the program, or the power.

use std::collections::HashSet;
use std::fs::File;
use std::io::ErrorKind::{InvalidInput, PermissionDenied, Unsupported};
use std::io::{Result, Write};
use std::path::Path;

/// How the names of temporary files and folders begin. Those that a killed program has left are of no use.
pub const TEMPORARY_PREFIX: &str = ".raygrad-tmp-";

/// Writes `bytes` to the file `path` atomically: the file then has all of them, or is unchanged.
///
/// The bytes go to a temporary file in the same folder and are flushed to the disk. Then the file is renamed to `path`,
/// and the folder is flushed. An interruption or a full disk leaves no partial file, and does not damage an existing
/// one. After a loss of power the file has the old or the new bytes.
///
/// # Errors
/// If the folder does not exist or the file cannot be written; or if the folder cannot be flushed, when the file has its
/// new bytes.
pub fn write_atomic(path: impl AsRef<Path>, bytes: &[u8]) -> Result<()> {
    let path = path.as_ref();
    let folder = parent(path);
    // Temporary files are private by default; this one becomes an ordinary file, as far as the umask allows.
    #[cfg(unix)]
    let mut file = tempfile::Builder::new()
        .prefix(TEMPORARY_PREFIX)
        .permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666))
        .tempfile_in(folder)?;
    #[cfg(not(unix))]
    let mut file = tempfile::Builder::new().prefix(TEMPORARY_PREFIX).tempfile_in(folder)?;
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    file.persist(path).map_err(|error| error.error)?;
    sync_folder(folder)
}

/// Renames a file, or a folder with all that it holds, such that a loss of power leaves all of it at one of both paths:
/// flushes the contents, renames, and flushes the folders of both paths.
///
/// # Errors
/// If the contents cannot be flushed or the rename fails, when nothing is renamed; or if a folder cannot be flushed, when
/// it is renamed.
pub fn rename_durable(from: impl AsRef<Path>, to: impl AsRef<Path>) -> Result<()> {
    let (from, to) = (from.as_ref(), to.as_ref());
    sync_all(from)?;
    std::fs::rename(from, to)?;
    let folders = [from, to].map(parent);
    sync_folder(folders[1])?;
    if folders[0] == folders[1] { Ok(()) } else { sync_folder(folders[0]) }
}

/// Creates a folder with its parents, and flushes the folders that have gained one.
///
/// # Errors
/// If a folder cannot be created or flushed.
pub fn create_folder(folder: impl AsRef<Path>) -> Result<()> {
    let folder = folder.as_ref();
    let new: Vec<&Path> =
        folder.ancestors().take_while(|path| !path.as_os_str().is_empty() && !path.is_dir()).collect();
    std::fs::create_dir_all(folder)?;
    new.into_iter().try_for_each(|path| sync_folder(parent(path)))
}

/// Flushes a file, or a folder with all that it holds. Links are not followed.
fn sync_all(path: &Path) -> Result<()> {
    let kind = path.symlink_metadata()?.file_type();
    if kind.is_dir() {
        std::fs::read_dir(path)?.try_for_each(|entry| sync_all(&entry?.path()))?;
        return sync_folder(path);
    }
    if kind.is_file() { File::open(path)?.sync_all() } else { Ok(()) }
}

/// Flushes the names in a folder, where the system and the permissions allow it.
fn sync_folder(folder: &Path) -> Result<()> {
    if cfg!(not(unix)) {
        return Ok(());
    }
    match File::open(folder).and_then(|folder| folder.sync_all()) {
        Err(error) if [PermissionDenied, InvalidInput, Unsupported].contains(&error.kind()) => Ok(()),
        result => result,
    }
}

/// The folder of a path.
fn parent(path: &Path) -> &Path {
    path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rename_durable_moves_files_and_folders() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        create_folder(at("a/b/c")).unwrap();
        create_folder(at("a/b")).unwrap();
        std::fs::write(at("a/b/file"), b"bytes").unwrap();
        #[cfg(unix)]
        std::os::unix::fs::symlink(at("absent"), at("a/b/link")).unwrap();
        rename_durable(at("a/b"), at("moved")).unwrap();
        rename_durable(at("moved/file"), at("moved/c/file")).unwrap();
        assert_eq!(std::fs::read(at("moved/c/file")).unwrap(), b"bytes");
        assert!(!at("a/b").exists() && rename_durable(at("absent"), at("new")).is_err());
        std::fs::write(at("taken"), b"kept").unwrap();
        assert!(create_folder(at("taken/inside")).is_err());
    }
}
