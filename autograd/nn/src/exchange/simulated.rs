//! Ranks in one process, with the times of a network.

use super::{Exchange, ExchangeError, FirstError, InProcess, TIMEOUT, next_round};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::time::Duration;

/// Bytes of a packet.
const PACKET: f64 = 1448.0;

/// The network between the ranks of a [`Simulated`] exchange: each rank has one full-duplex link to a switch that is
/// never full.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Link {
    /// Time from one rank to another.
    pub latency: Duration,
    /// Bytes per second, in each direction.
    pub bandwidth: f64,
    /// Share of packets of 1448 bytes that are lost. Each is sent again after a round trip. Range: 0 to below 1.
    pub loss: f64,
}

/// One of several ranks in one process, as [`InProcess`], with a clock that counts the time that messages would take on a
/// [`Link`]. Results and times do not depend on the machine.
///
/// Time passes in exchanges, and where the caller says so with [`work`](Self::work). A message leaves when those before
/// it have left, and arrives when those before it have arrived.
///
/// ```
/// use raygrad_nn::{Exchange, Link, Simulated};
/// use std::time::Duration;
/// let link = Link { latency: Duration::from_micros(50), bandwidth: 125e6, loss: 0.0 };
/// let ranks = Simulated::ranks(2, link).into_iter().map(|mut exchange| {
///     std::thread::spawn(move || {
///         exchange.all_gather(&[0; 125_000]).unwrap();
///         exchange.elapsed()
///     })
/// });
/// for rank in ranks.collect::<Vec<_>>() {
///     assert_eq!(rank.join().unwrap(), Duration::from_micros(1050));
/// }
/// ```
#[derive(Debug)]
pub struct Simulated {
    exchange: InProcess,
    link: Link,
    timeout: Duration,
    /// Seconds since the start.
    now: f64,
    /// When the link is free in each direction.
    free: [f64; 2],
    rng: Pcg64Mcg,
    sent: u64,
    failed: FirstError,
}

impl Simulated {
    /// Creates `count` connected ranks, in their order.
    ///
    /// # Panics
    /// If the bandwidth is not positive, or the loss is out of range.
    #[track_caller]
    pub fn ranks(count: usize, link: Link) -> Vec<Self> {
        assert!(link.bandwidth > 0.0, "a bandwidth of {}", link.bandwidth);
        assert!((0.0..1.0).contains(&link.loss), "a loss of {}; use 0 to below 1", link.loss);
        let rank = |exchange: InProcess| Simulated {
            rng: Pcg64Mcg::seed_from_u64(exchange.rank() as u64),
            exchange,
            link,
            timeout: TIMEOUT,
            failed: None,
            now: 0.0,
            free: [0.0; 2],
            sent: 0,
        };
        InProcess::ranks(count).into_iter().map(rank).collect()
    }

    /// Lets time pass, for work between exchanges.
    pub fn work(&mut self, time: Duration) {
        self.now += time.as_secs_f64();
    }

    /// Time since the start.
    pub fn elapsed(&self) -> Duration {
        // The sums are off by less.
        Duration::from_nanos((self.now * 1e9).round() as u64)
    }

    /// Time of a message on the link, with the packets that are sent again, and the delay by their round trips.
    fn transfer(&mut self, bytes: usize) -> [f64; 2] {
        let packets = (bytes as f64 / PACKET).ceil() as usize;
        let mut again = 0;
        for _ in 0..packets {
            while self.rng.random::<f64>() < self.link.loss {
                again += 1;
            }
        }
        let lost = f64::from(again);
        let round_trips = 2.0 * self.link.latency.as_secs_f64() * lost;
        [(bytes as f64 + PACKET * lost) / self.link.bandwidth, round_trips]
    }
}

impl Exchange for Simulated {
    fn rank(&self) -> usize {
        self.exchange.rank()
    }

    fn ranks(&self) -> usize {
        self.exchange.ranks()
    }

    fn all_to_all(&mut self, parts: &[&[u8]]) -> Result<Vec<Vec<u8>>, ExchangeError> {
        next_round(self, parts, Self::round, |own| &mut own.failed)
    }

    /// Sets how long a rank waits for another one, by the simulated clock.
    fn set_timeout(&mut self, timeout: Duration) {
        self.timeout = timeout;
    }

    fn sent_bytes(&self) -> u64 {
        self.sent
    }
}

impl Simulated {
    fn round(&mut self, parts: &[&[u8]]) -> Result<Vec<Vec<u8>>, ExchangeError> {
        let (rank, ranks) = (self.rank(), self.ranks());
        // Ranks after this one come first, so that not all send to rank 0 at a time.
        let mut messages = vec![vec![]; ranks];
        for to in (rank..rank + ranks).map(|to| to % ranks) {
            self.sent += if to == rank { 0 } else { parts[to].len() as u64 };
            let mut times = [0.0; 2];
            if to != rank {
                let [transfer, delay] = self.transfer(parts[to].len());
                self.free[0] = self.free[0].max(self.now) + transfer;
                times = [self.free[0] + delay + self.link.latency.as_secs_f64(), transfer];
            }
            messages[to] = times.iter().flat_map(|time| time.to_le_bytes()).chain(parts[to].iter().copied()).collect();
        }
        let messages: Vec<&[u8]> = messages.iter().map(|message| &message[..]).collect();
        let mut received = self.exchange.all_to_all(&messages)?;
        let times = |from: usize| {
            let time = |at: usize| received[from].get(8 * at..8 * at + 8).and_then(|bytes| bytes.try_into().ok());
            let [arrival, transfer] = [0, 1].map(|at| time(at).map_or(0.0, f64::from_le_bytes));
            (arrival, transfer, from)
        };
        let mut arrivals: Vec<_> = (0..ranks).filter(|from| *from != rank).map(times).collect();
        arrivals.sort_by(|a, b| a.0.total_cmp(&b.0));
        let start = self.now;
        for (arrival, transfer, from) in arrivals {
            self.free[1] = arrival.max(self.free[1] + transfer);
            if self.free[1] > start + self.timeout.as_secs_f64() {
                return Err(ExchangeError::TimedOut { rank: from, after: self.timeout });
            }
            self.now = self.now.max(self.free[1]);
        }
        received.iter_mut().for_each(|message| drop(message.drain(..16)));
        Ok(received)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The clock of each rank after `run`.
    fn clocks(ranks: Vec<Simulated>, run: impl Fn(&mut Simulated) + Sync) -> Vec<Duration> {
        std::thread::scope(|scope| {
            let start = |mut exchange: Simulated| {
                let run = &run;
                scope.spawn(move || {
                    run(&mut exchange);
                    exchange.elapsed()
                })
            };
            let ranks: Vec<_> = ranks.into_iter().map(start).collect();
            ranks.into_iter().map(|rank| rank.join().unwrap()).collect()
        })
    }

    fn link(loss: f64) -> Link {
        Link { latency: Duration::from_millis(2), bandwidth: 1e6, loss }
    }

    #[test]
    fn messages_share_the_link_and_wait_for_the_slowest() {
        // Three messages of 10 ms leave one after another, and the last of them arrives 2 ms later.
        let gather = |exchange: &mut Simulated| drop(exchange.all_gather(&[0; 10_000]).unwrap());
        assert_eq!(clocks(Simulated::ranks(4, link(0.0)), gather), [Duration::from_millis(32); 4]);
        // One rank is late, and all wait.
        let late = |exchange: &mut Simulated| {
            exchange.work(Duration::from_millis(if exchange.rank() == 2 { 50 } else { 1 }));
            gather(exchange);
            assert_eq!(exchange.sent_bytes(), 30_000);
        };
        let expected = [72, 82, 50, 62].map(Duration::from_millis);
        assert_eq!(clocks(Simulated::ranks(4, link(0.0)), late), expected);
    }

    #[test]
    fn lost_packets_cost_time_and_no_data() {
        let gather = |exchange: &mut Simulated| {
            let own = vec![exchange.rank() as u8; 100_000];
            let all = exchange.all_gather(&own).unwrap();
            assert!(all[0] == vec![0; 100_000] && all[1] == vec![1; 100_000]);
        };
        let [without, with] = [0.0, 0.2].map(|loss| clocks(Simulated::ranks(2, link(loss)), gather));
        assert_eq!(without, [Duration::from_millis(102); 2]);
        // Each lost packet costs its own time, 1.448 ms, and a round trip of 4 ms. A fifth of 70 is lost, some twice.
        let lost = with.iter().map(|time| (time.as_secs_f64() - 0.102) / 5.448e-3).collect::<Vec<_>>();
        assert!(lost.iter().all(|lost| (lost - lost.round()).abs() < 1e-6 && (8.0..30.0).contains(lost)), "{lost:?}");
        assert_eq!(with, clocks(Simulated::ranks(2, link(0.2)), gather));
    }

    #[test]
    fn messages_of_all_sizes_take_their_own_time() {
        let bytes = |from: usize, to: usize| 1000 * (1 + 4 * from + 2 * to);
        let run = |exchange: &mut Simulated| {
            let rank = exchange.rank();
            let parts: Vec<Vec<u8>> = (0..3).map(|to| vec![0; bytes(rank, to)]).collect();
            let parts: Vec<&[u8]> = parts.iter().map(|part| &part[..]).collect();
            exchange.all_to_all(&parts).unwrap();
        };
        // A kilobyte takes 1 ms. Rank 0 sends 3 to rank 1 and then 5 to rank 2; rank 1 sends 9 to 2, then 5 to 0; rank 2
        // sends 9 to 0, then 11 to 1. So rank 0 has its messages after 9 + 2 and 9 + 5 + 2, rank 1 after 3 + 2 and
        // 9 + 11 + 2, and rank 2 after 3 + 5 + 2 and then 8 + 2 + 9, since both come at once.
        let expected = [16, 22, 19].map(Duration::from_millis);
        assert_eq!(clocks(Simulated::ranks(3, link(0.0)), run), expected);
    }

    #[test]
    fn a_rank_that_is_too_late_is_named() {
        let [mut first, mut second] = <[_; 2]>::try_from(Simulated::ranks(2, link(0.0))).unwrap();
        first.set_timeout(Duration::from_secs(5));
        second.work(Duration::from_secs(6));
        let other = std::thread::spawn(move || second.all_gather(&[]).map(drop));
        assert_eq!(first.all_gather(&[]), Err(ExchangeError::TimedOut { rank: 1, after: Duration::from_secs(5) }));
        assert_eq!(other.join().unwrap(), Ok(()));
    }
}
