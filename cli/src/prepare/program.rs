//! External programs: running them and reading their output.

use std::collections::VecDeque;
use std::ffi::OsString;
use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::time::Duration;

use raygrad::nerf::{Error, Result};

use crate::interrupt::{self, Stop, Work};
use crate::output::note;

/// Lines of output that are shown if a program fails.
const KEPT: usize = 12;
/// Interval of checks for Ctrl-C.
const INTERVAL: Duration = Duration::from_millis(100);

/// An external program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Program {
    /// Name of the command.
    pub name: &'static str,
    /// Installation instructions.
    pub install: &'static str,
}

/// Reads videos.
pub const FFMPEG: Program = Program {
    name: "ffmpeg",
    install: "`apt install ffmpeg`, `brew install ffmpeg`, `conda install -c conda-forge ffmpeg` or \
              `winget install Gyan.FFmpeg`",
};

/// Converts HEIC and AVIF, with EXIF data and colour profile.
pub const HEIF_CONVERT: Program =
    Program { name: "heif-convert", install: "`apt install libheif-examples` or `brew install libheif`" };

/// The later name of [`HEIF_CONVERT`].
pub const HEIF_DEC: Program = Program { name: "heif-dec", ..HEIF_CONVERT };

/// Finds camera poses.
pub const COLMAP: Program = Program {
    name: "colmap",
    install: "`apt install colmap`, `brew install colmap`, `conda install -c conda-forge colmap`, or for Windows \
              (winget has none) from github.com/colmap/colmap/releases",
};

/// Finds camera poses of many images faster.
pub const GLOMAP: Program = Program { name: "glomap", install: "the instructions at github.com/colmap/glomap" };

impl Program {
    /// Runs a short command and returns its output, whatever its exit code.
    pub fn ask<S: AsRef<std::ffi::OsStr>>(&self, arguments: &[S]) -> Work<String> {
        let output = Command::new(self.name).args(arguments).stdin(Stdio::null()).output();
        let output = output.map_err(|e| self.unusable(&e))?;
        Ok([output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned()).concat())
    }

    /// Runs a command and passes each line of output to `line`. Shows the last lines if it fails, and ends it after
    /// Ctrl-C. Output that contains `excuse` counts as success, whatever the exit code.
    pub fn run(&self, command: &mut Command, excuse: Option<&str>, mut line: impl FnMut(&str)) -> Work<()> {
        command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|e| self.unusable(&e))?;
        let (sender, lines) = mpsc::channel();
        if let Some(out) = child.stdout.take() {
            listen(out, sender.clone());
        }
        if let Some(err) = child.stderr.take() {
            listen(err, sender.clone());
        }
        drop(sender);
        let mut kept = VecDeque::new();
        let mut excused = false;
        loop {
            match lines.recv_timeout(INTERVAL) {
                Ok(said) => {
                    line(&said);
                    excused |= excuse.is_some_and(|words| said.contains(words));
                    if !is_count(&said) {
                        kept.push_back(said);
                    }
                    if kept.len() > KEPT {
                        kept.pop_front();
                    }
                }
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            if interrupt::requested() {
                end(&mut child);
                return Err(Stop::Interrupted);
            }
        }
        let status = child.wait().map_err(|e| self.unusable(&e))?;
        // A terminal sends Ctrl-C to both programs, and the child may end first.
        if interrupt::requested() {
            return Err(Stop::Interrupted);
        }
        if status.success() || excused {
            return Ok(());
        }
        for line in &kept {
            note(&format!("  {line}"));
        }
        let step = command.get_args().next().and_then(|step| step.to_str()).filter(|step| !step.starts_with('-'));
        let name = step.map_or(self.name.to_owned(), |step| format!("{} {step}", self.name));
        let above = if kept.is_empty() { "and printed nothing" } else { "and its last output is above" };
        Err(Error::setting(name, format!("failed ({}), {above}", ending(status))).into())
    }

    /// Creates a command for the program.
    pub fn command(&self) -> Command {
        Command::new(self.name)
    }

    /// Fails if the program cannot be run.
    pub fn check(&self) -> Work<()> {
        self.ask(&["-h"]).map(drop)
    }

    fn unusable(&self, error: &std::io::Error) -> Stop {
        let what = match error.kind() {
            ErrorKind::NotFound => format!("is not on the PATH; install it with {}", self.install),
            _ => format!("cannot be run: {error}"),
        };
        Error::setting(self.name, what).into()
    }
}

/// The name of a file for ffmpeg, which takes `2024-05-01T12:30.mp4` and `http:host` for protocols.
pub fn file_url(file: &Path) -> Result<OsString> {
    let absolute = std::path::absolute(file).map_err(|e| Error::file(file, format!("cannot be read: {e}")))?;
    let mut url = OsString::from("file:");
    url.push(absolute);
    Ok(url)
}

/// Returns true for progress lines of ffmpeg, such as `out_time_us=1240000`. They are left out of error messages.
fn is_count(line: &str) -> bool {
    line.split_once('=')
        .is_some_and(|(name, _)| name.bytes().all(|c| c.is_ascii_lowercase() || c == b'_' || c.is_ascii_digit()))
}

/// Reads a stream in a separate thread and sends its lines. A program would block if nothing read its output.
fn listen(stream: impl Read + Send + 'static, sender: Sender<String>) {
    std::thread::spawn(move || {
        let mut stream = BufReader::new(stream);
        let mut bytes = vec![];
        while matches!(stream.read_until(b'\n', &mut bytes), Ok(count) if count > 0) {
            let text = String::from_utf8_lossy(&bytes);
            // After carriage returns, only the last text of a line counts.
            let last = text.trim_end().rsplit('\r').next().unwrap_or_default().trim_end().to_owned();
            bytes.clear();
            if !last.is_empty() && sender.send(last).is_err() {
                break;
            }
        }
    });
}

/// Ends a child process, which may have ended already.
fn end(child: &mut Child) {
    let _ = child.kill();
    let _ = child.wait();
}

fn ending(status: ExitStatus) -> String {
    status.code().map_or_else(|| status.to_string(), |code| format!("exit code {code}"))
}

/// The last `12/120` in brackets as a fraction. COLMAP prints `[12/120]`, or `[3/8, 2/8]` for nested blocks.
pub fn counted(line: &str) -> Option<f64> {
    let inside = line.rsplit_once('[')?.1.split_once(']')?.0;
    let mut share = 0.0;
    let mut size = 1.0;
    for part in inside.split(',') {
        let (done, all) = part.split_once('/')?;
        let (done, all): (f64, f64) = (done.trim().parse().ok()?, all.trim().parse().ok()?);
        if !(all >= 1.0 && (0.0..=all).contains(&done)) {
            return None;
        }
        // COLMAP counts from 1. All but the innermost count name a block that has only begun.
        share += size * (done - 1.0).max(0.0) / all;
        size /= all;
    }
    Some((share + size).min(1.0))
}

#[cfg(test)]
mod tests {
    use super::{counted, is_count};

    #[test]
    fn is_count_for_ffmpeg_progress_only() {
        for line in ["frame=12", "stream_0_0_q=-1.0", "out_time=00:00:01.2", "progress=continue"] {
            assert!(is_count(line), "{line}");
        }
        for line in ["Unknown encoder 'libx264'", "[mp4 @ 0x5] crf=18 is no number", "Error: a = b", "end"] {
            assert!(!is_count(line), "{line}");
        }
    }

    #[test]
    fn counted_parses_colmap_progress() {
        for (line, share) in [
            ("I1122 10:00:00 feature.cc:1] Processed file [12/120]", 0.1),
            ("Matching block [1/2, 2/2]", 0.5),
            ("Processing block [2/2, 2/2] in 3.1s", 1.0),
        ] {
            assert!(counted(line).is_some_and(|counted| (counted - share).abs() < 1e-12), "{line}");
        }
        for line in ["", "no count", "[a/b]", "[3/2]", "[1/0]", "[1]", "[-1/2]", "]["] {
            assert_eq!(counted(line), None, "{line}");
        }
    }
}
