//! Carving: cells that stay empty permanently.

use super::lattice::{CARVED, CELLS, cell, uncarved};
use super::{OccupancyGrid, TASK};
use glam::DVec3;
use raygrad_tensor::parallel;
use std::sync::Arc;

impl OccupancyGrid {
    /// Permanently empties the cells for which `is_empty(centre, radius)` holds, with a ball around the cell in scene
    /// units.
    ///
    /// They are never sampled again, from the next [`threshold`](Self::threshold) or
    /// [`empty_carved`](Self::empty_carved) on.
    pub fn carve(&mut self, is_empty: &(dyn Fn(DVec3, f64) -> bool + Sync)) {
        let lattice = &self.lattice;
        let tasks = Arc::make_mut(&mut self.densities).chunks_mut(CELLS * TASK);
        parallel::each_of(tasks, |task, densities| {
            for (word, densities) in densities.chunks_exact_mut(CELLS).enumerate() {
                let [corner, size] = lattice.block(task * TASK + word);
                let mut left = uncarved(densities);
                // Most blocks are entirely empty.
                if left != 0 && is_empty(corner + 2.0 * size, 2.0 * size.length()) {
                    densities.fill(CARVED);
                    left = 0;
                }
                while left != 0 {
                    let bit = left.trailing_zeros() as usize;
                    left &= left - 1;
                    let centre = corner + size * (DVec3::from(cell(bit).map(|i| i as f64)) + 0.5);
                    if is_empty(centre, 0.5 * size.length()) {
                        densities[bit] = CARVED;
                    }
                }
            }
        });
    }

    /// Marks carved cells empty. The occupancy of others stays.
    pub fn empty_carved(&mut self) {
        let mut words = self.exceeding(CARVED);
        words.iter_mut().zip(&self.words).for_each(|(left, occupied)| *left &= occupied);
        self.occupy(words, false);
    }
}
