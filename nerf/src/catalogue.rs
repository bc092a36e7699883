//! This crate's differentiable operations, for automatic checks.

#[cfg(any(test, feature = "check"))]
use raygrad_autograd::check::Entry;

/// Returns every operation of this crate with the inputs that it is checked on.
pub fn catalogue() -> Vec<Entry> {
    let mut entries = crate::encoding::sinusoids::entries();
    entries.extend(crate::volume::depth::entries());
    entries.extend(crate::volume::weights::entries());
    entries.extend(crate::volume::accumulate::entries());
    entries.extend(crate::encoding::hash_grid::entries());
    entries.extend(crate::encoding::spherical::entries());
    entries.extend(crate::dataset::color_space::entries());
    entries.extend(crate::space::contraction::entries());
    entries.extend(crate::volume::distortion::entries());
    entries.extend(crate::camera::rotation::entries());
    entries.extend(crate::camera::lens::recorded::entries());
    entries
}
