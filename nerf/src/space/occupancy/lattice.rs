//! Numbering of cells: blocks of 4 x 4 x 4 cells, cascades, and the position of a cell in the scene.

use glam::DVec3;
use std::ops::Range;

/// Cells along an edge of a block.
pub(super) const EDGE: usize = 4;
/// Cells in a block: the bits of its word.
pub(super) const CELLS: usize = u64::BITS as usize;
const _: () = assert!(EDGE * EDGE * EDGE == CELLS);

/// The geometry of a grid, without its content.
///
/// Cascade 0 is the box itself. Each further cascade is a box twice as large around the same centre, with as many
/// cells. A point belongs to the smallest cascade that contains it. Blocks are numbered x fastest, then y, z and
/// cascade; bit `x + 4 y + 16 z` of a block's word is its cell `(x, y, z)`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Lattice {
    pub bounds: [DVec3; 2],
    pub resolution: usize,
    pub cascades: usize,
}

impl Lattice {
    /// Blocks along an edge of a cascade.
    pub fn side(&self) -> usize {
        self.resolution / EDGE
    }

    /// Blocks in one cascade.
    pub fn blocks(&self) -> usize {
        self.side().pow(3)
    }

    /// Blocks in all cascades.
    pub fn words(&self) -> usize {
        self.blocks() * self.cascades
    }

    /// The words of one cascade.
    pub fn cascade(&self, cascade: usize) -> Range<usize> {
        cascade * self.blocks()..(cascade + 1) * self.blocks()
    }

    /// The cascade of a word and its block's place in it.
    pub fn place(&self, word: usize) -> (usize, [usize; 3]) {
        let (side, block) = (self.side(), word % self.blocks());
        (word / self.blocks(), [block % side, block / side % side, block / (side * side)])
    }

    /// The size of a word's cells, relative to those of cascade 0.
    pub fn enlargement(&self, word: usize) -> f32 {
        (1_u32 << self.place(word).0) as f32
    }

    /// Returns true unless a smaller cascade covers the same part of space, so that the word's cells are not in use.
    pub fn is_used(&self, word: usize) -> bool {
        let (cascade, block) = self.place(word);
        let (quarter, side) = (self.side() / 4, self.side());
        cascade == 0 || !block.iter().all(|b| (quarter..side - quarter).contains(b))
    }

    /// The number of cells in use.
    pub fn used_cells(&self) -> usize {
        let inner = if self.cascades > 1 { (self.side() / 2).pow(3) } else { 0 };
        (self.words() - (self.cascades - 1) * inner) * CELLS
    }

    /// Lower and upper corner of a cascade, in scene units.
    pub fn extent(&self, cascade: usize) -> [DVec3; 2] {
        let [low, high] = self.bounds;
        let (centre, half) = (0.5 * (low + high), 0.5 * (high - low) * (1u64 << cascade) as f64);
        if cascade == 0 { self.bounds } else { [centre - half, centre + half] }
    }

    /// Lower corner of a word's block and the size of its cells, in scene units.
    pub fn block(&self, word: usize) -> [DVec3; 2] {
        let (cascade, block) = self.place(word);
        let [low, high] = self.extent(cascade);
        let cell = (high - low) / self.resolution as f64;
        [low + cell * DVec3::from(block.map(|b| (b * EDGE) as f64)), cell]
    }

    /// The word and the bit of the smallest cell that holds a place; `None` if none does. Upper faces of a box belong
    /// to its last cells.
    pub fn holding(&self, place: DVec3) -> Option<(usize, usize)> {
        (0..self.cascades).find_map(|cascade| {
            let [low, high] = self.extent(cascade);
            let share = (place - low) / (high - low);
            if !(share.cmpge(DVec3::ZERO).all() && share.cmple(DVec3::ONE).all()) {
                return None;
            }
            let cell = share.to_array().map(|x| ((x * self.resolution as f64) as usize).min(self.resolution - 1));
            let number = |part: [usize; 3], side: usize| part[0] + side * (part[1] + side * part[2]);
            let word = self.cascade(cascade).start + number(cell.map(|i| i / EDGE), self.side());
            Some((word, number(cell.map(|i| i % EDGE), EDGE)))
        })
    }
}

/// The position of a cell in its block.
pub(super) fn cell(bit: usize) -> [usize; 3] {
    [bit % EDGE, bit / EDGE % EDGE, bit / (EDGE * EDGE)]
}

/// The density of a carved cell: below any threshold, and never sampled.
pub(super) const CARVED: f32 = f32::NEG_INFINITY;

/// The cells of a block that are not carved.
pub(super) fn uncarved(densities: &[f32]) -> u64 {
    densities.iter().enumerate().fold(0, |word, (bit, &x)| word | u64::from(x != CARVED) << bit)
}
