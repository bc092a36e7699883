//! Temporary folders beside results.

use std::ffi::OsStr;
use std::fs::{File, read_dir, remove_dir_all, remove_file, rename};
use std::io::Result;
use std::path::{Path, PathBuf};

use tempfile::{Builder, TempDir};

use super::output::{complain, note};

/// The file that a program locks while it uses its temporary folder. The system frees the lock of a killed program.
const LOCK: &str = ".raygrad-lock";

/// A temporary folder, removed when it is dropped. Folders of killed programs are removed by the next one that makes its
/// own beside them.
pub struct ScratchFolder {
    folder: TempDir,
    _lock: File,
}

impl ScratchFolder {
    /// Creates a folder in `parent`. Its name begins with `prefix`, and [`is_scratch`] must hold for it.
    ///
    /// Removes abandoned folders first, and says so.
    pub fn new(parent: &Path, prefix: &str) -> Result<Self> {
        sweep(parent);
        let mut builder = Builder::new();
        // Temporary folders are private by default. This one becomes an ordinary folder, subject to the umask.
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o777));
        let folder = builder.prefix(prefix).tempdir_in(parent)?;
        // Locked before it has its name, so that nobody finds it free.
        let unnamed = folder.path().join(format!("{LOCK}-new"));
        let lock = File::create(&unnamed)?;
        // Without locks on this file system, nobody removes abandoned folders there.
        let _ = lock.try_lock();
        rename(&unnamed, folder.path().join(LOCK))?;
        Ok(ScratchFolder { folder, _lock: lock })
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Makes the folder an ordinary one, which nobody removes.
    pub fn keep(self) -> PathBuf {
        let path = self.folder.keep();
        let _ = remove_file(path.join(LOCK));
        path
    }
}

/// Returns true for the names of temporary folders: those of unfinished writes and of unfinished datasets.
fn is_scratch(name: &OsStr) -> bool {
    let name = name.to_string_lossy();
    name.starts_with(raygrad::nn::TEMPORARY_PREFIX) || name.starts_with('.') && name.contains(UNFINISHED)
}

/// In the name of the temporary folder of a dataset, after that of the dataset.
pub const UNFINISHED: &str = "-unfinished-";

/// Removes the temporary folders in a folder whose programs were killed.
pub fn sweep(parent: &Path) {
    for entry in read_dir(parent).into_iter().flatten().flatten() {
        let path = entry.path();
        if !is_scratch(&entry.file_name()) || !is_abandoned(&path) {
            continue;
        }
        let bytes = size(&path);
        match remove_dir_all(&path) {
            Ok(()) => note(&format!(
                "{}: removed {:.1} MB that a killed command left there",
                path.display(),
                bytes as f64 / 1e6
            )),
            Err(e) => complain(&format!("warning: {}: cannot be removed: {e}", path.display())),
        }
    }
}

/// Returns true for a folder whose lock is free. Links, folders without a lock and those of file systems without locks
/// are not abandoned.
fn is_abandoned(folder: &Path) -> bool {
    let is_folder = folder.symlink_metadata().is_ok_and(|about| about.is_dir());
    is_folder && File::open(folder.join(LOCK)).is_ok_and(|lock| lock.try_lock().is_ok())
}

/// Bytes of all files in a folder. Links are not followed.
fn size(folder: &Path) -> u64 {
    let entries = read_dir(folder).into_iter().flatten().flatten();
    let size = |entry: std::fs::DirEntry| match entry.metadata() {
        Ok(about) if about.is_dir() => size(&entry.path()),
        Ok(about) => about.len(),
        Err(_) => 0,
    };
    entries.map(size).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A temporary folder with 3 bytes, as a killed program leaves it.
    fn abandoned(parent: &Path, prefix: &str) -> PathBuf {
        let scratch = ScratchFolder::new(parent, prefix).unwrap();
        let path = scratch.keep();
        std::fs::create_dir(path.join("images")).unwrap();
        std::fs::write(path.join("images/0.png"), "abc").unwrap();
        File::create(path.join(LOCK)).unwrap();
        path
    }

    #[test]
    fn next_scratch_folder_removes_abandoned_ones() {
        let folder = tempfile::tempdir().unwrap();
        let prefix = ".scene-unfinished-";
        let left = abandoned(folder.path(), ".other-unfinished-");
        assert!(is_abandoned(&left) && size(&left) == 3);
        let used = ScratchFolder::new(folder.path(), prefix).unwrap();
        assert!(!left.exists() && !is_abandoned(used.path()));
        // Folders that raygrad did not make, or has told the user to use, stay.
        let kept = ScratchFolder::new(folder.path(), prefix).unwrap().keep();
        let foreign = folder.path().join(".my-unfinished-symphony");
        std::fs::create_dir(&foreign).unwrap();
        let named = folder.path().join("mine");
        std::fs::create_dir(&named).unwrap();
        File::create(named.join(LOCK)).unwrap();
        let next = ScratchFolder::new(folder.path(), prefix).unwrap();
        let paths = [used.path(), &kept, &foreign, &named, next.path()];
        assert!(paths.iter().all(|path| path.exists()) && read_dir(&kept).unwrap().next().is_none());
        let paths = [used.path().to_owned(), next.path().to_owned()];
        drop((used, next));
        assert!(paths.iter().all(|path| !path.exists()));
    }

    #[cfg(unix)]
    #[test]
    fn linked_folder_is_not_swept() {
        let folder = tempfile::tempdir().unwrap();
        let mine = folder.path().join("mine");
        std::fs::create_dir(&mine).unwrap();
        File::create(mine.join(LOCK)).unwrap();
        std::os::unix::fs::symlink(&mine, folder.path().join(".raygrad-tmp-link")).unwrap();
        sweep(folder.path());
        assert!(mine.join(LOCK).exists());
    }
}
