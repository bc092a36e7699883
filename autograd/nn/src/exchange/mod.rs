//! Messages between the processes that train one model.

mod frame;
mod in_process;
#[cfg(feature = "mpi")]
mod mpi;
mod simulated;
mod tcp;

pub(crate) use frame::{Frame, Reader};
pub use in_process::InProcess;
#[cfg(feature = "mpi")]
pub use mpi::Mpi;
pub use simulated::{Link, Simulated};
pub use tcp::Tcp;

use std::time::Duration;

/// Messages between processes that train one model, each of which has a rank: 0, 1, and so on. In one process they are
/// threads ([`InProcess`]); over a network they use [`Tcp`] or MPI (`Mpi`, with the feature `mpi`).
///
/// All ranks make the same calls in the same order. [`Tiles::differentiate_across`](crate::Tiles::differentiate_across)
/// uses it to share the tiles of a training step.
///
/// ```
/// use raygrad_nn::{Exchange, InProcess};
/// let ranks = InProcess::ranks(3).into_iter().map(|mut exchange| {
///     std::thread::spawn(move || exchange.all_gather(&[10 * exchange.rank() as u8]))
/// });
/// for rank in ranks.collect::<Vec<_>>() {
///     assert_eq!(rank.join().unwrap().unwrap(), [[0], [10], [20]]);
/// }
/// ```
pub trait Exchange: Send {
    /// The number of this process, from 0.
    fn rank(&self) -> usize;

    /// Number of processes.
    fn ranks(&self) -> usize;

    /// Sends `parts[k]` to rank `k`, and returns what each rank has sent to this one, by rank. The part for this rank
    /// itself comes back too. Waits until all messages are here.
    ///
    /// # Errors
    /// If a rank has ended, or has sent nothing for too long. All further calls return this error.
    ///
    /// # Panics
    /// If there is not one part for each rank.
    fn all_to_all(&mut self, parts: &[&[u8]]) -> Result<Vec<Vec<u8>>, ExchangeError>;

    /// Sends the same bytes to all ranks, and returns those of each rank, by rank.
    ///
    /// # Errors
    /// As [`all_to_all`](Self::all_to_all).
    fn all_gather(&mut self, own: &[u8]) -> Result<Vec<Vec<u8>>, ExchangeError> {
        self.all_to_all(&vec![own; self.ranks()])
    }

    /// Sets how long this rank waits for another one.
    fn set_timeout(&mut self, timeout: Duration);

    /// Bytes that this rank has sent to others so far.
    fn sent_bytes(&self) -> u64;
}

/// The reason that processes cannot work together any more.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ExchangeError {
    /// A rank has ended, or its connection has.
    #[error("rank {rank} has ended: {what}")]
    Lost {
        /// The rank.
        rank: usize,
        /// The reason.
        what: String,
    },
    /// A rank has sent nothing.
    #[error("rank {rank} has sent nothing for {} s; it hangs, or works on something else", after.as_secs())]
    TimedOut {
        /// The rank.
        rank: usize,
        /// How long this rank has waited.
        after: Duration,
    },
    /// A rank has sent what does not belong here.
    #[error("rank {rank} {what}")]
    Differs {
        /// The rank.
        rank: usize,
        /// The difference.
        what: String,
    },
    /// A gradient cannot be sent.
    #[error(
        "the gradient of `{param}` has a sparse contribution that cannot be sent; implement `SparseGrad::to_parts`"
    )]
    NotSent {
        /// The parameter.
        param: String,
    },
    /// The processes cannot be connected.
    #[error("{0}")]
    Connection(String),
}

/// How long ranks wait for one another, unless [`Exchange::set_timeout`] says otherwise.
const TIMEOUT: Duration = Duration::from_secs(600);

/// The first error of an exchange: after it, messages of different rounds could meet.
type FirstError = Option<ExchangeError>;

/// What all ranks have sent to this one, by rank.
type Received = Result<Vec<Vec<u8>>, ExchangeError>;

/// Makes one round of an exchange, unless one before it has failed.
#[track_caller]
fn next_round<E: Exchange>(
    exchange: &mut E,
    parts: &[&[u8]],
    round: fn(&mut E, &[&[u8]]) -> Received,
    failed: fn(&mut E) -> &mut FirstError,
) -> Received {
    assert_eq!(parts.len(), exchange.ranks(), "one part for each rank");
    let result = failed(exchange).clone().map_or_else(|| round(exchange, parts), Err);
    *failed(exchange) = result.as_ref().err().cloned();
    result
}
