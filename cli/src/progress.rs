//! Progress of long tasks on standard error: a bar on a terminal, periodic lines elsewhere.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use raygrad::nerf::available_memory;
use raygrad::tensor::parallel::{self, locked};

use super::interrupt::{self, Stop, Work};
use super::output;

/// Resolution of the bar.
const PARTS: u64 = 1000;
/// Time between lines if there is no bar.
const INTERVAL: Duration = Duration::from_secs(5);

/// A progress display that threads can share. Dropping it clears the bar.
pub struct Progress {
    bar: ProgressBar,
    last_line: Mutex<Instant>,
}

impl Progress {
    /// Creates a display at 0.
    pub fn new() -> Self {
        let bar = ProgressBar::with_draw_target(Some(PARTS), ProgressDrawTarget::stderr());
        let style = ProgressStyle::with_template("{wide_bar:.cyan/dim} {percent:>3} %  {msg}");
        bar.set_style(style.expect("the template is a constant of the right form"));
        Progress { bar, last_line: Mutex::new(Instant::now()) }
    }

    /// Shows that `fraction` of the task is done, with a text.
    pub fn set(&self, fraction: f64, words: impl FnOnce() -> String) {
        let mut last_line = locked(&self.last_line);
        if !self.bar.is_hidden() {
            self.bar.set_position((fraction.min(1.0) * PARTS as f64) as u64);
            self.bar.set_message(words());
        } else if last_line.elapsed() >= INTERVAL {
            *last_line = Instant::now();
            output::note(&format!("{:3.0} %  {}", 100.0 * fraction.min(1.0), words()));
        }
    }

    /// Shows `3 of 12` and the text.
    pub fn count(&self, done: usize, total: usize, words: &str) {
        self.set(done as f64 / total as f64, || format!("{done} of {total} {words}"));
    }

    /// Runs a task for each of `costs`, its bytes of memory, and shows the number of finished ones, like
    /// [`count`](Self::count). Tasks run in parallel as far as half of the free memory allows.
    ///
    /// # Errors
    ///
    /// Returns the first error by task number after all tasks have ended. After a Ctrl-C no task starts, and the error
    /// is [`Stop::Interrupted`].
    pub fn each<R: Send>(&self, costs: &[u64], words: &str, work: impl Fn(usize) -> Work<R> + Sync) -> Work<Vec<R>> {
        let (done, total) = (AtomicUsize::new(0), costs.len());
        let limit = available_memory().map_or(u64::MAX, |free| free / 2);
        let results = parallel::collect_within(costs, limit, |i| {
            if interrupt::requested() {
                return Err(Stop::Interrupted);
            }
            let result = work(i)?;
            self.count(done.fetch_add(1, Ordering::Relaxed) + 1, total, words);
            Ok(result)
        });
        results.into_iter().collect()
    }

    /// Prints a permanent line.
    pub fn note(&self, line: &str) {
        self.bar.suspend(|| output::note(line));
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.bar.finish_and_clear();
    }
}

/// A duration as text: `42 s`, `3 min 20 s`, `2 h 05 min`.
pub fn spoken(seconds: f64) -> String {
    let seconds = seconds.round() as u64;
    match seconds {
        0..60 => format!("{seconds} s"),
        60..3600 => format!("{} min {:02} s", seconds / 60, seconds % 60),
        _ => format!("{} h {:02} min", seconds / 3600, seconds / 60 % 60),
    }
}

#[cfg(test)]
mod tests {
    use super::spoken;

    #[test]
    fn spoken_duration_has_two_units() {
        assert_eq!(spoken(0.4), "0 s");
        assert_eq!(spoken(59.6), "1 min 00 s");
        assert_eq!(spoken(200.0), "3 min 20 s");
        assert_eq!(spoken(7500.0), "2 h 05 min");
    }
}
