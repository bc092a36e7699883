//! A folder that is there as a whole or not at all.

use std::path::{Path, PathBuf};

use raygrad::nerf::{Error, Result};
use tempfile::TempDir;

/// A temporary folder beside the one that is to be. Dropped before it is [finished](Self::finish), nothing is left of it.
pub struct Workplace {
    temporary: TempDir,
    out: PathBuf,
}

impl Workplace {
    /// For a folder that does not exist yet, or is empty.
    pub fn new(out: &Path) -> Result<Self> {
        match std::fs::read_dir(out).map(|mut entries| entries.next().is_some()) {
            Ok(true) => {
                return Err(Error::file(out, "holds files already: choose another --out, or remove that folder"));
            }
            Err(_) if out.exists() => return Err(Error::file(out, "is not a folder")),
            _ => {}
        }
        let bad = |e: std::io::Error| Error::file(out, format!("cannot be created: {e}"));
        let out = std::path::absolute(out).map_err(bad)?;
        let name = out.file_name().ok_or_else(|| Error::file(&out, "is no folder that can be made"))?;
        let parent = out.parent().unwrap_or(&out);
        std::fs::create_dir_all(parent).map_err(bad)?;
        // On the same disk, so that it can be moved at the end.
        let prefix = format!(".{}-", name.to_string_lossy());
        let temporary = tempfile::Builder::new().prefix(&prefix).tempdir_in(parent).map_err(bad)?;
        Ok(Workplace { temporary, out })
    }

    /// Where to work.
    pub fn folder(&self) -> &Path {
        self.temporary.path()
    }

    /// Makes a folder in it.
    pub fn make(&self, name: &str) -> Result<PathBuf> {
        let folder = self.folder().join(name);
        std::fs::create_dir_all(&folder).map_err(|e| Error::file(&folder, format!("cannot be created: {e}")))?;
        Ok(folder)
    }

    /// Removes a file or a folder in it that has done its work.
    pub fn remove(&self, name: &str) -> Result<()> {
        let path = self.folder().join(name);
        let removed = if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
        removed.map_err(|e| Error::file(&path, format!("cannot be removed: {e}")))
    }

    /// Puts the folder where it is to be.
    pub fn finish(self) -> Result<()> {
        let bad = |e: std::io::Error| Error::file(&self.out, format!("cannot be created: {e}"));
        // A temporary folder is for its owner alone; this one is to be like any that is made here.
        std::fs::create_dir_all(&self.out).map_err(bad)?;
        let like = std::fs::metadata(&self.out).map_err(bad)?.permissions();
        std::fs::set_permissions(self.folder(), like).map_err(bad)?;
        // It is empty; elsewhere than on Unix a folder is not moved over another.
        std::fs::remove_dir(&self.out).map_err(bad)?;
        std::fs::rename(self.folder(), &self.out).map_err(bad)?;
        // Nothing is left to be removed.
        let _ = self.temporary.keep();
        Ok(())
    }
}
