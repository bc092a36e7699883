//! Signals. They end a program that has nothing to save. Of one that has, the first Ctrl-C requests a stop, and the second
//! ends it. SIGTERM and SIGHUP only request a stop.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use raygrad::nerf::Error;
use raygrad::tensor::parallel::locked;

use super::output::{complain, note};

/// Exit code of an interrupted program: 128 + SIGINT, as shells report it.
pub const EXIT_CODE: u8 = 130;

/// Reason for an early end of work.
#[derive(Debug)]
pub enum Stop {
    /// Ctrl-C was pressed.
    Interrupted,
    /// An error occurred.
    Failed(Error),
}

/// Result of interruptible work.
pub type Work<T> = Result<T, Stop>;

impl From<Error> for Stop {
    fn from(error: Error) -> Self {
        Stop::Failed(error)
    }
}

static REQUESTED: AtomicBool = AtomicBool::new(false);

/// From now on, signals end the program with [`EXIT_CODE`]. Called once, before any of the other functions.
pub fn end_at_signals() {
    let handler = |is_ctrl_c: bool| {
        let said = *locked(&SAID);
        if said.is_empty() {
            std::process::exit(EXIT_CODE.into());
        }
        match REQUESTED.swap(true, Ordering::Relaxed) {
            false => note(said),
            // A closed terminal may send SIGHUP more than once, so that only Ctrl-C ends a program that stops.
            true if is_ctrl_c => std::process::exit(EXIT_CODE.into()),
            true => {}
        }
    };
    if let Err(error) = system::listen(handler) {
        complain(&format!("warning: signals such as Ctrl-C will end raygrad without saving its work: {error}"));
    }
}

/// The first Ctrl-C sets [`requested`], a second one ends the program at once.
pub fn listen() {
    *locked(&SAID) = "stopping after this step; Ctrl-C again stops at once";
}

/// Like [`listen`], for frames that the same command can resume.
pub fn listen_to_go_on() {
    *locked(&SAID) = "stopping after this frame; Ctrl-C again stops at once";
}

/// Like [`listen`], for work whose unfinished result is removed.
pub fn listen_to_remove() {
    *locked(&SAID) = "stopping and removing unfinished files; Ctrl-C again stops at once";
}

/// The end of standard input counts as a Ctrl-C. It shows that the parent program has ended.
pub fn listen_to_input() {
    std::thread::spawn(|| {
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
        REQUESTED.store(true, Ordering::Relaxed);
    });
}

/// The line for the first Ctrl-C; empty while the program has nothing to save.
static SAID: Mutex<&str> = Mutex::new("");

/// Returns true if a stop was requested.
pub fn requested() -> bool {
    REQUESTED.load(Ordering::Relaxed)
}

#[cfg(unix)]
mod system {
    use std::io;
    use std::mem::MaybeUninit;
    use std::ptr;

    use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
    use signal_hook::iterator::Signals;

    /// Calls `handler` for each signal that ends programs. Its argument is true for Ctrl-C. Signals that are ignored at
    /// start (`nohup`, background jobs of scripts) stay ignored, also in child processes.
    pub fn listen(handler: impl Fn(bool) + Send + 'static) -> io::Result<()> {
        let wanted = [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|signal| !is_ignored(*signal));
        let mut signals = Signals::new(wanted)?;
        let listener = move || signals.forever().for_each(|signal| handler(signal == SIGINT));
        std::thread::Builder::new().name("signals".into()).spawn(listener).map(drop)
    }

    /// Returns true if a signal is ignored.
    fn is_ignored(signal: i32) -> bool {
        let mut action = MaybeUninit::<libc::sigaction>::zeroed();
        // SAFETY: a null action makes the call a query. It writes a whole `sigaction` to `action` if it succeeds. The
        // initial zeros are a valid `sigaction` too. Run by `is_ignored_matches_known_signals`.
        let action = unsafe {
            libc::sigaction(signal, ptr::null(), action.as_mut_ptr());
            action.assume_init()
        };
        action.sa_sigaction == libc::SIG_IGN
    }

    #[cfg(test)]
    mod tests {
        use super::*;

        #[test]
        fn is_ignored_matches_known_signals() {
            // Rust's runtime ignores SIGPIPE. Nothing ignores SIGCHLD here, and signal 0 does not exist.
            assert!(is_ignored(libc::SIGPIPE));
            assert!(!is_ignored(libc::SIGCHLD) && !is_ignored(0));
        }
    }
}

#[cfg(not(unix))]
mod system {
    /// Calls `handler` for each Ctrl-C.
    pub fn listen(handler: impl Fn(bool) + Send + 'static) -> Result<(), ctrlc::Error> {
        ctrlc::set_handler(move || handler(true))
    }
}
