//! Ctrl-C: the first asks to stop, the second stops. SIGTERM and a hang-up ask, however often they come.

use std::sync::atomic::{AtomicBool, Ordering};

use raygrad::nerf::Error;

use super::output::{complain, note};

/// Exit code of a program that was interrupted: 128 + SIGINT, as a shell reports it.
pub const EXIT_CODE: u8 = 130;

/// Why work ended early.
#[derive(Debug)]
pub enum Stop {
    /// There was a Ctrl-C.
    Interrupted,
    /// Something is wrong.
    Failed(Error),
}

/// What comes of work that may be interrupted.
pub type Work<T> = Result<T, Stop>;

impl From<Error> for Stop {
    fn from(error: Error) -> Self {
        Stop::Failed(error)
    }
}

static REQUESTED: AtomicBool = AtomicBool::new(false);

/// From now on a first Ctrl-C only sets [`requested`]; a second one ends the program at once.
pub fn listen() {
    set("stopping after this step; Ctrl-C again stops at once", "save the model");
}

/// As [`listen`], for frames that the same command goes on with.
pub fn listen_to_go_on() {
    set("stopping after this frame; Ctrl-C again stops at once", "finish this frame");
}

/// As [`listen`], for work whose unfinished result is removed.
pub fn listen_to_remove() {
    set("stopping and removing unfinished files; Ctrl-C again stops at once", "remove unfinished files");
}

/// From now on the end of standard input counts as a Ctrl-C: of the program at its other end, whatever ends that.
pub fn listen_to_input() {
    std::thread::spawn(|| {
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
        REQUESTED.store(true, Ordering::Relaxed);
    });
}

fn set(said: &'static str, promise: &str) {
    let handler = move |is_ctrl_c: bool| match REQUESTED.swap(true, Ordering::Relaxed) {
        false => note(said),
        // A terminal that is closed may hang up more than once: nobody asks for haste.
        true if is_ctrl_c => std::process::exit(EXIT_CODE.into()),
        true => {}
    };
    if let Err(error) = system::listen(handler) {
        complain(&format!("warning: Ctrl-C will not {promise}: {error}"));
    }
}

/// Whether it is to stop.
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

    /// Calls `handler` for each signal that asks this program to end, and says whether it is Ctrl-C. Those that it was started
    /// to ignore, as by `nohup` or in the background of a script, stay ignored, here and in the programs that it starts.
    pub fn listen(handler: impl Fn(bool) + Send + 'static) -> io::Result<()> {
        let wanted = [SIGINT, SIGTERM, SIGHUP].into_iter().filter(|signal| !is_ignored(*signal));
        let mut signals = Signals::new(wanted)?;
        let listener = move || signals.forever().for_each(|signal| handler(signal == SIGINT));
        std::thread::Builder::new().name("signals".into()).spawn(listener).map(drop)
    }

    /// Whether a signal is ignored.
    fn is_ignored(signal: i32) -> bool {
        let mut action = MaybeUninit::<libc::sigaction>::zeroed();
        // SAFETY: without a new action the call changes nothing; it writes a whole one to the place that is given, and that of
        // zeros which is read otherwise is one too. Run by `ignored_signals_are_known`.
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
        fn ignored_signals_are_known() {
            // Rust's runtime ignores SIGPIPE; nobody ignores SIGCHLD here, and there is no signal 0.
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
