//! The configuration of a new run: the preset, changed by flags.

use std::time::Duration;

use raygrad::nerf::dataset::{Dataset, SceneType};
use raygrad::nerf::losses::DepthConfig;
use raygrad::nerf::model::RefinedParam;
use raygrad::nerf::sampling::hierarchical::HierarchicalConfig;
use raygrad::nerf::sampling::marching::MarchingConfig;
use raygrad::nerf::{Budget, ClassicConfig, Config, Error, InstantConfig, LossTermConfig, Preset, Result, Trainer};
use serde_json::Value;

use super::super::cameras::Viewpoint;
use super::super::ranks;
use super::super::run::{RunConfig, usual_checkpoints};
use super::super::scene::{Opened, Scene};
use super::Args;

/// The largest batch scale.
pub const MOST_BATCH_SCALE: usize = 64;

impl Args {
    /// The configuration of a new run.
    pub fn config(&self, data: &Dataset) -> Result<Config> {
        let mut config = Config { seed: self.seed, ..Config::preset(self.preset) };
        config = config.for_budget(self.samples(), data.pixels_per_side());
        if let Some(skip) = self.skip {
            config = config.with_skip(skip);
        }
        // Before the scene type, which weighs the distortion loss by the sampler.
        let is_proposal = |(name, value): &&(String, Value)| name == "sampler" && value["kind"] == "proposal";
        if let Some((name, value)) = self.set.iter().find(is_proposal) {
            config = changed(&config, name, value)?;
        }
        config = config.with_scene_type(data.scene_type).with_images(data.frames.len());
        config = config.with_transparency(data.has_alpha());
        if let Some(background) = self.background {
            config.background = background;
        }
        if let Some(carve) = self.carve {
            let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() else {
                let what = format!("the preset {} has no occupancy grid to carve: add --skip fast", self.preset);
                return Err(Error::setting("carve", what));
            };
            sampler.occupancy.skip.carving = carve;
        }
        config = config.with_refined(&self.refine);
        if let Some(weight) = self.depth_loss {
            config.loss_terms.push(LossTermConfig::new(DepthConfig { weight }));
        }
        for (kind, weight) in &self.loss {
            config = with_term(config, kind, *weight)?;
        }
        if self.no_positional_encoding {
            if config.field.get::<ClassicConfig>().is_none() {
                let what = format!("the preset {} has none: add --preset small or classic", self.preset);
                return Err(Error::setting("no-positional-encoding", what));
            }
            config = config.without_positional_encoding();
        }
        // A number of steps gives the same model on any machine.
        if let Budget::Time(_) = self.budget() {
            config = config.with_cores(cores());
        }
        self.check_set()?;
        let config = self.set.iter().try_fold(config, |config, (name, value)| changed(&config, name, value))?;
        let config = config.with_batch_scale(self.batch_scale);
        if config.unbounded && config.sampler.get::<HierarchicalConfig>().is_some() {
            let what = "hierarchical sampling spaces samples evenly, too few for the long rays of an unbounded scene: \
                        use --preset instant or voxel, or add --skip fast or --scene-type bounded";
            return Err(Error::setting("preset", what));
        }
        Ok(config)
    }

    /// Fails if `--set` replaces what another flag gives.
    fn check_set(&self) -> Result<()> {
        let refines = |param| self.refine.contains(&param);
        let flags = [
            ("seed", self.seed != 0, "seed"),
            ("background", self.background.is_some(), "background"),
            ("scene-type", self.capture.scene_type.is_some(), "unbounded"),
            ("skip", self.skip.is_some(), "sampler.occupancy.skip"),
            ("carve", self.carve.is_some(), "sampler.occupancy.skip.carving"),
            ("loss", !self.loss.is_empty(), "loss_terms"),
            ("depth-loss", self.depth_loss.is_some(), "loss_terms"),
            ("refine", refines(RefinedParam::Poses), "poses"),
            ("refine", refines(RefinedParam::Focal), "camera_optimizer.focal"),
            ("refine", refines(RefinedParam::Lens), "camera_optimizer.lens"),
            ("refine", refines(RefinedParam::Exposure), "exposure_model.exposure"),
            ("refine", refines(RefinedParam::Vignetting), "exposure_model.vignetting"),
            ("no-positional-encoding", self.no_positional_encoding, "field.position_levels"),
            ("no-positional-encoding", self.no_positional_encoding, "field.direction_levels"),
            ("no-positional-encoding", self.no_positional_encoding, "sampler.proposal.position_levels"),
            ("no-positional-encoding", self.no_positional_encoding, "sampler.proposal.direction_levels"),
        ];
        for (name, value) in &self.set {
            let is_replaced = |flag: &str, key: &str| match key.strip_prefix(name.as_str()) {
                // Another learning rate of what is refined.
                Some("") => flag != "refine" || value.is_null(),
                rest => rest.is_some_and(|rest| rest.starts_with('.')),
            };
            if let Some((flag, ..)) = flags.iter().find(|(flag, is_given, key)| *is_given && is_replaced(flag, key)) {
                return Err(Error::setting(name, format!("replaces what --{flag} gives: leave out one of them")));
            }
        }
        Ok(())
    }

    /// The most cells along the scene box, or across the NDC frustum, that a hash grid may have with the budget;
    /// infinite for other fields.
    pub fn most_cells(&self, scene_type: SceneType) -> Result<f64> {
        let config = Config::preset(self.preset).for_budget(self.samples(), f64::INFINITY);
        let config = config.with_scene_type(scene_type);
        // Contraction leaves half of the cells along an axis to the box.
        let share = if scene_type == SceneType::Unbounded { 0.5 } else { 1.0 };
        let set = self.set.iter().filter(|(name, _)| name.starts_with("field"));
        let config = set.into_iter().try_fold(config, |config, (name, value)| changed(&config, name, value))?;
        Ok(config.field.get::<InstantConfig>().map_or(f64::INFINITY, |field| share * field.grid.finest as f64))
    }

    /// True if a depth loss is added, which needs measured depths.
    pub fn has_depth_loss(&self) -> bool {
        let is_depth = |term: &Value| term["kind"] == "depth";
        let is_set = |(name, value): &(String, Value)| {
            name == "loss_terms" && value.as_array().is_some_and(|terms| terms.iter().any(is_depth))
        };
        self.depth_loss.is_some()
            || self.loss.iter().any(|(kind, weight)| kind == "depth" && *weight > 0.0)
            || self.set.iter().any(is_set)
    }

    /// The record of a new run.
    pub fn run_config(
        &self,
        (scene, opened): (&Scene, &Opened),
        downscale: usize,
        trainer: &Trainer,
        data: &Dataset,
    ) -> Result<RunConfig> {
        Ok(RunConfig {
            raygrad: env!("CARGO_PKG_VERSION").to_owned(),
            scene: scene.absolute()?,
            downscale,
            description: opened.description(),
            test: self.capture.test.clone(),
            mask_as_alpha: self.capture.mask_as_alpha,
            scene_box: trainer.model.scene_box,
            viewpoint: Viewpoint::of(data),
            images: data.frames.iter().map(|frame| frame.name.clone()).collect(),
            budget: Some(self.budget()),
            keep_checkpoints: self.keep_checkpoints.unwrap_or_else(usual_checkpoints),
            config: trainer.model.config.clone(),
        })
    }

    /// The budget of a new run.
    pub fn budget(&self) -> Budget {
        self.given().unwrap_or_else(|| Budget::Time(default_budget(self.preset)))
    }

    /// Estimate of the samples along rays that fit in the budget, on all ranks.
    fn samples(&self) -> f64 {
        self.budget().samples_on(cores())
    }

    /// The note for steps with so many tiles if that leaves cores idle. A budget in time has chosen the number by the
    /// cores.
    pub fn idle_cores(&self, tiles: usize) -> Option<String> {
        let (cores, is_fixed) = (cores(), matches!(self.budget(), Budget::Steps(_)));
        (tiles < cores && is_fixed && self.batch_scale == 1).then(|| {
            format!(
                "note: steps of {tiles} tiles keep {tiles} of {cores} cores busy; `--set sampler.tiles=N` changes the \
                 number, and gives another model, as another seed does"
            )
        })
    }

    /// How long ranks wait for one another in training. A page can pause it for as long as it likes.
    pub fn patience(&self) -> Duration {
        if self.view { ranks::PATIENCE } else { self.rank_timeout }
    }

    /// The budget, if a flag sets it.
    pub fn given(&self) -> Option<Budget> {
        self.steps.map(Budget::Steps).or(self.budget.map(Budget::Time))
    }
}

/// The cores of all ranks.
fn cores() -> usize {
    ranks::own().map_or(1, |(_, ranks)| ranks) * rayon::current_num_threads()
}

/// Sets the near plane, given in capture units.
///
/// # Errors
/// If the near plane is negative or not in front of the far plane.
pub fn set_near(data: &mut Dataset, near: f64) -> Result<()> {
    let far = data.far / data.transform.scale;
    if !(0.0..far).contains(&near) {
        return Err(Error::setting("near", format!("is {near}; use 0 to less than {far:.4}, the far plane")));
    }
    let near = near * data.transform.scale;
    data.ndc = data.ndc.map(|ndc| ndc.with_near(data.near, near));
    data.near = near;
    Ok(())
}

/// The configuration with a loss term of this weight; a weight of 0 removes the term.
fn with_term(mut config: Config, kind: &str, weight: f64) -> Result<Config> {
    config.loss_terms.retain(|term| term.kind() != kind);
    if weight != 0.0 {
        let bad = |e| Error::setting("loss", format!("cannot be {kind}={weight}: {e}"));
        // Reading a configuration checks the name.
        let mut all = serde_json::to_value(&config).map_err(bad)?;
        if let Some(terms) = all.get_mut("loss_terms").and_then(Value::as_array_mut) {
            terms.push(serde_json::json!({ "kind": kind, "weight": weight }));
        }
        config = serde_json::from_value(all).map_err(bad)?;
    }
    Ok(config)
}

/// The configuration with the value of this dotted key replaced.
///
/// # Errors
/// If there is no such key or the value does not fit it.
pub fn changed(config: &Config, name: &str, value: &Value) -> Result<Config> {
    let unknown = |_| Error::setting(name, "cannot be changed");
    let mut all = serde_json::to_value(config).map_err(unknown)?;
    let pointer = format!("/{}", name.replace('.', "/"));
    let place = all
        .pointer_mut(&pointer)
        .ok_or_else(|| Error::setting(name, "is not a config key; config.json in a run folder lists them"))?;
    *place = value.clone();
    serde_json::from_value(all).map_err(|e| Error::setting(name, format!("cannot be {value}: {e}")))
}

/// Training time for a good result with a preset.
fn default_budget(preset: Preset) -> Duration {
    match preset {
        Preset::Instant | Preset::Voxel => Duration::from_secs(45),
        Preset::Small => Duration::from_secs(100),
        Preset::Classic => Duration::from_secs(3600),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use raygrad::nerf::losses::DistortionConfig;
    use raygrad::nerf::sampling::proposal::ProposalConfig;

    #[test]
    fn proposals_of_a_flag_get_their_distortion_weight() {
        let data = raygrad_scenes::landscape(raygrad::nerf::dataset::Split::Test, 8);
        let weight = |flags: &str| {
            let config = Args::parse_from(format!("train {flags}").split_whitespace()).config(&data).unwrap();
            config.loss_terms[0].get::<DistortionConfig>().unwrap().weight
        };
        assert_eq!(weight(""), 0.1);
        assert_eq!(weight(r#"--set sampler={"kind":"proposal"}"#), 0.002);
        assert_eq!(weight(r#"--loss distortion=0.5 --set sampler={"kind":"proposal"}"#), 0.5);
    }

    #[test]
    fn batch_scale_grows_the_step_also_if_it_is_set() {
        let data = raygrad_scenes::landscape(raygrad::nerf::dataset::Split::Test, 8);
        let config = |flags: &str| Args::parse_from(format!("train {flags}").split_whitespace()).config(&data).unwrap();
        let samples = |flags: &str| config(flags).sampler.get::<MarchingConfig>().unwrap().samples;
        assert_eq!(samples("--batch-scale 2"), 2 * samples(""));
        assert_eq!(samples("--batch-scale 2 --set sampler.samples=5000"), 10_000);
        // Where twice the steps would have a larger model.
        assert_eq!(samples("--steps 15000 --batch-scale 2"), 2 * samples("--steps 15000"));
        assert_eq!(config("--batch-scale 4 --set poses={\"constant\":{\"lr\":0.1}}").poses.unwrap().lr(0.5), 0.2);
        let proposal = config(r#"--batch-scale 3 --set sampler={"kind":"proposal"}"#).sampler;
        assert_eq!(proposal.get::<ProposalConfig>().unwrap().batch, 3 * ProposalConfig::default().batch);
    }

    #[test]
    fn set_replaces_no_other_flag() {
        let data = raygrad_scenes::landscape(raygrad::nerf::dataset::Split::Test, 8);
        let read = |flags: &str| Args::parse_from(format!("train {flags}").split_whitespace()).config(&data);
        for (flags, flag) in [
            ("--seed 3 --set seed=5", "seed"),
            ("--background black --set background=\"white\"", "background"),
            ("--loss entropy=0.1 --set loss_terms=[]", "loss"),
            ("--depth-loss --set loss_terms=[]", "depth-loss"),
            ("--carve 2 --set sampler.occupancy.skip.carving=3", "carve"),
            ("--carve 2 --set sampler.occupancy={}", "carve"),
            ("--skip off --set sampler.occupancy.skip={}", "skip"),
            ("--scene-type bounded --set unbounded=true", "scene-type"),
            ("--refine focal,poses --set poses=null", "refine"),
            ("--refine focal --set camera_optimizer.focal=null", "refine"),
            ("--refine lens --set camera_optimizer={}", "refine"),
            ("--refine exposure --set exposure_model={}", "refine"),
            ("--refine vignetting --set exposure_model.vignetting=null", "refine"),
            ("--preset small --no-positional-encoding --set field.position_levels=5", "no-positional-encoding"),
            ("--preset small --no-positional-encoding --set field.direction_levels=5", "no-positional-encoding"),
            ("--preset small --no-positional-encoding --set sampler.proposal={}", "no-positional-encoding"),
        ] {
            let message = read(flags).unwrap_err().to_string();
            assert!(message.ends_with(&format!("replaces what --{flag} gives: leave out one of them")), "{message}");
        }
        for flags in [
            "--loss entropy=0.1 --set loss={\"huber\":{\"delta\":0.1}}",
            "--set seed=5",
            "--carve 2 --set sampler.samples=5000",
            "--skip fast --set sampler.occupancy.skip.carving=2",
            "--refine poses --set camera_optimizer.coarse=0.5",
            "--refine focal --set camera_optimizer.lens=null",
            "--refine poses --set poses={\"constant\":{\"lr\":0.1}}",
            "--loss entropy=0.1 --set loss_terms.1.weight=2",
        ] {
            read(flags).unwrap();
        }
    }

    #[test]
    fn idle_cores_are_noted() {
        let data = raygrad_scenes::landscape(raygrad::nerf::dataset::Split::Test, 8);
        let tiles = |threads: usize, flags: &str| {
            let args = Args::parse_from(format!("train {flags}").split_whitespace());
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let tiles = args.config(&data).unwrap().sampler.get::<MarchingConfig>().unwrap().tiles;
                (tiles, args.idle_cores(tiles))
            })
        };
        // A model of a number of steps is the same on any machine.
        let expected = "note: steps of 8 tiles keep 8 of 18 cores busy; `--set sampler.tiles=N` changes the number, and \
                        gives another model, as another seed does";
        assert_eq!(tiles(18, "--steps 100"), (8, Some(expected.to_owned())));
        assert_eq!(tiles(18, "--steps 100 --set sampler.tiles=20"), (20, None));
        assert_eq!(tiles(8, "--steps 100"), (8, None));
        assert_eq!(tiles(18, "--steps 100 --batch-scale 2"), (16, None), "more tiles would be scaled too");
        assert_eq!(tiles(18, "--budget 1m"), (18, None));
        assert_eq!(tiles(18, "--budget 1m --batch-scale 2"), (36, None));
        assert_eq!(tiles(3, "--budget 1m"), (8, None));
        assert_eq!(tiles(100, "--budget 1m"), (64, None));
    }

    #[test]
    fn most_cells_follow_budget_and_flags() {
        let of = |scene_type, flags: &str| {
            Args::parse_from(format!("train {flags}").split_whitespace()).most_cells(scene_type).unwrap()
        };
        let cells = |flags: &str| of(SceneType::Bounded, flags);
        assert_eq!(of(SceneType::Unbounded, "--steps 1000"), 512.0);
        assert_eq!(of(SceneType::ForwardFacing, "--steps 1000"), 1024.0);
        assert_eq!(of(SceneType::Unbounded, "--steps 1000 --set field.grid.finest=2048"), 1024.0);
        assert_eq!(cells("--steps 1000"), 512.0);
        assert_eq!(cells("--steps 30000"), 768.0);
        assert_eq!(cells("--steps 1000 --set field.grid.finest=2048"), 2048.0);
        assert_eq!(cells("--preset voxel"), f64::INFINITY);
    }

    #[test]
    fn budget_is_of_the_flag_or_the_preset() {
        let budget = |flags: &str| Args::parse_from(format!("train {flags}").split_whitespace()).budget();
        let seconds = |seconds| Budget::Time(Duration::from_secs(seconds));
        for (flags, expected) in [
            ("", seconds(45)),
            ("--preset instant", seconds(45)),
            ("--preset voxel", seconds(45)),
            ("--preset small", seconds(100)),
            ("--preset classic", seconds(3600)),
            ("--preset classic --budget 10m", seconds(600)),
            ("--preset small --steps 7", Budget::Steps(7)),
        ] {
            assert_eq!(budget(flags), expected, "{flags}");
        }
        assert_eq!(Args::default().budget(), seconds(45), "the bare program");
    }
}
