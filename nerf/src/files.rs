//! Atomic writing of files.

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
