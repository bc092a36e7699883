//! Files that are on the disk, or not there at all.

use crate::error::{Error, Result};
use std::path::Path;

/// Writes `bytes` to the file `path` atomically: afterwards it holds all of them or is unchanged. See
/// [`raygrad_nn::write_atomic`].
///
/// # Errors
/// If the folder does not exist or the file cannot be written; the error names `path`.
pub fn write_atomic(path: impl AsRef<Path>, bytes: &[u8]) -> Result<()> {
    let path = path.as_ref();
    raygrad_nn::write_atomic(path, bytes).map_err(|e| Error::file(path, format!("cannot be written: {e}")))
}

/// Renames a file, or a folder with all that it holds, such that a loss of power leaves all of it at one of both paths.
/// See [`raygrad_nn::rename_durable`].
///
/// # Errors
/// If the contents cannot be flushed or the rename fails; the error names `to`.
pub fn rename_durable(from: impl AsRef<Path>, to: impl AsRef<Path>) -> Result<()> {
    let to = to.as_ref();
    raygrad_nn::rename_durable(from, to).map_err(|e| Error::file(to, format!("cannot be written: {e}")))
}

/// Creates a folder with its parents, which a loss of power then leaves in place. See [`raygrad_nn::create_folder`].
///
/// # Errors
/// If a folder cannot be created; the error names `folder`.
pub fn create_folder(folder: impl AsRef<Path>) -> Result<()> {
    let folder = folder.as_ref();
    raygrad_nn::create_folder(folder).map_err(|e| Error::file(folder, format!("cannot be created: {e}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn failed_write_names_and_keeps_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let absent = folder.path().join("absent/image.png");
        let message = write_atomic(&absent, b"x").unwrap_err().to_string();
        assert!(message.contains("absent/image.png: cannot be written"), "{message}");
        // A folder at the path of the file makes the rename fail; the temporary file is removed.
        let taken = folder.path().join("taken");
        std::fs::create_dir(&taken).unwrap();
        std::fs::write(taken.join("inside"), b"kept").unwrap();
        assert!(write_atomic(&taken, b"x").is_err());
        assert_eq!(std::fs::read(taken.join("inside")).unwrap(), b"kept");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}
