//! What happens beside training: progress, metrics, previews, and saving the model.

use std::collections::HashSet;
use std::io::ErrorKind;
use std::path::Path;
use std::time::Duration;

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
/// Training time of the first preview in seconds; each further one comes at twice the time of the one before.
const FIRST_PREVIEW: f64 = 5.0;
/// Weight of the latest step in the PSNR that is shown: that of single steps jumps.
const SMOOTHING: f64 = 0.05;

/// What the learning rate of a run is multiplied by that has diverged and goes back.
const SLOWER: f64 = 0.25;

/// An observer of one training run.
pub struct Watch<'a> {
    run: &'a Run,
    lock: Lock,
    /// Whether another program has the run's folder, or one in its place: nothing is written any more.
    lost: bool,
    budget: Budget,
    preview: Preview,
    metrics: Journal,
    /// What TensorBoard is told, if it is.
    events: Option<Events>,
    account: Account,
    /// The last step in the metrics.
    logged: u64,
    /// The step that it went back to last, having diverged.
    back: Option<u64>,
    next_preview: f64,
    /// Training time between saves in seconds.
    interval: f64,
    next_save: f64,
    psnr: Option<f64>,
    progress: Progress,
    /// The words about files that could not be written.
    warned: HashSet<String>,
}

impl<'a> Watch<'a> {
    /// Begins to watch; the untrained model is saved and a checkpoint, so that the folder is a whole run from the start. What
    /// metrics say of steps that are to come is cut off. `tensorboard` asks for event files too; a run that has some gets more.
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
            budget,
            preview,
            metrics,
            events: None,
            account,
            logged,
            back: None,
            next_preview: next_preview(train_seconds),
            interval,
            next_save: train_seconds + interval,
            psnr: None,
            progress: Progress::new(),
            warned: HashSet::new(),
        };
        watch.attempt(|watch| watch.summarise(&stats, None));
        if tensorboard || run.file("tensorboard").is_dir() {
            watch.begin_events(step);
        }
        Ok(watch)
    }

    /// Whether another program has taken the run's folder, or one in its place: training is to stop.
    pub fn has_lost_its_run(&self) -> bool {
        self.lost
    }

    /// Asked before each write: whether the run's folder is still this program's. One that was removed or moved is made again,
    /// which is said, and the metrics begin anew in it.
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

    /// Begins an event file for the steps after this one.
    fn begin_events(&mut self, step: u64) {
        self.events = None;
        self.attempt(|watch| {
            watch.events = Some(Events::create(&watch.run.file("tensorboard"), step + 1)?);
            Ok(())
        });
    }

    /// Called after each step; `stops` says that it is the last one, whatever the budget. What cannot be written is said, and
    /// training goes on: a full disk may have room again in a minute.
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
        if stats.train_seconds >= self.next_preview {
            self.next_preview = 2.0 * stats.train_seconds.max(self.next_preview);
            self.attempt(|watch| watch.preview(trainer));
        }
        // Views look at a finished model, and training goes on from one that is not; and not from one that may have diverged,
        // unless there is no later one to come.
        let ends = stops || fraction >= 1.0;
        let good = stats.non_finite_steps == 0 || (ends && !stats.ends_diverged());
        if (ends || stats.train_seconds >= self.next_save) && good {
            self.next_save = stats.train_seconds + self.interval;
            self.attempt(|watch| watch.save(trainer, !ends));
        }
    }

    /// Writes a checkpoint and the summary, and the model before them if it is to be.
    fn save(&mut self, trainer: &Trainer, model: bool) -> Result<()> {
        self.keep()?;
        if model {
            trainer.model.save(self.run.model_file())?;
        }
        self.keep()?;
        checkpoint::save(self.run, trainer)?;
        self.keep()?;
        self.summarise(&trainer.stats(), None)
    }

    /// Takes a trainer that has diverged, for that `reason`, back to a checkpoint, from where it goes on with lower learning
    /// rates, and says so. If that cannot be, it says why and gives `false`.
    pub fn retreat(&mut self, trainer: &mut Trainer, reason: &str) -> bool {
        let (end, pace) = (trainer.stats().step, trainer.lr_scale());
        // What was good when it was written may have been on its way out of all bounds: the second time it is the one before.
        let back = self.keep().and_then(|()| checkpoint::step_back(self.run, self.back)).and_then(|()| {
            checkpoint::load(self.run, trainer)?;
            trainer.set_lr_scale(SLOWER * pace);
            checkpoint::save(self.run, trainer)?;
            self.cut(trainer)
        });
        let step = trainer.stats().step;
        let what = format!("raygrad: warning: training diverged by step {end}: its values are not finite{reason}");
        match &back {
            Ok(()) => {
                self.back = Some(step);
                self.account.retreat();
                self.progress.note(&format!("{what}; resuming from step {step} with {SLOWER} times the learning rate"));
            }
            Err(error) => self.progress.note(&format!("{what}; it cannot return to a checkpoint: {error}")),
        }
        back.is_ok()
    }

    /// Takes a trainer that has diverged for good back to the last checkpoint; says whether there is one.
    pub fn give_up(&mut self, trainer: &mut Trainer) -> bool {
        let back = checkpoint::load(self.run, trainer).and_then(|()| self.keep()).and_then(|()| self.cut(trainer));
        trainer.model.finish();
        self.attempt(|_| back)
    }

    /// Forgets what was written of steps after the one that a trainer is at.
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

    /// Does what training goes on without: says what went wrong, if it was not said before, and gives whether nothing did. That the
    /// run is lost ends training, and is said then.
    fn attempt(&mut self, work: impl FnOnce(&mut Self) -> Result<()>) -> bool {
        let Err(error) = work(self) else { return true };
        let words = format!("raygrad: warning: {error}; training continues");
        if !self.lost && self.warned.insert(words.clone()) {
            self.progress.note(&words);
        }
        false
    }

    /// Called when training has ended; unless somebody waits for that, there is a last preview. The model is written if it is
    /// `good`, so that none that is not takes the place of one that is.
    ///
    /// # Errors
    /// If the run is lost, or something cannot be written.
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
        self.keep()?;
        shown.and(self.summarise(&stats, Some(ended)))
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

    fn preview(&mut self, trainer: &Trainer) -> Result<()> {
        let stats = trainer.stats();
        let folder = self.run.file("previews");
        let path = folder.join(format!("{:06}.png", stats.step));
        let (image, psnr) = self.preview.show(&trainer.model);
        let png = image.to_png();
        let (name, held_out) = (self.preview.name.clone(), self.preview.is_held_out());
        self.keep()?;
        self.account.preview(Previewed { name, held_out, step: stats.step, psnr: psnr.is_finite().then_some(psnr) });
        self.tell(|events| {
            events.scalars(stats.step, &[("preview/psnr".to_owned(), psnr)])?;
            events.image(stats.step, "preview/picture", [image.width, image.height], &png)
        });
        make_folder(&folder)?;
        write_atomic(&path, &png)?;
        let (time, name) = (spoken(stats.train_seconds), &self.preview.name);
        self.progress.note(&format!("after {time}: {}, PSNR {psnr:.2} dB on {name}", path.display()));
        Ok(())
    }

    /// Tells TensorBoard something, if it is told anything; what it cannot be told is said, and no more.
    fn tell(&mut self, write: impl FnOnce(&mut Events) -> Result<()>) {
        self.attempt(|watch| watch.events.as_mut().map_or(Ok(()), write));
    }

    fn summarise(&self, stats: &StepStats, ended: Option<Ended>) -> Result<()> {
        self.account.write(self.run, stats, self.budget, ended)
    }

    /// The PSNR that is shown, and the seconds of training that are left.
    pub fn shown(&self, trainer: &Trainer) -> (f64, f64) {
        let stats = trainer.stats();
        (self.psnr.unwrap_or(stats.psnr), remaining(self.budget, &stats).1)
    }
}

/// Share of a run that is done, and the seconds of training that are left.
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

/// Why the numbers of a trainer are not finite, as the end of a sentence.
pub fn reason(trainer: &Trainer) -> String {
    trainer.first_non_finite(1.0).map_or(String::new(), |error| format!(" ({error})"))
}

/// Training time in seconds at which a preview comes next.
fn next_preview(train_seconds: f64) -> f64 {
    let mut previews = std::iter::successors(Some(FIRST_PREVIEW), |time| Some(2.0 * time));
    previews.find(|time| *time > train_seconds).unwrap_or(f64::INFINITY)
}

/// The metrics of a run, cut to a step, and the last step in them.
fn metrics(run: &Run, step: u64) -> Result<(Journal, u64)> {
    let path = run.file("metrics.jsonl");
    let (kept, logged) = kept_metrics(&path, step)?;
    Ok((Journal::begin(&path, kept.as_bytes())?, logged))
}

/// The lines of metrics in a file of steps up to this one, and the last of these steps; none if there is no file. What was
/// written because a run ended there is left out, as a run that was not ended has no such line; and a line that is not whole.
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

/// What metrics say as numbers by their names, and how fast training is.
fn scalars(values: &Value, stats: &StepStats) -> Vec<(String, f64)> {
    let named = values.as_object().into_iter().flatten().filter(|(name, _)| *name != "step");
    // What is not finite is null in a line of metrics.
    let named = named.map(|(name, value)| (format!("train/{name}"), value.as_f64().unwrap_or(f64::NAN)));
    let speed = ("train/rays_per_second".to_owned(), stats.rays as f64 / stats.train_seconds);
    named.chain([speed]).collect()
}

/// Whether metrics have a line of a step that is not the last one.
fn is_logged(step: u64) -> bool {
    step == 1 || step.is_multiple_of(METRICS_STEPS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn metrics_are_cut_to_where_a_run_goes_on() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        assert_eq!(kept_metrics(&path, 9).unwrap(), (String::new(), 0));
        let line = |step: u64| format!("{{\"step\":{step},\"loss\":0.5}}\n");
        let lines = |steps: &[u64]| steps.iter().map(|step| line(*step)).collect::<String>();
        // It was ended at 14, went on, and was killed while it wrote of 40.
        std::fs::write(&path, lines(&[1, 10, 14, 20, 30]) + "{\"step\":40,\"lo").unwrap();
        for (step, expected) in
            [(0, vec![]), (9, vec![1]), (19, vec![1, 10]), (20, vec![1, 10, 20]), (99, vec![1, 10, 20, 30])]
        {
            assert_eq!(kept_metrics(&path, step).unwrap(), (lines(&expected), expected.last().copied().unwrap_or(0)));
        }
    }

    #[test]
    fn what_is_left_follows_from_what_was_done() {
        let stats = StepStats { step: 40, train_seconds: 8.0, ..StepStats::default() };
        assert_eq!(remaining(Budget::Steps(200), &stats), (0.2, 32.0));
        assert_eq!(remaining(Budget::Steps(20), &stats), (2.0, 0.0));
        assert_eq!(remaining(Budget::Time(Duration::from_secs(32)), &stats), (0.25, 24.0));
        assert_eq!(remaining(Budget::Time(Duration::from_secs(4)), &stats), (2.0, 0.0));
    }

    #[test]
    fn previews_come_at_twice_the_time_of_the_one_before() {
        assert_eq!([0.0, 4.9, 5.0, 39.0, 40.0].map(next_preview), [5.0, 5.0, 10.0, 40.0, 80.0]);
    }
}
