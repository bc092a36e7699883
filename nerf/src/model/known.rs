//! The fields, samplers and terms of this crate, by name: one line for each.

use crate::field::{ClassicConfig, Fields, InstantConfig, VoxelConfig};
use crate::kind::register;
use crate::losses::Terms;
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
        register::<Terms, DistortionConfig>();
        register::<Terms, EntropyConfig>();
        register::<Terms, OrientationConfig>();
        register::<Terms, DepthConfig>();
        register::<Terms, TotalVariationConfig>();
    });
}

/// Reads what holds parts of a configuration, which may be of this crate.
pub(super) fn read<'de, V: Deserialize<'de>, D: Deserializer<'de>>(deserializer: D) -> Result<V, D::Error> {
    register_all();
    V::deserialize(deserializer)
}
