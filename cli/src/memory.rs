//! Estimates of the memory for training and renders.

use raygrad::nerf::dataset::{Dataset, Frame};
use raygrad::nerf::{BatchSize, Camera, Error, Result, Trainer, available_memory};

use super::parse::LARGEST;

/// Bytes of the program itself: code, threads, and initialisation in the first step.
const PROGRAM: f64 = 1e8;
/// Bytes per parameter: value, optimizer state, gradient, and a copy of all of it while a checkpoint is written.
const PARAMETER: f64 = 40.0;
/// Bytes per cell of an occupancy grid.
const CELL: f64 = 12.0;
/// Bytes for each sample of a step, on the tape and in gradients that are not yet added up.
const SAMPLE: f64 = 3300.0;

/// Bytes per pixel of a render, with its encoded file.
const RENDERED: f64 = 40.0;
/// Most pixels of a render.
pub const MOST_PIXELS: usize = LARGEST * LARGEST;

/// Estimated bytes of training, images included. `docs/benchmarks/results.md` has the measured values.
pub fn need(trainer: &Trainer, data: &Dataset) -> f64 {
    let model = &trainer.model;
    let cells = model.sampler.grid().map_or(0, |grid| grid.cells());
    let samples = match model.sampler.batch_size() {
        BatchSize::Samples { step, .. } => step,
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

/// Checks the size of renders, before the first one.
///
/// # Errors
///
/// Fails if a render has more than 2^28 pixels, or needs more memory than is free.
pub fn check_renders(cameras: &[Camera]) -> Result<()> {
    let of = |camera: &Camera| (camera.width.saturating_mul(camera.height), [camera.width, camera.height]);
    match cameras.iter().map(of).max() {
        Some((_, size)) => check_render(size, available_memory()),
        None => Ok(()),
    }
}

fn check_render([width, height]: [usize; 2], free: Option<u64>) -> Result<()> {
    let pixels = width.saturating_mul(height);
    if pixels > MOST_PIXELS {
        return Err(Error::setting("size", format!("{width}x{height} pixels are more than the limit of 2^28")));
    }
    let need = pixels as f64 * RENDERED;
    match free.map(|free| free as f64) {
        Some(free) if need > free => {
            let [need, free] = [need, free].map(|bytes| bytes / 1e9);
            let what = format!(
                "a render of {width}x{height} pixels needs {need:.1} GB of memory, but {free:.1} GB are free: use a \
                 smaller size"
            );
            Err(Error::setting("size", what))
        }
        _ => Ok(()),
    }
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
    fn render_beyond_limit_or_memory_is_an_error() {
        let fails = |size, free| check_render(size, free).unwrap_err().to_string();
        assert!(check_render([16_384, 16_384], None).is_ok() && check_render([32_768, 8192], Some(1 << 40)).is_ok());
        let expected = "`size`: 16385x16384 pixels are more than the limit of 2^28";
        assert_eq!(fails([16_385, 16_384], None), expected);
        let expected = "`size`: a render of 8000x5000 pixels needs 1.6 GB of memory, but 1.5 GB are free: use a \
                        smaller size";
        assert_eq!(fails([8000, 5000], Some(1_500_000_000)), expected);
        assert!(check_render([8000, 5000], Some(1_600_000_000)).is_ok() && check_renders(&[]).is_ok());
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
    }
}
