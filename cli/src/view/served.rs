//! State and limits that all connections share.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::Semaphore;

use super::photo_cache::PhotoCache;
use super::requests::Requests;
use super::video_jobs::VideoJobs;

/// Resource limits and time-outs of pages and connections.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Most pages, and most connections before they become pages. Beyond, the network with the most gives one up.
    pub pages: usize,
    pub connections: usize,
    /// Time-out of a connection that does not become a page.
    pub connected: Duration,
    /// Largest message from a page, in bytes.
    pub longest: usize,
    /// Messages per second from a page, and the largest burst.
    pub rate: f64,
    pub burst: f64,
    /// Time-out of requests, of sent messages and of acknowledgements, in addition to their length at the slowest bytes
    /// per second.
    pub patience: Duration,
    pub slowest: usize,
    /// Interval of pings, and the silence after which a page counts as gone.
    pub idle: Duration,
    pub silence: Duration,
    /// Most waiting files when a page requests an image.
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

    /// Time-out of a message of this length.
    pub fn patience_for(&self, bytes: usize) -> Duration {
        self.patience + Duration::from_secs((bytes / self.slowest) as u64)
    }

    /// Token bucket: the number of messages that may follow after one more. `before` is the number of `seconds` ago.
    /// Negative if the message exceeds the limit.
    pub fn allowed(&self, before: f64, seconds: f64) -> f64 {
        (before + self.rate * seconds).min(self.burst) - 1.0
    }
}

/// State that all connections share.
pub struct Served {
    pub requests: Arc<Requests>,
    pub photos: Option<Arc<PhotoCache>>,
    /// Renders videos, if available.
    pub video_jobs: Option<Arc<VideoJobs>>,
    /// Background of transparent images.
    pub background: [f32; 3],
    /// The host name that pages may use besides IP addresses.
    pub host: String,
    /// Token of the link, which gives access.
    pub token: String,
    /// Limits the number of images that are read at a time.
    pub readers: Semaphore,
    pub limits: Limits,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patience_grows_with_the_length() {
        let seconds = |bytes: usize| Limits::USUAL.patience_for(bytes).as_secs_f64();
        assert_eq!([seconds(0), seconds(49_999), seconds(50_000), seconds(1_000_000)], [10.0, 10.0, 11.0, 30.0]);
    }

    #[test]
    fn allowed_limits_rate_and_burst() {
        let allowed = |before: f64, seconds: f64| Limits::USUAL.allowed(before, seconds);
        assert_eq!(
            [allowed(600.0, 0.0), allowed(0.0, 0.0), allowed(0.0, 1.5), allowed(9.0, 60.0)],
            [599.0, -1.0, 449.0, 599.0]
        );
        // A pointer moves 60 times per second, with bursts after a pause.
        let limits = Limits::USUAL;
        assert!(limits.rate >= 120.0 && limits.burst >= limits.rate);
    }

    #[test]
    fn silence_allows_one_missed_ping() {
        // One missed ping does not drop a page.
        let Limits { idle, silence, patience, connected, .. } = Limits::USUAL;
        assert!(2 * idle + patience < silence && patience < connected);
    }
}
