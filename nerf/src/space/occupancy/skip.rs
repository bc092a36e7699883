//! Skipping of empty space, by error bound.

use crate::range::{by_name, check_range};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;

/// A preset of [`Skipping`], by its error bound.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Skip {
    /// Skips nothing within the scene box.
    Off,
    /// Skips an optical depth of at most 1/200 along a ray. 8 bits do not show it, except in fog at the threshold.
    #[default]
    #[serde(alias = "lossless")]
    NearLossless,
    /// Skips an optical depth of at most 1/20 along a ray.
    Fast,
}

impl Skip {
    /// Returns the optical depth that may be skipped along one ray.
    pub fn max_depth(self) -> f64 {
        match self {
            Skip::Off => 0.0,
            Skip::NearLossless => 0.005,
            Skip::Fast => 0.05,
        }
    }

    /// Returns the largest change of a colour by skipped cells, as a share of the range of colours: `1 - e^-max_depth`.
    ///
    /// Views also end rays early and leave out colours. [`Skipping::early_stop_eps`] and [`Skipping::colors`] add to
    /// this bound: about 0.52 % in all for [`Skip::NearLossless`], and 5.2 % for [`Skip::Fast`].
    pub fn error_bound(self) -> f64 {
        -(-self.max_depth()).exp_m1()
    }

    /// Returns the density (1 / scene unit) up to which cells may be skipped, for paths of at most `path` scene units:
    /// `max_depth / path`, or minus infinity for [`Skip::Off`].
    ///
    /// With 500 steps along the path, that is 1e-5 of optical depth per step for [`Skip::NearLossless`] and 1e-4 for
    /// [`Skip::Fast`].
    ///
    /// # Panics
    /// If `path` is not above 0.
    pub fn min_sigma(self, path: f64) -> f32 {
        assert!(path > 0.0, "the path length must be above 0, is {path}");
        match self {
            Skip::Off => f32::NEG_INFINITY,
            Skip::NearLossless | Skip::Fast => (self.max_depth() / path) as f32,
        }
    }
}

/// Skipping in training and renders, with one field per technique. In a file it is the name of a [`Skip`], or an object
/// with these fields.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(from = "Stored")]
pub struct Skipping {
    /// Whether training skips cells with little density. Views skip these cells too.
    pub grid: bool,
    /// Visual hull carving: number of images that must show a cell as transparent before it becomes empty. Two or
    /// more protect against one wrong mask. Of fewer than 17 images, one in eight is enough. 0 carves nothing.
    /// `--carve` sets it. Unit: images.
    pub carving: u32,
    /// Optical depth that views may skip along a ray, in cells of low density. A pixel changes by at most as much,
    /// times the range of colours. Range: 0 to 1.
    pub pruning: f64,
    /// Early termination in views: a ray ends where the transmittance is below this. A pixel changes by at most as
    /// much. Range: 0 to 1.
    pub early_stop_eps: f64,
    /// Total weight of the samples of a ray whose colours views may leave out. A pixel changes by at most as much.
    /// Quadratures with two nodes an interval evaluate every colour. Range: 0 to 1.
    pub colors: f64,
}

/// The number of images that must agree that a cell is empty.
const VOTES: u32 = 3;

impl From<Skip> for Skipping {
    fn from(skip: Skip) -> Self {
        let (grid, carving, pruning) = (true, VOTES, skip.max_depth());
        match skip {
            Skip::Off => Skipping { grid: false, carving: 0, pruning, early_stop_eps: 0.0, colors: 0.0 },
            Skip::NearLossless => Skipping { grid, carving, pruning, early_stop_eps: 1e-4, colors: 1e-4 },
            Skip::Fast => Skipping { grid, carving, pruning, early_stop_eps: 1e-3, colors: 2e-3 },
        }
    }
}

/// The form in files.
#[derive(Deserialize)]
#[serde(untagged, deny_unknown_fields)]
enum Stored {
    Named(Skip),
    Each {
        grid: bool,
        carving: u32,
        pruning: f64,
        #[serde(alias = "termination")]
        early_stop_eps: f64,
        colors: f64,
    },
}

impl From<Stored> for Skipping {
    fn from(stored: Stored) -> Self {
        match stored {
            Stored::Named(skip) => skip.into(),
            Stored::Each { grid, carving, pruning, early_stop_eps, colors } => {
                Skipping { grid, carving, pruning, early_stop_eps, colors }
            }
        }
    }
}

impl Skipping {
    /// Checks that all values are in range.
    ///
    /// # Errors
    /// If a value is out of range.
    pub fn check(&self) -> Result<()> {
        check_range("occupancy.skip.pruning", self.pruning, 0.0, 1.0)?;
        check_range("occupancy.skip.early_stop_eps", self.early_stop_eps, 0.0, 1.0)?;
        check_range("occupancy.skip.colors", self.colors, 0.0, 1.0)
    }
}

impl fmt::Display for Skip {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl FromStr for Skip {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        by_name(name).ok_or_else(|| Error::setting("skip", format!("is `{name}`; use off, near-lossless or fast")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn skipping_is_read_from_a_name_or_fields() {
        let read = |text: &str| serde_json::from_str::<Skipping>(text);
        for skip in [Skip::Off, Skip::NearLossless, Skip::Fast] {
            let switches = Skipping::from(skip);
            assert_eq!(read(&format!("\"{skip}\"")).unwrap(), switches);
            assert_eq!(read(&serde_json::to_string(&switches).unwrap()).unwrap(), switches);
            assert!(switches.check().is_ok() && switches.pruning == skip.max_depth());
        }
        let none = Skipping::from(Skip::Off);
        assert!(!none.grid && none.carving == 0 && none.pruning + none.early_stop_eps + none.colors == 0.0);
        assert!(read(r#"{"grid": true, "carving": 1, "pruning": 0, "termination": 0}"#).is_err());
        let wrong = Skipping { colors: 1.5, ..none }.check().unwrap_err().to_string();
        assert!(wrong.starts_with("`occupancy.skip.colors`: is 1.5"), "{wrong}");
    }
}
