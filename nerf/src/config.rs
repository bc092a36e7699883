//! What to train and how: the presets and every number behind them.

use crate::background::Background;
use crate::field::{ClassicConfig, DensityActivation};
use crate::{Error, Result};
use raygrad_autograd::{AdamConfig, Schedule};
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// A named configuration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// The paper's networks and numbers: 64 + 128 samples, two networks of 8 layers of 256.
    Classic,
    /// A quarter of the depth and half of the width: a recognisable scene in minutes.
    Small,
}

impl FromStr for Preset {
    type Err = Error;
    fn from_str(name: &str) -> Result<Self> {
        match name {
            "classic" => Ok(Preset::Classic),
            "small" => Ok(Preset::Small),
            _ => Err(Error::setting("preset", format!("there is no `{name}`; use classic or small"))),
        }
    }
}

/// A model and how it is trained. It is stored with the model, so that a run can be read back.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The network that finds where to look.
    pub coarse: ClassicConfig,
    /// The network that is rendered.
    pub fine: ClassicConfig,
    /// Stratified samples a ray.
    pub coarse_samples: usize,
    /// Further samples a ray where the coarse network found something.
    pub fine_samples: usize,
    /// Share of the further samples that is spread evenly, in 0..=1.
    pub uniform_share: f64,
    /// Rays in a training step.
    pub batch: usize,
    /// Rays in a tile: one tape, on one core.
    pub tile: usize,
    /// Learning rate over the run.
    pub schedule: Schedule,
    /// The optimiser's constants.
    pub adam: AdamConfig,
    /// What photographs with alpha are composited over.
    pub background: Background,
    /// Seed of everything random.
    pub seed: u64,
}

impl Config {
    /// The numbers of a preset.
    pub fn preset(preset: Preset) -> Self {
        let paper = ClassicConfig::paper();
        let classic = Config {
            coarse: paper.clone(),
            fine: paper.clone(),
            coarse_samples: 64,
            fine_samples: 128,
            uniform_share: 0.01,
            batch: 1024,
            tile: 8,
            schedule: Schedule::Exponential { from: 5e-4, to: 5e-6, warmup: 0.0 },
            adam: AdamConfig::default(),
            background: Background::White,
            seed: 0,
        };
        match preset {
            Preset::Classic => classic,
            Preset::Small => Config {
                coarse: ClassicConfig {
                    depth: 2,
                    width: 64,
                    skips: vec![],
                    view_width: 32,
                    position_levels: 6,
                    ..paper.clone()
                },
                fine: ClassicConfig { depth: 4, width: 128, skips: vec![], view_width: 64, ..paper },
                coarse_samples: 48,
                fine_samples: 32,
                batch: 256,
                tile: 16,
                schedule: Schedule::Exponential { from: 4e-3, to: 1e-4, warmup: 0.005 },
                ..classic
            },
        }
    }

    /// Whether the numbers make sense together.
    ///
    /// # Errors
    /// If one is out of range.
    pub fn check(&self) -> Result<()> {
        let counts = [
            ("coarse_samples", self.coarse_samples, 1, 1 << 12),
            ("fine_samples", self.fine_samples, 0, 1 << 12),
            ("batch", self.batch, 1, 1 << 20),
            ("tile", self.tile, 1, 1 << 16),
        ];
        for (name, value, low, high) in counts {
            if !(low..=high).contains(&value) {
                return Err(Error::setting(name, format!("is {value}; use {low} to {high}")));
            }
        }
        if !(0.0..=1.0).contains(&self.uniform_share) {
            return Err(Error::setting("uniform_share", format!("is {}; use 0 to 1", self.uniform_share)));
        }
        Ok(())
    }

    /// The same without positional encoding: both networks see bare coordinates.
    pub fn without_encoding(mut self) -> Self {
        for field in [&mut self.coarse, &mut self.fine] {
            (field.position_levels, field.direction_levels) = (0, 0);
        }
        self
    }

    /// The same with the paper's ReLU density.
    pub fn with_relu_density(mut self) -> Self {
        for field in [&mut self.coarse, &mut self.fine] {
            field.density = DensityActivation::Relu;
        }
        self
    }
}
