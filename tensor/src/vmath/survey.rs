//! The functions of `vmath` that raygrad computes itself, except `sinh` and `cosh`. Each has its argument range, its
//! bound and a reference, for tests and benchmarks.

use super::{f32 as single, f64 as double};
use crate::{Real, Scalar, lanes, lanes_real};
use std::f64::consts::PI;

/// A function over slices, vectorised, with its bound and reference.
pub struct Function<T: Scalar> {
    /// Its name.
    pub name: &'static str,
    /// Ordinary arguments, for timing.
    pub range: [f64; 2],
    /// Applies the function to each element of the first slice, and writes to the second.
    pub apply: fn(&[T], &mut [T]),
    /// The stated bound in ULP.
    pub bound: f64,
    /// A reference for f32: the standard library's function in f64, or one of the same accuracy.
    pub reference: fn(f64) -> f64,
}

macro_rules! functions {
    ($module:ident: $($f:ident [$low:literal, $high:literal] $bound:literal $reference:expr;)+) => {
        vec![$(Function {
            name: stringify!($f),
            range: [$low, $high],
            apply: |x, y| lanes([x], y, #[inline(always)] |[x]| $module::$f(x)),
            bound: $bound,
            reference: $reference,
        }),+]
    };
}

macro_rules! all {
    ($module:ident) => {{
        let mut all = functions! { $module:
            exp [-10.0, 10.0] 1.0 f64::exp;
            exp2 [-10.0, 10.0] 1.0 f64::exp2;
            expm1 [-4.0, 4.0] 2.0 f64::exp_m1;
            ln [1e-3, 100.0] 1.0 f64::ln;
            ln1p [-0.9, 4.0] 2.0 f64::ln_1p;
            log2 [1e-3, 100.0] 2.0 f64::log2;
            sin [-10.0, 10.0] 2.0 f64::sin;
            cos [-10.0, 10.0] 2.0 f64::cos;
            sin_pi [-10.0, 10.0] 2.0 sin_pi;
            cos_pi [-10.0, 10.0] 2.0 |x| sin_pi(x.abs() % 2.0 + 0.5);
            tanh [-4.0, 4.0] 2.0 f64::tanh;
            sigmoid [-10.0, 10.0] 2.0 |x| 1.0 / (1.0 + (-x).exp());
            softplus [-10.0, 10.0] 2.0 |x| x.max(0.0) + (-x.abs()).exp().ln_1p();
            erf [-4.0, 4.0] 2.0 double::erf;
        };
        // As tensors call them: the short reduction where it holds.
        all[6].apply = |x, y| lanes_real!(&[x], y, |[x]| Real::sin(x));
        all[7].apply = |x, y| lanes_real!(&[x], y, |[x]| Real::cos(x));
        all
    }};
}

/// The functions in f32.
pub fn singles() -> Vec<Function<f32>> {
    all!(single)
}

/// The functions in f64, in the same order. Their references have the same precision, so they give a rough check only.
pub fn doubles() -> Vec<Function<f64>> {
    all!(double)
}

/// sin(pi x) for an x that came from f32 (plus one half): the reduction to |r| <= 1/4 is exact in f64.
fn sin_pi(x: f64) -> f64 {
    let y = x - 2.0 * (x / 2.0).round();
    let n = (2.0 * y).round();
    let r = PI * (y - n / 2.0);
    match n as i32 & 3 {
        0 => r.sin(),
        1 => r.cos(),
        2 => -r.sin(),
        _ => -r.cos(),
    }
}

/// `|got - reference|` in units of the spacing of f32 numbers at the reference; 0 for two NaN, infinite for one.
pub fn ulp_error(got: f32, reference: f64) -> f64 {
    if got.is_nan() || reference.is_nan() {
        return if got.is_nan() && reference.is_nan() { 0.0 } else { f64::INFINITY };
    }
    if got == reference as f32 && got.is_infinite() {
        return 0.0;
    }
    // Infinity stands where the next number after the largest would be.
    let got = if got.is_infinite() { 2.0_f64.powi(128).copysign(got.into()) } else { got.into() };
    let exponent = ((reference.to_bits() >> 52) & 0x7ff) as i32 - 1023;
    let ulp = f64::from_bits(((exponent.clamp(-126, 127) - 23 + 1023) as u64) << 52);
    (got - reference).abs() / ulp
}
