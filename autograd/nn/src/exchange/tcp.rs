//! Ranks on several machines, connected by TCP.

use super::{Exchange, ExchangeError, FirstError, next_round};
use std::convert::Infallible;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream, ToSocketAddrs};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Limits of timeouts: connections refuse 0, and clocks end.
const SHORTEST: Duration = Duration::from_millis(1);
const LONGEST: Duration = Duration::from_secs(1 << 30);

/// Time between attempts to connect.
const RETRY: Duration = Duration::from_millis(20);

/// Ranks connected by TCP, where there is no MPI. Each pair of ranks has one connection.
///
/// A rank is lost if it sends nothing for the timeout. A large message may take longer.
///
/// Connections are neither encrypted nor authenticated: use it in a network whose machines are trusted.
#[derive(Debug)]
pub struct Tcp {
    rank: usize,
    /// The other ranks; `None` for this one.
    peers: Vec<Option<Peer>>,
    timeout: Duration,
    sent: u64,
    failed: FirstError,
}

#[derive(Debug)]
struct Peer {
    incoming: TcpStream,
    /// To the thread that writes, so that two ranks that send much to each other do not wait for one another.
    outgoing: Option<Sender<Vec<u8>>>,
    writer: Option<JoinHandle<()>>,
    /// Ends with the writer.
    written: Receiver<Infallible>,
    /// How long the last messages may take at the end of the exchange. The other rank may be busy with a third one. While
    /// the exchange is in use, writers wait without limit: if the other rank hangs, the reader notices.
    patience: Duration,
}

impl Drop for Peer {
    /// Waits until the last messages are sent: the other rank may still need them.
    fn drop(&mut self) {
        self.outgoing = None;
        if let Err(RecvTimeoutError::Timeout) = self.written.recv_timeout(self.patience) {
            // Ends the writer.
            let _ = self.incoming.shutdown(Shutdown::Both);
        }
        self.writer.take().map(JoinHandle::join);
    }
}

impl Tcp {
    /// Connects rank `rank` of `addresses.len()` ranks. It listens at its own address, and waits up to `timeout` until all
    /// others are there. Later it waits as long for each message.
    ///
    /// # Errors
    /// If the own address cannot be listened at, or if not all others connect in time.
    ///
    /// # Panics
    /// If `rank` has no address.
    pub fn connect(rank: usize, addresses: &[impl ToSocketAddrs], timeout: Duration) -> Result<Self, ExchangeError> {
        let failed = |what: &str, error| ExchangeError::Connection(format!("rank {rank}: {what}: {error}"));
        let listener =
            TcpListener::bind(&addresses[rank]).map_err(|error| failed("its address cannot be listened at", error))?;
        Tcp::with_listener(rank, listener, addresses, timeout)
    }

    /// As [`connect`](Self::connect), with a bound listener in place of the own address.
    ///
    /// # Errors
    /// If not all others connect in time.
    pub fn with_listener(
        rank: usize,
        listener: TcpListener,
        addresses: &[impl ToSocketAddrs],
        timeout: Duration,
    ) -> Result<Self, ExchangeError> {
        let until = Instant::now() + timeout.min(LONGEST);
        let absent = |other: usize, error: io::Error| {
            let what = format!("rank {rank} cannot reach rank {other} within {} s: {error}", timeout.as_secs());
            ExchangeError::Connection(what)
        };
        let mut peers: Vec<Option<Peer>> = addresses.iter().map(|_| None).collect();
        // Each rank calls those before it, and says who it is.
        for (other, address) in addresses[..rank].iter().enumerate() {
            let stream = retry(until, || call(address, until)).map_err(|error| absent(other, error))?;
            let mut own = &stream;
            own.write_all(&greeting(rank, addresses.len())).map_err(|error| absent(other, error))?;
            peers[other] = Some(Peer::new(stream, timeout, addresses.len()).map_err(|error| absent(other, error))?);
        }
        for _ in rank + 1..addresses.len() {
            let missing = || (rank + 1..addresses.len()).find(|&other| peers[other].is_none()).unwrap_or(rank);
            let accepted = retry(until, || accept(&listener, rank, addresses.len()));
            let (other, stream) = accepted.map_err(|error| absent(missing(), error))?;
            if peers[other].is_some() {
                let what = format!("rank {rank}: a second rank {other} connects to its address");
                return Err(ExchangeError::Connection(what));
            }
            peers[other] = Some(Peer::new(stream, timeout, addresses.len()).map_err(|error| absent(other, error))?);
        }
        Ok(Tcp { rank, peers, timeout, sent: 0, failed: None })
    }
}

/// Tries until it works or the time is over.
fn retry<R>(until: Instant, mut attempt: impl FnMut() -> io::Result<R>) -> io::Result<R> {
    loop {
        match attempt() {
            Err(_) if Instant::now() < until => std::thread::sleep(RETRY),
            result => return result,
        }
    }
}

/// What a rank says first: that it is one, and which.
fn greeting(rank: usize, ranks: usize) -> [u8; 24] {
    let mut greeting = *b"raygrad\n................";
    greeting[8..16].copy_from_slice(&(rank as u64).to_le_bytes());
    greeting[16..].copy_from_slice(&(ranks as u64).to_le_bytes());
    greeting
}

/// Connects to one of the addresses of a name.
fn call(name: &impl ToSocketAddrs, until: Instant) -> io::Result<TcpStream> {
    let mut last = Err(ErrorKind::AddrNotAvailable.into());
    for address in name.to_socket_addrs()? {
        let left = until.saturating_duration_since(Instant::now()).max(RETRY);
        last = TcpStream::connect_timeout(&address, left);
        if last.is_ok() {
            break;
        }
    }
    last
}

/// Accepts a connection of a later rank, without waiting for one. Others are closed.
fn accept(listener: &TcpListener, rank: usize, ranks: usize) -> io::Result<(usize, TcpStream)> {
    listener.set_nonblocking(true)?;
    let (mut stream, _) = listener.accept()?;
    stream.set_nonblocking(false)?;
    stream.set_read_timeout(Some(Duration::from_secs(1)))?;
    let mut said = [0; 24];
    stream.read_exact(&mut said)?;
    match (rank + 1..ranks).find(|other| said == greeting(*other, ranks)) {
        Some(other) => Ok((other, stream)),
        None => Err(ErrorKind::InvalidData.into()),
    }
}

impl Peer {
    fn new(incoming: TcpStream, timeout: Duration, ranks: usize) -> io::Result<Self> {
        incoming.set_nodelay(true)?;
        let mut stream = incoming.try_clone()?;
        let (outgoing, messages) = channel::<Vec<u8>>();
        let (ends, written) = channel();
        // It ends with the sender. If the connection breaks, the reader notices.
        let write = move || {
            let _ends: Sender<Infallible> = ends;
            drop(messages.iter().try_for_each(|message| stream.write_all(&message)));
        };
        let (outgoing, writer) = (Some(outgoing), Some(std::thread::spawn(write)));
        let mut peer = Peer { incoming, outgoing, writer, written, patience: Duration::ZERO };
        peer.set_timeout(timeout, ranks)?;
        Ok(peer)
    }

    /// At the end the other rank has the time to read a message of each of the others.
    fn set_timeout(&mut self, timeout: Duration, ranks: usize) -> io::Result<()> {
        let timeout = timeout.clamp(SHORTEST, LONGEST);
        self.patience = timeout.saturating_mul(u32::try_from(ranks).unwrap_or(u32::MAX)).min(LONGEST);
        self.incoming.set_read_timeout(Some(timeout))
    }

    fn receive(&mut self) -> io::Result<Vec<u8>> {
        let mut len = [0; 8];
        self.incoming.read_exact(&mut len)?;
        let (len, mut message) = (u64::from_le_bytes(len), vec![]);
        if (&self.incoming).take(len).read_to_end(&mut message)? as u64 != len {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        Ok(message)
    }
}

impl Exchange for Tcp {
    fn rank(&self) -> usize {
        self.rank
    }

    fn ranks(&self) -> usize {
        self.peers.len()
    }

    fn all_to_all(&mut self, parts: &[&[u8]]) -> Result<Vec<Vec<u8>>, ExchangeError> {
        next_round(self, parts, Self::round, |own| &mut own.failed)
    }

    fn set_timeout(&mut self, timeout: Duration) {
        self.timeout = timeout;
        // A connection that refuses it has ended, which the next exchange finds.
        let ranks = self.peers.len();
        self.peers.iter_mut().flatten().for_each(|peer| drop(peer.set_timeout(timeout, ranks)));
    }

    fn sent_bytes(&self) -> u64 {
        self.sent
    }
}

impl Tcp {
    fn round(&mut self, parts: &[&[u8]]) -> Result<Vec<Vec<u8>>, ExchangeError> {
        // Ranks after this one come first, so that not all send to rank 0 at a time.
        let (rank, ranks) = (self.rank, self.ranks());
        for to in (rank + 1..rank + ranks).map(|to| to % ranks) {
            let (Some(peer), part) = (&self.peers[to], parts[to]) else { continue };
            let message = [&(part.len() as u64).to_le_bytes(), part].concat();
            self.sent += part.len() as u64;
            // A rank that has ended is found below.
            let _ = peer.outgoing.as_ref().map(|outgoing| outgoing.send(message));
        }
        let after = self.timeout;
        let receive = |(rank, peer): (usize, &mut Option<Peer>)| {
            let Some(peer) = peer else { return Ok(parts[rank].to_vec()) };
            peer.receive().map_err(|error| match error.kind() {
                ErrorKind::WouldBlock | ErrorKind::TimedOut => ExchangeError::TimedOut { rank, after },
                ErrorKind::UnexpectedEof => ExchangeError::Lost { rank, what: "it has closed its connection".into() },
                _ => ExchangeError::Lost { rank, what: error.to_string() },
            })
        };
        let received = self.peers.iter_mut().enumerate().map(receive).collect::<Result<_, _>>();
        if received.is_err() {
            // Of a failed exchange nobody needs the last messages.
            self.peers.iter_mut().flatten().for_each(|peer| peer.patience = peer.patience.min(after));
        }
        received
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIMEOUT: Duration = Duration::from_secs(20);

    /// Runs ranks on threads, each with its connections, and returns their results.
    fn on_ranks<R: Send>(count: usize, timeout: Duration, run: impl Fn(Tcp) -> R + Sync) -> Vec<R> {
        let listeners: Vec<_> = (0..count).map(|_| TcpListener::bind("127.0.0.1:0").unwrap()).collect();
        let addresses: Vec<_> = listeners.iter().map(|listener| listener.local_addr().unwrap()).collect();
        std::thread::scope(|scope| {
            let start = |(rank, listener)| {
                let (run, addresses) = (&run, &addresses);
                scope.spawn(move || run(Tcp::with_listener(rank, listener, addresses, timeout).unwrap()))
            };
            let ranks: Vec<_> = listeners.into_iter().enumerate().map(start).collect();
            ranks.into_iter().map(|rank| rank.join().unwrap()).collect()
        })
    }

    #[test]
    fn large_messages_cross_and_stay_in_order() {
        let message = |from: usize, to: usize, round: usize| vec![(10 * from + to + round) as u8; 3_000_000 * round];
        on_ranks(3, TIMEOUT, |mut tcp| {
            for round in 0..3 {
                let parts: Vec<Vec<u8>> = (0..3).map(|to| message(tcp.rank(), to, round)).collect();
                let parts: Vec<&[u8]> = parts.iter().map(|part| &part[..]).collect();
                let expected: Vec<_> = (0..3).map(|from| message(from, tcp.rank(), round)).collect();
                assert!(tcp.all_to_all(&parts).unwrap() == expected, "round {round}");
            }
            assert_eq!(tcp.sent_bytes(), 2 * 3_000_000 * 3);
        });
    }

    #[test]
    fn timeouts_of_any_length_are_kept() {
        on_ranks(2, Duration::MAX, |mut tcp| {
            tcp.all_gather(&[1]).unwrap();
            if tcp.rank() == 0 {
                tcp.set_timeout(Duration::ZERO);
                let start = Instant::now();
                tcp.all_gather(&[2]).unwrap_err();
                assert!(start.elapsed() < Duration::from_secs(2), "{:?}", start.elapsed());
            } else {
                // Rank 0 gives up before this connection ends.
                std::thread::sleep(Duration::from_secs(3));
            }
        });
    }

    #[test]
    fn ranks_that_end_or_hang_are_named() {
        let errors = on_ranks(3, TIMEOUT, |mut tcp| {
            tcp.all_gather(&[1]).unwrap();
            if tcp.rank() == 1 { None } else { Some(tcp.all_gather(&[2]).unwrap_err().to_string()) }
        });
        assert!(errors[0].as_deref().unwrap().starts_with("rank 1 has ended"), "{errors:?}");
        let (hold, held) = channel::<()>();
        let held = std::sync::Mutex::new(Some(held));
        let hold = std::sync::Mutex::new(Some(hold));
        let errors = on_ranks(2, Duration::from_secs(1), |mut tcp| {
            if tcp.rank() == 1 {
                // Stays until rank 0 has given up.
                let held = held.lock().unwrap().take().unwrap();
                let _ = held.recv();
                return None;
            }
            let error = tcp.all_gather(&[2]).unwrap_err();
            drop(hold.lock().unwrap().take());
            Some(error)
        });
        assert_eq!(errors[0], Some(ExchangeError::TimedOut { rank: 1, after: Duration::from_secs(1) }));
    }

    #[test]
    fn strangers_are_ignored_and_last_messages_arrive() {
        let listeners: Vec<_> = (0..2).map(|_| TcpListener::bind("127.0.0.1:0").unwrap()).collect();
        let addresses: Vec<_> = listeners.iter().map(|listener| listener.local_addr().unwrap()).collect();
        let mut stranger = TcpStream::connect(addresses[0]).unwrap();
        stranger.write_all(&[7; 24]).unwrap();
        // A rank of a job of three.
        TcpStream::connect(addresses[0]).unwrap().write_all(&greeting(1, 3)).unwrap();
        let start = |(rank, listener): (usize, TcpListener)| {
            let addresses = addresses.clone();
            std::thread::spawn(move || {
                let mut tcp = Tcp::with_listener(rank, listener, &addresses, TIMEOUT).unwrap();
                // Rank 1 sends much, receives nothing, and ends.
                let part = vec![1; if rank == 1 { 20_000_000 } else { 0 }];
                tcp.all_gather(&part).unwrap()[1].len()
            })
        };
        let ranks: Vec<_> = listeners.into_iter().enumerate().map(start).collect();
        ranks.into_iter().for_each(|rank| assert_eq!(rank.join().unwrap(), 20_000_000));
    }

    /// Rank 2 reads the message of rank 0, which takes longer than the timeout, before that of rank 1.
    #[test]
    fn messages_wait_for_ranks_that_are_busy_with_others() {
        let timeout = Duration::from_millis(800);
        let listeners: Vec<_> = (0..3).map(|_| TcpListener::bind("127.0.0.1:0").unwrap()).collect();
        let addresses: Vec<_> = listeners.iter().map(|listener| listener.local_addr().unwrap()).collect();
        let mut listeners = listeners.into_iter();
        let slow = listeners.next().unwrap();
        let slow = std::thread::spawn(move || {
            let mut streams: Vec<_> =
                (0..2).map(|_| retry(Instant::now() + TIMEOUT, || accept(&slow, 0, 3)).unwrap()).collect();
            for (_, stream) in &mut streams {
                stream.write_all(&9_u64.to_le_bytes()).unwrap();
            }
            // Two writes that time out have made some progress, so a timeout would end the third.
            for _ in 0..9 {
                for (rank, stream) in &mut streams {
                    if *rank == 1 { stream.write_all(&[0; 9]).unwrap() } else { stream.write_all(&[0]).unwrap() }
                }
                streams.retain(|(rank, _)| *rank == 2);
                std::thread::sleep(timeout / 2);
            }
            std::thread::sleep(TIMEOUT / 20);
        });
        let ranks = listeners.enumerate().map(|(i, listener)| {
            let addresses = addresses.clone();
            std::thread::spawn(move || {
                let mut tcp = Tcp::with_listener(i + 1, listener, &addresses, timeout).unwrap();
                let part = vec![1; if i == 0 { 20_000_000 } else { 0 }];
                let length = tcp.all_to_all(&[&[], &part, &part]).map(|parts| parts[1].len());
                // The exchange is still in use.
                std::thread::sleep(5 * timeout);
                length
            })
        });
        let lengths: Vec<_> = ranks.collect::<Vec<_>>().into_iter().map(|rank| rank.join().unwrap()).collect();
        assert_eq!(lengths, [Ok(20_000_000), Ok(20_000_000)]);
        slow.join().unwrap();
    }

    #[test]
    fn messages_that_end_early_are_lost() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let addresses = [listener.local_addr().unwrap(); 2];
        // It promises 100 bytes, and ends after 3.
        let mut peer = TcpStream::connect(addresses[0]).unwrap();
        peer.write_all(&greeting(1, 2)).unwrap();
        peer.write_all(&[100, 0, 0, 0, 0, 0, 0, 0, 1, 2, 3]).unwrap();
        peer.shutdown(Shutdown::Write).unwrap();
        let mut tcp = Tcp::with_listener(0, listener, &addresses, TIMEOUT).unwrap();
        let what = "it has closed its connection".to_owned();
        assert_eq!(tcp.all_gather(&[]), Err(ExchangeError::Lost { rank: 1, what }));
    }

    #[test]
    fn absent_ranks_are_named() {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = listener.local_addr().unwrap();
        let alone = Tcp::with_listener(0, listener, &[address, address], Duration::from_millis(50)).unwrap_err();
        assert!(alone.to_string().contains("cannot reach rank 1 within"), "{alone}");
        // Nobody listens at a port that has just been closed.
        let closed = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
        let alone = Tcp::connect(1, &[&closed, "127.0.0.1:0"], Duration::from_millis(50)).unwrap_err();
        assert!(alone.to_string().contains("rank 1 cannot reach rank 0"), "{alone}");
    }
}
