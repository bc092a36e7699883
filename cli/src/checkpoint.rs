//! Checkpoints of a run: `checkpoints/STEP.checkpoint`. By default the last two are kept.
//!
//! A file holds a line of text, `raygrad checkpoint VERSION CRC32 LENGTH`, and a [state](Trainer::state) of that
//! length.

use std::fs;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

use raygrad::nerf::{Error, Result, Trainer, write_atomic};

use super::output::{complain, make_folder, remove};
use super::run::Run;

/// Version of the file format. Later versions are refused.
const VERSION: u32 = 1;
/// The first words of a file.
const MAGIC: &str = "raygrad checkpoint";
/// Largest length of the first line, in bytes.
const LONGEST: usize = 80;

fn folder(run: &Run) -> PathBuf {
    run.file("checkpoints")
}

/// Saves the state of a trainer. Keeps the last `keep_checkpoints` checkpoints and removes all others.
pub fn save(run: &Run, trainer: &Trainer) -> Result<()> {
    let folder = folder(run);
    make_folder(&folder)?;
    let step = trainer.stats().step;
    write_atomic(folder.join(format!("{step:08}.checkpoint")), &framed(&trainer.state()?))?;
    // Checkpoints of later steps are damaged, since loading skipped them.
    let (mut surplus, others): (Vec<_>, Vec<_>) = all(&folder)?.into_iter().partition(|(own, _)| *own > step);
    surplus.extend(others.into_iter().skip(run.config.keep_checkpoints));
    remove(&surplus.into_iter().map(|(_, path)| path).collect::<Vec<_>>());
    Ok(())
}

/// The bytes of a checkpoint with this state.
pub(super) fn framed(state: &[u8]) -> Vec<u8> {
    let mut bytes = format!("{MAGIC} {VERSION} {:08x} {}\n", crc32fast::hash(state), state.len()).into_bytes();
    bytes.extend(state);
    bytes
}

/// Returns true if a run has a checkpoint, intact or damaged.
pub fn exists(run: &Run) -> Result<bool> {
    Ok(!all(&folder(run))?.is_empty())
}

/// The steps of a run's checkpoints, intact or damaged, in ascending order.
pub fn steps(run: &Run) -> Result<Vec<u64>> {
    Ok(all(&folder(run))?.into_iter().rev().map(|(step, _)| step).collect())
}

/// Reads the state of a run at a step.
///
/// # Errors
///
/// Fails if there is no checkpoint of this step or it is damaged.
pub fn read(run: &Run, step: u64) -> Result<Vec<u8>> {
    let found = all(&folder(run))?.into_iter().find(|(own, _)| *own == step);
    let (_, path) = found.ok_or_else(|| Error::file(folder(run), format!("no checkpoint of step {step}")))?;
    let bytes = fs::read(&path).map_err(|e| Error::file(&path, format!("cannot be read: {e}")))?;
    parse(&path, bytes)
}

/// The steps and paths of the checkpoints in a folder, latest first.
fn all(folder: &Path) -> Result<Vec<(u64, PathBuf)>> {
    let entries = match fs::read_dir(folder) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(vec![]),
        entries => entries.map_err(|e| Error::file(folder, format!("cannot be read: {e}")))?,
    };
    let step = |path: &PathBuf| {
        let name = path.file_name()?.to_str()?;
        name.strip_suffix(".checkpoint")?.parse::<u64>().ok()
    };
    let paths = entries.flatten().map(|entry| entry.path());
    let mut found: Vec<(u64, PathBuf)> = paths.filter_map(|path| Some((step(&path)?, path))).collect();
    found.sort_by(|a, b| b.cmp(a));
    Ok(found)
}

/// Removes the latest checkpoint if it is of this step and an earlier one exists.
pub fn step_back(run: &Run, step: Option<u64>) -> Result<()> {
    remove(surplus(&all(&folder(run))?, step).as_slice());
    Ok(())
}

/// The first path, the latest, if it is of this step and another one exists.
fn surplus(found: &[(u64, PathBuf)], step: Option<u64>) -> Option<PathBuf> {
    match found {
        [(latest, path), _, ..] if Some(*latest) == step => Some(path.clone()),
        _ => None,
    }
}

/// Loads the latest intact checkpoint into a trainer and warns of damaged ones. Fails if all are damaged, if it does not
/// fit the trainer, or if none exists although the run has taken steps. A trainer of a run without steps keeps its
/// initial state.
pub fn load(run: &Run, trainer: &mut Trainer) -> Result<()> {
    let checkpoints = all(&folder(run))?;
    let none = checkpoints.is_empty();
    // A checkpoint of a later version is an error: skipping it would lose progress.
    for (_, path) in &checkpoints {
        let mut beginning = vec![];
        // Errors of reading are handled below.
        let read = fs::File::open(path).and_then(|file| file.take(LONGEST as u64).read_to_end(&mut beginning));
        if read.is_ok() {
            check_version(path, &beginning)?;
        }
    }
    for (_, path) in checkpoints {
        // A checkpoint that cannot be read is an error too, since the cause may be temporary.
        let unread =
            |e| Error::file(&path, format!("cannot be read: {e}; delete it to resume from the checkpoint before it"));
        let bytes = fs::read(&path).map_err(unread)?;
        match parse(&path, bytes) {
            Ok(state) => {
                let changed = |error| {
                    let what =
                        "The checkpoint is intact. If config.json was changed, restore its `config` and `scene_box`";
                    Error::file(&path, format!("{error}. {what}"))
                };
                return trainer.load_state(&state).map_err(changed);
            }
            Err(error) => complain(&format!("warning: {error}")),
        }
    }
    match none {
        false => {
            Err(Error::file(folder(run), "every checkpoint is damaged, so the run cannot resume: train a new run"))
        }
        // Training writes the first checkpoint before the metrics.
        true if run.file("metrics.jsonl").exists() => Err(Error::file(
            &run.folder,
            "has no checkpoints, like runs of earlier versions, and cannot resume: train a new run",
        )),
        true => Ok(()),
    }
}

/// The length of the first line of a file, and its words after [`MAGIC`].
fn header(bytes: &[u8]) -> Option<(usize, impl Iterator<Item = &str>)> {
    let end = bytes.iter().take(LONGEST).position(|byte| *byte == b'\n')?;
    Some((end, std::str::from_utf8(&bytes[..end]).ok()?.strip_prefix(MAGIC)?.split_whitespace()))
}

/// Fails if the file's beginning names a later version.
fn check_version(path: &Path, beginning: &[u8]) -> Result<()> {
    let version = header(beginning).and_then(|(_, mut words)| words.next()?.parse::<u32>().ok());
    match version.filter(|version| *version > VERSION) {
        None => Ok(()),
        Some(version) => Err(Error::file(
            path,
            format!(
                "has format version {version}, and this raygrad reads up to {VERSION}: use the raygrad that wrote \
                 it, or a newer one"
            ),
        )),
    }
}

/// Extracts the state from the bytes of a file.
pub(super) fn parse(path: &Path, mut bytes: Vec<u8>) -> Result<Vec<u8>> {
    let bad = |what: String| Error::file(path, what);
    check_version(path, &bytes)?;
    let header = header(&bytes).and_then(|(end, mut words)| {
        words.next()?.parse::<u32>().ok()?;
        let sum = u32::from_str_radix(words.next()?, 16).ok()?;
        Some((end, sum, words.next()?.parse::<usize>().ok()?))
    });
    let Some((end, sum, length)) = header else {
        return Err(bad("not a checkpoint, or its header is damaged".into()));
    };
    let state = bytes.split_off(end + 1);
    if state.len() != length {
        return Err(bad(format!("damaged: it has {} of {length} bytes", state.len())));
    }
    if crc32fast::hash(&state) != sum {
        return Err(bad("damaged: its checksum does not match".into()));
    }
    Ok(state)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parse_damaged_checkpoint_fails() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("00000007.checkpoint");
        let state: Vec<u8> = (0..200_u8).collect();
        let whole = [format!("{MAGIC} 1 {:08x} 200\n", crc32fast::hash(&state)).as_bytes(), &state].concat();
        let read = |bytes: &[u8]| parse(&path, bytes.to_vec());
        assert_eq!(read(&whole).unwrap(), state);
        for length in 0..whole.len() {
            let error = read(&whole[..length]).unwrap_err().to_string();
            assert!(error.contains("00000007.checkpoint") && error.contains("damaged"), "{error}");
        }
        let mut changed = whole.clone();
        for bit in 0..8 * whole.len() {
            changed[bit / 8] ^= 1 << (bit % 8);
            // The letter case of the checksum is the only change that is accepted.
            assert!(read(&changed).is_err() || read(&changed).unwrap() == state, "bit {bit}");
            changed[bit / 8] ^= 1 << (bit % 8);
        }
        let found = [(20, "b".into()), (9, "a".into())];
        assert_eq!(surplus(&found, Some(20)), Some("b".into()));
        assert_eq!(
            [surplus(&found, Some(9)), surplus(&found, None), surplus(&found[..1], Some(20))],
            [None, None, None]
        );
        let newer = [b"raygrad checkpoint 2 00000000 200\n".as_slice(), &state].concat();
        assert!(read(&newer).unwrap_err().to_string().contains("version 2"));
        // Sorted by number, not by name. Other files are ignored.
        for name in ["00000007.checkpoint", "00000100.checkpoint", "20.checkpoint", "x.checkpoint", "00000200.tmp"] {
            fs::write(folder.path().join(name), b"").unwrap();
        }
        let names = |(_, path): (u64, PathBuf)| path.file_name().unwrap().to_str().unwrap().to_owned();
        let found: Vec<String> = all(folder.path()).unwrap().into_iter().map(names).collect();
        assert_eq!(found, ["00000100.checkpoint", "20.checkpoint", "00000007.checkpoint"]);
        assert!(all(&folder.path().join("absent")).unwrap().is_empty());
    }
}
