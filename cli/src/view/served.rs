//! What all connections know, and how much they may take.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Semaphore;

use super::photo_cache::PhotoCache;
use super::requests::Requests;
use super::video_jobs::VideoJobs;

/// How much pages and connections may take, and how long they are waited for.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Pages at a time, and connections that are no pages yet.
    pub pages: usize,
    pub connections: usize,
    /// How long one may last that does not become a page.
    pub connected: Duration,
    /// Bytes of a message from a page.
    pub longest: usize,
    /// Messages a second from a page, and how many may come at once.
    pub rate: f64,
    pub burst: f64,
    /// How long a request may take to arrive, and a page to take a message or say that it has seen a picture, beside what its
    /// bytes take, at so many a second.
    pub patience: Duration,
    pub slowest: usize,
    /// How often a page is asked whether it is still there, and how long it is not heard before it is taken to be gone.
    pub idle: Duration,
    pub silence: Duration,
    /// Files that may wait for a page when it asks for a photograph.
    pub files: usize,
}

impl Limits {
    pub const USUAL: Limits = Limits {
        pages: 64,
        connections: 128,
        connected: Duration::from_secs(60),
        longest: 1 << 14,
        rate: 300.0,
        burst: 600.0,
        patience: Duration::from_secs(10),
        slowest: 50_000,
        idle: Duration::from_secs(5),
        silence: Duration::from_secs(30),
        files: 4,
    };

    /// How long so many bytes may take.
    pub fn patience_for(&self, bytes: usize) -> Duration {
        self.patience + Duration::from_secs((bytes / self.slowest) as u64)
    }

    /// How many messages may still come after one more, if it was so many so many seconds ago; less than none if it is one too
    /// many.
    pub fn allowed(&self, before: f64, seconds: f64) -> f64 {
        (before + self.rate * seconds).min(self.burst) - 1.0
    }
}

/// What all connections know.
pub struct Served {
    pub requests: Arc<Requests>,
    pub photos: Option<Arc<PhotoCache>>,
    /// What makes videos, if they can be made.
    pub video_jobs: Option<Arc<VideoJobs>>,
    /// What photographs that have transparency stand before.
    pub background: [f32; 3],
    /// The name of this machine that pages may use, beside its addresses.
    pub host: String,
    /// What links must have, where others than this machine can follow them.
    pub token: Option<String>,
    /// Photographs that are read at a time.
    pub readers: Semaphore,
    pub limits: Limits,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_large_may_take_longer() {
        let seconds = |bytes: usize| Limits::USUAL.patience_for(bytes).as_secs_f64();
        assert_eq!([seconds(0), seconds(49_999), seconds(50_000), seconds(1_000_000)], [10.0, 10.0, 11.0, 30.0]);
    }

    #[test]
    fn messages_come_so_often_and_no_more() {
        let allowed = |before: f64, seconds: f64| Limits::USUAL.allowed(before, seconds);
        assert_eq!(
            [allowed(600.0, 0.0), allowed(0.0, 0.0), allowed(0.0, 1.5), allowed(9.0, 60.0)],
            [599.0, -1.0, 449.0, 599.0]
        );
        // A hand that moves says so 60 times a second, and more at once after a pause.
        let limits = Limits::USUAL;
        assert!(limits.rate >= 120.0 && limits.burst >= limits.rate);
    }

    #[test]
    fn who_is_asked_has_time_to_answer() {
        // A page that is asked once in vain is there still.
        let Limits { idle, silence, patience, connected, .. } = Limits::USUAL;
        assert!(2 * idle + patience < silence && patience < connected);
    }
}
