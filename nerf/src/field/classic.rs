//! The network of the NeRF paper.

use super::{Density, DensityActivation, Field};
use crate::encoding::sinusoids::PositionalEncoding;
use crate::range::{check_parameters, check_range};
use crate::{Error, Result};
use glam::DVec3;
use rand::Rng;
use raygrad_autograd::{Activation, Scalar, Segments, Tensor, Var};
use raygrad_nn::{Bound, Init, Linear, Mlp, Params};
use serde::{Deserialize, Serialize};

/// Size and shape of a [`Classic`] field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClassicConfig {
    /// Number of layers that see the position.
    pub depth: usize,
    /// Their width.
    pub width: usize,
    /// The layers, counted from 0, that see the encoded position once more.
    pub skips: Vec<usize>,
    /// Width of the layer that sees the direction.
    pub view_width: usize,
    /// Frequencies of the encoding of positions; 0 gives the network the bare coordinates.
    pub position_levels: usize,
    /// Frequencies of the encoding of directions.
    pub direction_levels: usize,
    /// How the raw density becomes a density.
    pub density: DensityActivation,
}

impl ClassicConfig {
    /// The paper's network: 8 layers of 256, the position again at the sixth, 128 for the direction, 10 and 4
    /// frequencies. Density is softplus instead of the paper's ReLU.
    pub fn paper() -> Self {
        ClassicConfig {
            depth: 8,
            width: 256,
            skips: vec![5],
            view_width: 128,
            position_levels: 10,
            direction_levels: 4,
            density: DensityActivation::Softplus,
        }
    }

    fn check(&self) -> Result<()> {
        let positive = [("depth", self.depth), ("width", self.width), ("view_width", self.view_width)];
        for (name, value) in positive {
            check_range(name, value, 1, 1 << 14)?;
        }
        check_parameters(self.depth * self.width * (self.width + 200))?;
        if self.position_levels > 24 || self.direction_levels > 24 {
            return Err(Error::setting("position_levels", "more than 24 frequencies are beyond the precision of f32"));
        }
        match self.skips.iter().find(|&&skip| !(1..self.depth).contains(&skip)) {
            Some(skip) => {
                Err(Error::setting("skips", format!("layer {skip} of {} cannot take the input again", self.depth)))
            }
            None => Ok(()),
        }
    }
}

/// The NeRF paper's field (Mildenhall et al. 2020, figure 7): positions through a deep stack to density and a feature
/// vector, which together with the direction gives colour. Positions are scaled so that the scene's box becomes -1..1.
#[derive(Debug, Clone)]
pub struct Classic {
    config: ClassicConfig,
    /// `(x - centre) * scale` lies in -1..1 within the box.
    centre: DVec3,
    scale: f64,
    trunk: Mlp,
    density: Linear,
    feature: Linear,
    view: Linear,
    color: Linear,
}

impl Classic {
    /// A field for the box `bounds` (lower and upper corner) with new parameters `<name>...` in `params`.
    ///
    /// # Errors
    /// If the configuration is out of range.
    pub fn new<T: Scalar>(
        config: &ClassicConfig,
        bounds: [DVec3; 2],
        params: &mut Params<T>,
        name: &str,
        rng: &mut (impl Rng + ?Sized),
    ) -> Result<Self> {
        config.check()?;
        let ClassicConfig { width, view_width, .. } = *config;
        let positions = PositionalEncoding { levels: config.position_levels, input: true }.width(3);
        let directions = PositionalEncoding { levels: config.direction_levels, input: true }.width(3);
        let trunk = Mlp::new(params, &format!("{name}.trunk"), [positions, width, config.depth], &config.skips, rng);
        let mut layer = |part: &str, sizes, activation, init| {
            Linear::new(params, &format!("{name}.{part}"), sizes, activation, init, &mut *rng)
        };
        Ok(Classic {
            config: config.clone(),
            centre: 0.5 * (bounds[0] + bounds[1]),
            scale: 2.0 / (bounds[1] - bounds[0]).max_element(),
            trunk,
            density: layer("density", [width, 1], Activation::Identity, Init::Glorot),
            feature: layer("feature", [width, width], Activation::Identity, Init::Glorot),
            view: layer("view", [width + directions, view_width], Activation::Relu, Init::He),
            color: layer("color", [view_width, 3], Activation::Identity, Init::Glorot),
        })
    }

    #[track_caller]
    fn sinusoids<'t, T: Scalar>(&self, x: &Var<'t, T>, levels: usize) -> Var<'t, T> {
        x.tape().apply(PositionalEncoding { levels, input: true }, &[x])
    }
}

impl<T: Scalar> Field<T> for Classic {
    fn encode<'t>(&self, _params: &Bound<'t, T>, positions: &Var<'t, T>) -> Var<'t, T> {
        let centre = self.centre.to_array().map(T::from_f64);
        let centre = positions.tape().constant(Tensor::from_vec(&[3], centre.to_vec()));
        self.sinusoids(&((positions - centre) * self.scale), self.config.position_levels)
    }

    fn encode_known<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>, known: Tensor<T>) -> Var<'t, T> {
        // Nothing to learn from: without a gradient of the positions the encoding is a constant.
        if positions.is_on_graph() { self.encode(params, positions) } else { positions.tape().constant(known) }
    }

    fn density<'t>(&self, params: &Bound<'t, T>, encoding: &Var<'t, T>) -> Density<'t, T> {
        let features = self.trunk.forward(params, encoding);
        let raw = self.density.forward(params, &features).reshape(&[encoding.shape()[0]]);
        Density { value: self.config.density.apply(&raw), log: false, features }
    }

    fn color<'t>(
        &self,
        params: &Bound<'t, T>,
        features: &Var<'t, T>,
        directions: &Var<'t, T>,
        segments: &Segments,
    ) -> Var<'t, T> {
        let feature = self.feature.forward(params, features);
        let seen = self.sinusoids(directions, self.config.direction_levels).segment_expand(segments);
        let hidden = self.view.forward(params, &Var::concat(&[&feature, &seen], 1));
        self.color.forward(params, &hidden).sigmoid()
    }
}
