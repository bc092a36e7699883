//! The network of the NeRF paper (Mildenhall et al. 2020).

use super::{Density, DensityActivation, Field, Fields, ViewInputs};
use crate::component::{BuildContext, ComponentConfig};
use crate::encoding::detail_weights;
use crate::encoding::sinusoids::PositionalEncoding;
use crate::range::{check_parameters, check_range};
use crate::space::cube::Space;
use crate::{Error, Result};
use raygrad_autograd::{Activation, Scalar, Tensor, Var};
use raygrad_nn::{Bound, Init, Linear, Mlp};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Frequencies that coarse-to-fine training enables from the start: they distinguish the halves of the box.
const FIRST_LEVELS: usize = 2;

/// Configuration of a [`Classic`] field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClassicConfig {
    /// Number of layers that see the position. Range: 1 to 16384.
    pub depth: usize,
    /// Width of these layers. Range: 1 to 16384.
    pub width: usize,
    /// Layers, counted from 0, that see the encoded position once more (skip connections). Range: 1 to `depth` - 1
    /// each.
    #[serde(alias = "skips")]
    pub skip_layers: Vec<usize>,
    /// Width of the layer that sees the viewing direction. Range: 1 to 16384.
    pub view_width: usize,
    /// Frequencies of the positional encoding of positions. 0 passes bare coordinates. Range: 0 to 24.
    pub position_levels: usize,
    /// Frequencies of the positional encoding of directions. 0 passes bare directions. Range: 0 to 24.
    pub direction_levels: usize,
    /// Activation that turns the raw output into a density.
    pub density: DensityActivation,
}

impl ClassicConfig {
    /// Returns the paper's network: 8 layers of 256 with a skip connection at the sixth, 128 for the direction, 10 and
    /// 4 frequencies. The density is softplus instead of the paper's ReLU.
    pub fn paper() -> Self {
        ClassicConfig {
            depth: 8,
            width: 256,
            skip_layers: vec![5],
            view_width: 128,
            position_levels: 10,
            direction_levels: 4,
            density: DensityActivation::Softplus,
        }
    }
}

impl ComponentConfig<Fields> for ClassicConfig {
    const KIND: &'static str = "classic";

    fn check(&self) -> Result<()> {
        let positive = [("depth", self.depth), ("width", self.width), ("view_width", self.view_width)];
        for (name, value) in positive {
            check_range(name, value, 1, 1 << 14)?;
        }
        check_parameters(self.depth * self.width * (self.width + 200))?;
        // f32 cannot resolve more frequencies.
        for (name, value) in [("position_levels", self.position_levels), ("direction_levels", self.direction_levels)] {
            check_range(name, value, 0, 24)?;
        }
        match self.skip_layers.iter().find(|&&skip| !(1..self.depth).contains(&skip)) {
            Some(skip) => Err(Error::setting(
                "skip_layers",
                format!("has layer {skip}; use layers from 1 to below `depth` ({})", self.depth),
            )),
            None => Ok(()),
        }
    }

    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<Arc<dyn Field<T>>> {
        Ok(Arc::new(Classic::new(self, site)?))
    }
}

/// The field of the NeRF paper (Mildenhall et al. 2020, figure 7).
///
/// A deep network maps the encoded position to a density and a feature vector; with the direction, that gives the
/// colour. Positions are scaled so that the scene box becomes -1 to 1.
#[derive(Debug, Clone)]
pub struct Classic {
    config: ClassicConfig,
    space: Space,
    trunk: Mlp,
    density: Linear,
    feature: Linear,
    view: Linear,
    color: Linear,
    /// The weight of each frequency of positions; `None` if all are 1.
    weights: Option<Arc<[f64]>>,
}

impl Classic {
    /// Creates a field with parameters `<name>...`.
    ///
    /// # Errors
    /// If the configuration is out of range.
    pub fn new<T: Scalar>(config: &ClassicConfig, site: BuildContext<'_, T>) -> Result<Self> {
        let BuildContext { space, params, name, rng, .. } = site;
        config.check()?;
        let ClassicConfig { width, view_width, .. } = *config;
        let positions = PositionalEncoding { levels: config.position_levels, input: true }.width(3);
        let directions = PositionalEncoding { levels: config.direction_levels, input: true }.width(3);
        let trunk =
            Mlp::new(params, &format!("{name}.trunk"), [positions, width, config.depth], &config.skip_layers, rng);
        let mut layer = |part: &str, sizes, activation, init| {
            Linear::new(params, &format!("{name}.{part}"), sizes, activation, init, &mut *rng)
        };
        Ok(Classic {
            config: config.clone(),
            space,
            trunk,
            density: layer("density", [width, 1], Activation::Identity, Init::Glorot),
            feature: layer("feature", [width, width], Activation::Identity, Init::Glorot),
            view: layer("view", [width + directions, view_width], Activation::Relu, Init::He),
            color: layer("color", [view_width, 3], Activation::Identity, Init::Glorot),
            weights: None,
        })
    }

    /// Returns the field with a share of the frequencies of positions enabled, 0 to 1, the lowest first: see
    /// [`detail_weights`].
    #[must_use]
    pub fn coarsened(&self, detail: f64) -> Self {
        let weights = detail_weights(detail, self.config.position_levels, FIRST_LEVELS).map(Into::into);
        Classic { weights, ..self.clone() }
    }

    #[track_caller]
    fn sinusoids<'t, T: Scalar>(&self, x: &Var<'t, T>, levels: usize) -> Var<'t, T> {
        x.tape().apply(PositionalEncoding { levels, input: true }, &[x])
    }
}

impl<T: Scalar> Field<T> for Classic {
    fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
        let mut encoding = self.sinusoids(&self.space.centred(positions), self.config.position_levels);
        if let Some(weights) = &self.weights {
            // The bare coordinates come first, then per frequency the sine and cosine of each.
            let row = Tensor::from_fn(&[3 + 6 * weights.len()], |i| {
                T::from_f64(if i < 3 { 1.0 } else { weights[(i - 3) / 6] })
            });
            encoding *= positions.tape().constant(row);
        }
        let features = self.trunk.forward(params, &encoding);
        let raw = self.density.forward(params, &features).reshape(&[positions.shape()[0]]);
        let value = self.config.density.apply(&raw);
        let value = if self.space.unit == 1.0 { value } else { value * (1.0 / self.space.unit) };
        Density { value, log: false, features }
    }

    fn color<'t>(&self, params: &Bound<'t, T>, features: &Var<'t, T>, seen: &ViewInputs<'_, 't, T>) -> Var<'t, T> {
        let feature = self.feature.forward(params, features);
        let directions = self.sinusoids(seen.directions, self.config.direction_levels).segment_expand(seen.segments);
        let hidden = self.view.forward(params, &Var::concat(&[&feature, &directions], 1));
        self.color.forward(params, &hidden).sigmoid()
    }

    fn with_detail(&self, detail: f64) -> Option<Arc<dyn Field<T>>> {
        Some(Arc::new(self.coarsened(detail)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;
    use raygrad_autograd::Tape;
    use raygrad_nn::Params;

    #[test]
    fn detail_enables_low_frequencies_first() {
        let config = ClassicConfig { depth: 1, width: 8, skip_layers: vec![], view_width: 4, ..ClassicConfig::paper() };
        let config = ClassicConfig { position_levels: 6, ..config };
        let mut params = Params::<f64>::new();
        let (space, rng) = (Space::within([DVec3::NEG_ONE, DVec3::ONE]), &mut Pcg64Mcg::seed_from_u64(5));
        let field =
            Classic::new(&config, BuildContext { space, frames: 0, params: &mut params, name: "field", rng }).unwrap();
        // The influence of each input of the first layer: the bare coordinates, then six numbers per frequency.
        let inputs = |detail: f64| {
            let tape = Tape::new();
            let bound = params.bind(&tape);
            let positions = tape.constant(Tensor::from([[0.31, -0.57, 0.83], [0.12, 0.44, -0.95]]));
            let density = field.coarsened(detail).density(&bound, &positions);
            let layer = params.ids().position(|id| params.get(id).shape() == [39, 8]).unwrap();
            let grads = density.value.sum().grad(&[bound.vars()[layer]]);
            let rows = grads[0].as_slice().chunks_exact(8).map(|row| row.iter().map(|x| x.abs()).sum::<f64>());
            rows.collect::<Vec<f64>>()
        };
        let all = inputs(1.0);
        assert!(all.iter().all(|x| *x > 0.0), "{all:?}");
        // Two of six frequencies are always enabled. At 5/8 of the other four, the fifth is half enabled and the sixth
        // is not.
        for (detail, shares) in [(0.0, [1.0, 1.0, 0.0, 0.0, 0.0, 0.0]), (0.625, [1.0, 1.0, 1.0, 1.0, 0.5, 0.0])] {
            let some = inputs(detail);
            let expected = (0..39).map(|i: usize| if i < 3 { 1.0 } else { shares[(i - 3) / 6] } * all[i]);
            // The shares also change the activations, so only the zeros are compared.
            for (i, expected) in expected.enumerate() {
                assert_eq!(some[i] == 0.0, expected == 0.0, "{detail}: {i}");
            }
        }
    }
}
