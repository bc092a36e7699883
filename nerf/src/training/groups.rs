//! Parameter groups, each with its own optimizer settings, schedule and weight decay.

use crate::model::config::Config;
use crate::model::{EXPOSURE, FOCAL, LENS, POSES, VIGNETTING};
use crate::{Error, Result};
use raygrad_autograd::Gradient;
use raygrad_nn::{Adam, AdamConfig, Optimizer, OptimizerState, Params, Schedule, StateError, UpdateReport};

/// Parameters of cameras and exposure; each has its own schedule.
const CAMERAS: [&str; 5] = [POSES, FOCAL, LENS, EXPOSURE, VIGNETTING];

/// The optimizer of all parameters.
///
/// A parameter belongs to the first configured group that matches its name. Otherwise it belongs to that of its camera
/// parameter, of the tables (updated by rows), or of the rest.
pub(crate) struct Groups {
    adam: Adam<f32>,
    /// The schedule of each group, by the optimizer's numbering.
    schedules: Vec<Schedule>,
}

impl Groups {
    /// Creates the groups of these parameters, at step 0.
    ///
    /// # Errors
    /// If a configured group has no parameter.
    pub fn new(config: &Config, params: &Params<f32>) -> Result<Self> {
        let mut groups = Groups { adam: Adam::new(config.adam), schedules: vec![config.schedule] };
        for group in &config.groups {
            let fits = |name: &str| name.starts_with(&group.params);
            if groups.add(params, fits, group.adam, group.weight_decay, group.schedule) == 0 {
                let names: Vec<&str> = params.names().collect();
                let names = names.join(", ");
                let what = format!("matches no parameter outside of earlier groups; use a prefix of one of {names}");
                return Err(Error::setting(format!("groups.{}", group.params), what));
            }
        }
        for camera in CAMERAS {
            if let Some(schedule) = config.camera_rate(camera) {
                groups.add(params, |name| name == camera, config.adam, 0.0, schedule);
            }
        }
        let is_table = |name: &str| params.find(name).is_some_and(|id| params.is_lazy(id));
        groups.add(params, is_table, config.table_adam, 0.0, config.schedule);
        Ok(groups)
    }

    /// Adds a group of the parameters that `which` selects and no other group has; returns their number.
    fn add(
        &mut self,
        params: &Params<f32>,
        which: impl Fn(&str) -> bool,
        adam: AdamConfig,
        decay: f64,
        schedule: Schedule,
    ) -> usize {
        self.schedules.push(schedule);
        self.adam.add_group(params, which, adam, decay)
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.adam.steps()
    }

    /// The optimizer's state as bytes.
    ///
    /// # Errors
    /// If the format cannot hold it.
    pub fn state(&self, params: &Params<f32>) -> Result<Vec<u8>> {
        self.adam.state(params).to_safetensors().map_err(failed)
    }

    /// Restores a [`state`](Self::state), whole or in parts: earlier versions had one per group.
    ///
    /// # Errors
    /// If it belongs to other parameters.
    pub fn load_state(&mut self, params: &Params<f32>, parts: &[Vec<u8>]) -> Result<()> {
        let mut state = OptimizerState::default();
        for part in parts {
            let OptimizerState { tensors, counts } = OptimizerState::from_safetensors(part).map_err(failed)?;
            state.tensors.extend(tensors);
            state.counts.extend(counts);
        }
        self.adam.load_state(params, &state).map_err(failed)
    }

    /// Updates the parameters at `fraction` of the run, with `lr_scale` times the learning rates of their schedules; see
    /// [`Optimizer::update`].
    pub fn update(
        &mut self,
        params: &mut Params<f32>,
        grads: &[Gradient<f32>],
        fraction: f64,
        lr_scale: f64,
    ) -> UpdateReport {
        self.adam.update_groups(params, grads, |group| lr_scale * self.schedules[group].lr(fraction))
    }
}

fn failed(error: StateError) -> Error {
    Error::setting("groups", error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{GroupConfig, Preset};
    use raygrad_autograd::Tensor;

    #[test]
    fn parameter_groups_have_own_lr_and_weight_decay() {
        let mut config = Config::preset(Preset::Instant);
        config.schedule = Schedule::Constant { lr: 0.1 };
        let group = |params: &str, rate, decay| GroupConfig {
            params: params.into(),
            adam: AdamConfig::default(),
            schedule: Schedule::Constant { lr: rate },
            weight_decay: decay,
        };
        config.groups = vec![group("pose", 0.001, 0.0), group("field.color", 0.2, 0.5)];
        let mut params = Params::new();
        for name in ["field.table", "field.color.0", "pose.3", "field.density"] {
            params.add(name, Tensor::full(&[2, 2], 1.0_f32));
        }
        params.set_lazy(|name| name == "field.table", true);
        params.freeze(|name| name == "field.density");
        let mut groups = Groups::new(&config, &params).unwrap();
        let grads: Vec<_> = (0..3).map(|_| Gradient::from(Tensor::full(&[2, 2], 3.0))).collect();
        let report = groups.update(&mut params, &grads, 0.0, 1.0);
        assert_eq!((report.updated, report.skipped, groups.steps()), (12, 0, 1));
        let moved: Vec<f32> = params.values().iter().map(|value| value.as_slice()[0]).collect();
        // Adam's first step is the learning rate; weight decay comes first.
        for (found, expected) in moved.iter().zip([0.9, 1.0 * (1.0 - 0.2 * 0.5) - 0.2, 0.999, 1.0]) {
            assert!((found - expected).abs() < 1e-6, "{moved:?}");
        }
        // Poses have their own schedule if they are learned.
        for (poses, expected) in [(Some(Schedule::Constant { lr: 0.25 }), 0.75), (None, 0.9)] {
            let mut learned = Params::new();
            learned.add("poses", Tensor::full(&[1, 6], 1.0_f32));
            let config = Config { poses, groups: vec![], ..config.clone() };
            let grads = [Gradient::from(Tensor::full(&[1, 6], 3.0))];
            let report = Groups::new(&config, &learned).unwrap().update(&mut learned, &grads, 0.0, 1.0);
            assert_eq!(report.updated, 6);
            assert!((learned.values()[0].as_slice()[0] - expected).abs() < 1e-6, "{:?}", learned.values());
        }
        // The first matching group counts; one that matches nothing is an error.
        config.groups = vec![group("field.", 0.5, 0.0), group("field.color", 0.2, 0.0)];
        let error = Groups::new(&config, &params).err().unwrap().to_string();
        assert!(error.starts_with("`groups.field.color`") && error.contains("pose.3"), "{error}");
    }

    #[test]
    fn tables_and_networks_have_own_adam_constants() {
        // With a beta1 of 0 the second step forgets the first gradient; with 0.9 it does not.
        let mut config = Config::preset(Preset::Instant);
        config.schedule = Schedule::Constant { lr: 0.1 };
        config.table_adam = AdamConfig { beta1: 0.0, ..AdamConfig::default() };
        config.adam = AdamConfig { beta1: 0.9, ..AdamConfig::default() };
        let mut params = Params::new();
        params.add("table", Tensor::full(&[1, 1], 0.0_f32));
        params.add("weight", Tensor::full(&[1, 1], 0.0_f32));
        params.set_lazy(|name| name == "table", true);
        let mut groups = Groups::new(&config, &params).unwrap();
        for g in [1.0, -1.0] {
            let grads: Vec<_> = (0..2).map(|_| Gradient::from(Tensor::full(&[1, 1], g))).collect();
            assert_eq!(groups.update(&mut params, &grads, 0.0, 1.0).updated, 2);
        }
        let [table, weight] = [0, 1].map(|i| params.values()[i].item());
        assert!(table.abs() < 1e-6 && weight < -0.05, "{table} {weight}");
    }
}
