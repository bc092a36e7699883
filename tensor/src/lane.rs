//! The numbers of a vectorised loop over a formula, with the short reduction of sine and cosine where it is valid.

use crate::real::any_flag;
use crate::{Real, Scalar, Wide};
use std::ops::{Add, Div, Mul, Neg, Sub};

/// The [`Lane`]s of a formula as it is written.
pub const PLAIN: u8 = 0;
/// [`Lane`]s that record whether an argument was too large for the short reduction of angles, or a number too small or
/// too large for quick products ([`Real::checked`]).
pub const QUICK: u8 = 1;
/// [`Lane`]s with the full reduction of angles, and products that keep their range where that is necessary.
pub const EXACT: u8 = 2;

/// A number in a loop of [`lanes_fused`](crate::lanes_fused), in one of the modes [`PLAIN`], [`QUICK`] and [`EXACT`].
///
/// The reduction for arguments of any size takes several times as long as the rest of a sine, and few arguments need
/// it. A loop cannot branch for each element and stay vectorised. So a formula runs on quick numbers first. Blocks of
/// elements with an argument that was too large run again, and have the same bits where it was not. A formula without
/// sines has no overhead. The same holds for products that may leave the range of the type.
#[derive(Debug, Clone, Copy)]
pub struct Lane<T: Scalar, const MODE: u8> {
    value: T,
    /// Whether an argument on the way to `value` was too large ([`Scalar::outside`]), or a product may have left the range
    /// ([`Real::checked`]).
    outside: T::Flags,
}

impl<T: Scalar, const MODE: u8> Lane<T, MODE> {
    #[inline(always)]
    pub(crate) fn new(value: T) -> Self {
        Lane { value, outside: T::Flags::default() }
    }

    #[inline(always)]
    pub(crate) fn parts(self) -> (T, T::Flags) {
        (self.value, self.outside)
    }

    #[inline(always)]
    fn with(self, value: T) -> Self {
        Lane { value, ..self }
    }
}

/// Whether the text of a formula has a sine or a cosine; only then [`Lane`]s have a quick version. A sine inside a
/// function of another name is slower, but just as accurate.
pub const fn has_angle(formula: &str) -> bool {
    let text = formula.as_bytes();
    let (mut start, mut i) = (0, 0);
    while i <= text.len() {
        if i == text.len() || !(text[i].is_ascii_alphanumeric() || text[i] == b'_') {
            let word = i - start == 3;
            if word
                && matches!([text[start], text[start + 1], text[start + 2]], [b's', b'i', b'n'] | [b'c', b'o', b's'])
            {
                return true;
            }
            start = i + 1;
        }
        i += 1;
    }
    false
}

macro_rules! operator {
    ($number:ident, $trait:ident, $method:ident) => {
        impl<T: Scalar, const MODE: u8> $trait for $number<T, MODE> {
            type Output = Self;
            #[inline(always)]
            #[allow(clippy::suspicious_arithmetic_impl)] // flags are joined whatever the operator
            fn $method(self, other: Self) -> Self {
                $number { value: self.value.$method(other.value), outside: self.outside | other.outside }
            }
        }
    };
}

operator!(Lane, Add, add);
operator!(Lane, Sub, sub);
operator!(Lane, Mul, mul);
operator!(Lane, Div, div);
operator!(WideLane, Mul, mul);
operator!(WideLane, Div, div);

impl<T: Scalar, const MODE: u8> Neg for Lane<T, MODE> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        self.with(-self.value)
    }
}

macro_rules! lane {
    (() unary sin $doc:literal) => {
        lane!(angle sin sin_quick);
    };
    (() unary cos $doc:literal) => {
        lane!(angle cos cos_quick);
    };
    (angle $f:ident $quick:ident) => {
        #[inline(always)]
        fn $f(self) -> Self {
            if MODE == QUICK {
                Lane { value: self.value.$quick(), outside: self.outside | self.value.outside() }
            } else {
                self.with(self.value.$f())
            }
        }
    };
    (() unary $f:ident $doc:literal) => {
        #[inline(always)]
        fn $f(self) -> Self {
            self.with(self.value.$f())
        }
    };
    (() binary $f:ident $doc:literal) => {
        #[inline(always)]
        fn $f(self, other: Self) -> Self {
            Lane { value: self.value.$f(other.value), outside: self.outside | other.outside }
        }
    };
}

impl<T: Scalar, const MODE: u8> Real for Lane<T, MODE> {
    #[inline(always)]
    fn like(&self, value: f64) -> Self {
        Lane::new(T::from_f64(value))
    }
    #[inline(always)]
    fn if_positive(&self, yes: Self, no: Self) -> Self {
        let value = self.value.if_positive(yes.value, no.value);
        Lane { value, outside: self.outside | yes.outside | no.outside }
    }
    crate::functions!(lane());
    #[inline(always)]
    fn powi(self, exponent: i32) -> Self {
        self.with(self.value.powi(exponent))
    }
    #[inline(always)]
    fn mul_add(self, factor: Self, summand: Self) -> Self {
        let outside = self.outside | factor.outside | summand.outside;
        Lane { value: self.value.mul_add(factor.value, summand.value), outside }
    }
    #[inline(always)]
    fn checked<const K: usize, const M: usize>(
        quick: Self,
        s: Self,
        inputs: [Self; K],
        factors: [Self; M],
        exact: impl FnOnce() -> Self,
    ) -> Self {
        if MODE == PLAIN {
            return quick;
        }
        let (mut given, mut made, mut k) = ([quick.value; K], [quick.value; M], 0);
        while k < K {
            given[k] = inputs[k].value;
            k += 1;
        }
        k = 0;
        while k < M {
            made[k] = factors[k].value;
            k += 1;
        }
        let flags = any_flag(s.value, given, made);
        if MODE == QUICK {
            return Lane { value: quick.value, outside: quick.outside | flags };
        }
        let value = exact().value;
        quick.with(if T::is_set(flags) { value } else { quick.value })
    }
    type Wide = WideLane<T, MODE>;
}

/// A [`Wide`] product of [`Lane`]s.
#[derive(Debug, Clone, Copy)]
pub struct WideLane<T: Scalar, const MODE: u8> {
    value: T::Wide,
    outside: T::Flags,
}

macro_rules! wide {
    ($($f:ident($first:ident, $second:ident))+) => {
        $(
            #[inline(always)]
            fn $f($first: Lane<T, MODE>, $second: Lane<T, MODE>) -> Self {
                WideLane { value: Wide::$f($first.value, $second.value), outside: $first.outside | $second.outside }
            }
        )+
    };
}

impl<T: Scalar, const MODE: u8> Wide<Lane<T, MODE>> for WideLane<T, MODE> {
    #[inline(always)]
    fn new(x: Lane<T, MODE>) -> Self {
        WideLane { value: x.value.wide(), outside: x.outside }
    }
    wide!(exp(x, low) sigmoid(x, low));
    #[inline(always)]
    fn normal_cdf(x: Lane<T, MODE>) -> Self {
        WideLane { value: Wide::normal_cdf(x.value), outside: x.outside }
    }
    #[inline(always)]
    fn pow(base: Lane<T, MODE>, exponent: Lane<T, MODE>, y: Lane<T, MODE>) -> Self {
        let outside = base.outside | exponent.outside | y.outside;
        WideLane { value: Wide::pow(base.value, exponent.value, y.value), outside }
    }
    #[inline(always)]
    fn powi(base: Lane<T, MODE>, exponent: i32) -> Self {
        WideLane { value: Wide::powi(base.value, exponent), outside: base.outside }
    }
    #[inline(always)]
    fn narrow(self) -> Lane<T, MODE> {
        Lane { value: self.value.narrow(), outside: self.outside }
    }
}

#[cfg(test)]
mod tests {
    use super::has_angle;

    #[test]
    fn has_angle_finds_sine_and_cosine() {
        for formula in ["x.sin()", "Real::cos(x)", "a * (x + b).sin() - 1.0", "cos", "sinh(x) + sin(x)"] {
            assert!(has_angle(formula), "{formula}");
        }
        for formula in ["", "x", "x.asin()", "x.sinh() + x.cosh()", "x.sin_pi()", "x * cosine", "si * n"] {
            assert!(!has_angle(formula), "{formula}");
        }
    }
}
