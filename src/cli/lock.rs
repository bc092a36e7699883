//! Files by which a program keeps others out of a folder.

use std::fs::{File, TryLockError};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};

use raygrad::nerf::{Error, Result};

use super::output::complain;

/// A folder that this program alone writes to, until this is dropped or the program ends, however it does.
///
/// The lock is on a file, and the folder can be moved and made anew with another one. So the file names its owner, and each write
/// to the folder asks for the [`state`](Self::state) before.
#[derive(Debug)]
pub struct Lock {
    path: PathBuf,
    /// The process and a random number.
    owner: String,
    _file: File,
}

/// What has become of a lock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// The folder is still this program's.
    Kept,
    /// There is no such file, or no such folder, any more.
    Gone,
    /// Another program has the folder, or one at the same path.
    Lost,
}

impl Lock {
    /// Locks a file, which is made; `busy` says what to do if another program has it.
    ///
    /// Where the file system has no locks, that is said, and an earlier owner finds its lock [lost](State::Lost).
    pub fn take(path: &Path, busy: impl Fn() -> Error) -> Result<Self> {
        Self::take_by(path, busy, File::try_lock)
    }

    fn take_by(
        path: &Path,
        busy: impl Fn() -> Error,
        try_lock: impl Fn(&File) -> std::result::Result<(), TryLockError>,
    ) -> Result<Self> {
        let bad = |e: std::io::Error| Error::file(path, format!("cannot be locked: {e}"));
        let mut file = File::options().create(true).truncate(false).write(true).open(path).map_err(bad)?;
        match try_lock(&file) {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(busy()),
            Err(TryLockError::Error(e)) => complain(&format!(
                "warning: {}: this file system has no locks ({e}): make sure that no other raygrad writes to this folder",
                path.display()
            )),
        }
        let owner = format!("{} {:016x}\n", std::process::id(), rand::random::<u64>());
        file.write_all(owner.as_bytes()).map_err(bad)?;
        file.set_len(owner.len() as u64).map_err(bad)?;
        let lock = Lock { path: path.into(), owner, _file: file };
        // The last owner may have removed the file while it was being opened here, and another program made it anew.
        match lock.state() {
            State::Kept => Ok(lock),
            State::Gone | State::Lost => Err(busy()),
        }
    }

    /// What has become of it.
    pub fn state(&self) -> State {
        match std::fs::read(&self.path) {
            Ok(owner) if owner == self.owner.as_bytes() => State::Kept,
            Ok(_) => State::Lost,
            // NotADirectory: a file has taken the folder's place.
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => State::Gone,
            // A lock that others respect when they read, as on Windows, or a disk that fails for a moment.
            Err(_) => State::Kept,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn take(path: &Path) -> Result<Lock> {
        Lock::take(path, || Error::file(path, "is busy"))
    }

    #[test]
    fn lock_is_one_programs_until_it_is_dropped() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lock");
        std::fs::write(&path, "a longer word than that of an owner, of an earlier program").unwrap();
        let first = take(&path).unwrap();
        assert_eq!(first.state(), State::Kept);
        assert!(take(&path).unwrap_err().to_string().ends_with("is busy"));
        assert_eq!(first.state(), State::Kept, "asking changes nothing");
        drop(first);
        assert_eq!(take(&path).unwrap().state(), State::Kept);
    }

    #[test]
    fn lock_of_a_folder_that_was_replaced_is_lost() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        let make = || {
            std::fs::create_dir(&run).unwrap();
            take(&run.join("lock")).unwrap()
        };
        let first = make();
        std::fs::rename(&run, folder.path().join("moved")).unwrap();
        assert_eq!(first.state(), State::Gone);
        let second = make();
        assert_eq!((first.state(), second.state()), (State::Lost, State::Kept));
        std::fs::remove_dir_all(&run).unwrap();
        assert_eq!((first.state(), second.state()), (State::Gone, State::Gone));
        std::fs::write(&run, b"a file").unwrap();
        assert_eq!(first.state(), State::Gone);
    }

    #[test]
    fn without_locks_the_last_one_has_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lock");
        let none = |_: &File| Err(TryLockError::Error(std::io::Error::from(ErrorKind::Unsupported)));
        let take = || Lock::take_by(&path, || Error::setting("lock", "busy"), none).unwrap();
        let first = take();
        assert_eq!(first.state(), State::Kept);
        let second = take();
        assert_eq!((first.state(), second.state()), (State::Lost, State::Kept));
    }
}
