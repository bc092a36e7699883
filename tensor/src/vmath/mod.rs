//! Elementary functions without branches, which LLVM vectorises wherever they are called in a loop.
//!
//! libm's `exp` or `sin` is a call, and a call ends vectorisation. These are straight-line code (every choice is a
//! select, every constant a literal), inlined into the caller's loop; inside [`simd::dispatch`](crate::simd::dispatch)
//! sixteen f32 elements go through at once.
//!
//! Conventions, for all of them:
//! - Subnormal arguments and results are exact to the stated bound, not flushed. NaN gives NaN, infinities give the
//!   limits, and the odd functions keep the sign of zero.
//! - Every multiply-add is written `mul_add` and rounds once, so that a result has the same bits on every instruction
//!   set, vectorised or not. Without FMA, or outside of `dispatch`, that is a call into libm: right, but slow.
//! - Bounds are errors against the exact value in units of the last place (ULP) of the result. Those for f32 are maxima
//!   over all 2^32 arguments, asserted by `tests/testsuite/ulp.rs`; those for f64 come from samples.
//! - Polynomials are minimax in the relative error of the result: least squares on Chebyshev nodes in 60-digit
//!   arithmetic, reweighted until the error is level (Lawson), then the coefficients are rounded one by one from the
//!   lowest, each time refitting those above it.
//! - Sine and cosine reduce arguments of any size, which costs several times the rest of them: f32 makes both reductions
//!   and takes one, f64 branches. Loops through [`map_real`](crate::map_real) run at the speed of the short reduction,
//!   with the same bits.
//!
//! The modules have the names of the primitive types: write `vmath::f32::exp`, and import neither by name.

pub mod f32;
pub mod f64;
mod plain;
pub mod survey;

#[cfg(test)]
mod tests;
