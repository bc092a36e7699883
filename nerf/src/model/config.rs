//! The configuration of a model and its training.

use crate::dataset::background::Background;
use crate::field::FieldConfig;
use crate::losses::photometric::Loss;
use crate::losses::{DistortionConfig, LossTermConfig};
use crate::model::camera_optimizer::{CameraOptimizerConfig, FOCAL, LENS, POSES};
use crate::model::exposure::{EXPOSURE, ExposureConfig, VIGNETTING};
use crate::range::{check_range, check_schedule};
use crate::sampling::SamplerConfig;
use crate::sampling::marching::MarchingConfig;
use crate::{Error, Result};
use raygrad_nn::{AdamConfig, Schedule, SettingError, Storage};
use serde::{Deserialize, Serialize};

/// A group of parameters with its own optimizer settings and schedule.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GroupConfig {
    /// Prefix of the names of the parameters in this group, such as `field.color`. A parameter belongs to the first
    /// group whose prefix fits.
    pub params: String,
    /// Adam constants of the group.
    pub adam: AdamConfig,
    /// Learning rate of the group over the run.
    pub schedule: Schedule,
    /// Decoupled weight decay of the group, as in [`AdamW`](raygrad_nn::AdamW). Range: 0 to 1e30.
    #[serde(default)]
    #[serde(alias = "decay")]
    pub weight_decay: f64,
}

/// The configuration of a model and its training; stored with the model.
///
/// ```
/// use raygrad_nerf::dataset::SceneType;
/// use raygrad_nerf::{Config, Preset};
/// let config = Config::preset(Preset::Instant).with_scene_type(SceneType::Unbounded);
/// config.check()?;
/// # Ok::<_, raygrad_nerf::Error>(())
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The field: density and colour at each point of the scene.
    #[serde(deserialize_with = "super::registry::read")]
    pub field: FieldConfig,
    /// The sampler, which places the samples along each ray.
    #[serde(deserialize_with = "super::registry::read")]
    pub sampler: SamplerConfig,
    /// Whether the scene extends beyond its scene box. Fields then see all of space [contracted](crate::contract)
    /// into a cube, or, in a forward-facing scene, [normalised device coordinates](crate::Ndc). A marching sampler
    /// reaches the outermost box of its [cascades](crate::space::occupancy::OccupancyConfig::cascades). The other
    /// samplers cover the whole range from near to far.
    #[serde(default)]
    pub unbounded: bool,
    /// Loss between rendered and true colours.
    #[serde(default)]
    pub loss: Loss,
    /// Loss terms that are added to the colour loss. `--loss NAME=WEIGHT` sets one.
    #[serde(default, deserialize_with = "super::registry::read")]
    #[serde(alias = "terms")]
    pub loss_terms: Vec<LossTermConfig>,
    /// Learning-rate schedule over the run.
    pub schedule: Schedule,
    /// Adam constants of the networks.
    pub adam: AdamConfig,
    /// Adam constants of tables, such as that of a hash grid. Rows without a gradient keep their moments.
    pub table_adam: AdamConfig,
    /// Parameter groups with Adam constants and learning rates of their own. All other parameters use the keys
    /// above.
    #[serde(default)]
    pub groups: Vec<GroupConfig>,
    /// Learning rate of the camera poses over the run; null keeps the poses fixed. `--refine poses` sets it. See
    /// [`CameraOptimizer`](crate::model::CameraOptimizer).
    #[serde(default)]
    pub poses: Option<Schedule>,
    /// Optimization of focal lengths and lenses.
    #[serde(default)]
    #[serde(alias = "refine")]
    pub camera_optimizer: CameraOptimizerConfig,
    /// Exposure, white balance and vignetting of the images.
    #[serde(default)]
    #[serde(alias = "tone")]
    pub exposure_model: ExposureConfig,
    /// Gradients of samples nearer to their camera than this are scaled by the square of distance over this
    /// distance. It prevents floaters in front of cameras (Philip and Deschaintre 2023, "Floaters No More",
    /// equation 6). 0 turns it off. Unit: the `unit` of the [scene box](crate::SceneBox::unit). Range: 0 to
    /// 1000000.
    #[serde(default)]
    #[serde(alias = "near_gradients")]
    pub gradient_scaling_distance: f64,
    /// Background behind transparent pixels.
    pub background: Background,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Number type of the parameters in `model.safetensors`.
    #[serde(default)]
    pub storage: Storage,
}

impl Config {
    /// The background of training rays: [`background`](Self::background), if the loss allows it.
    pub(crate) fn training_background(&self) -> Background {
        match (self.background, self.loss) {
            (Background::Expected, Loss::Huber { .. }) => Background::Random,
            (background, _) => background,
        }
    }

    /// The schedule of the camera optimizer or exposure model for the parameter `name`, if it belongs to them.
    pub(crate) fn camera_rate(&self, name: &str) -> Option<Schedule> {
        match name {
            POSES => self.poses,
            FOCAL => self.camera_optimizer.focal,
            LENS => self.camera_optimizer.lens,
            EXPOSURE => self.exposure_model.exposure,
            VIGNETTING => self.exposure_model.vignetting,
            _ => None,
        }
    }

    /// Checks that all values are in range and fit each other.
    ///
    /// # Errors
    /// If a value is out of range or contradicts another; the error names it.
    pub fn check(&self) -> Result<()> {
        self.loss.check()?;
        let named = |part: &str, checked: std::result::Result<(), SettingError>| {
            checked.map_err(|error| Error::setting(format!("{part}.{}", error.name), error.what))
        };
        check_schedule("schedule", Some(self.schedule))?;
        named("adam", self.adam.check::<f32>())?;
        named("table_adam", self.table_adam.check::<f32>())?;
        check_schedule(POSES, self.poses)?;
        self.camera_optimizer.check()?;
        self.exposure_model.check()?;
        check_range("gradient_scaling_distance", self.gradient_scaling_distance, 0.0, 1e6)?;
        for group in &self.groups {
            let part = format!("groups.{}", group.params);
            named(&part, group.schedule.check())?;
            named(&part, group.adam.check::<f32>())?;
            let decay = group.weight_decay;
            if !(0.0..=1e30).contains(&decay) {
                return Err(Error::setting("groups.weight_decay", format!("is {decay:?}; use 0 to 1e30")));
            }
        }
        if let Some(marching) = self.sampler.get::<MarchingConfig>() {
            let cascades = marching.occupancy.cascades;
            if self.unbounded != (cascades > 1) {
                let what = format!("is {cascades}; use 1 for a bounded scene, and 2 to 8 for an unbounded one");
                return Err(Error::setting("occupancy.cascades", what));
            }
            let has_distortion = self.loss_terms.iter().any(|term| term.get::<DistortionConfig>().is_some());
            if has_distortion && marching.quadrature.has_intervals() {
                let what = "needs one sample per interval: use the quadrature midpoint or left";
                return Err(Error::setting("loss_terms.distortion", what));
            }
        }
        self.loss_terms.iter().try_for_each(LossTermConfig::check)?;
        self.field.check()?;
        self.sampler.check()
    }
}
