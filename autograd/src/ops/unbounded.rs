//! Numbers with an exponent of any size.

use super::double::Double;
use super::running::Running;
use raygrad_tensor::scale::power_of_two;

/// A number `factor * 2^exponent` of any size. The exponent stays 0 as long as numbers are in the middle of f64's range.
#[derive(Debug, Clone, Copy)]
pub(super) struct Unbounded {
    /// Between 2^-400 and 2^400, unless it is 0 or not finite. After terms cancel it may be smaller.
    factor: Double,
    exponent: i64,
}

impl From<f64> for Unbounded {
    #[inline(always)]
    fn from(x: f64) -> Self {
        Unbounded { factor: Double::from(1.0), exponent: 0 }.times(x)
    }
}

impl Unbounded {
    #[inline(always)]
    fn is_in_the_middle(x: f64) -> bool {
        const END: f64 = f64::from_bits((1023 + 400) << 52);
        x.abs() > 1.0 / END && x.abs() < END
    }

    #[inline(never)]
    fn times_any(self, x: f64) -> Self {
        if is_special(self.factor.value()) || is_special(x) {
            return Unbounded { factor: Double::from(self.factor.value() * x), exponent: 0 };
        }
        let ((a, up), (b, up_too)) = (self.split(), split(x));
        Unbounded { factor: a.times(b), exponent: up + up_too }
    }

    /// The factor in 1..2, up to its sign, and the exponent that belongs to it.
    fn split(self) -> (Double, i64) {
        let (_, up) = split(self.factor.value());
        // In two steps: after terms have cancelled, the factor may be as small as a subnormal number.
        let factor = halves(-up).into_iter().fold(self.factor, |factor, half| factor.scaled(power_of_two(half)));
        (factor, self.exponent + up)
    }

    /// The product of two numbers.
    pub fn product_of(a: f64, b: f64) -> Self {
        Unbounded::from(a).times(b)
    }

    /// The difference.
    pub fn minus(self, other: Self) -> Self {
        self.plus(Unbounded { factor: other.factor.scaled(-1.0), ..other })
    }

    #[inline(never)]
    fn plus_any(self, other: Self) -> Self {
        let [a, b] = [self, other].map(|x| x.factor.value());
        match (is_special(a), is_special(b)) {
            (true, true) => return Unbounded { factor: Double::from(a + b), exponent: 0 },
            (true, false) => return if a == 0.0 { other } else { self },
            (false, true) => return if b == 0.0 { self } else { other },
            (false, false) => {}
        }
        let [(a, up), (b, up_too)] = [self, other].map(Unbounded::split);
        let most = up.max(up_too);
        let sum = a.scaled(power_of_two(up - most)).plus(b.scaled(power_of_two(up_too - most)));
        Unbounded { factor: sum, exponent: most }
    }
}

impl Running for Unbounded {
    #[inline(always)]
    fn times(self, x: f64) -> Self {
        let factor = self.factor.times(x);
        if Unbounded::is_in_the_middle(factor.value()) { Unbounded { factor, ..self } } else { self.times_any(x) }
    }
    #[inline(always)]
    fn product(self, other: Self) -> Self {
        let factor = self.factor.product(other.factor);
        if Unbounded::is_in_the_middle(factor.value()) {
            return Unbounded { factor, exponent: self.exponent + other.exponent };
        }
        let [a, b] = [self, other].map(|x| x.factor.value());
        if is_special(a) || is_special(b) {
            return Unbounded { factor: Double::from(a * b), exponent: 0 };
        }
        let [(a, up), (b, up_too)] = [self, other].map(Unbounded::split);
        Unbounded { factor: a.product(b), exponent: up + up_too }
    }
    #[inline(always)]
    fn plus(self, other: Self) -> Self {
        let factor = self.factor.plus(other.factor);
        if self.exponent == other.exponent && Unbounded::is_in_the_middle(factor.value()) {
            Unbounded { factor, ..self }
        } else {
            self.plus_any(other)
        }
    }
    #[inline(always)]
    fn value(self) -> f64 {
        if self.exponent == 0 { self.factor.value() } else { scaled(self.factor.value(), 1.0, self.exponent) }
    }
    #[inline(always)]
    fn is_in_range(self) -> bool {
        true
    }
}

/// Whether a number has no exponent.
pub(super) fn is_special(x: f64) -> bool {
    x == 0.0 || !x.is_finite()
}

/// A finite number other than 0 as a factor in 1..2, with its sign, and an exponent of two.
pub(super) fn split(x: f64) -> (f64, i64) {
    const MASK: u64 = 0x7ff << 52;
    let lift = if x.is_normal() { 0 } else { 54 };
    let bits = (x * power_of_two(lift)).to_bits();
    (f64::from_bits(bits & !MASK | 1023 << 52), (bits >> 52 & 0x7ff) as i64 - 1023 - lift)
}

/// Two numbers that differ by 1 at most and add up to `exponent`.
pub(super) fn halves(exponent: i64) -> [i64; 2] {
    [exponent / 2, exponent - exponent / 2]
}

/// `product * g * 2^exponent`, for a product that is near 1, 0 or not finite, rounded once more at most.
pub(super) fn scaled(product: f64, g: f64, exponent: i64) -> f64 {
    if is_special(product) || is_special(g) {
        return product * g;
    }
    let (g, of_g) = split(g);
    let [up, up_too] = halves(exponent + of_g).map(power_of_two);
    product * g * up * up_too
}
