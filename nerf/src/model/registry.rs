//! Registers this crate's fields, samplers and loss terms by name, one line each.

use crate::component::register;
use crate::field::{ClassicConfig, Fields, InstantConfig, VoxelConfig};
use crate::losses::LossTerms;
use crate::losses::{DepthConfig, DistortionConfig, EntropyConfig, OrientationConfig, TotalVariationConfig};
use crate::sampling::Samplers;
use crate::sampling::hierarchical::HierarchicalConfig;
use crate::sampling::marching::MarchingConfig;
use crate::sampling::proposal::ProposalConfig;
use serde::{Deserialize, Deserializer};
use std::sync::Once;

fn register_all() {
    static DONE: Once = Once::new();
    DONE.call_once(|| {
        register::<Fields, ClassicConfig>();
        register::<Fields, InstantConfig>();
        register::<Fields, VoxelConfig>();
        register::<Samplers, HierarchicalConfig>();
        register::<Samplers, MarchingConfig>();
        register::<Samplers, ProposalConfig>();
        register::<LossTerms, DistortionConfig>();
        register::<LossTerms, EntropyConfig>();
        register::<LossTerms, OrientationConfig>();
        register::<LossTerms, DepthConfig>();
        register::<LossTerms, TotalVariationConfig>();
    });
}

/// Deserialises a value that may contain this crate's components.
pub(super) fn read<'de, V: Deserialize<'de>, D: Deserializer<'de>>(deserializer: D) -> Result<V, D::Error> {
    register_all();
    V::deserialize(deserializer)
}
