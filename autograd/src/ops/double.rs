//! Numbers in twice the digits of f64.

use super::running::Running;

/// The sum of two numbers, of which the first is the sum rounded to f64.
#[derive(Debug, Clone, Copy)]
pub(super) struct Double {
    high: f64,
    low: f64,
}

impl Double {
    /// The product of two numbers, exact if its low part does not underflow.
    #[inline(always)]
    pub fn product_of(a: f64, b: f64) -> Self {
        let high = a * b;
        Double { high, low: a.mul_add(b, -high) }
    }

    /// The sum of a number and a much smaller one.
    #[inline(always)]
    fn sum_of(high: f64, low: f64) -> Self {
        let sum = high + low;
        // A zero keeps its sign, and the low part of infinity may be NaN.
        let is_whole = low == 0.0 || !high.is_finite();
        if is_whole { Double { high, low: 0.0 } } else { Double { high: sum, low: low - (sum - high) } }
    }

    /// Both parts times `scale`, a power of two.
    #[inline(always)]
    pub fn scaled(self, scale: f64) -> Self {
        Double { high: self.high * scale, low: self.low * scale }
    }

    /// The difference.
    #[inline(always)]
    pub fn minus(self, other: Self) -> Self {
        self.plus(other.scaled(-1.0))
    }
}

impl From<f64> for Double {
    #[inline(always)]
    fn from(x: f64) -> Self {
        Double { high: x, low: 0.0 }
    }
}

impl Running for Double {
    #[inline(always)]
    fn times(self, x: f64) -> Self {
        let Double { high, low } = Double::product_of(self.high, x);
        Double::sum_of(high, low + self.low * x)
    }
    #[inline(always)]
    fn product(self, other: Self) -> Self {
        let Double { high, low } = Double::product_of(self.high, other.high);
        Double::sum_of(high, low + (self.high * other.low + self.low * other.high))
    }
    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        let sum = self.high + other.high;
        let of_other = sum - self.high;
        let rest = (self.high - (sum - of_other)) + (other.high - of_other);
        Double::sum_of(sum, rest + (self.low + other.low))
    }
    #[inline(always)]
    fn value(self) -> f64 {
        self.high
    }
    #[inline(always)]
    fn is_in_range(self) -> bool {
        // The low part too is a normal number.
        (1e-270..1e300).contains(&self.high.abs())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_and_sums_have_twice_the_digits() {
        let third = 1.0 / 3.0;
        // 1/3 is 2^-54 / 3 larger than its rounding, relative to 1.
        let square = Double::from(third).times(third);
        assert_eq!(square.value(), third * third);
        assert_eq!(square.minus(Double::from(third * third)).value(), third.mul_add(third, -third * third));
        let cube = square.times(3.0).times(3.0).times(third);
        assert_eq!(cube.minus(Double::from(third)).value(), -third * 2.0_f64.powi(-53));
        let sum = Double::from(1.0).plus(Double::from(1e-30)).minus(Double::from(1.0));
        assert_eq!(sum.value(), 1e-30);
        assert_eq!(square.product(square).value(), 0.012345679012345677);
        assert!(Double::from(-1.0).times(0.0).value().is_sign_negative());
    }
}
