//! How far scenes go.

use crate::error::{Error, Result};
use crate::range::by_name;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// How far a scene goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SceneType {
    /// It ends at its box: an object before a background that is transparent or of one colour.
    Bounded,
    /// It goes on beyond its box, and photographs show what is there.
    Unbounded,
    /// So does this one, and all photographs look the same way: see [`Ndc`](crate::Ndc).
    #[serde(alias = "forward")]
    ForwardFacing,
}

impl SceneType {
    /// Whether it goes on beyond its box.
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
            Error::setting("scene-type", format!("`{text}` is not bounded, unbounded or forward-facing"))
        })
    }
}
