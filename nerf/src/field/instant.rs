//! A hash grid with two small networks (instant-ngp).

use super::{Density, DensityNetwork, Field, Fields, Grid, ViewInputs};
use crate::component::{BuildContext, ComponentConfig};
use crate::encoding::hash_grid::HashGridConfig;
use crate::encoding::spherical::SphericalHarmonics;
use crate::range::check_range;
use crate::{Error, Result};
use raygrad_autograd::{Activation, Scalar, Tensor, Var};
use raygrad_nn::{Bound, Init, Linear, ParamId};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Configuration of an [`Instant`] field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InstantConfig {
    /// Hash grid that encodes positions.
    pub grid: HashGridConfig,
    /// Width of the one hidden layer between the grid and the density. Range: 1 to 4096.
    pub density_width: usize,
    /// Outputs of the density network. The first is the logarithm of the density; the colour network sees all.
    /// Range: 1 to 4096.
    pub features: usize,
    /// Width of the hidden layers of the colour network. Range: 1 to 4096.
    pub color_width: usize,
    /// Number of hidden layers of the colour network. Range: 1 to 64.
    pub color_depth: usize,
    /// Degree of the spherical harmonics that encode directions. Range: 1 to 4.
    pub direction_degree: usize,
    /// Dimensions of the appearance embedding, a learned vector per image that the colour network sees. It absorbs
    /// changes of light and exposure (Martin-Brualla et al. 2021, "NeRF in the Wild", section 4.1). New views use
    /// the mean of all embeddings. 0 learns none. Range: 0 to 256.
    #[serde(default)]
    #[serde(alias = "codes")]
    pub appearance_embedding_dim: usize,
    /// Gradient cut of the hash grid. A sample does not change a level of the table if all gradients of its features are
    /// small: at most this share of their root mean square over a tile. Steps become faster, and slightly biased. The
    /// dropped gradient of the features is at most this share, in the Euclidean norm. 0 drops nothing. Range: 0 to 1.
    #[serde(default)]
    pub gradient_cut: f64,
}

impl ComponentConfig<Fields> for InstantConfig {
    const KIND: &'static str = "instant";

    fn check(&self) -> Result<()> {
        check_range("density_width", self.density_width, 1, 1 << 12)?;
        check_range("features", self.features, 1, 1 << 12)?;
        check_range("color_width", self.color_width, 1, 1 << 12)?;
        check_range("color_depth", self.color_depth, 1, 64)?;
        check_range("direction_degree", self.direction_degree, 1, 4)?;
        check_range("appearance_embedding_dim", self.appearance_embedding_dim, 0, 256)?;
        check_range("gradient_cut", self.gradient_cut, 0.0, 1.0)
    }

    fn build<T: Scalar>(&self, site: BuildContext<'_, T>) -> Result<Arc<dyn Field<T>>> {
        Ok(Arc::new(Instant::new(self, site)?))
    }
}

/// The field of instant-ngp (Mueller et al. 2022, section 5.4).
///
/// A multiresolution hash grid feeds a density network of one hidden layer. Its outputs and the direction feed a colour
/// network. No layer has a bias. The density is the exponential of the first output.
#[derive(Debug, Clone)]
pub struct Instant {
    density: DensityNetwork,
    direction: SphericalHarmonics,
    color: Vec<Linear>,
    /// The appearance embeddings, if any.
    codes: Option<ParamId>,
}

impl Instant {
    /// Creates a field with parameters `<name>...`; appearance embeddings start at 0.
    ///
    /// # Errors
    /// If the configuration is out of range, or has appearance embeddings and `site.frames` is 0.
    pub fn new<T: Scalar>(config: &InstantConfig, mut site: BuildContext<'_, T>) -> Result<Self> {
        config.check()?;
        let InstantConfig {
            density_width, features, color_width, color_depth, appearance_embedding_dim: codes, ..
        } = *config;
        let mut density = DensityNetwork::new(&config.grid, density_width, features, site.child(site.name))?;
        density.grid = density.grid.with_gradient_cut(config.gradient_cut);
        let BuildContext { frames, params, name, rng, .. } = site;
        let direction = SphericalHarmonics::new(config.direction_degree);
        let mut color = Vec::with_capacity(color_depth + 1);
        for i in 0..=color_depth {
            let inputs = if i == 0 { features + direction.width() + codes } else { color_width };
            let last = i == color_depth;
            let (outputs, activation) = if last { (3, Activation::Identity) } else { (color_width, Activation::Relu) };
            let name = format!("{name}.color.{i}");
            color.push(Linear::without_bias(params, &name, [inputs, outputs], activation, Init::He, &mut *rng));
        }
        if codes > 0 && frames == 0 {
            return Err(Error::setting(
                "appearance_embedding_dim",
                "needs the number of images; set `SceneBox::frames`",
            ));
        }
        let codes = (codes > 0).then(|| {
            let name = format!("{name}.codes");
            let id = params.add(&name, Tensor::zeros(&[frames, codes]));
            // Sparse updates, since a step uses few of the images.
            params.set_lazy(|other| other == name, true);
            id
        });
        Ok(Instant { density, direction, color, codes })
    }

    /// Returns the grid.
    pub fn grid(&self) -> &Grid {
        &self.density.grid
    }
}

impl<T: Scalar> Field<T> for Instant {
    fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
        self.density.density(params, positions)
    }

    fn color<'t>(&self, params: &Bound<'t, T>, features: &Var<'t, T>, seen: &ViewInputs<'_, 't, T>) -> Var<'t, T> {
        let directions = features.tape().apply(self.direction, &[seen.directions]).segment_expand(seen.segments);
        let mut hidden = match self.codes.map(|codes| &params[codes]) {
            None => Var::concat(&[features, &directions], 1),
            Some(codes) => {
                let rays = match seen.frames {
                    Some(frames) => codes.gather_rows(frames),
                    None => codes.mean_over(0).broadcast_to(&[seen.segments.len(), codes.shape()[1]]),
                };
                Var::concat(&[features, &directions, &rays.segment_expand(seen.segments)], 1)
            }
        };
        for layer in &self.color {
            hidden = layer.forward(params, &hidden);
        }
        hidden.sigmoid()
    }

    fn with_detail(&self, detail: f64) -> Option<Arc<dyn Field<T>>> {
        Some(Arc::new(Instant { density: self.density.with_detail(detail), ..self.clone() }))
    }
}
