//! The first bytes of a file.

use crate::error::{Error, Result};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// The bytes that are read of a JPEG for its header. If EXIF and colour profiles take more, all of it is read.
const START: u64 = 1 << 18;

/// The first bytes of a file, and its length.
pub(super) fn start_of(path: &Path) -> Result<(Vec<u8>, u64)> {
    let bad = |e: std::io::Error| Error::file(path, format!("cannot be read: {e}"));
    let file = File::open(path).map_err(bad)?;
    let (mut start, length) = (vec![], file.metadata().map_err(bad)?.len());
    file.take(START).read_to_end(&mut start).map_err(bad)?;
    Ok((start, length))
}
