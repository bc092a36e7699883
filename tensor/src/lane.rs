//! The numbers of a vectorised loop over a formula, with the short reduction of sine and cosine where it is valid.

use crate::{Real, Scalar};
use std::ops::{Add, Div, Mul, Neg, Sub};

/// A number in a loop of [`lanes_fused`](crate::lanes_fused). With `QUICK`, its sine and cosine use the short argument
/// reduction, and it records whether that was valid. Without, it is a plain number.
///
/// The reduction for arguments of any size takes several times as long as the rest of a sine, and few arguments need
/// it. A loop cannot branch for each element and stay vectorised. So a formula runs on quick numbers first. Blocks of
/// elements with an argument that was too large run again on plain numbers. The bits are those of plain numbers in any
/// case. A formula without sines has no overhead.
#[derive(Debug, Clone, Copy)]
pub struct Lane<T: Scalar, const QUICK: bool> {
    value: T,
    /// Whether an argument on the way to `value` was too large; see [`Scalar::outside`].
    outside: T::Flags,
}

impl<T: Scalar, const QUICK: bool> Lane<T, QUICK> {
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
    ($trait:ident, $method:ident) => {
        impl<T: Scalar, const QUICK: bool> $trait for Lane<T, QUICK> {
            type Output = Self;
            #[inline(always)]
            #[allow(clippy::suspicious_arithmetic_impl)] // flags are joined whatever the operator
            fn $method(self, other: Self) -> Self {
                Lane { value: self.value.$method(other.value), outside: self.outside | other.outside }
            }
        }
    };
}

operator!(Add, add);
operator!(Sub, sub);
operator!(Mul, mul);
operator!(Div, div);

impl<T: Scalar, const QUICK: bool> Neg for Lane<T, QUICK> {
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
            if QUICK {
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

impl<T: Scalar, const QUICK: bool> Real for Lane<T, QUICK> {
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
