//! Functions from short formulas, which vectorise, and from the standard library, which are right to an ULP or so on
//! the usual platforms. Of these, `tan`, `asin`, `acos`, `atan`, `atan2` and `pow` are calls, which prevent
//! vectorisation.

macro_rules! from_std {
    ($t:ident: $($f:ident)*) => {
        $(
            #[doc = concat!("[`", stringify!($t), "::", stringify!($f), "`].")]
            #[inline(always)]
            pub fn $f(x: $t) -> $t {
                $t::$f(x)
            }
        )*
    };
}

macro_rules! functions_of {
    ($t:ident) => {
        /// The functions in this precision.
        pub mod $t {
            use crate::vmath::$t::{exp, expm1};

            from_std!($t: sqrt tan asin acos atan abs floor ceil);

            /// The angle in -pi..=pi of the vector (`x`, `y`).
            #[inline(always)]
            pub fn atan2(y: $t, x: $t) -> $t {
                $t::atan2(y, x)
            }

            /// `x` to the power `exponent`; NaN for a negative base and a fractional exponent.
            #[inline(always)]
            pub fn pow(x: $t, exponent: $t) -> $t {
                $t::powf(x, exponent)
            }

            /// The nearest whole number; ties go to the even one.
            #[inline(always)]
            pub fn round(x: $t) -> $t {
                $t::round_ties_even(x)
            }

            /// Hyperbolic sine, within 4 ULP. It uses `expm1` near 0, and the square of `e^(x/2)` where `e^-x` does not
            /// matter, so that it overflows only if the result does.
            #[inline(always)]
            pub fn sinh(x: $t) -> $t {
                let a = $t::abs(x);
                let t = expm1(a);
                let half = exp(0.5 * a);
                let y = if a < 20.0 { 0.5 * (t + t / (t + 1.0)) } else { 0.5 * half * half };
                $t::copysign(y, x)
            }

            /// Hyperbolic cosine, within 4 ULP; see [`sinh`].
            #[inline(always)]
            pub fn cosh(x: $t) -> $t {
                let a = $t::abs(x);
                let t = exp(a);
                let half = exp(0.5 * a);
                if a < 20.0 { 0.5 * (t + 1.0 / t) } else { 0.5 * half * half }
            }

            /// 1 for positive numbers, -1 for negative ones. Zeros and NaN stay unchanged.
            #[inline(always)]
            pub fn sign(x: $t) -> $t {
                let negative = if x < 0.0 { -1.0 } else { x };
                if x > 0.0 { 1.0 } else { negative }
            }

            /// The larger of two numbers; NaN if one is NaN.
            #[inline(always)]
            pub fn maximum(a: $t, b: $t) -> $t {
                if a > b || $t::is_nan(a) { a } else { b }
            }

            /// The smaller of two numbers; NaN if one is NaN.
            #[inline(always)]
            pub fn minimum(a: $t, b: $t) -> $t {
                if a < b || $t::is_nan(a) { a } else { b }
            }
        }
    };
}

functions_of!(f32);
functions_of!(f64);
