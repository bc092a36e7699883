//! Ranks of an MPI job.

use super::{Exchange, ExchangeError, FirstError, next_round};
use mpi::Threading;
use mpi::environment::Universe;
use mpi::request::{StaticScope, scope};
use mpi::topology::{Process, SimpleCommunicator};
use mpi::traits::{Communicator, Destination, Equivalence, Source};
use std::cell::RefCell;
use std::mem::ManuallyDrop;
use std::time::{Duration, Instant};

/// Tells another rank that this one is there.
const READY: i32 = 1;
const MESSAGE: i32 = 2;

/// How long to ask for messages without a pause.
const BUSY: Duration = Duration::from_micros(200);
const PAUSE: Duration = Duration::from_micros(50);

thread_local! {
    /// MPI, on the thread that has initialised it. Dropping it waits for all ranks, which must not happen where some have
    /// failed.
    static UNIVERSE: RefCell<Option<ManuallyDrop<Universe>>> = const { RefCell::new(None) };
}

/// The ranks of an MPI job, as `mpirun` or `srun` starts them.
///
/// Of each process only the thread that initialises MPI may use it (MPI's level "funneled"). Other threads may compute
/// meanwhile. At its end a process calls [`finalize`](Self::finalize), or [`abort`](Self::abort) if it has failed.
///
/// A rank that hangs while it sends a message ends the job at once, after a line on standard error: MPI cannot give
/// the buffers of such messages back. A rank that hangs elsewhere is an [error](ExchangeError::TimedOut). If it
/// continues after the others have given up, it finds that they receive nothing, and ends the job too.
#[derive(Debug)]
pub struct Mpi {
    rank: usize,
    ranks: usize,
    timeout: Duration,
    sent: u64,
    failed: FirstError,
}

impl Mpi {
    /// Initialises MPI. `timeout` is how long a rank waits for another one.
    ///
    /// # Errors
    /// If MPI was initialised before, or does not allow other threads beside this one.
    pub fn initialize(timeout: Duration) -> Result<Self, ExchangeError> {
        let failed = |what: &str| ExchangeError::Connection(what.into());
        let (universe, threading) = mpi::initialize_with_threading(Threading::Funneled)
            .ok_or_else(|| failed("MPI was initialised before; a process can do so once"))?;
        if threading < Threading::Funneled {
            return Err(failed("this MPI allows no threads; use one built with MPI_THREAD_FUNNELED"));
        }
        let world = universe.world();
        let [rank, ranks] = [world.rank(), world.size()].map(|x| x as usize);
        UNIVERSE.set(Some(ManuallyDrop::new(universe)));
        Ok(Mpi { rank, ranks, timeout, sent: 0, failed: None })
    }

    /// Ends MPI if this thread has initialised it. Waits for the other ranks.
    pub fn finalize() {
        drop(UNIVERSE.take().map(ManuallyDrop::into_inner));
    }

    /// Ends all ranks at once, with this exit code.
    pub fn abort(code: i32) -> ! {
        SimpleCommunicator::world().abort(code)
    }

    fn others(&self) -> impl Iterator<Item = usize> + Clone + use<> {
        let (rank, ranks) = (self.rank, self.ranks);
        // Those after this one first, so that not all send to rank 0 at a time.
        (rank + 1..rank + ranks).map(move |other| other % ranks)
    }

    /// What `look` finds within the timeout.
    fn within_timeout<R>(&self, mut look: impl FnMut() -> Option<R>) -> Option<R> {
        let start = Instant::now();
        loop {
            let (found, waited) = (look(), start.elapsed());
            match found {
                Some(found) => return Some(found),
                None if waited > self.timeout => return None,
                None if waited < BUSY => std::thread::yield_now(),
                None => std::thread::sleep(PAUSE),
            }
        }
    }

    /// Waits until every rank is here. Until then nothing is sent but one byte that lives for ever: so this can end
    /// early, where MPI could not give a buffer back.
    fn wait_for_all(&self, world: &SimpleCommunicator) -> Result<(), ExchangeError> {
        static BYTE: [u8; 1] = [0];
        let ready: Vec<_> =
            self.others().map(|to| process(world, to).immediate_send_with_tag(StaticScope, &BYTE[..], READY)).collect();
        let mut absent: Vec<usize> = self.others().collect();
        let all_are_here = self.within_timeout(|| {
            absent.retain(|&rank| {
                let is_here = process(world, rank).immediate_probe_with_tag(READY).is_some();
                if is_here {
                    process(world, rank).receive_with_tag::<u8>(READY);
                }
                !is_here
            });
            absent.is_empty().then_some(())
        });
        if let (None, Some(&rank)) = (all_are_here, absent.first()) {
            ready.into_iter().for_each(std::mem::forget);
            return Err(ExchangeError::TimedOut { rank, after: self.timeout });
        }
        ready.into_iter().for_each(|request| _ = request.wait());
        Ok(())
    }
}

fn process(world: &SimpleCommunicator, rank: usize) -> Process<'_> {
    world.process_at_rank(rank as i32)
}

impl Exchange for Mpi {
    fn rank(&self) -> usize {
        self.rank
    }

    fn ranks(&self) -> usize {
        self.ranks
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

impl Mpi {
    fn round(&mut self, parts: &[&[u8]]) -> Result<Vec<Vec<u8>>, ExchangeError> {
        let error = |what: &str| Err(ExchangeError::Connection(what.into()));
        if UNIVERSE.with_borrow(Option::is_none) {
            return error("MPI has ended, or is used on another thread than the one that initialised it");
        }
        if parts.iter().any(|part| i32::try_from(part.len()).is_err()) {
            return error("MPI cannot send a message of 2 GB or more; use more tiles or a smaller model");
        }
        let world = SimpleCommunicator::world();
        self.wait_for_all(&world)?;
        let mut received = vec![vec![]; self.ranks];
        received[self.rank] = parts[self.rank].to_vec();
        scope(|scope| {
            let send = |to: usize| process(&world, to).immediate_send_with_tag(scope, parts[to], MESSAGE);
            let sends: Vec<_> = self.others().map(send).collect();
            for from in self.others() {
                let from_rank = process(&world, from);
                let Some(status) = self.within_timeout(|| from_rank.immediate_probe_with_tag(MESSAGE)) else {
                    self.give_up(from);
                };
                let mut message = vec![0_u8; status.count(u8::equivalent_datatype()) as usize];
                from_rank.receive_into_with_tag(&mut message[..], MESSAGE);
                received[from] = message;
            }
            for (request, to) in sends.into_iter().zip(self.others()) {
                let mut request = Some(request);
                let is_sent = self.within_timeout(|| match request.take()?.test() {
                    Ok(_) => Some(()),
                    Err(waiting) => {
                        request = Some(waiting);
                        None
                    }
                });
                if is_sent.is_none() {
                    self.give_up(to);
                }
            }
        });
        self.sent += self.others().map(|to| parts[to].len() as u64).sum::<u64>();
        Ok(received)
    }

    /// Ends the job because a rank has stopped within a message.
    fn give_up(&self, rank: usize) -> ! {
        let error = ExchangeError::TimedOut { rank, after: self.timeout };
        eprintln!("raygrad: rank {}: {error}; the job is aborted", self.rank);
        Mpi::abort(1);
    }
}
