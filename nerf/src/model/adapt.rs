//! Adaptations of a configuration to the budget, the scene, its images and the cores.

use super::camera_optimizer::RefinedParam;
use super::config::Config;
use crate::dataset::SceneType;
use crate::dataset::background::Background;
use crate::encoding::hash_grid::HashGridConfig;
use crate::field::{ClassicConfig, DensityActivation, InstantConfig};
use crate::losses::{DistortionConfig, LossTermConfig};
use crate::sampling::SamplerConfig;
use crate::sampling::hierarchical::HierarchicalConfig;
use crate::sampling::marching::MarchingConfig;
use crate::sampling::proposal::ProposalConfig;
use crate::space::occupancy::Skip;
use raygrad_nn::Schedule;
/// The factor of the samples per step in unbounded scenes: most of them are behind opaque parts and cost little.
const SAMPLES: usize = 4;
/// The most tiles of a step for many cores. More would spend more time on recording than they gain.
const MOST_TILES: usize = 64;
/// The same for the samples of a tile.
const LEAST_SAMPLES: usize = 384;
/// Weight of the distortion loss in unbounded scenes, where few images show each point.
const DISTORTION: f64 = 0.1;
/// The same with proposals, as in nerfacto. With the weight above they collapse onto floaters.
const PROPOSAL_DISTORTION: f64 = 0.002;

/// Learning rates of cameras at the start and the end of a run. Units: radians of image motion, logarithms of focal
/// lengths, lens coefficients.
const POSE_RATE: [f64; 2] = [1e-3, 1e-5];
const FOCAL_RATE: [f64; 2] = [5e-3, 5e-5];
const LENS_RATE: [f64; 2] = [1e-3, 1e-5];
/// Learning rates of the logarithms of gains.
const TONE_RATE: [f64; 2] = [1e-2, 1e-4];
/// The share of a run over which these rates rise from 0: cameras would drift before the scene takes shape.
const CAMERA_WARMUP: f64 = 0.1;
/// The share of a run over which detail is enabled while poses are learned, and after which poses are checked.
const COARSE: f64 = 0.4;
const CHECK_AT: f64 = 0.05;

/// The most images that count as few, and the share of a run over which detail is enabled then.
const FEW_IMAGES: usize = 16;
const FEW_IMAGES_COARSE: f64 = 0.5;
/// Early termination of training on transparent images of a bounded scene.
const TRANSPARENT_EARLY_STOP: f64 = 0.01;

impl Config {
    /// Adapts the hash grid, the colour network and the sampling to a training budget.
    ///
    /// `samples` is [`Budget::samples`](crate::Budget::samples), `pixels_per_side` is
    /// [`Dataset::pixels_per_side`](crate::dataset::Dataset::pixels_per_side). [`HashGridConfig::cpu`] chooses the
    /// table's size and resolution. Beyond 200 million samples (100 seconds on two cores) steps along a ray shrink
    /// during training, down to a pixel's footprint. Beyond 600 million a training step has twice as many samples, and the
    /// colour network of an instant field two hidden layers instead of one.
    pub fn for_budget(mut self, samples: f64, pixels_per_side: f64) -> Self {
        if let Some(field) = self.field.get_mut::<InstantConfig>() {
            field.grid = HashGridConfig::cpu(samples, pixels_per_side);
            field.color_depth = if samples > 6e8 { 2 } else { 1 };
            if let Some(marching) = self.sampler.get_mut::<MarchingConfig>()
                && samples > 2e8
            {
                (marching.step, marching.last_step) = (1.0 / 150.0, Some(1.0 / pixels_per_side.clamp(150.0, 450.0)));
                marching.samples *= if samples > 6e8 { 2 } else { 1 };
            }
        }
        self
    }

    /// Adapts the configuration to the type of scene; a second call with the same type changes nothing.
    ///
    /// For an unbounded scene a marching sampler goes through [cascades](MarchingConfig::cascaded) with growing steps. It
    /// doubles the resolution of a hash grid and adds a [distortion loss](DistortionConfig) against fog. The steps along a
    /// ray shorten during training where those of [`for_budget`](Self::for_budget) do. Figures are in
    /// docs/benchmarks/results.md, section Captures.
    pub fn with_scene_type(mut self, scene_type: SceneType) -> Self {
        let before = std::mem::replace(&mut self.unbounded, scene_type.is_unbounded());
        if before == self.unbounded {
            return self;
        }
        let usual = MarchingConfig::default();
        if let Some(marching) = self.sampler.get_mut::<MarchingConfig>() {
            if self.unbounded {
                let samples = SAMPLES * marching.samples.min(usual.samples);
                *marching = MarchingConfig { samples, ..marching.clone().cascaded() };
            } else {
                let occupancy = &mut marching.occupancy;
                (occupancy.cascades, occupancy.resolution) = (1, usual.occupancy.resolution);
                let MarchingConfig { occupancy, tiles, samples, .. } = *marching;
                *marching = MarchingConfig { occupancy, tiles, samples: samples / SAMPLES, ..usual };
            }
        }
        let field = self.field.get_mut::<InstantConfig>();
        if self.unbounded {
            let has_proposals = self.sampler.get::<ProposalConfig>().is_some();
            let weight = if has_proposals { PROPOSAL_DISTORTION } else { DISTORTION };
            self.loss_terms.push(LossTermConfig::new(DistortionConfig { weight }));
            field.into_iter().for_each(|field| field.grid.finest *= 2);
        } else {
            self.loss_terms.retain(|term| term.get::<DistortionConfig>().is_none());
            field.into_iter().for_each(|field| field.grid.finest /= 2);
        }
        self
    }

    /// Adapts the configuration to images with or without transparent pixels. Call it after
    /// [`with_scene_type`](Self::with_scene_type).
    ///
    /// An [expected](Background::Expected) background becomes white behind opaque images. Where a bounded scene has
    /// transparent images, training ends rays at a transmittance of .01. Elsewhere some runs have fog for long, and ending
    /// rays early keeps it. Figures are in docs/benchmarks/results.md, section Levers.
    pub fn with_transparency(mut self, is_transparent: bool) -> Self {
        if self.background == Background::Expected && !is_transparent {
            self.background = Background::White;
        }
        if let Some(marching) = self.sampler.get_mut::<MarchingConfig>()
            && is_transparent
            && !self.unbounded
        {
            marching.early_stop_eps = TRANSPARENT_EARLY_STOP;
        }
        self
    }

    /// Adapts the configuration to the number of training images.
    ///
    /// Up to 16 images leave much of a scene to chance. Detail then fades in over the first half of the run, from coarse
    /// to fine (Yang et al. 2023, "FreeNeRF"), even if poses are right. Figures are in docs/benchmarks/results.md,
    /// section Few images.
    pub fn with_images(mut self, count: usize) -> Self {
        if count <= FEW_IMAGES {
            (self.camera_optimizer.coarse, self.camera_optimizer.check_at) = (FEW_IMAGES_COARSE, 0.0);
        }
        self
    }

    /// Gives a training step a [tile](MarchingConfig::tiles) for each of `cores`, if it has fewer: up to 64, and up to one
    /// for 384 samples. Call it after the sampler is chosen.
    pub fn with_cores(mut self, cores: usize) -> Self {
        if let Some(marching) = self.sampler.get_mut::<MarchingConfig>() {
            marching.tiles = marching.tiles.max(cores.min(MOST_TILES).min(marching.samples / LEAST_SAMPLES));
        }
        self
    }

    /// Makes training steps `scale` times as large, in `scale` times as many [tiles](MarchingConfig::tiles). All learning
    /// rates grow by the square root of `scale`, as Malladi et al. 2022 derive for Adam ("On the SDEs and Scaling Rules for
    /// Adaptive Gradient Algorithms"; their rule for the moments' constants is not applied). Samplers of other crates keep
    /// their size. Call it last. Figures are in docs/benchmarks/results.md, section Many cores.
    ///
    /// # Panics
    /// If `scale` is 0.
    pub fn with_batch_scale(mut self, scale: usize) -> Self {
        assert!(scale > 0, "a batch scale of 0; use 1 or more");
        let sampler = &mut self.sampler;
        let marching = sampler.get_mut::<MarchingConfig>().map(|marching| [&mut marching.samples, &mut marching.tiles]);
        marching.into_iter().flatten().for_each(|size| *size = size.saturating_mul(scale));
        let batch = sampler.get_mut::<HierarchicalConfig>().map(|hierarchical| &mut hierarchical.batch);
        batch.into_iter().for_each(|size| *size = size.saturating_mul(scale));
        let batch = sampler.get_mut::<ProposalConfig>().map(|proposal| &mut proposal.batch);
        batch.into_iter().for_each(|size| *size = size.saturating_mul(scale));
        let Config { schedule, groups, poses, camera_optimizer, exposure_model, .. } = &mut self;
        let groups = groups.iter_mut().map(|group| &mut group.schedule);
        let cameras = [&mut camera_optimizer.focal, &mut camera_optimizer.lens];
        let exposure = [&mut exposure_model.exposure, &mut exposure_model.vignetting];
        let others = [poses].into_iter().chain(cameras).chain(exposure).flatten();
        for schedule in [schedule].into_iter().chain(groups).chain(others) {
            *schedule = schedule.scaled((scale as f64).sqrt());
        }
        self
    }

    /// Enables refinement of these camera parameters, at learning rates found with `examples/refine.rs`. With
    /// [`RefinedParam::Poses`], detail is enabled from coarse to fine, unless a
    /// [check](crate::model::CameraOptimizerConfig::check_at) finds that the given poses are right.
    pub fn with_refined(mut self, parts: &[RefinedParam]) -> Self {
        let rate = |from: f64, to: f64| Some(Schedule::Exponential { from, to, warmup: CAMERA_WARMUP });
        for part in parts {
            match part {
                RefinedParam::Poses => {
                    self.poses = rate(POSE_RATE[0], POSE_RATE[1]);
                    // Few images have a schedule of their own.
                    if self.camera_optimizer.coarse == 0.0 {
                        (self.camera_optimizer.coarse, self.camera_optimizer.check_at) = (COARSE, CHECK_AT);
                    }
                }
                RefinedParam::Focal => self.camera_optimizer.focal = rate(FOCAL_RATE[0], FOCAL_RATE[1]),
                RefinedParam::Lens => self.camera_optimizer.lens = rate(LENS_RATE[0], LENS_RATE[1]),
                RefinedParam::Exposure => self.exposure_model.exposure = rate(TONE_RATE[0], TONE_RATE[1]),
                RefinedParam::Vignetting => self.exposure_model.vignetting = rate(TONE_RATE[0], TONE_RATE[1]),
            }
        }
        self
    }

    /// Sets the skipping of empty space, by marching through an occupancy grid; [`Skip::Off`] keeps another sampler.
    pub fn with_skip(mut self, skip: Skip) -> Self {
        if let Some(marching) = self.sampler.get_mut::<MarchingConfig>() {
            marching.occupancy.skip = skip.into();
        } else if skip != Skip::Off {
            // The same number of rays as before, if about 16 samples of each remain.
            let batch = self.sampler.get::<HierarchicalConfig>().map(|hierarchical| hierarchical.batch);
            let usual = MarchingConfig::default();
            let mut marching = MarchingConfig { samples: batch.map_or(usual.samples, |batch| 16 * batch), ..usual };
            marching.occupancy.skip = skip.into();
            self.sampler = SamplerConfig::new(marching);
        }
        self
    }

    fn classic_fields(&mut self) -> impl Iterator<Item = &mut ClassicConfig> {
        let proposal = self.sampler.get_mut::<HierarchicalConfig>().map(|config| &mut config.proposal);
        self.field.get_mut::<ClassicConfig>().into_iter().chain(proposal)
    }

    /// Removes the positional encoding from classic networks.
    pub fn without_positional_encoding(mut self) -> Self {
        for field in self.classic_fields() {
            (field.position_levels, field.direction_levels) = (0, 0);
        }
        self
    }

    /// Uses the paper's ReLU density in classic networks.
    pub fn with_relu_density(mut self) -> Self {
        for field in self.classic_fields() {
            field.density = DensityActivation::Relu;
        }
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::config::GroupConfig;
    use crate::model::exposure::ExposureConfig;
    use crate::model::preset::Preset;
    use raygrad_nn::AdamConfig;

    #[test]
    fn refined_params_have_their_own_schedule() {
        let refined = |part| Config::preset(Preset::Instant).with_refined(&[part]);
        let rate = |from, to| Some(Schedule::Exponential { from, to, warmup: 0.1 });
        let expected = [
            (RefinedParam::Poses, "poses", rate(1e-3, 1e-5)),
            (RefinedParam::Focal, "focal", rate(5e-3, 5e-5)),
            (RefinedParam::Lens, "lens", rate(1e-3, 1e-5)),
            (RefinedParam::Exposure, "exposure", rate(1e-2, 1e-4)),
            (RefinedParam::Vignetting, "vignetting", rate(1e-2, 1e-4)),
        ];
        for (part, name, rate) in expected {
            let config = refined(part);
            config.check().unwrap();
            for (_, other, _) in expected {
                assert_eq!(config.camera_rate(other), rate.filter(|_| other == name), "{part}: {other}");
            }
            assert_eq!(config.camera_rate("field.table"), None);
            assert_eq!((part.to_string(), name.parse::<RefinedParam>().unwrap()), (name.to_owned(), part));
            // Only with pose refinement is detail enabled gradually.
            let coarse = if part == RefinedParam::Poses { 0.4 } else { 0.0 };
            assert_eq!(config.camera_optimizer.coarse, coarse);
            let details = [0.0, 0.1, 0.4, 1.0].map(|fraction| config.camera_optimizer.detail(fraction));
            assert_eq!(details, if coarse > 0.0 { [0.0, 0.25, 1.0, 1.0] } else { [1.0; 4] });
        }
        assert!(
            "tone"
                .parse::<RefinedParam>()
                .unwrap_err()
                .to_string()
                .contains("poses, focal, lens, exposure or vignetting")
        );
        let mut wrong = refined(RefinedParam::Vignetting);
        wrong.exposure_model.vignetting = Some(Schedule::Constant { lr: f64::NAN });
        assert!(wrong.check().unwrap_err().to_string().starts_with("`exposure_model.vignetting.constant.lr`"));
        wrong.exposure_model = ExposureConfig { exposure: wrong.exposure_model.vignetting, vignetting: None };
        assert!(wrong.check().unwrap_err().to_string().starts_with("`exposure_model.exposure.constant.lr`"));
    }

    #[test]
    fn tiles_follow_the_cores() {
        let tiles = |cores: usize, set: usize| {
            let mut config = Config::preset(Preset::Instant);
            config.sampler.get_mut::<MarchingConfig>().unwrap().tiles = set;
            let config = config.with_cores(cores).with_scene_type(SceneType::Unbounded);
            config.check().unwrap();
            let config = config.with_scene_type(SceneType::Bounded);
            config.sampler.get::<MarchingConfig>().unwrap().tiles
        };
        assert_eq!([tiles(2, 8), tiles(20, 8), tiles(20, 30), tiles(100, 8)], [8, 20, 30, 64]);
        let small = Config::preset(Preset::Small).with_skip(Skip::Fast).with_cores(64);
        assert_eq!(small.sampler.get::<MarchingConfig>().unwrap().tiles, 10);
        let classic = Config::preset(Preset::Classic);
        assert_eq!(classic.clone().with_cores(99), classic);
    }

    #[test]
    fn batch_scale_grows_steps_and_learning_rates() {
        let all = [
            RefinedParam::Poses,
            RefinedParam::Focal,
            RefinedParam::Lens,
            RefinedParam::Exposure,
            RefinedParam::Vignetting,
        ];
        for preset in [Preset::Instant, Preset::Small, Preset::Voxel, Preset::Classic] {
            let mut config = Config::preset(preset).with_refined(&all);
            if preset == Preset::Voxel {
                config.sampler = SamplerConfig::new(ProposalConfig::default());
            }
            let schedule = Schedule::Constant { lr: 0.1 };
            let adam = AdamConfig::default();
            config.groups = vec![GroupConfig { params: "field".into(), adam, schedule, weight_decay: 0.5 }];
            assert_eq!(config.clone().with_batch_scale(1), config);
            let scaled = config.clone().with_batch_scale(4);
            scaled.check().unwrap();
            let size = |config: &Config| {
                let sampler = &config.sampler;
                let samples =
                    sampler.get::<MarchingConfig>().map(|marching| marching.samples.min(3072 * marching.tiles));
                let batch = sampler.get::<HierarchicalConfig>().map(|hierarchical| hierarchical.batch);
                samples.or(batch).or_else(|| Some(sampler.get::<ProposalConfig>()?.batch)).unwrap()
            };
            assert_eq!(size(&scaled), 4 * size(&config), "{preset}");
            let rates = |config: &Config| {
                let cameras = ["poses", "focal", "lens", "exposure", "vignetting"];
                let schedules = cameras.map(|name| config.camera_rate(name).unwrap());
                let all = [config.schedule, config.groups[0].schedule].into_iter().chain(schedules);
                all.map(|schedule| schedule.lr(0.5)).collect::<Vec<_>>()
            };
            let doubled = rates(&config).into_iter().map(|rate| 2.0 * rate);
            assert!(rates(&scaled).into_iter().zip(doubled).all(|(rate, double)| (rate / double - 1.0).abs() < 1e-12));
        }
    }

    #[test]
    fn model_size_follows_budget_and_images() {
        let made = |samples: f64, pixels_per_side: f64| {
            let config = Config::preset(Preset::Instant).for_budget(samples, pixels_per_side);
            config.check().unwrap();
            let InstantConfig { grid, color_depth, .. } = config.field.get::<InstantConfig>().unwrap();
            let marching = config.sampler.get::<MarchingConfig>().unwrap();
            (grid.log2_table, grid.finest, *color_depth, marching.samples, marching.last_step)
        };
        let samples = MarchingConfig::default().samples;
        assert_eq!(made(2e8, 400.0), (17, 512, 1, samples, None));
        assert_eq!(made(6e8, 400.0), (18, 512, 1, samples, Some(1.0 / 400.0)));
        assert_eq!(made(6.5e8, 1000.0), (19, 768, 2, 2 * samples, Some(1.0 / 450.0)));
        assert_eq!(made(6.5e8, 100.0), (19, 200, 2, 2 * samples, Some(1.0 / 150.0)));
        // Presets without a grid do not change.
        assert_eq!(Config::preset(Preset::Classic).for_budget(1e9, 50.0), Config::preset(Preset::Classic));
    }

    #[test]
    fn transparency_sets_background_and_end_of_rays() {
        let preset = Config::preset(Preset::Instant);
        let adapted = |config: &Config, is_transparent: bool| {
            let config = config.clone().with_transparency(is_transparent);
            config.check().unwrap();
            (config.background, config.sampler.get::<MarchingConfig>().map(|marching| marching.early_stop_eps))
        };
        assert_eq!(adapted(&preset, true), (Background::Expected, Some(0.01)));
        assert_eq!(adapted(&preset, false), (Background::White, Some(0.001)));
        let unbounded = preset.clone().with_scene_type(SceneType::Unbounded);
        assert_eq!(adapted(&unbounded, true), (Background::Expected, Some(0.001)));
        let black = Config { background: Background::Black, ..preset };
        assert_eq!([true, false].map(|is_transparent| adapted(&black, is_transparent).0), [Background::Black; 2]);
        assert_eq!(adapted(&Config::preset(Preset::Classic), true), (Background::White, None));
    }

    #[test]
    fn few_images_get_detail_late() {
        let preset = Config::preset(Preset::Instant);
        let few = preset.clone().with_images(16);
        few.check().unwrap();
        assert_eq!([0.0, 0.25, 0.5, 1.0].map(|fraction| few.camera_optimizer.detail(fraction)), [0.0, 0.5, 1.0, 1.0]);
        assert_eq!(preset.clone().with_images(17), preset);
        // Refined poses do not change that, in either order.
        let poses = &[RefinedParam::Poses];
        let refined = few.with_refined(poses).camera_optimizer;
        assert_eq!((refined.coarse, refined.check_at), (0.5, 0.0));
        assert_eq!(preset.clone().with_refined(poses).with_images(16).camera_optimizer, refined);
        let mut wrong = preset.with_refined(poses);
        assert_eq!(wrong.camera_optimizer.check_at, 0.05);
        wrong.camera_optimizer.check_at = 1.5;
        assert!(wrong.check().unwrap_err().to_string().starts_with("`camera_optimizer.check_at`"));
    }

    #[test]
    fn scene_type_changes_the_config_once() {
        let preset = Config::preset(Preset::Instant);
        let unbounded = preset.clone().with_scene_type(SceneType::Unbounded);
        unbounded.check().unwrap();
        let [before, after] =
            [&preset, &unbounded].map(|config| config.sampler.get::<MarchingConfig>().unwrap().clone());
        assert_eq!((after.occupancy.cascades, after.occupancy.resolution, after.samples), (6, 32, 4 * before.samples));
        assert_eq!((after.step, after.last_step, after.cone, after.view_step), (0.01, None, 1.0 / 64.0, 1.0 / 150.0));
        let [coarse, fine] =
            [&preset, &unbounded].map(|config| config.field.get::<InstantConfig>().unwrap().grid.finest);
        assert_eq!(fine, 2 * coarse);
        assert!(unbounded.unbounded && unbounded.loss_terms.len() == 1);
        assert_eq!(unbounded.clone().with_scene_type(SceneType::Unbounded), unbounded);
        assert_eq!(unbounded.with_scene_type(SceneType::Bounded), preset);
        assert_eq!(preset.clone().with_scene_type(SceneType::Bounded), preset);
        for other in [Preset::Voxel, Preset::Small, Preset::Classic] {
            Config::preset(other).with_scene_type(SceneType::Unbounded).check().unwrap();
        }
        // The weight of the distortion loss suits the sampler.
        let weight = |config: Config| config.loss_terms[0].get::<DistortionConfig>().unwrap().weight;
        let proposals = Config { sampler: SamplerConfig::new(ProposalConfig::default()), ..preset.clone() };
        assert_eq!(
            [&preset, &proposals].map(|c| weight(c.clone().with_scene_type(SceneType::Unbounded))),
            [0.1, 0.002]
        );
        // The same number of rays as before, each with more samples.
        let skipped = Config::preset(Preset::Small).with_skip(Skip::Fast);
        let samples = |config: &Config| config.sampler.get::<MarchingConfig>().unwrap().samples;
        let open = skipped.clone().with_scene_type(SceneType::Unbounded);
        open.check().unwrap();
        assert_eq!((samples(&skipped), samples(&open)), (16 * 256, 4 * 16 * 256));
        assert_eq!(open.with_scene_type(SceneType::Bounded), skipped);
        let long = Config::preset(Preset::Instant).for_budget(1.2e9, 400.0).with_scene_type(SceneType::Unbounded);
        let MarchingConfig { step, last_step, cone, view_step, .. } = *long.sampler.get::<MarchingConfig>().unwrap();
        assert_eq!((step, last_step, cone, view_step), (0.01, Some(0.004), 0.01, 0.005));
    }
}
