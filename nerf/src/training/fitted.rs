//! Alignment of held-out cameras to a trained model.

use super::trainer::Trainer;
use crate::camera::Camera;
use crate::dataset::Dataset;
use crate::model::{CameraOptimizerConfig, Config, Model, POSES};
use crate::{Error, Result};
use raygrad_autograd::Tensor;
use raygrad_nn::Schedule;
use std::sync::Arc;
use std::time::Duration;

/// Optimization steps, for all images together.
const STEPS: u64 = 400;
/// The learning-rate schedule of poses, in radians of image motion.
const RATE: Schedule = Schedule::Exponential { from: 2e-3, to: 2e-5, warmup: 0.0 };

/// Refines the poses of images against a fixed model and returns their cameras.
///
/// This is the test-time pose optimization of Lin et al. 2021, "BARF", section 4.2. It starts at the given poses. An
/// evaluation after it uses images to which six numbers each were fitted.
///
/// # Errors
/// If there is no image, or no image shows the scene.
pub fn fitted_cameras(model: &Model<f32>, photographs: Dataset) -> Result<Vec<Camera>> {
    let config = Config {
        poses: Some(RATE),
        camera_optimizer: CameraOptimizerConfig::default(),
        loss_terms: vec![],
        groups: vec![],
        gradient_scaling_distance: 0.0,
        ..model.config.clone()
    };
    let photographs = Arc::new(photographs);
    // The clock is not used.
    let mut trainer = Trainer::with_clock(config, photographs.clone(), model.scene_box, || Duration::ZERO)?;
    let params = &mut trainer.model.params;
    let ids: Vec<_> = params.ids().filter(|id| params.name(*id) != POSES).collect();
    for id in ids {
        let name = params.name(id).to_owned();
        let Some(known) = model.params.find(&name).map(|id| model.params.get(id)) else {
            return Err(Error::setting(name, "is missing in the model; use one that was built from its configuration"));
        };
        let shape = params.get(id).shape().to_vec();
        // For other images, parameters per training image become their mean.
        let value = if known.shape() == shape { known.clone() } else { mean_rows(known, &shape) };
        *params.get_mut(id) = value;
    }
    params.freeze(|name| name != POSES);
    trainer.model.sampler = model.sampler.boxed();
    if let Some(marching) = trainer.model.marching_mut() {
        // Empty cells stay empty.
        marching.config.occupancy.skip.grid = false;
    }
    for step in 0..STEPS {
        trainer.step(step as f64 / STEPS as f64);
    }
    let frames = photographs.frames.iter().enumerate();
    Ok(frames.map(|(i, frame)| trainer.model.learned_camera(i, &frame.camera)).collect())
}

/// The mean of the rows, repeated for each row of `shape`.
fn mean_rows(rows: &Tensor<f32>, shape: &[usize]) -> Tensor<f32> {
    let width = shape[1..].iter().product::<usize>();
    let count = rows.as_slice().len() / width;
    let mean = |k: usize| rows.as_slice().iter().skip(k).step_by(width).sum::<f32>() / count as f32;
    let mean: Vec<f32> = (0..width).map(mean).collect();
    Tensor::from_fn(shape, |i| mean[i % width])
}
