//! Folders that are removed, moved or replaced while a program writes to them.

use super::SMALL;
use super::resume::assert_same;
use super::signals::{send, stopped};
use super::{Place, complained, files_below, wait};
use std::process::{Child, Output, Stdio};

/// Begins a long training in `run` with many checkpoints, and waits for some of them.
fn begin(place: &Place, flags: &str) -> Child {
    let arguments = format!("train scene --budget 1h --checkpoint-every 0.05s --out run {flags} {SMALL}");
    let mut child = place.command(&arguments).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    wait(&mut child, || {
        let found = std::fs::read_dir(place.path("run/checkpoints"));
        found.is_ok_and(|found| found.flatten().filter(|entry| entry.path().extension().is_some()).count() > 1)
    });
    child
}

/// The output of a program that ends by itself within a minute.
fn ended(mut child: Child) -> Output {
    let start = std::time::Instant::now();
    while child.try_wait().unwrap().is_none() {
        if start.elapsed().as_secs() > 60 {
            child.kill().unwrap();
        }
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
    child.wait_with_output().unwrap()
}

/// Checks that the last error of a program is the loss of its folder.
#[track_caller]
fn lost(what: &str, mut output: Output) {
    let said = String::from_utf8(output.stderr).unwrap();
    let last = said.lines().rfind(|line| line.starts_with("raygrad: ")).unwrap_or_default().to_owned();
    output.stderr = (last + "\n").into_bytes();
    let expected = "run: training stopped: another raygrad now uses this folder";
    complained(what, &output, &[expected, "raygrad train --resume"]);
}

#[test]
fn training_stops_if_its_folder_is_replaced() {
    let place = Place::with_scene();
    let small = format!("train scene --steps 40 --checkpoint-every 0.02s {SMALL}");
    place.succeeds(&format!("{small} --out whole"));
    for moves in [false, true] {
        let first = begin(&place, "");
        // It is stopped while another one begins and ends.
        stopped(&first, || {
            if moves {
                std::fs::rename(place.path("run"), place.path("moved")).unwrap();
            } else {
                std::fs::remove_dir_all(place.path("run")).unwrap();
            }
            place.succeeds(&format!("{small} --out run"));
        });
        let before = files_below(&place.path("run"));
        lost("the first training", ended(first));
        assert_same(&place, "whole", "run");
        // A file being written at that moment is completed.
        let changed: Vec<_> = files_below(&place.path("run"))
            .into_iter()
            .filter(|(path, bytes)| before.get(path) != Some(bytes))
            .collect();
        assert!(changed.len() <= 1, "{:?}", changed.iter().map(|(path, _)| path).collect::<Vec<_>>());
        if moves {
            place.succeeds("train --resume moved --steps 1");
            std::fs::remove_dir_all(place.path("moved")).unwrap();
        }
        std::fs::remove_dir_all(place.path("run")).unwrap();
    }
}

#[test]
fn training_stops_if_its_run_is_taken_over() {
    // As on a file system without locks: another program wrote its name.
    let place = Place::with_scene();
    for flags in ["--steps 100000", "--checkpoint-every 1h"] {
        let first = begin(&place, "");
        let before = stopped(&first, || {
            std::fs::write(place.path("run/lock.owner"), "1 0123456789abcdef\n").unwrap();
            files_below(&place.path("run"))
        });
        lost(flags, ended(first));
        // A file being written at that moment is completed.
        let written: Vec<_> = files_below(&place.path("run"))
            .into_iter()
            .filter(|(path, bytes)| before.get(path) != Some(bytes))
            .collect();
        assert!(written.len() <= 1, "{:?}", written.iter().map(|(path, _)| path).collect::<Vec<_>>());
        place.succeeds("train --resume run --steps 1");
        std::fs::remove_dir_all(place.path("run")).unwrap();
    }
}

#[test]
fn training_recreates_a_removed_folder() {
    let place = Place::with_scene();
    let mut first = begin(&place, "--tensorboard");
    stopped(&first, || std::fs::remove_dir_all(place.path("run")).unwrap());
    let is_there = |name: &str| place.path(&format!("run/{name}")).exists();
    wait(&mut first, || ["checkpoints", "metrics.jsonl", "tensorboard", "model.safetensors"].into_iter().all(is_there));
    // It recreates the folder each time it is removed.
    place.fails_with(
        &format!("train scene --steps 3 --out run {SMALL}"),
        "run: another raygrad is training it: stop that one or choose another --out",
    );
    // Without its lock the run is still there and stays.
    let metrics = || String::from_utf8(place.bytes("run/metrics.jsonl")).unwrap();
    wait(&mut first, || metrics().lines().count() > 3);
    let before = stopped(&first, || {
        std::fs::remove_file(place.path("run/lock")).unwrap();
        std::fs::remove_file(place.path("run/lock.owner")).unwrap();
        metrics()
    });
    wait(&mut first, || is_there("lock.owner"));
    send(&first, "TERM");
    let output = ended(first);
    assert_eq!(output.status.code(), Some(130), "{output:?}");
    let said = String::from_utf8(output.stderr).unwrap();
    assert_eq!(said.matches("run: was removed or moved: training continues in a new folder of that name").count(), 1);
    assert!(metrics().starts_with(&before) && place.json("run/summary.json")["ended"] == "interrupted");
    assert_eq!(std::fs::read_dir(place.path("run/tensorboard")).unwrap().count(), 1);
    place.succeeds("eval run --views 1");
    place.succeeds("train --resume run --steps 1");
}

#[test]
fn eval_stops_if_its_folder_is_taken_over() {
    let place = Place::with_run();
    for gone in [false, true] {
        let folder = place.path("run/eval-test-f64");
        let name = folder.join("unfinished.lock.owner");
        let _ = std::fs::remove_dir_all(&folder);
        let mut child = place.command("eval run --precision f64").stderr(Stdio::piped()).spawn().unwrap();
        // This folder is created once the lock is taken.
        wait(&mut child, || folder.join("unfinished").exists());
        stopped(&child, || match gone {
            true => std::fs::remove_file(&name).unwrap(),
            false => std::fs::write(&name, "1 0123456789abcdef\n").unwrap(),
        });
        let output = ended(child);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(1) && said.contains("another raygrad evaluates there now"), "{said}");
        assert!(!place.path("run/eval-test-f64.json").exists(), "nothing was written");
    }
}
