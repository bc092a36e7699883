//! This crate's operations, for the checks.

#[cfg(feature = "check")]
use raygrad_autograd::check::Entry;

/// Every operation of this crate, with the inputs it is checked on.
pub fn catalogue() -> Vec<Entry> {
    let mut entries = crate::encoding::entries();
    entries.extend(crate::composite::entries());
    entries.extend(crate::quadrature::entries());
    entries.extend(crate::hash_grid::entries());
    entries.extend(crate::spherical::entries());
    entries.extend(crate::color_space::entries());
    entries.extend(crate::contraction::entries());
    entries.extend(crate::distortion::entries());
    entries.extend(crate::rotation::entries());
    entries
}
