//! Derivatives of the elementary functions: each takes the slope `s` of the argument and returns that of the result.
//!
//! A slope is an incoming gradient times a derivative. It may be an ordinary number where the derivative alone, or a
//! product on the way to it, is out of range: so such products are [`Wide`]. Products and quotients of operands alone have
//! the same order as the quick ones, and so the same bits: a power of two as a factor of the operands is one of the result.

use raygrad_tensor::{Real, Wide};
use std::f64::consts::{LN_2, PI};

/// [`Real::checked`] with an expression in place of the closure. Only inlined closures are vectorised.
macro_rules! checked {
    ($quick:expr, $s:expr, $inputs:expr, $factors:expr, $exact:expr) => {
        raygrad_tensor::Real::checked(
            $quick,
            $s,
            $inputs,
            $factors,
            #[inline(always)]
            || $exact,
        )
    };
}
pub(crate) use checked;

/// `x`, but at least `low`; NaN stays NaN.
#[inline(always)]
pub(crate) fn at_least<E: Real>(x: E, low: f64) -> E {
    let low = x.like(low);
    (low - x).if_positive(low, x)
}

/// `x`, but at most `high`; NaN stays NaN.
#[inline(always)]
pub(crate) fn at_most<E: Real>(x: E, high: f64) -> E {
    let high = x.like(high);
    (x - high).if_positive(high, x)
}

/// `x` limited to `-limit..=limit`; NaN stays NaN.
#[inline(always)]
pub(crate) fn within<E: Real>(x: E, limit: f64) -> E {
    at_most(at_least(x, -limit), limit)
}

/// Where a bell and an activation have long reached their limits, but the square is still in range. Beyond it, further
/// derivatives would be infinity times 0.
pub(crate) const FAR: f64 = 1e4;

/// `s e^x`, for y = e^x.
#[inline(always)]
pub(crate) fn exp_slope<E: Real>(s: E, x: E, y: E) -> E {
    checked!(s * y, s, [], [y], (s.wide() * E::Wide::exp(x, x.like(0.0))).narrow())
}

/// `s e^(c x^2)`, for a power of two `c`. The rounding error of the square counts as many times as the square is large.
#[inline(always)]
pub(crate) fn bell<E: Real>(s: E, x: E, c: f64) -> E {
    let [square, low] = scaled_square(x, c);
    let y = square.exp();
    checked!(s * y.mul_add(low, y), s, [], [y], (s.wide() * wide_bell(x, c)).narrow())
}

/// `e^(c x^2)`, for a power of two `c`.
#[inline(always)]
pub(crate) fn wide_bell<E: Real>(x: E, c: f64) -> E::Wide {
    let [square, low] = scaled_square(x, c);
    E::Wide::exp(square, low)
}

/// `c x^2` and its rounding error, for a power of two `c`.
#[inline(always)]
fn scaled_square<E: Real>(x: E, c: f64) -> [E; 2] {
    let scaled = x.like(c) * x;
    let square = scaled * x;
    // Where the square overflows, there is none.
    let (one, low) = (x.like(1.0), scaled.mul_add(x, -square));
    [square, (one - low.abs()).if_positive(low, x.like(0.0))]
}

/// `s 2^x ln 2`, for y = 2^x; from four times the rounded quarter of x and the rest.
#[inline(always)]
pub(crate) fn exp2_slope<E: Real>(s: E, x: E, y: E) -> E {
    let ln_2 = x.like(LN_2);
    checked!(s * (y * ln_2), s, [], [y], {
        let x = at_most(at_least(x, -4e3), 4e3);
        let quarter = (x.like(0.25) * x).round();
        let (root, rest) = (quarter.exp2().wide(), (x - x.like(4.0) * quarter).exp2().wide());
        (s.wide() * ln_2.wide() * (root * root) * (root * root) * rest).narrow()
    })
}

/// 1 / (1 + e^-x).
#[inline(always)]
pub(crate) fn wide_sigmoid<E: Real>(x: E) -> E::Wide {
    E::Wide::sigmoid(x, x.like(0.0))
}

/// `s / (1 + e^-(x + low))` for a rounding error `low` of x.
#[inline(always)]
pub(crate) fn corrected_sigmoid<E: Real>(s: E, x: E, low: E) -> E {
    let share = near_sigmoid(x, low);
    checked!(s * share, s, [], [share], (s.wide() * E::Wide::sigmoid(x, low)).narrow())
}

/// `1 / (1 + e^-(x + low))` for a rounding error `low` of x.
#[inline(always)]
pub(crate) fn near_sigmoid<E: Real>(x: E, low: E) -> E {
    let share = x.sigmoid();
    share.mul_add((share.like(1.0) - share) * low, share)
}

/// The derivative of the sigmoid, as a product that keeps its digits where the sigmoid is near 1.
#[inline(always)]
pub(crate) fn sigmoid_slope<E: Real>(s: E, x: E) -> E {
    let slope = x.logistic_density();
    checked!(s * slope, s, [], [slope], (s.wide() * wide_sigmoid(x) * wide_sigmoid(-x)).narrow())
}

/// The derivative of softplus is the sigmoid.
#[inline(always)]
pub(crate) fn softplus_slope<E: Real>(s: E, x: E) -> E {
    let slope = x.sigmoid();
    checked!(s * slope, s, [], [slope], (s.wide() * wide_sigmoid(x)).narrow())
}

/// `1 - tanh^2 x` is four times the derivative of the sigmoid at 2x.
#[inline(always)]
pub(crate) fn tanh_slope<E: Real>(s: E, x: E) -> E {
    let (twice, four) = (x + x, x.like(4.0));
    let density = twice.logistic_density();
    checked!(
        s * (four * density),
        s * four,
        [],
        [density],
        (s.wide() * four.wide() * wide_sigmoid(twice) * wide_sigmoid(-twice)).narrow()
    )
}

/// `s cosh x`, as `s e^x / 2 + s e^-x / 2`.
#[inline(always)]
pub(crate) fn sinh_slope<E: Real>(s: E, x: E) -> E {
    let slope = x.cosh();
    checked!(s * slope, s, [], [slope], half_exp(s, x) + half_exp(s, -x))
}

/// `s sinh x`, as a difference where it does not cancel.
#[inline(always)]
pub(crate) fn cosh_slope<E: Real>(s: E, x: E) -> E {
    let slope = x.sinh();
    checked!(s * slope, s, [], [slope], {
        let is_near = x.like(1.0) - x.abs();
        is_near.if_positive(s * slope, half_exp(s, x) - half_exp(s, -x))
    })
}

#[inline(always)]
fn half_exp<E: Real>(s: E, x: E) -> E {
    (s.wide() * x.like(0.5).wide() * E::Wide::exp(x, x.like(0.0))).narrow()
}

/// `-s pi sin(pi x)`. A sine that is a subnormal number has lost digits, so close to 0 it is `pi x`.
#[inline(always)]
pub(crate) fn cos_pi_slope<E: Real>(s: E, x: E) -> E {
    let (one, pi, sine) = (x.like(1.0), x.like(PI), x.sin_pi());
    checked!(-(s * (pi * sine)), s, [x], [], {
        let is_far = x.abs() - x.like(1e-9);
        let (sine, factor) = (is_far.if_positive(sine, x), is_far.if_positive(one, pi));
        -(s.wide() * pi.wide() * factor.wide() * sine.wide()).narrow()
    })
}

/// The derivative of the square root y.
#[inline(always)]
pub(crate) fn sqrt_slope<E: Real>(s: E, y: E) -> E {
    s / (y + y)
}

/// `sqrt(1 - x^2)`, with a square that is rounded with the difference and so keeps its digits near +-1.
#[inline(always)]
pub(crate) fn complement<E: Real>(x: E) -> E {
    let one = x.like(1.0);
    let square = (-x).mul_add(x, one);
    // At +-1 another zero: the root has an infinite slope there, and its argument the slope 0 in one factor.
    let is_inside = square.abs();
    is_inside.if_positive(is_inside.if_positive(square, one).sqrt(), one - x.abs())
}

/// `s / (1 + x^2)`, without the 1 and the square where the square could overflow.
#[inline(always)]
pub(crate) fn atan_slope<E: Real>(s: E, x: E) -> E {
    let (one, is_far) = (x.like(1.0), x.abs() - x.like(1e9));
    // Two divisions for both, since a choice of results is a branch, which prevents vectorisation.
    let (near, far) = (is_far.if_positive(one, x), is_far.if_positive(x, one));
    s / far / is_far.if_positive(far, one + near * near)
}

/// `s c / (a^2 + b^2)` for c = a or b; 0 at the origin and at infinity.
#[inline(always)]
pub(crate) fn turn<E: Real>(s: E, c: E, a: E, b: E) -> E {
    let (one, largest) = (a.like(1.0), a.abs().maximum(b.abs()));
    let length = unless_zero(largest);
    // The limit is 0 for an infinite vector. The other branch stays finite, or the next derivative would be NaN.
    let is_finite = one / length;
    let (a, b) = (is_finite.if_positive(a, one), is_finite.if_positive(b, one));
    let (c, scale) = (is_finite.if_positive(c, one), is_finite.if_positive(length, one));
    let square = unit_square(a / scale, b / scale);
    let full = checked!(
        s / scale / square * (c / scale),
        s,
        [s, c, largest],
        [],
        (s.wide() / scale.wide() / square.wide() * (c.wide() / scale.wide())).narrow()
    );
    is_finite.if_positive(full, s / length)
}

/// The derivative `a / y` of the length y of the vector (a, b) by a; 0 at the origin. A length that is a subnormal number
/// has lost digits.
#[inline(always)]
pub(crate) fn length_slope<E: Real>(s: E, a: E, b: E, y: E) -> E {
    let quick = s.along(a, b, unless_zero(y));
    checked!(quick, s, [s, a, y], [], {
        let scale = unless_zero(a.abs().maximum(b.abs()));
        let length = unit_square(a / scale, b / scale).sqrt();
        let full = (s.wide() * (a.wide() / scale.wide()) / length.wide()).narrow();
        // An infinite vector has no unit vector.
        (a.like(1.0) / scale).if_positive(full, quick)
    })
}

/// `a^2 + b^2` of a vector whose larger component is 1; 1 for the zero vector.
#[inline(always)]
fn unit_square<E: Real>(a: E, b: E) -> E {
    let square = a * a + b * b;
    square.if_positive(square, square + a.like(1.0))
}

/// `x`, which is not negative, and infinity for 0: a quotient by it is 0, and so are its derivatives.
#[inline(always)]
pub(crate) fn unless_zero<E: Real>(x: E) -> E {
    x.if_positive(x, x + x.like(f64::INFINITY))
}

/// `s a / b`.
#[inline(always)]
pub(crate) fn product_over<E: Real>(s: E, a: E, b: E) -> E {
    checked!(s * a / b, s, [s, a, b], [], (s.wide() * a.wide() / b.wide()).narrow())
}

/// `s a / b^2`.
#[inline(always)]
pub(crate) fn over_square<E: Real>(s: E, a: E, b: E) -> E {
    checked!(s / b * (a / b), s, [s, a, b], [], (s.wide() / b.wide() * (a.wide() / b.wide())).narrow())
}

/// `s floor(a / b)`, from the remainder y.
#[inline(always)]
pub(crate) fn multiple<E: Real>(s: E, a: E, b: E, y: E) -> E {
    checked!(s * ((a - y) / b).round(), s, [s, a, b], [], {
        let [difference, scale] = scaled_difference(a, y);
        let quotient = difference.wide() / (b.wide() * scale.wide());
        // A rounded quotient is constant also for further derivatives; a large one is too large for rounding.
        let rounded = quotient.narrow().round();
        let is_small = s.like(1e4) - rounded.abs();
        is_small.if_positive((s.wide() * rounded.wide()).narrow(), (s.wide() * quotient).narrow())
    })
}

/// `(a - b) c` without overflow, and c, which is 1/2; or 1 for small numbers, of which the halves are not exact.
#[inline(always)]
pub(crate) fn scaled_difference<E: Real>(a: E, b: E) -> [E; 2] {
    let (one, half, is_large) = (a.like(1.0), a.like(0.5), a.abs() + b.abs() - a.like(1.0));
    let scale = is_large.if_positive(half, one);
    [a * scale - b * scale, scale]
}

/// `s n x^(n - 1)` for a whole n that is not 0.
#[inline(always)]
pub(crate) fn powi_slope<E: Real>(s: E, x: E, n: i32) -> E {
    let factor = x.like(f64::from(n));
    match n {
        1 => s,
        2 => s * (x * factor),
        3 => checked!(s * x * x * factor, s, [s, x], [], (s.wide() * x.wide() * x.wide() * factor.wide()).narrow()),
        4 => checked!(
            s * x * x * x * factor,
            s,
            [s, x],
            [],
            (s.wide() * x.wide() * x.wide() * x.wide() * factor.wide()).narrow()
        ),
        -1 => -checked!(s / x / x, s, [s, x], [], (s.wide() / x.wide() / x.wide()).narrow()),
        _ => any_powi_slope(s, x, n),
    }
}

/// [`powi_slope`] in one form for all exponents.
#[inline(always)]
pub(crate) fn any_powi_slope<E: Real>(s: E, x: E, n: i32) -> E {
    let (one, factor) = (x.like(1.0), x.like(f64::from(n)));
    if n == i32::MIN {
        return base_slope(s, x, factor, x.powi(n));
    }
    let power = x.powi(n - 1);
    // At 0 the quick product is right.
    let size = x.abs();
    let factors = [size.if_positive(power, one), size.if_positive(factor * power, one)];
    checked!(
        s * (factor * power),
        s * factor,
        [],
        factors,
        (s.wide() * factor.wide() * E::Wide::powi(x, n - 1)).narrow()
    )
}

/// The factor of a power in a derivative. An infinite factor of a power that is 0 becomes 0: the power vanishes faster.
#[inline(always)]
pub(crate) fn factor_of<E: Real>(power: E, factor: E) -> E {
    let limit = power.abs().if_positive(factor, factor.like(0.0));
    (factor.abs() - factor.like(1e30)).if_positive(limit, factor)
}

/// The derivative of y = a^b by a. An exponent that may be infinite has to be a [`factor_of`] y.
#[inline(always)]
pub(crate) fn base_slope<E: Real>(s: E, a: E, b: E, y: E) -> E {
    let (zero, one) = (a.like(0.0), a.like(1.0));
    // Positive unless a is 0, infinite or NaN.
    let is_ordinary = a.abs() * (one / a.abs());
    let base = is_ordinary.if_positive(a, one);
    // Where b - 1 is exact, its power; elsewhere its rounding error would count as many times as the logarithm is large.
    // Of two zeros it is infinite and not chosen; the next derivative would be NaN.
    let less = (a.abs() + b.abs()).if_positive(a, one).pow(b - one);
    let is_exact = (b - one) * (b.like(1e6) - b);
    // The branch for ordinary bases stays finite at others, or the next derivative would be NaN.
    let of_ordinary = |x: E| is_ordinary.if_positive(x, one);
    let inexact = is_exact.if_positive(one, of_ordinary(y));
    let power = of_ordinary(is_exact.if_positive(less, inexact / base));
    // A zero base has its limit, and a subnormal y has lost digits.
    let factors = [power, of_ordinary(b * power), inexact];
    // Several factors may bring a number back into range that was lost, whatever s is.
    let full = checked!(s * (b * power), one + one, [], factors, {
        let y = is_ordinary.if_positive(y, one);
        (s.wide() * b.wide() * E::Wide::pow(base, b, y) / base.wide()).narrow()
    });
    // At an infinite or a zero base; 0 where both are 0, and NaN where one is.
    let limit = (a.abs() + b.abs()).if_positive(s * (b * less), (a + b) * zero);
    is_ordinary.if_positive(full, limit)
}

/// The derivative of y = a^b by b.
#[inline(always)]
pub(crate) fn exponent_slope<E: Real>(s: E, a: E, b: E, y: E) -> E {
    let (zero, one, size) = (a.like(0.0), a.like(1.0), a.abs());
    // Logarithms that are finite where they are not chosen, or the next derivative would be NaN.
    let ln = factor_of(y, size.if_positive(a, one).ln());
    let factors = [size.if_positive(y, one), size.if_positive(y * ln, one)];
    let full = checked!(s * (y * ln), one + one, [], factors, (s.wide() * E::Wide::pow(a, b, y) * ln.wide()).narrow());
    let ln_of_size = size.if_positive(one, (-b).if_positive(size, one)).ln();
    let at_zero = s * (-b).if_positive(y * ln_of_size, y * zero + a * zero);
    size.if_positive(full, at_zero)
}
