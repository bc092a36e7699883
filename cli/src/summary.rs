//! Summary of a run for later analysis: `summary.json`.

use std::collections::VecDeque;
use std::time::Instant;

use raygrad::nerf::model::PoseMotion;
use raygrad::nerf::{Budget, Result, StepStats};
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::run::{Run, write_json};
use super::{machine, ranks};

/// File name in a run's folder.
const FILE: &str = "summary.json";
/// Number of last steps whose loss and PSNR are averaged, since single steps fluctuate.
const AVERAGED: usize = 100;

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Ended {
    /// It used up its budget.
    Done,
    /// Ctrl-C or SIGTERM stopped it.
    Interrupted,
    /// Its numbers were no longer finite.
    Diverged,
}

/// The last preview.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Previewed {
    /// Name of the image.
    pub name: String,
    /// True for a held-out image.
    pub held_out: bool,
    /// Training step of the preview.
    pub step: u64,
    /// PSNR in dB; null if it is not finite.
    pub psnr: Option<f64>,
}

/// Sums over the sessions of a resumed run. They are the first fields of [`Summary`].
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Sums {
    /// Wall time of training in seconds, with previews and files. A killed session counts up to its last checkpoint.
    wall_seconds: f64,
    /// Number of times that the run resumed.
    resumed: u32,
    /// Number of times that the run diverged and returned to a checkpoint.
    #[serde(default)]
    retreats: u32,
    /// Peak memory of any session, if the system reports it.
    peak_memory_bytes: Option<u64>,
    preview: Option<Previewed>,
}

/// The contents of the file.
#[derive(Serialize)]
struct Summary<'a> {
    raygrad: &'static str,
    /// Null during training, and for a killed run.
    ended: Option<Ended>,
    seed: u64,
    budget: Budget,
    steps: u64,
    rays: u64,
    train_seconds: f64,
    #[serde(flatten)]
    sums: &'a Sums,
    /// Number of averaged steps.
    averaged_steps: usize,
    loss: Option<f64>,
    /// PSNR on the training rays, in dB.
    psnr: Option<f64>,
    /// Placed samples, density queries and colour queries, and the number of each without skipping within the box.
    placed_samples: u64,
    density_queries: u64,
    color_queries: u64,
    unskipped: u64,
    /// The last fractions of skipped samples and queries: 0 to 1.
    skipped_share: Option<Shares>,
    restarts: u32,
    /// Image motion at the check of the poses, in degrees; null without one.
    pose_motion: Option<PoseMotion>,
    /// Number of gradient elements that were not finite.
    non_finite_gradients: u64,
    /// Number of processes that trained together.
    ranks: usize,
    /// Number of threads of this one.
    threads: usize,
    processor: String,
}

#[derive(Debug, PartialEq, Serialize)]
struct Shares {
    placed_samples: f64,
    density_queries: f64,
    color_queries: f64,
}

/// Training steps and seconds at the last checkpoint, if the file can be read.
pub fn trained(run: &Run) -> Option<(u64, f64)> {
    let summary: Value = serde_json::from_slice(&std::fs::read(run.file(FILE)).ok()?).ok()?;
    Some((summary["steps"].as_u64()?, summary["train_seconds"].as_f64()?))
}

/// Collects the summary of a run during training.
pub struct Account {
    /// Sums of earlier sessions.
    past: Sums,
    start: Instant,
    /// Loss and PSNR of the last steps.
    recent: VecDeque<[f64; 2]>,
    preview: Option<Previewed>,
}

impl Account {
    /// Opens the summary of a run at this step. An absent or damaged file counts as no earlier session.
    pub fn open(run: &Run, stats: &StepStats) -> Self {
        let text = std::fs::read(run.file(FILE)).ok();
        let past = text.and_then(|text| serde_json::from_slice::<Sums>(&text).ok());
        let past = past.filter(|past| past.wall_seconds >= 0.0);
        let begun = stats.step > 0;
        let mut past = match past {
            Some(past) => Sums { resumed: past.resumed.saturating_add(1), ..past },
            None => Sums { resumed: u32::from(begun), ..Sums::default() },
        };
        // The steps of a later preview are taken again.
        let preview = past.preview.take().filter(|preview| preview.step <= stats.step);
        let recent = begun.then_some([stats.loss, stats.psnr]).into_iter().collect();
        Account { past, start: Instant::now(), recent, preview }
    }

    /// Records a training step.
    pub fn step(&mut self, stats: &StepStats) {
        self.recent.push_back([stats.loss, stats.psnr]);
        if self.recent.len() > AVERAGED {
            self.recent.pop_front();
        }
    }

    /// Records a return to a checkpoint after divergence.
    pub fn retreat(&mut self) {
        self.past.retreats += 1;
    }

    /// Discards data of steps after this one.
    pub fn cut(&mut self, step: u64) {
        self.recent.clear();
        self.preview = self.preview.take().filter(|preview| preview.step <= step);
    }

    /// Records a preview.
    pub fn preview(&mut self, preview: Previewed) {
        self.preview = Some(preview);
    }

    /// Writes the file.
    pub fn write(&self, run: &Run, stats: &StepStats, budget: Budget, ended: Option<Ended>) -> Result<()> {
        let sums = Sums {
            wall_seconds: self.past.wall_seconds + self.start.elapsed().as_secs_f64(),
            resumed: self.past.resumed,
            retreats: self.past.retreats,
            peak_memory_bytes: self.past.peak_memory_bytes.max(machine::peak_memory()),
            preview: self.preview.clone(),
        };
        let [loss, psnr] = [0, 1].map(|which| {
            let sum: f64 = self.recent.iter().map(|values| values[which]).sum();
            (!self.recent.is_empty()).then(|| sum / self.recent.len() as f64)
        });
        let summary = Summary {
            raygrad: env!("CARGO_PKG_VERSION"),
            ended,
            seed: run.config.config.seed,
            budget,
            steps: stats.step,
            rays: stats.rays,
            train_seconds: stats.train_seconds,
            sums: &sums,
            averaged_steps: self.recent.len(),
            loss,
            psnr,
            placed_samples: stats.placed_samples,
            density_queries: stats.density_queries,
            color_queries: stats.color_queries,
            unskipped: stats.unskipped,
            skipped_share: shares(stats),
            restarts: stats.restarts,
            pose_motion: stats.pose_motion,
            non_finite_gradients: stats.non_finite,
            ranks: ranks::own().map_or(1, |(_, ranks)| ranks),
            threads: rayon::current_num_threads(),
            processor: machine::processor(),
        };
        write_json(&run.file(FILE), &summary)
    }
}

/// Fractions of skipped samples and queries.
fn shares(stats: &StepStats) -> Option<Shares> {
    let share = |count: u64| 1.0 - count as f64 / stats.unskipped as f64;
    let StepStats { placed_samples, density_queries, color_queries, unskipped, .. } = *stats;
    (unskipped > 0).then(|| Shares {
        placed_samples: share(placed_samples),
        density_queries: share(density_queries),
        color_queries: share(color_queries),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fuzz::run_config;
    use serde_json::{Value, json};

    #[test]
    fn summary_of_resumed_run_adds_up() {
        let folder = tempfile::tempdir().unwrap();
        let run = Run { folder: folder.path().into(), config: run_config() };
        let read = || serde_json::from_slice::<Value>(&std::fs::read(run.file(FILE)).unwrap()).unwrap();
        let write = |account: &Account, stats: &StepStats, ended: Option<Ended>| {
            account.write(&run, stats, Budget::Steps(300), ended).unwrap();
            read()
        };
        let at = |step: u64| StepStats { step, loss: step as f64, psnr: -2.0 * step as f64, ..StepStats::default() };
        // Before the first step.
        let account = Account::open(&run, &at(0));
        let begun = write(&account, &at(0), None);
        for name in ["ended", "loss", "psnr", "preview", "skipped_share", "pose_motion"] {
            assert_eq!(begun[name], Value::Null, "{name}");
        }
        assert_eq!([&begun["resumed"], &begun["averaged_steps"]], [&json!(0), &json!(0)]);
        // The means cover the last hundred steps.
        let mut account = Account::open(&run, &at(0));
        account.past.wall_seconds = 1000.0;
        account.past.peak_memory_bytes = Some(1 << 60);
        (1..=150).for_each(|step| account.step(&at(step)));
        let preview = Previewed { name: "val/0".into(), held_out: true, step: 140, psnr: Some(20.5) };
        account.preview(preview.clone());
        let counts = StepStats {
            placed_samples: 50,
            density_queries: 40,
            color_queries: 10,
            unskipped: 200,
            non_finite: 3,
            restarts: 2,
            pose_motion: Some(PoseMotion { median: 0.5, largest: 0.75 }),
            ..at(150)
        };
        let ended = write(&account, &counts, Some(Ended::Interrupted));
        assert_eq!(ended["ended"], "interrupted");
        assert_eq!((ended["loss"].as_f64(), ended["psnr"].as_f64()), (Some(100.5), Some(-201.0)));
        assert_eq!(ended["averaged_steps"], 100);
        assert_eq!(ended["budget"], json!({ "steps": 300 }));
        assert_eq!(ended["preview"], json!({ "name": "val/0", "held_out": true, "step": 140, "psnr": 20.5 }));
        assert_eq!(
            ended["skipped_share"],
            json!({ "placed_samples": 0.75, "density_queries": 0.8, "color_queries": 0.95 })
        );
        assert_eq!([&ended["non_finite_gradients"], &ended["restarts"]], [&json!(3), &json!(2)]);
        assert_eq!(ended["pose_motion"], json!({ "median": 0.5, "largest": 0.75 }));
        // After divergence, the run returns to a step before the preview.
        account.retreat();
        account.cut(139);
        let back = write(&account, &at(139), None);
        assert_eq!(
            [&back["retreats"], &back["preview"], &back["averaged_steps"]],
            [&json!(1), &Value::Null, &json!(0)]
        );
        account.retreat();
        assert_eq!(write(&account, &at(139), None)["retreats"], 2);
        account.preview(preview.clone());
        account.past.retreats = 0;
        write(&account, &counts, Some(Ended::Interrupted));
        // The run resumes from a step before the preview, and from one at it.
        for (step, shown) in [(139, None), (140, Some(preview))] {
            let later = Account::open(&run, &at(step));
            assert_eq!((later.past.resumed, later.past.peak_memory_bytes), (2, Some(1 << 60)));
            assert!((1000.0..1060.0).contains(&later.past.wall_seconds), "{:?}", later.past);
            assert_eq!((&later.preview, &later.recent), (&shown, &VecDeque::from([[step as f64, -2.0 * step as f64]])));
        }
        // A damaged file is ignored, without an error.
        for text in ["", "{}", "[[[", r#"{"wall_seconds":-1,"resumed":3,"peak_memory_bytes":null,"preview":null}"#] {
            std::fs::write(run.file(FILE), text).unwrap();
            let past = Account::open(&run, &at(9)).past;
            assert_eq!(past, Sums { resumed: 1, ..Sums::default() }, "{text}");
        }
    }
}
