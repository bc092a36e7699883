//! The geometry of a hash grid: levels, resolutions and rows.

use crate::range::{check_parameters, check_range};
use crate::{Error, Result};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Scalar, Tensor};
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::sync::Arc;

/// Configuration of a [`HashGrid`] (Müller et al. 2022, table 1).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HashGridConfig {
    /// Number of levels, each of another resolution. Range: 1 to 32.
    pub levels: usize,
    /// Features in a row of the table. Range: 1, 2, 4, 8, 16 or 32.
    pub features: usize,
    /// Binary logarithm of the largest number of rows of a level. Range: 4 to 28.
    pub log2_table: u32,
    /// Cells along an axis of the coarsest level. Range: 1 to `finest`.
    pub coarsest: usize,
    /// Cells along an axis of the finest level. Finer cells would leave f32 too few digits for the place within a
    /// cell. Range: `coarsest` to 65536.
    pub finest: usize,
}

impl HashGridConfig {
    /// The largest `log2_table`: a grid of 512 cells per axis then has a row for every corner.
    pub(crate) const MOST_LOG2_TABLE: u32 = 28;

    /// Returns the paper's values: 16 levels of 2 features from 16 to 2048, tables of 2^19 rows.
    pub fn paper() -> Self {
        HashGridConfig { levels: 16, features: 2, log2_table: 19, coarsest: 16, finest: 2048 }
    }

    /// Returns values for CPUs: more features on fewer levels, which need fewer memory accesses, sized for a training
    /// budget.
    ///
    /// `samples` is that of the whole [training](crate::Budget::samples). `pixels_per_side` is
    /// [`Dataset::pixels_per_side`](crate::dataset::Dataset::pixels_per_side): no cell is smaller than half a pixel.
    /// Larger tables hold more detail but take longer, above all beyond the caches.
    pub fn cpu(samples: f64, pixels_per_side: f64) -> Self {
        let (log2_table, finest) = match samples {
            ..=2e8 => (17, 512),
            ..=6e8 => (18, 512),
            _ => (19, 768),
        };
        let coarsest = 16;
        let finest = ((2.0 * pixels_per_side).ceil() as usize).clamp(2 * coarsest, finest);
        HashGridConfig { levels: 8, features: 4, log2_table, coarsest, finest }
    }

    fn check(&self) -> Result<()> {
        check_range("levels", self.levels, 1, 32)?;
        check_range("log2_table", self.log2_table, 4, Self::MOST_LOG2_TABLE)?;
        check_range("coarsest", self.coarsest, 1, self.finest)?;
        check_range("finest", self.finest, self.coarsest, 1 << 16)?;
        if ![1, 2, 4, 8, 16, 32].contains(&self.features) {
            return Err(Error::setting("features", format!("is {}; use 1, 2, 4, 8, 16 or 32", self.features)));
        }
        Ok(())
    }
}

/// One level of a [`HashGrid`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HashLevel {
    /// Resolution: cells along an axis.
    pub resolution: u32,
    /// Whether corners are hashed to shared rows; otherwise each corner has its own row.
    pub hashed: bool,
    /// The level's rows of the table.
    pub rows: Range<usize>,
}

impl HashLevel {
    /// The row of the corner `[x, y, z]` within the level; each coordinate is at most the resolution.
    ///
    /// Either `x + (N+1) (y + (N+1) z)`, or the paper's hash (equation 4): `(x xor 2654435761 y xor 805459861 z) mod
    /// rows`, in 32 bits.
    #[inline(always)]
    pub(super) fn row(&self, [x, y, z]: [u32; 3]) -> u32 {
        if self.hashed {
            (x ^ y.wrapping_mul(PRIMES[0]) ^ z.wrapping_mul(PRIMES[1])) & (self.rows.len() as u32 - 1)
        } else {
            let side = self.resolution + 1;
            x + side * (y + side * z)
        }
    }
}

/// Multipliers of the hash.
pub(super) const PRIMES: [u32; 2] = [2_654_435_761, 805_459_861];

/// The geometry of a hash grid: levels of rising resolution over the unit cube, and their rows of one table. Clones are
/// cheap.
///
/// Level `l` has `N_l = floor(coarsest b^l)` cells along an axis, `b = (finest / coarsest)^(1 / (levels - 1))`
/// (equations 2 and 3), so `N_l + 1` corners. A level with at most `2^log2_table` corners has a row for each; a finer
/// one hashes its corners to that many rows. Rows are rounded up to a multiple of 16, so that each level is aligned to
/// a cache line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HashGrid {
    config: HashGridConfig,
    levels: Arc<[HashLevel]>,
    /// Rows of the table, and features per row.
    shape: [usize; 2],
}

impl HashGrid {
    /// Creates a grid.
    ///
    /// # Errors
    /// If a value is out of the range that its field states.
    pub fn new(config: &HashGridConfig) -> Result<Self> {
        config.check()?;
        let growth = (config.finest as f64 / config.coarsest as f64).ln() / (config.levels - 1).max(1) as f64;
        let most = 1_usize << config.log2_table;
        let mut first = 0;
        let level = |l: usize| {
            // The tiny excess makes the last level the finest despite rounding.
            let resolution = config.coarsest as f64 * (l as f64 * growth).exp() * (1.0 + 1e-12);
            let corners = (resolution as usize + 1).pow(3);
            let count = corners.min(most).next_multiple_of(16);
            first += count;
            HashLevel { resolution: resolution as u32, hashed: corners > most, rows: first - count..first }
        };
        let levels: Arc<[HashLevel]> = (0..config.levels).map(level).collect();
        check_parameters(first * config.features)?;
        Ok(HashGrid { config: config.clone(), levels, shape: [first, config.features] })
    }

    /// Returns the configuration.
    pub fn config(&self) -> &HashGridConfig {
        &self.config
    }

    /// Returns the levels, coarsest first.
    pub fn levels(&self) -> &[HashLevel] {
        &self.levels
    }

    /// Returns the number of features per row of the table.
    pub fn features(&self) -> usize {
        self.shape[1]
    }

    /// Returns the number of rows of the table.
    pub fn rows(&self) -> usize {
        self.shape[0]
    }

    /// Returns the number of features per sample: levels times features.
    pub fn width(&self) -> usize {
        self.levels.len() * self.features()
    }

    /// Returns the shape of the table, `[rows, features]`.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// Returns an initial table `[rows, features]`, uniform in -1e-4 to 1e-4 (section 4).
    #[inline(never)]
    pub fn init<T: Scalar>(&self, seed: u64) -> Tensor<T> {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        Tensor::from_fn(&self.shape, |_| T::from_f64(1e-4 * (2.0 * rng.random::<f64>() - 1.0)))
    }
}
