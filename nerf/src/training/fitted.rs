//! Alignment of held-out cameras to a trained model.

use super::trainer::Trainer;
use crate::camera::Camera;
use crate::dataset::Dataset;
use crate::model::{CameraOptimizerConfig, Config, Model, POSES, SceneBox};
use crate::{Error, Result};
use raygrad_autograd::Tensor;
use raygrad_nn::Schedule;
use std::sync::Arc;
use std::time::Duration;

/// Optimization steps, for all images together.
const STEPS: u64 = 400;
/// The learning-rate schedule of poses, in radians of image motion.
const RATE: Schedule = Schedule::Exponential { from: 2e-3, to: 2e-5, warmup: 0.0 };

/// Refines the poses of held-out images against a fixed model and returns their cameras.
///
/// Exposures and appearance embeddings are the means of the training images.
///
/// This is the test-time pose optimization of Lin et al. 2021, "BARF", section 4.2. It starts at the given poses. An
/// evaluation after it uses images to which six numbers each were fitted.
///
/// # Errors
/// If there is no image, or no image shows the scene.
pub fn fitted_cameras(model: &Model<f32>, photographs: Dataset) -> Result<Vec<Camera>> {
    let photographs = Arc::new(photographs);
    let mut trainer = trainer(model, &photographs)?;
    for step in 0..STEPS {
        trainer.step(step as f64 / STEPS as f64);
    }
    let frames = photographs.frames.iter().enumerate();
    Ok(frames.map(|(i, frame)| trainer.model.learned_camera(i, &frame.camera)).collect())
}

/// A trainer of the poses alone.
fn trainer(model: &Model<f32>, photographs: &Arc<Dataset>) -> Result<Trainer> {
    let config = Config {
        poses: Some(RATE),
        camera_optimizer: CameraOptimizerConfig::default(),
        loss_terms: vec![],
        groups: vec![],
        gradient_scaling_distance: 0.0,
        ..model.config.clone()
    };
    // Parameters per training image have other shapes for other numbers of images.
    let more = SceneBox { frames: photographs.frames.len() + 1, ..model.scene_box };
    let more = Model::<f32>::new(config.clone(), more, 0)?.params;
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
        let is_common = more.find(&name).is_some_and(|id| more.get(id).shape() == shape);
        *params.get_mut(id) = if is_common { known.clone() } else { mean_rows(known, &shape) };
    }
    params.freeze(|name| name != POSES);
    trainer.model.copy_sampler_state(model)?;
    if let Some(marching) = trainer.model.marching_mut() {
        // The steps of the end of training.
        marching.progress = 1.0;
    }
    trainer.model.set_detail(model.detail());
    trainer.is_fixed = true;
    Ok(trainer)
}

/// The mean of the rows, repeated for each row of `shape`.
fn mean_rows(rows: &Tensor<f32>, shape: &[usize]) -> Tensor<f32> {
    let width = shape[1..].iter().product::<usize>();
    let count = rows.as_slice().len() / width;
    let mean = |k: usize| rows.as_slice().iter().skip(k).step_by(width).sum::<f32>() / count as f32;
    let mean: Vec<f32> = (0..width).map(mean).collect();
    Tensor::from_fn(shape, |i| mean[i % width])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Rays;
    use crate::component::ComponentConfig;
    use crate::dataset::{Split, sample::ball};
    use crate::field::InstantConfig;
    use crate::model::{Preset, RefinedParam};
    use crate::random::Jitter;
    use crate::sampling::hierarchical::HierarchicalConfig;
    use crate::sampling::marching::MarchingConfig;
    use crate::sampling::proposal::ProposalConfig;
    use crate::sampling::{SamplerConfig, Samplers};

    /// As many images as in training are others nevertheless; and the model samples as it was trained to.
    #[test]
    fn fitting_keeps_the_model() {
        let (batch, tile) = (32, 32);
        fitting_keeps_the_model_with(ProposalConfig { batch, tile, ..ProposalConfig::default() });
        fitting_keeps_the_model_with(HierarchicalConfig { batch, tile, ..HierarchicalConfig::default() });
        let last_step = Some(0.25 * MarchingConfig::default().step);
        fitting_keeps_the_model_with(MarchingConfig { samples: 1024, last_step, ..MarchingConfig::default() });
    }

    fn fitting_keeps_the_model_with(sampler: impl ComponentConfig<Samplers>) {
        let (data, sampler) = (Arc::new(ball(Split::Train, 8)), SamplerConfig::new(sampler));
        let mut config = Config { sampler, ..Config::preset(Preset::Instant).with_refined(&[RefinedParam::Exposure]) };
        config.field.get_mut::<InstantConfig>().unwrap().grid.log2_table = 12;
        if let Some(marching) = config.sampler.get_mut::<MarchingConfig>() {
            marching.occupancy.resolution = 16;
        }
        let mut model = Trainer::new(config, data.clone()).unwrap().model;
        let exposure = model.params.find("exposure").unwrap();
        let gains = model.params.get(exposure).len();
        model.params.get_mut(exposure).as_mut_slice().iter_mut().enumerate().for_each(|(i, gain)| *gain = i as f32);
        model.set_detail(0.25);
        model.marching_mut().into_iter().for_each(|marching| marching.progress = 1.0);
        model.finish();
        let mut trainer = trainer(&model, &data).unwrap();
        trainer.step(0.0);
        let fitted = &trainer.model;
        assert_eq!(fitted.detail(), 0.25);
        // The mean of 0, 3, 6 ... in the first column.
        let mean = (gains as f32 - 3.0) / 2.0;
        let exposure = fitted.params.find("exposure").unwrap();
        assert_eq!(fitted.params.get(exposure).as_slice()[..4], [mean, mean + 1.0, mean + 2.0, mean]);
        let mut rays = Rays::new();
        rays.push_pixel(&data.frames[0].camera, [4, 4], model.scene_box.bounds, model.scene_box.near_far);
        let places = |model: &Model<f32>| model.samples(&rays, &mut Jitter::Middle).pop().unwrap().t;
        assert_eq!(places(&model), places(fitted));
    }
}
