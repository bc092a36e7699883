//! Ranks as threads of one process.

use super::{Exchange, ExchangeError, FirstError, TIMEOUT, next_round};
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
    failed: FirstError,
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
        let rank = |(rank, (to, from))| InProcess { rank, to, from, timeout: TIMEOUT, sent: 0, failed: None };
        to.into_iter().zip(from).enumerate().map(rank).collect()
    }

    fn round(&mut self, parts: &[&[u8]]) -> Result<Vec<Vec<u8>>, ExchangeError> {
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
}

impl Exchange for InProcess {
    fn rank(&self) -> usize {
        self.rank
    }

    fn ranks(&self) -> usize {
        self.to.len()
    }

    fn all_to_all(&mut self, parts: &[&[u8]]) -> Result<Vec<Vec<u8>>, ExchangeError> {
        next_round(self, parts, Self::round, |own| &mut own.failed)
    }

    fn set_timeout(&mut self, timeout: Duration) {
        self.timeout = timeout;
    }

    fn sent_bytes(&self) -> u64 {
        self.sent
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn first_error_stays_and_late_messages_meet_no_later_round() {
        let [mut first, mut second] = <[_; 2]>::try_from(InProcess::ranks(2)).unwrap();
        let short = Duration::from_millis(20);
        first.set_timeout(short);
        let error = Err(ExchangeError::TimedOut { rank: 1, after: short });
        assert_eq!(first.all_gather(&[1]), error);
        // Rank 1 comes late, and gets what rank 0 has sent in that round. Rank 0 does not take it for its next one.
        assert_eq!(second.all_gather(&[1]), Ok(vec![vec![1], vec![1]]));
        assert_eq!(first.all_gather(&[2]), error);
        drop(first);
        second.set_timeout(short);
        let lost = Err(ExchangeError::Lost { rank: 0, what: "its thread has ended".into() });
        assert_eq!((second.all_gather(&[2]), second.all_gather(&[2])), (lost.clone(), lost));
    }
}
