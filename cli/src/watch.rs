//! Output during training: progress, metrics, previews, and saved models.

use std::collections::HashSet;
use std::io::ErrorKind;
use std::path::Path;
use std::time::Duration;

use raygrad::nerf::model::PoseMotion;
use raygrad::nerf::{Budget, Error, Result, StepStats, Trainer, write_atomic};

use super::checkpoint;
use super::events::Events;
use super::journal::Journal;
use super::lock::{Lock, State};
use super::output::make_folder;
use super::preview::Preview;
use super::progress::{Progress, spoken};
use super::run::Run;
use super::summary::{Account, Ended, Previewed};
use serde_json::Value;

/// Steps between lines of `metrics.jsonl`.
const METRICS_STEPS: u64 = 10;
/// Training time of the first preview in seconds. The interval doubles: each further preview comes at twice the time of
/// the last one.
const FIRST_PREVIEW: f64 = 5.0;
/// Weight of the latest step in the displayed PSNR, since single steps fluctuate.
const SMOOTHING: f64 = 0.05;

/// Factor of the learning rate when a diverged run returns to a checkpoint.
const SLOWER: f64 = 0.25;

/// An observer of one training run.
pub struct Watch<'a> {
    run: &'a Run,
    lock: Lock,
    /// True if another program owns the run's folder or its path. Nothing is written then.
    lost: bool,
    /// Step of the last checkpoint, if it was written after the start.
    saved: Option<u64>,
    budget: Budget,
    preview: Preview,
    metrics: Journal,
    /// Event file of TensorBoard, if enabled.
    events: Option<Events>,
    account: Account,
    /// Last step in the metrics.
    logged: u64,
    /// Last step to which a diverged run returned.
    back: Option<u64>,
    next_preview: f64,
    /// The step of the last preview.
    previewed: Option<u64>,
    /// Training time between saves in seconds.
    interval: f64,
    next_save: f64,
    psnr: Option<f64>,
    /// Image motion at the check of the poses, if that was before the last step.
    pose_motion: Option<PoseMotion>,
    progress: Progress,
    /// Warnings about files that were printed already.
    warned: HashSet<String>,
}

impl<'a> Watch<'a> {
    /// Starts watching. Saves the model and a checkpoint, so that the folder is a complete run from the start. Cuts
    /// metrics of later steps. `tensorboard` enables event files, which a run with earlier ones always continues.
    pub fn new(
        (run, mut lock): (&'a Run, Lock),
        trainer: &Trainer,
        budget: Budget,
        interval: Duration,
        preview: Preview,
        tensorboard: bool,
    ) -> Result<Self> {
        run.keep(&mut lock)?;
        if !run.model_file().exists() {
            trainer.model.save(run.model_file())?;
        }
        if !checkpoint::exists(run)? {
            checkpoint::save(run, trainer)?;
        }
        let stats = trainer.stats();
        let StepStats { step, train_seconds, .. } = stats;
        let (metrics, logged) = metrics(run, step)?;
        let account = Account::open(run, &stats);
        let interval = interval.as_secs_f64();
        let mut watch = Watch {
            run,
            lock,
            lost: false,
            saved: None,
            budget,
            preview,
            metrics,
            events: None,
            account,
            logged,
            back: None,
            next_preview: next_preview(train_seconds),
            previewed: None,
            interval,
            next_save: train_seconds + interval,
            psnr: None,
            pose_motion: stats.pose_motion,
            progress: Progress::new(),
            warned: HashSet::new(),
        };
        watch.attempt(|watch| watch.summarise(&stats, None));
        if tensorboard || run.file("tensorboard").is_dir() {
            watch.begin_events(step);
        }
        Ok(watch)
    }

    /// Returns true if another program owns the run's folder or its path. Training must stop.
    pub fn has_lost_its_run(&self) -> bool {
        self.lost
    }

    /// Checks before each write that this program still owns the run's folder. If the folder was removed or moved, it
    /// is created again with a warning, and the metrics start anew.
    fn keep(&mut self) -> Result<()> {
        let kept = self.run.keep(&mut self.lock);
        self.lost |= kept.is_err() && self.lock.state() == State::Lost;
        if kept? {
            let folder = self.run.folder.display();
            let what = "was removed or moved: training continues in a new folder of that name";
            self.progress.note(&format!("raygrad: warning: {folder}: {what}"));
            self.metrics = Journal::begin(&self.run.file("metrics.jsonl"), b"")?;
            if self.events.is_some() {
                self.begin_events(self.logged);
            }
        }
        Ok(())
    }

    /// Creates an event file for the steps after this one.
    fn begin_events(&mut self, step: u64) {
        self.events = None;
        self.attempt(|watch| {
            watch.events = Some(Events::create(&watch.run.file("tensorboard"), step + 1)?);
            Ok(())
        });
    }

    /// Called after each step. `stops` marks the last step, whatever the budget. Failed writes give a warning, and
    /// training continues: a full disk may have space later.
    pub fn step(&mut self, trainer: &Trainer, stops: bool) {
        let stats = trainer.stats();
        let before = self.psnr.filter(|psnr| psnr.is_finite());
        let psnr = before.map_or(stats.psnr, |psnr| psnr + SMOOTHING * (stats.psnr - psnr));
        self.psnr = Some(psnr);
        self.account.step(&stats);
        if is_logged(stats.step) {
            self.attempt(|watch| watch.log(&stats));
        }
        let (fraction, left) = remaining(self.budget, &stats);
        self.progress.set(fraction, || {
            let speed = stats.rays as f64 / stats.train_seconds;
            let StepStats { step, loss, .. } = stats;
            format!("step {step}  loss {loss:.5}  PSNR {psnr:.2}  {speed:.0} rays/s  {} left", spoken(left))
        });
        if self.pose_motion != stats.pose_motion {
            self.pose_motion = stats.pose_motion;
            pose_check(&stats).into_iter().for_each(|line| self.progress.note(&line));
        }
        if stats.train_seconds >= self.next_preview {
            self.next_preview = 2.0 * stats.train_seconds.max(self.next_preview);
            self.attempt(|watch| watch.preview(trainer));
        }
        // The model is saved at a good step, for viewers. A checkpoint that may have diverged is saved only at the end,
        // if no later one can follow.
        let ends = stops || fraction >= 1.0;
        let good = stats.non_finite_steps == 0 || (ends && !stats.ends_diverged());
        if (ends || stats.train_seconds >= self.next_save) && good {
            self.next_save = stats.train_seconds + self.interval;
            self.attempt(|watch| watch.save(trainer, !ends));
        }
    }

    /// Writes a checkpoint of a run that was stopped after its last step, by another rank or between two looks at the
    /// signal, unless that step has one.
    pub fn stop(&mut self, trainer: &Trainer) {
        let stats = trainer.stats();
        if self.saved != Some(stats.step) && !stats.ends_diverged() {
            self.attempt(|watch| watch.save(trainer, false));
        }
    }

    /// Writes a checkpoint and the summary. With `model`, writes the model before them.
    fn save(&mut self, trainer: &Trainer, model: bool) -> Result<()> {
        self.keep()?;
        if model {
            trainer.model.save(self.run.model_file())?;
        }
        // The steps before a checkpoint are not trained again, so their records come first.
        self.flush();
        self.keep()?;
        checkpoint::save(self.run, trainer)?;
        self.saved = Some(trainer.stats().step);
        self.keep()?;
        self.summarise(&trainer.stats(), None)
    }

    /// Returns a trainer that has diverged to a checkpoint and prints the `reason`. Training continues with lower
    /// learning rates. If this fails, prints the cause and returns false.
    pub fn retreat(&mut self, trainer: &mut Trainer, reason: &str) -> bool {
        let (end, lr_scale) = (trainer.stats().step, trainer.lr_scale());
        // A checkpoint may be good but about to diverge. So the second return uses the one before it.
        let back = self.keep().and_then(|()| checkpoint::step_back(self.run, self.back)).and_then(|()| {
            checkpoint::load(self.run, trainer)?;
            trainer.set_lr_scale(SLOWER * lr_scale);
            checkpoint::save(self.run, trainer)?;
            self.cut(trainer)
        });
        let step = trainer.stats().step;
        let what = format!("raygrad: warning: training diverged by step {end}: its values are not finite{reason}");
        match &back {
            Ok(()) => {
                (self.back, self.saved) = (Some(step), None);
                self.account.retreat();
                self.progress.note(&format!("{what}; resuming from step {step} with {SLOWER} times the learning rate"));
            }
            Err(error) => self.progress.note(&format!("{what}; it cannot return to a checkpoint: {error}")),
        }
        back.is_ok()
    }

    /// Returns a trainer that has diverged finally to its last checkpoint. Returns false if there is none.
    pub fn give_up(&mut self, trainer: &mut Trainer) -> bool {
        let back = checkpoint::load(self.run, trainer).and_then(|()| self.keep()).and_then(|()| self.cut(trainer));
        trainer.model.finish();
        self.attempt(|_| back)
    }

    /// Discards output of steps after the trainer's step.
    fn cut(&mut self, trainer: &Trainer) -> Result<()> {
        let StepStats { step, train_seconds, .. } = trainer.stats();
        (self.metrics, self.logged) = metrics(self.run, step)?;
        (self.psnr, self.next_preview) = (None, next_preview(train_seconds));
        self.next_save = train_seconds + self.interval;
        self.account.cut(step);
        if self.events.is_some() {
            self.begin_events(step);
        }
        Ok(())
    }

    /// Runs work that training can do without. Prints an error once and returns true on success. Loss of the run's
    /// folder ends training, and is reported then.
    fn attempt(&mut self, work: impl FnOnce(&mut Self) -> Result<()>) -> bool {
        let Err(error) = work(self) else { return true };
        let words = format!("raygrad: warning: {error}; training continues");
        if !self.lost && self.warned.insert(words.clone()) {
            self.progress.note(&words);
        }
        false
    }

    /// Called at the end of training. Renders a last preview, unless the user has interrupted the run. Writes the model
    /// if it is `good`, so that a diverged model never replaces a good one.
    ///
    /// # Errors
    ///
    /// Fails if the run's folder is lost or a file cannot be written.
    pub fn finish(mut self, trainer: &Trainer, ended: Ended, good: bool) -> Result<()> {
        self.keep()?;
        if good {
            trainer.model.save(self.run.model_file())?;
        }
        let stats = trainer.stats();
        if stats.step > self.logged {
            self.attempt(|watch| watch.log(&stats));
        }
        let shown = if ended == Ended::Interrupted { Ok(()) } else { self.preview(trainer) };
        self.flush();
        self.keep()?;
        shown.and(self.summarise(&stats, Some(ended)))
    }

    /// Flushes the logs to the disk. Failure gives a warning.
    fn flush(&mut self) {
        self.attempt(|watch| watch.metrics.flush());
        self.tell(|events| events.flush());
    }

    fn log(&mut self, stats: &StepStats) -> Result<()> {
        self.logged = stats.step;
        let failed = |e| Error::file(self.run.file("metrics.jsonl"), e);
        let mut line = serde_json::to_vec(stats).map_err(failed)?;
        let values = serde_json::to_value(stats).map_err(failed)?;
        line.push(b'\n');
        self.keep()?;
        let logged = self.metrics.add(&line);
        self.tell(|events| events.scalars(stats.step, &scalars(&values, stats)));
        logged
    }

    /// Renders and writes a preview, once for each step.
    fn preview(&mut self, trainer: &Trainer) -> Result<()> {
        let stats = trainer.stats();
        if self.previewed.replace(stats.step) == Some(stats.step) {
            return Ok(());
        }
        let folder = self.run.file("previews");
        let path = folder.join(format!("{:06}.png", stats.step));
        let (image, psnr) = self.preview.show(&trainer.model);
        let png = image.to_png();
        let (name, held_out) = (self.preview.name().to_owned(), self.preview.is_held_out());
        self.keep()?;
        self.account.preview(Previewed { name, held_out, step: stats.step, psnr: psnr.is_finite().then_some(psnr) });
        self.tell(|events| {
            events.scalars(stats.step, &[("preview/psnr".to_owned(), psnr)])?;
            events.image(stats.step, "preview/picture", [image.width, image.height], &png)
        });
        make_folder(&folder)?;
        write_atomic(&path, &png)?;
        let (time, name) = (spoken(stats.train_seconds), self.preview.name());
        let size = format!("{}x{}", image.width / 2, image.height);
        self.progress.note(&format!("after {time}: {} ({size}), PSNR {psnr:.2} dB on {name}", path.display()));
        Ok(())
    }

    /// Writes to the event file, if enabled. Failure gives a warning.
    fn tell(&mut self, write: impl FnOnce(&mut Events) -> Result<()>) {
        self.attempt(|watch| watch.events.as_mut().map_or(Ok(()), write));
    }

    fn summarise(&self, stats: &StepStats, ended: Option<Ended>) -> Result<()> {
        self.account.write(self.run, stats, self.budget, ended)
    }

    /// The displayed PSNR, and the remaining training time in seconds.
    pub fn shown(&self, trainer: &Trainer) -> (f64, f64) {
        let stats = trainer.stats();
        (self.psnr.unwrap_or(stats.psnr), remaining(self.budget, &stats).1)
    }
}

/// Completed fraction of a run, and the remaining training time in seconds.
pub fn remaining(budget: Budget, stats: &StepStats) -> (f64, f64) {
    match budget {
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

/// The reason why a trainer's numbers are not finite, as the end of a sentence.
pub fn reason(trainer: &Trainer) -> String {
    trainer.first_non_finite(1.0).map_or(String::new(), |error| format!(" ({error})"))
}

/// Training time of the next preview in seconds.
fn next_preview(train_seconds: f64) -> f64 {
    let mut previews = std::iter::successors(Some(FIRST_PREVIEW), |time| Some(2.0 * time));
    previews.find(|time| *time > train_seconds).unwrap_or(f64::INFINITY)
}

/// The metrics of a run, cut to a step, and their last step.
fn metrics(run: &Run, step: u64) -> Result<(Journal, u64)> {
    let path = run.file("metrics.jsonl");
    let (kept, logged) = kept_metrics(&path, step)?;
    Ok((Journal::begin(&path, kept.as_bytes())?, logged))
}

/// The lines of a metrics file up to this step, and their last step; empty without a file. Omits lines that were
/// written only because the run ended there, and incomplete lines.
fn kept_metrics(path: &Path, step: u64) -> Result<(String, u64)> {
    let text = match std::fs::read(path) {
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok((String::new(), 0)),
        text => text.map_err(|e| Error::file(path, format!("cannot be read: {e}")))?,
    };
    let text = String::from_utf8_lossy(&text);
    let known = |line: &str| {
        let value: Value = serde_json::from_str(line).ok()?;
        value["step"].as_u64().filter(|own| *own <= step && is_logged(*own))
    };
    let (mut kept, mut last) = (String::new(), 0);
    for (line, own) in text.lines().filter_map(|line| Some((line, known(line)?))) {
        kept.extend([line, "\n"]);
        last = own;
    }
    Ok((kept, last))
}

/// The result of the check of the poses, if they have been checked.
fn pose_check(stats: &StepStats) -> Option<String> {
    let found = match stats.given_poses_are_right() {
        true => "the given poses are right, and are hardly refined from here on",
        false => "some given poses are wrong, and detail fades in while all are refined",
    };
    let told = |PoseMotion { median, largest }| {
        format!("poses    moved images by {median:.2} degrees, and one by {largest:.2}: {found}")
    };
    stats.pose_motion.map(told)
}

/// Named scalars of the metrics, and the training speed.
fn scalars(values: &Value, stats: &StepStats) -> Vec<(String, f64)> {
    let named = values.as_object().into_iter().flatten().filter(|(name, value)| *name != "step" && !value.is_object());
    // Values that are not finite are null in the metrics.
    let named = named.map(|(name, value)| (format!("train/{name}"), value.as_f64().unwrap_or(f64::NAN)));
    let speed = ("train/rays_per_second".to_owned(), stats.rays as f64 / stats.train_seconds);
    named.chain([speed]).collect()
}

/// Returns true if metrics have a line of a step that is not the last one.
fn is_logged(step: u64) -> bool {
    step == 1 || step.is_multiple_of(METRICS_STEPS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn check_of_poses_is_told_with_its_motion() {
        let told = |pose_motion| pose_check(&StepStats { pose_motion, ..StepStats::default() });
        assert_eq!(told(None), None);
        let [right, some, wrong] = [(0.384, 0.5), (0.384, 0.9), (1.9, 2.0)]
            .map(|(median, largest)| told(Some(PoseMotion { median, largest })).unwrap());
        assert!(right.contains("by 0.38 degrees, and one by 0.50: the given poses are right"), "{right}");
        assert!(some.contains("by 0.38 degrees, and one by 0.90: some given poses are wrong"), "{some}");
        assert!(wrong.contains("by 1.90 degrees, and one by 2.00: some given poses are wrong"), "{wrong}");
    }

    #[test]
    fn kept_metrics_end_at_the_resumed_step() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        assert_eq!(kept_metrics(&path, 9).unwrap(), (String::new(), 0));
        let line = |step: u64| format!("{{\"step\":{step},\"loss\":0.5}}\n");
        let lines = |steps: &[u64]| steps.iter().map(|step| line(*step)).collect::<String>();
        // The run ended at 14, resumed, and was killed while it wrote line 40.
        std::fs::write(&path, lines(&[1, 10, 14, 20, 30]) + "{\"step\":40,\"lo").unwrap();
        for (step, expected) in
            [(0, vec![]), (9, vec![1]), (19, vec![1, 10]), (20, vec![1, 10, 20]), (99, vec![1, 10, 20, 30])]
        {
            assert_eq!(kept_metrics(&path, step).unwrap(), (lines(&expected), expected.last().copied().unwrap_or(0)));
        }
    }

    #[test]
    fn remaining_time_follows_from_progress() {
        let stats = StepStats { step: 40, train_seconds: 8.0, ..StepStats::default() };
        assert_eq!(remaining(Budget::Steps(200), &stats), (0.2, 32.0));
        assert_eq!(remaining(Budget::Steps(20), &stats), (2.0, 0.0));
        assert_eq!(remaining(Budget::Time(Duration::from_secs(32)), &stats), (0.25, 24.0));
        assert_eq!(remaining(Budget::Time(Duration::from_secs(4)), &stats), (2.0, 0.0));
    }

    #[test]
    fn next_preview_doubles_the_time() {
        assert_eq!([0.0, 4.9, 5.0, 39.0, 40.0].map(next_preview), [5.0, 5.0, 10.0, 40.0, 80.0]);
    }
}
