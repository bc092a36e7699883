//! Tests that skip because a program or a file is missing.

use std::fs::OpenOptions;
use std::io::{Result, Write};
use std::path::Path;

/// The environment variable that names a file to which tests that skip append a line.
pub const VARIABLE: &str = "RAYGRAD_SKIPPED";

/// Prints that the running test skips and why, and records it in the file of [`VARIABLE`].
///
/// # Panics
/// If the file cannot be written.
pub fn skipped(reason: &str) {
    println!("skipped: {reason}");
    if let Some(file) = std::env::var_os(VARIABLE) {
        let thread = std::thread::current();
        record(Path::new(&file), thread.name().unwrap_or("a test"), reason).unwrap();
    }
}

/// Appends `test: reason` in one write, as tests of several programs share the file.
fn record(file: &Path, test: &str, reason: &str) -> Result<()> {
    OpenOptions::new().create(true).append(true).open(file)?.write_all(format!("{test}: {reason}\n").as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_of_skips_are_appended() {
        let file = std::env::temp_dir().join(format!("raygrad-skips-{}", std::process::id()));
        record(&file, "video", "ffmpeg is not installed").unwrap();
        record(&file, "disk", "strace is not installed").unwrap();
        let text = std::fs::read_to_string(&file).unwrap();
        std::fs::remove_file(&file).unwrap();
        assert_eq!(text, "video: ffmpeg is not installed\ndisk: strace is not installed\n");
    }
}
