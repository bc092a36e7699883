//! What training takes of memory, said before it is taken.

use raygrad::nerf::dataset::{Dataset, Frame};
use raygrad::nerf::{Load, Trainer};

use super::machine;

/// Bytes that the program takes whatever it does: code, threads, what the first step sets up.
const PROGRAM: f64 = 1e8;
/// Bytes for each parameter: itself, what the optimiser remembers of it, its gradient, and all of that once more while a checkpoint is
/// written.
const PARAMETER: f64 = 40.0;
/// Bytes for each cell of an occupancy grid.
const CELL: f64 = 12.0;
/// Bytes for each sample of a step, on the tape and in gradients that are not yet added up.
const SAMPLE: f64 = 3300.0;

/// About how many bytes training takes, photographs and all: within a quarter, by `docs/benchmarks.md`.
pub fn need(trainer: &Trainer, data: &Dataset) -> f64 {
    let model = &trainer.model;
    let cells = model.sampler.grid().map_or(0, |grid| grid.cells());
    let samples = match model.sampler.load() {
        Load::Samples(samples) => samples,
        // Tapes of a few rays.
        Load::Rays { .. } => 0,
    };
    let photographs: f64 = data.frames.iter().map(bytes).sum();
    let parts = [(model.params.elements(), PARAMETER), (cells, CELL), (samples, SAMPLE)]
        .map(|(count, each)| count as f64 * each);
    PROGRAM + photographs + parts.iter().sum::<f64>()
}

/// Bytes of a photograph and of what was measured beside it.
fn bytes(frame: &Frame) -> f64 {
    let image = &frame.image;
    let distances = if frame.distances.is_some() { 4 } else { 0 };
    (image.width * image.height * (image.channels + distances)) as f64
}

/// Bytes that are free for programs, where the system says it: of the machine, or of the group that this one runs in.
pub fn available() -> Option<f64> {
    let group = || {
        let read =
            |name: &str| std::fs::read_to_string(format!("/sys/fs/cgroup/{name}")).ok()?.trim().parse::<f64>().ok();
        Some(read("memory.max")? - read("memory.current")?)
    };
    let machine = machine::available_memory().map(|bytes| bytes as f64);
    [machine, group()].into_iter().flatten().reduce(f64::min)
}
