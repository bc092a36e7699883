//! The golden angle, for uniform points.

/// The golden angle in radians: points at multiples of it on a circle never cluster, for any number of points.
pub(super) const GOLDEN_ANGLE: f64 = 2.399963229728653;
