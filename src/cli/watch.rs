//! What happens beside training: progress, metrics, previews, and saving the model.

use std::fs::File;
use std::io::Write;

use raygrad::nerf::{Budget, Error, Result, StepStats, Trainer};

use super::preview::Preview;
use super::progress::{Progress, spoken};
use super::run::Run;

/// Steps between lines of `metrics.jsonl`.
const METRICS_STEPS: u64 = 10;
/// Training time of the first preview in seconds; each further one comes at twice the time of the one before.
const FIRST_PREVIEW: f64 = 5.0;
/// Training time between saves in seconds.
const SAVE_INTERVAL: f64 = 60.0;
/// Weight of the latest step in the PSNR that is shown: that of single steps jumps.
const SMOOTHING: f64 = 0.05;

/// An observer of one training run.
pub struct Watch<'a> {
    run: &'a Run,
    budget: Budget,
    preview: Preview,
    metrics: File,
    /// The last step in the metrics.
    logged: u64,
    next_preview: f64,
    next_save: f64,
    psnr: Option<f64>,
    progress: Progress,
}

impl<'a> Watch<'a> {
    /// Begins to watch; the untrained model is saved, so that the folder is a whole run from the start.
    pub fn new(run: &'a Run, trainer: &Trainer, budget: Budget, preview: Preview) -> Result<Self> {
        trainer.model.save(run.model_file())?;
        let path = run.file("metrics.jsonl");
        let metrics = File::create(&path).map_err(|e| Error::file(&path, format!("cannot be written: {e}")))?;
        Ok(Watch {
            run,
            budget,
            preview,
            metrics,
            logged: 0,
            next_preview: FIRST_PREVIEW,
            next_save: SAVE_INTERVAL,
            psnr: None,
            progress: Progress::new(),
        })
    }

    /// Called after each step.
    pub fn step(&mut self, trainer: &Trainer) -> Result<()> {
        let stats = trainer.stats();
        let psnr = self.psnr.map_or(stats.psnr, |psnr| psnr + SMOOTHING * (stats.psnr - psnr));
        self.psnr = Some(psnr);
        if stats.step == 1 || stats.step.is_multiple_of(METRICS_STEPS) {
            self.log(&stats)?;
        }
        let (fraction, left) = self.remaining(&stats);
        self.progress.set(fraction, || {
            let speed = stats.rays as f64 / stats.train_seconds;
            let StepStats { step, loss, .. } = stats;
            format!("step {step}  loss {loss:.5}  PSNR {psnr:.2}  {speed:.0} rays/s  {} left", spoken(left))
        });
        if stats.train_seconds >= self.next_preview {
            self.next_preview = 2.0 * stats.train_seconds.max(self.next_preview);
            self.preview(trainer)?;
        }
        if stats.train_seconds >= self.next_save {
            self.next_save = stats.train_seconds + SAVE_INTERVAL;
            trainer.model.save(self.run.model_file())?;
        }
        Ok(())
    }

    /// Called when training has ended; `preview` asks for a last one.
    pub fn finish(mut self, trainer: &Trainer, preview: bool) -> Result<()> {
        trainer.model.save(self.run.model_file())?;
        let stats = trainer.stats();
        if stats.step != self.logged {
            self.log(&stats)?;
        }
        if preview { self.preview(trainer) } else { Ok(()) }
    }

    fn log(&mut self, stats: &StepStats) -> Result<()> {
        self.logged = stats.step;
        let path = self.run.file("metrics.jsonl");
        let mut line = serde_json::to_vec(stats).map_err(|e| Error::file(&path, e))?;
        line.push(b'\n');
        self.metrics.write_all(&line).map_err(|e| Error::file(&path, format!("cannot be written: {e}")))
    }

    fn preview(&mut self, trainer: &Trainer) -> Result<()> {
        let stats = trainer.stats();
        let path = self.run.file(&format!("previews/{:06}.png", stats.step));
        let psnr = self.preview.save(&trainer.model, &path)?;
        let (time, name) = (spoken(stats.train_seconds), &self.preview.name);
        self.progress.note(&format!("after {time}: {}, PSNR {psnr:.2} dB on {name}", path.display()));
        Ok(())
    }

    /// Share of the run that is done, and the seconds of training that are left.
    fn remaining(&self, stats: &StepStats) -> (f64, f64) {
        match self.budget {
            Budget::Time(time) => {
                let total = time.as_secs_f64();
                (stats.train_seconds / total, (total - stats.train_seconds).max(0.0))
            }
            Budget::Steps(steps) => {
                let left = steps.saturating_sub(stats.step) as f64;
                (stats.step as f64 / steps as f64, left * stats.train_seconds / stats.step as f64)
            }
        }
    }
}
