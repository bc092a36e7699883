//! Ranks as threads of one process.

use super::{Exchange, ExchangeError, check_parts};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::Duration;

/// One of several ranks in one process, each on a thread of its own: for tests, and to try a model before it runs on a
/// cluster.
#[derive(Debug)]
pub struct InProcess {
    rank: usize,
    to: Vec<Sender<Vec<u8>>>,
    from: Vec<Receiver<Vec<u8>>>,
    timeout: Duration,
    sent: u64,
}

impl InProcess {
    /// Creates `count` connected ranks, in their order.
    pub fn ranks(count: usize) -> Vec<Self> {
        let mut from: Vec<Vec<Receiver<Vec<u8>>>> = (0..count).map(|_| vec![]).collect();
        let mut to: Vec<Vec<Sender<Vec<u8>>>> = (0..count).map(|_| vec![]).collect();
        for sender in &mut to {
            for receiver in &mut from {
                let (end, start) = channel();
                sender.push(end);
                receiver.push(start);
            }
        }
        let rank = |(rank, (to, from))| InProcess { rank, to, from, timeout: Duration::from_secs(600), sent: 0 };
        to.into_iter().zip(from).enumerate().map(rank).collect()
    }

    /// Sets how long a rank waits for another one. Default: 10 minutes.
    pub fn with_timeout(self, timeout: Duration) -> Self {
        InProcess { timeout, ..self }
    }
}

impl Exchange for InProcess {
    fn rank(&self) -> usize {
        self.rank
    }

    fn ranks(&self) -> usize {
        self.to.len()
    }

    fn all_to_all(&mut self, parts: &[&[u8]]) -> Result<Vec<Vec<u8>>, ExchangeError> {
        check_parts(parts, self.ranks());
        let lost = |rank| ExchangeError::Lost { rank, what: "its thread has ended".into() };
        for (rank, part) in parts.iter().enumerate() {
            self.to[rank].send(part.to_vec()).map_err(|_| lost(rank))?;
            self.sent += if rank == self.rank { 0 } else { part.len() as u64 };
        }
        let after = self.timeout;
        let receive = |(rank, from): (usize, &Receiver<Vec<u8>>)| {
            from.recv_timeout(after).map_err(|error| match error {
                RecvTimeoutError::Timeout => ExchangeError::TimedOut { rank, after },
                RecvTimeoutError::Disconnected => lost(rank),
            })
        };
        self.from.iter().enumerate().map(receive).collect()
    }

    fn sent_bytes(&self) -> u64 {
        self.sent
    }
}
