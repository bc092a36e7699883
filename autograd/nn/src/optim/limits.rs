//! Smallest and largest magnitudes in optimizer state, by number type.

use raygrad_tensor::Scalar;

/// `single` for f32, `double` for f64.
#[inline(always)]
pub(crate) fn by_type<T: Scalar>(single: f64, double: f64) -> f64 {
    if size_of::<T>() == 4 { single } else { double }
}

/// State smaller than this becomes 0: 1e-30, or 1e-300 in f64, well above the denormal numbers.
#[inline(always)]
pub(crate) fn tiny<T: Scalar>() -> T {
    T::from_f64(by_type::<T>(1e-30, 1e-300))
}

/// The root of the factor of second moments in memory: 16, so that f32 holds the squares of gradients from 1e-18 to 1e18.
/// It is 1 in f64. A power of two leaves all roundings as they are.
pub(crate) fn moment_root<T: Scalar>() -> f64 {
    by_type::<T>(16.0, 1.0)
}

/// A scaled mean of squares smaller than this becomes 0: 4.7e-41 unscaled, or 1e-307 in f64. The square of [`tiny`] would
/// be a denormal number; this is the square of 6.9e-21 (3e-154). It has no effect as long as epsilon is larger. (A limit
/// of 1e-30 would zero the squares of gradients of 1e-14, but keep their mean, and so make steps of 10 learning rates.)
#[inline(always)]
pub(crate) fn tiny_square<T: Scalar>() -> T {
    T::from_f64(by_type::<T>(1.2e-38, 1e-307))
}

/// The smallest epsilon. From it on, the second moments that become 0 change a step by less than 1 part in 1000.
pub(crate) fn smallest_eps<T: Scalar>(beta2: f64) -> f64 {
    // Above this beta2, the moment of a single gradient of 1e-18 becomes 0.
    by_type::<T>(if beta2 > 0.9999 { 1e-10 } else { 1e-15 }, 1e-30)
}

/// A scaled second moment as in a saved state: without its factor, so that all versions read the same number. One that
/// would be denormal stays scaled and gets a minus sign, so that it keeps its digits.
pub(crate) fn saved_moment<T: Scalar>(scaled: T) -> T {
    let (least, scaled) = (by_type::<T>(f32::MIN_POSITIVE.into(), f64::MIN_POSITIVE), scaled.to_f64());
    let moment = scaled / moment_root::<T>().powi(2);
    let is_denormal = moment < least && scaled > 0.0;
    T::from_f64(if is_denormal { -scaled } else { moment })
}

/// The inverse of [`saved_moment`]. Earlier versions had larger moments: they become the largest.
pub(crate) fn loaded_moment<T: Scalar>(saved: T) -> T {
    let (saved, most) = (saved.to_f64(), by_type::<T>(f32::MAX.into(), f64::MAX));
    T::from_f64(if saved < 0.0 { -saved } else { (saved * moment_root::<T>().powi(2)).min(most) })
}

/// Limits a gradient to the range of second moments: 1.1e18, or 1e154 in f64. Its scaled square is then finite, and an
/// element with a larger gradient still changes. (An infinite second moment would never decay.)
#[inline(always)]
pub(crate) fn limited<T: Scalar>(g: T) -> T {
    let most = T::from_f64(by_type::<T>(1.1e18, 1e154));
    let g = if g > most { most } else { g };
    if g < -most { -most } else { g }
}

/// Replaces a number smaller than [`tiny`] with 0. NaN stays.
#[inline(always)]
pub(crate) fn flushed<T: Scalar>(x: T) -> T {
    if x < tiny() && x > -tiny::<T>() { T::ZERO } else { x }
}
