//! Folders that are removed, moved or replaced while a program writes to them.

use super::resume::{SMALL, assert_same};
use super::{Place, complained, wait};
use std::process::{Child, Output, Stdio};

/// Begins a long training in `run`, with many checkpoints, and waits for the first of them.
fn begin(place: &Place) -> Child {
    let arguments = format!("train scene --budget 1h --checkpoint 0.05s --out run {SMALL}");
    let mut child = place.command(&arguments).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    wait(&mut child, || {
        let found = std::fs::read_dir(place.path("run/checkpoints"));
        found.is_ok_and(|found| found.flatten().filter(|entry| entry.path().extension().is_some()).count() > 1)
    });
    child
}

fn end(child: Child) -> Output {
    let id = child.id().to_string();
    let _ = std::process::Command::new("kill").args(["-TERM", &id]).status();
    child.wait_with_output().unwrap()
}

/// The last line that a program complained with is that it lost its folder.
#[track_caller]
fn lost(what: &str, mut output: Output) {
    let said = String::from_utf8(output.stderr).unwrap();
    let last = said.lines().rfind(|line| line.starts_with("raygrad: ")).unwrap_or_default().to_owned();
    output.stderr = (last + "\n").into_bytes();
    let expected = "run: another raygrad trains here now, in this folder or in one that took its place";
    complained(what, &output, &[expected, "raygrad train --resume"]);
}

#[test]
fn a_training_whose_folder_is_replaced_stops() {
    let place = Place::with_scene();
    let small = format!("train scene --steps 40 --checkpoint 0.02s {SMALL}");
    place.succeeds(&format!("{small} --out whole"));
    for moves in [false, true] {
        let first = begin(&place);
        if moves {
            std::fs::rename(place.path("run"), place.path("moved")).unwrap();
        } else {
            std::fs::remove_dir_all(place.path("run")).unwrap();
        }
        // The first one may have made its folder again, and then keeps it.
        let second = place.command(&format!("{small} --out run")).output().unwrap();
        if second.status.success() {
            // It stops by itself.
            lost("the first training", first.wait_with_output().unwrap());
            assert_same(&place, "whole", "run");
            let left = std::fs::read_dir(place.path("run/checkpoints")).unwrap().count();
            assert_eq!(left, 2, "the checkpoints of one run");
        } else {
            let said = String::from_utf8_lossy(&second.stderr).into_owned();
            assert!(said.contains("by another raygrad") || said.contains("already holds a run"), "{said}");
            assert_eq!(end(first).status.code(), Some(130));
        }
        if moves {
            place.succeeds("train --resume moved --steps 1");
            std::fs::remove_dir_all(place.path("moved")).unwrap();
        }
        std::fs::remove_dir_all(place.path("run")).unwrap();
    }
}

#[test]
fn a_training_whose_run_is_taken_over_stops() {
    // As where a file system has no locks: another program has written to the lock.
    let place = Place::with_scene();
    let first = begin(&place);
    std::fs::write(place.path("run/lock"), "1 0123456789abcdef\n").unwrap();
    lost("the first training", first.wait_with_output().unwrap());
    let summary = place.json("run/summary.json");
    assert_eq!(summary["ended"], serde_json::Value::Null, "nothing more was written");
    place.succeeds("train --resume run --steps 1");
}

#[test]
fn a_folder_that_is_removed_is_made_again() {
    let place = Place::with_scene();
    let mut first = begin(&place);
    std::fs::remove_dir_all(place.path("run")).unwrap();
    wait(&mut first, || place.path("run/checkpoints").exists() && place.path("run/metrics.jsonl").exists());
    place.fails(&format!("train scene --steps 3 --out run {SMALL}"), &["run"]);
    let output = end(first);
    assert_eq!(output.status.code(), Some(130), "{output:?}");
    let metrics = String::from_utf8(place.bytes("run/metrics.jsonl")).unwrap();
    assert!(metrics.lines().count() > 0 && place.json("run/summary.json")["ended"] == "interrupted");
    place.succeeds("eval run --views 1");
    place.succeeds("train --resume run --steps 1");
}
