//! The largest empty cubes, over which rays skip.

use super::lattice::Lattice;
use raygrad_tensor::parallel;

/// For each block and each of the eight octants of directions, the edge of an empty cube in blocks. It is the largest
/// cube that has the block in its rearmost corner. A ray in one of the cube's blocks is next tested where it leaves the
/// cube.
///
/// 0 is a block with an occupied cell. A cube ends at the border of its cascade. That of the outermost cascade may
/// extend beyond it, where nothing is.
#[derive(Debug, Clone)]
pub(super) struct Leaps {
    tables: [Vec<u8>; 8],
}

impl Leaps {
    /// The leaps for these words. A word of a cascade must not be 0 where a smaller cascade has an occupied cell.
    pub fn new(words: &[u64], lattice: &Lattice) -> Self {
        let mut tables = std::array::from_fn(|_| vec![0; words.len()]);
        parallel::each_of(&mut tables, |octant, table| {
            for cascade in 0..lattice.cascades {
                let range = lattice.cascade(cascade);
                let beyond = if cascade + 1 == lattice.cascades { u8::MAX } else { 0 };
                fill(&mut table[range.clone()], &words[range], lattice.side(), octant, beyond);
            }
        });
        Leaps { tables }
    }

    /// The table of an octant, whose bit `a` is set if directions in it point downwards along axis `a`.
    pub fn octant(&self, octant: usize) -> &[u8] {
        &self.tables[octant]
    }
}

/// A block's cube is one block longer than the shortest of the cubes of the seven blocks before it.
fn fill(table: &mut [u8], words: &[u64], side: usize, octant: usize, beyond: u8) {
    let mirrored = |axis: usize, i: usize| if octant >> axis & 1 == 1 { side - 1 - i } else { i };
    let stride: [isize; 3] =
        std::array::from_fn(|axis| side.pow(axis as u32) as isize * if octant >> axis & 1 == 1 { -1 } else { 1 });
    for z in (0..side).rev() {
        for y in (0..side).rev() {
            for x in (0..side).rev() {
                let index = mirrored(0, x) + side * (mirrored(1, y) + side * mirrored(2, z));
                if words[index] != 0 {
                    continue;
                }
                let at_border = [x, y, z].map(|i| i + 1 == side);
                let mut shortest = u8::MAX;
                for neighbour in 1..8 {
                    let steps: [bool; 3] = std::array::from_fn(|axis| neighbour >> axis & 1 == 1);
                    let leap = if (0..3).any(|a| steps[a] && at_border[a]) {
                        beyond
                    } else {
                        let offset: isize = (0..3).map(|a| if steps[a] { stride[a] } else { 0 }).sum();
                        table[index.wrapping_add_signed(offset)]
                    };
                    shortest = shortest.min(leap);
                }
                table[index] = shortest.saturating_add(1);
            }
        }
    }
}
