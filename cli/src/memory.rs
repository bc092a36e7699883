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
/// Bytes for each pixel of an image that is read.
const PIXEL: f64 = 3.0;
/// Bytes of images that raygrad warns of if the free memory is unknown.
const HEAVY: f64 = 4e9;
/// Largest factor of `--downscale`.
const MOST_DOWNSCALE: usize = 1 << 14;
/// Bytes for each sample of a step, on the tape and in gradients that are not yet added up.
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

/// The warning if `count` images need more bytes than are free, or more than many computers have. `pixels` is their
/// number at full size, and `--downscale` divides both sides.
pub fn image_shortage(count: usize, pixels: f64, downscale: usize, free: Option<f64>) -> Option<String> {
    let bytes = |downscale: usize| PIXEL * pixels / (downscale as f64).powi(2);
    let limit = free.unwrap_or(HEAVY);
    if bytes(downscale) <= limit {
        return None;
    }
    let enough = (downscale..=MOST_DOWNSCALE).find(|k| bytes(*k) <= 0.5 * limit).unwrap_or(downscale);
    let [needed, less] = [downscale, enough].map(|downscale| bytes(downscale) / 1e9);
    let left = free.map_or("the free memory is unknown".to_owned(), |free| format!("{:.1} GB are free", free / 1e9));
    Some(format!(
        "warning: {count} images need about {needed:.1} GB of memory, but {left}: --downscale {enough} needs {less:.1} \
         GB"
    ))
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
        let expected = "warning: training needs about 3.3 GB of memory, but 2.5 GB are free: use --downscale, or lower \
                        field.grid.log2_table or sampler.samples with --set";
        assert_eq!(shortage(3.26e9, 2.5e9).as_deref(), Some(expected));
    }

    #[test]
    fn image_warning_names_a_sufficient_downscale() {
        // 100 images of 10 by 10 thousand pixels: 30 GB, and 7.5, 3.33 and 1.875 at a half, a third and a quarter.
        let warning = |downscale, free| image_shortage(100, 1e10, downscale, free);
        let expected = "warning: 100 images need about 30.0 GB of memory, but 8.0 GB are free: --downscale 3 needs 3.3 \
                        GB";
        assert_eq!(warning(1, Some(8e9)).as_deref(), Some(expected));
        let expected = "warning: 100 images need about 7.5 GB of memory, but 7.0 GB are free: --downscale 3 needs 3.3 \
                        GB";
        assert_eq!(warning(2, Some(7e9)).as_deref(), Some(expected));
        let expected = "warning: 100 images need about 7.5 GB of memory, but the free memory is unknown: --downscale 4 \
                        needs 1.9 GB";
        assert_eq!(warning(2, None).as_deref(), Some(expected));
        assert_eq!([warning(1, Some(3e10)), warning(2, Some(7.5e9)), warning(3, None)], [None, None, None]);
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
        assert!(all > elements && (more - least - 40.0 * (all - elements)).abs() < 1.0);
        assert!((least_of(need(8, 8, 32, 1024)) - 12.0 * (32.0_f64.powi(3) - 16.0_f64.powi(3))).abs() < 1.0);
        assert!((least_of(need(8, 8, 16, 3072)) - 3300.0 * 2048.0).abs() < 1.0);
        let whole = 1e8 + 60.0 * 64.0 * 16.0 + 40.0 * elements + 12.0 * 4096.0 + 3300.0 * 1024.0;
        assert!((least - whole).abs() < 1.0, "{least} {whole}");
        assert!(available().is_none_or(|free| free > 0.0));
    }
}
