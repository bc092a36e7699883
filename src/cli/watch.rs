//! What happens beside training: progress, metrics, previews, and saving the model.

use std::fs::File;
use std::io::{ErrorKind, Write};
use std::path::Path;
use std::time::Duration;

use raygrad::nerf::{Budget, Error, Result, StepStats, Trainer, write_atomic};

use super::checkpoint;
use super::preview::Preview;
use super::progress::{Progress, spoken};
use super::run::Run;
use serde_json::Value;

/// Steps between lines of `metrics.jsonl`.
const METRICS_STEPS: u64 = 10;
/// Training time of the first preview in seconds; each further one comes at twice the time of the one before.
const FIRST_PREVIEW: f64 = 5.0;
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
    /// Training time between saves in seconds.
    interval: f64,
    next_save: f64,
    psnr: Option<f64>,
    progress: Progress,
}

impl<'a> Watch<'a> {
    /// Begins to watch; the untrained model is saved, so that the folder is a whole run from the start. What metrics say of steps
    /// that are to come is cut off.
    pub fn new(run: &'a Run, trainer: &Trainer, budget: Budget, interval: Duration, preview: Preview) -> Result<Self> {
        if !run.model_file().exists() {
            trainer.model.save(run.model_file())?;
        }
        let StepStats { step, train_seconds, .. } = trainer.stats();
        let path = run.file("metrics.jsonl");
        write_atomic(&path, kept_metrics(&path, step)?.as_bytes())?;
        let metrics = File::options().append(true).open(&path);
        let metrics = metrics.map_err(|e| Error::file(&path, format!("cannot be written: {e}")))?;
        let previews = std::iter::successors(Some(FIRST_PREVIEW), |time| Some(2.0 * time));
        let interval = interval.as_secs_f64();
        Ok(Watch {
            run,
            budget,
            preview,
            metrics,
            logged: step,
            next_preview: previews.into_iter().find(|time| *time > train_seconds).unwrap_or(f64::INFINITY),
            interval,
            next_save: train_seconds + interval,
            psnr: None,
            progress: Progress::new(),
        })
    }

    /// Called after each step; `stops` says that it is the last one, whatever the budget.
    pub fn step(&mut self, trainer: &Trainer, stops: bool) -> Result<()> {
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
        // Views look at a finished model, and training goes on from one that is not.
        let ends = stops || fraction >= 1.0;
        if (ends || stats.train_seconds >= self.next_save) && !stats.has_diverged() {
            self.next_save = stats.train_seconds + self.interval;
            let model = if ends { Ok(()) } else { trainer.model.save(self.run.model_file()) };
            // A full disk may have room again in a minute.
            if let Err(error) = model.and_then(|()| checkpoint::save(self.run, trainer)) {
                self.progress.note(&format!("raygrad: warning: {error}; training goes on"));
            }
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

/// What metrics in a file say of steps up to this one; nothing if there is no file. A line that is not whole is left out.
fn kept_metrics(path: &Path, step: u64) -> Result<String> {
    let text = match std::fs::read(path) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(String::new()),
        text => text.map_err(|e| Error::file(path, format!("cannot be read: {e}")))?,
    };
    let text = String::from_utf8_lossy(&text);
    let known = |line: &&str| {
        let value: Option<Value> = serde_json::from_str(line).ok();
        value.is_some_and(|value| value["step"].as_u64().is_some_and(|own| own <= step))
    };
    Ok(text.lines().filter(known).flat_map(|line| [line, "\n"]).collect())
}
