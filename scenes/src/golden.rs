//! Points that never bunch up.

/// The golden angle in radians: points a golden angle apart on a circle never bunch up, however many they are.
pub(super) const GOLDEN_ANGLE: f64 = 2.399963229728653;
