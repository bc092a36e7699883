//! Where numbers become too small or too large for an optimiser, by their type.

use raygrad_tensor::Scalar;

/// `single` for f32, `double` for f64.
#[inline(always)]
fn by_type<T: Scalar>(single: f64, double: f64) -> T {
    T::from_f64(if size_of::<T>() == 4 { single } else { double })
}

/// What an optimiser remembers is 0 below this: 1e-30, or 1e-300 in f64, well above the denormal numbers.
#[inline(always)]
pub(crate) fn tiny<T: Scalar>() -> T {
    by_type(1e-30, 1e-300)
}

/// A mean of squares is 0 below this, 1e-37, or 1e-307 in f64: the square of [`tiny`] would be a denormal number, and this
/// is that of 3e-19 (3e-154). As far as epsilon is larger, nobody notices. (A limit of 1e-30 would make 0 of the squares
/// of gradients of 1e-14, whose own mean is kept, and their step 10 learning rates.)
#[inline(always)]
pub(crate) fn tiny_square<T: Scalar>() -> T {
    by_type(1e-37, 1e-307)
}

/// The gradient, at most as large as second moments can hold: 1e19, or 1e154 in f64. Squared it is still a number, and an
/// element that has met a larger one moves on. (An infinite second moment would never fade.)
#[inline(always)]
pub(crate) fn limited<T: Scalar>(g: T) -> T {
    let most = by_type(1e19, 1e154);
    let g = if g > most { most } else { g };
    if g < -most { -most } else { g }
}

/// 0 in place of a number below [`tiny`]. NaN stays.
#[inline(always)]
pub(crate) fn flushed<T: Scalar>(x: T) -> T {
    if x < tiny() && x > -tiny::<T>() { T::ZERO } else { x }
}
