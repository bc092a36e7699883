//! Signals. The first Ctrl-C requests a stop, the second ends the program. SIGTERM and SIGHUP only request a stop.

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

/// The first Ctrl-C sets [`requested`], a second one ends the program at once.
pub fn listen() {
    set("stopping after this step; Ctrl-C again stops at once", "save the model");
}

/// Like [`listen`], for frames that the same command can resume.
pub fn listen_to_go_on() {
    set("stopping after this frame; Ctrl-C again stops at once", "finish this frame");
}

/// Like [`listen`], for work whose unfinished result is removed.
pub fn listen_to_remove() {
    set("stopping and removing unfinished files; Ctrl-C again stops at once", "remove unfinished files");
}

/// The end of standard input counts as a Ctrl-C. It shows that the parent program has ended.
pub fn listen_to_input() {
    std::thread::spawn(|| {
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
        REQUESTED.store(true, Ordering::Relaxed);
    });
}

/// The line for the first Ctrl-C; empty before this program listens.
static SAID: Mutex<&str> = Mutex::new("");

/// Sets the line for the first Ctrl-C. Listens from the first call on: a second handler would end the program at once.
fn set(said: &'static str, promise: &str) {
    let line = || locked(&SAID);
    if !std::mem::replace(&mut *line(), said).is_empty() {
        return;
    }
    let handler = move |is_ctrl_c: bool| match REQUESTED.swap(true, Ordering::Relaxed) {
        false => note(*line()),
        // A closed terminal may send SIGHUP more than once, so that only Ctrl-C ends the program.
        true if is_ctrl_c => std::process::exit(EXIT_CODE.into()),
        true => {}
    };
    if let Err(error) = system::listen(handler) {
        complain(&format!("warning: Ctrl-C will not {promise}: {error}"));
    }
}

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
