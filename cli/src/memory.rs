//! Estimates of the memory for training.

use raygrad::nerf::dataset::{Dataset, Frame};
use raygrad::nerf::{BatchSize, Trainer};

use super::machine;

/// Bytes of the program itself: code, threads, and initialisation in the first step.
const PROGRAM: f64 = 1e8;
/// Bytes per parameter: value, optimizer state, gradient, and a copy of all of it while a checkpoint is written.
const PARAMETER: f64 = 40.0;
/// Bytes per cell of an occupancy grid.
const CELL: f64 = 12.0;
/// Bytes per sample of a step, on the tape and in gradients that are not summed yet.
const SAMPLE: f64 = 3300.0;

/// Estimated bytes of training, images included. `docs/benchmarks/results.md` has the measured values.
pub fn need(trainer: &Trainer, data: &Dataset) -> f64 {
    let model = &trainer.model;
    let cells = model.sampler.grid().map_or(0, |grid| grid.cells());
    let samples = match model.sampler.batch_size() {
        BatchSize::Samples(samples) => samples,
        // The tape of a few rays is negligible.
        BatchSize::Rays { .. } => 0,
    };
    let photographs: f64 = data.frames.iter().map(bytes).sum();
    let parts = [(model.params.elements(), PARAMETER), (cells, CELL), (samples, SAMPLE)]
        .map(|(count, each)| count as f64 * each);
    PROGRAM + photographs + parts.iter().sum::<f64>()
}

/// Bytes of an image and of its measured depths.
fn bytes(frame: &Frame) -> f64 {
    (frame.image.bytes() + frame.distances.as_ref().map_or(0, |distances| 4 * distances.data.len())) as f64
}

/// Free bytes of the machine or of the cgroup, whichever is less, if the system reports them.
pub fn available() -> Option<f64> {
    let group = || {
        let read =
            |name: &str| std::fs::read_to_string(format!("/sys/fs/cgroup/{name}")).ok()?.trim().parse::<f64>().ok();
        Some((read("memory.max")? - read("memory.current")?).max(0.0))
    };
    let machine = machine::available_memory().map(|bytes| bytes as f64);
    [machine, group()].into_iter().flatten().reduce(f64::min)
}

/// The warning if training needs more bytes than are free.
pub fn shortage(need: f64, free: f64) -> Option<String> {
    let [needed, left] = [need, free].map(|bytes| bytes / 1e9);
    (need > free).then(|| {
        format!(
            "warning: training needs about {needed:.1} GB of memory, but {left:.1} GB are free: use --downscale, or \
             lower field.grid.log2_table or sampler.samples with --set"
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::dataset::Split;
    use raygrad::nerf::sampling::marching::MarchingConfig;
    use raygrad::nerf::{Config, InstantConfig, Preset};
    use raygrad_scenes::embedded;
    use std::sync::Arc;

    #[test]
    fn shortage_needing_more_gives_warning() {
        assert_eq!(shortage(1e9, 1e9), None);
        let said = shortage(3.26e9, 2.5e9).unwrap();
        assert!(said.contains("about 3.3 GB of memory, but 2.5 GB are free"), "{said}");
    }

    #[test]
    fn need_grows_with_each_component() {
        let need = |width: usize, table: u32, resolution: usize, samples: usize| {
            let mut config = Config::preset(Preset::Instant);
            if let Some(field) = config.field.get_mut::<InstantConfig>() {
                (field.grid.levels, field.grid.log2_table) = (2, table);
            }
            if let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() {
                (sampler.occupancy.resolution, sampler.samples) = (resolution, samples);
            }
            let data = Arc::new(embedded(Split::Train, width));
            let trainer = Trainer::new(config, data.clone()).unwrap();
            (need(&trainer, &data), trainer.model.params.elements() as f64)
        };
        let (least, elements) = need(8, 8, 16, 1024);
        let least_of = |other: (f64, f64)| other.0 - least;
        let pixels = 60.0 * (16.0 * 16.0 - 8.0 * 8.0);
        // Four channels of single precision.
        assert!((least_of(need(16, 8, 16, 1024)) / pixels - 16.0).abs() < 0.01);
        let (more, all) = need(8, 12, 16, 1024);
        assert!(all > elements && (more - least - PARAMETER * (all - elements)).abs() < 1.0);
        assert!((least_of(need(8, 8, 32, 1024)) - CELL * (32.0_f64.powi(3) - 16.0_f64.powi(3))).abs() < 1.0);
        assert!((least_of(need(8, 8, 16, 3072)) - SAMPLE * 2048.0).abs() < 1.0);
        assert!(least > PROGRAM && available().is_none_or(|free| free > 0.0));
    }
}
