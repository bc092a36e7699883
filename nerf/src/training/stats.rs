//! The training budget, and statistics of a step.

use crate::model::PoseMotion;
use crate::sampling::marching::TILES;
use serde::{Deserialize, Deserializer, Serialize};
use std::time::Duration;

/// Consecutive steps without a finite gradient after which a run has diverged. A single overflow may pass.
pub(crate) const STUCK: u64 = 100;

/// Motion of the median image and of the one that moves most, below which the given poses are right, in degrees. Until
/// the check, right poses drift by .17 to .39, and one image by .81. Poses that are half a degree off move by .41 to
/// .49: see docs/benchmarks/results.md, section Wrong cameras.
const RIGHT: PoseMotion = PoseMotion { median: 0.4, largest: 0.85 };

/// The length of a run, in steps or time.
///
/// In a file it is `{"steps": 5000}` or `{"seconds": 60}`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Budget {
    /// Number of training steps.
    #[serde(rename = "steps")]
    Steps(u64),
    /// Training time. Work between steps, such as saving, does not count. Schedules stretch to it. Unit: seconds.
    #[serde(rename = "seconds", with = "seconds")]
    Time(Duration),
}

/// The most rays per step.
pub(super) const MOST_RAYS: usize = 1 << 20;
/// Samples per step of the instant preset.
const SAMPLES_PER_STEP: f64 = 24576.0;
/// Training samples per second and core, approximately.
const SAMPLES_PER_SECOND: f64 = 1e6;

impl Budget {
    /// Estimates the samples along rays that fit in the budget, for [`Config::for_budget`](crate::Config::for_budget).
    ///
    /// For steps it is the same on any machine; for a time it grows with the number of threads.
    pub fn samples(self) -> f64 {
        self.samples_on(rayon::current_num_threads())
    }

    /// As [`samples`](Self::samples), on this number of cores of all machines. More than 8 count as 8: no machine with more
    /// was measured.
    pub fn samples_on(self, cores: usize) -> f64 {
        match self {
            Budget::Steps(steps) => steps as f64 * SAMPLES_PER_STEP,
            Budget::Time(time) => time.as_secs_f64() * SAMPLES_PER_SECOND * cores.min(TILES) as f64,
        }
    }
}

/// Serialises a duration as seconds.
mod seconds {
    use serde::{Deserialize, Deserializer, Serializer, de::Error};
    use std::time::Duration;

    pub fn serialize<S: Serializer>(time: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_f64(time.as_secs_f64())
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Duration, D::Error> {
        Duration::try_from_secs_f64(f64::deserialize(deserializer)?).map_err(D::Error::custom)
    }
}

/// Statistics of a training step and of the run so far.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct StepStats {
    /// Number of the step, counted from 1.
    pub step: u64,
    /// Training time so far, in seconds.
    pub train_seconds: f64,
    /// Rays traced so far.
    pub rays: u64,
    /// Samples placed on rays so far; with an occupancy grid only those in occupied cells.
    #[serde(alias = "marched")]
    pub placed_samples: u64,
    /// Density evaluations so far.
    #[serde(alias = "samples")]
    pub density_queries: u64,
    /// Colour evaluations, and evaluations of all gradients, so far.
    #[serde(alias = "shaded")]
    pub color_queries: u64,
    /// Evaluations so far if no space in the box were skipped.
    pub unskipped: u64,
    /// Parameter elements updated so far; of tables only the rows that a sample reads.
    pub moved: u64,
    /// Mean loss over rays and channels; for a hierarchical model, coarse plus fine.
    #[serde(deserialize_with = "number_or_nan")]
    pub loss: f64,
    /// PSNR on this step's rays, in dB, over the backgrounds of training.
    #[serde(deserialize_with = "number_or_nan")]
    pub psnr: f64,
    /// Mean opacity of this step's rays, 0 to 1.
    #[serde(deserialize_with = "number_or_nan")]
    pub opacity: f64,
    /// Share of the occupancy grid that is occupied; 1 without a grid.
    pub occupied: f64,
    /// The learning rate of the default group.
    #[serde(alias = "rate")]
    pub lr: f64,
    /// Elements with a non-finite gradient so far; they were not updated.
    #[serde(alias = "skipped")]
    pub non_finite: u64,
    /// Consecutive steps, up to this one, without any finite gradient; see [`has_diverged`](Self::has_diverged).
    #[serde(alias = "stuck")]
    pub non_finite_steps: u64,
    /// Restarts with another seed by the start-up detector.
    pub restarts: u32,
    /// Image motion by pose refinement up to the [check](crate::model::CameraOptimizerConfig::check_at) of the poses.
    /// `None` before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub pose_motion: Option<PoseMotion>,
}

/// Reads a number; null, as files write non-finite ones, is NaN.
fn number_or_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

impl StepStats {
    /// Returns whether the check of the poses found the given ones right: the median image moved by less than .4
    /// degrees, and each by less than .85.
    pub fn given_poses_are_right(&self) -> bool {
        self.pose_motion.is_some_and(|motion| motion.median < RIGHT.median && motion.largest < RIGHT.largest)
    }

    /// Returns whether the run has diverged: no gradient was finite for 100 consecutive steps. Its model is useless.
    pub fn has_diverged(&self) -> bool {
        self.non_finite_steps >= STUCK
    }

    /// Returns whether a run that ends at this step has diverged: as [`has_diverged`](Self::has_diverged), or without a
    /// finite gradient in its second half.
    pub fn ends_diverged(&self) -> bool {
        self.has_diverged() || (self.non_finite_steps > 0 && 2 * self.non_finite_steps >= self.step)
    }
}

impl Default for StepStats {
    /// Statistics before the first step.
    fn default() -> Self {
        StepStats {
            step: 0,
            train_seconds: 0.0,
            rays: 0,
            placed_samples: 0,
            density_queries: 0,
            color_queries: 0,
            unskipped: 0,
            moved: 0,
            loss: f64::NAN,
            psnr: f64::NAN,
            opacity: f64::NAN,
            occupied: 1.0,
            lr: 0.0,
            non_finite: 0,
            non_finite_steps: 0,
            restarts: 0,
            pose_motion: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn budgets_are_read_and_estimate_samples() {
        let read = |text: &str| serde_json::from_str::<Budget>(text);
        let threads = rayon::current_num_threads().min(8) as f64;
        for (text, budget, samples) in [
            (r#"{"steps":4000}"#, Budget::Steps(4000), 4000.0 * 24576.0),
            (r#"{"seconds":62.5}"#, Budget::Time(Duration::from_millis(62_500)), 62.5e6 * threads),
        ] {
            assert_eq!((read(text).unwrap(), serde_json::to_string(&budget).unwrap()), (budget, text.to_owned()));
            assert_eq!(budget.samples(), samples);
        }
        let minute = Budget::Time(Duration::from_secs(60));
        assert_eq!([4, 8, 12].map(|cores| minute.samples_on(cores)), [2.4e8, 4.8e8, 4.8e8]);
        assert_eq!(Budget::Steps(10).samples_on(99), 10.0 * 24576.0);
        assert!(read(r#"{"seconds":-1}"#).is_err() && read(r#"{"seconds":1e300}"#).is_err());
    }

    #[test]
    fn short_run_of_non_finite_steps_diverges() {
        let at = |step, stuck| StepStats { step, non_finite_steps: stuck, ..StepStats::default() };
        assert!(!at(0, 0).ends_diverged() && !at(50, 20).ends_diverged() && !at(5000, 99).ends_diverged());
        assert!(at(50, 25).ends_diverged() && at(1, 1).ends_diverged() && at(5000, 100).ends_diverged());
    }
}
