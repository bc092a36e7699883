//! What a run goes on from: `checkpoints/STEP.checkpoint`, the last two of them, or as many as are to stay.
//!
//! A line of text, `raygrad checkpoint VERSION CRC32 LENGTH`, and a [state](Trainer::state) of that length.

use std::fs;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

use raygrad::nerf::{Error, Result, Trainer, write_atomic};

use super::output::{complain, make_folder, remove};
use super::run::Run;

/// How files are laid out; newer ones are refused.
const VERSION: u32 = 1;
/// The first words of a file.
const MAGIC: &str = "raygrad checkpoint";
/// Longest first line that is looked for, in bytes.
const LONGEST: usize = 80;

fn folder(run: &Run) -> PathBuf {
    run.file("checkpoints")
}

/// Writes where training is, and removes all others but the last, as many as the run keeps with this.
pub fn save(run: &Run, trainer: &Trainer) -> Result<()> {
    let folder = folder(run);
    make_folder(&folder)?;
    let step = trainer.stats().step;
    write_atomic(folder.join(format!("{step:08}.checkpoint")), &framed(&trainer.state()?))?;
    // What is said to be later was damaged, and passed over.
    let (mut surplus, others): (Vec<_>, Vec<_>) = all(&folder)?.into_iter().partition(|(own, _)| *own > step);
    surplus.extend(others.into_iter().skip(run.config.keep_checkpoints));
    remove(&surplus.into_iter().map(|(_, path)| path).collect::<Vec<_>>());
    Ok(())
}

/// The bytes of a file that holds a state.
pub(super) fn framed(state: &[u8]) -> Vec<u8> {
    let mut bytes = format!("{MAGIC} {VERSION} {:08x} {}\n", crc32fast::hash(state), state.len()).into_bytes();
    bytes.extend(state);
    bytes
}

/// Whether a run has a checkpoint, whole or not.
pub fn exists(run: &Run) -> Result<bool> {
    Ok(!all(&folder(run))?.is_empty())
}

/// The steps of which a run has checkpoints, whole or not, the first one first.
pub fn steps(run: &Run) -> Result<Vec<u64>> {
    Ok(all(&folder(run))?.into_iter().rev().map(|(step, _)| step).collect())
}

/// The state of a run at a step.
///
/// # Errors
/// If there is no checkpoint of this step, or it is damaged.
pub fn read(run: &Run, step: u64) -> Result<Vec<u8>> {
    let found = all(&folder(run))?.into_iter().find(|(own, _)| *own == step);
    let (_, path) = found.ok_or_else(|| Error::file(folder(run), format!("no checkpoint of step {step}")))?;
    let bytes = fs::read(&path).map_err(|e| Error::file(&path, format!("cannot be read: {e}")))?;
    parse(&path, bytes)
}

/// The checkpoints in a folder with their steps, the latest first.
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

/// Removes the latest checkpoint if it is of this step and there is one before it.
pub fn step_back(run: &Run, step: Option<u64>) -> Result<()> {
    remove(surplus(&all(&folder(run))?, step).as_slice());
    Ok(())
}

/// The first of these, the latest, if it is of this step and there is another.
fn surplus(found: &[(u64, PathBuf)], step: Option<u64>) -> Option<PathBuf> {
    match found {
        [(latest, path), _, ..] if Some(*latest) == step => Some(path.clone()),
        _ => None,
    }
}

/// Takes a trainer to the latest checkpoint that is whole; one that is not is said to be so. If none is whole, that is an error,
/// and if there is none although steps were taken; without steps, the trainer stays at its beginning.
pub fn load(run: &Run, trainer: &mut Trainer) -> Result<()> {
    let checkpoints = all(&folder(run))?;
    let none = checkpoints.is_empty();
    // What a later raygrad wrote is not passed over, and lost.
    for (_, path) in &checkpoints {
        let mut beginning = vec![];
        // What cannot be read is said below.
        let read = fs::File::open(path).and_then(|file| file.take(LONGEST as u64).read_to_end(&mut beginning));
        if read.is_ok() {
            check_version(path, &beginning)?;
        }
    }
    for (_, path) in checkpoints {
        // One that is there and cannot be read just now is not passed over either.
        let unread =
            |e| Error::file(&path, format!("cannot be read: {e}; delete it to resume from the checkpoint before it"));
        let bytes = fs::read(&path).map_err(unread)?;
        let loaded =
            parse(&path, bytes).and_then(|state| trainer.load_state(&state).map_err(|e| Error::file(&path, e)));
        let Err(error) = loaded else { return Ok(()) };
        complain(&format!("warning: {error}"));
    }
    match none {
        false => {
            Err(Error::file(folder(run), "every checkpoint is damaged, so the run cannot resume: train a new run"))
        }
        // The first one is there before the metrics are.
        true if run.file("metrics.jsonl").exists() => Err(Error::file(
            &run.folder,
            "has no checkpoints, like runs of earlier versions, and cannot resume: train a new run",
        )),
        true => Ok(()),
    }
}

/// Whether a file that begins so is not of a later version.
fn check_version(path: &Path, beginning: &[u8]) -> Result<()> {
    let version = || -> Option<u32> {
        let line = beginning.iter().take(LONGEST).position(|byte| *byte == b'\n')?;
        let words = std::str::from_utf8(&beginning[..line]).ok()?.strip_prefix(MAGIC)?;
        words.split_whitespace().next()?.parse().ok()
    };
    match version().filter(|version| *version > VERSION) {
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

/// The state in the bytes of a file.
pub(super) fn parse(path: &Path, mut bytes: Vec<u8>) -> Result<Vec<u8>> {
    let bad = |what: String| Error::file(path, what);
    check_version(path, &bytes)?;
    let end = bytes.iter().take(LONGEST).position(|byte| *byte == b'\n');
    let line = end.and_then(|end| std::str::from_utf8(&bytes[..end]).ok()?.strip_prefix(MAGIC));
    let (Some(end), Some(line)) = (end, line) else {
        return Err(bad("not a checkpoint, or its header is damaged".into()));
    };
    let mut words = line.split_whitespace();
    let version: Option<u32> = words.next().and_then(|word| word.parse().ok());
    let sum = words.next().and_then(|word| u32::from_str_radix(word, 16).ok());
    let length: Option<usize> = words.next().and_then(|word| word.parse().ok());
    let (Some(_), Some(sum), Some(length)) = (version, sum, length) else {
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
    fn damaged_checkpoint_is_refused() {
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
            // Only how the checksum is written may differ: in capitals.
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
        // The latest comes first, by number and not by name; others are none.
        for name in ["00000007.checkpoint", "00000100.checkpoint", "20.checkpoint", "x.checkpoint", "00000200.tmp"] {
            fs::write(folder.path().join(name), b"").unwrap();
        }
        let names = |(_, path): (u64, PathBuf)| path.file_name().unwrap().to_str().unwrap().to_owned();
        let found: Vec<String> = all(folder.path()).unwrap().into_iter().map(names).collect();
        assert_eq!(found, ["00000100.checkpoint", "20.checkpoint", "00000007.checkpoint"]);
        assert!(all(&folder.path().join("absent")).unwrap().is_empty());
    }
}
