//! Ranks of an MPI job.

use super::{Exchange, ExchangeError, check_parts};
use mpi::Threading;
use mpi::environment::Universe;
use mpi::request::{StaticScope, scope};
use mpi::topology::{Process, SimpleCommunicator};
use mpi::traits::{Communicator, Destination, Equivalence, Source};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

/// Tells another rank that this one is there.
const READY: i32 = 1;
const MESSAGE: i32 = 2;

/// How long to ask for messages without a pause.
const BUSY: Duration = Duration::from_micros(200);
const PAUSE: Duration = Duration::from_micros(50);

/// The ranks of an MPI job, as `mpirun` or `srun` starts them.
///
/// Of each process only the thread that initialises MPI may use it (MPI's level "funneled"). Other threads may compute
/// meanwhile. MPI ends when this value is dropped, which waits for the other ranks.
#[derive(Debug)]
pub struct Mpi {
    /// Ends MPI when it is dropped.
    _universe: Ending,
    thread: ThreadId,
    rank: usize,
    ranks: usize,
    timeout: Duration,
    sent: u64,
}

struct Ending(#[allow(dead_code, reason = "it is dropped")] Universe);

impl std::fmt::Debug for Ending {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Universe")
    }
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
        let (world, thread) = (universe.world(), std::thread::current().id());
        let [rank, ranks] = [world.rank(), world.size()].map(|x| x as usize);
        Ok(Mpi { _universe: Ending(universe), thread, rank, ranks, timeout, sent: 0 })
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

    /// Waits until every rank is here. Until then nothing is sent but one byte that lives for ever: so this can end
    /// early, where MPI could not give a buffer back.
    fn wait_for_all(&self, world: &SimpleCommunicator) -> Result<(), ExchangeError> {
        static BYTE: [u8; 1] = [0];
        let ready: Vec<_> =
            self.others().map(|to| process(world, to).immediate_send_with_tag(StaticScope, &BYTE[..], READY)).collect();
        let (start, mut absent): (_, Vec<usize>) = (Instant::now(), self.others().collect());
        loop {
            absent.retain(|&rank| {
                let is_here = process(world, rank).immediate_probe_with_tag(READY).is_some();
                if is_here {
                    process(world, rank).receive_with_tag::<u8>(READY);
                }
                !is_here
            });
            let waited = start.elapsed();
            match absent.first() {
                None => break,
                Some(&rank) if waited > self.timeout => {
                    ready.into_iter().for_each(std::mem::forget);
                    return Err(ExchangeError::TimedOut { rank, after: self.timeout });
                }
                Some(_) if waited < BUSY => std::thread::yield_now(),
                Some(_) => std::thread::sleep(PAUSE),
            }
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
        check_parts(parts, self.ranks);
        if std::thread::current().id() != self.thread {
            let what = "MPI is used on another thread than the one that initialised it";
            return Err(ExchangeError::Connection(what.into()));
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
                let length = from_rank.probe_with_tag(MESSAGE).count(u8::equivalent_datatype());
                let mut message = vec![0_u8; length as usize];
                from_rank.receive_into_with_tag(&mut message[..], MESSAGE);
                received[from] = message;
            }
            sends.into_iter().for_each(|request| _ = request.wait());
        });
        self.sent += self.others().map(|to| parts[to].len() as u64).sum::<u64>();
        Ok(received)
    }

    fn sent_bytes(&self) -> u64 {
        self.sent
    }
}
