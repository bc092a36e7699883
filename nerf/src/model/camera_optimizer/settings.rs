//! What of the cameras is learned, and how fast.

use crate::model::exposure::{EXPOSURE, VIGNETTING};
use crate::range::{check_range, check_schedule};
use crate::{Error, Result};
use raygrad_nn::Schedule;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The name of the parameter of poses.
pub(crate) const POSES: &str = "poses";
/// That of focal lengths.
pub(crate) const FOCAL: &str = "focal";
/// That of lenses.
pub(crate) const LENS: &str = "lens";

/// What is learned of cameras beside their poses, and how the scene is held back meanwhile.
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
}

impl CameraOptimizerConfig {
    /// How much of the detail there is at this fraction of the run, 0 to 1.
    pub fn detail(&self, fraction: f64) -> f64 {
        if self.coarse > 0.0 { (fraction / self.coarse).clamp(0.0, 1.0) } else { 1.0 }
    }

    /// Whether the numbers make sense.
    ///
    /// # Errors
    /// If one is out of range.
    pub fn check(&self) -> Result<()> {
        check_range("camera_optimizer.coarse", self.coarse, 0.0, 1.0)?;
        check_schedule("camera_optimizer.focal", self.focal)?;
        check_schedule("camera_optimizer.lens", self.lens)
    }
}

/// A part of what cameras did that can be learned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RefinedParam {
    /// Where it was and how it was held, for each photograph.
    Poses,
    /// Its focal length.
    Focal,
    /// The coefficients of its lens.
    Lens,
    /// How bright it made what it saw, and of what white balance, for each photograph.
    Exposure,
    /// How dark it made the corners of its photographs.
    Vignetting,
}

impl FromStr for RefinedParam {
    type Err = Error;
    fn from_str(name: &str) -> Result<Self> {
        let all = [
            RefinedParam::Poses,
            RefinedParam::Focal,
            RefinedParam::Lens,
            RefinedParam::Exposure,
            RefinedParam::Vignetting,
        ];
        all.into_iter().find(|part| part.to_string() == name).ok_or_else(|| {
            let what = format!("there is no `{name}`; use poses, focal, lens, exposure or vignetting");
            Error::setting("camera_optimizer", what)
        })
    }
}

impl fmt::Display for RefinedParam {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            RefinedParam::Poses => POSES,
            RefinedParam::Focal => FOCAL,
            RefinedParam::Lens => LENS,
            RefinedParam::Exposure => EXPOSURE,
            RefinedParam::Vignetting => VIGNETTING,
        })
    }
}
