//! The quadrature rules.

use crate::Result;
use crate::range::check_range;
use serde::{Deserialize, Serialize};
use std::fmt;

/// A quadrature rule for the integral along a ray.
///
/// In a configuration it is a word, such as `"gauss2"`, or `{"adaptive": {"tolerance": 1e-3}}`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Quadrature {
    /// One evaluation at the near end of each interval (Mildenhall et al. 2020, equation 3). The last interval ends
    /// where the ray does.
    Left,
    /// One evaluation at the centre of each interval, or at a random place in training.
    #[default]
    Midpoint,
    /// One evaluation at each end of an interval, shared with the next. Density is linear in between, with the mean
    /// colour (Uy et al. 2023, "NeRF Revisited", with the mean in place of the near colour).
    PiecewiseLinear,
    /// Two evaluations in each interval, at the nodes of Gauss's rule. Colour is linear in optical depth
    /// ([`gauss_share`](super::gauss_share)).
    Gauss2,
    /// One evaluation at each end of an interval too, but halves intervals until halving changes a pixel by less than
    /// `tolerance`. Each round evaluates colours.
    Adaptive {
        /// Change of a pixel below which an interval is not halved further. Range: 0.000000001 to 1.
        tolerance: f64,
    },
}

impl Quadrature {
    /// Checks that all values are in range.
    ///
    /// # Errors
    /// If a value is out of range.
    pub fn check(self) -> Result<()> {
        match self {
            Quadrature::Adaptive { tolerance } => check_range("quadrature.adaptive.tolerance", tolerance, 1e-9, 1.0),
            _ => Ok(()),
        }
    }

    /// Returns the order of convergence in the interval length for smooth scenes, or `None` if intervals differ in
    /// length.
    pub fn order(self) -> Option<u32> {
        match self {
            Quadrature::Left => Some(1),
            Quadrature::Midpoint | Quadrature::PiecewiseLinear => Some(2),
            Quadrature::Gauss2 => Some(4),
            Quadrature::Adaptive { .. } => None,
        }
    }
}

impl fmt::Display for Quadrature {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Quadrature::Left => f.pad("left"),
            Quadrature::Midpoint => f.pad("midpoint"),
            Quadrature::PiecewiseLinear => f.pad("piecewise-linear"),
            Quadrature::Gauss2 => f.pad("gauss2"),
            Quadrature::Adaptive { tolerance } => f.pad(&format!("adaptive {tolerance:.0e}")),
        }
    }
}
