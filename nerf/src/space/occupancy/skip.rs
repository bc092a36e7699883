//! How much empty-looking space may be skipped.

use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// What a grid may skip when rendering, by what it may cost.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Skip {
    /// Nothing but what lies outside of the box.
    Off,
    /// At most an optical depth of 1/200 along a ray: beyond what 8 bits show, except in fog at the threshold.
    #[default]
    Lossless,
    /// At most an optical depth of 1/20 along a ray.
    Fast,
}

impl Skip {
    /// The optical depth that may be skipped along one ray.
    pub fn max_depth(self) -> f64 {
        match self {
            Skip::Off => 0.0,
            Skip::Lossless => 0.005,
            Skip::Fast => 0.05,
        }
    }

    /// The largest change of a colour, as a share of the range of colours: `1 - e^-max_depth`.
    pub fn error_bound(self) -> f64 {
        -(-self.max_depth()).exp_m1()
    }

    /// The density (1 / scene unit) up to which cells may be skipped if a ray's path through all of them is no longer
    /// than `path` scene units: `max_depth / path`, and for [`Skip::Off`] minus infinity, which no density is below.
    ///
    /// With 500 steps along the path, that is 1e-5 of optical depth a step for [`Skip::Lossless`] and 1e-4 for
    /// [`Skip::Fast`].
    ///
    /// # Panics
    /// If the path is not longer than 0.
    pub fn min_sigma(self, path: f64) -> f32 {
        assert!(path > 0.0, "a path of length {path}");
        match self {
            Skip::Off => f32::NEG_INFINITY,
            Skip::Lossless | Skip::Fast => (self.max_depth() / path) as f32,
        }
    }
}

impl fmt::Display for Skip {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Skip::Off => "off",
            Skip::Lossless => "lossless",
            Skip::Fast => "fast",
        })
    }
}

impl FromStr for Skip {
    type Err = Error;
    fn from_str(name: &str) -> Result<Self> {
        match name {
            "off" => Ok(Skip::Off),
            "lossless" => Ok(Skip::Lossless),
            "fast" => Ok(Skip::Fast),
            _ => Err(Error::setting("skip", format!("there is no `{name}`; use off, lossless or fast"))),
        }
    }
}
