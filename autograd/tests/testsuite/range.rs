//! Reductions, norms and normalisations of numbers of every binade: against an exact oracle, under exact scaling, and in
//! their second derivatives.

use proptest::prelude::*;
use raygrad_autograd::derivatives::jvp;
use raygrad_autograd::{Axes, Pool2dConfig, Scalar, Segments, Tape, Tensor, Var};
use std::ops::{Add, Mul, Sub};

/// A sum of two f64 that do not overlap: about 106 bits.
#[derive(Debug, Clone, Copy)]
struct Double(f64, f64);

impl Double {
    fn of_sum(a: f64, b: f64) -> Self {
        let sum = a + b;
        let of_b = sum - a;
        Double(sum, (a - (sum - of_b)) + (b - of_b))
    }
    fn over(self, other: f64) -> Self {
        let first = self.0 / other;
        let rest = self - Double(first, 0.0) * Double(other, 0.0);
        Double::of_sum(first, (rest.0 + rest.1) / other)
    }
    fn sqrt(self) -> Self {
        if self.0 == 0.0 {
            return self;
        }
        let root = self.0.sqrt();
        let rest = self - Double(root, 0.0) * Double(root, 0.0);
        Double::of_sum(root, 0.5 * (rest.0 + rest.1) / root)
    }
}

impl Add for Double {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        let Double(sum, rest) = Double::of_sum(self.0, other.0);
        Double::of_sum(sum, rest + (self.1 + other.1))
    }
}

impl Sub for Double {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        self + Double(-other.0, -other.1)
    }
}

impl Mul for Double {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        let product = self.0 * other.0;
        let rest = f64::mul_add(self.0, other.0, -product);
        Double::of_sum(product, rest + (self.0 * other.1 + self.1 * other.0))
    }
}

fn sum(x: impl IntoIterator<Item = f64>) -> Double {
    x.into_iter().fold(Double(0.0, 0.0), |sum, x| sum + Double(x, 0.0))
}

fn deviations(x: &[f64]) -> Vec<Double> {
    let mean = sum(x.iter().copied()).over(x.len() as f64);
    x.iter().map(|&x| Double(x, 0.0) - mean).collect()
}

fn norm(x: impl IntoIterator<Item = Double>) -> Double {
    x.into_iter().fold(Double(0.0, 0.0), |sum, x| sum + x * x).sqrt()
}

/// `2^exponent` in two factors, since it may be out of range where a product with it is not.
fn lifted(x: f64, exponent: i32) -> f64 {
    x * 2.0_f64.powi(exponent / 2) * 2.0_f64.powi(exponent - exponent / 2)
}

/// The exponents of the normal numbers.
fn exponents<T: Scalar>() -> [i32; 2] {
    if T::NAME == "f32" { [-126, 127] } else { [-1022, 1023] }
}

/// Numbers of which the largest is in 1..2: rows of one size, of some sizes, of all, and with zeros.
fn row(most: usize) -> impl Strategy<Value = Vec<f64>> {
    (1..most).prop_flat_map(row_of)
}

/// The same, of `n` numbers.
fn row_of(n: usize) -> impl Strategy<Value = Vec<f64>> {
    prop_oneof![Just(0_i32), Just(3), Just(30), Just(2200)].prop_flat_map(move |spread| {
        let one = (any::<u64>(), 0..=spread, 0..8_u8).prop_map(move |(bits, below, kind)| {
            let significand = f64::from_bits(bits >> 12 | 1023 << 52);
            match kind {
                0 if spread > 0 => 0.0,
                1 => 1.0,
                kind => lifted(significand, -below) * if kind % 2 == 0 { 1.0 } else { -1.0 },
            }
        });
        prop::collection::vec(one, n).prop_map(|row| {
            let largest = row.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
            let power = if largest == 0.0 { 0 } else { largest.log2().floor() as i32 };
            row.iter().map(|&x| lifted(x, -power)).collect()
        })
    })
}

/// The row at a place of the type's range, from its lower end at 0 to its upper end at 1, rounded to the type.
fn placed<T: Scalar>(row: &[f64], place: f64) -> (Vec<f64>, i32) {
    let [low, high] = exponents::<T>();
    // Down to rows of subnormal numbers.
    let exponent = low - 20 + (place * f64::from(high + 21 - low)) as i32;
    // In units of the place, in f64.
    let round = |x: &f64| lifted(T::from_f64(lifted(*x, exponent)).to_f64(), -exponent);
    (row.iter().map(round).collect(), exponent)
}

fn tensor<T: Scalar>(row: &[f64], exponent: i32) -> Tensor<T> {
    Tensor::from_fn(&[row.len()], |i| T::from_f64(lifted(row[i], exponent)))
}

/// Fails if `got` is further than `units` units in the last place from `exact 2^exponent`, or than one subnormal step.
fn check<T: Scalar>(what: &str, got: T, exact: Double, exponent: i32, units: f64) -> Result<(), TestCaseError> {
    let [low, high] = exponents::<T>();
    // The oracle itself has no digits below.
    if exact.0 != 0.0 && exact.0.abs() < 1e-280 {
        return Ok(());
    }
    let size = exact.0.abs().log2() + f64::from(exponent);
    let got = got.to_f64();
    if exact.0 == 0.0 || size < f64::from(low) + 1.0 {
        // Below the normal numbers: as many subnormal steps.
        let step = T::EPSILON * 2.0_f64.powi(low);
        let expected = lifted(exact.0, exponent);
        prop_assert!((got - expected).abs() <= units * step, "{what} in {}: {got:e} for {expected:e}", T::NAME);
    } else if size > f64::from(high) + 1.0 {
        prop_assert!(got.is_infinite() && got.signum() == exact.0.signum(), "{what} in {}: {got:e}", T::NAME);
    } else if got.is_finite() || size < f64::from(high) + 0.999 {
        let error = (Double(lifted(got, -exponent), 0.0) - exact).0.abs() / exact.0.abs() / T::EPSILON;
        prop_assert!(
            error <= units,
            "{what} in {}: {got:e} for {:e} 2^{exponent}, {error} units off",
            T::NAME,
            exact.0
        );
    }
    Ok(())
}

/// Fails if `got` is further from `exact 2^exponent` than `units T::EPSILON 2^exponent` and some subnormal steps.
fn within<T: Scalar>(what: &str, got: T, exact: Double, exponent: i32, units: f64) -> Result<(), TestCaseError> {
    let [low, high] = exponents::<T>();
    if exact.0.abs().log2() + f64::from(exponent) >= f64::from(high) {
        return Ok(());
    }
    let error = (Double(lifted(got.to_f64(), -exponent), 0.0) - exact).0.abs();
    let bound = T::EPSILON * units + lifted(4.0 * T::EPSILON, low - exponent);
    prop_assert!(error <= bound, "{what} in {}: {:e} for {:e} 2^{exponent}", T::NAME, got.to_f64(), exact.0);
    Ok(())
}

/// The row as the last axis, as the first one, transposed, every second element, reversed, and broadcast: each along its
/// axis.
fn views<'t, T: Scalar>(x: &Var<'t, T>) -> Vec<(&'static str, Var<'t, T>, isize)> {
    let n = x.shape()[0];
    let column = x.reshape(&[n, 1]).broadcast_to(&[n, 3]);
    let twice = Var::stack(&[x, x], 1);
    let copied = x.tape().constant(Tensor::zeros(&[n, 3])) + &column;
    vec![
        ("the row", x.clone(), 0),
        ("rows", x.reshape(&[1, n]).broadcast_to(&[2, n]) * 1.0, 1),
        ("broadcast columns", column.clone(), 0),
        ("columns", copied.clone(), 0),
        ("transposed columns", copied.t(), 1),
        ("every second element", twice.slice_axis(1, ..1).squeeze(-1), 0),
        ("reversed columns", copied.flip(0), 0),
    ]
}

/// Value and gradient of `std`, `norm`, `var`, `mean` and `normalize` of a row, for an incoming gradient of any size.
fn reductions<T: Scalar>(row: &[f64], place: f64, size: f64) -> Result<(), TestCaseError> {
    let (row, exponent) = placed::<T>(row, place);
    let [low, high] = exponents::<T>();
    let power = low + (size * f64::from(high - low)) as i32;
    let g = Double(-1.5, 0.0);
    let n = row.len() as f64;
    let tape = Tape::<T>::new();
    let x = tape.leaf(tensor(&row, exponent));
    let (apart, mean) = (deviations(&row), sum(row.iter().copied()).over(n));
    let (length, away) = (norm(row.iter().map(|&x| Double(x, 0.0))), norm(apart.iter().copied()));
    let deviation = (away * away).over(n).sqrt();
    let magnitudes: f64 = row.iter().map(|x| x.abs()).sum();
    // Digits of deviations that the mean's own rounding leaves.
    let largest = row.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
    for (name, x, axis) in views(&x) {
        let what = |of: &str| format!("{of} of {name} of {n}");
        for &y in x.norm_over(axis).value().as_slice() {
            check(&what("norm"), y, length, exponent, 4.0)?;
        }
        for &y in x.std_over(axis, 0).value().as_slice() {
            check(&what("std"), y, deviation, exponent, 8.0)?;
        }
        for &y in x.var_over(axis, 0).value().as_slice() {
            check(&what("var"), y, deviation * deviation, 2 * exponent, 16.0)?;
        }
        // In units of the elements' mean size, in which a mean may vanish.
        let scale = (magnitudes / n).max(1e-300);
        for &y in x.mean_over(axis).value().as_slice() {
            let [low, _] = exponents::<T>();
            let bound = 16.0 * (T::EPSILON * scale).max(lifted(T::EPSILON, low - exponent));
            let error = (Double(lifted(y.to_f64(), -exponent), 0.0) - mean).0.abs();
            prop_assert!(error <= bound, "{}: {y:e} for {mean:?} 2^{exponent}", what("mean"), y = y.to_f64());
        }
        let gradient = |y: Var<'_, T>| {
            let g = x.tape().constant(Tensor::full(y.shape(), T::from_f64(lifted(g.0, power))));
            y.vjp(&g, &[&x]).remove(0).value().to_vec()
        };
        let along = |i: usize| if x.shape().len() == 1 || axis == 1 { i % row.len() } else { i / x.shape()[1] };
        let flipped = name.starts_with("reversed");
        let index = |i: usize| if flipped { row.len() - 1 - along(i) } else { along(i) };
        let is_in_range = |size: Double| T::from_f64(lifted(size.0, exponent)).is_finite();
        if length.0 > 0.0 && is_in_range(length) {
            for (i, dx) in gradient(x.norm_over(axis)).into_iter().enumerate() {
                let x = row[index(i)];
                if x != 0.0 && x.abs() < 1e-280 {
                    // The quotient of the oracle has no digits.
                    continue;
                }
                let exact = g * Double(x, 0.0).over(length.0);
                check(&what("gradient of norm"), dx, exact, power, 8.0)?;
            }
        }
        if deviation.0 > 16.0 * T::EPSILON * largest && is_in_range(deviation) {
            for (i, dx) in gradient(x.std_over(axis, 0)).into_iter().enumerate() {
                let exact = g * apart[index(i)].over(deviation.0).over(n);
                // Deviations are exact to the digits of the mean.
                let relative = 16.0 * (1.0 + largest / deviation.0) / n;
                within(&what("gradient of std"), dx, exact, power, relative)?;
            }
        }
        for (i, dx) in gradient(x.var_over(axis, 0)).into_iter().enumerate() {
            let exact = g * apart[index(i)].over(0.5 * n);
            within(&what("gradient of var"), dx, exact, power + exponent, 32.0 * largest / n)?;
        }
    }
    for (i, &y) in x.normalize().value().as_slice().iter().enumerate() {
        let exact = if length.0 == 0.0 { Double(0.0, 0.0) } else { Double(row[i], 0.0).over(length.0) };
        check("normalize", y, exact, 0, 6.0)?;
    }
    Ok(())
}

/// Layer normalisation, with an epsilon between 2^-40 and 2^40 variances, or 0.
fn layer_norms<T: Scalar>(row: &[f64], place: f64, epsilon: Option<i32>) -> Result<(), TestCaseError> {
    let (row, exponent) = placed::<T>(row, place);
    let n = row.len();
    let (apart, largest) = (deviations(&row), row.iter().fold(0.0, |most: f64, x| most.max(x.abs())));
    let away = norm(apart.iter().copied());
    let variance = (away * away).over(n as f64);
    // An epsilon is an f64, and may be out of the range of f32.
    let eps = epsilon.map_or(0.0, |power| lifted(1.0, 2 * exponent + power));
    let in_units = epsilon.filter(|_| eps.is_normal()).map_or(0.0, |power| 2.0_f64.powi(power));
    if variance.0 <= (16.0 * T::EPSILON * largest).powi(2) || (eps == 0.0) != (in_units == 0.0) {
        return Ok(());
    }
    let scale = (variance + Double(in_units, 0.0)).sqrt();
    let tape = Tape::<T>::new();
    let x = tape.leaf(tensor(&row, exponent).reshape(&[1, n]));
    let (gain, bias) = (tape.constant(Tensor::ones(&[n])), tape.constant(Tensor::zeros(&[n])));
    let y = x.layer_norm(&gain, &bias, eps);
    let relative = T::EPSILON * (1.0 + largest / away.0);
    for (&y, exact) in y.value().as_slice().iter().zip(&apart) {
        let (exact, bound) = (exact.over(scale.0).0, 64.0 * relative * away.0 / scale.0);
        prop_assert!((y.to_f64() - exact).abs() <= bound, "layer_norm at 2^{exponent}: {:e} for {exact:e}", y.to_f64());
    }
    // Weighted by 1 for the first element: (1 - 1/n - u^2 / n) / scale.
    let pick = |i: usize| if i == 0 { T::ONE } else { T::ZERO };
    let weighted = (y * tape.constant(Tensor::from_fn(&[1, n], pick))).sum();
    let first = (1.0 - (1.0 + (apart[0].0 / scale.0).powi(2)) / n as f64) / scale.0;
    let [_, high] = exponents::<T>();
    if (first.abs().log2() - f64::from(exponent)).abs() < f64::from(high) && first.abs() > 0.1 / scale.0 {
        for grad in [weighted.grad(&[&x]).remove(0), weighted.grad_graph(&[&x]).remove(0).into_value()] {
            let error = (lifted(grad.as_slice()[0].to_f64(), exponent) / first - 1.0).abs();
            prop_assert!(error <= 256.0 * relative, "gradient of layer_norm at 2^{exponent}: {error:e} off");
        }
    }
    Ok(())
}

/// Each line of a matrix has the value and the gradient, to the bit, that it has among copies of itself.
fn neighbours<T: Scalar>(lines: &[(Vec<f64>, f64)]) -> Result<(), TestCaseError> {
    type Along<T> = for<'t> fn(&Var<'t, T>, isize) -> Var<'t, T>;
    let functions: [(&str, Along<T>); 10] = [
        ("norm", |x, axis| x.norm_over(Axes::from(axis).keepdims())),
        ("std", |x, axis| x.std_over(Axes::from(axis).keepdims(), 0)),
        ("var", |x, axis| x.var_over(Axes::from(axis).keepdims(), 0)),
        ("mean", |x, axis| x.mean_over(Axes::from(axis).keepdims())),
        ("logsumexp", |x, axis| x.logsumexp_over(Axes::from(axis).keepdims())),
        ("prod", |x, axis| x.prod_over(Axes::from(axis).keepdims())),
        ("softmax", |x, axis| x.softmax(axis)),
        ("log_softmax", |x, axis| x.log_softmax(axis)),
        ("cumsum", |x, axis| x.cumsum(axis)),
        ("cumprod", |x, axis| x.cumprod(axis)),
    ];
    let lines: Vec<_> = lines.iter().map(|(line, place)| placed::<T>(line, *place)).collect();
    let (k, n) = (lines.len(), lines[0].0.len());
    for axis in [0, 1] {
        let matrix = |line: &dyn Fn(usize) -> usize| {
            let at = |i: usize| if axis == 0 { (i % k, i / k) } else { (i / n, i % n) };
            let value = |i: usize| {
                let (row, exponent) = &lines[line(at(i).0)];
                T::from_f64(lifted(row[at(i).1], *exponent))
            };
            Tensor::from_fn(&if axis == 0 { [n, k] } else { [k, n] }, value)
        };
        for (name, f) in functions {
            // Value and gradient of the line `which`.
            let line = |x: Tensor<T>, which: isize| {
                let tape = Tape::<T>::new();
                let x = tape.leaf(x);
                let y = f(&x, axis);
                let dx = tape.no_grad(|| y.vjp(&tape.constant(Tensor::ones(y.shape())), &[&x])).remove(0);
                [y, dx].map(|x| x.slice_axis(1 - axis, which..=which).value().to_vec())
            };
            for which in 0..k {
                let (among, alone) = (line(matrix(&|i| i), which as isize), line(matrix(&|_| which), which as isize));
                let same = |(a, b): (&T, &T)| a == b || a.to_f64().is_nan() && b.to_f64().is_nan();
                let all = among.iter().flatten().zip(alone.iter().flatten()).all(same);
                prop_assert!(all, "{name} of line {which} of axis {axis} in {}: {among:?}, {alone:?}", T::NAME);
            }
        }
    }
    Ok(())
}

type Function<T> = for<'t> fn(&Var<'t, T>) -> Var<'t, T>;

/// Functions, with the power of a factor of their argument that their value has.
fn scaled<T: Scalar>() -> [(&'static str, Function<T>, i32); 10] {
    [
        ("sum", |x| x.sum_over(-1), 1),
        ("mean", |x| x.mean_over(-1), 1),
        ("cumsum", |x| x.cumsum(-1), 1),
        ("norm_l1", |x| x.norm_l1_over(-1), 1),
        ("norm", |x| x.norm_over(-1), 1),
        ("std", |x| x.std_over(-1, 0), 1),
        (
            "std along the first axis",
            |x| x.reshape(&[x.shape()[0], 1]).broadcast_to(&[x.shape()[0], 2]).std_over(0, 0),
            1,
        ),
        ("var", |x| x.var_over(-1, 0), 2),
        ("normalize", |x| x.normalize(), 0),
        (
            "layer_norm",
            |x| {
                let like = |value| x.tape().constant(Tensor::full(x.shape(), value));
                x.layer_norm(&like(T::ONE), &like(T::ZERO), 0.0)
            },
            0,
        ),
    ]
}

/// Value, gradient, recorded gradient, and the gradient of a weighted sum of that, with the power of each.
fn of_all_orders<T: Scalar>(f: Function<T>, power: i32, x: &Tensor<T>) -> [(Vec<T>, i32); 4] {
    let tape = Tape::<T>::new();
    let weights = |n: usize, phase: f64| {
        tape.constant(Tensor::from_fn(&[n], |i| T::from_f64((i as f64 * 0.7 + phase).sin() + 0.1)))
    };
    let x = tape.leaf(x.clone());
    let y = f(&x);
    let whole = y.reshape(&[y.value().len()]).dot(weights(y.value().len(), 0.3));
    let plain = whole.grad(&[&x]).remove(0);
    let recorded = whole.grad_graph(&[&x]).remove(0);
    let second = recorded.dot(weights(x.value().len(), 1.1)).tracked().grad(&[&x]).remove(0);
    [
        (y.value().to_vec(), power),
        (plain.to_vec(), power - 1),
        (recorded.value().to_vec(), power - 1),
        (second.to_vec(), power - 2),
    ]
}

/// Numbers times a power of two give the results times its powers, bit for bit.
fn scaling<T: Scalar>(row: &[f64], place: f64) -> Result<(), TestCaseError> {
    let [low, high] = exponents::<T>();
    // Digits of elements stay in range, down to their last bit.
    let exponent = (f64::from(low + 100) + place * f64::from(high - low - 110)) as i32;
    let row: Vec<f64> = row.iter().map(|x| T::from_f64(*x).to_f64()).collect();
    let [near, far] = [0, exponent].map(|exponent| tensor::<T>(&row, exponent));
    for (name, f, power) in scaled::<T>() {
        let orders = of_all_orders(f, power, &near).into_iter().zip(of_all_orders(f, power, &far));
        for (order, ((near, power), (far, _))) in orders.enumerate() {
            for (&near, &far) in near.iter().zip(&far) {
                let expected = T::from_f64(lifted(near.to_f64(), power * exponent)).to_f64();
                let size = expected.abs();
                // The normalised form of equal numbers is NaN without an epsilon.
                prop_assert_eq!(
                    near.to_f64().is_nan(),
                    far.to_f64().is_nan(),
                    "{}, order {}, of {:?}",
                    name,
                    order,
                    row
                );
                prop_assert!(!near.to_f64().is_nan() || name == "layer_norm", "{name}, order {order}, of {row:?}");
                // Where the result is normal, with a margin for the terms of derivatives.
                let margin = if order == 0 { 1.0 } else { 2.0_f64.powi(30) };
                if near.to_f64() == 0.0 || (lifted(margin, low)..lifted(1.0 / margin, high)).contains(&size) {
                    prop_assert_eq!(
                        far.to_f64(),
                        expected,
                        "{} in {} at 2^{}, order {}, of {:?}",
                        name,
                        T::NAME,
                        exponent,
                        order,
                        row
                    );
                }
            }
        }
    }
    Ok(())
}

/// Sums of every kind stay within the pairwise bound of the exact sum.
fn sums<T: Scalar>(row: &[f64], repeats: usize, place: f64) -> Result<(), TestCaseError> {
    let (row, exponent) = placed::<T>(row, 0.9 * place);
    let row: Vec<f64> = row.iter().cycle().take(row.len() * repeats).copied().collect();
    let n = row.len();
    let exact = sum(row.iter().copied());
    let [low, _] = exponents::<T>();
    let rounds = 16.0 + (n as f64 / 512.0).log2().max(0.0);
    let step = lifted(T::EPSILON, low - exponent);
    let bound = rounds * (T::EPSILON * row.iter().map(|x| x.abs()).sum::<f64>()).max(step);
    let tape = Tape::<T>::new();
    let x = tape.constant(tensor(&row, exponent));
    let within = |what: &str, got: T, bound: f64| {
        let error = (Double(lifted(got.to_f64(), -exponent), 0.0) - exact).0.abs();
        prop_assert!(error <= bound, "{what} of {n} in {}: {error:e} off, bound {bound:e}", T::NAME);
        Ok(())
    };
    for (name, x, axis) in views(&x) {
        for &y in x.sum_over(axis).value().as_slice() {
            within(&format!("sum of {name}"), y, bound)?;
        }
    }
    within("dot", x.dot(Tensor::ones(&[n])).item(), bound)?;
    within("cumsum", x.cumsum(0).value().as_slice()[n - 1], bound)?;
    // A window that is the image: its mean, and the gradients of as many windows in one pixel.
    let image = x.reshape(&[1, 1, 1, n]);
    let mean = image.avg_pool2d(&Pool2dConfig::new([1, n])).item();
    // A mean is rounded, also to a subnormal number.
    let of_mean = bound + T::EPSILON * exact.0.abs() + n as f64 * step;
    within("avg_pool2d", T::from_f64(mean.to_f64() * n as f64), of_mean)?;
    if n < 300 {
        let pixels = tape.leaf(Tensor::from_fn(&[1, 1, 1, 2 * n - 1], |i| if i == n - 1 { T::ONE } else { T::ZERO }));
        let config = Pool2dConfig { stride: [1, 1], ..Pool2dConfig::new([1, n]) };
        let max = (pixels.max_pool2d(&config) * &image).sum().grad(&[&pixels]).remove(0);
        within("gradient of max_pool2d", max.as_slice()[n - 1], bound)?;
        let average = (pixels.avg_pool2d(&config) * &image).sum().grad(&[&pixels]).remove(0);
        let mean = average.as_slice()[n - 1].to_f64() * n as f64;
        within("gradient of avg_pool2d", T::from_f64(mean), of_mean)?;
    }
    Ok(())
}

/// Gradients that bring back the probabilities that underflow: e^x alone is out of range, its product with g is not. The
/// logits have an offset.
fn lifted_probabilities<T: Scalar>(row: &[f64], lift: f64, offset: f64, class: usize) -> Result<(), TestCaseError> {
    let [low, high] = exponents::<T>();
    let reach = -f64::from(low) * std::f64::consts::LN_2;
    // Logits down to below the range of e^x.
    let logits = [0.0].into_iter().chain(row.iter().map(|x| 1.3 * x.abs().fract() * -reach));
    let logits: Vec<f64> = logits.map(|logit| T::from_f64(logit + offset).to_f64()).collect();
    let g = (lift.abs() * 2.0 - 1.0) * f64::from(high) * std::f64::consts::LN_2;
    let g = T::from_f64(g.exp().copysign(lift)).to_f64();
    let (n, class) = (logits.len(), class % logits.len());
    // The first one is the largest. A difference may have more digits than f64.
    let apart: Vec<_> = logits.iter().map(|&x| Double(x, 0.0) - Double(logits[0], 0.0)).collect();
    let total = sum(apart.iter().map(|x| x.0.exp() * (1.0 + x.1))).0;
    // In two factors: neither underflows in f64.
    let exact = |i: usize| (0.5 * apart[i].0).exp() * g * (0.5 * apart[i].0).exp() * (1.0 + apart[i].1) / total;
    let others: f64 = (0..n).filter(|&i| i != class).map(exact).sum();
    let tape = Tape::<T>::new();
    let x = tape.leaf(Tensor::from_fn(&[1, n], |i| T::from_f64(logits[i])));
    let first = |value: f64| tape.constant(Tensor::from_fn(&[1, n], |i| T::from_f64(if i == 0 { value } else { 0.0 })));
    let results = [
        ("logsumexp", (x.logsumexp_over(-1) * g).sum(), 1.0),
        ("cross_entropy", (x.cross_entropy([class as u32]) * g).sum(), 1.0),
        ("log_softmax", (x.log_softmax(-1) * first(g)).sum(), -1.0),
    ];
    for (name, y, sign) in results {
        for grad in [y.grad(&[&x]).remove(0), y.grad_graph(&[&x]).remove(0).into_value()] {
            for (i, got) in grad.as_slice().iter().enumerate() {
                let is_class = name == "cross_entropy" && i == class;
                if name == "log_softmax" && i == 0 {
                    // 1 minus a probability.
                    continue;
                }
                let expected = if is_class { -others } else { sign * exact(i) };
                check(&format!("gradient {i} of {name} at {}", logits[i]), *got, Double(expected, 0.0), 0, 16.0)?;
            }
        }
    }
    Ok(())
}

/// Means of windows, and gradients of such means, are in range wherever they can be represented.
fn pooled_means<T: Scalar>(row: &[f64], place: f64, kernel: usize, stride: usize) -> Result<(), TestCaseError> {
    let (row, exponent) = placed::<T>(row, place);
    let (n, kernel) = (row.len(), 1 + kernel % row.len());
    let starts: Vec<usize> = (0..=n - kernel).step_by(stride).collect();
    let size = kernel as f64;
    let near = |what: &str, got: T, of: &[f64]| {
        let exact = sum(of.iter().copied()).over(size);
        let magnitudes = of.iter().map(|x| x.abs()).sum::<f64>() / size;
        within(what, got, exact, exponent, 16.0 * magnitudes)
    };
    let tape = Tape::<T>::new();
    let config = Pool2dConfig { stride: [1, stride], ..Pool2dConfig::new([1, kernel]) };
    let image = tape.leaf(tensor::<T>(&row, exponent).reshape(&[1, 1, 1, n]));
    let means = image.avg_pool2d(&config);
    for (&mean, &start) in means.value().as_slice().iter().zip(&starts) {
        near("avg_pool2d", mean, &row[start..start + kernel])?;
    }
    let g = tape.leaf(tensor::<T>(&row[..starts.len()], exponent).reshape(means.shape()));
    let plain = tape.no_grad(|| means.vjp(&g, &[&image])).remove(0);
    for grads in [plain, means.vjp(&g, &[&image]).remove(0)] {
        for (i, &grad) in grads.value().as_slice().iter().enumerate() {
            let met = |k: &usize| (starts[*k]..starts[*k] + kernel).contains(&i);
            let of: Vec<f64> = (0..starts.len()).filter(met).map(|k| row[k]).collect();
            near("gradient of avg_pool2d", grad, &of)?;
        }
    }
    Ok(())
}

/// Cumulative sums along an axis and in segments, and their gradients, which run the other way, are rounded once. Before
/// that, sums of f32 have the precision of f64, and sums of f64 its square.
fn cumulative_sums<T: Scalar>(row: &[f64], repeats: usize, place: f64) -> Result<(), TestCaseError> {
    let (row, exponent) = placed::<T>(row, 0.9 * place);
    let row: Vec<f64> = row.iter().cycle().take(row.len() * repeats).copied().collect();
    let n = row.len();
    let backwards: Vec<f64> = row.iter().rev().copied().collect();
    let precision = if T::NAME == "f32" { f64::EPSILON } else { f64::EPSILON * f64::EPSILON };
    let tape = Tape::<T>::new();
    let x = tape.leaf(tensor::<T>(&row, exponent));
    let segments = Segments::uniform(1, n);
    let check = |what: &str, got: &[T], row: &[f64], skip: usize| -> Result<(), TestCaseError> {
        let (mut exact, mut magnitudes) = (Double(0.0, 0.0), 0.0);
        for (k, &got) in got.iter().enumerate() {
            if k >= skip {
                exact = exact + Double(row[k - skip], 0.0);
                magnitudes += row[k - skip].abs();
            }
            let units = 0.501 * exact.0.abs() + n as f64 * precision / T::EPSILON * magnitudes;
            within(what, got, exact, exponent, units)?;
        }
        Ok(())
    };
    for (what, y, skip) in [
        ("cumsum", x.cumsum(0), 0),
        ("segment_cumsum", x.segment_cumsum(&segments, false), 0),
        ("exclusive segment_cumsum", x.segment_cumsum(&segments, true), 1),
    ] {
        check(what, y.value().as_slice(), &row, skip)?;
        let plain = tape.no_grad(|| y.vjp(&x, &[&x])).remove(0);
        for grad in [plain, y.vjp(&x, &[&x]).remove(0)] {
            let grad: Vec<T> = grad.value().as_slice().iter().rev().copied().collect();
            check(&format!("gradient of {what}"), &grad, &backwards, skip)?;
        }
    }
    Ok(())
}

/// Cumulative products and their gradients where others are out of range; exact, since the elements are powers of two
/// but for one, and one product alone has a gradient.
fn products<T: Scalar>(powers: &[i32], odd: usize, at: usize) -> Result<(), TestCaseError> {
    let (n, [low, high]) = (powers.len(), exponents::<T>());
    let (odd, at) = (odd % n, at % n);
    let significand = |i: usize| if i == odd { 1.5 } else { 1.0 };
    let power = |i: usize| powers[i] % high;
    let tape = Tape::<T>::new();
    let x = tape.leaf(Tensor::from_fn(&[n], |i| T::from_f64(lifted(significand(i), power(i)))));
    let y = x.cumprod(0);
    let expect = |what: &str, got: T, significand: f64, power: i32| {
        if power > low && power < high {
            let expected = T::from_f64(lifted(significand, power));
            prop_assert!(got == expected, "{what}: {got} for {expected}, of {powers:?}");
        }
        Ok(())
    };
    for i in 0..n {
        let significand: f64 = (0..=i).map(significand).product();
        expect("cumprod", y.value().as_slice()[i], significand, (0..=i).map(power).sum())?;
    }
    let picked = y.slice_axis(0, at..=at).sum();
    for grad in [picked.grad(&[&x]).remove(0), picked.grad_graph(&[&x]).remove(0).into_value()] {
        for i in 0..n {
            let others = (0..=at).filter(|&j| j != i);
            let significand: f64 = if i > at { 0.0 } else { others.clone().map(significand).product() };
            expect("gradient of cumprod", grad.as_slice()[i], significand, others.map(power).sum())?;
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1000, ..ProptestConfig::default() })]

    #[test]
    fn reductions_of_every_binade_agree_with_an_exact_oracle(
        row in row(40), place in 0.0..1.0, size in 0.0..1.0
    ) {
        reductions::<f32>(&row, place, size)?;
        reductions::<f64>(&row, place, size)?;
    }

    #[test]
    fn no_line_depends_on_its_neighbours(
        lines in (1_usize..40).prop_flat_map(|n| prop::collection::vec((row_of(n), 0.0..1.0), 2..5))
    ) {
        neighbours::<f32>(&lines)?;
        neighbours::<f64>(&lines)?;
    }

    #[test]
    fn layer_norm_of_every_binade_agrees_with_an_exact_oracle(
        row in row(40), place in 0.0..1.0, epsilon in prop::option::of(-40..40)
    ) {
        layer_norms::<f32>(&row, place, epsilon)?;
        layer_norms::<f64>(&row, place, epsilon)?;
    }

    #[test]
    fn scaling_by_a_power_of_two_is_exact(
        row in prop::collection::vec((1.0..2.0, -5..5, any::<bool>()), 1..40), place in 0.0..1.0
    ) {
        let row: Vec<f64> =
            row.into_iter().map(|(x, power, minus)| lifted(x, power) * if minus { -1.0 } else { 1.0 }).collect();
        scaling::<f32>(&row, place)?;
        scaling::<f64>(&row, place)?;
    }

    #[test]
    fn sums_are_within_the_pairwise_bound(row in row(80), repeats in 1_usize..60, place in 0.0..1.0) {
        sums::<f32>(&row, repeats, place)?;
        sums::<f64>(&row, repeats, place)?;
    }

    #[test]
    fn pooled_means_of_every_binade(row in row(40), place in 0.0..1.0, kernel: usize, stride in 1_usize..4) {
        pooled_means::<f32>(&row, place, kernel, stride)?;
        pooled_means::<f64>(&row, place, kernel, stride)?;
    }

    #[test]
    fn cumulative_sums_are_rounded_once(row in row(40), repeats in 1_usize..60, place in 0.0..1.0) {
        cumulative_sums::<f32>(&row, repeats, place)?;
        cumulative_sums::<f64>(&row, repeats, place)?;
    }

    #[test]
    fn large_gradients_lift_probabilities_that_underflow(
        row in prop::collection::vec(0.0..1.0, 1..40), lift in -1.0..1.0, offset in -4_000_000..4_000_000, class: usize
    ) {
        lifted_probabilities::<f32>(&row, lift, f64::from(offset) / 7.0, class)?;
        lifted_probabilities::<f64>(&row, lift, f64::from(offset) * 1e3 / 7.0, class)?;
    }

    #[test]
    fn cumulative_products_come_back_into_range(
        powers in prop::collection::vec(-1000..1000, 1..20), odd: usize, at: usize
    ) {
        products::<f32>(&powers, odd, at)?;
        products::<f64>(&powers, odd, at)?;
    }
}

#[test]
fn deviation_of_numbers_whose_squares_overflow() {
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::from([1e25_f32, 2e25, 3e25, 4e25]));
    let y = x.std(0);
    assert_eq!(y.item(), 1.118_034e25);
    for grad in [y.grad(&[&x]).remove(0), y.grad_graph(&[&x]).remove(0).into_value()] {
        for (got, expected) in grad.iter().zip([-0.335_410_2_f32, -0.111_803_4, 0.111_803_4, 0.335_410_2]) {
            assert!((got / expected - 1.0).abs() < 2e-7, "{grad:?}");
        }
    }
}

/// Calls `check` with a number at the end of each type's range.
macro_rules! at_the_end {
    ($check:ident) => {{
        $check::<f32>(3e38);
        $check::<f64>(1.7e308);
    }};
}

fn near<T: Scalar>(got: T, expected: f64) -> bool {
    got.to_f64() == expected || (got.to_f64() / expected - 1.0).abs() < 8.0 * T::EPSILON
}

/// The gradient, and the recorded gradient.
fn both<T: Scalar>(y: &Var<'_, T>, wrt: &[&Var<'_, T>]) -> [Vec<Tensor<T>>; 2] {
    [y.grad(wrt), y.grad_graph(wrt).into_iter().map(Var::into_value).collect()]
}

/// The product of a deviation and the number of elements is not in range.
#[test]
fn deviation_of_many_numbers_at_the_end_of_the_range() {
    fn check<T: Scalar>(most: f64) {
        let (most, tape, n) = (T::from_f64(most), Tape::<T>::new(), 1024);
        let x = tape.leaf(Tensor::from_fn(&[n], |i| if i % 2 == 0 { most } else { -most }));
        let share = 1.0 / n as f64;
        let third = Tensor::from_fn(&[n], |i| if i == 3 { T::ONE } else { T::ZERO });
        assert!(near(along(&|x| x[0].std(0), x.value(), &third), -share));
        for grads in both(&x.std(0), &[&x]) {
            let mut signs = [share, -share].into_iter().cycle();
            assert!(grads[0].iter().all(|got| near(got, signs.next().unwrap())), "{:?}", grads[0].as_slice()[0]);
        }
    }
    at_the_end!(check);
}

/// The sum of a direction is not in range, its mean is.
#[test]
fn means_along_numbers_at_the_end_of_the_range() {
    fn check<T: Scalar>(most: f64) {
        let (ones, direction) = (Tensor::full(&[4], T::ONE), Tensor::full(&[4], T::from_f64(most)));
        assert!(near(along(&|x| x[0].mean(), &ones, &direction), T::from_f64(most).to_f64()));
        let half = Tensor::full(&[4], T::from_f64(0.5));
        let l1 = along(&|x| x[0].l1_loss(x[0].tape().constant(half.clone())), &ones, &direction);
        assert!(near(l1, T::from_f64(most).to_f64()));
    }
    at_the_end!(check);
}

/// Sums of shares of gain and bias leave the range and come back.
#[test]
fn gain_and_bias_of_gradients_at_the_end_of_the_range() {
    fn check<T: Scalar>(most: f64) {
        let (most, tape) = (T::from_f64(most), Tape::<T>::new());
        let x = tape.constant(Tensor::from_fn(&[4, 2], |i| T::from_f64((i % 2) as f64)));
        let (gain, bias) = (tape.leaf(Tensor::full(&[2], T::ONE)), tape.leaf(Tensor::zeros(&[2])));
        for (weights, of_bias) in [([1.0, 1.0, -1.0, -1.0], 0.0), ([1.0, 1.0, -1.0, -0.5], 0.5)] {
            let weights = weights.map(|weight| T::from_f64(0.9 * weight) * most);
            let weights =
                tape.constant(Tensor::from_fn(&[4, 2], |i| if i % 2 == 0 { weights[i / 2] } else { T::ZERO }));
            let loss = (x.layer_norm(&gain, &bias, 0.0) * &weights).sum();
            for grads in both(&loss, &[&gain, &bias]) {
                let expected = 0.9 * of_bias * most.to_f64();
                let [gain, bias] = [&grads[0], &grads[1]].map(|grad| grad.as_slice());
                for (got, expected) in [(gain[0], -expected), (gain[1], 0.0), (bias[0], expected), (bias[1], 0.0)] {
                    assert!(near(got, expected), "{got:?} for {expected}");
                }
            }
        }
    }
    at_the_end!(check);
}

/// A length that overflows still has a direction.
#[test]
fn direction_of_a_length_beyond_the_range() {
    fn check<T: Scalar>(most: f64) {
        let tape = Tape::<T>::new();
        let x = tape.leaf(Tensor::full(&[2], T::from_f64(most)));
        assert!(x.norm().item().to_f64().is_infinite());
        for grads in both(&x.norm(), &[&x]) {
            assert!(grads[0].iter().all(|got| near(got, 0.5_f64.sqrt())), "{grads:?}");
        }
    }
    at_the_end!(check);
}

/// The derivative of a function of one operand in a direction.
fn along<T: Scalar>(f: &dyn for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>, x: &Tensor<T>, direction: &Tensor<T>) -> T {
    jvp(f, std::slice::from_ref(x), std::slice::from_ref(direction)).1.item()
}

/// Products of both incoming gradients leave the range of f32, their products with the probabilities do not.
#[test]
fn second_derivatives_of_logarithms_of_sums() {
    fn second(logits: [f32; 2], g: f32, h: f32, f: impl for<'t> Fn(&Var<'t, f32>) -> Var<'t, f32>) -> f64 {
        let tape = Tape::<f32>::new();
        let x = tape.leaf(Tensor::from(logits));
        let first = (f(&x) * g).grad_graph(&[&x]).remove(0);
        f64::from((first.slice_axis(0, ..1) * h).sum().grad(&[&x])[0].as_slice()[0])
    }
    for (logits, g, h) in [([0.0, -2.0], 2e38, 1.0), ([0.0, -20.0], 2e38, 1.0), ([0.0, -10.0], 1e19, 1e20)] {
        // g h y (1 - y), for the probability y of the first.
        let odds = f64::from(logits[1]).exp();
        let expected = f64::from(g) * f64::from(h) * odds / ((1.0 + odds) * (1.0 + odds));
        for (name, got) in [
            ("logsumexp", second(logits, g, h, |x| x.logsumexp())),
            ("cross_entropy", second(logits, g, h, |x| x.reshape(&[1, 2]).cross_entropy([1]).sum())),
        ] {
            assert!((got / expected - 1.0).abs() < 1e-6, "{name} of {logits:?}: {got:e} for {expected:e}");
        }
    }
}

/// NaN in one row changes nothing in others, which have digits only if a large gradient lifts them.
#[test]
fn nan_stays_in_its_row_of_a_softmax() {
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::from([[0_f32, 0.0], [0.0, -100.0]]));
    for nan in [f32::NAN, 1.0] {
        let g = tape.constant(Tensor::from([[nan, 1.0], [0.0, 1e30]]));
        let y = x.softmax(-1);
        let grad = tape.no_grad(|| y.vjp(&g, &[&x])).remove(0);
        assert!((grad.value().as_slice()[3] / 3.720_076e-14 - 1.0).abs() < 1e-6, "{:?}", grad.value());
    }
}

/// As many windows on one pixel as a window has pixels, all with one gradient, whose plain sum in f32 is off by 4e-5.
#[test]
fn many_windows_on_one_pixel() {
    let n = 4096;
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::from_fn(&[1, 1, 1, 2 * n - 1], |i| if i == n - 1 { 1.0 } else { 0.0 }));
    let config = Pool2dConfig { stride: [1, 1], ..Pool2dConfig::new([1, n]) };
    let expected = f64::from(0.1_f32) * n as f64;
    let at = |y: Var<'_, f32>| f64::from((y * 0.1).sum().grad(&[&x])[0].as_slice()[n - 1]);
    let (max, average) = (at(x.max_pool2d(&config)), n as f64 * at(x.avg_pool2d(&config)));
    let mean = f64::from(tape.constant(Tensor::full(&[1, 1, 1, n], 0.1)).avg_pool2d(&config).item()) * n as f64;
    for sum in [max, average, mean] {
        assert!((sum / expected - 1.0).abs() < 1e-6, "{sum} for {expected}");
    }
}

/// A mean in range of numbers whose sum is not, and deviations from it that are not.
#[test]
fn means_at_the_end_of_the_range() {
    fn check<T: Scalar>(most: T) {
        let tape = Tape::<T>::new();
        let x = tape.leaf(Tensor::from_fn(&[4], |i| if i == 0 { most } else { -most }));
        let half = T::from_f64(0.5) * most;
        assert_eq!((x.mean().item(), x.value().mean()), (-half, -half));
        assert_eq!(x.mean().grad(&[&x])[0], Tensor::full(&[4], T::from_f64(0.25)));
        for (x, axis) in [(x.reshape(&[4, 1]).broadcast_to(&[4, 2]), 0), (x.reshape(&[1, 4]), 1)] {
            let y = x.std_over(axis, 0);
            let expected = 0.75_f64.sqrt() * most.to_f64();
            assert!(y.value().iter().all(|y| (y.to_f64() / expected - 1.0).abs() < 4.0 * T::EPSILON), "{y:?}");
            let grad = y.sum().grad(&[&x]).remove(0);
            let first = grad.as_slice()[0].to_f64();
            assert!((first - 0.75_f64.sqrt() / 2.0).abs() < 4.0 * T::EPSILON, "{grad:?}");
        }
        // Equal numbers have no deviation, and no gradient.
        let x = tape.leaf(Tensor::full(&[3], most));
        let (y, z) = (x.std(0), x.var(0));
        assert_eq!((y.item(), z.item(), x.norm_over(Axes::from(0)).item().to_f64()), (T::ZERO, T::ZERO, f64::INFINITY));
        for grad in [y.grad(&[&x]), z.grad(&[&x])] {
            assert_eq!(grad[0], Tensor::zeros(&[3]));
        }
    }
    check(f32::MAX);
    check(f64::MAX);
}

/// A square overflows, but the mean does not.
#[test]
fn mean_of_squares_beyond_the_range() {
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::from([2.6e19_f32, 0.0, 1e19, 0.0, 1.0]));
    let loss = x.mse_loss(tape.constant(Tensor::zeros(&[5])));
    let close = |got: f32, exact: f64| assert!((f64::from(got) / exact - 1.0).abs() < 3e-7, "{got:e} for {exact:e}");
    close(loss.item(), (f64::from(2.6e19_f32).powi(2) + f64::from(1e19_f32).powi(2) + 1.0) / 5.0);
    let first = loss.grad_graph(&[&x]).remove(0);
    for (got, x) in first.value().iter().zip(x.value().iter()).filter(|&(_, x)| x != 0.0) {
        close(got, 0.4 * f64::from(x));
    }
    first.sum().grad(&[&x])[0].iter().for_each(|got| close(got, 0.4));
    assert_eq!(x.mse_loss(tape.constant(Tensor::full(&[5], -1e38))).item(), f32::INFINITY);
}

/// An element overflows, but the mean does not.
#[test]
fn mean_losses_beyond_the_range() {
    const MOST: f64 = f32::MAX as f64;
    type Loss = for<'t> fn(&Var<'t, f32>, &Var<'t, f32>) -> Var<'t, f32>;
    let check = |loss: Loss, expected: f64, slopes: [f64; 4]| {
        let tape = Tape::<f32>::new();
        let x = tape.leaf(Tensor::from([f32::MAX, 3.0, -0.5, 0.0]));
        let target = tape.leaf(Tensor::from([-0.5 * f32::MAX, 0.0, 0.0, 0.0]));
        let y = loss(&x, &target);
        assert!((f64::from(y.item()) / expected - 1.0).abs() < 3e-7, "{:e} for {expected:e}", y.item());
        for [of_x, of_target] in
            [y.grad(&[&x, &target]), y.grad_graph(&[&x, &target]).into_iter().map(Var::into_value).collect()]
                .map(|grads| [grads[0].to_vec(), grads[1].to_vec()])
        {
            for ((&got, negative), expected) in of_x.iter().zip(of_target).zip(slopes) {
                assert!((f64::from(got) - 0.25 * expected).abs() < 1e-7, "{of_x:?} for a quarter of {slopes:?}");
                assert_eq!(got, -negative);
            }
        }
    };
    check(|x, target| x.l1_loss(target), 0.375 * MOST, [1.0, 1.0, -1.0, 0.0]);
    check(|x, target| x.huber_loss(target, 2.0), 0.75 * MOST, [2.0, 2.0, -0.5, 0.0]);
    check(|x, target| x.smooth_l1_loss(target, 2.0), 0.375 * MOST, [1.0, 1.0, -0.25, 0.0]);
    check(|x, target| x.smooth_l1_loss(target, 0.0), 0.375 * MOST, [1.0, 1.0, -1.0, 0.0]);
    check(|x, target| x.smooth_l1_loss(target, 1e-60), 0.375 * MOST, [1.0, 1.0, -1.0, 0.0]);

    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::from([[f32::MAX, -0.5 * f32::MAX], [0.0, 20.0], [0.0, 0.0], [0.0, 0.0]]));
    let y = x.cross_entropy_loss([1, 1, 0, 1]);
    assert!((f64::from(y.item()) / (0.375 * MOST) - 1.0).abs() < 3e-7, "{y:?}");
    let confident = 0.25 * (-20.0_f64).exp() / (1.0 + (-20.0_f64).exp());
    let expected = [0.25, -0.25, confident, -confident, -0.125, 0.125, 0.125, -0.125];
    for grad in [y.grad(&[&x]).remove(0), y.grad_graph(&[&x]).remove(0).into_value()] {
        for (got, expected) in grad.iter().zip(expected) {
            assert!((f64::from(got) / expected - 1.0).abs() < 1e-6, "{got:e} for {expected:e}");
        }
    }
}

/// An element overflows, and gradients are at the ends of the range.
#[test]
fn gradients_beside_a_loss_that_overflows() {
    /// The gradients by the first operand, plain and recorded.
    fn gradients<T: Scalar>(
        loss: impl for<'t> Fn(&Var<'t, T>, &Var<'t, T>) -> Var<'t, T>,
        [x, target]: [Tensor<T>; 2],
        g: f64,
    ) -> (T, [Tensor<T>; 2]) {
        let tape = Tape::<T>::new();
        let [x, target] = [x, target].map(|x| tape.leaf(x));
        let y = loss(&x, &target);
        let g = tape.constant(Tensor::scalar(T::from_f64(g)));
        let plain = tape.no_grad(|| y.vjp(&g, &[&x])).remove(0);
        (y.item(), [plain, y.vjp(&g, &[&x]).remove(0)].map(Var::into_value))
    }
    fn check<T: Scalar>(most: T, g: f64, least: f64, [big, small, large]: [f64; 3]) {
        let of = |values: &[f64]| Tensor::from_vec(&[values.len()], values.iter().map(|&x| T::from_f64(x)).collect());
        let most = most.to_f64();
        let operands = || [of(&[most, 3.0, -0.5, 0.0]), of(&[-0.5 * most, 0.0, 0.0, 0.0])];
        // Each element's gradient is in range, and a multiple of g is not.
        let (value, grads) = gradients::<T>(|x, target| x.l1_loss(target), operands(), g);
        assert_eq!(value, T::from_f64(0.375 * most));
        let quarter = T::from_f64(g / 4.0);
        grads.into_iter().for_each(|grad| assert_eq!(grad, [quarter, quarter, -quarter, T::ZERO]));
        let (_, grads) = gradients::<T>(|x, target| x.smooth_l1_loss(target, 2.0), operands(), g);
        grads.into_iter().for_each(|grad| assert_eq!(grad.as_slice()[..2], [quarter; 2]));
        let (_, grads) = gradients::<T>(|x, target| x.huber_loss(target, 2.0), operands(), g / 4.0);
        grads.into_iter().for_each(|grad| assert_eq!(grad.as_slice()[..2], [T::from_f64(g / 8.0); 2]));
        let logits = || [of(&[most, -0.5 * most]).reshape(&[1, 2]), of(&[0.0])];
        let (_, grads) = gradients::<T>(|x, _| x.cross_entropy_loss([1]), logits(), g);
        grads.into_iter().for_each(|grad| assert_eq!(grad.as_slice(), [T::from_f64(g), T::from_f64(-g)]));
        // The least residual has its sign.
        let operands = || [of(&[most, least, 0.0, 0.0]), of(&[-0.5 * most, 0.0, 0.0, 0.0])];
        let (_, grads) = gradients::<T>(|x, target| x.l1_loss(target), operands(), 1.0);
        grads.into_iter().for_each(|grad| assert_eq!(grad.as_slice()[1], T::from_f64(0.25)));
        // Small residuals keep their digits.
        let mut residuals = vec![0.0; 1000];
        residuals[..2].copy_from_slice(&[big, small]);
        let (value, grads) = gradients::<T>(|x, target| x.mse_loss(target), [of(&residuals), of(&[0.0; 1000])], large);
        let is_close = |got: T, exact: f64| (got.to_f64() / exact - 1.0).abs() <= 4.0 * T::EPSILON;
        let [big, small, large] = [big, small, large].map(|x| T::from_f64(x).to_f64());
        assert!(is_close(value, big / 1000.0 * big), "{value:?}");
        let exact = small * (2.0 * large / 1000.0);
        grads.into_iter().for_each(|grad| assert!(is_close(grad.as_slice()[1], exact), "{grad:?} for {exact:e}"));
    }
    check(f32::MAX, 1e38, 1e-45, [2e19, 1.3e-38, 1e10]);
    check(f64::MAX, 1e308, 5e-324, [1e154, 3e-308, 1e10]);
}

/// The prediction and the target of a loss depend on one variable.
#[test]
fn gradients_of_mean_losses_of_targets_that_depend_on_predictions() {
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::from([1e15_f32]));
    let target = &x * 0.5;
    let [y, equal] = [x.mse_loss(&target), x.mse_loss(&x)];
    for g in [1e-43_f32, 1e-10] {
        let g = tape.constant(Tensor::scalar(g));
        let expected = 0.5 * 1e15 * f64::from(g.item());
        for grad in [tape.no_grad(|| y.vjp(&g, &[&x])).remove(0), y.vjp(&g, &[&x]).remove(0)] {
            assert!((f64::from(grad.value().as_slice()[0]) / expected - 1.0).abs() < 4e-7, "{grad:?} for {expected:e}");
        }
        assert_eq!(equal.vjp(&g, &[&x])[0].value(), [0.0]);
    }
}

/// The gradient of each element of a loss is a subnormal number, or 0 after rounding, and its product is not.
#[test]
fn gradients_of_mean_losses_from_subnormal_shares() {
    fn check<T: Scalar>(g: f64, residual: f64) {
        let n = 7;
        let tape = Tape::<T>::new();
        let [r, g] = [residual, g].map(T::from_f64);
        let x = tape.leaf(Tensor::full(&[n], r));
        let zero = tape.leaf(Tensor::zeros(&[n]));
        let (slope, g_wide) = (r.to_f64(), g.to_f64());
        let losses = [
            ("mse", x.mse_loss(&zero), 2.0 * slope),
            ("huber", x.huber_loss(&zero, residual * 2.0), slope),
            ("smooth_l1", x.smooth_l1_loss(&zero, residual), 1.0),
            ("l1", x.l1_loss(&zero), 1.0),
        ];
        for (name, loss, slope) in losses {
            let g = tape.constant(Tensor::scalar(g));
            let plain = tape.no_grad(|| loss.vjp(&g, &[&x, &zero]));
            let recorded = loss.vjp(&g, &[&x, &zero]);
            for (grads, sign) in [(&plain, 1.0), (&plain, -1.0), (&recorded, 1.0), (&recorded, -1.0)] {
                let grad = &grads[usize::from(sign < 0.0)];
                // One rounding of a subnormal result.
                let least = if T::NAME == "f32" { 1e-45 } else { 5e-324 };
                for got in grad.value().iter() {
                    let expected = sign * (g_wide * 1e30 / n as f64 * slope) / 1e30;
                    let error = (got.to_f64() - expected).abs();
                    assert!(
                        error <= (4.0 * T::EPSILON * expected.abs()).max(least),
                        "{name}: {got:?} for {expected:e}"
                    );
                }
            }
        }
        let loss = x.binary_cross_entropy_with_logits_loss(&zero);
        let grad = tape.no_grad(|| loss.vjp(&tape.constant(Tensor::scalar(g)), &[&zero])).remove(0);
        let expected = -g_wide * slope / n as f64;
        assert!((grad.value().as_slice()[0].to_f64() / expected - 1.0).abs() <= 4.0 * T::EPSILON, "{grad:?}");
    }
    check::<f32>(1e-43, 1e15);
    check::<f32>(-1e-45, 1e18);
    check::<f64>(1e-322, 1e30);
}

/// Means of windows, and of gradients of windows that share a pixel, of numbers whose sum is out of range.
#[test]
fn pooled_means_at_the_end_of_the_range() {
    fn check<T: Scalar>(most: T) {
        let (tape, part) = (Tape::<T>::new(), |share: f64| T::from_f64(share) * most);
        let image = tape.leaf(Tensor::full(&[1, 1, 3, 3], most));
        let y = image.avg_pool2d(&Pool2dConfig { stride: [1, 1], ..Pool2dConfig::new([2, 2]) });
        assert_eq!(y.value().as_slice(), [most; 4]);
        let g = tape.constant(y.value().clone());
        let [corner, edge] = [0.25, 0.5].map(part);
        let expected = [corner, edge, corner, edge, most, edge, corner, edge, corner];
        let plain = tape.no_grad(|| y.vjp(&g, &[&image])).remove(0);
        for grad in [plain, y.vjp(&g, &[&image]).remove(0)] {
            assert_eq!(grad.value().as_slice(), expected);
        }
    }
    check(f32::MAX);
    check(f64::MAX);
    // Small means beside them keep their digits.
    let tape = Tape::<f32>::new();
    let image =
        tape.leaf(Tensor::from([f32::MAX, f32::MAX, f32::from_bits(3), f32::from_bits(5)]).reshape(&[1, 1, 1, 4]));
    let y = image.avg_pool2d(&Pool2dConfig { stride: [1, 2], ..Pool2dConfig::new([1, 2]) });
    assert_eq!(y.value().as_slice(), [f32::MAX, f32::from_bits(4)]);
}

/// The gradient at the class is minus the sum of the other probabilities, and 1 minus a probability has no digits left.
#[test]
fn gradients_of_confident_predictions() {
    fn check<T: Scalar>() {
        for logit in [2.0, 10.0, 16.25, 20.0, 40.0] {
            let tape = Tape::<T>::new();
            let x = tape.leaf(Tensor::from([[T::from_f64(logit), T::ZERO]]));
            let y = x.cross_entropy([0]);
            let (p, q) = ((-logit).exp() / (1.0 + (-logit).exp()), 1.0 / (1.0 + (-logit).exp()));
            let recorded = y.grad_graph(&[&x]).remove(0);
            let plain = y.grad(&[&x]).remove(0);
            let second = recorded.slice_axis(1, ..1).sum().grad(&[&x]).remove(0);
            for (got, expected) in [(&plain, [-p, p]), (recorded.value(), [-p, p]), (&second, [p * q, -p * q])] {
                for (got, expected) in got.as_slice().iter().zip(expected) {
                    let error = (got.to_f64() / expected - 1.0).abs() / T::EPSILON;
                    assert!(error <= 8.0 + 2.0 * logit, "{logit} in {}: {got:?} for {expected:e}", T::NAME);
                }
            }
        }
    }
    check::<f32>();
    check::<f64>();
}

/// The gradient of a function of one row, for an incoming gradient in every element.
fn gradient(x: &[f32], g: f32, f: Function<f32>) -> Vec<f32> {
    let tape = Tape::new();
    let x = tape.leaf(Tensor::from_vec(&[x.len()], x.to_vec()));
    let y = f(&x);
    let g = tape.constant(Tensor::full(y.shape(), g));
    tape.no_grad(|| y.vjp(&g, &[&x])).remove(0).value().to_vec()
}

#[track_caller]
fn assert_close(got: &[f32], expected: &[f32]) {
    for (a, b) in got.iter().zip(expected) {
        assert!(a == b || (a / b - 1.0).abs() < 4.0 * f32::EPSILON, "{got:?} for {expected:?}");
    }
}

/// Lengths and deviations that are subnormal numbers, or are 0 after rounding.
#[test]
fn gradients_of_subnormal_lengths() {
    let step = 1e-45;
    let half = 0.5_f32.sqrt();
    assert_close(&gradient(&[step, step], 1.0, |x| x.norm()), &[half, half]);
    assert_close(&gradient(&[0.0, 0.0], 1.0, |x| x.norm()), &[0.0, 0.0]);
    assert_close(&gradient(&[step, 2.0 * step, 2.0 * step], 1.0, |x| x.std(0)), &[-half / 1.5, half / 3.0, half / 3.0]);
    let third = 2.0_f32.powi(120) * step * (2.0 / 9.0);
    assert_close(
        &gradient(&[step, 2.0 * step, 2.0 * step], 2.0_f32.powi(120), |x| x.var(0)),
        &[-2.0 * third, third, third],
    );
}

#[test]
fn gradients_of_deviations_beyond_the_range() {
    let most = f32::MAX;
    let quarter = 1e-30 * most / 4.0;
    assert_close(
        &gradient(&[most, -most, -most, -most], 1e-30, |x| x.var(0)),
        &[3.0 * quarter, -quarter, -quarter, -quarter],
    );
}

/// The second derivative of a length, of factors whose partial products leave the range.
#[test]
fn second_derivative_of_a_length_for_large_gradients() {
    let tape = Tape::<f32>::new();
    let power = |n| 2.0_f32.powi(n);
    let x = tape.leaf(Tensor::from([power(-10), power(-40)]));
    let first = (x.norm() * power(62)).grad_graph(&[&x]).remove(0);
    let second = (first * tape.constant(Tensor::from([0.0, power(62)]))).sum().grad(&[&x]).remove(0);
    assert_eq!(second.as_slice()[0], -power(104));
}

#[test]
fn means_of_rows_beside_extreme_ones() {
    let mean = |rows: [[f32; 2]; 2]| Tensor::from(rows).mean_over(1).to_vec();
    assert_eq!(mean([[f32::MAX, f32::MAX], [f32::INFINITY, 0.0]]), [f32::MAX, f32::INFINITY]);
    assert_eq!(mean([[f32::MAX, f32::MAX], [1e-45, 1e-45]]), [f32::MAX, 1e-45]);
}

#[test]
fn softmax_and_its_relatives_for_extreme_logits_and_gradients() {
    for size in [1e4, 1e6, 1e8, 1e30, -1e30] {
        let equal = gradient(&[size, size], 1.0, |x| x.logsumexp());
        assert_close(&equal, &[0.5, 0.5]);
    }
    assert_eq!(gradient(&[f32::NEG_INFINITY; 2], 1.0, |x| x.logsumexp()), [0.0, 0.0]);
    assert_close(&gradient(&[1.0, 1.0], 2e38, |x| x.log_softmax(-1)), &[0.0, 0.0]);
    assert_close(&gradient(&[1.0, 1.0], 2e38, |x| x.softmax(-1)), &[0.0, 0.0]);
    // y (g - sum g y) with a difference that is out of range.
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::from([0.01_f64.ln(), 0.99_f64.ln()]));
    let g = tape.constant(Tensor::from([1.5e308, -1.5e308]));
    let y = x.softmax(-1);
    let grad = tape.no_grad(|| y.vjp(&g, &[&x])).remove(0);
    let expected = 0.0099 * 3.0 * 1e308;
    assert!((grad.value().as_slice()[0] / expected - 1.0).abs() < 1e-13, "{grad:?}");
}

/// In f64, which has no wider type for the derivatives of a gradient.
#[test]
fn second_derivatives_of_softmax_for_large_gradients() {
    fn second(x: &[f64], g: &[f64], f: Function<f64>) -> f64 {
        let tape = Tape::new();
        let leaf = tape.leaf(Tensor::from_vec(&[x.len()], x.to_vec()));
        let first = f(&leaf).vjp(&tape.constant(Tensor::from_vec(&[g.len()], g.to_vec())), &[&leaf]).remove(0);
        (first.slice_axis(0, ..1) * 1e-300).sum().grad(&[&leaf])[0].as_slice()[0]
    }
    let (most, scaled) = (f64::MAX, 1e-300 * f64::MAX);
    // p (1 - p) (1 - 2 p) times a difference that is out of range, and -p (1 - p) times a sum that is.
    let softmax = second(&[0.01_f64.ln(), 0.99_f64.ln()], &[most, -most], |x| x.softmax(-1));
    let log_softmax = second(&[0.0; 3], &[most / 2.0; 3], |x| x.log_softmax(-1));
    for (got, expected) in [(softmax, 0.0099 * 0.98 * 2.0 * scaled), (log_softmax, -2.0 / 9.0 * 1.5 * scaled)] {
        assert!((got / expected - 1.0).abs() < 1e-13, "{got:e} for {expected:e}");
    }
}

#[test]
fn products_and_lengths_at_the_ends_of_the_range() {
    let tape = Tape::<f64>::new();
    let power = |n: i32| 2.0_f64.powi(n);
    // A product of others that is out of range, and a gradient that brings it back.
    let x = tape.leaf(Tensor::from([1.5, power(750), power(750)]));
    assert_eq!((x.prod() * power(-1000)).grad(&[&x])[0].as_slice()[0], power(500));
    let x = tape.leaf(Tensor::from([1.0, power(230), power(-230)]));
    let g = tape.constant(Tensor::from([0.0, 0.0, power(-900)]));
    assert_eq!((x.cumprod(0) * g).sum().grad(&[&x])[0].as_slice()[0], power(-900));
    // A gradient that is 0 after rounding, times a sum that brings it back.
    let a = tape.leaf(Tensor::from([1.0, 1.0, power(-960)]));
    let y = a.recurrence(&tape.constant(Tensor::from([power(170), 1.0, 1.0])), 0);
    let g = tape.constant(Tensor::from([0.0, 0.0, power(-160)]));
    assert_eq!((y * g).sum().grad(&[&a])[0].as_slice()[1], power(-950));
    let [a, b] = [f64::INFINITY, f64::NEG_INFINITY].map(|x| tape.leaf(Tensor::scalar(x)));
    assert_eq!((a.hypot(&b).item(), a.hypot(&a).item()), (f64::INFINITY, f64::INFINITY));
    let nan = tape.leaf(Tensor::scalar(f64::NAN));
    assert!(nan.powf(2.0).grad(&[&nan])[0].item().is_nan() && nan.pow(&b).grad(&[&nan])[0].item().is_nan());
    // The smaller term of a logarithm of a sum counts with the rounding error of the difference.
    let [a, b] = [3.5e-15, -33.3].map(|x| tape.leaf(Tensor::scalar(x)));
    assert!((b.logaddexp(&a).item() / 6.951_387_744_374_198e-15 - 1.0).abs() < 8.0 * f64::EPSILON);
    // A gradient at the end of the range, and one below it.
    let x = tape.leaf(Tensor::from([1.0, 0.75, 1.0]));
    let g = tape.constant(Tensor::scalar(f64::MAX));
    let y = x.prod();
    for grad in [tape.no_grad(|| y.vjp(&g, &[&x])).remove(0), y.vjp(&g, &[&x]).remove(0)] {
        assert_eq!(grad.value().as_slice(), [0.75 * f64::MAX, f64::MAX, 0.75 * f64::MAX]);
    }
    let x = tape.leaf(Tensor::from([1.0, 4.0 / 3.0 * power(30), power(40)]));
    let g = tape.constant(Tensor::scalar(power(-1074)));
    let y = x.prod();
    let grad = tape.no_grad(|| y.vjp(&g, &[&x])).remove(0);
    assert_eq!(grad.value().as_slice()[0], 4.0 / 3.0 * power(-1004));
    // Factors below 1 that lead to subnormal numbers are rounded once.
    let x = tape.constant(Tensor::full(&[40_000], 0.96));
    let exact = |n: f64| (n * 0.96_f64.ln()).exp();
    let y = x.cumprod(0);
    for n in [17_000, 18_200, 30_000] {
        assert!((y.value().as_slice()[n - 1] - exact(n as f64)).abs() <= 1e-9 * exact(n as f64) + power(-1074));
    }
    // A NaN leaves products before it, and in other lines, as they are.
    let x = tape.constant(Tensor::from([[1e300, 1e10, 1e-10, f64::NAN], [1e300, 1e100, 1e-50, 1e-50]]));
    let y = x.cumprod(1);
    for (i, expected) in [(0, 1e300), (2, 1e300), (4, 1e300), (7, 1e300)] {
        assert!((y.value().as_slice()[i] / expected - 1.0).abs() < 4.0 * f64::EPSILON, "{y:?}");
    }
    assert!(y.value().as_slice()[3].is_nan());
    // Fewer elements than the correction.
    assert!(!tape.leaf(Tensor::from([1.0, 2.0])).var(3).item().is_finite());
}

/// Rounding errors of long products do not add up. The exact values are those of integers.
#[test]
fn long_products_are_rounded_once() {
    let tape = Tape::<f64>::new();
    let is_close = |got: f64, exact: f64, units: f64| {
        assert!((got / exact - 1.0).abs() <= units * f64::EPSILON, "{got:e} for {exact:e}");
    };
    for (factor, n, exact) in [
        (1.3, 50, 497929.22297912795),
        (0.96, 300, 4.801422373777491e-6),
        (0.96, 500, 1.366521659788137e-9),
        (1.01, 2000, 439286205.05010384),
    ] {
        let x = tape.leaf(Tensor::full(&[n], factor));
        let (y, cumulative) = (x.prod(), x.cumprod(0));
        is_close(y.item(), exact, 0.5);
        is_close(cumulative.value().as_slice()[n - 1], exact, 0.5);
        let last = cumulative.slice_axis(0, n as isize - 1..).sum();
        for grad in [y.grad(&[&x]).remove(0), last.grad(&[&x]).remove(0)] {
            grad.iter().for_each(|got| is_close(got, exact / factor, 2.0));
        }
    }
    for (factor, summand, n, exact) in [(0.96, 0.1, 300, 2.4999879964440637), (1.01, 0.3, 1000, 628744.6691344148)] {
        let [a, b] = [factor, summand].map(|x| tape.leaf(Tensor::full(&[n], x)));
        is_close(a.recurrence(&b, 0).value().as_slice()[n - 1], exact, 0.5);
    }
}

/// Terms cancel in numbers whose exponent is their own, and leave the rounding error of another.
#[test]
fn terms_that_cancel_leave_finite_numbers() {
    let tape = Tape::<f64>::new();
    let of = |values: &[f64]| tape.leaf(Tensor::from_vec(&[values.len()], values.to_vec()));
    let y = of(&[1.0; 6]).recurrence(&of(&[1e41, 1e-276, -1e41, 0.0, 3.0, 4.0]), 0);
    assert!(y.value().is_finite(), "{y:?}");
    assert_eq!(y.value().as_slice()[4..], [3.0, 7.0]);
    let y = of(&[1.0, 1.0, 1.0, 1e10]).recurrence(&of(&[1.0, 1e-310, -1.0, 0.0]), 0);
    assert!((y.value().as_slice()[3] / 1e-300 - 1.0).abs() < 1e-12, "{y:?}");
    for (g, expected) in [
        (&[3.0, -1e41, 1e-276, 1e41][..], &[3.0, 1e-276, 1e41, 1e41][..]),
        (&[3.0, 1.0, -1.0, 1e-310, 1.0], &[4.0, 1.0, 0.0, 1.0, 1.0]),
    ] {
        let x = of(&vec![1.0; g.len()]);
        let grad = x.cumprod(0).vjp(&of(g), &[&x]).remove(0);
        // In units of the largest term.
        let unit = g.iter().fold(0.0_f64, |most, g| most.max(g.abs())) * f64::EPSILON;
        let is_close = |(got, expected): (f64, &f64)| (got - expected).abs() <= unit;
        assert!(grad.value().iter().zip(expected).all(is_close), "{grad:?} for {expected:?}");
    }
}

#[test]
fn losses_of_no_rows_are_nan() {
    let tape = Tape::<f32>::new();
    for shape in [&[0, 3][..], &[2, 0, 3], &[0, 0]] {
        let x = tape.leaf(Tensor::zeros(shape));
        let y = x.cross_entropy_loss([]);
        assert!(y.item().is_nan());
        assert_eq!(y.grad(&[&x])[0].shape(), shape);
    }
    let none = tape.constant(Tensor::zeros(&[0]));
    assert!(none.mse_loss(&none).item().is_nan() && none.huber_loss(&none, 1.0).item().is_nan());
}

/// A row without a largest element has no part in second derivatives.
#[test]
fn extrema_of_nan_do_not_spoil_second_derivatives() {
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::from([[f64::NAN, 1.0], [2.0, 3.0]]));
    let w = tape.leaf(Tensor::scalar(1.0));
    for y in [x.max_over(1), x.min_over(1)] {
        let first = (y * &w).sum().grad_graph(&[&x]).remove(0);
        assert_eq!(first.sum().grad(&[&w])[0].item(), 1.0);
    }
}

/// Numbers on the way to a gradient overflow, and the gradient does not.
#[test]
fn searches_for_infinity_leave_out_values_on_the_way() {
    let power = |n: i32| 2.0_f32.powi(n);
    let tape = Tape::<f32>::new();
    tape.check_finite(true);
    let x = tape.leaf(Tensor::from([power(60), power(60), power(-100)]));
    let first = x.prod().grad_graph(&[&x]).remove(0);
    let seed = tape.constant(Tensor::from([0.0, 0.0, power(20)]));
    let second = tape.no_grad(|| first.try_vjp(&seed, &[&x])).unwrap().remove(0);
    assert_eq!(second.value(), [power(80), power(80), 0.0]);
}

#[test]
fn gradients_in_no_grad_are_constants() {
    let tape = Tape::<f64>::new();
    let x = tape.leaf(Tensor::scalar(2.0));
    let (y, seed) = (&x * 3.0, tape.leaf(Tensor::scalar(1.0)));
    let grads = tape.no_grad(|| y.vjp(&seed, &[&y, &x]));
    assert!(grads.iter().all(|grad| !grad.is_on_graph()), "{grads:?}");
    assert!(y.vjp(&seed, &[&y, &x]).iter().all(|grad| grad.is_on_graph()));
}

/// Cross products whose two terms cancel or leave the range. The exact values are those of integers.
#[test]
fn cross_products_of_nearly_parallel_and_huge_vectors() {
    fn cross<T: Scalar>(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
        let tape = Tape::<T>::new();
        let [a, b] = [a, b].map(|x| tape.constant(Tensor::from(x.map(T::from_f64))));
        let y = a.cross(&b);
        std::array::from_fn(|i| y.value().as_slice()[i].to_f64())
    }
    fn check<T: Scalar>(digits: u32) {
        let mut random = 1_u64;
        let mut next = || {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (random >> (65 - digits)) as i128 + (1 << (digits - 2))
        };
        for parallel in [false, true].repeat(200) {
            let a = [next(), next(), next()];
            let shift = |i: usize| if parallel { a[i] + (i as i128 % 2) } else { a[(i + 1) % 3] - 7 };
            let b: [i128; 3] = std::array::from_fn(shift);
            let exact = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
            let got = cross::<T>(a.map(|x| x as f64), b.map(|x| x as f64));
            for (got, exact) in got.into_iter().zip(exact) {
                assert!((got - exact as f64).abs() <= T::EPSILON * (exact as f64).abs(), "{got} for {exact}");
            }
        }
    }
    check::<f32>(24);
    check::<f64>(53);
    assert_eq!(cross::<f32>([1e20; 3], [1e20; 3]), [0.0; 3]);
    assert_eq!(cross::<f64>([1e160; 3], [1e160; 3]), [0.0; 3]);
    let power = |n: i32| 2.0_f64.powi(n);
    assert_eq!(cross::<f32>([0.0, power(64), power(63)], [0.0, power(64), power(64)])[0], power(127));
    assert_eq!(cross::<f64>([0.0, power(512), power(511)], [0.0, power(512), power(512)])[0], power(1023));
    assert_eq!(cross::<f64>([0.0, power(-540), 3.0 * power(-540)], [0.0, power(-500), power(-500)])[0], -power(-1039));
    assert_eq!(cross::<f64>([0.0, 1e300, 0.0], [0.0, 0.0, 1e300])[0], f64::INFINITY);
    assert_eq!(cross::<f64>([0.0, 1e-300, 1.0], [0.0, 2.0, 1e-300])[0], -2.0);
    // A value of 0 has a gradient in range.
    let tape = Tape::<f32>::new();
    let [a, b] = [0.0, 1e30].map(|x| tape.leaf(Tensor::full(&[3], x)));
    let grads = a.cross(&b).vjp(&tape.constant(Tensor::full(&[3], 1e20)), &[&a, &b]);
    grads.iter().for_each(|grad| assert_eq!(grad.value(), [0.0; 3]));
}

/// Partial sums leave the range, and the sum does not.
#[test]
fn sums_that_overflow_on_the_way() {
    /// `power` is the largest power of two.
    fn check<T: Scalar>(power: T) {
        let of = |parts: &[f64]| {
            let values: Vec<T> = parts.iter().map(|&x| T::from_f64(x) * power).collect();
            Tensor::from_vec(&[values.len()], values)
        };
        let tape = Tape::<T>::new();
        for (parts, expected) in [
            (&[1.75, -1.75, 1.75][..], 1.75),
            (&[1.75, 1.75, -1.75], 1.75),
            (&[1.75, -1.75, 1.75, -1.75], 0.0),
            (&[1.75, 1.75, -1.75, -1.75, 0.25], 0.25),
            (&[1.75, 1.75], f64::INFINITY),
            (&[-1.75, -1.75, 0.25], f64::NEG_INFINITY),
        ] {
            let (x, n) = (of(parts), parts.len());
            let expected = T::from_f64(expected) * power;
            assert_eq!(tape.constant(x.clone()).sum().item(), expected, "{parts:?}");
            // Down the columns, beside a column with small numbers.
            let small = Tensor::full(&[n], T::ONE);
            let columns = Tensor::concat(&[&x.reshape(&[n, 1]), &small.reshape(&[n, 1])], 1);
            let sums = tape.constant(columns.clone()).sum_over(0);
            assert_eq!(sums.value(), [expected, T::from_f64(n as f64)]);
            assert_eq!(tape.constant(columns.t()).sum_over(1).value(), sums.value());
            // The adjoint of a broadcast.
            let one = tape.leaf(Tensor::scalar(T::ONE));
            let grad = one.broadcast_to(&[n]).vjp(&tape.constant(x), &[&one]).remove(0);
            assert_eq!(grad.value().item(), expected);
        }
        let nan = of(&[f64::INFINITY, f64::NEG_INFINITY, 1.0]);
        assert!(nan.sum().to_f64().is_nan() && of(&[f64::INFINITY, 1.0]).sum().to_f64() == f64::INFINITY);
    }
    check(2.0_f32.powi(127));
    check(2.0_f64.powi(1023));
}
