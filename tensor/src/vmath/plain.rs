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
            use crate::vmath::$t::exp_minus;
            use crate::vmath::polynomial;
            use crate::vmath::wide::$t::Wide;
            use crate::Wide as _;

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

            /// Hyperbolic sine, within 2 ULP. It uses Taylor's series up to 1, and beyond half the difference of e^x and
            /// e^-x, which overflows only if the result does.
            #[inline(always)]
            pub fn sinh(x: $t) -> $t {
                /// 1 / (2n + 3)!
                const TAYLOR: [$t; 9] = [
                    1.0 / 6.0,
                    1.0 / 120.0,
                    1.0 / 5040.0,
                    1.0 / 362_880.0,
                    1.0 / 39_916_800.0,
                    1.0 / 6_227_020_800.0,
                    1.0 / 1_307_674_368_000.0,
                    1.0 / 355_687_428_096_000.0,
                    1.0 / 121_645_100_408_832_000.0,
                ];
                let a = $t::abs(x);
                let square = a * a;
                let (e, inverse) = exponentials(a);
                let y = if a < 1.0 { (a * square).mul_add(polynomial(square, TAYLOR), a) } else { e - inverse };
                $t::copysign(y, x)
            }

            /// Hyperbolic cosine, within 2 ULP; see [`sinh`].
            #[inline(always)]
            pub fn cosh(x: $t) -> $t {
                let (e, inverse) = exponentials($t::abs(x));
                e + inverse
            }

            /// Halves of e^a and e^-a for a >= 0.
            #[inline(always)]
            fn exponentials(a: $t) -> ($t, $t) {
                let e = Wide::exp(a, 0.0);
                ((e * Wide::new(0.5)).narrow(), 0.5 / e.narrow())
            }

            /// The logistic function `1 / (1 + e^-x)`, within 2 ULP.
            ///
            /// With `e = e^-|x|` it is `1 / (1 + e)` for x >= 0 and `e / (1 + e)` below. So it does not overflow, and small
            /// results keep all their digits. Below 1/4, one step of `y = e (1 - y)` corrects the rounding of `1 + e` and of
            /// the quotient.
            #[inline(always)]
            pub fn sigmoid(x: $t) -> $t {
                let e = exp_minus($t::abs(x));
                let y = if x < 0.0 { e } else { 1.0 } / (1.0 + e);
                if y < 0.25 { (-e).mul_add(y, e) } else { y }
            }

            /// The distribution function of the standard normal distribution, within 6 ULP.
            #[inline(always)]
            pub fn normal_cdf(x: $t) -> $t {
                Wide::normal_cdf(x).narrow()
            }

            /// The length of the vector (`x`, `y`), within 2 ULP, from the ratio of the two.
            #[inline(always)]
            pub fn hypot(x: $t, y: $t) -> $t {
                let (x, y) = ($t::abs(x), $t::abs(y));
                let (long, short) = if x > y { (x, y) } else { (y, x) };
                let ratio = short / if long > 0.0 { long } else { 1.0 };
                let length = long * $t::sqrt(ratio.mul_add(ratio, 1.0));
                let is_infinite = x == $t::INFINITY || y == $t::INFINITY;
                if is_infinite { $t::INFINITY } else { length }
            }

            /// `x` modulo `y` as in Python: `x - y floor(x / y)`, rounded once. It has the sign of `y`.
            #[inline(always)]
            pub fn remainder(x: $t, y: $t) -> $t {
                let rest = x % y;
                let other_sign = rest != 0.0 && (rest < 0.0) != (y < 0.0);
                if other_sign { rest + y } else { rest.copysign(if rest == 0.0 { y } else { rest }) }
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
