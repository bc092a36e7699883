//! Elementary functions, most of them without branches, so that LLVM vectorises them inside loops.
//!
//! libm's `exp` or `sin` is a call, and a call prevents vectorisation. These functions are straight-line code: every
//! choice is a select, and every constant is a literal. They are inlined into the caller's loop. Inside
//! [`simd::dispatch`](crate::simd::dispatch) sixteen f32 elements run at once.
//!
//! `tan`, `asin`, `acos`, `atan`, `atan2` and `pow` are exceptions. They call the standard library, which prevents
//! vectorisation, and their accuracy and bits are those of the platform.
//!
//! Conventions of all other functions:
//! - Subnormal arguments and results are exact to the stated bound, not flushed. NaN gives NaN, infinities give the
//!   limits, and odd functions keep the sign of zero.
//! - Every multiply-add is written `mul_add` and rounds once, so that a result has the same bits on every instruction
//!   set, vectorised or not. Without FMA, or outside `dispatch`, it is a call into libm: right, but slow.
//! - Bounds are errors against the exact value in units in the last place (ULP) of the result. Those for f32 are maxima
//!   over all 2^32 arguments, asserted by `tests/testsuite/ulp.rs`. Those for f64 come from samples.
//! - Polynomials are minimax in the relative error of the result. They start as least squares on Chebyshev nodes in
//!   60-digit arithmetic, reweighted until the error is level (Lawson). Then the coefficients are rounded one by one
//!   from the lowest, and those above are fitted again each time.
//! - Sine and cosine reduce arguments of any size, which takes several times as long as the rest. f32 computes both
//!   reductions and selects one; f64 branches. Loops through [`map_real`](crate::map_real) run at the speed of the
//!   short reduction, with the same bits.
//!
//! The modules have the names of the primitive types. Write `vmath::f32::exp`, and do not import the modules by name.

pub mod f32;
pub mod f64;
mod plain;
pub mod survey;
pub(crate) mod wide;

use crate::Real;

/// `x` limited to `lo..=hi`, but NaN stays NaN (`f32::max` would drop it). Two instructions.
#[inline(always)]
fn clamp<T: PartialOrd>(x: T, lo: T, hi: T) -> T {
    let x = if x < lo { lo } else { x };
    if x > hi { hi } else { x }
}

/// The polynomial `c[0] + c[1] x + c[2] x^2 + ...`. Horner's rule runs for even and odd powers side by side, since a
/// single chain has a longer latency.
#[inline(always)]
fn polynomial<T: Real, const N: usize>(x: T, c: [T; N]) -> T {
    let x2 = x * x;
    let (mut last, mut other) = (c[N - 1], c[N - 2]);
    for i in (0..N - 2).rev() {
        (last, other) = (other, last.mul_add(x2, c[i]));
    }
    last.mul_add(x, other)
}

#[cfg(test)]
mod tests;
