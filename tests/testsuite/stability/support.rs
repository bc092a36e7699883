//! Helpers of the tests: both precisions, comparisons that fail for NaN, and constants.

use raygrad::nerf::volume::{OpticalDepth, accumulate, weights};
use raygrad::nerf::{Ray, Rays, glam::DVec3};
use raygrad::{Scalar, Segments, Tensor, Var};
use serde_json::Value;

/// Makes tests in each precision from generic functions.
macro_rules! both {
    ($($(#[$attribute:meta])* $name:ident),* $(,)?) => {
        mod single {
            $($(#[$attribute])* #[test] fn $name() { super::$name::<f32>() })*
        }
        mod double {
            $($(#[$attribute])* #[test] fn $name() { super::$name::<f64>() })*
        }
    };
}

/// A constant of `reference/constants.json`.
#[track_caller]
pub fn constant(name: &str) -> f64 {
    let all: Value = serde_json::from_str(include_str!("reference/constants.json")).unwrap();
    all[name].as_f64().unwrap_or_else(|| panic!("there is no constant `{name}`"))
}

/// The first in f32, the second in f64.
pub fn by_type<T: Scalar>(single: f64, double: f64) -> f64 {
    if size_of::<T>() == 4 { single } else { double }
}

/// The smallest number above 0.
pub fn smallest<T: Scalar>() -> f64 {
    by_type::<T>(f32::from_bits(1).into(), f64::from_bits(1))
}

/// The largest finite number.
pub fn greatest<T: Scalar>() -> f64 {
    by_type::<T>(f32::MAX.into(), f64::MAX)
}

/// The number rounded to the type.
pub fn round<T: Scalar>(x: f64) -> f64 {
    T::from_f64(x).to_f64()
}

/// A vector.
pub fn vector<T: Scalar>(values: &[f64]) -> Tensor<T> {
    tensor(&[values.len()], values)
}

/// A tensor.
pub fn tensor<T: Scalar>(shape: &[usize], values: &[f64]) -> Tensor<T> {
    Tensor::from_vec(shape, values.iter().map(|&x| T::from_f64(x)).collect())
}

/// The elements of a tensor.
pub fn numbers<T: Scalar>(x: &Tensor<T>) -> Vec<f64> {
    x.as_slice().iter().map(|x| x.to_f64()).collect()
}

/// Checks that `got` is `expected` up to the relative `tolerance`, or up to the type's smallest number.
#[track_caller]
pub fn near<T: Scalar>(what: &str, got: f64, expected: f64, tolerance: f64) {
    if got == expected {
        return;
    }
    let error = (got - expected).abs();
    assert!(error <= tolerance * expected.abs() + smallest::<T>(), "{what} in {}: {got:e} for {expected:e}", T::NAME);
}

/// Checks that `got` is within `tolerance` of `expected`.
#[track_caller]
pub fn within(what: &str, got: f64, expected: f64, tolerance: f64) {
    assert!((got - expected).abs() <= tolerance, "{what}: {got:e} for {expected:e}, tolerance {tolerance:e}");
}

/// The distance of a row-major matrix from a rotation: the Frobenius norm of `R'R - 1`.
pub fn skewness(rotation: &[f64]) -> f64 {
    let gram = |i: usize, j: usize| (0..3).map(|k| rotation[3 * k + i] * rotation[3 * k + j]).sum::<f64>();
    (0..9).map(|k| (gram(k / 3, k % 3) - f64::from(u8::from(k % 4 == 0))).powi(2)).sum::<f64>().sqrt()
}

/// Checks that no element is infinite or NaN.
#[track_caller]
pub fn finite<T: Scalar>(what: &str, x: &Tensor<T>) {
    assert!(x.is_finite(), "{what} in {}: {x:?}", T::NAME);
}

/// The distance from `x` to the type's next larger number.
pub fn ulp<T: Scalar>(x: f64) -> f64 {
    if size_of::<T>() == 4 {
        let x = (x.abs() as f32).min(f32::MAX.next_down());
        f64::from(x.next_up() - x)
    } else {
        let x = x.abs().min(f64::MAX.next_down());
        x.next_up() - x
    }
}

/// The type's next number, upwards or downwards.
pub fn beside<T: Scalar>(x: f64, up: bool) -> f64 {
    match (size_of::<T>() == 4, up) {
        (true, true) => (x as f32).next_up().into(),
        (true, false) => (x as f32).next_down().into(),
        (false, true) => x.next_up(),
        (false, false) => x.next_down(),
    }
}

/// The message of the error or panic that `f` ends in.
#[track_caller]
pub fn panic_of<R>(f: impl FnOnce() -> R) -> String {
    let Err(panic) = std::panic::catch_unwind(std::panic::AssertUnwindSafe(f)) else { panic!("nothing panicked") };
    match panic.downcast::<String>() {
        Ok(text) => *text,
        Err(panic) => panic.downcast::<&str>().expect("a message is text").to_string(),
    }
}

/// One ray along z from `(0, 0, z)`, sampled over `span`.
pub fn ray_along_z<T: Scalar>(z: f64, span: [f64; 2]) -> Rays<T> {
    let mut rays = Rays::new();
    rays.push(&Ray { origin: DVec3::new(0.0, 0.0, z), direction: DVec3::Z }, span);
    rays
}

/// A generator of numbers in 0..1 without a dependency: scrambled fractional parts of multiples of the golden ratio.
pub fn noise(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x1234_5678_9abc_def1;
    move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1_u64 << 53) as f64
    }
}

/// Composited features and the remaining light, `[rays, channels + 1]`, by the operations of volume rendering.
pub fn composite<'t, T: Scalar>(
    depth: OpticalDepth<T>,
    segments: &Segments,
    [density, features]: [&Var<'t, T>; 2],
) -> Var<'t, T> {
    let x = density.tape().apply(depth, &[density]);
    let left = (-x.segment_sum(segments)).exp().reshape(&[segments.len(), 1]);
    Var::concat(&[&accumulate(&weights(&x, segments), features, segments), &left], 1)
}
