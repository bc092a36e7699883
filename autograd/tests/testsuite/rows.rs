//! Softmax and its relatives, layer normalisation and normalisation of rows of all bits, against 100-bit arithmetic.
//! Values and gradients are compared one by one; where terms cancel, in units of the largest one.

use crate::accuracy::exact::Exact;
use crate::accuracy::{Format, Random};
use raygrad_autograd::{Scalar, Tape, Tensor, Var};

const ROWS: u64 = 1500;

/// Numbers of the type.
fn rounded<T: Scalar>(x: Vec<f64>) -> Vec<f64> {
    let finite = |x: f64| if T::from_f64(x).is_finite() { T::from_f64(x).to_f64() } else { 0.0 };
    x.into_iter().map(finite).collect()
}

fn many(n: usize, mut one: impl FnMut() -> f64) -> Vec<f64> {
    (0..n).map(|_| one()).collect()
}

/// A number with one of the `count` exponents from `least` on.
fn of_size<T: Scalar>(random: &mut Random, least: i64, count: i64) -> f64 {
    let exponent = least + random.below(count);
    random.of_exponent::<T>(exponent.max(Format::of::<T>().least))
}

/// Rows of all bits, of one size or of many, close to the subnormal numbers, of neighbours, of equal numbers, and of
/// ordinary numbers among zeros.
fn row<T: Scalar>(random: &mut Random, n: usize) -> Vec<f64> {
    let Format { least, greatest, digits } = Format::of::<T>();
    let (kind, size, first) = (random.below(9), least + random.below(greatest - least), random.pattern::<T>());
    rounded::<T>(many(n, || match kind {
        0 => random.pattern::<T>(),
        1 => of_size::<T>(random, size - 2, 3),
        2 => of_size::<T>(random, size - 30, 30),
        3 => random.below(9) as f64 * T::EPSILON * 2.0_f64.powi(least as i32),
        4 => first * (1.0 + random.below(16) as f64 * 2.0_f64.powi(-digits as i32)),
        5 => first,
        6 => of_size::<T>(random, greatest - 2, 3),
        7 if random.below(2) == 0 => 0.0,
        _ => of_size::<T>(random, -3, 5),
    }))
}

/// Logits of all bits, of sizes whose powers are in range and of larger ones, and far from 0.
fn logits<T: Scalar>(random: &mut Random, n: usize) -> Vec<f64> {
    let (kind, far, greatest) = (random.below(5), of_size::<T>(random, 0, 20), if T::NAME == "f32" { 6 } else { 9 });
    rounded::<T>(many(n, || match kind {
        0 => random.pattern::<T>(),
        1 => far + of_size::<T>(random, -3, greatest + 4),
        2 => of_size::<T>(random, greatest - 2, 3),
        _ => of_size::<T>(random, -12, greatest + 13),
    }))
}

/// Incoming gradients, gains and biases: ones, of ordinary sizes, of all bits, one alone, or the largest numbers.
fn factors<T: Scalar>(random: &mut Random, n: usize) -> Vec<f64> {
    let (kind, place, greatest) = (random.below(6), random.below(n as i64) as usize, Format::of::<T>().greatest);
    let mut i = 0;
    let factors = many(n, || {
        i += 1;
        match kind {
            0 => 1.0,
            1 => of_size::<T>(random, -3, 7),
            2 => random.of_exponent::<T>(greatest).abs(),
            3 if i != place + 1 => 0.0,
            _ => random.pattern::<T>(),
        }
    });
    rounded::<T>(factors)
}

/// The value of a function of a row and vectors of its length, its gradients, and those of a recorded pass.
fn evaluate<T: Scalar>(x: &[&[f64]], g: &[f64], f: impl for<'t> Fn(&[Var<'t, T>]) -> Var<'t, T>) -> [Vec<Vec<f64>>; 3] {
    let tape = Tape::<T>::new();
    let tensor = |x: &[f64]| Tensor::from_fn(&[x.len()], |i| T::from_f64(x[i]));
    let leaves: Vec<_> = x.iter().map(|x| tape.leaf(tensor(x))).collect();
    let wrt: Vec<_> = leaves.iter().collect();
    let y = f(&leaves);
    let g = tape.constant(tensor(g).reshape(y.shape()));
    let numbers = |x: &Var<'_, T>| x.value().iter().map(T::to_f64).collect::<Vec<_>>();
    let plain = tape.no_grad(|| y.vjp(&g, &wrt)).iter().map(numbers).collect();
    let recorded = y.vjp(&g, &wrt).iter().map(numbers).collect();
    [vec![numbers(&y)], plain, recorded]
}

/// Fails if a number is further than `gate` units in the last place from the exact one, or from its largest term.
#[track_caller]
fn check<T: Scalar>(what: &str, row: &[f64], got: &[f64], exact: &[[Exact; 2]], gate: f64) {
    let format = Format::of::<T>();
    for (i, (&got, &[exact, term])) in got.iter().zip(exact).enumerate() {
        // Of terms that overflow and cancel, the rounding errors overflow too.
        let is_noise = exact.abs() < term.abs().shifted(-16);
        if is_noise && term.abs() >= Exact::new(1.0).shifted(format.greatest) {
            continue;
        }
        let error = format.error(got, exact, term);
        assert!(
            error <= gate,
            "{what}, in {}, at element {i} of x {row:?}: {got:e} for {:e}, {error} units off",
            T::NAME,
            exact.to_f64()
        );
    }
}

fn exacts(x: &[f64]) -> Vec<Exact> {
    x.iter().map(|&x| Exact::new(x)).collect()
}

fn sum(x: impl IntoIterator<Item = Exact>) -> Exact {
    x.into_iter().fold(Exact::ZERO, |sum, x| sum + x)
}

fn largest(x: impl IntoIterator<Item = Exact>) -> Exact {
    x.into_iter().map(Exact::abs).fold(Exact::ZERO, |a, b| if b > a { b } else { a })
}

fn softmaxes<T: Scalar>() {
    for case in 0..ROWS {
        let random = &mut Random::of("softmax", case);
        let n = 1 + random.below(if case % 16 == 0 { 40 } else { 7 }) as usize;
        let (x, g, class) = (logits::<T>(random, n), factors::<T>(random, n), random.below(n as i64) as usize);
        // The powers of rows of fewer than 32 are added one after another.
        let gate = (4.0 + 0.5 * n as f64).max(8.0);
        let most = x.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let apart: Vec<_> = x.iter().map(|&x| Exact::new(x) - Exact::new(most)).collect();
        let powers: Vec<_> = apart.iter().map(|x| x.exp()).collect();
        let first = x.iter().position(|&x| x == most).unwrap_or(0);
        let others = sum((0..n).filter(|&i| i != first).map(|i| powers[i]));
        let (ln, total) = (others.ln1p(), others + Exact::new(1.0));
        let p: Vec<_> = powers.iter().map(|&power| power / total).collect();
        let alone = |x: Exact| [x, Exact::ZERO];
        let g_exact = exacts(&g);

        let [y, plain, recorded] = evaluate::<T>(&[&x], &g, |x| x[0].softmax(-1));
        check::<T>("softmax", &x, &y[0], &p.iter().map(|&p| alone(p)).collect::<Vec<_>>(), gate);
        let terms: Vec<_> = p.iter().zip(&g_exact).map(|(&p, &g)| p * g).collect();
        let (mean, term) = (sum(terms.iter().copied()), largest(terms));
        let exact: Vec<_> = (0..n).map(|i| [p[i] * (g_exact[i] - mean), p[i] * largest([g_exact[i], term])]).collect();
        check::<T>("gradient of softmax", &x, &plain[0], &exact, 1.5 * gate);
        check::<T>("recorded gradient of softmax", &x, &recorded[0], &exact, 1.5 * gate);

        let [y, plain, recorded] = evaluate::<T>(&[&x], &g, |x| x[0].log_softmax(-1));
        check::<T>("log_softmax", &x, &y[0], &apart.iter().map(|&x| alone(x - ln)).collect::<Vec<_>>(), gate);
        let (of_g, term) = (sum(g_exact.iter().copied()), largest(g_exact.iter().copied()));
        let exact: Vec<_> = (0..n).map(|i| [g_exact[i] - p[i] * of_g, largest([g_exact[i], p[i] * term])]).collect();
        if y[0].iter().all(|y| y.is_finite()) {
            check::<T>("gradient of log_softmax", &x, &plain[0], &exact, gate);
            check::<T>("recorded gradient of log_softmax", &x, &recorded[0], &exact, gate);
        }

        let [y, plain, recorded] = evaluate::<T>(&[&x], &g[..1], |x| x[0].reshape(&[1, n]).logsumexp_over(-1));
        let top = Exact::new(most);
        check::<T>("logsumexp", &x, &y[0], &[[top + ln, largest([top, ln])]], gate);
        let mut exact: Vec<_> = p.iter().map(|&p| alone(p * g_exact[0])).collect();
        check::<T>("gradient of logsumexp", &x, &plain[0], &exact, gate);
        check::<T>("recorded gradient of logsumexp", &x, &recorded[0], &exact, gate);

        let [y, plain, _] = evaluate::<T>(&[&x], &g[..1], |x| x[0].reshape(&[1, n]).cross_entropy([class as u32]));
        check::<T>("cross_entropy", &x, &y[0], &[alone(ln - apart[class])], gate);
        if y[0][0].is_finite() {
            let others = sum((0..n).filter(|&i| i != class).map(|i| p[i]));
            exact[class] = alone(-others * g_exact[0]);
            check::<T>("gradient of cross_entropy", &x, &plain[0], &exact, gate);
        }
    }
}

fn layer_norms<T: Scalar>() {
    for case in 0..ROWS {
        let random = &mut Random::of("layer_norm", case);
        let n = 2 + random.below(6) as usize;
        let x = row::<T>(random, n);
        let [gain, bias, g] = [(); 3].map(|()| factors::<T>(random, n));
        let bias = if case % 2 == 0 { vec![0.0; n] } else { bias };
        let eps = match random.below(4) {
            0 => 0.0,
            1 => 1e-5,
            2 => random.pattern::<f64>().abs(),
            _ => random.pattern::<f32>().abs(),
        };
        let [wide_x, a, b, wide_g] = [&x, &gain, &bias, &g].map(|x| exacts(x));
        let count = Exact::new(n as f64);
        let mean = sum(wide_x.iter().copied()) / count;
        let apart: Vec<_> = wide_x.iter().map(|&x| x - mean).collect();
        let variance = sum(apart.iter().map(|x| x.square())) / count + Exact::new(eps);
        if variance.is_zero() {
            continue;
        }
        let scale = variance.sqrt();
        let is_equal = x.iter().all(|&other| other == x[0]);
        let u: Vec<_> = apart.iter().map(|&x| if is_equal { Exact::ZERO } else { x / scale }).collect();
        // The mean is as exact as the largest element.
        let unit = if is_equal { Exact::ZERO } else { largest(wide_x.iter().copied()) / scale };
        let what = |what: &str| format!("{what}, epsilon {eps:e}, gain {gain:?}, bias {bias:?}, g {g:?}");
        let [y, plain, recorded] = evaluate::<T>(&[&x, &gain, &bias], &g, |x| x[0].layer_norm(&x[1], &x[2], eps));
        let exact: Vec<_> = (0..n).map(|i| [u[i] * a[i] + b[i], largest([unit * a[i], b[i]])]).collect();
        let limit = Exact::new(1.0).shifted(Format::of::<T>().greatest);
        if (0..n).any(|i| (u[i] * a[i]).abs() >= limit) {
            continue;
        }
        check::<T>(&what("layer_norm"), &x, &y[0], &exact, 8.0);
        let h: Vec<_> = wide_g.iter().zip(&a).map(|(&g, &a)| g * a).collect();
        let (level, along) = (sum(h.iter().copied()) / count, sum((0..n).map(|i| h[i] * u[i])) / count);
        let size = largest(h.iter().copied());
        let term = largest([size, unit * unit * size]) / scale;
        let dx: Vec<_> = (0..n).map(|i| [(h[i] - level - u[i] * along) / scale, term]).collect();
        let dgain: Vec<_> = (0..n).map(|i| [wide_g[i] * u[i], wide_g[i] * unit]).collect();
        let dbias: Vec<_> = wide_g.iter().map(|&g| [g, g]).collect();
        for (which, grads) in [("gradient", plain), ("recorded gradient", recorded)] {
            check::<T>(&what(&format!("{which} of layer_norm")), &x, &grads[0], &dx, 8.0);
            check::<T>(&what(&format!("{which} of layer_norm by gain")), &x, &grads[1], &dgain, 8.0);
            check::<T>(&what(&format!("{which} of layer_norm by bias")), &x, &grads[2], &dbias, 8.0);
        }
    }
}

fn normalizes<T: Scalar>() {
    for case in 0..2 * ROWS {
        let random = &mut Random::of("normalize", case);
        let n = 1 + random.below(7) as usize;
        let (x, g) = (row::<T>(random, n), factors::<T>(random, n));
        let (wide_x, wide_g) = (exacts(&x), exacts(&g));
        let length = sum(wide_x.iter().map(|x| x.square())).sqrt();
        if length.is_zero() {
            continue;
        }
        let [y, plain, recorded] = evaluate::<T>(&[&x], &g, |x| x[0].normalize());
        let u: Vec<_> = wide_x.iter().map(|&x| x / length).collect();
        check::<T>("normalize", &x, &y[0], &u.iter().map(|&u| [u, Exact::ZERO]).collect::<Vec<_>>(), 8.0);
        let terms: Vec<_> = u.iter().zip(&wide_g).map(|(&u, &g)| u * g).collect();
        let (along, term) = (sum(terms.iter().copied()), largest(terms));
        let exact = |i| [(wide_g[i] - u[i] * along) / length, largest([wide_g[i], u[i] * term]) / length];
        let dx: Vec<_> = (0..n).map(exact).collect();
        // Beyond, it is the largest number, not infinity.
        let limit = Exact::new(1.0).shifted(Format::of::<T>().greatest);
        let is_in_range = dx.iter().all(|dx| dx[0].abs() < limit);
        for (which, grads) in [("gradient", plain), ("recorded gradient", recorded)] {
            if is_in_range {
                check::<T>(&format!("{which} of normalize for {g:?}"), &x, &grads[0], &dx, 12.0);
            }
        }
    }
}

/// `y[i] = a[i] y[i - 1] + b[i]` in one direction, and the same of magnitudes.
fn recurrence(a: &[f64], b: &[f64]) -> Vec<[Exact; 2]> {
    let (a, b) = (exacts(a), exacts(b));
    let mut state = [Exact::ZERO; 2];
    let step = |(&a, &b): (&Exact, &Exact)| {
        state = [a * state[0] + b, a.abs() * state[1] + b.abs()];
        state
    };
    a.iter().zip(&b).map(step).collect()
}

fn recurrences<T: Scalar>() {
    for case in 0..2 * ROWS {
        let random = &mut Random::of("recurrence", case);
        let n = 1 + random.below(7) as usize;
        let (a, b, g) = (row::<T>(random, n), row::<T>(random, n), factors::<T>(random, n));
        let exact = recurrence(&a, &b);
        let back = |x: &[f64]| x.iter().rev().copied().collect::<Vec<_>>();
        let next: Vec<f64> = a[1..].iter().copied().chain([0.0]).collect();
        let mut later = recurrence(&back(&next), &back(&g));
        later.reverse();
        let limit = Exact::new(1.0).shifted(Format::of::<T>().greatest);
        if exact.iter().any(|[_, term]| *term >= limit) {
            continue;
        }
        let what = |what: &str| format!("{what}, summands {b:?}, g {g:?}");
        let [y, plain, recorded] = evaluate::<T>(&[&a, &b], &g, |x| x[0].recurrence(&x[1], 0));
        check::<T>(&what("recurrence"), &a, &y[0], &exact, 8.0);
        let before = [[Exact::ZERO; 2]].into_iter().chain(exact);
        let of_factors: Vec<_> = before.zip(&later).map(|(y, later)| [y[0] * later[0], y[1] * later[1]]).collect();
        for (which, grads) in [("gradient", plain), ("recorded gradient", recorded)] {
            check::<T>(&what(&format!("{which} of recurrence by factors")), &a, &grads[0], &of_factors, 8.0);
            check::<T>(&what(&format!("{which} of recurrence by summands")), &a, &grads[1], &later, 8.0);
        }
    }
}

/// The gradient by a factor is a product of two sums, of which one may be out of the range.
#[test]
fn recurrence_of_all_bits() {
    recurrences::<f32>();
    recurrences::<f64>();
}

/// Fails if the derivative by a row of the gradient by the row is not finite although its largest `term` is in range.
/// `g` and `h` are the gradients of the result and of the first gradient.
#[track_caller]
fn check_finite(what: &str, [x, g, h]: [&[f64]; 3], term: Exact, f: impl for<'t> Fn(&Var<'t, f32>) -> Var<'t, f32>) {
    let limit = Exact::new(1.0).shifted(Format::of::<f32>().greatest - 4);
    if term >= limit {
        return;
    }
    let tape = Tape::<f32>::new();
    let tensor = |x: &[f64]| Tensor::from_fn(&[x.len()], |i| x[i] as f32);
    let var = tape.leaf(tensor(x));
    let y = f(&var);
    let first = y.vjp(&tape.constant(tensor(g)).reshape(y.shape()), &[&var]).remove(0);
    let second = tape.no_grad(|| first.vjp(&tape.constant(tensor(h)), &[&var])).remove(0);
    assert!(second.value().is_finite(), "{what} of {x:?}, g {g:?}, h {h:?}: {:?}", second.value());
}

/// Factors leave the range of f32: the third power of a length of 1e-20, or a product of both incoming gradients.
#[test]
fn second_derivatives_of_rows_of_all_bits_are_finite() {
    for case in 0..2 * ROWS {
        let random = &mut Random::of("second", case);
        let n = 1 + random.below(7) as usize;
        let (row, logits) = (row::<f32>(random, n), logits::<f32>(random, n));
        let [g, h] = [(); 2].map(|()| factors::<f32>(random, n));
        let x = exacts(&row);
        let [g_size, h_size] = [&g, &h].map(|x| largest(exacts(x)));
        let size = g_size * h_size * Exact::new(3.0 * n as f64);
        let first = |term: Exact| largest([term, term * h_size]);
        let length = sum(x.iter().map(|x| x.square())).sqrt();
        if !length.is_zero() {
            let term = largest([size / length.square(), first(g_size / length)]);
            check_finite("normalize", [&row, &g, &h], term, |x| x.normalize());
        }
        let term = largest([size, first(g_size * Exact::new(n as f64))]);
        check_finite("log_softmax", [&logits, &g, &h], term, |x| x.log_softmax(-1));
        check_finite("logsumexp", [&logits, &g[..1], &h], term, |x| x.logsumexp());
        check_finite("cross_entropy", [&logits, &g[..1], &h], term, |x| x.cross_entropy([0]));
        // The product of all elements but one or two is at most that of all that are larger than 1.
        let product = x.iter().fold(Exact::new(1.0), |product, &x| product * largest([x, Exact::new(1.0)]));
        let term = largest([size * product, first(g_size * product)]);
        check_finite("prod", [&row, &g[..1], &h], term, |x| x.prod());
    }
}

#[test]
fn softmax_and_its_relatives_of_all_bits() {
    softmaxes::<f32>();
    softmaxes::<f64>();
}

#[test]
fn layer_norm_of_all_bits() {
    layer_norms::<f32>();
    layer_norms::<f64>();
}

#[test]
fn normalize_of_all_bits() {
    normalizes::<f32>();
    normalizes::<f64>();
}
