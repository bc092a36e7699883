//! Ctrl-C: the first asks to stop, the second stops.

use std::sync::atomic::{AtomicBool, Ordering};

use super::output::{complain, note};

/// Exit code of a program that was interrupted: 128 + SIGINT, as a shell reports it.
pub const EXIT_CODE: u8 = 130;

static REQUESTED: AtomicBool = AtomicBool::new(false);

/// From now on a first Ctrl-C only sets [`requested`]; a second one ends the program at once.
pub fn listen() {
    set("stopping after this step; Ctrl-C again stops at once", "save the model");
}

/// As [`listen`], for frames that the same command goes on with.
pub fn listen_to_go_on() {
    set("stopping after this frame; Ctrl-C again stops at once", "let this frame be finished");
}

/// As [`listen`], for work whose unfinished result is removed.
pub fn listen_to_remove() {
    set("stopping, and removing what is unfinished; Ctrl-C again stops at once", "remove what is unfinished");
}

/// From now on the end of standard input counts as a Ctrl-C: of the program at its other end, whatever ends that.
pub fn listen_to_input() {
    std::thread::spawn(|| {
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
        REQUESTED.store(true, Ordering::Relaxed);
    });
}

fn set(said: &'static str, promise: &str) {
    let handler = move || {
        if REQUESTED.swap(true, Ordering::Relaxed) {
            std::process::exit(EXIT_CODE.into());
        }
        note(said);
    };
    if let Err(error) = ctrlc::set_handler(handler) {
        complain(&format!("warning: Ctrl-C will not {promise}: {error}"));
    }
}

/// Whether it is to stop.
pub fn requested() -> bool {
    REQUESTED.load(Ordering::Relaxed)
}
