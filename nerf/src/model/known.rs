//! The fields, samplers and terms of this crate, by name: one line for each.

use crate::field::{ClassicConfig, Fields, InstantConfig, VoxelConfig};
use crate::kind::{Family, Part, register};
use crate::losses::{DepthConfig, DistortionConfig, EntropyConfig, OrientationConfig, TotalVariationConfig};
use crate::losses::{TermConfig, Terms};
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

/// Reads a part of a configuration, which may be one of this crate's.
pub(super) fn read<'de, F: Family, D: Deserializer<'de>>(deserializer: D) -> Result<Part<F>, D::Error> {
    register_all();
    Part::deserialize(deserializer)
}

/// As [`read`], for a list of terms.
pub(super) fn read_terms<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<TermConfig>, D::Error> {
    register_all();
    Vec::deserialize(deserializer)
}
