//! Groups of parameters, each with an optimiser, a schedule and a decay of its own.

use crate::model::config::{Config, GroupConfig};
use crate::model::{EXPOSURE, FOCAL, LENS, POSES, VIGNETTING};
use crate::{Error, Result};
use raygrad_autograd::Gradient;
use raygrad_nn::{AdamW, Optimizer, OptimizerState, Params, Schedule, StateError, UpdateReport};

/// Parameters of cameras, each of which has a learning rate of its own.
const CAMERAS: [&str; 5] = [POSES, FOCAL, LENS, EXPOSURE, VIGNETTING];

/// One group.
struct Group {
    /// For each parameter of the store whether it belongs here.
    members: Vec<bool>,
    adam: AdamW<f32>,
    schedule: Schedule,
}

/// All groups: a parameter belongs to the first that its name fits, and else to one of its own, if it is of cameras, to the
/// tables, if only rows of it are moved, or to the rest.
pub(crate) struct Groups(Vec<Group>);

impl Groups {
    /// Groups of these parameters that have seen nothing.
    ///
    /// # Errors
    /// If a group of the configuration has no parameter.
    pub fn new(config: &Config, params: &Params<f32>) -> Result<Self> {
        let rest = |adam, schedule| GroupConfig { params: String::new(), adam, schedule, decay: 0.0 };
        let cameras = CAMERAS.map(|name| rest(config.adam, config.camera_rate(name).unwrap_or(config.schedule)));
        let others = [rest(config.table_adam, config.schedule), rest(config.adam, config.schedule)];
        let settings: Vec<_> = config.groups.iter().cloned().chain(cameras).chain(others).collect();
        let named = config.groups.len();
        let place = |name: &str, lazy: bool| {
            let fits = |group: &GroupConfig| name.starts_with(&group.params);
            let camera = CAMERAS.iter().position(|camera| *camera == name && config.camera_rate(name).is_some());
            let other = camera.unwrap_or(CAMERAS.len() + usize::from(!lazy));
            config.groups.iter().position(fits).unwrap_or(named + other)
        };
        let places: Vec<usize> = params.ids().map(|id| place(params.name(id), params.is_lazy(id))).collect();
        let group = |(i, GroupConfig { adam, schedule, decay, .. }): (usize, GroupConfig)| Group {
            members: places.iter().map(|&place| place == i).collect(),
            adam: AdamW::new(adam, decay),
            schedule,
        };
        if let Some(empty) = (0..named).find(|i| !places.contains(i)) {
            let names: Vec<&str> = params.names().collect();
            let what = format!("no parameter begins so that is in no group before it; there are {}", names.join(", "));
            return Err(Error::setting(format!("groups.{}", config.groups[empty].params), what));
        }
        let groups = settings.into_iter().enumerate().map(group).filter(|group| group.members.contains(&true));
        Ok(Groups(groups.collect()))
    }

    /// Steps taken.
    pub fn steps(&self) -> u64 {
        self.0.first().map_or(0, |group| group.adam.steps())
    }

    /// What the optimisers remember of these parameters, as bytes for each group.
    ///
    /// # Errors
    /// If the format cannot hold it.
    pub fn state(&self, params: &Params<f32>) -> Result<Vec<Vec<u8>>> {
        let failed = |error: StateError| Error::setting("groups", error.to_string());
        self.0.iter().map(|group| group.adam.state(params).to_safetensors().map_err(failed)).collect()
    }

    /// Takes back what [`state`](Self::state) gave.
    ///
    /// # Errors
    /// If it is that of other groups or of other parameters.
    pub fn load_state(&mut self, params: &Params<f32>, state: &[Vec<u8>]) -> Result<()> {
        if state.len() != self.0.len() {
            let what = format!("are {}, and the optimisers' states are {}", self.0.len(), state.len());
            return Err(Error::setting("groups", what));
        }
        for (group, bytes) in self.0.iter_mut().zip(state) {
            let load = OptimizerState::from_safetensors(bytes).and_then(|state| group.adam.load_state(params, &state));
            load.map_err(|error| Error::setting("groups", error.to_string()))?;
        }
        Ok(())
    }

    /// Moves the parameters at `fraction` of the run against gradients as [`Optimizer::update`] takes them, at `pace` times
    /// the rates of their schedules.
    pub fn update(
        &mut self,
        params: &mut Params<f32>,
        grads: &[Gradient<f32>],
        fraction: f64,
        pace: f64,
    ) -> UpdateReport {
        let mut report = UpdateReport::default();
        for Group { members, adam, schedule } in &mut self.0 {
            let free = params.ids().zip(&*members).filter(|(id, _)| !params.is_frozen(*id));
            let own = |((_, member), grad): ((_, &bool), &Gradient<f32>)| match member {
                true => grad.clone(),
                false => Gradient::zero(grad.shape()),
            };
            let own: Vec<_> = free.zip(grads).map(own).collect();
            let UpdateReport { moved, skipped, bad } = adam.update(params, &own, pace * schedule.rate(fraction));
            report.moved += moved;
            report.skipped += skipped;
            report.bad.extend(bad);
        }
        report
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::config::Preset;
    use raygrad_autograd::Tensor;
    use raygrad_nn::AdamConfig;

    #[test]
    fn each_group_has_its_rate_and_decay_and_each_parameter_one_group() {
        let mut config = Config::preset(Preset::Instant);
        config.schedule = Schedule::Constant { rate: 0.1 };
        let group = |params: &str, rate, decay| GroupConfig {
            params: params.into(),
            adam: AdamConfig::default(),
            schedule: Schedule::Constant { rate },
            decay,
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
        assert_eq!((report.moved, report.skipped, groups.steps()), (12, 0, 1));
        let moved: Vec<f32> = params.values().iter().map(|value| value.as_slice()[0]).collect();
        // Adam's first step is the learning rate; what decays does so first.
        for (found, expected) in moved.iter().zip([0.9, 1.0 * (1.0 - 0.2 * 0.5) - 0.2, 0.999, 1.0]) {
            assert!((found - expected).abs() < 1e-6, "{moved:?}");
        }
        // Poses have a rate of their own, if they are learned.
        for (poses, expected) in [(Some(Schedule::Constant { rate: 0.25 }), 0.75), (None, 0.9)] {
            let mut learned = Params::new();
            learned.add("poses", Tensor::full(&[1, 6], 1.0_f32));
            let config = Config { poses, groups: vec![], ..config.clone() };
            let grads = [Gradient::from(Tensor::full(&[1, 6], 3.0))];
            let report = Groups::new(&config, &learned).unwrap().update(&mut learned, &grads, 0.0, 1.0);
            assert_eq!(report.moved, 6);
            assert!((learned.values()[0].as_slice()[0] - expected).abs() < 1e-6, "{:?}", learned.values());
        }
        // The first group that fits counts; one that fits nothing is an error.
        config.groups = vec![group("field.", 0.5, 0.0), group("field.color", 0.2, 0.0)];
        let error = Groups::new(&config, &params).err().unwrap().to_string();
        assert!(error.starts_with("`groups.field.color`") && error.contains("pose.3"), "{error}");
    }

    #[test]
    fn tables_and_networks_have_their_own_constants() {
        // With a beta1 of 0 the second step forgets the first gradient; with .9 it does not.
        let mut config = Config::preset(Preset::Instant);
        config.schedule = Schedule::Constant { rate: 0.1 };
        config.table_adam = AdamConfig { beta1: 0.0, ..AdamConfig::default() };
        config.adam = AdamConfig { beta1: 0.9, ..AdamConfig::default() };
        let mut params = Params::new();
        params.add("table", Tensor::full(&[1, 1], 0.0_f32));
        params.add("weight", Tensor::full(&[1, 1], 0.0_f32));
        params.set_lazy(|name| name == "table", true);
        let mut groups = Groups::new(&config, &params).unwrap();
        for g in [1.0, -1.0] {
            let grads: Vec<_> = (0..2).map(|_| Gradient::from(Tensor::full(&[1, 1], g))).collect();
            assert_eq!(groups.update(&mut params, &grads, 0.0, 1.0).moved, 2);
        }
        let [table, weight] = [0, 1].map(|i| params.values()[i].item());
        assert!(table.abs() < 1e-6 && weight < -0.05, "{table} {weight}");
    }
}
