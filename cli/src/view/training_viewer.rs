//! The viewer during training.

use std::sync::Arc;
use std::time::{Duration, Instant};

use raygrad::nerf::{Model, Result, StepStats, Trainer};
use serde_json::json;

use super::messages::{self, ServerMessage, Taken};
use super::photo_cache::PhotoCache;
use super::renderer::Renderer;
use super::requests::Requests;
use super::served::Limits;
use super::server::Listener;
use super::{about, photos, server, taken};
use crate::interrupt;
use crate::output::{note, print};
use crate::progress::spoken;
use crate::run::Run;
use crate::summary::Ended;

/// Initial fraction of time for renders.
const SHARE: f64 = 0.3;
/// Most render time in seconds that carries over, so that a new request starts at once.
const MOST_CREDIT: f64 = 0.1;
/// The most time in seconds that renders owe to training.
const MOST_DEBT: f64 = 1.0;
/// Interval between messages on the state of training.
const TOLD: Duration = Duration::from_millis(400);
/// Interval between messages on the cameras with pose refinement.
const CAMERAS: Duration = Duration::from_secs(5);
/// After this time without a page, paused training resumes.
const ALONE: Duration = Duration::from_secs(60);
/// Time that a page may take to reload after training.
const GONE: Duration = Duration::from_secs(3);
/// Time that the renderer waits for requests while training is paused or has ended.
const WAIT: Duration = Duration::from_millis(200);
/// Most points of a curve. Beyond that, every second one is dropped.
const POINTS: usize = 240;

/// The viewer of a training run, which also handles commands of pages.
pub struct TrainingViewer {
    run: Run,
    requests: Arc<Requests>,
    photos: Option<Arc<PhotoCache>>,
    renderer: Renderer,
    /// Training time up to the last step, and the render time in seconds that is due.
    trained: f64,
    credit: f64,
    told: Rhythm,
    /// Cameras that pages have, and the interval of their updates.
    taken: (Taken, Rhythm),
    curves: Curves,
}

/// A periodic event with a minimum interval.
struct Rhythm {
    each: Duration,
    last: Instant,
}

impl Rhythm {
    fn new(each: Duration, last: Instant) -> Self {
        Rhythm { each, last }
    }

    /// Returns true if the event is due, and starts the next interval.
    fn is_due(&mut self, now: Instant) -> bool {
        let due = now.saturating_duration_since(self.last) >= self.each;
        if due {
            self.last = now;
        }
        due
    }
}

/// Training curves at regular steps.
struct Curves {
    every: u64,
    points: Vec<Point>,
}

struct Point {
    step: u64,
    loss: f64,
    psnr: f64,
    speed: f64,
}

impl TrainingViewer {
    /// Starts the viewer of a new training run.
    pub fn open(listener: Listener, run: &Run, trainer: &Trainer) -> Result<Self> {
        let (requests, photos) = (Arc::new(Requests::default()), photos(run, None));
        requests.set_share(SHARE);
        requests.introduce(about(run, &trainer.model, photos.as_deref(), None));
        let link = server::serve(
            Limits::USUAL,
            listener,
            requests.clone(),
            photos.clone(),
            None,
            trainer.model.config.background.shown(),
        )?;
        print(&format!("view     {link}\n"))?;
        let (renderer, now) = (Renderer::new(requests.clone(), photos.clone(), None), Instant::now());
        let taken = (taken(run, &trainer.model, photos.as_deref()), Rhythm::new(CAMERAS, now));
        let curves = Curves { every: 1, points: vec![] };
        let (trained, told) = (trainer.stats().train_seconds, Rhythm::new(TOLD, now));
        Ok(TrainingViewer { run: run.clone(), requests, photos, renderer, trained, credit: 0.0, told, taken, curves })
    }

    /// Called after each step with the remaining seconds of training. Renders for the due time, and waits while
    /// training is paused. Returns true if a page stops training.
    pub fn step(&mut self, trainer: &Trainer, psnr: f64, left: f64) -> bool {
        let stats = trainer.stats();
        self.curves.step(&stats, psnr);
        // A return to a checkpoint also resets the time.
        let trained = (stats.train_seconds - self.trained).max(0.0);
        self.trained = stats.train_seconds;
        if is_unseen(self.requests.connected(), self.requests.paused()) {
            self.renderer.clear();
            return self.requests.stops();
        }
        self.credit = credit(self.credit, trained, self.requests.share());
        while is_owed(self.credit) && !self.is_over() {
            let start = Instant::now();
            if !self.renderer.work(&trainer.model, stats.step) {
                break;
            }
            self.credit -= start.elapsed().as_secs_f64();
        }
        self.tell(trainer, psnr, left, None, false);
        let (mut waits, mut alone) = (false, Alone::default());
        while self.requests.paused() && !self.is_over() {
            if !waits {
                self.tell(trainer, psnr, left, None, true);
                note("training paused by the viewer");
                waits = true;
            }
            if alone.is_longer(self.requests.connected(), ALONE) {
                self.requests.pause(false);
            }
            self.renderer.work_or_wait(&trainer.model, stats.step, WAIT);
            self.tell(trainer, psnr, left, None, false);
        }
        if waits && !self.is_over() {
            note("training resumed");
            self.tell(trainer, psnr, left, None, true);
        }
        self.requests.stops()
    }

    /// Returns true if training must end.
    fn is_over(&self) -> bool {
        self.requests.stops() || interrupt::requested()
    }

    /// Tells pages how training ended, and renders for them until the last one disconnects.
    pub fn end(&mut self, trainer: &Trainer, ended: Ended) {
        let how = match ended {
            Ended::Done => "done",
            Ended::Interrupted => "stopped and saved",
            Ended::Diverged => "diverged",
        };
        let stats = trainer.stats();
        self.tell(trainer, stats.psnr, 0.0, Some(how), true);
        if self.requests.connected() == 0 {
            return;
        }
        if interrupt::requested() {
            // Time for the message to be sent before the program ends.
            std::thread::sleep(Duration::from_millis(100));
        } else {
            note("the viewer stays open until its page closes; Ctrl-C ends it now");
        }
        let mut alone = Alone::default();
        while !interrupt::requested() && !alone.is_longer(self.requests.connected(), GONE) {
            self.renderer.work_or_wait(&trainer.model, stats.step, WAIT);
            self.tell(trainer, stats.psnr, 0.0, Some(how), false);
        }
    }

    fn tell(&mut self, trainer: &Trainer, psnr: f64, left: f64, ended: Option<&str>, now: bool) {
        if !self.told.is_due(Instant::now()) && !now {
            return;
        }
        self.tell_taken(&trainer.model);
        let stats = trainer.stats();
        let curve = |of: fn(&Point) -> f64| self.curves.points.iter().map(of).collect::<Vec<f64>>();
        self.requests.tell_state(&messages::text(&ServerMessage::Training(json!({
            "step": stats.step,
            "loss": stats.loss,
            "psnr": psnr,
            "left": spoken(left),
            "share": self.requests.share(),
            "paused": self.requests.paused() && ended.is_none(),
            "ended": ended,
            "curves": { "loss": curve(|at| at.loss), "psnr": curve(|at| at.psnr), "speed": curve(|at| at.speed) },
        }))));
    }

    /// Sends the cameras to pages if they have changed.
    fn tell_taken(&mut self, model: &Model<f32>) {
        let (known, rhythm) = &mut self.taken;
        if model.camera_optimizer.is_none() || !rhythm.is_due(Instant::now()) {
            return;
        }
        let now = taken(&self.run, model, self.photos.as_deref());
        if now != *known {
            self.requests.introduce(about(&self.run, model, self.photos.as_deref(), None));
            self.requests.tell(&server::text(&ServerMessage::Taken(now.clone())));
            *known = now;
        }
    }
}

/// Start of the time without pages.
#[derive(Default)]
struct Alone(Option<Instant>);

impl Alone {
    /// Returns true if no page was connected for longer than the limit. A reloaded page reconnects soon.
    fn is_longer(&mut self, pages: usize, limit: Duration) -> bool {
        if pages > 0 {
            self.0 = None;
            return false;
        }
        self.0.get_or_insert_with(Instant::now).elapsed() > limit
    }
}

/// Returns true if no page is connected and training is not paused.
fn is_unseen(pages: usize, paused: bool) -> bool {
    pages == 0 && !paused
}

/// Returns true if render time is due.
fn is_owed(credit: f64) -> bool {
    credit > 0.0
}

/// The due render time in seconds after training for `trained` seconds. Renders get `share` of the total time. Unused
/// time carries over only up to a limit, and so does the time of a large image, after which pages would wait for long.
fn credit(before: f64, trained: f64, share: f64) -> f64 {
    before.clamp(-MOST_DEBT, MOST_CREDIT) + trained * share / (1.0 - share)
}

impl Curves {
    fn step(&mut self, stats: &StepStats, psnr: f64) {
        if !stats.step.is_multiple_of(self.every) {
            return;
        }
        // Drops points after a return to a checkpoint.
        self.points.retain(|point| point.step < stats.step);
        let speed = stats.rays as f64 / stats.train_seconds.max(1e-9);
        self.points.push(Point { step: stats.step, loss: stats.loss, psnr, speed });
        if self.points.len() > POINTS {
            self.every *= 2;
            self.points.retain(|point| point.step.is_multiple_of(self.every));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn credit_gives_renders_their_fraction() {
        // For a second of training: a second at a fraction of a half, a ninth at a tenth.
        assert_eq!(credit(0.0, 1.0, 0.5), 1.0);
        assert!((credit(0.0, 1.0, 0.1) - 1.0 / 9.0).abs() < 1e-12);
        assert_eq!(
            [credit(0.0, 1.0, 0.0), credit(9.0, 0.0, 0.5), credit(-9.0, 0.0, 0.5)],
            [0.0, MOST_CREDIT, -MOST_DEBT]
        );
    }

    #[test]
    fn unseen_without_pages_and_pause() {
        let all = [(0, false), (0, true), (1, false), (1, true)].map(|(pages, paused)| is_unseen(pages, paused));
        assert_eq!(all, [true, false, false, false]);
        assert_eq!([0.0, 1e-9, -1e-9].map(is_owed), [false, true, false]);
    }

    #[test]
    fn rhythm_is_due_once_per_interval() {
        let begun = Instant::now();
        let mut rhythm = Rhythm::new(Duration::from_secs(5), begun);
        let at = |seconds: f64| begun + Duration::from_secs_f64(seconds);
        assert_eq!(
            [4.9, 5.0, 5.1, 9.9, 10.1].map(|seconds| rhythm.is_due(at(seconds))),
            [false, true, false, false, true]
        );
        assert!(!rhythm.is_due(begun), "clocks of threads may differ a little");
    }

    #[test]
    fn alone_counts_until_a_page_connects() {
        let mut alone = Alone::default();
        let short = Duration::from_millis(20);
        assert!(!alone.is_longer(0, short) && !alone.is_longer(1, Duration::ZERO));
        std::thread::sleep(2 * short);
        assert!(!alone.is_longer(0, short), "it begins anew after a page was there");
        std::thread::sleep(2 * short);
        assert!(!alone.is_longer(0, Duration::from_secs(60)) && alone.is_longer(0, short));
        assert!(!alone.is_longer(2, short) && !alone.is_longer(0, short));
    }

    #[test]
    fn curves_of_long_runs_have_even_steps() {
        // Also for a resumed run.
        for first in [1, 5000] {
            let (mut curves, mut most) = (Curves { every: 1, points: vec![] }, 0);
            for step in first..first + 5000 {
                let (loss, rays) = (step as f64, 10 * step);
                let stats = StepStats { step, loss, rays, train_seconds: step as f64, ..StepStats::default() };
                curves.step(&stats, 0.5);
                most = most.max(curves.points.len());
            }
            assert_eq!(most, POINTS);
            assert!(curves.points.len() > POINTS / 3);
            for pair in curves.points.windows(2) {
                assert_eq!(pair[1].step - pair[0].step, curves.every);
            }
            let last = &curves.points[curves.points.len() - 1];
            assert!(last.step + curves.every >= first + 5000 && last.step.is_multiple_of(curves.every));
            assert!(last.loss == last.step as f64 && last.psnr == 0.5 && (last.speed - 10.0).abs() < 1e-9);
            // The run returns to a checkpoint.
            let (step, before) = (curves.points[40].step, curves.points[39].step);
            curves.step(&StepStats { step, loss: 0.5, ..StepStats::default() }, 0.5);
            assert!(curves.points.len() == 41 && curves.points[40].loss == 0.5 && curves.points[39].step == before);
        }
    }
}
