//! Occupancy grids, to skip empty space along rays (instant-ngp, Mueller et al. 2022).
//!
//! Start with [`OccupancyGrid`]: each cell keeps the largest density that was sampled in it, and is *occupied* if that
//! exceeds a threshold. Rays are sampled only in occupied cells, a few percent of a scene of solid objects.
//!
//! # Error of skipping
//! Skipping samples with a total optical depth `tau` changes a colour by at most `1 - e^-tau` times the range of
//! colours (background included). If every skipped cell holds at most [`Skip::min_sigma`] of the longest path, `tau` is
//! at most [`Skip::max_depth`], and the error at most [`Skip::error_bound`]: 0.005 for [`Skip::NearLossless`] and 0.049
//! for [`Skip::Fast`]. This is the worst case, fog just below the threshold along the whole ray. On solid scenes with
//! faint fog the error is a tenth of it.
//!
//! [`OccupancyGrid::update`] samples one random point per cell and keeps decaying maxima, which suits training.
//! [`OccupancyGrid::rebuild`] samples eight points around all occupied cells and adds a margin, which suits rendering.
//!
//! # Layout
//! A block of 4 x 4 x 4 cells is one 64-bit word. Each block also has the largest empty cube in each of the eight
//! octants of directions, so that a ray crosses empty space in a few steps.
//!
//! ```
//! use glam::DVec3;
//! use raygrad_autograd::Pool;
//! use raygrad_nerf::space::occupancy::{MarchBuffer, OccupancyConfig, OccupancyGrid, Skip, Step, Update};
//! use raygrad_nerf::{Ray, Rays, Jitter};
//!
//! let config = OccupancyConfig { resolution: 32, ..OccupancyConfig::default() };
//! let mut grid = OccupancyGrid::new([DVec3::NEG_ONE, DVec3::ONE], &config)?;
//! // A ball of radius 0.5.
//! let ball = |points: &[[f32; 3]], out: &mut [f32]| {
//!     for (point, out) in points.iter().zip(out) {
//!         *out = if DVec3::from(point.map(f64::from)).length() < 0.5 { 10.0 } else { 0.0 };
//!     }
//! };
//! grid.rebuild(Skip::NearLossless.min_sigma(grid.longest_path()), true, &ball);
//! assert!(grid.occupied_share() < 0.15);
//!
//! let mut rays = Rays::new();
//! rays.push(&Ray { origin: DVec3::new(0.0, 0.0, -3.0), direction: DVec3::Z }, [0.0, 10.0]);
//! let mut found = MarchBuffer::default();
//! grid.march(&rays, &Step::uniform(0.01), &mut Jitter::Middle, &mut found);
//! assert!((100..130).contains(&found.t.len()), "1 of 2 scene units, and a margin");
//! let samples = found.samples(&rays, &Pool::new());
//! assert_eq!(samples.len(), found.t.len());
//! # Ok::<(), raygrad_nerf::Error>(())
//! ```

mod bits;
mod carve;
mod empty_cubes;
mod lattice;
mod march;
mod skip;
mod store;
#[cfg(test)]
mod tests;
mod update;

use crate::range::check_bounds;
use crate::{Error, Result};
use empty_cubes::Leaps;
use glam::DVec3;
use lattice::{CARVED, CELLS, Lattice};
use raygrad_tensor::parallel;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

pub use march::{MAX_STEPS, MarchBuffer, Step};
pub use skip::{Skip, Skipping};
pub use update::{DensityFn, POINTS, Shares, Update};

/// The most cells of a grid.
const MOST_CELLS: usize = 1 << 30;
/// A density and a bit.
const BYTES_PER_CELL: f64 = 4.125;

/// Words per task.
const TASK: usize = 256;

/// Configuration of an [`OccupancyGrid`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(from = "Stored")]
pub struct OccupancyConfig {
    /// Cells along each axis, at most 2^30 (4.4 GB) with all cascades. Several cascades need a multiple of 16.
    /// Range: a multiple of 4 up to 1024.
    pub resolution: usize,
    /// Number of nested boxes: the scene box, then boxes that are each twice as large around the same centre. A
    /// bounded scene has 1, an unbounded one 2 to 8. Range: 1 to 8.
    pub cascades: usize,
    /// Empty-space skipping: `"off"`, `"near-lossless"`, `"fast"`, or an object with all keys below. `--skip` sets
    /// it.
    pub skip: Skipping,
}

impl Default for OccupancyConfig {
    fn default() -> Self {
        OccupancyConfig { resolution: 128, cascades: 1, skip: Skip::NearLossless.into() }
    }
}

/// The form in files.
#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Stored {
    resolution: usize,
    cascades: usize,
    skip: Skipping,
    /// The former switch for visual hull carving: true becomes a `carving` of 1, false becomes 0.
    silhouettes: Option<bool>,
}

impl Default for Stored {
    fn default() -> Self {
        let OccupancyConfig { resolution, cascades, skip } = OccupancyConfig::default();
        Stored { resolution, cascades, skip, silhouettes: None }
    }
}

impl From<Stored> for OccupancyConfig {
    fn from(Stored { resolution, cascades, mut skip, silhouettes }: Stored) -> Self {
        if let Some(silhouettes) = silhouettes {
            skip.carving = u32::from(silhouettes && skip.grid);
        }
        OccupancyConfig { resolution, cascades, skip }
    }
}

impl OccupancyConfig {
    /// Checks that all values are in range and fit each other.
    ///
    /// # Errors
    /// If a value is out of range.
    pub fn check(&self) -> Result<()> {
        if !(1..=8).contains(&self.cascades) {
            return Err(Error::setting("occupancy.cascades", format!("is {}; use 1 to 8", self.cascades)));
        }
        // With several cascades, the border of the next smaller one lies at a quarter of the blocks and must not cut a
        // block.
        let unit = if self.cascades > 1 { 16 } else { 4 };
        if !self.resolution.is_multiple_of(unit) || !(unit..=1024).contains(&self.resolution) {
            let what = format!("is {}; use a multiple of {unit} up to 1024", self.resolution);
            return Err(Error::setting("occupancy.resolution", what));
        }
        let cells = self.resolution.pow(3) * self.cascades;
        if cells > MOST_CELLS {
            let what = format!(
                "is {} with {} cascades, which takes {:.1} GB; use at most 2^30 cells ({:.1} GB)",
                self.resolution,
                self.cascades,
                BYTES_PER_CELL * cells as f64 / 1e9,
                BYTES_PER_CELL * MOST_CELLS as f64 / 1e9
            );
            return Err(Error::setting("occupancy.resolution", what));
        }
        self.skip.check()
    }
}

/// The rule that decides which cells are occupied, see [`OccupancyGrid::threshold`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Threshold {
    /// Cells with more than this density, in 1 / scene unit, are occupied. The threshold halves from cascade to
    /// cascade, as cells and steps double.
    pub min_sigma: f32,
    /// Whether the mean density of all cells is the threshold instead where it is smaller: the usual rule in training,
    /// which keeps a field that is still faint everywhere.
    pub or_mean: bool,
    /// Whether the 26 neighbours of an occupied cell are occupied too, in its cascade and in those around it.
    pub dilate: bool,
}

/// An occupancy grid over a box, or over nested boxes (cascades).
#[derive(Debug, Clone)]
pub struct OccupancyGrid {
    lattice: Lattice,
    /// For each cell, in the order of words and bits, the decayed largest density times the cell's size relative to
    /// cascade 0; NaN if never sampled. Copies share it until one of them samples.
    densities: Arc<Vec<f32>>,
    /// For each block its occupied cells; see [`bits::coarsen`] for the inner blocks of larger cascades.
    words: Vec<u64>,
    leaps: Leaps,
}

impl OccupancyGrid {
    /// Creates a grid over a box (lower and upper corner, scene units). Every cell is occupied until it is sampled.
    ///
    /// # Errors
    /// If the configuration is out of range, or the box is flat or not finite.
    pub fn new(bounds: [DVec3; 2], config: &OccupancyConfig) -> Result<Self> {
        config.check()?;
        check_bounds(bounds)?;
        let lattice = Lattice { bounds, resolution: config.resolution, cascades: config.cascades };
        let words = vec![u64::MAX; lattice.words()];
        let leaps = Leaps::new(&words, &lattice);
        Ok(OccupancyGrid { densities: Arc::new(vec![f32::NAN; CELLS * words.len()]), lattice, words, leaps })
    }

    /// Returns the box of the first cascade: lower and upper corner.
    pub fn bounds(&self) -> [DVec3; 2] {
        self.lattice.bounds
    }

    /// Returns the outermost box: lower and upper corner.
    pub fn outer_bounds(&self) -> [DVec3; 2] {
        self.lattice.extent(self.lattice.cascades - 1)
    }

    /// Returns the longest path through the grid for [`Skip::min_sigma`], in scene units.
    ///
    /// Each cascade counts as the first box's diagonal: its paths are twice as long as the previous one's, and its
    /// threshold half as high.
    pub fn longest_path(&self) -> f64 {
        let [low, high] = self.bounds();
        self.cascades() as f64 * low.distance(high)
    }

    /// Returns the number of cells along each axis of a cascade.
    pub fn resolution(&self) -> usize {
        self.lattice.resolution
    }

    /// Returns the number of cascades.
    pub fn cascades(&self) -> usize {
        self.lattice.cascades
    }

    /// Returns the number of cells, each part of space counted in the smallest cascade that holds it.
    pub fn cells(&self) -> usize {
        self.lattice.used_cells()
    }

    /// Returns the share of the [`cells`](Self::cells) that are occupied, 0 to 1.
    pub fn occupied_share(&self) -> f64 {
        bits::count(&self.words, &self.lattice) as f64 / self.cells() as f64
    }

    /// Returns the occupied cells as bits, one word per block of 4 x 4 x 4.
    ///
    /// Blocks are ordered x fastest, then y, z and cascade. Bit `x + 4 y + 16 z` is the cell `(x, y, z)` of the block.
    pub fn words(&self) -> &[u64] {
        &self.words
    }

    /// Returns whether a point (scene units) is in an occupied cell of the smallest cascade that holds it; `false`
    /// outside of all.
    pub fn is_occupied(&self, place: DVec3) -> bool {
        self.lattice.holding(place).is_some_and(|(word, bit)| self.words[word] >> bit & 1 == 1)
    }

    /// Returns the mean density of the sampled cells, in 1 / scene unit, or 0 if there are none.
    ///
    /// Densities are multiplied by the cell's size relative to the first cascade. Carved cells do not count.
    pub fn mean_density(&self) -> f64 {
        // Tasks of fixed size, so that the sum has the same bits at any number of threads.
        let parts: Vec<&[f32]> = self.densities.chunks(CELLS * TASK).collect();
        let sums = parallel::collect(parts.len(), |i| {
            let known = parts[i].iter().filter(|x| !x.is_nan() && **x != CARVED);
            known.fold((0.0, 0), |(sum, n), &x| (sum + f64::from(x), n + 1))
        });
        let (sum, count) = sums.iter().fold((0.0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        if count == 0 { 0.0 } else { sum / count as f64 }
    }

    /// Updates which cells are occupied. Cells that were never sampled, or whose density is NaN, are occupied.
    pub fn threshold(&mut self, rule: &Threshold) {
        let mut limit = rule.min_sigma;
        if rule.or_mean {
            // The mean itself is occupied: in a uniform fog every cell has it.
            let mean = self.mean_density() as f32;
            limit = limit.min(if mean > 0.0 { mean.next_down() } else { mean });
        }
        let words = self.exceeding(limit);
        self.occupy(words, rule.dilate);
    }

    /// The cells whose density is not known to be at most `limit`.
    fn exceeding(&self, limit: f32) -> Vec<u64> {
        let mut words = vec![0; self.words.len()];
        let parts = words.chunks_mut(TASK).zip(self.densities.chunks(CELLS * TASK));
        parallel::each_of(parts, |_, (words, densities)| {
            for (word, densities) in words.iter_mut().zip(densities.chunks_exact(CELLS)) {
                *word = exceeding(densities, limit);
            }
        });
        for (i, word) in words.iter_mut().enumerate() {
            if !self.lattice.is_used(i) {
                *word = 0;
            }
        }
        words
    }

    /// Sets the occupied cells.
    fn occupy(&mut self, mut words: Vec<u64>, dilate: bool) {
        if dilate {
            bits::dilate(&mut words, &self.lattice);
        } else {
            bits::coarsen(&mut words, &self.lattice);
        }
        self.leaps = Leaps::new(&words, &self.lattice);
        self.words = words;
    }
}

/// The cells of one block whose density is not known to be at most `limit`.
fn exceeding(densities: &[f32], limit: f32) -> u64 {
    let known = densities.iter().enumerate().fold(0, |word, (bit, &x)| word | u64::from(x <= limit) << bit);
    !known
}
