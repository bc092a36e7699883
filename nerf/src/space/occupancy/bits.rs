//! Sets of cells as words of bits: growing, coarsening and counting.

use super::lattice::{CELLS, EDGE, Lattice, cell};

/// For each axis, the distance between the bits of neighbouring cells.
const STRIDES: [usize; 3] = [1, EDGE, EDGE * EDGE];
/// For each axis, the bits of the cells at the lower face of a block.
const LOWER: [u64; 3] = [0x1111_1111_1111_1111, 0x000f_000f_000f_000f, 0x0000_0000_0000_ffff];

/// Adds the cells that touch a set's cells by a face, an edge or a corner, within each cascade and from each cascade to
/// the one around it.
pub(super) fn dilate(words: &mut [u64], lattice: &Lattice) {
    coarsen(words, lattice);
    for cascade in 0..lattice.cascades {
        let words = &mut words[lattice.cascade(cascade)];
        for axis in 0..3 {
            dilate_axis(words, lattice.side(), axis);
        }
    }
}

/// Adds each cell's two neighbours along an axis.
fn dilate_axis(words: &mut [u64], side: usize, axis: usize) {
    let (shift, far, lower) = (STRIDES[axis], (EDGE - 1) * STRIDES[axis], LOWER[axis]);
    let upper = lower << far;
    let stride = side.pow(axis as u32);
    // Rows of blocks along the axis. Each word needs the old values of its neighbours.
    for start in (0..words.len()).filter(|start| (start / stride).is_multiple_of(side)) {
        let mut before = 0;
        for i in 0..side {
            let word = words[start + i * stride];
            let after = if i + 1 < side { words[start + (i + 1) * stride] } else { 0 };
            let inner = (word & !upper) << shift | (word & !lower) >> shift;
            words[start + i * stride] = word | inner | (before & upper) >> far | (after & lower) << far;
            before = word;
        }
    }
}

/// Adds to the inner part of each cascade the cells that contain any cell of a smaller cascade.
///
/// No lookup reads a single cell there, but an empty block is then empty in all cascades.
pub(super) fn coarsen(words: &mut [u64], lattice: &Lattice) {
    let (side, quarter) = (lattice.side(), lattice.side() / 4);
    for cascade in 1..lattice.cascades {
        for word in lattice.cascade(cascade - 1) {
            let fine = words[word];
            if fine == 0 {
                continue;
            }
            let (_, block) = lattice.place(word);
            let coarse = block.map(|b| quarter + b / 2);
            let target = lattice.cascade(cascade).start + coarse[0] + side * (coarse[1] + side * coarse[2]);
            for bit in (0..CELLS).filter(|bit| fine >> bit & 1 == 1) {
                let cell = cell(bit);
                let bit: usize = (0..3).map(|a| STRIDES[a] * (block[a] % 2 * 2 + cell[a] / 2)).sum();
                words[target] |= 1 << bit;
            }
        }
    }
}

/// The number of set cells that are in use.
pub(super) fn count(words: &[u64], lattice: &Lattice) -> usize {
    let used = words.iter().enumerate().filter(|(i, _)| lattice.is_used(*i));
    used.map(|(_, word)| word.count_ones() as usize).sum()
}
