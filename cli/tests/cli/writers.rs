//! Every command that writes, with faults of the disk at its output.
//!
//! `WRITERS=all cargo test --test cli writers -- --nocapture` injects each fault at up to twelve calls and prints the
//! table; the suite injects some of them once.

use super::faults::{has_strace, traced};
use super::power::{Tree, differing, on_disk};
use super::{Place, SMALL};
use std::path::Path;

/// A command that writes, and what it writes.
struct Writer {
    command: &'static str,
    /// The file or folder of the result.
    result: &'static str,
    /// True if a folder of results may hold some new files beside old ones.
    is_gradual: bool,
}

const fn writer(command: &'static str, result: &'static str) -> Writer {
    Writer { command, result, is_gradual: false }
}

const WRITERS: [Writer; 10] = [
    writer("render run --path orbit --frames 2 --size 8x6 --out film.gif --overwrite", "film.gif"),
    Writer {
        is_gradual: true,
        ..writer("render run --path orbit --frames 2 --size 8x6 --out frames --overwrite", "frames")
    },
    writer("export run mesh.ply --resolution 8 --iso-value 0.01 --overwrite", "mesh.ply"),
    writer("export run page.html --overwrite", "page.html"),
    writer("export run cameras.json --overwrite", "cameras.json"),
    writer("prepare scene --to nerfstudio --out captured", "captured"),
    Writer { is_gradual: true, ..writer("eval run", "run") },
    Writer { is_gradual: true, ..writer("doctor scene --out checked --overwrite", "checked") },
    Writer { is_gradual: true, ..writer("bench --suite quadrature --quick --out measured --overwrite", "measured") },
    Writer {
        is_gradual: true,
        ..writer("render run --path orbit --frames 2 --size 8x6 --shard 1/1 --out shards --overwrite", "shards")
    },
];

/// Calls, the errors that they may answer, and the fault.
const FAULTS: [(&str, &str, &str); 13] = [
    ("write", "error=ENOSPC", "the disk is full"),
    ("write", "error=EDQUOT", "the quota is used up"),
    ("write", "error=EIO", "the disk fails to write"),
    ("openat", "error=EROFS", "the disk is read-only"),
    ("openat", "error=ENOENT", "the folder has vanished"),
    ("openat", "error=ENAMETOOLONG", "the name is too long"),
    ("mkdir", "error=EACCES", "the folder is not writable"),
    ("fsync", "error=EIO", "the disk fails to flush"),
    ("renameat", "error=EXDEV", "another disk is mounted between"),
    ("renameat", "error=EBUSY", "the target is a mount point"),
    ("rename", "error=EXDEV", "another disk is mounted between"),
    ("rename", "error=EBUSY", "the target is a mount point"),
    ("fsync", "delay_enter=50000", "the disk is slow"),
];

/// How the system names these errors.
const CAUSES: [(&str, &str); 8] = [
    ("ENOSPC", "No space left on device"),
    ("EDQUOT", "Disk quota exceeded"),
    ("EIO", "Input/output error"),
    ("EROFS", "Read-only file system"),
    ("ENOENT", "No such file or directory"),
    ("ENAMETOOLONG", "File name too long"),
    ("EACCES", "Permission denied"),
    ("EXDEV", "Invalid cross-device link"),
];

/// Returns true if a call of the trace concerns the output, or a temporary file beside it.
fn is_about(call: &str, place: &str, result: &str) -> bool {
    // Reading the run and the capture is no write.
    let writes = !call.starts_with("openat(") || call.contains("O_CREAT");
    let inside =
        call.contains(place) || call.contains("AT_FDCWD") || call.starts_with("mkdir(") || call.starts_with("rename(");
    writes && inside && (call.contains(result) || call.contains(".raygrad-tmp-") || call.contains("-unfinished-"))
}

/// The files of the result.
fn result(tree: &Tree, name: &str) -> Tree {
    tree.iter().filter(|(path, _)| path.starts_with(name)).map(|(path, bytes)| (path.clone(), bytes.clone())).collect()
}

#[test]
fn writers_keep_old_results_on_faults() {
    if !has_strace() {
        return;
    }
    let all = std::env::var("WRITERS").is_ok_and(|which| which == "all");
    let place = Place::with_scene();
    place.succeeds(&format!("--threads 1 train scene --steps 12 --out run {SMALL}"));
    let root = place.path("").canonicalize().unwrap();
    let here = root.to_str().unwrap();
    for (number, Writer { command, result: name, is_gradual }) in WRITERS.into_iter().enumerate() {
        // It takes seconds.
        let is_slow = command.starts_with("bench");
        if is_slow && !all {
            continue;
        }
        let threaded = format!("--threads 1 {command}");
        let before = on_disk(&place);
        let (output, calls) = traced(&place, None, &threaded);
        assert!(matches!(output.status.code(), Some(0 | 3)), "{command}: {output:?}");
        let after = result(&on_disk(&place), name);
        let restore = || {
            let now = on_disk(&place);
            for path in now.keys().rev().filter(|path| !before.contains_key(*path)) {
                let path = root.join(path);
                let _ = if path.is_dir() { std::fs::remove_dir(path) } else { std::fs::remove_file(path) };
            }
            for (path, bytes) in before.iter().filter(|(path, bytes)| now.get(*path) != Some(*bytes)) {
                match bytes {
                    Some(bytes) => std::fs::write(root.join(path), bytes).unwrap(),
                    None => std::fs::create_dir_all(root.join(path)).unwrap(),
                }
            }
        };
        // An old result, if this command replaces one; a new capture needs an absent folder.
        let replaces = !command.starts_with("prepare");
        for (kind, (call, fault, what)) in FAULTS.into_iter().enumerate() {
            let of_kind = calls.iter().filter(|line| line.starts_with(&format!("{call}(")));
            let numbers: Vec<usize> =
                of_kind.enumerate().filter(|(_, line)| is_about(line, here, name)).map(|(i, _)| i + 1).collect();
            if numbers.is_empty() || !all && (number + kind) % 3 != 0 {
                continue;
            }
            let stride = if all && !is_slow { 1.max(numbers.len() / 12) } else { numbers.len() };
            let (mut failed, mut warned, mut succeeded, mut words) = (0, 0, 0, String::new());
            for (turn, at) in numbers.into_iter().step_by(stride).enumerate() {
                restore();
                if !is_gradual && replaces {
                    std::fs::write(root.join(name), "an old result").unwrap();
                } else if replaces {
                    place.command(&threaded).output().unwrap();
                }
                let old = on_disk(&place);
                // Once, or from then on. First a full disk on which a message can be written.
                let more = if (turn % 2 == 0) == (call != "write") { "+" } else { "" };
                let (output, calls) = traced(&place, Some(&format!("{call}:{fault}:when={at}{more}")), &threaded);
                // This time a command may have fewer calls, or another one may be at this number.
                let hit = calls.iter().any(|call| call.contains("(INJECTED)") && is_about(call, here, name));
                let said = String::from_utf8_lossy(&output.stderr).into_owned();
                let case = format!("{command}: {call} {fault} at {at}{more}: {said}");
                assert!(!said.contains("panicked"), "{case}");
                let line = said.lines().find(|line| line.starts_with("raygrad: ")).unwrap_or_default();
                let cause = CAUSES.iter().find(|(error, _)| fault.ends_with(error)).map_or("", |(_, cause)| cause);
                if hit && !fault.starts_with("delay") && call != "write" {
                    // A target that is a mount point may be reported in other words.
                    assert!(line.contains(cause) && (line.contains(name) || is_gradual), "{case}");
                }
                match output.status.code() {
                    Some(0 | 3) if line.is_empty() && (!hit || fault.starts_with("delay")) => succeeded += 1,
                    Some(0 | 3) if !line.is_empty() => warned += 1,
                    // A program that cannot write cannot print either.
                    Some(1) if !line.is_empty() || call == "write" => failed += 1,
                    code => panic!("{case} {code:?}"),
                }
                if words.is_empty() {
                    words = line.replace(here, "");
                }
                let now = on_disk(&place);
                let [new, old_result] = [&now, &old].map(|tree| result(tree, name));
                let ends_well = matches!(output.status.code(), Some(0 | 3));
                let other = |tree: &Tree| {
                    let outside = tree
                        .iter()
                        .filter(|(path, bytes)| !path.starts_with(name) && bytes.is_some() && !is_temporary(path));
                    outside.map(|(path, bytes)| (path.clone(), bytes.clone())).collect::<Tree>()
                };
                assert!(
                    other(&now) == other(&old),
                    "{case}: files beside: {:?}",
                    differing(&other(&now), &other(&old))
                );
                let gone: Vec<_> =
                    old_result.keys().filter(|path| !is_temporary(path) && !new.contains_key(*path)).collect();
                assert!(gone.is_empty(), "{case}: {gone:?} have gone");
                if !is_gradual {
                    let complete = new == old_result || same_lengths(&new, &after);
                    assert!(complete, "{case}: {:?}", differing(&new, &old_result));
                    assert!(!ends_well || same_lengths(&new, &after), "{case}: it ended well without its result");
                } else {
                    // No file is cut: each is the old one, or the new one.
                    for (path, bytes) in new.iter().filter(|(path, bytes)| bytes.is_some() && !is_temporary(path)) {
                        let fits = old_result.get(path) == Some(bytes) || is_whole(path, bytes.as_ref().unwrap());
                        assert!(fits, "{case}: {path:?} is cut");
                    }
                }
                // And the command succeeds when the disk works again.
                if !(command.starts_with("prepare") && ends_well) {
                    let again = place.command(&threaded).output().unwrap();
                    assert!(matches!(again.status.code(), Some(0 | 3)), "{case}: and then {again:?}");
                }
            }
            println!("{command} | {what} | {failed} errors, {warned} warnings, {succeeded} done | {words}");
        }
        restore();
        if replaces {
            place.command(&threaded).output().unwrap();
        }
    }
}

/// Temporary files and locks, and files that name jobs and times.
fn is_temporary(path: &Path) -> bool {
    let name = path.to_string_lossy();
    [".raygrad-tmp-", "-unfinished-", ".frames", "lock", "strace.log", "unfinished"]
        .iter()
        .any(|part| name.contains(part))
}

/// Returns true if both have the same files with the same lengths: marks of jobs and times differ in their bytes.
fn same_lengths(a: &Tree, b: &Tree) -> bool {
    let lengths = |tree: &Tree| {
        let files = tree.iter().filter_map(|(path, bytes)| Some((path.clone(), bytes.as_ref()?.len())));
        files.collect::<Vec<_>>()
    };
    lengths(a) == lengths(b)
}

/// Returns true if a file of a known format ends as it must.
fn is_whole(path: &Path, bytes: &[u8]) -> bool {
    match path.extension().and_then(|ending| ending.to_str()).unwrap_or_default() {
        "png" => bytes.ends_with(b"IEND\xaeB`\x82"),
        "html" => bytes.trim_ascii_end().ends_with(b"</html>"),
        "json" => serde_json::from_slice::<serde_json::Value>(bytes).is_ok(),
        "csv" | "txt" | "md" | "svg" => bytes.ends_with(b"\n") || bytes.ends_with(b">"),
        other => panic!("a file of type {other}: {path:?}"),
    }
}
