//! Numbered frames in a folder, which an interrupted command can resume.

use std::ops::Range;
use std::path::{Path, PathBuf};

use clap::ValueEnum;
use raygrad::nerf::{Error, Result, create_folder, write_atomic};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::shown::Layer;
use crate::lock::{Lock, UNFINISHED};
use crate::output::{complain, is_written, make_folder, note, numbered, other_numbered, parent, print, remove};
use crate::overwrite::{Job, is_occupied, png_with_text, taken};
use crate::parse::read_text;
use crate::run::write_json;
use crate::shard::{self, Complete, Part, Shard, Whole};

/// Digits of a frame number.
pub const DIGITS: usize = 4;
/// The file that describes the frames of a folder until all are complete.
const RECORD: &str = "unfinished.json";

/// The frames of a path, some of which may exist.
pub struct Frames {
    folder: PathBuf,
    job: Job,
    /// Number of frames of the path.
    count: usize,
    claim: Claim,
}

/// The frames that a program may write.
enum Claim {
    All(Record, Lock),
    Shard(Part),
}

/// Facts of a shard's program.
#[derive(Debug, Serialize, Deserialize)]
struct Facts {
    job: Job,
    /// As in [`Record`]. Images of another shard do not count, so one shard that saw none is right.
    strange: bool,
}

/// The contents of the record file.
#[derive(Debug, Serialize, Deserialize)]
pub struct Record {
    /// All inputs of the frames.
    of: Value,
    /// The mark of the job.
    #[serde(default)]
    job: String,
    /// Number of complete frames, from the first.
    done: usize,
    /// True if numbered images existed before the first frame. They may be the user's.
    #[serde(default)]
    strange: bool,
}

impl Frames {
    /// Opens `count` frames in a folder, and creates the folder. Frames of an interrupted command are kept if `of` is
    /// equal. All others are replaced one by one, with their layers.
    ///
    /// # Errors
    ///
    /// Fails if another job has written one of the files, the folder is not writable, or another program writes frames
    /// there.
    pub fn new(folder: PathBuf, of: Value, job: &Job, count: usize, save: &[Layer]) -> Result<Self> {
        shard::check_none(&folder)?;
        check(&folder, record(&folder).as_ref(), &of, job, count, save)?;
        make_folder(&folder)?;
        let lock = Lock::take(&folder.join(UNFINISHED), || {
            Error::file(&folder, "another raygrad is rendering to it: wait until it ends")
        })?;
        // A shard may have begun meanwhile.
        shard::check_none(&folder)?;
        let left = record(&folder);
        let strange = match &left {
            Some(left) => left.strange,
            None => !other_numbered(&folder, DIGITS, &[]).is_empty(),
        };
        let others = left.as_ref().filter(|left| left.of != of && left.done > 0);
        if let Some(Record { of: before, done, .. }) = others {
            let others = differing(before, &of).join(", ");
            note(&format!("{}: replacing {done} frames that were rendered with another {others}", folder.display()));
        }
        let done = left.filter(|left| left.of == of).map_or(0, |left| left.done);
        let done = (0..done).take_while(|&frame| is_complete(&folder, frame, save)).count();
        note_layers(&folder, done..count, save);
        let record = Record { of, job: job.mark().to_owned(), done, strange };
        let frames = Frames { folder, job: job.clone(), count, claim: Claim::All(record, lock) };
        frames.write()?;
        Ok(frames)
    }

    /// Opens the frames of one shard. See [`new`](Self::new) and [`Part::open`].
    pub fn of_shard(folder: PathBuf, shard: Shard, whole: Whole, job: &Job, save: &[Layer]) -> Result<Self> {
        let (count, begun) = (whole.items, shard::own_facts::<Facts>(&folder)?);
        if begun.is_empty() {
            if folder.join(RECORD).exists() {
                let what = format!(
                    "holds unfinished frames of a render without shards: finish it without --shard, or remove {}",
                    folder.join(RECORD).display()
                );
                return Err(Error::file(&folder, what));
            }
            check(&folder, None, &Value::Null, job, count, save)?;
        }
        let strange = match begun.is_empty() {
            true => !other_numbered(&folder, DIGITS, &[]).is_empty(),
            false => begun.iter().all(|facts| facts.strange),
        };
        let mut part = Part::open(&folder, shard, whole, json!(Facts { job: job.clone(), strange }))?;
        part.retain(|frame| is_complete(&folder, frame, save))?;
        Ok(Frames { folder, job: job.clone(), count, claim: Claim::Shard(part) })
    }

    /// The frames of complete shards, made from `of` with layers `save`. Returns them with their job.
    pub fn of_shards(complete: Complete, of: Value, save: &[Layer]) -> Result<(Self, Job)> {
        let (folder, count) = (complete.at().to_owned(), complete.whole.items);
        for frame in 0..count {
            files(&folder, frame, save).try_for_each(|file| complete.check(frame, &file))?;
        }
        let facts: Vec<Facts> = complete.own()?;
        let strange = facts.iter().all(|facts| facts.strange);
        let Some(Facts { job, .. }) = facts.into_iter().next() else {
            return Err(Error::file(&folder, "holds no shards"));
        };
        let record = Record { of, job: job.mark().to_owned(), done: count, strange };
        let claim = Claim::All(record, complete.lock);
        Ok((Frames { folder, job: job.clone(), count, claim }, job))
    }

    /// Replaces the records of shards by one of all frames.
    pub fn drop_shards(&self) -> Result<()> {
        if self.folder.join(shard::FOLDER).is_dir() {
            self.write()?;
            shard::clear(&self.folder);
        }
        Ok(())
    }

    /// Prints that the work was interrupted. `again` is how to resume it.
    pub fn stopped(&self, again: &str) -> Result<()> {
        let (done, all, folder) = (self.done(), self.count(), self.folder.display());
        print(&format!("stopped  after {done} of {all} frames, in {folder}: {again} to resume\n"))
    }

    /// Number of complete frames, from the first that is the program's.
    pub fn done(&self) -> usize {
        match &self.claim {
            Claim::All(record, _) => record.done,
            Claim::Shard(part) => part.done(),
        }
    }

    /// Number of frames that are the program's.
    pub fn count(&self) -> usize {
        match &self.claim {
            Claim::All(..) => self.count,
            Claim::Shard(part) => part.items().len(),
        }
    }

    /// The next frame to render.
    pub fn next(&self) -> Option<usize> {
        match &self.claim {
            Claim::All(record, _) => Some(record.done).filter(|frame| *frame < self.count),
            Claim::Shard(part) => part.next(),
        }
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Writes a frame, which is the [`next`](Self::next) one: its layers first, then the image.
    pub fn push(&mut self, frame: usize, picture: &[u8], layers: &[(Layer, Vec<u8>)]) -> Result<()> {
        let path = path(&self.folder, frame);
        // A file may have appeared meanwhile.
        self.job.check(&path)?;
        for (layer, bytes) in layers {
            let file = beside(&self.folder, frame, *layer);
            let folder = parent(&file);
            self.check_lock()?;
            create_folder(folder)?;
            self.put(&file, bytes)?;
        }
        self.put(&path, &png_with_text(picture, self.job.mark()))?;
        match &mut self.claim {
            Claim::All(record, _) => record.done += 1,
            Claim::Shard(part) => return part.advance(1),
        }
        self.write()
    }

    fn put(&self, path: &Path, bytes: &[u8]) -> Result<()> {
        self.check_lock()?;
        match &self.claim {
            Claim::All(..) => write_atomic(path, bytes),
            Claim::Shard(part) => part.write(path, bytes),
        }
    }

    /// Checks that the folder is still the locked one.
    pub fn check_lock(&self) -> Result<()> {
        let Claim::All(_, lock) = &self.claim else { return Ok(()) };
        let gone = "was removed or moved during rendering: run the same command to start again";
        lock.check(&self.folder, gone, "another raygrad now renders to it, so this one stopped")
    }

    /// Keeps the frames and removes the record.
    pub fn keep(self) {
        if self.check_lock().is_err() {
            return;
        }
        match self.claim {
            Claim::All(_, lock) => {
                remove(&[self.folder.join(RECORD)]);
                lock.remove();
            }
            Claim::Shard(part) => part.finish(),
        }
    }

    /// Removes all frames, and the folder if it is empty then. Keeps everything if numbered images existed before.
    pub fn remove(self) {
        let is_strange = matches!(&self.claim, Claim::All(record, _) if record.strange);
        if self.check_lock().is_err() {
            return;
        }
        if is_strange {
            note(&format!("{}: kept, because it held other images before", self.folder.display()));
            return self.keep();
        }
        remove(&other_numbered(&self.folder, DIGITS, &[]));
        let folder = self.folder.clone();
        self.keep();
        if let Err(e) = std::fs::remove_dir(&folder) {
            complain(&format!("{}: cannot be removed: {e}", folder.display()));
        }
    }

    /// Writes the record of all frames.
    fn write(&self) -> Result<()> {
        let Claim::All(record, _) = &self.claim else { return Ok(()) };
        self.check_lock()?;
        write_json(&self.folder.join(RECORD), record)
    }
}

/// The file of a frame.
fn path(folder: &Path, frame: usize) -> PathBuf {
    folder.join(numbered(frame, DIGITS))
}

/// The record of a folder; `None` if it cannot be read.
pub fn record(folder: &Path) -> Option<Record> {
    read_text(&folder.join(RECORD), "a record of frames").ok().and_then(|text| serde_json::from_str(&text).ok())
}

/// The files of a frame: its layers and its image.
fn files<'a>(folder: &'a Path, frame: usize, save: &'a [Layer]) -> impl Iterator<Item = PathBuf> + 'a {
    save.iter().map(move |layer| beside(folder, frame, *layer)).chain([path(folder, frame)])
}

/// Returns true if all files of a frame were written.
fn is_complete(folder: &Path, frame: usize, save: &[Layer]) -> bool {
    files(folder, frame, save).all(|file| is_written(&file))
}

/// A note on layers beside frames that will be replaced without them. They may be the user's, so they are kept.
fn note_layers(folder: &Path, frames: Range<usize>, save: &[Layer]) {
    let replaced = frames.filter(|frame| path(folder, *frame).is_file());
    let others = || Layer::value_variants().iter().filter(|layer| !save.contains(layer));
    let left: Vec<PathBuf> =
        replaced.flat_map(|frame| others().map(move |layer| beside(folder, frame, *layer))).collect();
    let left: Vec<&PathBuf> = left.iter().filter(|file| file.is_file()).collect();
    if let Some(first) = left.first() {
        let (count, first) = (left.len(), first.display());
        note(&format!("{count} layers of earlier frames stay, such as {first}: they do not belong to the new frames"));
    }
}

/// The file of a frame's layer.
fn beside(folder: &Path, frame: usize, layer: Layer) -> PathBuf {
    let (name, ending) = layer.place();
    folder.join(name).join(numbered(frame, DIGITS)).with_extension(ending)
}

/// Checks that a job may write its frames and layers to a folder: existing files must be its own.
fn check(folder: &Path, left: Option<&Record>, of: &Value, job: &Job, count: usize, save: &[Layer]) -> Result<()> {
    // A moved run has another mark but the same inputs.
    if job.overwrites() || left.is_some_and(|left| left.job == job.mark() || left.of == *of) {
        return Ok(());
    }
    for frame in 0..count {
        let there: Vec<PathBuf> = files(folder, frame, save).filter(|file| is_occupied(file)).collect();
        let Some(file) = there.first().filter(|_| !job.wrote(&path(folder, frame))) else { continue };
        return Err(match left {
            Some(_) => Error::file(
                folder,
                "holds unfinished frames of another command: repeat that command or add --overwrite",
            ),
            None => taken(file),
        });
    }
    Ok(())
}

/// The keys whose values differ between two records.
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

    fn job(number: u32, overwrites: bool) -> Job {
        Job::new("render", &json!(number), overwrites)
    }

    /// Up to three frames of job 0 with this model.
    fn frames(folder: &Path, model: u32) -> Frames {
        Frames::new(folder.into(), json!({ "model": model }), &job(0, false), 3, &[Layer::DepthNpy]).unwrap()
    }

    #[test]
    fn new_equal_inputs_resumes_frames() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("frames");
        let begin = |model: u32| frames(&folder, model);
        let mut first = begin(1);
        for i in 0..3_u8 {
            first.push(i.into(), &[i], &[(Layer::DepthNpy, vec![10 + i])]).unwrap();
        }
        let read = |name: &str| std::fs::read(folder.join(name)).unwrap();
        assert_eq!((read("0002.png")[0], read("depth/0002.npy")), (2, vec![12]));
        drop(first);
        assert_eq!(begin(1).done(), 3);
        // Resumes at the first missing frame.
        std::fs::remove_file(folder.join("0001.png")).unwrap();
        let mut again = begin(1);
        assert_eq!(again.done(), 1);
        again.push(1, &[7], &[]).unwrap();
        assert_eq!(read("0001.png")[0], 7);
        drop(again);
        assert_eq!(begin(2).done(), 0);
        // The record was replaced, so the frames count as those of another model.
        assert_eq!(begin(1).done(), 0);
        std::fs::write(folder.join(RECORD), "{").unwrap();
        assert_eq!(begin(1).done(), 0);
        begin(3).keep();
        assert!(!folder.join(RECORD).exists() && folder.join("0000.png").exists());
        std::fs::remove_dir_all(folder.join("depth")).unwrap();
        // Images that existed without a record are kept.
        begin(3).remove();
        assert!(folder.join("0002.png").exists());
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 3, "nothing but the frames");
        // They are also kept after an interruption.
        drop(begin(3));
        begin(3).remove();
        assert!(folder.join("0002.png").exists());
        std::fs::remove_dir_all(&folder).unwrap();
        begin(3).push(0, &[1], &[]).unwrap();
        begin(3).remove();
        assert!(!folder.exists());
    }

    #[test]
    fn new_while_locked_fails_and_keys_differ() {
        let place = tempfile::tempdir().unwrap();
        let again = || Frames::new(place.path().into(), json!({}), &job(0, false), 3, &[]);
        let frames = again().unwrap();
        let error = again().err().unwrap().to_string();
        assert!(error.contains("another raygrad is rendering to it"), "{error}");
        drop(frames);
        again().unwrap();
        let [a, b] = [json!({"size": [1, 2], "model": 3, "only": 0}), json!({"size": [1, 2], "model": 4, "b": null})];
        assert_eq!(differing(&a, &b), ["b", "model", "only"]);
    }

    #[test]
    fn new_refuses_files_of_other_jobs() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path();
        let of = |job: &Job| json!({ "job": job.mark() });
        let new = |job: &Job, save: &[Layer]| Frames::new(folder.into(), of(job), job, 3, save).map(drop);
        let refused = |job: &Job, save: &[Layer], name: &str| {
            let error = new(job, save).unwrap_err().to_string();
            assert!(error.starts_with(&format!("{}: exists, and", folder.join(name).display())), "{error}");
            let left = [RECORD, UNFINISHED].map(|name| folder.join(name).exists());
            assert_eq!(left, [false; 2], "nothing is left there");
        };
        // Numbered images of the user: one within the range is refused, later ones are not.
        std::fs::write(folder.join("0003.png"), b"photograph").unwrap();
        new(&job(0, false), &[]).unwrap();
        Frames::new(folder.into(), of(&job(0, false)), &job(0, false), 3, &[]).unwrap().keep();
        std::fs::write(folder.join("0002.png"), b"photograph").unwrap();
        refused(&job(0, false), &[], "0002.png");
        std::fs::remove_file(folder.join("0002.png")).unwrap();
        // Measured depths of the user.
        std::fs::create_dir(folder.join("depth")).unwrap();
        std::fs::write(folder.join("depth/0001.png"), b"depths").unwrap();
        refused(&job(0, false), &[Layer::Normals, Layer::Depth], "depth/0001.png");
        Frames::new(folder.into(), of(&job(0, true)), &job(0, true), 3, &[Layer::Depth]).unwrap().keep();
        std::fs::remove_dir_all(folder.join("depth")).unwrap();
        // Finished frames and layers of the same job are replaced, those of another job are not.
        let mut frames = Frames::new(folder.into(), of(&job(0, false)), &job(0, false), 3, &[Layer::Depth]).unwrap();
        for i in 0..3_u8 {
            frames.push(i.into(), &[i], &[(Layer::Depth, vec![i])]).unwrap();
        }
        frames.keep();
        refused(&job(1, false), &[], "0000.png");
        new(&job(0, false), &[Layer::Depth]).unwrap();
        // Unfinished frames of the same job are replaced too.
        std::fs::remove_file(folder.join("0000.png")).unwrap();
        std::fs::write(folder.join("0001.png"), b"cut off").unwrap();
        new(&job(0, false), &[Layer::Depth]).unwrap();
        let error = new(&job(1, false), &[]).unwrap_err().to_string();
        assert!(error.ends_with("holds unfinished frames of another command: repeat that command or add --overwrite"));
        new(&job(1, true), &[]).unwrap();
        // Frames with equal inputs count as the job's own, as in a moved run. An image that appears meanwhile is kept.
        let mut frames = Frames::new(folder.into(), of(&job(1, true)), &job(2, false), 3, &[]).unwrap();
        assert_eq!(frames.done(), 0);
        std::fs::write(folder.join("0000.png"), b"photograph").unwrap();
        assert!(frames.push(0, &[1], &[]).unwrap_err().to_string().contains("0000.png: exists"));
        assert_eq!(std::fs::read(folder.join("0000.png")).unwrap(), b"photograph");
    }

    #[test]
    fn frames_without_all_their_files_are_rendered_again() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("frames");
        let mut first = frames(&folder, 1);
        for i in 0..3_u8 {
            first.push(i.into(), &[i], &[(Layer::DepthNpy, vec![10 + i])]).unwrap();
        }
        drop(first);
        for (file, done) in [("depth/0002.npy", 2), ("0001.png", 1), ("depth/0000.npy", 0)] {
            let bytes = std::fs::read(folder.join(file)).unwrap();
            std::fs::write(folder.join(file), "").unwrap();
            let mut again = frames(&folder, 1);
            assert_eq!(again.done(), done, "{file} is empty");
            for i in done..3 {
                again.push(i, &[i as u8], &[(Layer::DepthNpy, vec![10 + i as u8])]).unwrap();
            }
            assert_eq!(std::fs::read(folder.join(file)).unwrap(), bytes);
            drop(again);
            assert_eq!(frames(&folder, 1).done(), 3);
        }
        std::fs::remove_file(folder.join("depth/0001.npy")).unwrap();
        assert_eq!(frames(&folder, 1).done(), 1);
    }

    #[test]
    fn push_to_replaced_folder_fails() {
        let place = tempfile::tempdir().unwrap();
        let folder = place.path().join("frames");
        let mut first = frames(&folder, 1);
        std::fs::rename(&folder, place.path().join("moved")).unwrap();
        assert!(first.push(0, &[0], &[]).unwrap_err().to_string().contains("was removed or moved during rendering"));
        let mut second = frames(&folder, 2);
        for layers in [vec![], vec![(Layer::Depth, vec![1])]] {
            assert!(
                first.push(0, &[1], &layers).unwrap_err().to_string().contains("another raygrad now renders to it")
            );
        }
        second.push(0, &[2], &[]).unwrap();
        // Files of the other program are not removed.
        first.remove();
        // A frame, the record, and the two files of a lock.
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 4);
        let third = frames(&place.path().join("moved"), 1);
        let lock = crate::lock::owner_of(&place.path().join("moved").join(UNFINISHED));
        std::fs::write(lock, "1 0123456789abcdef\n").unwrap();
        third.keep();
        assert_eq!(std::fs::read_dir(place.path().join("moved")).unwrap().count(), 3, "nor kept by who has lost it");
        second.keep();
    }
}
