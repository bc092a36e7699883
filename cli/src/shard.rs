//! Shards: several programs share one job and write to one folder, without a coordinator.
//!
//! The folder [`FOLDER`] beside the results holds a record and a lock of each shard. A shard writes its record and then
//! compares it with all others. So if two programs start at once, at least one of them finds a difference. The program
//! that finds all shards complete merges them, as [`Complete`], and removes the folder.

use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::fmt;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use raygrad::nerf::{Error, Result, create_folder, rename_durable};
use raygrad::nn::TEMPORARY_PREFIX;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::lock::{Lock, State, UNFINISHED};
use super::output::{check_writable, complain, entries, is_written, listed, quoted, remove};
use super::parse::read_text;
use super::run::write_json;
use super::scratch::ScratchFolder;

/// The folder of the records, beside the results.
pub const FOLDER: &str = "unfinished-shards";
/// The most shards of a job.
const MOST: usize = 10_000;
/// The most items of a job.
const MOST_ITEMS: usize = 10_000_000;
/// Differences, and incomplete shards, that an error names.
const NAMED: usize = 4;

/// One of several equal parts of a job: `I/N`, counted from 1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    number: usize,
    count: usize,
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        let usage = || format!("write I/N such as 1/5, with I from 1 to N and N at most {MOST}");
        let (number, count) = text.split_once('/').ok_or_else(usage)?;
        let [number, count] = [number, count].map(|text| text.parse::<usize>().ok());
        let (number, count) = number.zip(count).ok_or_else(usage)?;
        if (1..=count).contains(&number) && count <= MOST { Ok(Shard { number, count }) } else { Err(usage()) }
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.number, self.count)
    }
}

impl Shard {
    /// Shard `number`, from 1, of `count`.
    pub fn new(number: usize, count: usize) -> Self {
        Shard { number, count }
    }

    /// The items of this shard, of `total`. They are interleaved, because neighbours take similar times.
    pub fn items(self, total: usize) -> impl ExactSizeIterator<Item = usize> {
        (self.number - 1..total).step_by(self.count)
    }

    fn file(self, extension: &str) -> String {
        format!("shard-{}.{extension}", self.number)
    }
}

/// The job that shards belong to. It is equal for all of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Whole {
    /// Subcommand.
    pub command: String,
    /// All inputs of the results.
    pub inputs: Value,
    /// Number of frames, views or images.
    pub items: usize,
}

/// The contents of a record.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Record {
    #[serde(flatten)]
    whole: Whole,
    /// Number of shards.
    shards: usize,
    /// Number of complete items, from the first of the shard.
    done: usize,
    /// Facts that may differ between shards.
    own: Value,
}

/// Exclusive access to one shard.
pub struct Part {
    folder: PathBuf,
    shard: Shard,
    record: Record,
    lock: Lock,
}

impl Part {
    /// Opens a shard of a job whose results are in the folder `at`. Complete items of a killed program are kept.
    ///
    /// # Errors
    ///
    /// Fails if shards of another job are in the folder, another program works on this shard, or one works there
    /// without shards.
    pub fn open(at: &Path, shard: Shard, whole: Whole, own: Value) -> Result<Self> {
        let folder = at.join(FOLDER);
        let mut record = Record { whole, shards: shard.count, done: 0, own };
        record.check(at, &records(at)?)?;
        create_folder(&folder)?;
        check_writable(&folder)?;
        let lock = Lock::take(&folder.join(shard.file("lock")), || {
            Error::file(at, format!("another raygrad works on shard {shard}: wait until it ends"))
        })?;
        // Another job may have begun the shard since.
        let mut there = records(at)?;
        if let Err(error) = record.check(at, &there) {
            lock.remove();
            return Err(error);
        }
        let left = there.remove(&shard.number);
        let is_new = left.is_none();
        record.done = left.map_or(0, |left| left.done);
        let part = Part { folder, shard, record, lock };
        part.save()?;
        let is_alone = || match Lock::is_taken(&at.join(UNFINISHED)) {
            true => Err(Error::file(at, "another raygrad writes or merges all results there: wait until it ends")),
            false => Ok(()),
        };
        let checked = records(at).and_then(|all| part.record.check(at, &all));
        if let Err(error) = checked.and_then(|()| is_alone()) {
            if is_new {
                remove(&[part.folder.join(shard.file("json"))]);
            }
            part.lock.remove();
            return Err(error);
        }
        Ok(part)
    }

    /// Number of complete items, from the first.
    pub fn done(&self) -> usize {
        self.record.done
    }

    /// The first item that is not complete.
    pub fn next(&self) -> Option<usize> {
        self.items().nth(self.record.done)
    }

    /// The items of this shard.
    pub fn items(&self) -> impl ExactSizeIterator<Item = usize> + use<> {
        self.shard.items(self.record.whole.items)
    }

    /// Counts only the complete items before the first one that is absent.
    pub fn retain(&mut self, is_there: impl Fn(usize) -> bool) -> Result<()> {
        self.record.done = self.items().take(self.record.done).take_while(|item| is_there(*item)).count();
        self.save()
    }

    /// Counts more complete items.
    pub fn advance(&mut self, count: usize) -> Result<()> {
        self.record.done += count;
        self.save()
    }

    /// Writes a file and replaces it atomically. A killed program leaves nothing outside of [`FOLDER`].
    pub fn write(&self, path: &Path, bytes: &[u8]) -> Result<()> {
        self.check_lock()?;
        let staged = self.folder.join(self.shard.file("part"));
        std::fs::write(&staged, bytes).map_err(|e| Error::file(path, format!("cannot be written: {e}")))?;
        rename_durable(staged, path)
    }

    /// Releases the shard. Another program may have merged it already.
    pub fn finish(self) {
        if self.lock.state() == State::Kept {
            self.lock.remove();
        }
    }

    fn save(&self) -> Result<()> {
        self.check_lock()?;
        write_json(&self.folder.join(self.shard.file("json")), &self.record)
    }

    /// Checks that the folder is still the locked one.
    fn check_lock(&self) -> Result<()> {
        let gone = "was removed or moved: run the same command to start again";
        self.lock.check(&self.folder, gone, "another raygrad now works on this shard, so this one stopped")
    }
}

/// Fails if a folder of results holds shards. For programs that write all results.
pub fn check_none(at: &Path) -> Result<()> {
    if records(at)?.is_empty() {
        return Ok(());
    }
    let (folder, merge) = (at.join(FOLDER), quoted(at));
    let what = format!("holds shards: finish them with `raygrad merge {merge}`, or remove {}", folder.display());
    Err(Error::file(at, what))
}

/// The facts of each shard in a folder of results that may differ: see [`Part::open`].
pub fn own_facts<T: DeserializeOwned>(at: &Path) -> Result<Vec<T>> {
    records(at)?.iter().map(|(number, record)| parsed(&file_of(at, *number), &record.own)).collect()
}

/// A value of a record.
fn parsed<T: DeserializeOwned>(record: &Path, value: &Value) -> Result<T> {
    T::deserialize(value).map_err(|e| damaged(record, e))
}

fn file_of(at: &Path, number: usize) -> PathBuf {
    at.join(FOLDER).join(Shard { number, count: number }.file("json"))
}

fn damaged(record: &Path, what: impl fmt::Display) -> Error {
    Error::file(record, format!("is no record of this raygrad ({what}): remove it and run its shard again"))
}

/// The records of a folder of results, by the number of the shard.
fn records(at: &Path) -> Result<BTreeMap<usize, Record>> {
    let folder = at.join(FOLDER);
    let mut all = BTreeMap::new();
    if !folder.is_dir() {
        return Ok(all);
    }
    let found = match entries(&folder) {
        // Another program has just merged them.
        Err(_) if !folder.is_dir() => return Ok(all),
        found => found?,
    };
    for path in found {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let number = name.strip_prefix("shard-").and_then(|rest| rest.strip_suffix(".json"));
        let Some(number) = number.and_then(|number| number.parse().ok()).filter(|n| (1..=MOST).contains(n)) else {
            continue;
        };
        if let Some(record) = read(&path, number)? {
            all.insert(number, record);
        }
    }
    Ok(all)
}

/// Reads a record; `None` if another program has just removed it.
pub fn read(path: &Path, number: usize) -> Result<Option<Record>> {
    let text = match read_text(path, "a record of a shard") {
        Err(_) if path.symlink_metadata().is_err_and(|e| e.kind() == ErrorKind::NotFound) => return Ok(None),
        text => text?,
    };
    let record: Record = serde_json::from_str(&text).map_err(|e| damaged(path, e))?;
    let Record { shards: count, done, whole: Whole { items, .. }, .. } = record;
    let is_sound = number <= count && count <= MOST && items <= MOST_ITEMS;
    if !is_sound || done > (Shard { number, count }).items(items).len() {
        return Err(damaged(path, "its numbers do not fit"));
    }
    Ok(Some(record))
}

impl Record {
    /// Fails if one of the other records is of another job, and names the differences.
    fn check(&self, at: &Path, others: &BTreeMap<usize, Record>) -> Result<()> {
        let about = |record: &Record| json!({ "shards": record.shards, "job": record.whole });
        let here = about(self);
        let mut differences = vec![];
        others.values().map(about).for_each(|there| differing("", &there, &here, &mut differences));
        // Another size is an argument and changes inputs of the same name. It counts once.
        let mut names = HashSet::new();
        differences.retain(|(name, ..)| names.insert(name.clone()));
        if differences.is_empty() {
            return Ok(());
        }
        let each = differences.iter().take(NAMED);
        let each: Vec<String> =
            each.map(|(name, there, here)| format!("`{name}` is {there} there, {here} here")).collect();
        let more = if differences.len() > NAMED { ", ..." } else { "" };
        let what = format!(
            "holds shards of another job: {}{more}; use the same arguments, or remove {} and what its shards wrote beside it \
             to start again",
            each.join(", "),
            at.join(FOLDER).display()
        );
        Err(Error::file(at, what))
    }
}

/// Adds the names and both values of all leaves that differ.
fn differing(name: &str, there: &Value, here: &Value, differences: &mut Vec<(String, String, String)>) {
    /// Characters of a value in an error.
    const LONGEST: usize = 60;
    match (there, here) {
        _ if there == here => {}
        (Value::Object(a), Value::Object(b)) => {
            let names: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
            for name in names {
                let [a, b] = [a, b].map(|fields| fields.get(name).unwrap_or(&Value::Null));
                differing(name, a, b, differences);
            }
        }
        _ => {
            let [there, here] = [there, here].map(|value| {
                let text = value.to_string();
                if text.chars().count() > LONGEST {
                    format!("{}...", text.chars().take(LONGEST).collect::<String>())
                } else {
                    text
                }
            });
            differences.push((name.to_owned(), there, here));
        }
    }
}

/// A folder of results whose shards are all complete, locked to merge them.
pub struct Complete {
    at: PathBuf,
    pub whole: Whole,
    /// Facts of each shard that may differ, by number.
    own: Vec<Value>,
    pub lock: Lock,
}

/// The shards of a folder of results.
pub enum Progress {
    /// There are none; perhaps another program has merged them.
    None,
    Complete(Box<Complete>),
    /// Another program merges them.
    Merging,
    /// Some are missing, in words.
    Incomplete(String),
}

/// Locks the results of a folder if all shards are complete.
pub fn progress(at: &Path) -> Result<Progress> {
    let all = records(at)?;
    let Some(Record { shards: count, .. }) = all.values().next() else { return Ok(Progress::None) };
    if let Some(words) = incomplete(at, &all, *count) {
        return Ok(Progress::Incomplete(words));
    }
    let path = at.join(UNFINISHED);
    let lock = match Lock::take(&path, || Error::file(at, "another raygrad merges its shards: wait until it ends")) {
        Err(_) if Lock::is_taken(&path) => return Ok(Progress::Merging),
        // Its owner has just ended.
        Err(_) if records(at)?.is_empty() => return Ok(Progress::None),
        lock => lock?,
    };
    // Another program may have merged them before the lock, or begun others.
    let all = records(at)?;
    let Some((number, first)) = all.first_key_value() else {
        lock.remove();
        return Ok(Progress::None);
    };
    if let Some(words) = incomplete(at, &all, first.shards) {
        lock.remove();
        return Ok(Progress::Incomplete(words));
    }
    let (whole, first) = (first.whole.clone(), BTreeMap::from([(*number, first.clone())]));
    for record in all.values() {
        record.check(at, &first)?;
    }
    let own = all.into_values().map(|record| record.own).collect();
    Ok(Progress::Complete(Box::new(Complete { at: at.into(), whole, own, lock })))
}

/// Names the shards that are not complete.
fn incomplete(at: &Path, all: &BTreeMap<usize, Record>, count: usize) -> Option<String> {
    let missing = (1..=count).filter_map(|number| {
        let shard = Shard { number, count };
        let Some(record) = all.get(&number) else { return Some(format!("{shard} (not begun)")) };
        let share = shard.items(record.whole.items).len();
        (record.done < share).then(|| {
            let is_running = Lock::is_taken(&at.join(FOLDER).join(shard.file("lock")));
            let state = if is_running { "running" } else { "stopped" };
            format!("{shard} ({state}, {} of {share})", record.done)
        })
    });
    let missing: Vec<String> = missing.collect();
    (!missing.is_empty()).then(|| listed(&missing, NAMED))
}

impl Complete {
    /// The folder of the results.
    pub fn at(&self) -> &Path {
        &self.at
    }

    /// The inputs of the job.
    pub fn inputs<T: DeserializeOwned>(&self) -> Result<T> {
        parsed(&file_of(&self.at, 1), &self.whole.inputs)
    }

    /// Facts of each shard that may differ, by number.
    pub fn own<T: DeserializeOwned>(&self) -> Result<Vec<T>> {
        self.own.iter().enumerate().map(|(i, own)| parsed(&file_of(&self.at, i + 1), own)).collect()
    }

    /// Checks that a file of an item exists and is not empty.
    pub fn check(&self, item: usize, path: &Path) -> Result<()> {
        if is_written(path) {
            return Ok(());
        }
        let shard = Shard { number: item % self.own.len() + 1, count: self.own.len() };
        let record = file_of(&self.at, shard.number);
        Err(Error::file(path, format!("is missing or empty: remove {} and run shard {shard} again", record.display())))
    }
}

/// Removes the records at once, after the results are complete. The folder must be locked.
pub fn clear(at: &Path) {
    let folder = at.join(FOLDER);
    let cleared = ScratchFolder::new(at, TEMPORARY_PREFIX)
        .and_then(|scratch| std::fs::rename(&folder, scratch.path().join(FOLDER)));
    if let Err(e) = cleared {
        complain(&format!("warning: {}: cannot be removed: {e}", folder.display()));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn open(at: &Path, shard: &str, inputs: Value) -> Result<Part> {
        let whole = Whole { command: "render".to_owned(), inputs, items: 7 };
        Part::open(at, shard.parse().unwrap(), whole, Value::Null)
    }

    /// Completes a shard.
    fn complete(at: &Path, shard: &str) {
        let mut part = open(at, shard, json!({})).unwrap();
        part.advance(part.items().len() - part.done()).unwrap();
        part.finish();
    }

    #[test]
    fn shard_parses_or_refuses() {
        for text in ["1/1", "2/5", "10000/10000"] {
            assert_eq!(text.parse::<Shard>().unwrap().to_string(), text);
        }
        for bad in ["", "/", "1", "0/1", "2/1", "1/0", "1/10001", "-1/2", "1/2/3", "1.0/2", "99999999999999999999/2"] {
            assert_eq!(
                bad.parse::<Shard>(),
                Err("write I/N such as 1/5, with I from 1 to N and N at most 10000".into())
            );
        }
    }

    #[test]
    fn items_are_interleaved_and_shared_out_once() {
        let of = |shard: &str, total: usize| shard.parse::<Shard>().unwrap().items(total).collect::<Vec<_>>();
        assert_eq!([of("1/3", 7), of("2/3", 7), of("3/3", 7)], [vec![0, 3, 6], vec![1, 4], vec![2, 5]]);
        for (count, total) in (1..9).flat_map(|count| (0..20).map(move |total| (count, total))) {
            let shares: Vec<_> = (1..=count).map(|i| of(&format!("{i}/{count}"), total)).collect();
            let sizes = shares.iter().map(Vec::len);
            assert!(sizes.clone().max().unwrap() - sizes.min().unwrap() <= 1);
            let mut all = shares.concat();
            all.sort_unstable();
            assert!(all.into_iter().eq(0..total), "{count} {total}");
        }
    }

    #[test]
    fn part_keeps_complete_items() {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path();
        let mut part = open(at, "2/3", json!({})).unwrap();
        assert_eq!((part.done(), part.next()), (0, Some(1)));
        part.advance(1).unwrap();
        assert_eq!(part.next(), Some(4));
        part.advance(1).unwrap();
        assert_eq!(part.next(), None);
        drop(part);
        let mut part = open(at, "2/3", json!({})).unwrap();
        part.retain(|item| item != 4).unwrap();
        drop(part);
        assert_eq!(open(at, "2/3", json!({})).unwrap().next(), Some(4));
        // A share may be empty.
        std::fs::remove_dir_all(at.join(FOLDER)).unwrap();
        let part = open(at, "8/8", json!({})).unwrap();
        assert_eq!((part.done(), part.next()), (0, None));
        // A file is replaced when the new one is complete.
        std::fs::write(at.join("0.png"), b"good").unwrap();
        std::fs::create_dir(at.join(FOLDER).join("shard-8.part")).unwrap();
        assert!(part.write(&at.join("0.png"), b"new").is_err());
        assert_eq!(std::fs::read(at.join("0.png")).unwrap(), b"good");
        std::fs::remove_dir(at.join(FOLDER).join("shard-8.part")).unwrap();
        part.write(&at.join("0.png"), b"new").unwrap();
        assert_eq!(std::fs::read(at.join("0.png")).unwrap(), b"new");
        std::fs::remove_file(at.join("0.png")).unwrap();
        // The folder was removed, and another program has begun.
        let part = open(at, "1/8", json!({})).unwrap();
        std::fs::remove_dir_all(at.join(FOLDER)).unwrap();
        let error = part.write(&at.join("0.png"), b"frame").unwrap_err().to_string();
        assert!(error.contains("was removed or moved"), "{error}");
        let other = open(at, "1/8", json!({})).unwrap();
        let error = part.write(&at.join("0.png"), b"frame").unwrap_err().to_string();
        assert!(error.contains("another raygrad now works on this shard") && !at.join("0.png").exists(), "{error}");
        part.finish();
        assert_eq!(other.lock.state(), State::Kept);
    }

    #[test]
    fn parts_of_different_jobs_never_both_open() {
        for _ in 0..20 {
            let folder = tempfile::tempdir().unwrap();
            let (barrier, at) = (std::sync::Barrier::new(2), folder.path());
            let begin = |shard: &str, size: u32| {
                barrier.wait();
                open(at, shard, json!({ "size": size })).is_ok()
            };
            let both = std::thread::scope(|scope| {
                let other = scope.spawn(|| begin("2/2", 8));
                [begin("1/2", 7), other.join().unwrap()]
            });
            assert_ne!(both, [true; 2]);
            // A refused one leaves nothing that keeps the other from beginning.
            assert_eq!(open(at, "1/2", json!({ "size": 7 })).is_ok(), !both[1], "{both:?}");
        }
    }

    #[test]
    fn check_names_differences_once() {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path();
        let of = |size: u32| json!({ "of": { "size": size, "path": "a".repeat(size as usize) }, "size": size });
        open(at, "1/2", of(100)).unwrap();
        let error = open(at, "2/2", of(3)).err().unwrap().to_string();
        let expected = format!(
            "{}: holds shards of another job: `path` is \"{}... there, \"aaa\" here, `size` is 100 there, 3 here; use the \
             same arguments, or remove {} and what its shards wrote beside it to start again",
            at.display(),
            "a".repeat(59),
            at.join(FOLDER).display()
        );
        assert_eq!(error, expected);
        assert_eq!(records(at).unwrap().len(), 1);
    }

    #[test]
    fn progress_names_missing_shards_until_all_are_complete() {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path();
        let words = || match progress(at).unwrap() {
            Progress::None => "none".to_owned(),
            Progress::Complete(complete) => {
                clear(at);
                complete.lock.remove();
                "complete".to_owned()
            }
            Progress::Merging => "merging".to_owned(),
            Progress::Incomplete(words) => words,
        };
        assert_eq!(words(), "none");
        complete(at, "3/3");
        let part = open(at, "2/3", json!({})).unwrap();
        assert_eq!(words(), "1/3 (not begun), 2/3 (running, 0 of 2)");
        drop(part);
        assert_eq!(words(), "1/3 (not begun), 2/3 (stopped, 0 of 2)");
        complete(at, "1/3");
        complete(at, "2/3");
        let merging = Lock::take(&at.join(UNFINISHED), || Error::file(at, "is busy")).unwrap();
        assert_eq!(words(), "merging");
        merging.remove();
        assert_eq!(words(), "complete");
        assert_eq!((words(), std::fs::read_dir(at).unwrap().count()), ("none".to_owned(), 0));
        complete(at, "7/9");
        assert_eq!(words(), "1/9 (not begun), 2/9 (not begun), 3/9 (not begun), 4/9 (not begun) and 4 more");
    }
}
