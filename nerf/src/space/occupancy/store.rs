//! Serialisation of grids.

use super::empty_cubes::Leaps;
use super::lattice::CELLS;
use super::{OccupancyConfig, OccupancyGrid};
use crate::{Error, Result};
use glam::DVec3;
use std::sync::Arc;

/// The magic bytes of a stored grid, a name and a version: with the densities of its cells, and without.
const WHOLE: [u8; 8] = *b"raygocc1";
const OCCUPIED: [u8; 8] = *b"raygocb1";
/// Bytes before the words: magic, resolution and cascades (u32), lower and upper corner (f64).
const HEADER: usize = 8 + 2 * 4 + 6 * 8;

impl OccupancyGrid {
    /// Serialises the whole grid, to resume training: a header, one word per block and one `f32` per cell,
    /// little-endian. It takes 8.7 MB at 128^3.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = self.header_and_words(WHOLE);
        bytes.reserve(4 * self.densities.len());
        self.densities.iter().for_each(|density| bytes.extend(density.to_le_bytes()));
        bytes
    }

    /// Serialises only the occupied cells, which suffice for rendering. It takes 0.26 MB at 128^3.
    pub fn occupied_to_bytes(&self) -> Vec<u8> {
        self.header_and_words(OCCUPIED)
    }

    fn header_and_words(&self, magic: [u8; 8]) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEADER + 8 * self.words.len());
        bytes.extend(magic);
        for number in [self.resolution(), self.cascades()] {
            bytes.extend((number as u32).to_le_bytes());
        }
        for number in self.bounds().map(|corner| corner.to_array()).as_flattened() {
            bytes.extend(number.to_le_bytes());
        }
        self.words.iter().for_each(|word| bytes.extend(word.to_le_bytes()));
        bytes
    }

    /// Deserialises [`to_bytes`](Self::to_bytes) or [`occupied_to_bytes`](Self::occupied_to_bytes). After the latter,
    /// occupied cells count as never sampled, and others as empty.
    ///
    /// # Errors
    /// If the bytes are too short, too long or not a grid.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self> {
        let error = |what: String| Error::setting("occupancy grid", what);
        let magic = bytes.first_chunk().filter(|magic| [WHOLE, OCCUPIED].contains(magic));
        if bytes.len() < HEADER || magic.is_none() {
            return Err(error("is not an occupancy grid of this version; save the model again".into()));
        }
        let is_whole = magic == Some(&WHOLE);
        let mut rest = &bytes[WHOLE.len()..];
        let [resolution, cascades] = [0; 2].map(|_| u32::from_le_bytes(take(&mut rest)) as usize);
        let corners = [[0; 3]; 2].map(|corner| DVec3::from(corner.map(|_| f64::from_le_bytes(take(&mut rest)))));
        let config = OccupancyConfig { resolution, cascades, ..OccupancyConfig::default() };
        // Checked before memory is allocated for it.
        config.check()?;
        let cells = resolution.pow(3) * cascades;
        let needed = HEADER + cells / CELLS * 8 + if is_whole { cells * 4 } else { 0 };
        if bytes.len() != needed {
            return Err(error(format!("has {} bytes, should have {needed}; save the model again", bytes.len())));
        }
        let mut grid = OccupancyGrid::new(corners, &config)?;
        grid.words.iter_mut().for_each(|word| *word = u64::from_le_bytes(take(&mut rest)));
        let densities = Arc::make_mut(&mut grid.densities);
        if is_whole {
            densities.iter_mut().for_each(|density| *density = f32::from_le_bytes(take(&mut rest)));
        } else {
            for (cells, word) in densities.chunks_exact_mut(CELLS).zip(&grid.words) {
                cells
                    .iter_mut()
                    .enumerate()
                    .for_each(|(bit, x)| *x = if word >> bit & 1 == 1 { f32::NAN } else { 0.0 });
            }
        }
        grid.leaps = Leaps::new(&grid.words, &grid.lattice);
        Ok(grid)
    }
}

/// Takes the first `N` bytes off a slice, which must have as many.
fn take<const N: usize>(bytes: &mut &[u8]) -> [u8; N] {
    let mut out = [0; N];
    let (head, rest) = bytes.split_at(N);
    out.copy_from_slice(head);
    *bytes = rest;
    out
}
