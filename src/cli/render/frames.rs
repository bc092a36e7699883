//! Frames in a folder, one file each, which another call goes on with.

use std::path::{Path, PathBuf};

use raygrad::nerf::{Error, Result, write_atomic};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::cli::output::{complain, make_folder, numbered, other_numbered, remove};
use crate::cli::run::write_json;

/// Digits of the number of a frame.
pub const DIGITS: usize = 4;
/// The file that says what the frames of a folder are pictures of, while some are to come.
const RECORD: &str = "unfinished.json";

/// Frames of a path, some of which may be there already.
pub struct Frames {
    folder: PathBuf,
    record: Record,
}

/// What is written down beside frames.
#[derive(Serialize, Deserialize)]
struct Record {
    /// All that decides what they show.
    of: Value,
    /// How many are there, from the first.
    done: usize,
}

impl Frames {
    /// In a folder, which is made. Frames that an interrupted call has left there are kept if they are `of` the same;
    /// all others are replaced one by one.
    pub fn new(folder: PathBuf, of: Value) -> Result<Self> {
        make_folder(&folder)?;
        // What cannot be read is begun again.
        let left =
            std::fs::read(folder.join(RECORD)).ok().and_then(|text| serde_json::from_slice::<Record>(&text).ok());
        let done = left.filter(|left| left.of == of).map_or(0, |left| left.done);
        let mut frames = Frames { folder, record: Record { of, done: 0 } };
        frames.record.done = (0..done).take_while(|&frame| frames.path(frame).is_file()).count();
        frames.write()?;
        Ok(frames)
    }

    /// How many there are, from the first.
    pub fn done(&self) -> usize {
        self.record.done
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Writes the next frame: what is to lie in folders beside it by the folder's name and the file's ending, and last
    /// the picture.
    pub fn push(&mut self, picture: &[u8], layers: &[(&str, &str, Vec<u8>)]) -> Result<()> {
        let path = self.path(self.record.done);
        for (layer, ending, bytes) in layers {
            let folder = self.folder.join(layer);
            std::fs::create_dir_all(&folder).map_err(|e| Error::file(&folder, format!("cannot be created: {e}")))?;
            let name = Path::new(&numbered(self.record.done, DIGITS)).with_extension(ending);
            write_atomic(folder.join(name), bytes)?;
        }
        write_atomic(path, picture)?;
        self.record.done += 1;
        self.write()
    }

    /// Leaves the frames as they are, with nothing to go on with.
    pub fn keep(self) {
        remove(&[self.folder.join(RECORD)]);
    }

    /// Removes all frames, and the folder unless there is something else in it.
    pub fn remove(self) {
        remove(&other_numbered(&self.folder, DIGITS, &[]));
        remove(&[self.folder.join(RECORD)]);
        if let Err(e) = std::fs::remove_dir(&self.folder) {
            complain(&format!("{}: cannot be removed: {e}", self.folder.display()));
        }
    }

    fn path(&self, frame: usize) -> PathBuf {
        self.folder.join(numbered(frame, DIGITS))
    }

    fn write(&self) -> Result<()> {
        write_json(&self.folder.join(RECORD), &self.record)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn frames_are_gone_on_with_if_they_are_of_the_same() {
        let place = tempfile::tempdir().unwrap();
        let folder = || place.path().join("frames");
        let mut frames = Frames::new(folder(), json!({ "model": 1 })).unwrap();
        for i in 0..3_u8 {
            frames.push(&[i], &[("depth", "npy", vec![10 + i])]).unwrap();
        }
        let read = |name: &str| std::fs::read(folder().join(name)).unwrap();
        assert_eq!((read("0002.png"), read("depth/0002.npy")), (vec![2], vec![12]));
        assert_eq!(Frames::new(folder(), json!({ "model": 1 })).unwrap().done(), 3);
        // From one that is no longer there on.
        std::fs::remove_file(folder().join("0001.png")).unwrap();
        let mut again = Frames::new(folder(), json!({ "model": 1 })).unwrap();
        assert_eq!(again.done(), 1);
        again.push(&[7], &[]).unwrap();
        assert_eq!(read("0001.png"), [7]);
        assert_eq!(Frames::new(folder(), json!({ "model": 2 })).unwrap().done(), 0);
        // It was begun again: what lies there now is of another model.
        assert_eq!(Frames::new(folder(), json!({ "model": 1 })).unwrap().done(), 0);
        std::fs::write(folder().join(RECORD), "{").unwrap();
        assert_eq!(Frames::new(folder(), json!({ "model": 1 })).unwrap().done(), 0);
        Frames::new(folder(), json!({})).unwrap().keep();
        assert!(!folder().join(RECORD).exists() && folder().join("0000.png").exists());
        std::fs::remove_dir_all(folder().join("depth")).unwrap();
        Frames::new(folder(), json!({})).unwrap().remove();
        assert!(!folder().exists());
    }
}
