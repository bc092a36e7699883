//! Signals: programs started to survive a hang-up do; all others save their work.

use super::SMALL;
use super::{Place, wait};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Instant;

pub fn send(child: &Child, signal: &str) {
    let sent = Command::new("kill").args([format!("-{signal}"), child.id().to_string()]).status().unwrap();
    assert!(sent.success());
}

/// Does something while a program is stopped.
pub fn stopped<R>(child: &Child, f: impl FnOnce() -> R) -> R {
    send(child, "STOP");
    let result = f();
    send(child, "CONT");
    result
}

/// Returns true if a file is not empty.
fn has_content(path: &Path) -> bool {
    std::fs::metadata(path).is_ok_and(|file| file.len() > 0)
}

/// Runs `raygrad` from a shell that ignores signals, as `nohup` does.
fn ignoring(place: &Place, signals: &str, arguments: &str) -> Command {
    let mut command = Command::new("/bin/sh");
    command.args(["-c", &format!("trap '' {signals}; exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_raygrad")]);
    command.args(arguments.split_whitespace()).current_dir(place.path(""));
    command.stdout(Stdio::null()).stderr(Stdio::null());
    command
}

#[test]
fn ignored_signals_end_no_training() {
    let place = Place::with_scene();
    let train = |run: &str| format!("train scene --budget 1h --out {run} {SMALL}");
    let length =
        |run: &str| std::fs::metadata(place.path(&format!("{run}/metrics.jsonl"))).map_or(0, |file| file.len());
    for (run, ignored, heard) in
        [("a", "HUP", "TERM"), ("b", "HUP INT", "TERM"), ("c", "TERM", "HUP"), ("d", "INT", "HUP")]
    {
        let mut child = ignoring(&place, ignored, &train(run)).spawn().unwrap();
        wait(&mut child, || length(run) > 0);
        ignored.split(' ').for_each(|signal| send(&child, signal));
        // It takes many more steps.
        let before = length(run);
        wait(&mut child, || length(run) > before + 2000);
        // Other signals end it.
        send(&child, heard);
        assert_eq!(child.wait().unwrap().code(), Some(130), "{ignored}");
        assert_eq!(place.json(&format!("{run}/summary.json"))["ended"], "interrupted");
    }
}

#[test]
fn repeated_hang_ups_save_the_model() {
    let place = Place::with_scene();
    for signal in ["HUP", "TERM"] {
        let mut command = place.command(&format!("train scene --budget 1h --out {signal} {SMALL}"));
        let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        wait(&mut child, || has_content(&place.path(&format!("{signal}/metrics.jsonl"))));
        let untrained = place.bytes(&format!("{signal}/model.safetensors"));
        // A closed terminal sends a hang-up, and so does its shell.
        let id = child.id().to_string();
        while child.try_wait().unwrap().is_none() {
            let _ = Command::new("kill").args([&format!("-{signal}"), &id]).stderr(Stdio::null()).status();
        }
        assert_eq!(child.wait().unwrap().code(), Some(130));
        assert_eq!(place.json(&format!("{signal}/summary.json"))["ended"], "interrupted");
        assert_ne!(place.bytes(&format!("{signal}/model.safetensors")), untrained);
        place.succeeds(&format!("train --resume {signal} --steps 1"));
    }
}

#[test]
fn commands_without_work_to_save_end_with_their_code() {
    let place = Place::with_run();
    for signal in ["INT", "TERM", "HUP"] {
        let mut server = super::view::serve(&place, "view run");
        send(&server.child, signal);
        assert_eq!(server.child.wait().unwrap().code(), Some(130), "{signal}");
    }
}

#[test]
fn second_ctrl_c_ends_at_once() {
    let place = Place::with_run();
    // One image takes minutes.
    let render = "render run --frames 2 --size 6000x6000 --out frames";
    let mut child = place.command(render).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    wait(&mut child, || place.path("frames/unfinished.json").exists());
    let start = Instant::now();
    while child.try_wait().unwrap().is_none() {
        assert!(start.elapsed().as_secs() < 60, "it did not end");
        send(&child, "INT");
    }
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert!(!place.path("frames/0000.png").exists(), "it finished the picture");
}

#[test]
fn child_programs_inherit_ignored_signals() {
    let place = super::prepare::place();
    // Replaces colmap: waits for a file, and reports a hang-up meanwhile.
    let script = "#!/bin/sh\n[ \"$1\" = mapper ] || exit 0\necho begun $$ >> \"$LOG\"\n\
                  while [ ! -e \"$LOG.go\" ]; do sleep 0.05; done\necho survived >> \"$LOG\"\nexit 1\n";
    let log = place.path("log");
    let text = || std::fs::read_to_string(&log).unwrap_or_default();
    let colmap = || text().lines().find_map(|line| line.strip_prefix("begun ").map(str::to_owned));
    for (signals, survives) in [("HUP", true), ("USR1", false)] {
        let _ = std::fs::remove_file(&log);
        let _ = std::fs::remove_file(place.path("log.go"));
        std::fs::write(place.path("bin/colmap"), script).unwrap();
        let mut command = ignoring(&place, signals, "prepare photos --out made");
        command.env("LOG", &log).env("PATH", place.path("bin"));
        let mut child = command.spawn().unwrap();
        wait(&mut child, || colmap().is_some());
        let sent = Command::new("kill").args(["-HUP", &colmap().unwrap()]).status().unwrap();
        assert!(sent.success());
        if survives {
            send(&child, "HUP");
        }
        std::fs::write(place.path("log.go"), "").unwrap();
        // It fails, since this colmap finds nothing. After an interruption it would have removed its work.
        assert_eq!(child.wait().unwrap().code(), Some(1));
        assert_eq!(text().contains("survived"), survives, "{signals}: {}", text());
    }
}
