//! Overwrite protection. A command may replace its own files, and any file with `--overwrite`.
//!
//! A command writes a mark into its files: a checksum of its arguments. So the same command may replace its output, but
//! no other file.

use std::fs::{File, Metadata};
use std::io::{ErrorKind, Read};
use std::path::Path;

use crc::{CRC_64_XZ, Crc};
use raygrad::nerf::{Error, Result};
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// The arguments of a command, except for the output path.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Job {
    mark: String,
    /// True if everything may be replaced.
    overwrites: bool,
}

/// Bytes at the beginning of a file that are searched for a mark. In a long video, tables come before it.
const SEARCHED: u64 = 16 << 20;
/// Bytes per read.
const BLOCK: usize = 1 << 16;

impl Job {
    /// Creates the job of a subcommand with these arguments.
    pub fn new(command: &str, arguments: &Value, overwrites: bool) -> Self {
        let number = Crc::<u64>::new(&CRC_64_XZ).checksum(arguments.to_string().as_bytes());
        Job { mark: format!("raygrad-{command}-{number:016x}"), overwrites }
    }

    /// The mark of files that this job writes.
    pub fn mark(&self) -> &str {
        &self.mark
    }

    /// Returns true if everything may be replaced.
    pub fn overwrites(&self) -> bool {
        self.overwrites
    }

    /// Returns true if a file contains the mark.
    pub fn wrote(&self, file: &Path) -> bool {
        // Unreadable files count as unmarked. Reading a pipe would block.
        let open = || File::open(file).and_then(|file| contains(file.take(SEARCHED), self.mark.as_bytes()));
        file.is_file() && open().unwrap_or(false)
    }

    /// Checks that a file may be written. Called before the work, and again before the file is replaced. An empty file
    /// holds nothing to lose.
    ///
    /// # Errors
    ///
    /// Fails if it is a folder, or a file of another job that this one may not replace.
    pub fn check(&self, out: &Path) -> Result<()> {
        match std::fs::symlink_metadata(out) {
            Err(e) if e.kind() == ErrorKind::NotFound => Ok(()),
            Err(e) => Err(Error::file(out, format!("cannot be written: {e}"))),
            Ok(_) if out.is_dir() => Err(Error::file(out, "is a folder, not a file")),
            Ok(about) if self.overwrites || is_empty(&about) || self.wrote(out) => Ok(()),
            Ok(_) => Err(taken(out)),
        }
    }
}

/// Returns true for a file without contents, such as a loss of power may leave.
fn is_empty(about: &Metadata) -> bool {
    about.is_file() && about.len() == 0
}

/// Returns true if a path is that of a file with contents, or of something else than a file.
pub fn is_occupied(path: &Path) -> bool {
    path.symlink_metadata().is_ok_and(|about| !is_empty(&about))
}

/// The error for an existing file.
pub fn taken(file: &Path) -> Error {
    Error::file(file, "exists, and another command or other options made it: choose another output or add --overwrite")
}

/// Returns true if the stream contains a word.
fn contains(mut from: impl Read, word: &[u8]) -> std::io::Result<bool> {
    let mut bytes = vec![];
    loop {
        let kept = bytes.len();
        from.by_ref().take(BLOCK as u64).read_to_end(&mut bytes)?;
        if bytes.windows(word.len()).any(|window| window == word) {
            return Ok(true);
        }
        if bytes.len() == kept {
            return Ok(false);
        }
        // The word may span two blocks.
        bytes.drain(..(bytes.len() + 1).saturating_sub(word.len()));
    }
}

/// Adds a Latin-1 text to a PNG file.
pub fn png_with_text(png: &[u8], text: &str) -> Vec<u8> {
    /// Length of the signature and of the first chunk. Other chunks may follow them.
    const HEADER: usize = 8 + 25;
    let body = [b"tEXtComment\0", text.as_bytes()].concat();
    let chunk = [&((body.len() - 4) as u32).to_be_bytes(), &body[..], &crc32fast::hash(&body).to_be_bytes()].concat();
    let (header, rest) = png.split_at(HEADER.min(png.len()));
    [header, &chunk, rest].concat()
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::Image;
    use serde_json::json;

    #[test]
    fn contains_word_across_blocks_is_found() {
        let word = b"raygrad-render-0123456789abcdef";
        for at in [0, 1, BLOCK - 1, BLOCK - word.len(), BLOCK - word.len() / 2, BLOCK, 3 * BLOCK - 2] {
            let mut bytes = vec![b'r'; 3 * BLOCK + 100];
            bytes[at..at + word.len()].copy_from_slice(word);
            assert!(contains(&bytes[..], word).unwrap(), "at {at}");
            bytes[at + word.len() - 1] = b'g';
            assert!(!contains(&bytes[..], word).unwrap(), "at {at}");
            assert!(!contains(&bytes[..at + word.len() - 1], word).unwrap(), "at {at}");
        }
        assert!(!contains(&b""[..], word).unwrap());
    }

    #[test]
    fn check_accepts_files_of_the_same_job() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.png");
        let job = |size: u32, overwrites: bool| Job::new("render", &json!({ "size": size }), overwrites);
        let image = Image { width: 2, height: 1, channels: 1, data: vec![0.0, 1.0] };
        let own = job(1, false);
        assert!(own.check(&path).is_ok());
        std::fs::write(&path, png_with_text(&image.to_png(), own.mark())).unwrap();
        assert_eq!(Image::open(&path).unwrap().data, [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]);
        let mut options = png::DecodeOptions::default();
        options.set_skip_ancillary_crc_failures(false);
        let file = std::io::BufReader::new(File::open(&path).unwrap());
        let reader = png::Decoder::new_with_options(file, options).read_info().unwrap();
        let [text] = &reader.info().uncompressed_latin1_text[..] else { panic!("one text") };
        assert_eq!((&text.keyword[..], &text.text[..]), ("Comment", own.mark()));
        assert!(own.check(&path).is_ok() && job(1, false) == own);
        // Files of another job, and other images.
        let refused = |job: Job| job.check(&path).unwrap_err().to_string();
        let expected = "exists, and another command or other options made it: choose another output or add --overwrite";
        assert_eq!(refused(job(2, false)), format!("{}: {expected}", path.display()));
        assert!(Job::new("export", &json!({ "size": 1 }), false).check(&path).is_err());
        std::fs::write(&path, image.to_png()).unwrap();
        assert!(refused(own.clone()).ends_with(expected));
        assert!(job(2, true).check(&path).is_ok());
        assert!(job(2, true).check(folder.path()).unwrap_err().to_string().ends_with("is a folder, not a file"));
        // In a long video, the mark follows the tables, within the limit.
        for (at, wrote) in [(15 << 20, true), (17 << 20, false)] {
            let video = [vec![0; at], own.mark().as_bytes().to_vec()].concat();
            std::fs::write(&path, video).unwrap();
            assert_eq!(own.wrote(&path), wrote);
        }
        // A pipe does not block.
        #[cfg(unix)]
        {
            let pipe = folder.path().join("pipe.png");
            let made = std::process::Command::new("mkfifo").arg(&pipe).status();
            assert!(made.is_err() || own.check(&pipe).is_err());
        }
        // Dangling links are not replaced.
        #[cfg(unix)]
        {
            let link = folder.path().join("link.png");
            std::os::unix::fs::symlink(folder.path().join("absent"), &link).unwrap();
            assert!(own.check(&link).is_err());
        }
    }
}
