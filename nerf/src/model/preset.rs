//! The presets: named configurations.

use super::camera_optimizer::CameraOptimizerConfig;
use super::config::Config;
use super::exposure::ExposureConfig;
use crate::dataset::background::Background;
use crate::encoding::hash_grid::HashGridConfig;
use crate::field::{ClassicConfig, FieldConfig, InstantConfig, VoxelConfig};
use crate::losses::photometric::Loss;
use crate::range::by_name;
use crate::sampling::SamplerConfig;
use crate::sampling::hierarchical::HierarchicalConfig;
use crate::sampling::marching::MarchingConfig;
use crate::{Error, Result};
use raygrad_nn::{AdamConfig, Schedule, Storage};
use serde::{Deserialize, Serialize};
use std::fmt;
use std::str::FromStr;
/// A named configuration, for [`Config::preset`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// The networks and numbers of the NeRF paper: 64 + 128 samples a ray, two networks of 8 layers of 256.
    Classic,
    /// Networks of half the depth and width: a recognisable scene in minutes.
    Small,
    /// A hash grid, marched through an occupancy grid: a good scene in a minute.
    #[default]
    Instant,
    /// A dense voxel grid without a network, marched in the same way. It has five times the parameters.
    Voxel,
}

impl FromStr for Preset {
    type Err = Error;
    fn from_str(name: &str) -> Result<Self> {
        by_name(name)
            .ok_or_else(|| Error::setting("preset", format!("is `{name}`; use classic, small, instant or voxel")))
    }
}

impl fmt::Display for Preset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.serialize(f)
    }
}

impl Config {
    /// Returns the configuration of a preset, for a bounded scene.
    pub fn preset(preset: Preset) -> Self {
        let paper = ClassicConfig::paper();
        let small = ClassicConfig { depth: 4, width: 128, skip_layers: vec![], view_width: 64, ..paper.clone() };
        let proposal = ClassicConfig {
            depth: 2,
            width: 64,
            skip_layers: vec![],
            view_width: 32,
            position_levels: 6,
            ..paper.clone()
        };
        let classic = Config {
            field: FieldConfig::new(paper.clone()),
            sampler: SamplerConfig::new(HierarchicalConfig::default()),
            unbounded: false,
            loss: Loss::Mse,
            loss_terms: vec![],
            schedule: Schedule::Exponential { from: 5e-4, to: 5e-6, warmup: 0.0 },
            adam: AdamConfig::default(),
            table_adam: AdamConfig { beta1: 0.9, beta2: 0.99, eps: 1e-15 },
            groups: vec![],
            poses: None,
            camera_optimizer: CameraOptimizerConfig::default(),
            exposure_model: ExposureConfig::default(),
            gradient_scaling_distance: 0.0,
            background: Background::White,
            seed: 0,
            storage: Storage::Full,
        };
        match preset {
            Preset::Classic => classic,
            Preset::Small => Config {
                field: FieldConfig::new(small),
                sampler: SamplerConfig::new(HierarchicalConfig {
                    proposal,
                    coarse: 48,
                    fine: 32,
                    batch: 256,
                    tile: 16,
                    ..HierarchicalConfig::default()
                }),
                schedule: Schedule::Exponential { from: 4e-3, to: 1e-4, warmup: 0.005 },
                ..classic
            },
            Preset::Instant => Config {
                field: FieldConfig::new(InstantConfig {
                    grid: HashGridConfig::cpu(0.0, f64::INFINITY),
                    density_width: 64,
                    features: 16,
                    color_width: 64,
                    color_depth: 2,
                    direction_degree: 4,
                    appearance_embedding_dim: 0,
                    gradient_cut: 0.03,
                }),
                sampler: SamplerConfig::new(MarchingConfig::default()),
                schedule: Schedule::Linear { from: 2e-2, to: 0.0, warmup: 0.005 },
                adam: AdamConfig { beta1: 0.9, beta2: 0.99, eps: 1e-15 },
                background: Background::Expected,
                ..classic
            },
            Preset::Voxel => Config {
                field: FieldConfig::new(VoxelConfig { resolution: 128, direction_degree: 2 }),
                sampler: SamplerConfig::new(MarchingConfig::default()),
                schedule: Schedule::Exponential { from: 5e-2, to: 5e-3, warmup: 0.0 },
                background: Background::Expected,
                ..classic
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn classic_preset_has_the_sizes_of_the_paper() {
        let field = Config::preset(Preset::Classic).field;
        let classic = field.get::<ClassicConfig>().unwrap();
        let sizes = (classic.depth, classic.width, classic.view_width, classic.skip_layers.clone());
        assert_eq!(sizes, (8, 256, 128, vec![5]));
        assert_eq!((classic.position_levels, classic.direction_levels), (10, 4));
    }
}
