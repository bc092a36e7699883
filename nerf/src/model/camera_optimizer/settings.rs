//! Configuration of the camera optimizer.

use crate::range::{by_name, check_range, check_schedule};
use crate::{Error, Result};
use raygrad_nn::Schedule;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The name of the pose parameter.
pub(crate) const POSES: &str = "poses";
/// The name of the focal length parameter.
pub(crate) const FOCAL: &str = "focal";
/// The name of the lens parameter.
pub(crate) const LENS: &str = "lens";

/// Configuration of the [`CameraOptimizer`](crate::model::CameraOptimizer), beside
/// [`Config::poses`](crate::Config::poses).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CameraOptimizerConfig {
    /// Learning rate of the focal lengths over the run; null keeps them fixed. `--refine focal` sets it. See
    /// [`CameraOptimizer`](crate::model::CameraOptimizer).
    pub focal: Option<Schedule>,
    /// Learning rate of the lens coefficients over the run; null keeps them fixed. `--refine lens` sets it.
    pub lens: Option<Schedule>,
    /// Share of the run over which detail fades in, from coarse to fine (Lin et al. 2021, "BARF", equation 14).
    /// Fine detail too early pulls a pose to the nearest repetition of a pattern. 0 shows all detail from the
    /// start. Range: 0 to 1.
    pub coarse: f64,
    /// Share of the run after which the trainer checks the poses. The given poses are right if they moved the median
    /// image by less than .4 degrees and each by less than .85. Then they are restored, all detail is enabled, and
    /// their learning rate falls to a fiftieth. 0 omits the check. Range: 0 to 1.
    pub check_at: f64,
}

impl CameraOptimizerConfig {
    /// Returns the share of detail at this fraction of the run, 0 to 1.
    pub fn detail(&self, fraction: f64) -> f64 {
        if self.coarse > 0.0 { (fraction / self.coarse).clamp(0.0, 1.0) } else { 1.0 }
    }

    /// Checks that all values are in range.
    ///
    /// # Errors
    /// If a value is out of range.
    pub fn check(&self) -> Result<()> {
        check_range("camera_optimizer.coarse", self.coarse, 0.0, 1.0)?;
        check_range("camera_optimizer.check_at", self.check_at, 0.0, 1.0)?;
        check_schedule("camera_optimizer.focal", self.focal)?;
        check_schedule("camera_optimizer.lens", self.lens)
    }
}

/// A camera parameter that can be refined.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RefinedParam {
    /// Position and orientation, per image.
    Poses,
    /// Focal length, per camera.
    Focal,
    /// Distortion coefficients, per camera.
    Lens,
    /// Exposure and white balance, per image.
    Exposure,
    /// Vignetting, shared by all images.
    Vignetting,
}

impl FromStr for RefinedParam {
    type Err = Error;
    fn from_str(name: &str) -> Result<Self> {
        by_name(name).ok_or_else(|| {
            let what = format!("is `{name}`; use poses, focal, lens, exposure or vignetting");
            Error::setting("camera_optimizer", what)
        })
    }
}

impl fmt::Display for RefinedParam {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}
