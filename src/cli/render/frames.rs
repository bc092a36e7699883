//! Frames in a folder, one file each, which another call goes on with.

use std::fs::File;
use std::path::{Path, PathBuf};

use raygrad::nerf::{Error, Result, write_atomic};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::cli::output::{complain, lock, make_folder, note, numbered, other_numbered, remove};
use crate::cli::run::write_json;

/// Digits of the number of a frame.
pub const DIGITS: usize = 4;
/// The file that says what the frames of a folder are pictures of, while some are to come.
const RECORD: &str = "unfinished.json";
/// The file by which a program keeps others from writing frames there.
const LOCK: &str = "unfinished.lock";

/// Frames of a path, some of which may be there already.
pub struct Frames {
    folder: PathBuf,
    record: Record,
    _lock: File,
}

/// What is written down beside frames.
#[derive(Serialize, Deserialize)]
struct Record {
    /// All that decides what they show.
    of: Value,
    /// How many are there, from the first.
    done: usize,
    /// Whether pictures by number were there before the first frame, which somebody may want to keep.
    #[serde(default)]
    strange: bool,
}

impl Frames {
    /// In a folder, which is made. Frames that an interrupted call has left there are kept if they are `of` the same;
    /// all others are replaced one by one.
    ///
    /// # Errors
    /// If it cannot be written, or another program writes frames there.
    pub fn new(folder: PathBuf, of: Value) -> Result<Self> {
        make_folder(&folder)?;
        let lock = lock(&folder.join(LOCK), || Error::file(&folder, "is being rendered to by another raygrad"))?;
        // What cannot be read is begun again.
        let left =
            std::fs::read(folder.join(RECORD)).ok().and_then(|text| serde_json::from_slice::<Record>(&text).ok());
        let strange = match &left {
            Some(left) => left.strange,
            None => !other_numbered(&folder, DIGITS, &[]).is_empty(),
        };
        let others = left.as_ref().filter(|left| left.of != of && left.done > 0);
        if let Some(Record { of: before, done, .. }) = others {
            let others = differing(before, &of).join(", ");
            note(&format!("{}: {done} frames are replaced, which were of another {others}", folder.display()));
        }
        let done = left.filter(|left| left.of == of).map_or(0, |left| left.done);
        let mut frames = Frames { folder, record: Record { of, done: 0, strange }, _lock: lock };
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
        remove(&[RECORD, LOCK].map(|name| self.folder.join(name)));
    }

    /// Removes all frames, and the folder unless there is something else in it. If pictures were there before that somebody may
    /// want to keep, all stay.
    pub fn remove(self) {
        if self.record.strange {
            note(&format!("{}: held pictures before, and is not removed", self.folder.display()));
            return self.keep();
        }
        remove(&other_numbered(&self.folder, DIGITS, &[]));
        remove(&[RECORD, LOCK].map(|name| self.folder.join(name)));
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

/// The names of what differs between two records.
fn differing<'a>(a: &'a Value, b: &'a Value) -> Vec<&'a str> {
    let names = |value: &'a Value| value.as_object().into_iter().flat_map(|fields| fields.keys().map(String::as_str));
    let mut names: Vec<&str> = names(a).chain(names(b)).filter(|name| a.get(name) != b.get(name)).collect();
    names.sort_unstable();
    names.dedup();
    names
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
        drop(frames);
        assert_eq!(Frames::new(folder(), json!({ "model": 1 })).unwrap().done(), 3);
        // From one that is no longer there on.
        std::fs::remove_file(folder().join("0001.png")).unwrap();
        let mut again = Frames::new(folder(), json!({ "model": 1 })).unwrap();
        assert_eq!(again.done(), 1);
        again.push(&[7], &[]).unwrap();
        assert_eq!(read("0001.png"), [7]);
        drop(again);
        assert_eq!(Frames::new(folder(), json!({ "model": 2 })).unwrap().done(), 0);
        // It was begun again: what lies there now is of another model.
        assert_eq!(Frames::new(folder(), json!({ "model": 1 })).unwrap().done(), 0);
        std::fs::write(folder().join(RECORD), "{").unwrap();
        assert_eq!(Frames::new(folder(), json!({ "model": 1 })).unwrap().done(), 0);
        Frames::new(folder(), json!({})).unwrap().keep();
        assert!(!folder().join(RECORD).exists() && folder().join("0000.png").exists());
        std::fs::remove_dir_all(folder().join("depth")).unwrap();
        // What was there before without a record stays.
        Frames::new(folder(), json!({})).unwrap().remove();
        assert!(folder().join("0002.png").exists());
        assert_eq!(std::fs::read_dir(folder()).unwrap().count(), 3, "nothing but the frames");
        // After an interruption too.
        drop(Frames::new(folder(), json!({})).unwrap());
        Frames::new(folder(), json!({})).unwrap().remove();
        assert!(folder().join("0002.png").exists());
        std::fs::remove_dir_all(folder()).unwrap();
        let mut frames = Frames::new(folder(), json!({})).unwrap();
        frames.push(&[1], &[]).unwrap();
        drop(frames);
        Frames::new(folder(), json!({})).unwrap().remove();
        assert!(!folder().exists());
    }

    #[test]
    fn frames_are_written_by_one_program_at_a_time_which_says_what_differs() {
        let place = tempfile::tempdir().unwrap();
        let frames = Frames::new(place.path().into(), json!({})).unwrap();
        let error = Frames::new(place.path().into(), json!({})).err().unwrap().to_string();
        assert!(error.contains("by another raygrad"), "{error}");
        drop(frames);
        Frames::new(place.path().into(), json!({})).unwrap();
        let [a, b] = [json!({"size": [1, 2], "model": 3, "only": 0}), json!({"size": [1, 2], "model": 4, "b": null})];
        assert_eq!(differing(&a, &b), ["b", "model", "only"]);
    }
}
