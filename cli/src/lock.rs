//! Locks of folders.

use std::fs::{File, TryLockError};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::time::Duration;

use raygrad::nerf::{Error, Result, write_atomic};

use super::output::{complain, remove};

/// Lock file of a program that writes all results of a folder.
pub const UNFINISHED: &str = "unfinished.lock";

/// How often, and after which pause, a lock that is taken is tried again.
const TRIES: usize = 5;
const PAUSE: Duration = Duration::from_millis(20);

/// Exclusive access to a folder, until this is dropped or the program ends.
///
/// The lock is on a file. If the folder is moved and another one is created at its path, the lock moves with it. So a
/// second, unlocked file beside it names the owner. Each write to the folder checks the [`state`](Self::state) first.
#[derive(Debug)]
pub struct Lock {
    path: PathBuf,
    /// The process ID and a random number.
    owner: String,
    _file: File,
}

/// State of a lock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// The program still owns the folder.
    Kept,
    /// The owner file is absent: the folder was removed or moved.
    Gone,
    /// Another program owns the folder, or a new one at the same path.
    Lost,
}

/// The file that names the owner of a lock.
pub fn owner_of(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".owner");
    name.into()
}

impl Lock {
    /// Creates and locks a file. `busy` gives the error if another program has locked it.
    ///
    /// If the file system does not support locks, prints a warning, and an earlier owner finds its lock
    /// [lost](State::Lost).
    pub fn take(path: &Path, busy: impl Fn() -> Error) -> Result<Self> {
        Self::take_by(path, busy, File::try_lock)
    }

    fn take_by(
        path: &Path,
        busy: impl Fn() -> Error,
        try_lock: impl Fn(&File) -> std::result::Result<(), TryLockError>,
    ) -> Result<Self> {
        let bad = |e: std::io::Error| Error::file(path, format!("cannot be locked: {e}"));
        let open = || File::options().create(true).truncate(false).write(true).open(path).map_err(bad);
        let (mut file, mut tries) = (open()?, 0);
        loop {
            match try_lock(&file) {
                // Its last owner has removed it after this program opened it.
                Ok(()) if !path.exists() => {}
                Ok(()) => break,
                // Another program may be asking, which takes an instant.
                Err(TryLockError::WouldBlock) => {}
                Err(TryLockError::Error(e)) => {
                    let what = "make sure that no other raygrad writes to this folder";
                    let path = path.display();
                    complain(&format!("warning: {path}: this file system has no locks ({e}): {what}"));
                    break;
                }
            }
            if tries == TRIES {
                return Err(busy());
            }
            std::thread::sleep(PAUSE);
            (file, tries) = (open()?, tries + 1);
        }
        let owner = format!("{} {:016x}\n", std::process::id(), rand::random::<u64>());
        write_atomic(owner_of(path), owner.as_bytes())?;
        let lock = Lock { path: path.into(), owner, _file: file };
        // The last owner may have removed the file after this program opened it, and another program may have created
        // it again.
        match lock.state() {
            State::Kept if path.exists() => Ok(lock),
            _ => Err(busy()),
        }
    }

    /// Returns true if another program has locked the file.
    pub fn is_taken(path: &Path) -> bool {
        // A shared lock, so that programs that ask at one time do not take each other for an owner. Some network file
        // systems lock files only that are open for writing.
        let file = File::options().read(true).write(true).open(path).or_else(|_| File::open(path));
        file.is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
    }

    /// The state of the lock.
    pub fn state(&self) -> State {
        match std::fs::read(owner_of(&self.path)) {
            Ok(owner) if owner == self.owner.as_bytes() => State::Kept,
            Ok(_) => State::Lost,
            // NotADirectory: a file has replaced the folder.
            Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => State::Gone,
            // Temporary errors of the disk do not count.
            Err(_) => State::Kept,
        }
    }

    /// Checks that the lock is kept. `gone` and `lost` say of `folder` what else happened.
    pub fn check(&self, folder: &Path, gone: &str, lost: &str) -> Result<()> {
        match self.state() {
            State::Kept => Ok(()),
            State::Gone => Err(Error::file(folder, gone)),
            State::Lost => Err(Error::file(folder, lost)),
        }
    }

    /// Releases the folder and removes the files of the lock.
    pub fn remove(self) {
        // The owner's file first: it may be another's as soon as the lock's file is gone.
        remove(&[owner_of(&self.path), self.path.clone()]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn take(path: &Path) -> Result<Lock> {
        Lock::take(path, || Error::file(path, "is busy"))
    }

    #[test]
    fn take_while_locked_fails_until_drop() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lock");
        let first = take(&path).unwrap();
        assert_eq!(first.state(), State::Kept);
        assert!(take(&path).unwrap_err().to_string().ends_with("is busy"));
        assert!(Lock::is_taken(&path));
        assert_eq!(first.state(), State::Kept, "asking changes nothing");
        drop(first);
        assert!(!Lock::is_taken(&path) && !Lock::is_taken(&folder.path().join("absent")));
        let second = take(&path).unwrap();
        assert_eq!(second.state(), State::Kept);
        second.remove();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    /// Shards that begin at one time ask for the lock of all, which none of them holds.
    #[test]
    fn asking_does_not_look_like_owning() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lock");
        File::create(&path).unwrap();
        let asking = || (0..2000).filter(|_| Lock::is_taken(&path)).count();
        std::thread::scope(|scope| {
            let others: Vec<_> = (0..3).map(|_| scope.spawn(asking)).collect();
            assert!(others.into_iter().all(|other| other.join().unwrap() == 0));
        });
        // Nor does it keep an owner from taking it.
        let asks = File::open(&path).unwrap();
        asks.lock_shared().unwrap();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                std::thread::sleep(PAUSE);
                asks.unlock().unwrap();
            });
            take(&path).unwrap();
        });
    }

    #[test]
    fn state_of_replaced_folder_is_lost() {
        let folder = tempfile::tempdir().unwrap();
        let [run, moved] = ["run", "moved"].map(|name| folder.path().join(name));
        std::fs::create_dir(&run).unwrap();
        let first = take(&run.join("lock")).unwrap();
        // The owner file names another program, as in a folder that replaced this one.
        let owner = owner_of(&run.join("lock"));
        let own = std::fs::read(&owner).unwrap();
        std::fs::write(&owner, "1 0123456789abcdef\n").unwrap();
        assert_eq!(first.state(), State::Lost);
        std::fs::write(&owner, own).unwrap();
        assert_eq!(first.state(), State::Kept);
        std::fs::remove_file(&owner).unwrap();
        assert_eq!(first.state(), State::Gone);
        // Other errors of reading do not change the state.
        std::fs::create_dir(&owner).unwrap();
        assert_eq!(first.state(), State::Kept);
        drop(first);
        std::fs::rename(&run, &moved).unwrap();
        let first =
            Lock { path: run.join("lock"), owner: String::new(), _file: File::open(moved.join("lock")).unwrap() };
        assert_eq!(first.state(), State::Gone);
        std::fs::write(&run, b"a file").unwrap();
        assert_eq!(first.state(), State::Gone);
    }

    #[cfg(unix)]
    #[test]
    fn take_at_path_of_moved_folder_succeeds() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        let make = || {
            std::fs::create_dir(&run).unwrap();
            take(&run.join("lock")).unwrap()
        };
        let first = make();
        std::fs::rename(&run, folder.path().join("moved")).unwrap();
        let second = make();
        assert_eq!((first.state(), second.state()), (State::Lost, State::Kept));
        std::fs::remove_dir_all(&run).unwrap();
        assert_eq!((first.state(), second.state()), (State::Gone, State::Gone));
    }

    #[test]
    fn take_without_locks_gives_the_last_one_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("lock");
        let none = |_: &File| Err(TryLockError::Error(std::io::Error::from(ErrorKind::Unsupported)));
        let take = || Lock::take_by(&path, || Error::setting("lock", "busy"), none).unwrap();
        let first = take();
        assert_eq!(first.state(), State::Kept);
        let second = take();
        assert_eq!((first.state(), second.state()), (State::Lost, State::Kept));
    }

    #[cfg(unix)]
    #[test]
    fn take_through_link_keeps_the_target() {
        let folder = tempfile::tempdir().unwrap();
        let [notes, path] = ["notes.txt", "lock"].map(|name| folder.path().join(name));
        std::fs::write(&notes, b"mine").unwrap();
        std::os::unix::fs::symlink(&notes, &path).unwrap();
        std::os::unix::fs::symlink(&notes, owner_of(&path)).unwrap();
        let lock = take(&path).unwrap();
        assert_eq!((lock.state(), std::fs::read(&notes).unwrap()), (State::Kept, b"mine".to_vec()));
        lock.remove();
        assert_eq!(std::fs::read(&notes).unwrap(), b"mine");
    }
}
