//! Scales for squares: powers of two that keep them in a type's range. Products with them are exact.

use crate::{Axes, Pool, Scalar, Tensor, map};

/// `2^exponent`; 0 or infinity beyond the range of f64.
pub fn power_of_two(exponent: i64) -> f64 {
    match exponent {
        ..-1074 => 0.0,
        -1074..-1022 => f64::from_bits(1 << (exponent + 1074)),
        -1022..1024 => f64::from_bits(((exponent + 1023) as u64) << 52),
        _ => f64::INFINITY,
    }
}

/// The exponent of a number: n for 2^n and numbers up to twice as large, below those of all products for 0, -1023 for
/// subnormal numbers of f64, 1024 for infinity and NaN.
pub fn exponent<T: Scalar>(x: T) -> i64 {
    if x == T::ZERO { -10_000 } else { (x.to_f64().to_bits() >> 52 & 0x7ff) as i64 - 1023 }
}

/// `2^exponent` as a factor, also out of the type's range.
pub fn wide_power<T: Scalar>(exponent: i64) -> T::Wide {
    let (mut power, mut rest) = (T::ONE.wide(), exponent);
    while rest != 0 {
        let step = rest.clamp(-100, 100);
        power = power * T::from_f64(power_of_two(step)).wide();
        rest -= step;
    }
    power
}

/// The largest absolute value; 0 for no elements, NaN if one is NaN.
#[inline(always)]
pub fn largest<T: Scalar>(x: &[T]) -> T {
    let mut largest = T::ZERO;
    for &x in x {
        largest = largest.maximum(x.abs());
    }
    largest
}

/// `[down, up]`: powers of two whose product is 1, such that squares and sums of squares of numbers up to `size`, times
/// `down`, are in range. Both are 1 for 0, infinity and NaN.
pub fn powers<T: Scalar>(size: T) -> [T; 2] {
    // Their reciprocals are no subnormal numbers.
    let most = if size_of::<T>() == 4 { 100 } else { 1000 };
    let exponent = if size == T::ZERO || !size.is_finite() { 0 } else { exponent(size).clamp(-most, most) };
    [-exponent, exponent].map(|exponent| T::from_f64(power_of_two(exponent)))
}

/// [`powers`] for the largest elements over the axes whose extent is 1 in `kept`.
pub fn scales<T: Scalar>(x: &Tensor<T>, kept: &[usize], pool: &Pool<T>) -> [Tensor<T>; 2] {
    if x.is_empty() {
        return [T::ONE; 2].map(|one| pool.full(kept, one));
    }
    let axes: Vec<isize> = (0..kept.len()).filter(|&axis| kept[axis] == 1).map(|axis| axis as isize).collect();
    // Axes of repeated elements stay repeated, so that a product with `x` is summed in the order of `x`.
    let is_repeated = |&axis: &usize| x.layout().strides()[axis] == 0 && kept[axis] > 1;
    let once =
        (0..kept.len()).filter(is_repeated).fold(x.layout().clone(), |layout, axis| layout.sliced(axis, 0, 1, 1));
    let size = x.with_layout(once).abs().max_over(Axes::from(&axes[..]).keepdims());
    [0, 1].map(|which| map([&size], pool, |[size]| powers(size)[which]).broadcast_to(kept))
}

/// Whether a sum of squares has lost nothing to overflow or underflow, nor have its terms.
#[inline(always)]
pub fn is_safe<T: Scalar>(sum: T) -> bool {
    let [least, most] = if size_of::<T>() == 4 { [-60, 100] } else { [-600, 1000] };
    sum > T::from_f64(power_of_two(least)) && sum < T::from_f64(power_of_two(most))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn powers_of_two_bring_every_size_near_one() {
        fn check<T: Scalar>(sizes: &[f64]) {
            for &size in sizes {
                let size = T::from_f64(size);
                let [down, up] = powers(size);
                assert_eq!(down * up, T::ONE);
                let square = (size * down * (size * down)).to_f64();
                assert!(
                    (1e-46..1e17).contains(&square),
                    "{size:e}: {down:e}",
                    size = size.to_f64(),
                    down = down.to_f64()
                );
                assert_eq!((size * down * up).to_f64(), size.to_f64());
            }
            for size in [0.0, f64::INFINITY, f64::NAN] {
                assert_eq!(powers(T::from_f64(size)), [T::ONE; 2]);
            }
        }
        check::<f32>(&[f32::MAX.into(), 1e38, 1.0, 0.3, 1e-37, 1e-40, 1.5e-45]);
        check::<f64>(&[f64::MAX, 1e308, 1.0, 0.3, 1e-307, 1e-310, 5e-324]);
    }

    #[test]
    fn the_largest_element_lets_nan_through() {
        assert_eq!((largest(&[1.0, -3.0, 2.0]), largest::<f32>(&[])), (3.0, 0.0));
        assert!(largest(&[f32::NAN, 5.0]).is_nan() && largest(&[5.0, f64::NAN]).is_nan());
        assert!(!is_safe(f32::NAN) && !is_safe(0.0) && !is_safe(f64::INFINITY) && is_safe(1.0_f32));
    }
}
