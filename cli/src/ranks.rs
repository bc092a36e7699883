//! The ranks of a job that `mpirun` or `srun` has started.
//!
//! Rank 0 alone prints and writes. Training exchanges gradients; frames and views are shared as shards.

use std::cell::RefCell;
use std::process::Command;
use std::sync::OnceLock;
use std::time::Duration;

use raygrad::nerf::{Error, Trainer};
use raygrad::nn::{Exchange, ExchangeError};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::shard::Shard;

/// Variables in which launchers tell the number of processes: Open MPI, MPICH and Intel MPI, MVAPICH.
const COUNTS: [&str; 3] = ["OMPI_COMM_WORLD_SIZE", "PMI_SIZE", "MV2_COMM_WORLD_SIZE"];
/// How long ranks wait for one another before training, while rank 0 may prepare a video, and after renders.
pub const PATIENCE: Duration = Duration::from_secs(7 * 24 * 3600);

/// The rank in a job of `srun --mpi=pmix`.
const RANK: &str = "PMIX_RANK";

/// Rank and number of ranks; unset in a single process.
static OWN: OnceLock<(usize, usize)> = OnceLock::new();

thread_local! {
    /// Of the main thread, which alone may use MPI.
    static EXCHANGE: RefCell<Option<Box<dyn Exchange>>> = const { RefCell::new(None) };
}

/// Number of processes that a launcher has started, this one included.
fn launched(variable: impl Fn(&str) -> Option<String>) -> usize {
    let counted = COUNTS.iter().find_map(|name| variable(name)?.parse().ok());
    // `srun --mpi=pmix` tells the number by Slurm's own variable only.
    let slurm = || variable(RANK).and(variable("SLURM_STEP_NUM_TASKS"))?.parse().ok();
    counted.or_else(slurm).unwrap_or(1)
}

/// Connects the processes of a job; does nothing in a single process. `threads` is whether the number of threads is
/// given.
pub fn start(threads: bool) -> Result<(), Error> {
    let count = launched(|name| std::env::var(name).ok());
    if count > 1 { connect(count, threads) } else { Ok(()) }
}

/// Makes a program that this one starts a single process.
pub fn leave(command: &mut Command) {
    COUNTS.iter().chain(&[RANK]).for_each(|name| _ = command.env_remove(name));
}

#[cfg(not(feature = "mpi"))]
fn connect(count: usize, _: bool) -> Result<(), Error> {
    let what = format!(
        "{count} processes were started together, but this raygrad is built without MPI: build it with `cargo install \
         --path cli --features mpi`, or start one process"
    );
    Err(Error::setting("mpi", what))
}

#[cfg(feature = "mpi")]
fn connect(_: usize, threads: bool) -> Result<(), Error> {
    let mut mpi = raygrad::nn::Mpi::initialize(PATIENCE).map_err(failed)?;
    let _ = OWN.set((mpi.rank(), mpi.ranks()));
    let place = place();
    let places = mpi.all_gather(place.as_bytes()).map_err(failed)?;
    if !threads && std::env::var_os("RAYON_NUM_THREADS").is_none() {
        let sharing = places.iter().filter(|other| **other == place.as_bytes()).count();
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let pool = rayon::ThreadPoolBuilder::new().num_threads((cores / sharing).max(1)).build_global();
        pool.map_err(|e| Error::setting("threads", e))?;
    }
    EXCHANGE.set(Some(Box::new(mpi)));
    Ok(())
}

/// The cores that this process may use: the machine, and Linux's list of them. Processes with the same share them.
#[cfg(feature = "mpi")]
fn place() -> String {
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    let status = read("/proc/self/status");
    let cores = status.lines().find(|line| line.starts_with("Cpus_allowed_list")).unwrap_or_default().to_owned();
    read("/proc/sys/kernel/hostname") + &cores
}

/// The error of a job whose ranks cannot work together.
pub fn failed(error: ExchangeError) -> Error {
    Error::setting("mpi", error)
}

/// Rank and number of ranks; `None` in a single process.
pub fn own() -> Option<(usize, usize)> {
    OWN.get().copied()
}

/// Whether this process is to print and write nothing, since rank 0 does.
pub fn is_silent() -> bool {
    own().is_some_and(|(rank, _)| rank > 0)
}

/// The shard of this rank.
pub fn shard() -> Option<Shard> {
    own().map(|(rank, ranks)| Shard::new(rank + 1, ranks))
}

/// Waits until all ranks are here. Returns whether this is rank 0, or a single process.
pub fn wait() -> Result<bool, Error> {
    EXCHANGE.with_borrow_mut(|exchange| match exchange {
        Some(exchange) => exchange.all_gather(&[]).map_err(failed).map(|_| exchange.rank() == 0),
        None => Ok(true),
    })
}

/// Hands the exchange over to a trainer.
pub fn take() -> Option<Box<dyn Exchange>> {
    EXCHANGE.take()
}

/// Gives all ranks the value of rank 0, which is `Some` there.
pub fn of_first<T: Serialize + DeserializeOwned>(exchange: &mut dyn Exchange, value: Option<&T>) -> Result<T, Error> {
    let broken = |error| {
        Error::setting(
            "mpi",
            format!("rank 0 has sent what this rank cannot read ({error}): use one version of raygrad"),
        )
    };
    let bytes = value.map_or(Ok(vec![]), serde_json::to_vec).map_err(broken)?;
    let bytes = bytes_of_first(exchange, &bytes)?;
    serde_json::from_slice(&bytes).map_err(broken)
}

/// Gives all ranks the bytes of rank 0. Those of others are ignored.
pub fn bytes_of_first(exchange: &mut dyn Exchange, bytes: &[u8]) -> Result<Vec<u8>, Error> {
    /// Bytes of a message. MPI sends less than 2^31.
    const MESSAGE: usize = 1 << 30;
    in_messages(exchange, bytes, MESSAGE)
}

/// [`bytes_of_first`] in messages of this many bytes.
fn in_messages(exchange: &mut dyn Exchange, bytes: &[u8], message: usize) -> Result<Vec<u8>, Error> {
    let bytes = if exchange.rank() == 0 { bytes } else { &[] };
    let mut first = |bytes: &[u8]| Ok::<_, Error>(exchange.all_gather(bytes).map_err(failed)?.swap_remove(0));
    let mut received = first(&bytes.len().to_le_bytes())?;
    let length = received[..].try_into().map(usize::from_le_bytes);
    let length = length.map_err(|_| Error::setting("mpi", "rank 0 has sent what this rank cannot read"))?;
    received.clear();
    while received.len() < length {
        let start = received.len().min(bytes.len());
        let part = first(&bytes[start..bytes.len().min(start + message)])?;
        if part.is_empty() {
            return Err(Error::setting("mpi", "rank 0 has sent less than it announced"));
        }
        received.extend(part);
    }
    Ok(received)
}

/// Whether one of the ranks of a run that has ended was interrupted.
pub fn any_is_interrupted(trainer: &mut Trainer, is_interrupted: bool) -> Result<bool, ExchangeError> {
    if let Some(error) = trainer.exchange_error() {
        return Err(error.clone());
    }
    let Some(exchange) = trainer.exchange_mut() else { return Ok(is_interrupted) };
    let all = exchange.all_gather(&[is_interrupted.into()])?;
    Ok(all.iter().any(|flag| *flag == [1]))
}

/// Ends MPI after work that has not failed.
pub fn finish() {
    #[cfg(feature = "mpi")]
    raygrad::nn::Mpi::finalize();
}

/// Ends all ranks of a job of which this one ends early, since the others would wait for it.
pub fn fail(code: u8) {
    #[cfg(feature = "mpi")]
    if own().is_some() {
        raygrad::nn::Mpi::abort(code.into());
    }
    let _ = code;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_of_the_first_come_in_messages() {
        for length in [0, 1, 6, 7, 8, 20] {
            let sent: Vec<u8> = (0..length).collect();
            std::thread::scope(|scope| {
                for mut rank in raygrad::nn::InProcess::ranks(3) {
                    let sent = &sent;
                    scope.spawn(move || {
                        // What others give is ignored.
                        let own = if rank.rank() == 0 { &sent[..] } else { &[9; 40][..] };
                        assert_eq!(&in_messages(&mut rank, own, 7).unwrap(), sent);
                    });
                }
            });
        }
    }

    #[test]
    fn launchers_tell_the_number_of_processes() {
        let count = |variables: &[(&str, &str)]| {
            launched(|name| variables.iter().find(|(other, _)| *other == name).map(|(_, value)| (*value).to_owned()))
        };
        assert_eq!(count(&[]), 1);
        assert_eq!(count(&[("OMPI_COMM_WORLD_SIZE", "4")]), 4);
        assert_eq!(count(&[("PMI_SIZE", "3"), ("PMI_RANK", "0")]), 3);
        assert_eq!(count(&[("PMIX_RANK", "1"), ("SLURM_STEP_NUM_TASKS", "8")]), 8);
        // A job array has no MPI.
        assert_eq!(count(&[("SLURM_STEP_NUM_TASKS", "8"), ("SLURM_PROCID", "1")]), 1);
        assert_eq!(count(&[("PMI_SIZE", "many")]), 1);
    }
}
