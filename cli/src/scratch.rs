//! Temporary folders beside results.

use std::ffi::OsStr;
use std::fs::{File, read_dir, read_to_string, remove_dir_all, remove_file, rename};
use std::io::{ErrorKind, Result, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use tempfile::{Builder, TempDir};

use super::output::{complain, note};

/// The file that a program locks while it uses its temporary folder. The system frees the lock of a killed program. The
/// file names the boot of the machine, since locks of other machines are not always seen.
const LOCK: &str = ".raygrad-lock";
/// After this time without a change, a folder of another machine or of another boot counts as abandoned.
const DAY: Duration = Duration::from_secs(24 * 3600);

/// A temporary folder, removed when it is dropped. Folders of killed programs are removed by the next one that makes its
/// own beside them.
pub struct ScratchFolder {
    /// Dropped first: some network file systems keep the folder of an open file.
    lock: File,
    folder: TempDir,
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
        // It gets its name when it is locked, so that nobody finds it free. Without a lock, nobody removes the folder.
        let unnamed = folder.path().join(format!("{LOCK}-new"));
        let mut lock = File::create(&unnamed)?;
        lock.write_all(boot().unwrap_or_default().as_bytes())?;
        match lock.try_lock() {
            Ok(()) => rename(&unnamed, folder.path().join(LOCK))?,
            Err(_) => remove_file(&unnamed)?,
        }
        Ok(ScratchFolder { lock, folder })
    }

    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// Moves the folder, with all that it holds, to its final path; durable as
    /// [`rename_durable`](raygrad::nn::rename_durable). It stays locked until then.
    ///
    /// # Errors
    ///
    /// Fails with the path at which the folder then is.
    pub fn rename(self, to: &Path) -> std::result::Result<(), (std::io::Error, PathBuf)> {
        let ScratchFolder { lock, folder } = self;
        let from = folder.keep();
        // Windows renames no folder with an open file.
        let lock = (!cfg!(windows)).then_some(lock);
        let moved = raygrad::nn::rename_durable(&from, to);
        let at = if from.exists() { from } else { to.to_owned() };
        let _ = remove_file(at.join(LOCK));
        drop(lock);
        moved.map_err(|error| (error, at))
    }

    /// Makes the folder an ordinary one, which nobody removes.
    pub fn keep(self) -> PathBuf {
        let path = self.folder.keep();
        // It has none on file systems without locks.
        let _ = remove_file(path.join(LOCK));
        drop(self.lock);
        path
    }
}

/// The identity of the machine since its start, if the system has one.
fn boot() -> Option<String> {
    Some(read_to_string("/proc/sys/kernel/random/boot_id").ok()?.trim().to_owned())
}

/// Returns true for the names of temporary folders: those of unfinished writes and of unfinished datasets.
pub fn is_scratch(name: &OsStr) -> bool {
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
        let megabytes = contents(&path).0 as f64 / 1e6;
        match remove_dir_all(&path) {
            Ok(()) => note(&format!("{}: removed {megabytes:.1} MB that a killed command left there", path.display())),
            // Another program removes it too.
            Err(e) if e.kind() == ErrorKind::NotFound => {}
            Err(e) => complain(&format!("warning: {}: cannot be removed: {e}", path.display())),
        }
    }
}

/// Returns true for a folder whose lock is free, if a program of this machine has held it since the last start. Others
/// must not have changed for a day. Links and folders without a lock are not abandoned.
fn is_abandoned(folder: &Path) -> bool {
    let path = folder.join(LOCK);
    let about = |path: &Path| path.symlink_metadata();
    // Opening a pipe would wait for its writer.
    if !about(folder).is_ok_and(|about| about.is_dir()) || !about(&path).is_ok_and(|about| about.is_file()) {
        return false;
    }
    // Network file systems lock files only that are open for writing.
    let free = File::options().read(true).write(true).open(&path).is_ok_and(|lock| lock.try_lock().is_ok());
    let here = boot().is_some_and(|boot| read_to_string(&path).is_ok_and(|held| held == boot));
    let is_old = || contents(folder).1.is_some_and(|last| last.elapsed().is_ok_and(|age| age > DAY));
    free && (here || is_old())
}

/// Bytes of all files in a folder, and the time of the last change. Links are not followed.
fn contents(folder: &Path) -> (u64, Option<SystemTime>) {
    let mut all = (0, folder.symlink_metadata().and_then(|about| about.modified()).ok());
    for entry in read_dir(folder).into_iter().flatten().flatten() {
        let Ok(about) = entry.metadata() else { continue };
        let (bytes, last) = if about.is_dir() { contents(&entry.path()) } else { (about.len(), about.modified().ok()) };
        all = (all.0 + bytes, all.1.max(last));
    }
    all
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    /// A temporary folder with 3 bytes, as a killed program of this boot leaves it.
    fn abandoned(parent: &Path, prefix: &str) -> PathBuf {
        let path = ScratchFolder::new(parent, prefix).unwrap().keep();
        std::fs::create_dir(path.join("images")).unwrap();
        std::fs::write(path.join("images/0.png"), "abc").unwrap();
        std::fs::write(path.join(LOCK), boot().unwrap()).unwrap();
        path
    }

    #[test]
    fn next_scratch_folder_removes_abandoned_ones() {
        let folder = tempfile::tempdir().unwrap();
        let prefix = ".scene-unfinished-";
        let left = abandoned(folder.path(), ".other-unfinished-");
        assert!(is_abandoned(&left) && contents(&left).0 == 3 + boot().unwrap().len() as u64);
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

    #[test]
    fn folder_of_another_boot_is_abandoned_after_a_day() {
        let folder = tempfile::tempdir().unwrap();
        let left = abandoned(folder.path(), ".raygrad-tmp-");
        std::fs::write(left.join(LOCK), "another machine").unwrap();
        assert!(!is_abandoned(&left));
        let yesterday = SystemTime::now() - DAY - Duration::from_secs(60);
        for path in [left.join("images/0.png"), left.join("images"), left.join(LOCK), left.clone()] {
            assert!(!is_abandoned(&left), "{path:?} is new");
            File::open(path).unwrap().set_modified(yesterday).unwrap();
        }
        assert!(is_abandoned(&left));
        // A live program of another machine, whose lock is seen.
        let lock = File::open(left.join(LOCK)).unwrap();
        lock.lock().unwrap();
        assert!(!is_abandoned(&left));
    }

    #[test]
    fn rename_moves_the_work_without_its_lock() {
        let folder = tempfile::tempdir().unwrap();
        let make = || {
            let scratch = ScratchFolder::new(folder.path(), ".raygrad-tmp-").unwrap();
            std::fs::write(scratch.path().join("a"), "work").unwrap();
            scratch
        };
        let to = folder.path().join("to");
        make().rename(&to).unwrap();
        assert!(to.join("a").exists() && !to.join(LOCK).exists() && read_dir(folder.path()).unwrap().count() == 1);
        // The target is not empty now.
        let (_, kept) = make().rename(&to).unwrap_err();
        assert!(kept.join("a").exists() && !kept.join(LOCK).exists());
    }

    #[cfg(unix)]
    #[test]
    fn links_and_pipes_are_not_swept() {
        let folder = tempfile::tempdir().unwrap();
        let mine = folder.path().join("mine");
        std::fs::create_dir(&mine).unwrap();
        std::fs::write(mine.join(LOCK), boot().unwrap()).unwrap();
        std::os::unix::fs::symlink(&mine, folder.path().join(".raygrad-tmp-link")).unwrap();
        let piped = folder.path().join(".raygrad-tmp-pipe");
        std::fs::create_dir(&piped).unwrap();
        let made = std::process::Command::new("mkfifo").arg(piped.join(LOCK)).status().unwrap();
        assert!(made.success());
        sweep(folder.path());
        assert!(mine.join(LOCK).exists() && piped.exists());
    }
}
