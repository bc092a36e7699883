//! Runs that are killed, or refused something, at each call to the system that leaves something on disk.
//!
//! `FAULTS=all cargo test --test cli faults -- --nocapture` is the campaign: every call. The suite has one of 31. Both
//! need `strace`, and say that they skip without it.

use super::Place;
use super::SMALL;
use super::resume::assert_same;
use std::process::{Command, Output};

/// Calls that leave something on disk, and what each is for.
const CALLS: [(&str, &str); 6] = [
    ("mkdir", "a folder is made"),
    ("openat", "a file is opened"),
    ("write", "bytes are written"),
    ("fsync", "bytes reach the disk"),
    ("renameat", "a file gets its name"),
    ("unlink", "an old file goes"),
];
/// What a disk may answer in place of doing it.
const ANSWERS: [&str; 4] = ["ENOSPC", "EIO", "EROFS", "EDQUOT"];

/// Every how many calls there is a fault.
fn stride() -> usize {
    if std::env::var("FAULTS").is_ok_and(|which| which == "all") { 1 } else { 31 }
}

fn has_strace() -> bool {
    let found = Command::new("strace").arg("-V").output().is_ok_and(|output| output.status.success());
    if !found {
        println!("skipped: strace is not installed");
    }
    found
}

/// Runs the program, with a fault if one is given (`CALL:FAULT:when=N`), and gives what came of it and its calls.
fn traced(place: &Place, fault: Option<&str>, arguments: &str) -> (Output, Vec<String>) {
    let log = place.path("strace.log");
    let mut command = Command::new("strace");
    command.current_dir(place.path("")).args(["-f", "-qq", "-y", "-o"]).arg(&log);
    command.args(["-e", "trace=mkdir,openat,write,fsync,renameat,unlink"]);
    if let Some(fault) = fault {
        command.args(["-e", &format!("inject={fault}")]);
    }
    command.arg(env!("CARGO_BIN_EXE_raygrad")).args(arguments.split_whitespace());
    let output = command.output().unwrap();
    let text = std::fs::read_to_string(&log).unwrap();
    // Those of the thread that writes files: faults are counted for each thread.
    let first = text.split_whitespace().next().unwrap_or_default().to_owned();
    let own = text.lines().filter_map(|line| line.strip_prefix(&first)).map(|line| line.trim().to_owned());
    (output, own.collect())
}

/// Whether a call only asks: whose the run is, as each write does, or how long earlier parts of it took. That this cannot be read
/// for once changes nothing.
fn asks(call: &str) -> bool {
    ["run/lock.owner\"", "run/summary.json\""].iter().any(|name| call.contains(name)) && call.contains("O_RDONLY")
}

/// The numbers of the calls of this kind that are about the run, from 1 as faults count them.
fn about_the_run(calls: &[String], kind: &str) -> Vec<usize> {
    let of_kind = calls.iter().filter(|line| line.starts_with(&format!("{kind}(")));
    let ours = |line: &&String| (line.contains("\"run") || line.contains("/run/")) && !asks(line);
    of_kind.enumerate().filter(|(_, line)| ours(line)).map(|(i, _)| i + 1).collect()
}

/// Whether the calls have these names on this system; says so if not.
fn has_names(calls: &[String]) -> bool {
    let found = CALLS.iter().all(|(call, _)| !about_the_run(calls, call).is_empty());
    assert!(found || !cfg!(all(target_arch = "x86_64", target_env = "gnu")), "{calls:?}");
    if !found {
        println!("skipped: calls to this system have other names");
    }
    found
}

fn begin() -> String {
    format!("--threads 1 train scene --steps 12 --checkpoint-every 0.001s --out run {SMALL}")
}

/// Goes on with what a fault has left, with a new run if that was not even begun, and gives what it was.
fn go_on(place: &Place) -> &'static str {
    if !place.path("run/config.json").exists() {
        place.succeeds(&begin());
        return "nothing: trained anew";
    }
    place.succeeds("--threads 1 train --resume run --checkpoint-every 0.001s");
    "the run: went on"
}

/// A place with an undisturbed run in `whole`, and its calls; nothing, which it says, where faults cannot be made.
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
fn faults_that_kill_a_run_at_any_call_cost_it_nothing() {
    let Some((place, calls)) = undisturbed() else { return };
    let mut kills = 0;
    for (call, what) in CALLS {
        let (mut anew, mut on) = (0, 0);
        for number in about_the_run(&calls, call).into_iter().step_by(stride()) {
            forget(&place);
            // As the call is about to be made.
            let (output, _) = traced(&place, Some(&format!("{call}:signal=KILL:when={number}")), &begin());
            // How many calls there are depends on time: a run may be too quick to be killed.
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
fn faults_of_a_disk_lose_no_run() {
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
            let line = said.lines().find(|line| line.starts_with("raygrad: ") && !line.contains("few-photographs"));
            match (output.status.code(), line) {
                (Some(0), Some(_)) => warned += 1,
                // There may be fewer calls this time.
                (Some(0), None) if !calls.iter().any(|call| call.contains("(INJECTED)") && !asks(call)) => silent += 1,
                // What cannot write cannot say so.
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
