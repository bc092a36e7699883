//! Kills and errors at each system call that changes the disk.
//!
//! `FAULTS=all cargo test --test cli faults -- --nocapture` tests every call; the suite tests one in 31. Both need
//! `strace` and print a skip message without it.

use super::Place;
use super::SMALL;
use super::resume::assert_same;
use raygrad_test_support::skip::skipped;
use std::process::{Command, Output};

/// System calls that change the disk, and their purpose.
const CALLS: [(&str, &str); 6] = [
    ("mkdir", "a folder is made"),
    ("openat", "a file is opened"),
    ("write", "bytes are written"),
    ("fsync", "bytes reach the disk"),
    ("renameat", "a file gets its name"),
    ("unlink", "an old file goes"),
];
/// Possible errors of a disk.
const ANSWERS: [&str; 4] = ["ENOSPC", "EIO", "EROFS", "EDQUOT"];

/// The number of calls per tested fault.
fn stride() -> usize {
    if std::env::var("FAULTS").is_ok_and(|which| which == "all") { 1 } else { 31 }
}

pub fn has_strace() -> bool {
    let found = Command::new("strace").arg("-V").output().is_ok_and(|output| output.status.success());
    if !found {
        skipped("strace is not installed");
    }
    found
}

/// Runs the program, with a fault if one is given (`CALL:FAULT:when=N`). Returns its output and its calls.
pub fn traced(place: &Place, fault: Option<&str>, arguments: &str) -> (Output, Vec<String>) {
    let log = place.path("strace.log");
    let mut command = Command::new("strace");
    command.current_dir(place.path("")).args(["-f", "-qq", "-y", "-o"]).arg(&log);
    command.args(["-e", "trace=mkdir,openat,write,fsync,rename,renameat,unlink,rmdir"]);
    if let Some(fault) = fault {
        command.args(["-e", &format!("inject={fault}")]);
    }
    command.arg(env!("CARGO_BIN_EXE_raygrad")).args(arguments.split_whitespace());
    let output = command.output().unwrap();
    let text = std::fs::read_to_string(&log).unwrap();
    // Calls of the thread that writes files, since strace counts faults per thread.
    let first = text.split_whitespace().next().unwrap_or_default().to_owned();
    let own = text.lines().filter_map(|line| line.strip_prefix(&first)).map(|line| line.trim().to_owned());
    (output, own.collect())
}

/// Returns true if a call only reads the run's owner, as before each write, or the times of earlier parts. A single
/// failure of it changes nothing.
fn asks(call: &str) -> bool {
    ["run/lock.owner\"", "run/summary.json\""].iter().any(|name| call.contains(name)) && call.contains("O_RDONLY")
}

/// The numbers, from 1 as in strace, of the calls of this kind that concern the run.
fn about_the_run(calls: &[String], kind: &str) -> Vec<usize> {
    let of_kind = calls.iter().filter(|line| line.starts_with(&format!("{kind}(")));
    let ours = |line: &&String| (line.contains("\"run") || line.contains("/run/")) && !asks(line);
    of_kind.enumerate().filter(|(_, line)| ours(line)).map(|(i, _)| i + 1).collect()
}

/// Returns true if the calls have these names on this system; prints a skip message otherwise.
fn has_names(calls: &[String]) -> bool {
    let found = CALLS.iter().all(|(call, _)| !about_the_run(calls, call).is_empty());
    assert!(found || !cfg!(all(target_arch = "x86_64", target_env = "gnu")), "{calls:?}");
    if !found {
        skipped("calls to this system have other names");
    }
    found
}

fn begin() -> String {
    format!("--threads 1 train scene --steps 12 --checkpoint-every 0.001s --out run {SMALL}")
}

/// Resumes the run, or trains a new one if it had not begun; returns which.
fn go_on(place: &Place) -> &'static str {
    if !place.path("run/config.json").exists() {
        place.succeeds(&begin());
        return "nothing: trained anew";
    }
    place.succeeds("--threads 1 train --resume run --checkpoint-every 0.001s");
    "the run: went on"
}

/// A place with an undisturbed run in `whole`, and its calls; `None` with a message if faults cannot be injected.
fn undisturbed() -> Option<(Place, Vec<String>)> {
    if !has_strace() {
        return None;
    }
    let place = Place::with_scene();
    let (output, calls) = traced(&place, None, &begin());
    assert!(output.status.success(), "{output:?}");
    std::fs::rename(place.path("run"), place.path("whole")).unwrap();
    has_names(&calls).then_some((place, calls))
}

fn forget(place: &Place) {
    let _ = std::fs::remove_dir_all(place.path("run"));
}

#[test]
fn faults_by_kill_at_any_call_lose_nothing() {
    let Some((place, calls)) = undisturbed() else { return };
    let mut kills = 0;
    for (call, what) in CALLS {
        let (mut anew, mut on) = (0, 0);
        for number in about_the_run(&calls, call).into_iter().step_by(stride()) {
            forget(&place);
            // At the start of the call.
            let (output, _) = traced(&place, Some(&format!("{call}:signal=KILL:when={number}")), &begin());
            // The number of calls depends on time, so a run may end before the kill.
            if !output.status.success() {
                kills += 1;
                if go_on(&place).starts_with("nothing") { anew += 1 } else { on += 1 }
            }
            assert_same(&place, "whole", "run");
        }
        println!("killed when {what} ({call}): {on} went on, {anew} had not begun, all ended as the undisturbed run");
    }
    assert!(kills > 3, "{kills}");
}

#[test]
fn faults_of_the_disk_lose_no_run() {
    let Some((place, calls)) = undisturbed() else { return };
    for (i, (call, what)) in CALLS.into_iter().enumerate() {
        let (mut ended, mut warned, mut silent, mut words) = (0, 0, 0, String::new());
        for (j, number) in about_the_run(&calls, call).into_iter().step_by(stride()).enumerate() {
            forget(&place);
            // Once, or from then on.
            let (answer, more) = (ANSWERS[(i + j) % 4], if j % 2 == 0 { "+" } else { "" });
            let fault = format!("{call}:error={answer}:when={number}{more}");
            let (output, calls) = traced(&place, Some(&fault), &begin());
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(!said.contains("panicked"), "{fault}: {said}");
            let line = said.lines().find(|line| line.starts_with("raygrad: ") && !line.contains("few-images"));
            match (output.status.code(), line) {
                (Some(0), Some(_)) => warned += 1,
                // This run may have fewer calls.
                (Some(0), None) if !calls.iter().any(|call| call.contains("(INJECTED)") && !asks(call)) => silent += 1,
                // A program that cannot write cannot print an error.
                (Some(1), line) if line.is_some() || call == "write" => ended += 1,
                _ => {
                    let injected: Vec<_> = calls.iter().filter(|call| call.contains("(INJECTED)")).collect();
                    panic!("{fault}: {injected:?}: {output:?}");
                }
            }
            if words.is_empty() {
                words = line.unwrap_or_default().to_owned();
            }
            go_on(&place);
            assert_same(&place, "whole", "run");
        }
        assert!(ended + warned > 0, "{call}");
        println!(
            "refused when {what} ({call}): {ended} ended with an error, {warned} with a warning, {silent} had ended before; {words}"
        );
    }
}

/// Panics unless calls of these names, whose lines contain these texts, follow each other.
#[track_caller]
fn assert_order(calls: &[String], expected: &[(&str, &str)]) {
    let mut rest = calls.iter();
    for (call, text) in expected {
        let found = rest.any(|line| line.starts_with(&format!("{call}(")) && line.contains(text));
        assert!(found, "no {call} of {text} in its order: {calls:#?}");
    }
}

/// A loss of power keeps what was written before the sync: so contents come first, then the name, then what is deleted.
#[test]
fn faults_by_power_loss_keep_films_and_captures() {
    if !has_strace() {
        return;
    }
    let place = Place::with_scene();
    place.succeeds(&begin());
    let folder = place.path("").canonicalize().unwrap();
    let folder = format!("<{}>", folder.display());
    let (output, calls) = traced(&place, None, "--threads 1 render run --path test --size 8x6 --out film.gif");
    assert!(output.status.success(), "{output:?}");
    assert_order(
        &calls,
        &[
            ("mkdir", "film.gif.frames"),
            ("fsync", &folder),
            ("fsync", "film.gif.frames/"),
            ("renameat", "film.gif.frames/0000.png"),
            ("fsync", "film.gif.frames>"),
            ("fsync", "/video>"),
            ("rename", "film.gif\""),
            ("fsync", &folder),
            ("unlink", "film.gif.frames/0000.png"),
        ],
    );
    let (output, calls) = traced(&place, None, "--threads 1 prepare scene --to nerfstudio --out captured");
    assert!(output.status.success(), "{output:?}");
    let (mut folders, mut count) = (vec![place.path("captured")], 0);
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).unwrap().map(|entry| entry.unwrap().path()) {
            if entry.is_dir() {
                folders.push(entry);
                continue;
            }
            count += 1;
            let name = format!("/{}>", entry.strip_prefix(place.path("captured")).unwrap().display());
            assert_order(&calls, &[("fsync", &name), ("rename", "captured\""), ("fsync", &folder)]);
        }
    }
    assert!(count > 3, "{count} files");
}
