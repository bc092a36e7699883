//! Detail that comes in from coarse to fine.

use std::f64::consts::PI;

/// The weight of each of `levels` resolutions, coarsest first, with the share `detail` of them in use, 0 to 1: the first
/// `first` are always there, and each further one comes in as half a wave, `(1 - cos(pi clamp(alpha - level, 0, 1))) / 2`,
/// where `alpha` rises from `first` to `levels` (Lin et al. 2021, "BARF", equation 14). `None` if all are there.
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
