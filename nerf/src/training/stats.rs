//! How long to train, and what was done.

use serde::Serialize;
use std::time::Duration;

/// Steps in a row without a finite gradient after which a run has diverged: an overflow of one batch passes.
pub(crate) const STUCK: u64 = 100;

/// How long to train.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Budget {
    /// A number of steps.
    Steps(u64),
    /// Training time; what happens between steps does not count. The schedule stretches to it.
    Time(Duration),
}

/// What one step did, and the run so far.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct StepStats {
    /// Number of the step, from 1.
    pub step: u64,
    /// Training time so far.
    pub train_seconds: f64,
    /// Rays so far.
    pub rays: u64,
    /// Samples placed on rays so far: without a grid all, with one those in occupied cells.
    pub marched: u64,
    /// Evaluations of a density so far.
    pub samples: u64,
    /// Evaluations of a colour, and of all gradients, so far.
    pub shaded: u64,
    /// Evaluations of each that there would have been so far if nothing in the box were skipped.
    pub unskipped: u64,
    /// Elements of parameters that were moved so far; of tables only rows that a sample looked up are.
    pub moved: u64,
    /// The mean loss, of a hierarchical model that of the coarse field plus that of the fine one.
    pub loss: f64,
    /// PSNR on this step's rays, in dB.
    pub psnr: f64,
    /// Mean opacity of this step's rays, 0 to 1.
    pub opacity: f64,
    /// Share of the occupancy grid that is occupied; 1 without a grid.
    pub occupied: f64,
    /// The learning rate.
    pub rate: f64,
    /// Elements whose gradient was not finite, so far; they were left alone.
    pub skipped: u64,
    /// Steps in a row, up to this one, that moved nothing because no gradient was finite: the run has diverged if they
    /// go on.
    pub stuck: u64,
    /// How often the start-up detector began again with another seed.
    pub restarts: u32,
}

impl StepStats {
    /// Whether the run has diverged: for 100 steps in a row no gradient was finite, so that nothing moves any more. Its
    /// model is of no use.
    pub fn has_diverged(&self) -> bool {
        self.stuck >= STUCK
    }
}

impl Default for StepStats {
    /// Nothing done.
    fn default() -> Self {
        StepStats {
            step: 0,
            train_seconds: 0.0,
            rays: 0,
            marched: 0,
            samples: 0,
            shaded: 0,
            unskipped: 0,
            moved: 0,
            loss: f64::NAN,
            psnr: f64::NAN,
            opacity: f64::NAN,
            occupied: 1.0,
            rate: 0.0,
            skipped: 0,
            stuck: 0,
            restarts: 0,
        }
    }
}
