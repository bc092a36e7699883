//! Files that grow record by record.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};

use raygrad::nerf::{Error, Result, write_atomic};

/// A file that holds whole records at any time: of one that cannot be written, as the disk is full, nothing stays, so that
/// those that follow can be read.
pub struct Journal {
    path: PathBuf,
    file: File,
    /// The bytes of all whole records.
    length: u64,
}

impl Journal {
    /// Replaces a file by one with this beginning.
    pub fn begin(path: &Path, beginning: &[u8]) -> Result<Self> {
        write_atomic(path, beginning)?;
        let file = File::options().append(true).open(path).map_err(|e| failed(path, &e))?;
        Ok(Journal { path: path.into(), file, length: beginning.len() as u64 })
    }

    /// Adds a record.
    pub fn add(&mut self, record: &[u8]) -> Result<()> {
        if let Err(error) = self.file.write_all(record) {
            // If that fails too, nobody can do more.
            let _ = self.file.set_len(self.length);
            return Err(failed(&self.path, &error));
        }
        self.length += record.len() as u64;
        Ok(())
    }
}

fn failed(path: &Path, error: &std::io::Error) -> Error {
    Error::file(path, format!("cannot be written: {error}"))
}
