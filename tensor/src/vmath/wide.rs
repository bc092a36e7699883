//! Products with more range than their number type: a mantissa and a power of two.
//!
//! A derivative times an incoming gradient may be an ordinary number although the derivative alone is not: `1e30 e^-100`
//! is 3.7e-14, but `e^-100` has lost most of its digits in f32. [`Wide`] factors neither overflow nor underflow, and
//! [`Wide::narrow`] rounds their product.

use crate::Wide;

macro_rules! wide {
    ($t:ident, $digits:literal, $bias:literal, $limit:literal, $tail:expr) => {
        /// Products in this precision.
        pub mod $t {
            use super::power;
            use crate::vmath::$t::{ROUND, erf_near, expm1_of_rest, round_product};
            use crate::vmath::{clamp, polynomial};
            use std::ops::{Div, Mul};
            use std::$t::consts::{FRAC_1_SQRT_2, LOG2_E};

            /// `mantissa * 2^exponent`. The mantissa is within a few powers of two of 1, or it is 0, infinite or NaN.
            #[derive(Debug, Clone, Copy)]
            pub struct Wide {
                pub(super) mantissa: $t,
                pub(super) exponent: $t,
            }

            /// The bits of a whole number below this one, joined with its bits, are those of their sum.
            const INTEGER: $t = (1_u64 << $digits) as $t;

            /// 2^n for a whole n in the range of exponents of normal numbers.
            #[inline(always)]
            fn power_of_two(n: $t) -> $t {
                $t::from_bits((n + (ROUND + $bias)).to_bits() << $digits)
            }

            impl Mul for Wide {
                type Output = Self;
                #[inline(always)]
                fn mul(self, other: Self) -> Self {
                    Wide { mantissa: self.mantissa * other.mantissa, exponent: self.exponent + other.exponent }
                }
            }

            impl Div for Wide {
                type Output = Self;
                #[inline(always)]
                fn div(self, other: Self) -> Self {
                    Wide { mantissa: self.mantissa / other.mantissa, exponent: self.exponent - other.exponent }
                }
            }

            impl crate::Wide<$t> for Wide {
                #[inline(always)]
                fn new(x: $t) -> Self {
                    let is_subnormal = x.abs() < $t::MIN_POSITIVE;
                    let normal = x * if is_subnormal { INTEGER } else { 1.0 };
                    let field = $t::from_bits(normal.abs().to_bits() >> $digits | INTEGER.to_bits()) - INTEGER;
                    let exponent = field - if is_subnormal { $bias + $digits as $t } else { $bias };
                    // With the exponent of 1.
                    let mantissa = $t::from_bits(normal.to_bits() & !$t::INFINITY.to_bits() | $t::to_bits(1.0));
                    let has_exponent = x.abs() > 0.0 && x.abs() <= $t::MAX;
                    Wide {
                        mantissa: if has_exponent { mantissa } else { x },
                        exponent: if has_exponent { exponent } else { 0.0 },
                    }
                }

                #[inline(always)]
                fn exp(x: $t, low: $t) -> Self {
                    // The rounding error of an overflow is no number.
                    let low = if low.abs() < 1.0 { low } else { 0.0 };
                    let x = clamp(x, -$limit, $limit);
                    let (n, _) = round_product(x, LOG2_E);
                    let y = 1.0 + expm1_of_rest(x, n);
                    Wide { mantissa: y.mul_add(low, y), exponent: n }
                }

                #[inline(always)]
                fn sigmoid(x: $t, low: $t) -> Self {
                    let is_negative = x < 0.0;
                    let top = Self::exp(if is_negative { x } else { -x }, if is_negative { low } else { -low });
                    // e^-|x|; from an exponent of -100 on, it is nothing beside 1.
                    let e = top.mantissa * power_of_two(if top.exponent < -100.0 { -100.0 } else { top.exponent });
                    Wide {
                        mantissa: if is_negative { top.mantissa } else { 1.0 } / (1.0 + e),
                        exponent: if is_negative { top.exponent } else { 0.0 },
                    }
                }

                #[inline(always)]
                fn normal_cdf(x: $t) -> Self {
                    // Up to 1.3, (1 + erf(x / sqrt 2)) / 2. Beyond, the tail is P(-t) = e^(-t^2/2) p(u) / (t + 5), with
                    // u = (t - 5) / (t + 5).
                    let t = clamp(x.abs(), 0.0, 70.0);
                    let inverse = 1.0 / (t + 5.0);
                    let ratio = polynomial((t - 5.0) * inverse, $tail) * inverse;
                    let half = -0.5 * x;
                    let square = half * x;
                    let density = Self::exp(square, half.mul_add(x, -square));
                    let tail = Wide { mantissa: density.mantissa * ratio, exponent: density.exponent };
                    let near = erf_near(x * FRAC_1_SQRT_2).mul_add(0.5, 0.5);
                    let above = if t < 1.3 { near } else { 1.0 - tail.narrow() };
                    let is_tail = x <= -1.3;
                    Wide {
                        mantissa: if is_tail { tail.mantissa } else { above },
                        exponent: if is_tail { tail.exponent } else { 0.0 },
                    }
                }

                #[inline(always)]
                fn pow(base: $t, exponent: $t, y: $t) -> Self {
                    let is_limit = y.is_nan() || base == 0.0 || base.is_infinite();
                    if y.is_normal() || is_limit { Wide::new(y) } else { power(base as f64, exponent as f64).into() }
                }

                #[inline(always)]
                fn powi(base: $t, exponent: i32) -> Self {
                    power(base as f64, f64::from(exponent)).into()
                }

                #[inline(always)]
                fn narrow(self) -> $t {
                    let exponent = clamp(self.exponent, -2.0 * ($bias - 1.0), 2.0 * ($bias - 1.0));
                    let half = exponent.mul_add(0.5, ROUND) - ROUND;
                    self.mantissa * power_of_two(half) * power_of_two(exponent - half)
                }
            }
        }
    };
}

wide!(
    f32,
    23,
    127.0,
    350.0,
    [
        0.769_193_05,
        -0.665_382_5,
        0.495_305_62,
        -0.313_533_28,
        0.165_020_18,
        -0.069_117_29,
        0.020_797_007,
        -0.002_999_095,
        -0.000_806_881_8,
        0.000_554_833_6,
        -4.004_088_3e-5,
        -5.372_804_3e-5,
    ]
);
wide!(
    f64,
    52,
    1023.0,
    2200.0,
    [
        0.769_193_049_750_062_96,
        -0.665_382_502_890_056_9,
        0.495_305_615_969_976_26,
        -0.313_533_156_671_287_9,
        0.165_020_366_170_396_26,
        -0.069_118_638_706_868_2,
        0.020_795_066_799_515_385,
        -0.002_993_376_761_934_080_6,
        -0.000_797_869_392_364_643,
        0.000_544_898_992_304_731_8,
        -5.937_578_584_354_543e-5,
        -4.976_244_674_714_934e-5,
        1.668_154_605_856_912e-5,
        3.979_742_023_467_117e-6,
        -2.770_462_712_817_136e-6,
        -3.343_452_003_399_717e-7,
        4.358_503_259_095_646e-7,
        3.968_038_251_058_483e-8,
        -6.970_738_548_629_78e-8,
        -7.907_995_358_822_814e-9,
        1.062_074_614_104_954e-8,
        1.754_669_206_638_716e-9,
        -1.208_340_376_115_194_6e-9,
        -2.386_649_511_331_696e-10,
        5.019_050_299_101_937e-11,
    ]
);

impl From<f64::Wide> for f32::Wide {
    fn from(x: f64::Wide) -> Self {
        f32::Wide { mantissa: x.mantissa as f32, exponent: x.exponent as f32 }
    }
}

/// `base^exponent` by the standard library; from the fourth root if the power is out of range.
fn power(base: f64, exponent: f64) -> f64::Wide {
    let y = base.powf(exponent);
    if y.is_normal() || y.is_nan() || base == 0.0 || base.is_infinite() {
        return f64::Wide::new(y);
    }
    let root = f64::Wide::new(base.abs().powf(0.25 * exponent));
    let power = root * root * (root * root);
    f64::Wide { mantissa: power.mantissa.copysign(y), ..power }
}
