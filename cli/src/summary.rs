//! What came of a run, for whoever looks at it later: `summary.json`.

use std::collections::VecDeque;
use std::time::Instant;

use raygrad::nerf::{Budget, Result, StepStats};
use serde::{Deserialize, Serialize};

use super::machine;
use super::run::{Run, write_json};

/// The name of the file in a run's folder.
const FILE: &str = "summary.json";
/// Steps whose loss and PSNR are averaged: those of single steps jump.
const AVERAGED: usize = 100;

/// How a run has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Ended {
    /// By using up its budget.
    Done,
    /// By Ctrl-C or SIGTERM.
    Interrupted,
    /// Because its numbers were no longer finite.
    Diverged,
}

/// The last preview.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Previewed {
    /// The photograph that was compared with.
    pub name: String,
    /// Whether it is not trained on.
    pub held_out: bool,
    /// Steps that the model had been trained for.
    pub step: u64,
    /// In dB; null if it is not finite.
    pub psnr: Option<f64>,
}

/// What adds up over the parts of a run that was ended and gone on with. The first fields of [`Summary`] are these.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
struct Sums {
    /// Time in which a program trained the run, with previews and files, in seconds. Of a part that was killed, up to its last
    /// checkpoint.
    wall_seconds: f64,
    /// How often it was gone on with.
    resumed: u32,
    /// How often it went back to a checkpoint because it had diverged.
    #[serde(default)]
    retreats: u32,
    /// The most memory that any part took, where the system says so.
    peak_memory_bytes: Option<u64>,
    preview: Option<Previewed>,
}

/// The contents of the file.
#[derive(Serialize)]
struct Summary<'a> {
    raygrad: &'static str,
    /// Null while it is trained, and of a run that was killed.
    ended: Option<Ended>,
    seed: u64,
    budget: Budget,
    steps: u64,
    rays: u64,
    train_seconds: f64,
    #[serde(flatten)]
    sums: &'a Sums,
    /// Means of the last steps, of which there are so many.
    averaged_steps: usize,
    loss: Option<f64>,
    /// On the rays that were trained on, in dB.
    psnr: Option<f64>,
    /// Samples placed on rays, evaluations of densities and of colours, and those of each that there would have been if
    /// nothing in the box were skipped.
    placed_samples: u64,
    density_queries: u64,
    color_queries: u64,
    unskipped: u64,
    /// What was left out of these: 0 to 1, of the last.
    skipped_share: Option<Shares>,
    restarts: u32,
    /// Elements whose gradient was not finite.
    non_finite_gradients: u64,
    threads: usize,
    processor: String,
}

#[derive(Debug, PartialEq, Serialize)]
struct Shares {
    placed_samples: f64,
    density_queries: f64,
    color_queries: f64,
}

/// Keeps account of a run while it is trained.
pub struct Account {
    /// Of the parts before this one.
    past: Sums,
    start: Instant,
    /// Loss and PSNR of the last steps.
    recent: VecDeque<[f64; 2]>,
    preview: Option<Previewed>,
}

impl Account {
    /// The account of a run that has come to this step. A file that is absent or damaged says nothing of earlier parts.
    pub fn open(run: &Run, stats: &StepStats) -> Self {
        let text = std::fs::read(run.file(FILE)).ok();
        let past = text.and_then(|text| serde_json::from_slice::<Sums>(&text).ok());
        let past = past.filter(|past| past.wall_seconds >= 0.0);
        let begun = stats.step > 0;
        let mut past = match past {
            Some(past) => Sums { resumed: past.resumed.saturating_add(1), ..past },
            None => Sums { resumed: u32::from(begun), ..Sums::default() },
        };
        // A later one was of steps that are taken again.
        let preview = past.preview.take().filter(|preview| preview.step <= stats.step);
        let recent = begun.then_some([stats.loss, stats.psnr]).into_iter().collect();
        Account { past, start: Instant::now(), recent, preview }
    }

    /// A step was taken.
    pub fn step(&mut self, stats: &StepStats) {
        self.recent.push_back([stats.loss, stats.psnr]);
        if self.recent.len() > AVERAGED {
            self.recent.pop_front();
        }
    }

    /// It goes on from a checkpoint, having diverged.
    pub fn retreat(&mut self) {
        self.past.retreats += 1;
    }

    /// It is back at this step.
    pub fn cut(&mut self, step: u64) {
        self.recent.clear();
        self.preview = self.preview.take().filter(|preview| preview.step <= step);
    }

    /// A preview was made.
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
            non_finite_gradients: stats.non_finite,
            threads: rayon::current_num_threads(),
            processor: machine::processor(),
        };
        write_json(&run.file(FILE), &summary)
    }
}

/// How much of what there is to do was left out.
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
    fn parts_of_a_run_add_up() {
        let folder = tempfile::tempdir().unwrap();
        let run = Run { folder: folder.path().into(), config: run_config() };
        let read = || serde_json::from_slice::<Value>(&std::fs::read(run.file(FILE)).unwrap()).unwrap();
        let write = |account: &Account, stats: &StepStats, ended: Option<Ended>| {
            account.write(&run, stats, Budget::Steps(300), ended).unwrap();
            read()
        };
        let at = |step: u64| StepStats { step, loss: step as f64, psnr: -2.0 * step as f64, ..StepStats::default() };
        // Nothing was done yet.
        let account = Account::open(&run, &at(0));
        let begun = write(&account, &at(0), None);
        for name in ["ended", "loss", "psnr", "preview", "skipped_share"] {
            assert_eq!(begun[name], Value::Null, "{name}");
        }
        assert_eq!([&begun["resumed"], &begun["averaged_steps"]], [&json!(0), &json!(0)]);
        // The means are those of the last hundred steps.
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
        // It diverges, and goes back to where there was no such preview.
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
        // It goes on: from a step before the preview, and from one after it.
        for (step, shown) in [(139, None), (140, Some(preview))] {
            let later = Account::open(&run, &at(step));
            assert_eq!((later.past.resumed, later.past.peak_memory_bytes), (2, Some(1 << 60)));
            assert!((1000.0..1060.0).contains(&later.past.wall_seconds), "{:?}", later.past);
            assert_eq!((&later.preview, &later.recent), (&shown, &VecDeque::from([[step as f64, -2.0 * step as f64]])));
        }
        // What is damaged says nothing, and is no error.
        for text in ["", "{}", "[[[", r#"{"wall_seconds":-1,"resumed":3,"peak_memory_bytes":null,"preview":null}"#] {
            std::fs::write(run.file(FILE), text).unwrap();
            let past = Account::open(&run, &at(9)).past;
            assert_eq!(past, Sums { resumed: 1, ..Sums::default() }, "{text}");
        }
    }
}
