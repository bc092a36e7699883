//! Smallest and largest magnitudes in optimizer state, by number type.

use raygrad_tensor::Scalar;

/// `single` for f32, `double` for f64.
#[inline(always)]
fn by_type<T: Scalar>(single: f64, double: f64) -> T {
    T::from_f64(if size_of::<T>() == 4 { single } else { double })
}

/// State smaller than this becomes 0: 1e-30, or 1e-300 in f64, well above the denormal numbers.
#[inline(always)]
pub(crate) fn tiny<T: Scalar>() -> T {
    by_type(1e-30, 1e-300)
}

/// A mean of squares smaller than this becomes 0: 1e-37, or 1e-307 in f64. The square of [`tiny`] would be a denormal
/// number; this is the square of 3e-19 (3e-154). It has no effect as long as epsilon is larger. (A limit of 1e-30 would
/// zero the squares of gradients of 1e-14, but keep their mean, and so make steps of 10 learning rates.)
#[inline(always)]
pub(crate) fn tiny_square<T: Scalar>() -> T {
    by_type(1e-37, 1e-307)
}

/// Limits a gradient to the range of second moments: 1e19, or 1e154 in f64. Its square is then finite, and an element
/// with a larger gradient still changes. (An infinite second moment would never decay.)
#[inline(always)]
pub(crate) fn limited<T: Scalar>(g: T) -> T {
    let most = by_type(1e19, 1e154);
    let g = if g > most { most } else { g };
    if g < -most { -most } else { g }
}

/// Replaces a number smaller than [`tiny`] with 0. NaN stays.
#[inline(always)]
pub(crate) fn flushed<T: Scalar>(x: T) -> T {
    if x < tiny() && x > -tiny::<T>() { T::ZERO } else { x }
}
