//! Coarse-to-fine weights of levels of detail.

use std::f64::consts::PI;

/// Returns the weight of each of `levels`, coarsest first, at the share `detail`, 0 to 1 (Lin et al. 2021, "BARF",
/// equation 14).
///
/// The first `first` levels have weight 1. Level `l` of the others has `(1 - cos(pi clamp(alpha - l, 0, 1))) / 2`,
/// where `alpha` rises from `first` to `levels`. Returns `None` if all weights are 1.
///
/// ```
/// use raygrad_nerf::encoding::detail_weights;
/// let weights = detail_weights(0.625, 6, 2).unwrap();
/// assert_eq!(weights[..4], [1.0; 4]);
/// assert!((weights[4] - 0.5).abs() < 1e-15 && weights[5] == 0.0);
/// assert!(detail_weights(1.0, 6, 2).is_none());
/// ```
pub fn detail_weights(detail: f64, levels: usize, first: usize) -> Option<Vec<f64>> {
    let first = first.min(levels) as f64;
    let alpha = first + detail * (levels as f64 - first);
    let weight = |level: usize| 0.5 * (1.0 - (PI * (alpha - level as f64).clamp(0.0, 1.0)).cos());
    (alpha < levels as f64).then(|| (0..levels).map(weight).collect())
}
