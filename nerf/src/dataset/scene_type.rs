//! The type of scene.

use crate::error::{Error, Result};
use crate::range::by_name;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// The type of scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SceneType {
    /// Bounded by its box: an object before a transparent or plain background.
    Bounded,
    /// Unbounded: the images show a background beyond the scene box.
    Unbounded,
    /// Forward-facing: unbounded, and all cameras look the same way at one part of the scene; see [`Ndc`](crate::Ndc).
    #[serde(alias = "forward")]
    ForwardFacing,
}

impl SceneType {
    /// Returns whether the scene extends beyond its box (unbounded or forward-facing).
    pub fn is_unbounded(self) -> bool {
        self != SceneType::Bounded
    }
}

impl fmt::Display for SceneType {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for SceneType {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        by_name(text).ok_or_else(|| {
            Error::setting("scene-type", format!("is `{text}`; use bounded, unbounded or forward-facing"))
        })
    }
}
