//! Real numbers with 100 bits and exponents without bounds: the reference that operations are measured against.
//!
//! `reference/exact.py` computes arguments and values with mpmath, and a test compares them.

use std::array::from_fn;
use std::cmp::Ordering;
use std::f64::consts;
use std::ops::{Add, Div, Mul, Neg, Sub};
use std::sync::LazyLock;

/// `(high + low) 2^exponent`: the sum of two numbers that do not overlap, with 1 <= |high| < 2. Zero, infinities and NaN
/// are in `high` alone.
#[derive(Debug, Clone, Copy)]
pub struct Exact {
    high: f64,
    low: f64,
    exponent: i64,
}

/// The sum of two numbers and its rounding error, for |a| >= |b|.
fn quick_two_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    (sum, b - (sum - a))
}

/// The sum of two numbers and its rounding error.
fn two_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    let back = sum - a;
    (sum, (a - (sum - back)) + (b - back))
}

/// x 2^n, exact if the result is a normal number.
pub fn scaled(x: f64, n: i64) -> f64 {
    let (mut y, mut n) = (x, n.clamp(-3000, 3000));
    while n != 0 {
        let step = n.clamp(-1000, 1000);
        y *= f64::from_bits(((step + 1023) as u64) << 52);
        n -= step;
    }
    y
}

/// Reciprocals of whole numbers.
static RECIPROCALS: LazyLock<[Exact; 256]> = LazyLock::new(|| from_fn(|n| Exact::new(n as f64).recip()));

/// The sum of `first` and of terms that `next` gives from the one before, the reciprocals, and n = 1, 2, ..; until a term
/// is nothing beside the sum.
fn series(first: Exact, next: impl Fn(Exact, &[Exact], usize) -> Exact) -> Exact {
    let (mut sum, mut term) = (first, first);
    for n in 1..100 {
        term = next(term, &*RECIPROCALS, n);
        sum = sum + term;
        if term.is_zero() || term.exponent < sum.exponent - 110 {
            break;
        }
    }
    sum
}

impl Exact {
    pub const ZERO: Exact = Exact { high: 0.0, low: 0.0, exponent: 0 };
    const LN_2: Exact = Exact { high: 2.0 * consts::LN_2, low: 2.0 * 2.319_046_813_846_299_6e-17, exponent: -1 };
    pub const PI: Exact = Exact { high: 0.5 * consts::PI, low: 0.5 * 1.224_646_799_147_353_2e-16, exponent: 1 };

    /// `(high + low) 2^exponent` of any two numbers.
    pub fn of(high: f64, low: f64, exponent: i64) -> Exact {
        let (high, low) = if low == 0.0 { (high, low) } else { two_sum(high, low) };
        if high == 0.0 || !high.is_finite() {
            return Exact { high, low: 0.0, exponent: 0 };
        }
        // Subnormals have their exponent too.
        let lift = if high.abs() < 1e-290 { 200 } else { 0 };
        let (high, low) = (scaled(high, lift), scaled(low, lift));
        let own = (high.to_bits() >> 52 & 0x7ff) as i64 - 1023;
        Exact { high: scaled(high, -own), low: scaled(low, -own), exponent: exponent + own - lift }
    }

    pub fn new(x: f64) -> Exact {
        Exact::of(x, 0.0, 0)
    }

    pub fn is_zero(self) -> bool {
        self.high == 0.0
    }

    pub fn is_finite(self) -> bool {
        self.high.is_finite()
    }

    pub fn is_negative(self) -> bool {
        self.high < 0.0
    }

    /// The nearest f64, and the rest.
    pub fn parts(self) -> [f64; 2] {
        [self.high, self.low].map(|part| scaled(part, self.exponent))
    }

    /// The exponent of the leading digit.
    pub fn exponent(self) -> i64 {
        self.exponent
    }

    /// The nearest f64.
    pub fn to_f64(self) -> f64 {
        scaled(self.high, self.exponent)
    }

    pub fn abs(self) -> Exact {
        if self.high < 0.0 { -self } else { self }
    }

    /// Times 2^n.
    pub fn shifted(self, n: i64) -> Exact {
        if self.high == 0.0 { self } else { Exact { exponent: self.exponent + n, ..self } }
    }

    pub fn recip(self) -> Exact {
        Exact::new(1.0) / self
    }

    pub fn square(self) -> Exact {
        self * self
    }

    pub fn sqrt(self) -> Exact {
        if self.is_zero() || !self.is_finite() {
            return Exact::new(self.high.sqrt());
        }
        let odd = self.exponent.rem_euclid(2);
        let half = (self.exponent - odd) / 2;
        let x = Exact { exponent: odd, ..self };
        let y = Exact::new(x.to_f64().sqrt());
        // One step of Newton's method.
        let y = y + (x - y * y) / y.shifted(1);
        y.shifted(half)
    }

    /// The nearest whole number; ties go to the even one.
    fn round(self) -> f64 {
        self.to_f64().round_ties_even()
    }

    pub fn exp(self) -> Exact {
        if self.exponent > 20 && self.is_finite() {
            return if self.is_negative() { Exact::ZERO } else { Exact::new(f64::INFINITY) };
        }
        let n = (self / Exact::LN_2).round();
        let rest = (self - Exact::new(n) * Exact::LN_2).shifted(-8);
        let mut y = Exact::new(1.0) + rest.expm1_series();
        for _ in 0..8 {
            y = y * y;
        }
        y.shifted(n as i64)
    }

    /// Taylor's series of e^x - 1.
    fn expm1_series(self) -> Exact {
        series(self, |term, reciprocals, n| term * self * reciprocals[n + 1])
    }

    pub fn expm1(self) -> Exact {
        if self.exponent < -1 { self.expm1_series() } else { self.exp() - Exact::new(1.0) }
    }

    /// ln((1 + s) / (1 - s)).
    fn ln_of_ratio(s: Exact) -> Exact {
        let (square, two) = (s * s, Exact::new(2.0));
        // Each term has the factor of the one before.
        series(s, |term, reciprocals, n| {
            term * square * (two * Exact::new(n as f64) - Exact::new(1.0)) * reciprocals[2 * n + 1]
        })
        .shifted(1)
    }

    pub fn ln(self) -> Exact {
        if !(self.high > 0.0) || !self.is_finite() {
            return Exact::new(self.high.ln());
        }
        let up = i64::from(self.high > consts::SQRT_2);
        let m = Exact { exponent: -up, ..self };
        let one = Exact::new(1.0);
        Exact::new((self.exponent + up) as f64) * Exact::LN_2 + Exact::ln_of_ratio((m - one) / (m + one))
    }

    pub fn ln1p(self) -> Exact {
        let small = self.exponent < -2;
        if small { Exact::ln_of_ratio(self / (Exact::new(2.0) + self)) } else { (Exact::new(1.0) + self).ln() }
    }

    /// Sine and cosine of an angle within about pi/4.
    fn sin_cos_series(self) -> [Exact; 2] {
        let square = -(self * self);
        [(self, 1), (Exact::new(1.0), 0)].map(|(first, odd)| {
            series(first, |term, reciprocals, n| {
                term * square * reciprocals[2 * n - 1 + odd] * reciprocals[2 * n + odd]
            })
        })
    }

    /// Sine and cosine, turned by n right angles.
    fn turned([sine, cosine]: [Exact; 2], n: i64) -> [Exact; 2] {
        match n.rem_euclid(4) {
            0 => [sine, cosine],
            1 => [cosine, -sine],
            2 => [-sine, -cosine],
            _ => [-cosine, sine],
        }
    }

    /// Sine and cosine of an f64.
    pub fn sin_cos(x: f64) -> [Exact; 2] {
        if !x.is_finite() {
            return [Exact::new(f64::NAN); 2];
        }
        let (n, rest) = quarters(x.abs());
        let [sine, cosine] = Exact::turned(rest.sin_cos_series(), n);
        [if x < 0.0 { -sine } else { sine }, cosine]
    }

    /// Sine and cosine of pi times an f64.
    pub fn sin_cos_pi(x: f64) -> [Exact; 2] {
        if !x.is_finite() {
            return [Exact::new(f64::NAN); 2];
        }
        // Exact: from 2^53 on all numbers are even.
        let x = x % 2.0;
        let n = (2.0 * x).round_ties_even();
        Exact::turned((Exact::new(x - 0.5 * n) * Exact::PI).sin_cos_series(), n as i64)
    }

    pub fn atan(self) -> Exact {
        if self.abs() > Exact::new(1.0) {
            let right = if self.is_negative() { -Exact::PI } else { Exact::PI }.shifted(-1);
            return right - self.recip().atan();
        }
        if self.exponent < -60 {
            return self;
        }
        // The angle between this tangent and that of the f64 nearest to the result.
        let near = self.to_f64().atan();
        let [sine, cosine] = Exact::new(near).sin_cos_series();
        let rest = (self * cosine - sine) / (cosine + self * sine);
        Exact::new(near) + (rest - rest * rest * rest / Exact::new(3.0))
    }

    /// The angle of the vector (x, `self`).
    pub fn atan2(self, x: Exact) -> Exact {
        match x.high.partial_cmp(&0.0) {
            Some(Ordering::Equal) => match self.high.partial_cmp(&0.0) {
                Some(Ordering::Less) => -Exact::PI.shifted(-1),
                Some(Ordering::Greater) => Exact::PI.shifted(-1),
                _ => Exact::ZERO,
            },
            Some(Ordering::Greater) => (self / x).atan(),
            _ if self.is_negative() => (self / x).atan() - Exact::PI,
            _ => (self / x).atan() + Exact::PI,
        }
    }

    pub fn sinh(self) -> Exact {
        let t = self.abs().expm1();
        let y =
            if self.exponent > 8 { self.abs().exp().shifted(-1) } else { (t + t / (t + Exact::new(1.0))).shifted(-1) };
        if self.is_negative() { -y } else { y }
    }

    pub fn cosh(self) -> Exact {
        let e = self.abs().exp();
        (e + e.recip()).shifted(-1)
    }

    pub fn tanh(self) -> Exact {
        let t = self.abs().shifted(1).expm1();
        let y = if self.exponent > 8 { Exact::new(1.0) } else { t / (t + Exact::new(2.0)) };
        if self.is_negative() { -y } else { y }
    }

    pub fn sigmoid(self) -> Exact {
        (Exact::new(1.0) + (-self).exp()).recip()
    }

    pub fn softplus(self) -> Exact {
        let tail = (-self.abs()).exp().ln1p();
        if self.is_negative() { tail } else { self + tail }
    }

    pub fn erf(self) -> Exact {
        if self.abs() > Exact::new(2.5) {
            let tail = Exact::new(1.0) - self.abs().erfc();
            return if self.is_negative() { -tail } else { tail };
        }
        // A series of positive terms, 2^n x^(2n + 1) / (2n + 1)!!.
        let twice = self.square().shifted(1);
        let sum = series(self, |term, reciprocals, n| term * twice * reciprocals[2 * n + 1]);
        (-self.square()).exp() * sum.shifted(1) / Exact::PI.sqrt()
    }

    pub fn erfc(self) -> Exact {
        if self.exponent > 30 {
            return if self.is_negative() { Exact::new(2.0) } else { Exact::ZERO };
        }
        if !(self > Exact::new(2.5)) {
            return Exact::new(1.0) - self.erf();
        }
        // Laplace's continued fraction, from its end; it converges faster for larger numbers.
        let mut fraction = self;
        for n in (1..10 + (1200.0 / self.square().to_f64()) as u32).rev() {
            fraction = self + Exact::new(0.5 * f64::from(n)) / fraction;
        }
        (-self.square()).exp() / (fraction * Exact::PI.sqrt())
    }

    pub fn normal_cdf(self) -> Exact {
        (-self / Exact::new(2.0).sqrt()).erfc().shifted(-1)
    }

    /// A power of positive numbers.
    pub fn pow(self, exponent: Exact) -> Exact {
        (self.ln() * exponent).exp()
    }
}

/// 2 / pi, in digits of base 2^32.
const TWO_OVER_PI: [u32; 40] = [
    0xa2f9836e, 0x4e441529, 0xfc2757d1, 0xf534ddc0, 0xdb629599, 0x3c439041, 0xfe5163ab, 0xdebbc561, 0xb7246e3a,
    0x424dd2e0, 0x06492eea, 0x09d1921c, 0xfe1deb1c, 0xb129a73e, 0xe88235f5, 0x2ebb4484, 0xe99c7026, 0xb45f7e41,
    0x3991d639, 0x835339f4, 0x9c845f8b, 0xbdf9283b, 0x1ff897ff, 0xde05980f, 0xef2f118b, 0x5a0a6d1f, 0x6d367ecf,
    0x27cb09b7, 0x4f463f66, 0x9e5fea2d, 0x7527bac7, 0xebe5f17b, 0x3d0739f7, 0x8a5292ea, 0x6bfb5fb1, 0x1f8d5d08,
    0x56033046, 0xfc7b6bab, 0xf0cfbc20, 0x9af4361d,
];

/// The number of right angles in a positive angle, modulo 4, and the rest, within pi/4 of 0.
fn quarters(x: f64) -> (i64, Exact) {
    let x = Exact::new(x);
    if x.exponent < -1 {
        return (0, x);
    }
    // x is a whole number of 53 bits times 2^shift.
    let (whole, shift) = (scaled(x.high, 52) as u64, x.exponent - 52);
    // The first digit of 2/pi whose product with x is not a multiple of 2^32 right angles.
    let first = (shift - 64).max(0) / 32;
    // digits[k] counts 2^(shift - 32 (first + k + 1)) right angles; the products carry upwards.
    let count = 10;
    let mut digits = vec![0_u64; count + 2];
    for k in (0..count).rev() {
        let digit = u64::from(TWO_OVER_PI.get(first as usize + k).copied().unwrap_or(0));
        let (low, high) = ((whole & 0xffff_ffff) * digit, (whole >> 32) * digit);
        // digits are shifted by two places, for the carries of the first.
        for (place, value) in [(k + 2, low & 0xffff_ffff), (k + 1, (low >> 32) + (high & 0xffff_ffff)), (k, high >> 32)]
        {
            digits[place] += value;
        }
    }
    for place in (1..digits.len()).rev() {
        digits[place - 1] += digits[place] >> 32;
        digits[place] &= 0xffff_ffff;
    }
    // As numbers of right angles modulo 4, the whole part by itself.
    let exponent = |place: usize| shift - 32 * (first + place as i64 - 1);
    let (mut n, mut rest) = (0_i64, vec![]);
    for (place, &digit) in digits.iter().enumerate() {
        let exponent = exponent(place);
        if exponent >= 2 {
            continue;
        }
        if exponent >= 0 {
            n += (digit << exponent) as i64 & 3;
        } else if exponent > -32 {
            n += (digit >> -exponent) as i64 & 3;
            rest.push(Exact::of((digit & ((1 << -exponent) - 1)) as f64, 0.0, exponent));
        } else {
            rest.push(Exact::of(digit as f64, 0.0, exponent));
        }
    }
    let mut turns = Exact::ZERO;
    // Above one half, the next right angle is nearer. The leading digits are subtracted before the rest is added.
    let over = rest.first().is_some_and(|&x| x > Exact::new(0.5))
        || rest.first().is_some_and(|&x| x + rest.get(1).copied().unwrap_or(Exact::ZERO) > Exact::new(0.5));
    if over {
        n += 1;
        turns = -Exact::new(1.0);
    }
    for part in rest {
        turns = turns + part;
    }
    (n, turns * Exact::PI.shifted(-1))
}

impl PartialEq for Exact {
    fn eq(&self, other: &Exact) -> bool {
        self.partial_cmp(other) == Some(Ordering::Equal)
    }
}

impl PartialOrd for Exact {
    fn partial_cmp(&self, other: &Exact) -> Option<Ordering> {
        if !self.is_finite() || !other.is_finite() {
            return self.high.partial_cmp(&other.high);
        }
        (*self - *other).high.partial_cmp(&0.0)
    }
}

impl Neg for Exact {
    type Output = Exact;
    fn neg(self) -> Exact {
        Exact { high: -self.high, low: -self.low, ..self }
    }
}

impl Add for Exact {
    type Output = Exact;
    fn add(self, other: Exact) -> Exact {
        if self.is_zero() || !other.is_finite() {
            return if self.is_finite() { other } else { Exact::new(self.high + other.high) };
        }
        if other.is_zero() || !self.is_finite() {
            return self;
        }
        let (a, b) = if self.exponent >= other.exponent { (self, other) } else { (other, self) };
        let down = b.exponent - a.exponent;
        if down < -300 {
            return a;
        }
        let (b_high, b_low) = (scaled(b.high, down), scaled(b.low, down));
        let (high, rest) = two_sum(a.high, b_high);
        let (low, last) = two_sum(a.low, b_low);
        let (high, rest) = quick_two_sum(high, rest + low);
        let (high, rest) = quick_two_sum(high, rest + last);
        Exact::of(high, rest, a.exponent)
    }
}

impl Sub for Exact {
    type Output = Exact;
    fn sub(self, other: Exact) -> Exact {
        self + -other
    }
}

impl Mul for Exact {
    type Output = Exact;
    fn mul(self, other: Exact) -> Exact {
        let high = self.high * other.high;
        if high == 0.0 || !high.is_finite() {
            return Exact::new(high);
        }
        let low = self.high.mul_add(other.high, -high) + (self.high * other.low + self.low * other.high);
        Exact::of(high, low, self.exponent + other.exponent)
    }
}

impl Div for Exact {
    type Output = Exact;
    fn div(self, other: Exact) -> Exact {
        let first = self.high / other.high;
        if first == 0.0 || !first.is_finite() {
            return Exact::new(first);
        }
        let (x, y) = (Exact { exponent: 0, ..self }, Exact { exponent: 0, ..other });
        let rest = x - y * Exact::new(first);
        let second = rest.to_f64() / y.high;
        let rest = rest - y * Exact::new(second);
        let quotient = Exact::new(first) + (Exact::new(second) + Exact::new(rest.to_f64() / y.high));
        quotient.shifted(self.exponent - other.exponent)
    }
}
