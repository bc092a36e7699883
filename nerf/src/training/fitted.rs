//! Where photographs were taken from that a model was not trained on.

use super::trainer::Trainer;
use crate::camera::Camera;
use crate::dataset::Dataset;
use crate::model::{CameraOptimizerConfig, Config, Model, POSES};
use crate::{Error, Result};
use raygrad_autograd::Tensor;
use raygrad_nn::Schedule;
use std::sync::Arc;
use std::time::Duration;

/// Steps that are taken with all photographs together.
const STEPS: u64 = 400;
/// The learning rate of poses: of the radians by which what a photograph shows moves.
const RATE: Schedule = Schedule::Exponential { from: 2e-3, to: 2e-5, warmup: 0.0 };

/// The cameras of these photographs, each moved to where the model shows what its photograph does, as nearly as can be found
/// from where they are given: the test-time optimisation of poses of Lin et al. 2021, "BARF", section 4.2. Nothing of the model
/// changes. Of a photograph that is compared with the model afterwards, this takes six numbers.
///
/// # Errors
/// If there is no photograph, or none of them shows the scene.
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
    // No time is measured.
    let mut trainer = Trainer::with_clock(config, photographs.clone(), model.scene_box, || Duration::ZERO)?;
    let params = &mut trainer.model.params;
    let ids: Vec<_> = params.ids().filter(|id| params.name(*id) != POSES).collect();
    for id in ids {
        let name = params.name(id).to_owned();
        let Some(known) = model.params.find(&name).map(|id| model.params.get(id)) else {
            return Err(Error::setting(name, "is no parameter of the model"));
        };
        let shape = params.get(id).shape().to_vec();
        // What is known of each of its own photographs is the mean for others.
        let value = if known.shape() == shape { known.clone() } else { mean_rows(known, &shape) };
        *params.get_mut(id) = value;
    }
    params.freeze(|name| name != POSES);
    trainer.model.sampler = model.sampler.boxed();
    if let Some(marching) = trainer.model.marching_mut() {
        // What is empty stays so.
        marching.config.occupancy.skip.grid = false;
    }
    for step in 0..STEPS {
        trainer.step(step as f64 / STEPS as f64);
    }
    let frames = photographs.frames.iter().enumerate();
    Ok(frames.map(|(i, frame)| trainer.model.learned_camera(i, &frame.camera)).collect())
}

/// The mean of the rows, as often as that shape has rows.
fn mean_rows(rows: &Tensor<f32>, shape: &[usize]) -> Tensor<f32> {
    let width = shape[1..].iter().product::<usize>();
    let count = rows.as_slice().len() / width;
    let mean = |k: usize| rows.as_slice().iter().skip(k).step_by(width).sum::<f32>() / count as f32;
    let mean: Vec<f32> = (0..width).map(mean).collect();
    Tensor::from_fn(shape, |i| mean[i % width])
}
