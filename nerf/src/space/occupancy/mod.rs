//! Which parts of a scene's box hold something, for any field, and marching rays through those parts only.
//!
//! The box is divided into cells; each remembers the largest density that was met in it and is *occupied* if that
//! exceeds a threshold. Rays are sampled at equal steps, and a sample is taken only if its cell is occupied: on a scene
//! of solid objects that leaves a few percent of them.
//!
//! # What skipping may cost
//! A ray that skips samples with a total optical depth `tau` changes its colour by at most `(1 - e^-tau)` times the
//! range of colours (background included). If every skipped cell really holds no more than [`Skip::min_sigma`] of the
//! longest path through the grid, `tau` is at most [`Skip::max_depth`], whatever the step, and the error at most
//! [`Skip::error_bound`]: .005 for [`Skip::NearLossless`] and .049 for [`Skip::Fast`]. That is the worst case, a fog just
//! below the threshold along the whole ray; on scenes of solids with faint fog the error is a tenth of it.
//!
//! What a grid knows of a cell comes from points in it. [`OccupancyGrid::update`] looks at one random point a cell and
//! keeps decaying maxima, which suits training: what it misses now it finds later. [`OccupancyGrid::rebuild`] looks at
//! eight around everything that was found and adds a margin, which suits rendering.
//!
//! # Layout
//! One 64-bit word for each block of 4 x 4 x 4 cells, and for each block the largest empty cube before it in each of the
//! eight octants of directions: a ray crosses an empty box in a few leaps.
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

use crate::{Error, Result};
use empty_cubes::Leaps;
use glam::DVec3;
use lattice::{CARVED, CELLS, Lattice};
use raygrad_tensor::parallel;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

pub use march::{MAX_STEPS, MarchBuffer, Step};
pub use skip::{Skip, Skipping};
pub use update::{DensityFn, POINTS, Update};

/// Cells of a grid, at most.
const MOST_CELLS: usize = 1 << 30;
/// A density, and a bit.
const BYTES_PER_CELL: f64 = 4.125;

/// Words that one task works on.
const TASK: usize = 256;

/// How fine a grid is, and what it may cost.
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

/// What a file may say.
#[derive(Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Stored {
    resolution: usize,
    cascades: usize,
    skip: Skipping,
    /// Switch for visual hull carving. true becomes a `carving` of 1, false one of 0.
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
    /// Whether the numbers make sense together.
    ///
    /// # Errors
    /// If one is out of range.
    pub fn check(&self) -> Result<()> {
        if !(1..=8).contains(&self.cascades) {
            return Err(Error::setting("occupancy.cascades", format!("is {}; use 1 to 8", self.cascades)));
        }
        // With several, the border of the next smaller cascade must not cut a block: it lies at a quarter of the blocks.
        let unit = if self.cascades > 1 { 16 } else { 4 };
        if !self.resolution.is_multiple_of(unit) || !(unit..=1024).contains(&self.resolution) {
            let what = format!("is {}; use a multiple of {unit} up to 1024", self.resolution);
            return Err(Error::setting("occupancy.resolution", what));
        }
        let cells = self.resolution.pow(3) * self.cascades;
        if cells > MOST_CELLS {
            let what = format!(
                "{} with {} cascades takes {:.1} GB; use at most 2^30 cells ({:.1} GB)",
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

/// Which cells are occupied.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Threshold {
    /// Cells with more than this density, in 1 / scene unit, are occupied; those of each further cascade with more than half of
    /// that of the one before, as they are twice as large and steps through them as long.
    pub min_sigma: f32,
    /// Whether cells below the mean density of all cells are passed over instead, where that is smaller: the customary rule
    /// in training, with which a field that is faint everywhere is not skipped before it has taken shape.
    pub or_mean: bool,
    /// Whether the 26 cells around an occupied cell are occupied too.
    pub dilate: bool,
}

/// Cells of a box, or of nested boxes, and whether they hold something.
#[derive(Debug, Clone)]
pub struct OccupancyGrid {
    lattice: Lattice,
    /// For each cell, in the order of the words and their bits, the decayed largest density, as many times over as the cell is
    /// larger than those of cascade 0; NaN if never looked at.
    /// Shared with copies until one of them looks.
    densities: Arc<Vec<f32>>,
    /// For each block its occupied cells; see [`bits::coarsen`] for the inner blocks of larger cascades.
    words: Vec<u64>,
    leaps: Leaps,
}

impl OccupancyGrid {
    /// A grid over the box with these lower and upper corners (scene units). Every cell is occupied until looked at.
    ///
    /// # Errors
    /// If the configuration is out of range or the box is not finite or flat.
    pub fn new(bounds: [DVec3; 2], config: &OccupancyConfig) -> Result<Self> {
        config.check()?;
        let [low, high] = bounds;
        if !(low.is_finite() && high.is_finite() && low.cmplt(high).all()) {
            return Err(Error::setting("bounds", format!("{low} to {high} is no box")));
        }
        let lattice = Lattice { bounds, resolution: config.resolution, cascades: config.cascades };
        let words = vec![u64::MAX; lattice.words()];
        let leaps = Leaps::new(&words, &lattice);
        Ok(OccupancyGrid { densities: Arc::new(vec![f32::NAN; CELLS * words.len()]), lattice, words, leaps })
    }

    /// The box of cascade 0 as it was given.
    pub fn bounds(&self) -> [DVec3; 2] {
        self.lattice.bounds
    }

    /// The outermost box.
    pub fn outer_bounds(&self) -> [DVec3; 2] {
        self.lattice.extent(self.lattice.cascades - 1)
    }

    /// The longest path through the grid, in scene units and as thresholds have it: that through each further
    /// cascade is twice as long, and its thresholds half as high, so that each counts as the first, the diagonal of the box.
    pub fn longest_path(&self) -> f64 {
        let [low, high] = self.bounds();
        self.cascades() as f64 * low.distance(high)
    }

    /// Cells along each axis of a cascade.
    pub fn resolution(&self) -> usize {
        self.lattice.resolution
    }

    /// Number of nested boxes.
    pub fn cascades(&self) -> usize {
        self.lattice.cascades
    }

    /// Number of cells that make up the grid, each part of space counted in the smallest cascade that holds it.
    pub fn cells(&self) -> usize {
        self.lattice.used_cells()
    }

    /// The share of the [`cells`](Self::cells) that are occupied, 0 to 1.
    pub fn occupied_share(&self) -> f64 {
        bits::count(&self.words, &self.lattice) as f64 / self.cells() as f64
    }

    /// The occupied cells, a word for each block of 4 x 4 x 4 of them: blocks x fastest, then y, z and cascade; bit `x + 4 y + 16 z`
    /// is the cell `(x, y, z)` of the block.
    pub fn words(&self) -> &[u64] {
        &self.words
    }

    /// Whether a place (scene units) is in an occupied cell: of the smallest cascade that holds it. Outside of all it is not.
    pub fn is_occupied(&self, place: DVec3) -> bool {
        self.lattice.holding(place).is_some_and(|(word, bit)| self.words[word] >> bit & 1 == 1)
    }

    /// The mean density of the cells that were looked at, in 1 / scene unit, that of each cell as many times over as it is
    /// larger than those of cascade 0; 0 if there are none. Carved cells do not count.
    pub fn mean_density(&self) -> f64 {
        // In tasks of fixed size, so that the sum has the same bits at any number of threads.
        let parts: Vec<&[f32]> = self.densities.chunks(CELLS * TASK).collect();
        let sums = parallel::collect(parts.len(), |i| {
            let known = parts[i].iter().filter(|x| !x.is_nan() && **x != CARVED);
            known.fold((0.0, 0), |(sum, n), &x| (sum + f64::from(x), n + 1))
        });
        let (sum, count) = sums.iter().fold((0.0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        if count == 0 { 0.0 } else { sum / count as f64 }
    }

    /// Decides anew which cells are occupied. A cell that was never looked at, or whose density is NaN, is.
    pub fn threshold(&mut self, rule: &Threshold) {
        let mut limit = rule.min_sigma;
        if rule.or_mean {
            // The mean itself is not passed over: it may be that of a fog that is the same everywhere.
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

    /// Makes these cells the occupied ones.
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
