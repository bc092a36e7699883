//! The map from the scene to the unit cube.

use super::contraction::contract;
use crate::camera::Ndc;
use crate::range::check_bounds;
use crate::{Error, Result};
use glam::{DMat3, DVec3};
use raygrad_autograd::{Scalar, Tensor, Var};
use serde::{Deserialize, Serialize};

/// The map from scene units to the unit cube of encodings and grids.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Space {
    /// Lower and upper corner of the scene box, in scene units.
    pub bounds: [DVec3; 2],
    /// Whether the scene is unbounded: all of space is then [contracted](crate::contract) into the cube. The ball
    /// around the box's centre that touches its nearest sides maps to a ball of radius 1/4.
    #[serde(default)]
    pub unbounded: bool,
    /// The unit of length of densities, in scene units: a density of 1 is 1 / `unit`. Files of early versions imply 1.
    #[serde(default = "crate::range::one")]
    pub unit: f64,
    /// The NDC frustum of a forward-facing scene, which then maps to the cube instead of all space.
    #[serde(default)]
    pub ndc: Option<Ndc>,
}

/// The longest side of a box in its own units. A new field is then equally opaque for any unit of the scene.
const UNITS: f64 = 3.0;

impl Space {
    /// Creates the map of a bounded scene, from its box (lower and upper corner, scene units).
    pub fn within(bounds: [DVec3; 2]) -> Self {
        let unit = (bounds[1] - bounds[0]).max_element() / UNITS;
        Space { bounds, unbounded: false, unit, ndc: None }
    }

    /// Checks that all values are in range.
    ///
    /// # Errors
    /// If a corner is not finite or the lower one is not below the upper one along each axis, if `unit` is not above 0,
    /// or as [`Ndc::check`].
    pub fn check(&self) -> Result<()> {
        check_bounds(self.bounds)?;
        self.ndc.as_ref().map_or(Ok(()), Ndc::check)?;
        if self.unit > 0.0 && self.unit.is_finite() {
            return Ok(());
        }
        Err(Error::setting("unit", format!("is {}; use a length above 0", self.unit)))
    }

    /// Returns the longest side of the box, in scene units.
    pub fn side(&self) -> f64 {
        (self.bounds[1] - self.bounds[0]).max_element()
    }

    /// Maps positions `[samples, 3]` from scene units to the unit cube.
    ///
    /// For a bounded scene the box's lower corner maps to the origin, and its longest side has length 1; points outside
    /// of a cubic box map outside of the cube. In [NDC](Ndc) the last axis is `1 - near / depth`, from the near plane to
    /// infinity.
    #[track_caller]
    pub fn cube<'t, T: Scalar>(&self, positions: &Var<'t, T>) -> Var<'t, T> {
        let row = |x: DVec3| positions.tape().constant(Tensor::from_vec(&[3], x.to_array().map(T::from_f64).to_vec()));
        let [low, high] = self.bounds;
        if !self.unbounded {
            let scale = 1.0 / self.side();
            return positions * scale + row(-low * scale);
        }
        if let Some(ndc) = &self.ndc {
            return project(ndc, &(positions - row(ndc.eye)));
        }
        let scale = 2.0 / (high - low).min_element();
        contract(&(positions * scale + row(-0.5 * (low + high) * scale))) * 0.25 + 0.5
    }

    /// Maps positions `[samples, 3]` from scene units to the cube from -1 to 1 around the box's centre, for positional
    /// encodings. The longest side of a bounded box spans -1 to 1.
    #[track_caller]
    pub fn centred<'t, T: Scalar>(&self, positions: &Var<'t, T>) -> Var<'t, T> {
        if self.unbounded {
            return self.cube(positions) * 2.0 - 1.0;
        }
        let centre = (0.5 * (self.bounds[0] + self.bounds[1])).to_array().map(T::from_f64);
        (positions - positions.tape().constant(Tensor::from_vec(&[3], centre.to_vec()))) * (2.0 / self.side())
    }
}

/// Projects offsets from the eye, `[samples, 3]`, to normalised device coordinates.
#[track_caller]
fn project<'t, T: Scalar>(ndc: &Ndc, offsets: &Var<'t, T>) -> Var<'t, T> {
    let tape = offsets.tape();
    // In halves of the frustum's sides at the near plane, with depth in units of the near plane.
    let across = ndc.slopes.map(|slope| 0.5 / (slope * ndc.near));
    let local = ndc.axes * DMat3::from_diagonal(DVec3::new(across[0], across[1], -1.0 / ndc.near));
    let local = local.transpose().to_cols_array().map(T::from_f64).to_vec();
    let local = offsets.matmul(tape.constant(Tensor::from_vec(&[3, 3], local)));
    let depth = local.slice_axis(1, 2..).maximum(1.0);
    Var::concat(&[&(local.slice_axis(1, ..2) / &depth + 0.5), &(1.0 - depth.reciprocal())], 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::Tape;

    #[test]
    fn ndc_maps_the_frustum_to_the_cube() {
        // From (1, 2, 3) along +y: right is x, up is z, back is -y.
        let axes = DMat3::from_cols(DVec3::X, DVec3::Z, DVec3::NEG_Y);
        let ndc = Ndc { eye: DVec3::new(1.0, 2.0, 3.0), axes, slopes: [0.5, 0.25], near: 2.0 };
        let within = Space::within([DVec3::NEG_ONE, DVec3::ONE]);
        let space = Space { unbounded: true, ndc: Some(ndc), ..within };
        space.check().unwrap();
        let tape = Tape::<f64>::new();
        // At the near plane and its left border; twice as far, at the upper border; far away; in front of the near
        // plane; behind the eye.
        let points =
            [[1.0, 4.0, 3.0], [0.0, 4.0, 3.0], [1.0, 6.0, 4.0], [1.0, 2e9, 3.0], [1.5, 3.0, 3.0], [1.5, -9.0, 3.0]];
        let cube = space.cube(&tape.constant(Tensor::from(points)));
        let expected = [
            [0.5, 0.5, 0.0],
            [0.0, 0.5, 0.0],
            [0.5, 1.0, 0.5],
            [0.5, 0.5, 1.0 - 1e-9],
            [0.75, 0.5, 0.0],
            [0.75, 0.5, 0.0],
        ];
        for (got, expected) in cube.value().as_slice().iter().zip(expected.as_flattened()) {
            assert!((got - expected).abs() < 1e-12, "{:?}", cube.value());
        }
        // Lines stay lines, and inverse depth is uniform along them.
        let line = [1.0, 2.0, 4.0].map(|t| [1.0 + 0.1 * t, 2.0 + 4.0 * t, 3.0 + 0.3 - 0.2 * t]);
        let line = space.cube(&tape.constant(Tensor::from(line)));
        let [a, b, c] = [0, 1, 2].map(|i| DVec3::from_slice(&line.value().as_slice()[3 * i..]));
        assert!((b - a).cross(c - a).length() < 1e-12 && ((b - a).z / (c - b).z - 2.0).abs() < 1e-12, "{a} {b} {c}");
        let wrong = Space { ndc: Some(Ndc { near: 0.0, ..ndc }), ..space };
        assert!(wrong.check().unwrap_err().to_string().contains("`ndc`"));
        // A bounded scene ignores it.
        let bounded = Space { unbounded: false, ..space };
        let point = tape.constant(Tensor::from([[0.2, 0.4, 0.6]]));
        assert_eq!(bounded.cube(&point).value(), within.cube(&point).value());
    }

    #[test]
    fn space_maps_to_the_cube_contracted_if_unbounded() {
        let bounds = [DVec3::new(-1.0, 0.0, 2.0), DVec3::new(3.0, 2.0, 4.0)];
        let tape = Tape::<f64>::new();
        let points = [[-1.0, 0.0, 2.0], [3.0, 2.0, 4.0], [1.0, 1.0, 3.0], [1.0, 1.0, 1e9], [1.0, 1.5, 3.0]];
        let points = tape.constant(Tensor::from(points));
        let within = Space::within(bounds);
        let unit = within.cube(&points);
        assert_eq!(&unit.value().as_slice()[..9], [0.0, 0.0, 0.0, 1.0, 0.5, 0.5, 0.5, 0.25, 0.25]);
        let centred = within.centred(&points);
        assert_eq!(&centred.value().as_slice()[..9], [-1.0, -0.5, -0.5, 1.0, 0.5, 0.5, 0.0, 0.0, 0.0]);
        let all = Space { unbounded: true, ..within }.cube(&points);
        let far = &all.value().as_slice()[6..];
        assert!(far[..3] == [0.5; 3] && far[3..5] == [0.5; 2] && (far[5] - 1.0).abs() < 1e-4, "{far:?}");
        assert!((far[7] - 0.625).abs() < 1e-12, "half a unit of the ball of radius 1 is an eighth: {far:?}");
        let centred = Space { unbounded: true, ..within }.centred(&points);
        let pairs = centred.value().as_slice().iter().zip(all.value().as_slice());
        assert!(pairs.clone().count() == 15 && pairs.clone().all(|(c, u)| (c - (2.0 * u - 1.0)).abs() < 1e-15));
        assert_eq!((within.side(), within.unit), (4.0, 4.0 / 3.0));
        let error = Space::within([DVec3::ONE, DVec3::ONE]).check().unwrap_err().to_string();
        assert!(error.contains("use finite corners, the lower below the upper"), "{error}");
    }
}
