//! A window on a scene that is being trained.

use std::sync::Arc;
use std::time::{Duration, Instant};

use raygrad::nerf::{Model, Result, StepStats, Trainer};
use serde_json::json;

use super::album::Album;
use super::hub::Hub;
use super::messages::{Taken, Tell};
use super::painter::Painter;
use super::server::Listener;
use super::{about, album, server, taken};
use crate::cli::interrupt;
use crate::cli::output::{note, print};
use crate::cli::progress::spoken;
use crate::cli::run::Run;
use crate::cli::summary::Ended;

/// The share of time that pictures get at first.
const SHARE: f64 = 0.3;
/// Seconds of painting that can be saved up, for the next picture to come at once.
const MOST_CREDIT: f64 = 0.1;
/// How often pages are told how training goes.
const TOLD: Duration = Duration::from_millis(400);
/// How often they are told where photographs were taken, while that is learned.
const CAMERAS: Duration = Duration::from_secs(5);
/// How long training that was paused waits for a page when none is there any more.
const ALONE: Duration = Duration::from_secs(60);
/// Points of a curve, after which every second one is dropped.
const POINTS: usize = 240;

/// Lets pages look at training, and takes what they say of it.
pub struct Window {
    run: Run,
    hub: Arc<Hub>,
    album: Option<Arc<Album>>,
    painter: Painter,
    /// When it last let training go on, and how many seconds of painting training owes it.
    since: Instant,
    credit: f64,
    told: Instant,
    /// Where photographs were when pages were told last, and when that was.
    taken: (Taken, Instant),
    curves: Curves,
}

/// How training went, at even steps.
struct Curves {
    every: u64,
    loss: Vec<f64>,
    psnr: Vec<f64>,
    speed: Vec<f64>,
}

impl Window {
    /// Begins to serve the page of a run that is about to be trained.
    pub fn open(listener: Listener, run: &Run, trainer: &Trainer) -> Result<Self> {
        let (hub, album) = (Arc::new(Hub::default()), album(run, None));
        hub.set_share(SHARE);
        hub.introduce(about(run, &trainer.model, album.as_deref(), None));
        let link = server::serve(listener, hub.clone(), album.clone(), None, trainer.model.config.background.shown())?;
        print(&format!("view     {link}\n"))?;
        let (painter, now) = (Painter::new(hub.clone(), album.clone(), None), Instant::now());
        let taken = (taken(run, &trainer.model, album.as_deref()), now);
        let curves = Curves { every: 1, loss: vec![], psnr: vec![], speed: vec![] };
        Ok(Window { run: run.clone(), hub, album, painter, since: now, credit: 0.0, told: now, taken, curves })
    }

    /// Called after each step; `left` says how many seconds of training there are. Paints for as long as its share is, and
    /// waits for as long as a page wants training to. Says whether a page wants it to end.
    pub fn step(&mut self, trainer: &Trainer, psnr: f64, left: f64) -> bool {
        self.curves.step(&trainer.stats(), psnr);
        if self.hub.connected() == 0 && !self.hub.paused() {
            self.since = Instant::now();
            return self.hub.stops();
        }
        let share = self.hub.share();
        let owed = self.since.elapsed().as_secs_f64() * share / (1.0 - share);
        // What was not asked for is not saved up, but for a little.
        self.credit = self.credit.min(MOST_CREDIT) + owed;
        let step = trainer.stats().step;
        while self.credit > 0.0 {
            let start = Instant::now();
            if !self.painter.work(&trainer.model, step) {
                break;
            }
            self.credit -= start.elapsed().as_secs_f64();
        }
        self.tell(trainer, psnr, left, None, false);
        let (mut waits, mut alone) = (false, None);
        while self.hub.paused() && !self.hub.stops() && !interrupt::requested() {
            if !waits {
                self.tell(trainer, psnr, left, None, true);
                note("training waits: a page has paused it");
                waits = true;
            }
            // A page that is loaded anew comes back soon.
            alone =
                alone.filter(|_| self.hub.connected() == 0).or_else(|| (self.hub.connected() == 0).then(Instant::now));
            if alone.is_some_and(|since: Instant| since.elapsed() > ALONE) {
                self.hub.pause(false);
            }
            if !self.painter.work(&trainer.model, step) {
                self.hub.wait(Duration::from_millis(200));
            }
            self.tell(trainer, psnr, left, None, false);
        }
        if waits {
            note("training goes on");
            self.tell(trainer, psnr, left, None, true);
        }
        self.since = Instant::now();
        self.hub.stops()
    }

    /// Tells pages that training has ended, and how.
    pub fn end(&mut self, trainer: &Trainer, ended: Ended) {
        let how = match ended {
            Ended::Done => "done",
            Ended::Interrupted => "stopped, and saved",
            Ended::Diverged => "diverged",
        };
        let psnr = trainer.stats().psnr;
        self.tell(trainer, psnr, 0.0, Some(how), true);
        // For it to arrive before the program ends.
        if self.hub.connected() > 0 {
            std::thread::sleep(Duration::from_millis(100));
        }
    }

    fn tell(&mut self, trainer: &Trainer, psnr: f64, left: f64, ended: Option<&str>, now: bool) {
        if !now && self.told.elapsed() < TOLD {
            return;
        }
        self.told = Instant::now();
        self.tell_taken(&trainer.model);
        let (stats, Curves { loss, psnr: decibels, speed, .. }) = (trainer.stats(), &self.curves);
        self.hub.tell(&server::text(&Tell::Training(json!({
            "step": stats.step,
            "loss": stats.loss,
            "psnr": psnr,
            "left": spoken(left),
            "share": self.hub.share(),
            "paused": self.hub.paused() && ended.is_none(),
            "ended": ended,
            "curves": { "loss": loss, "psnr": decibels, "speed": speed },
        }))));
    }
}

impl Window {
    /// Tells pages where photographs were taken, if more of that is known by now.
    fn tell_taken(&mut self, model: &Model<f32>) {
        let (known, when) = &self.taken;
        if when.elapsed() < CAMERAS {
            return;
        }
        let now = taken(&self.run, model, self.album.as_deref());
        if now != *known {
            self.hub.introduce(about(&self.run, model, self.album.as_deref(), None));
            self.hub.tell(&server::text(&Tell::Taken(now.clone())));
        }
        self.taken = (now, Instant::now());
    }
}

impl Curves {
    fn step(&mut self, stats: &StepStats, psnr: f64) {
        if !stats.step.is_multiple_of(self.every) {
            return;
        }
        // After a run went back.
        let before = (stats.step / self.every) as usize - 1;
        for values in [&mut self.loss, &mut self.psnr, &mut self.speed] {
            values.truncate(before);
        }
        self.loss.push(stats.loss);
        self.psnr.push(psnr);
        self.speed.push(stats.rays as f64 / stats.train_seconds.max(1e-9));
        if self.loss.len() > POINTS {
            self.every *= 2;
            for values in [&mut self.loss, &mut self.psnr, &mut self.speed] {
                let mut number = 0;
                values.retain(|_| {
                    number += 1;
                    number % 2 == 0
                });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_are_of_even_steps_however_long_they_get() {
        let mut curves = Curves { every: 1, loss: vec![], psnr: vec![], speed: vec![] };
        for step in 1..=5000 {
            let stats = StepStats {
                step,
                loss: step as f64,
                rays: 10 * step,
                train_seconds: step as f64,
                ..StepStats::default()
            };
            curves.step(&stats, 0.5);
            assert!(curves.loss.len() <= POINTS && curves.loss.len() == curves.speed.len());
        }
        assert!(curves.loss.len() > POINTS / 3 && curves.psnr.iter().all(|psnr| *psnr == 0.5));
        let every = curves.every as f64;
        assert!(curves.loss.iter().enumerate().all(|(i, loss)| *loss == every * (i + 1) as f64), "{:?}", curves.loss);
        assert!(curves.speed.iter().all(|speed| (speed - 10.0).abs() < 1e-9));
        // It went back, and takes other ways.
        let step = 40 * curves.every;
        curves.step(&StepStats { step, loss: 0.5, ..StepStats::default() }, 0.5);
        assert!(curves.loss.len() == 40 && curves.loss[39] == 0.5 && curves.loss[38] == 39.0 * every);
    }
}
