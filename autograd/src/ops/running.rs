//! Numbers that carry running products and sums.

/// A running product or sum of products.
pub(super) trait Running: Copy + From<f64> {
    /// The product with a number.
    fn times(self, x: f64) -> Self;
    /// The product.
    fn product(self, other: Self) -> Self;
    /// The sum.
    fn plus(self, other: Self) -> Self;
    /// The number in f64.
    fn value(self) -> f64;
    /// Whether the number is right, if it is not 0.
    fn is_in_range(self) -> bool;
}

impl Running for f64 {
    #[inline(always)]
    fn times(self, x: f64) -> f64 {
        self * x
    }
    #[inline(always)]
    fn product(self, other: f64) -> f64 {
        self * other
    }
    #[inline(always)]
    fn plus(self, other: f64) -> f64 {
        self + other
    }
    #[inline(always)]
    fn value(self) -> f64 {
        self
    }
    #[inline(always)]
    fn is_in_range(self) -> bool {
        (1e-300..1e300).contains(&self.abs())
    }
}
