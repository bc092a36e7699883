//! Training state: saving and resuming a run.

use super::groups::Groups;
use super::stats::{MOST_RAYS, StepStats};
use super::trainer::Trainer;
use crate::model::Model;
use crate::model::SceneBox;
use crate::model::config::Config;
use crate::{Error, Result};
use raygrad_nn::Storage;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::time::Duration;

/// The name of the trainer's own numbers in the file.
const TRAINER: &str = "trainer";

/// A trainer's state beside model and optimizer.
///
/// There is no random state: every random number is a function of the seed, the step and the tile.
#[derive(Serialize, Deserialize)]
struct Counts {
    config: Config,
    extent: SceneBox,
    stats: StepStats,
    elapsed: Duration,
    /// Rays of the next step.
    batch: usize,
    collapses: u32,
    /// The lr scale.
    #[serde(default = "crate::range::one")]
    lr_scale: f64,
    /// The share of detail of the fields.
    #[serde(default = "crate::range::one")]
    detail: f64,
    /// The number of parts of the optimizer's state, which is one. Earlier versions had one per group.
    groups: usize,
    /// Settings of the parameters, in their order.
    settings: Vec<Setting>,
}

/// Settings of a parameter.
#[derive(Serialize, Deserialize)]
struct Setting {
    name: String,
    frozen: bool,
    lazy: bool,
    rate: f64,
    decay: f64,
}

/// The name of a part of the optimizer's state.
fn part(number: usize) -> String {
    format!("optimizer.{number}")
}

fn failed(what: impl ToString) -> Error {
    Error::setting("state", what)
}

impl Trainer {
    /// Returns the training state as a safetensors file, to [resume](Self::load_state) from.
    ///
    /// It holds parameters in full precision with their settings, the states of optimizer and sampler, the step, the
    /// training time and the number of rays. Configuration and images are not part of it.
    ///
    /// # Errors
    /// If the format cannot hold it.
    pub fn state(&self) -> Result<Vec<u8>> {
        let params = &self.model.params;
        let optimizer = self.groups.state(params)?;
        let setting = |id| Setting {
            name: params.name(id).to_owned(),
            frozen: params.is_frozen(id),
            lazy: params.is_lazy(id),
            rate: params.lr_scale(id),
            decay: params.weight_decay_scale(id),
        };
        let counts = Counts {
            config: self.model.config.clone(),
            extent: self.model.scene_box,
            stats: self.done,
            elapsed: self.elapsed,
            batch: self.batch,
            collapses: self.collapses,
            lr_scale: self.lr_scale,
            detail: self.model.detail(),
            groups: 1,
            settings: params.ids().map(setting).collect(),
        };
        let counts = serde_json::to_vec(&counts).map_err(failed)?;
        let mut blobs = self.model.sampler.training_state();
        let name = part(0);
        blobs.extend([(TRAINER, counts), (&name, optimizer)]);
        let metadata = BTreeMap::from([("format".into(), "raygrad training".into())]);
        let bytes = params.to_safetensors(Storage::Full, &metadata, &blobs);
        bytes.map_err(failed)
    }

    /// Resumes from a [state](Self::state) of a trainer with the same configuration and images.
    ///
    /// The next steps equal those of the original trainer, bit for bit. After an error, nothing has changed.
    ///
    /// ```no_run
    /// use raygrad_nerf::dataset::{Split, load};
    /// use raygrad_nerf::{Config, Preset, Trainer};
    /// use std::sync::Arc;
    /// let (config, data) = (Config::preset(Preset::Instant), Arc::new(load("scene", Split::Train, 4)?));
    /// let mut trainer = Trainer::new(config.clone(), data.clone())?;
    /// trainer.step(0.0);
    /// let state = trainer.state()?;
    /// let expected = trainer.step(0.5).loss;
    ///
    /// let mut later = Trainer::new(config, data)?;
    /// later.load_state(&state)?;
    /// assert_eq!(later.stats().step, 1);
    /// assert_eq!(later.step(0.5).loss, expected);
    /// # Ok::<(), raygrad_nerf::Error>(())
    /// ```
    ///
    /// # Errors
    /// If the bytes are not a training state, or belong to another configuration.
    pub fn load_state(&mut self, state: &[u8]) -> Result<()> {
        let (mut model, counts, mut blobs) = self.model.restored(state)?;
        if !(1..=MOST_RAYS).contains(&counts.batch) {
            return Err(failed(format!("has {} rays per step; use 1 to {MOST_RAYS}", counts.batch)));
        }
        if !(counts.lr_scale >= 0.0 && counts.lr_scale.is_finite()) {
            return Err(failed(format!("has an lr scale of {}; use a finite number of at least 0", counts.lr_scale)));
        }
        for Setting { name, frozen, lazy, rate, decay } in &counts.settings {
            let is_own = |other: &str| other == name;
            if !(*rate >= 0.0 && rate.is_finite() && *decay >= 0.0 && decay.is_finite()) {
                return Err(failed(format!(
                    "has an lr scale of {rate} and a weight decay scale of {decay} for `{name}`; use at least 0"
                )));
            }
            if *frozen {
                model.params.freeze(is_own)
            } else {
                model.params.unfreeze(is_own)
            };
            model.params.set_lazy(is_own, *lazy);
            model.params.set_lr_scale(is_own, *rate);
            model.params.set_weight_decay_scale(is_own, *decay);
        }
        let missing = || failed("lacks a part of the optimizer's state; use one that `Trainer::state` wrote");
        let remembered: Vec<Vec<u8>> =
            (0..counts.groups).map(|i| blobs.remove(&part(i)).ok_or_else(missing)).collect::<Result<_>>()?;
        let mut groups = Groups::new(&model.config, &model.params)?;
        groups.load_state(&model.params, &remembered)?;
        (self.model, self.groups) = (model, groups);
        let Counts { stats, elapsed, batch, collapses, lr_scale, .. } = counts;
        (self.done, self.elapsed, self.batch, self.collapses, self.lr_scale) =
            (stats, elapsed, batch, collapses, lr_scale);
        Ok(())
    }
}

impl Model<f32> {
    /// Returns the model of a training [state](Trainer::state), ready to render.
    ///
    /// It keeps this model's [`appearance_image`](Self::appearance_image) and skipping, and updates the occupancy grid
    /// as [`load`](Self::load) does.
    ///
    /// ```no_run
    /// use raygrad_nerf::dataset::{Split, load};
    /// use raygrad_nerf::{Config, Preset, Trainer};
    /// use std::sync::Arc;
    /// let data = Arc::new(load("scene", Split::Train, 4)?);
    /// let mut trainer = Trainer::new(Config::preset(Preset::Instant), data)?;
    /// let (state, place) = (trainer.state()?, [[0.1, 0.2, 0.3]]);
    /// let [mut before, mut seen] = [[0.0]; 2];
    /// trainer.model.densities(&place, &mut before);
    /// trainer.step(0.5);
    /// trainer.model.at_state(&state)?.densities(&place, &mut seen);
    /// assert_eq!(seen, before);
    /// # Ok::<(), raygrad_nerf::Error>(())
    /// ```
    ///
    /// # Errors
    /// If the bytes are not a training state, or belong to another configuration.
    pub fn at_state(&self, state: &[u8]) -> Result<Self> {
        let (mut model, ..) = self.restored(state)?;
        model.finish();
        Ok(model)
    }

    /// The model of a state, the counts, and the remaining parts.
    fn restored(&self, state: &[u8]) -> Result<(Self, Counts, HashMap<String, Vec<u8>>)> {
        let mut model = self.clone();
        let mut blobs = model.params.load_safetensors(state).map_err(failed)?;
        let Some(counts) = blobs.remove(TRAINER) else {
            return Err(failed("holds a model, not a training state; resume from a checkpoint"));
        };
        let counts: Counts = serde_json::from_slice(&counts).map_err(failed)?;
        if counts.config != self.config || counts.extent != self.scene_box {
            return Err(failed(
                "belongs to another configuration or to other images; use those that it was written with",
            ));
        }
        if !(0.0..=1.0).contains(&counts.detail) {
            return Err(failed(format!("has a detail of {}; use 0 to 1", counts.detail)));
        }
        model.set_detail(counts.detail);
        model.sampler.load_state(&blobs)?;
        Ok((model, counts, blobs))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::{Split, sample::ball};
    use crate::model::Preset;
    use raygrad_nn::OptimizerState;
    use std::sync::Arc;

    fn trainer() -> Trainer {
        let mut config = Config::preset(Preset::Instant);
        if let Some(sampler) = config.sampler.get_mut::<crate::sampling::marching::MarchingConfig>() {
            (sampler.occupancy.resolution, sampler.samples) = (16, 512);
        }
        Trainer::new(config, Arc::new(ball(Split::Train, 8))).unwrap()
    }

    #[test]
    fn state_round_trips_before_the_first_step() {
        let mut trainer = trainer();
        (trainer.collapses, trainer.done.restarts, trainer.batch) = (2, 3, 512);
        trainer.set_lr_scale(0.125);
        trainer.elapsed = Duration::from_nanos(1_234_567_891);
        let state = trainer.state().unwrap();
        let mut later = self::trainer();
        later.load_state(&state).unwrap();
        assert_eq!((later.collapses, later.done.restarts, later.batch, later.lr_scale), (2, 3, 512, 0.125));
        assert_eq!((later.elapsed, later.done.step), (trainer.elapsed, 0));
        assert!([later.done.loss, later.done.psnr, later.done.opacity].iter().all(|x| x.is_nan()), "{:?}", later.done);
    }

    #[test]
    fn at_state_restores_parameters_and_detail() {
        let mut trainer = trainer();
        trainer.step(0.0);
        let state = trainer.state().unwrap();
        let expected = trainer.model.params.clone();
        trainer.step(0.5);
        let earlier = trainer.model.at_state(&state).unwrap();
        for id in expected.ids() {
            assert_eq!(earlier.params.get(id).as_slice(), expected.get(id).as_slice());
        }
        trainer.model.set_detail(0.25);
        assert_eq!(earlier.at_state(&trainer.state().unwrap()).unwrap().detail(), 0.25);
        assert!(earlier.at_state(b"nothing").is_err());
    }

    #[test]
    fn invalid_state_numbers_are_errors() {
        let mut trainer = trainer();
        let written = |change: &dyn Fn(&mut Counts)| {
            let params = &trainer.model.params;
            let state = trainer.state().unwrap();
            let mut blobs = params.clone().load_safetensors(&state).unwrap();
            let mut counts: Counts = serde_json::from_slice(&blobs.remove(TRAINER).unwrap()).unwrap();
            change(&mut counts);
            blobs.insert(TRAINER.into(), serde_json::to_vec(&counts).unwrap());
            let blobs: Vec<_> = blobs.iter().map(|(name, bytes)| (name.as_str(), bytes.clone())).collect();
            params.to_safetensors(Storage::Full, &BTreeMap::new(), &blobs).unwrap()
        };
        let states = [
            (written(&|counts| counts.batch = 0), "has 0 rays per step; use 1 to 1048576"),
            (written(&|counts| counts.batch = usize::MAX), "rays per step; use 1 to 1048576"),
            (written(&|counts| counts.settings[0].rate = -1.0), "has an lr scale of -1"),
            (written(&|counts| counts.settings[1].decay = -2.0), "a weight decay scale of -2"),
            (written(&|counts| counts.lr_scale = -1.0), "has an lr scale of -1; use a finite number of at least 0"),
            (written(&|counts| counts.groups = 9), "lacks a part of the optimizer's state"),
            (written(&|counts| counts.groups = 0), "groups"),
            (written(&|counts| counts.extent.unit *= 2.0), "another configuration"),
            (written(&|counts| counts.detail = 1.5), "has a detail of 1.5; use 0 to 1"),
            (written(&|counts| counts.detail = -1.0), "has a detail of -1; use 0 to 1"),
        ];
        // Zeros are valid numbers of a run.
        let still = written(&|counts| {
            (counts.settings[0].rate, counts.settings[1].decay, counts.lr_scale, counts.detail) = (0.0, 0.0, 0.0, 0.0);
        });
        let before = trainer.state().unwrap();
        for (state, expected) in &states {
            let error = trainer.load_state(state).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
        assert!(trainer.state().unwrap() == before);
        trainer.load_state(&still).unwrap();
        assert_eq!((trainer.lr_scale, trainer.model.detail()), (0.0, 0.0));
        trainer.load_state(&before).unwrap();
    }

    /// Earlier versions had an optimizer and a state per group.
    #[test]
    fn states_of_earlier_versions_are_read() {
        let mut trainer = trainer();
        trainer.step(0.0);
        let state = trainer.state().unwrap();
        let expected = trainer.step(0.5).loss;
        let params = &trainer.model.params;
        let mut blobs = params.clone().load_safetensors(&state).unwrap();
        let mut counts: Counts = serde_json::from_slice(&blobs.remove(TRAINER).unwrap()).unwrap();
        let whole = OptimizerState::<f32>::from_safetensors(&blobs.remove(&part(0)).unwrap()).unwrap();
        let tables: Vec<&str> = params.ids().filter(|id| params.is_lazy(*id)).map(|id| params.name(id)).collect();
        let of = |lazy: bool| {
            let own = |name: &String| name == "steps" || tables.iter().any(|table| name.starts_with(table)) == lazy;
            let mut half = whole.clone();
            half.tensors.retain(|name, _| own(name));
            half.counts.retain(|name, _| own(name));
            half.to_safetensors().unwrap()
        };
        counts.groups = 2;
        blobs.insert(TRAINER.into(), serde_json::to_vec(&counts).unwrap());
        blobs.extend([true, false].into_iter().enumerate().map(|(i, lazy)| (part(i), of(lazy))));
        let blobs: Vec<_> = blobs.iter().map(|(name, bytes)| (name.as_str(), bytes.clone())).collect();
        let mut file = params.clone();
        file.load_safetensors(&state).unwrap();
        let parts = file.to_safetensors(Storage::Full, &BTreeMap::new(), &blobs).unwrap();
        let mut later = self::trainer();
        later.load_state(&parts).unwrap();
        assert!(later.state().unwrap() == state);
        assert_eq!(later.step(0.5).loss, expected);
    }
}
