//! Append-only files of records.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use raygrad::nerf::{Error, Result, write_atomic};

/// A file that always holds whole records. A record that cannot be written, as on a full disk, is written with the next
/// one.
pub struct Journal {
    path: PathBuf,
    file: File,
    /// Length of all whole records in the file, in bytes.
    length: u64,
    /// Records that are not in the file yet.
    waiting: Vec<u8>,
}

impl Journal {
    /// Replaces a file by a new one with this content.
    pub fn begin(path: &Path, beginning: &[u8]) -> Result<Self> {
        write_atomic(path, beginning)?;
        let file = File::options().append(true).open(path).map_err(|e| failed(path, &e))?;
        Ok(Journal { path: path.into(), file, length: beginning.len() as u64, waiting: vec![] })
    }

    /// Appends the waiting records and this one.
    pub fn add(&mut self, record: &[u8]) -> Result<()> {
        self.waiting.extend_from_slice(record);
        self.append()
    }

    /// Appends the waiting records.
    fn append(&mut self) -> Result<()> {
        if let Err(error) = self.file.write_all(&self.waiting) {
            // No further recovery is possible.
            let _ = self.file.set_len(self.length);
            return Err(failed(&self.path, &error));
        }
        self.length += self.waiting.len() as u64;
        self.waiting.clear();
        Ok(())
    }

    /// Flushes all records to the disk, waiting ones too.
    pub fn flush(&mut self) -> Result<()> {
        self.append()?;
        self.file.sync_data().map_err(|e| failed(&self.path, &e))
    }
}

fn failed(path: &Path, error: &std::io::Error) -> Error {
    Error::file(path, format!("cannot be written: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn add_after_failure_writes_waiting_records() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("records");
        let mut journal = Journal::begin(&path, b"begin\n").unwrap();
        journal.add(b"one\n").unwrap();
        // A read-only file refuses every record.
        let writable = std::mem::replace(&mut journal.file, File::open(&path).unwrap());
        for record in [b"two\n", b"six\n"] {
            let message = journal.add(record).unwrap_err().to_string();
            assert!(message.contains("records: cannot be written"), "{message}");
        }
        journal.file = writable;
        journal.flush().unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "begin\none\ntwo\nsix\n");
        journal.add(b"ten\n").unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "begin\none\ntwo\nsix\nten\n");
        assert_eq!(journal.length, std::fs::metadata(&path).unwrap().len());
    }
}
