//! Hang-ups: what was started to survive them does, and all else saves its work.

use super::resume::SMALL;
use super::{Place, wait};
use std::path::Path;
use std::process::{Child, Command, Stdio};

fn send(child: &Child, signal: &str) {
    let sent = Command::new("kill").args([format!("-{signal}"), child.id().to_string()]).status().unwrap();
    assert!(sent.success());
}

/// Whether a file has something in it.
fn has_content(path: &Path) -> bool {
    std::fs::metadata(path).is_ok_and(|file| file.len() > 0)
}

/// Runs `raygrad` by a shell that ignores signals, as `nohup` does.
fn ignoring(place: &Place, signals: &str, arguments: &str) -> Command {
    let mut command = Command::new("/bin/sh");
    command.args(["-c", &format!("trap '' {signals}; exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_raygrad")]);
    command.args(arguments.split_whitespace()).current_dir(place.path(""));
    command.stdout(Stdio::null()).stderr(Stdio::null());
    command
}

#[test]
fn ignored_hang_ups_end_no_training() {
    let place = Place::with_scene();
    let mut child = ignoring(&place, "HUP INT", &format!("train scene --steps 150 --out run {SMALL}")).spawn().unwrap();
    wait(&mut child, || has_content(&place.path("run/metrics.jsonl")));
    send(&child, "HUP");
    // As of a job that a script put in the background.
    send(&child, "INT");
    assert_eq!(child.wait().unwrap().code(), Some(0));
    assert_eq!(place.json("run/summary.json")["steps"], 150);
    // Signals that are not ignored still stop it.
    let mut child = ignoring(&place, "HUP", &format!("train scene --budget 1h --out other {SMALL}")).spawn().unwrap();
    wait(&mut child, || has_content(&place.path("other/metrics.jsonl")));
    send(&child, "HUP");
    send(&child, "TERM");
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert_eq!(place.json("other/summary.json")["ended"], "interrupted");
}

#[test]
fn hang_ups_save_the_model_however_often_they_come() {
    let place = Place::with_scene();
    let mut command = place.command(&format!("train scene --budget 1h --out run {SMALL}"));
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    wait(&mut child, || has_content(&place.path("run/metrics.jsonl")));
    let untrained = place.bytes("run/model.safetensors");
    // A terminal that is closed hangs up for itself, and so does the shell in it.
    for _ in 0..5 {
        send(&child, "HUP");
    }
    assert_eq!(child.wait().unwrap().code(), Some(130));
    assert_eq!(place.json("run/summary.json")["ended"], "interrupted");
    assert_ne!(place.bytes("run/model.safetensors"), untrained);
    place.succeeds("train --resume run --steps 1");
}

#[test]
fn programs_that_are_started_inherit_what_is_ignored() {
    let place = super::prepare::place();
    // In place of colmap: waits until it is told to go on, and hears of a hang-up meanwhile.
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
            assert!(child.try_wait().unwrap().is_none(), "the hang-up ended it");
        }
        std::fs::write(place.path("log.go"), "").unwrap();
        // It fails, as this colmap finds nothing; with the code of an interruption it would have removed its work.
        assert_eq!(child.wait().unwrap().code(), Some(1));
        assert_eq!(text().contains("survived"), survives, "{signals}: {}", text());
    }
}
