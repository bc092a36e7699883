//! Output folders that appear complete or not at all.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use raygrad::nerf::{Error, Result};

use crate::output::complain;
use crate::scratch::{ScratchFolder, UNFINISHED, is_scratch};

/// A temporary folder on the disk of the output folder. It is removed if it is dropped before [`finish`](Self::finish).
pub struct Workplace {
    temporary: ScratchFolder,
    out: PathBuf,
    /// True if the output folder existed and was empty. The temporary folder is then inside it.
    is_inside: bool,
}

impl Workplace {
    /// Creates a temporary folder for an output folder that is absent or empty. An empty folder is kept. It may be a
    /// mount point, the target of a link, or the only writable folder.
    pub fn new(out: &Path) -> Result<Self> {
        let bad = |e: std::io::Error| Error::file(out, format!("cannot be created: {e}"));
        let is_inside = match others(out) {
            Ok(others) if !others.is_empty() => {
                return Err(Error::file(out, "is not empty: choose another folder"));
            }
            Ok(_) => true,
            Err(e) if out.is_dir() => return Err(Error::file(out, format!("cannot be read: {e}"))),
            Err(_) if out.exists() => return Err(Error::file(out, "is not a folder")),
            Err(_) if out.is_symlink() => {
                let what = "is a symbolic link to a folder that does not exist: create that folder or choose another";
                return Err(Error::file(out, what));
            }
            Err(_) => false,
        };
        let absolute = std::path::absolute(out).map_err(bad)?;
        let name = absolute.file_name().ok_or_else(|| Error::file(out, "is not a valid folder name"))?;
        let folder = if is_inside { &absolute } else { absolute.parent().unwrap_or(&absolute) };
        std::fs::create_dir_all(folder).map_err(bad)?;
        let prefix = format!(".{}{UNFINISHED}", name.to_string_lossy());
        let temporary = ScratchFolder::new(folder, &prefix).map_err(bad)?;
        Ok(Workplace { temporary, out: absolute, is_inside })
    }

    /// The temporary folder.
    pub fn folder(&self) -> &Path {
        self.temporary.path()
    }

    /// Creates a subfolder.
    pub fn make(&self, name: &str) -> Result<PathBuf> {
        let folder = self.folder().join(name);
        std::fs::create_dir_all(&folder).map_err(|e| Error::file(&folder, format!("cannot be created: {e}")))?;
        Ok(folder)
    }

    /// Removes a subfolder that is no longer needed. Failure gives a warning only, since the other files are valid.
    pub fn remove(&self, name: &str) {
        let path = self.folder().join(name);
        if let Err(e) = std::fs::remove_dir_all(&path) {
            complain(&format!("warning: {}: cannot be removed: {e}", path.display()));
        }
    }

    /// Moves the folder to its final path.
    ///
    /// # Errors
    ///
    /// Fails if that path now holds files or is not writable. The finished work is kept, and the error names its
    /// folder.
    pub fn finish(self) -> Result<()> {
        let Workplace { temporary, out, is_inside } = self;
        let moved = match is_inside {
            true => {
                let done = temporary.keep();
                move_up(&done, &out).map_err(|e| (e, done))
            }
            false => temporary.rename(&out),
        };
        moved.map_err(|(e, done)| {
            if done == out {
                return Error::file(&out, format!("is complete, but may not outlast a loss of power: {e}"));
            }
            let done = done.display();
            Error::file(&out, format!("cannot be written: {e}; the result is complete: move it from {done}"))
        })
    }
}

/// Files of empty folders on some systems.
const NOTHING: [&str; 2] = ["lost+found", ".DS_Store"];

/// The entries of a folder, except for temporary ones, such as those of a killed program.
pub fn others(folder: &Path) -> std::io::Result<Vec<OsString>> {
    let names = std::fs::read_dir(folder)?.map(|entry| Ok(entry?.file_name()));
    let is_other = |name: &OsString| !(NOTHING.iter().any(|nothing| name == *nothing) || is_scratch(name));
    Ok(names.collect::<std::io::Result<Vec<_>>>()?.into_iter().filter(is_other).collect())
}

/// Moves all entries of a folder to its parent, which holds nothing else.
fn move_up(from: &Path, to: &Path) -> std::io::Result<()> {
    if !others(to)?.is_empty() {
        return Err(std::io::Error::other("it is no longer empty"));
    }
    for entry in std::fs::read_dir(from)? {
        let name = entry?.file_name();
        raygrad::nn::rename_durable(from.join(&name), to.join(&name))?;
    }
    std::fs::remove_dir(from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// A workplace with a finished file.
    fn filled(out: &Path) -> Workplace {
        let place = Workplace::new(out).unwrap();
        fs::write(place.make("images").unwrap().join("0.png"), b"work").unwrap();
        place
    }

    fn names(folder: &Path) -> Vec<String> {
        let names = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
        let mut names: Vec<String> = names.collect();
        names.sort();
        names
    }

    /// The folder that the error names.
    fn kept(error: &Error) -> PathBuf {
        let message = error.to_string();
        let (_, kept) = message.split_once("the result is complete: move it from ").unwrap();
        kept.into()
    }

    #[test]
    fn finish_moves_to_new_and_empty_folders() {
        let folder = tempfile::tempdir().unwrap();
        let [new, empty] = ["a/new", "empty"].map(|name| folder.path().join(name));
        fs::create_dir(&empty).unwrap();
        for out in [&new, &empty] {
            filled(out).finish().unwrap();
            assert_eq!((names(out), names(&out.join("images"))), (vec!["images".to_owned()], vec!["0.png".to_owned()]));
        }
        assert_eq!(names(folder.path()), ["a", "empty"]);
        assert_eq!(names(&folder.path().join("a")), ["new"]);
        // A failed removal does not prevent finishing.
        let place = filled(&folder.path().join("finished"));
        place.remove("absent");
        place.remove("images");
        place.finish().unwrap();
        assert!(names(&folder.path().join("finished")).is_empty());
        fs::remove_dir(folder.path().join("finished")).unwrap();
        // Files of the system or of a killed program do not count.
        fs::remove_dir_all(&empty).unwrap();
        fs::create_dir_all(empty.join("lost+found")).unwrap();
        fs::create_dir_all(empty.join(".empty-unfinished-abc")).unwrap();
        let other = filled(&empty);
        filled(&empty).finish().unwrap();
        assert_eq!(fs::read(kept(&other.finish().unwrap_err()).join("images/0.png")).unwrap(), b"work");
        // An unfinished workplace is removed on drop.
        let gone = folder.path().join("gone");
        drop(filled(&gone));
        fs::create_dir(&gone).unwrap();
        drop(filled(&gone));
        assert!(names(&gone).is_empty());
        assert!(Workplace::new(&new).err().unwrap().to_string().contains("is not empty"));
        assert!(Workplace::new(&new.join("images/0.png")).err().unwrap().to_string().contains("is not a folder"));
        assert_eq!(names(folder.path()), ["a", "empty", "gone"]);
    }

    #[test]
    fn finish_failing_keeps_the_work() {
        let folder = tempfile::tempdir().unwrap();
        let file = |kept: &Path| fs::read(kept.join("images/0.png")).unwrap();
        // An empty folder and an absent one, which gain a file during the work.
        for exists in [true, false] {
            let out = folder.path().join(format!("gains-{exists}"));
            if exists {
                fs::create_dir(&out).unwrap();
            }
            let place = filled(&out);
            fs::create_dir_all(&out).unwrap();
            fs::write(out.join("notes.txt"), b"mine").unwrap();
            let error = place.finish().unwrap_err();
            assert!(error.to_string().starts_with(&format!("{}: cannot be written: ", out.display())), "{error}");
            assert_eq!(file(&kept(&error)), b"work");
            assert_eq!(fs::read(out.join("notes.txt")).unwrap(), b"mine");
        }
        // A file replaces the folder.
        let out = folder.path().join("file");
        let place = filled(&out);
        fs::write(&out, b"mine").unwrap();
        assert_eq!(file(&kept(&place.finish().unwrap_err())), b"work");
        assert_eq!(fs::read(&out).unwrap(), b"mine");
    }

    #[cfg(unix)]
    #[test]
    fn atomic_write_follows_links_keeps_permissions() {
        use std::os::unix::fs::{PermissionsExt, symlink};
        let folder = tempfile::tempdir().unwrap();
        let [target, link, lost] = ["target", "link", "lost"].map(|name| folder.path().join(name));
        fs::create_dir(&target).unwrap();
        symlink(&target, &link).unwrap();
        filled(&link).finish().unwrap();
        assert!(link.is_symlink() && target.join("images/0.png").exists());
        symlink(folder.path().join("absent"), &lost).unwrap();
        assert!(
            Workplace::new(&lost).err().unwrap().to_string().contains("is a symbolic link to a folder that does not")
        );
        assert_eq!(names(folder.path()), ["link", "lost", "target"]);
        // The permissions of a new folder.
        let [made, new] = ["made", "new"].map(|name| folder.path().join(name));
        fs::create_dir(&made).unwrap();
        filled(&new).finish().unwrap();
        let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode();
        assert_eq!(mode(&new), mode(&made));
    }
}
