//! Scans against plain loops: as many lines as are walked side by side, one less, one more and a few times as many, along
//! any axis, in both precisions.

use raygrad_autograd::{Scalar, Tape, Tensor, Var};

/// Round numbers between -2 and 2, so that f64 sums of any number of them are exact.
fn values<T: Scalar>(shape: &[usize], seed: usize) -> Tensor<T> {
    Tensor::from_fn(shape, |i| T::from_f64((((i * 7919 + seed * 10_007) % 2003) as f64 - 1001.0) / 512.0))
}

/// Factors near 1 and -1, so that long products stay in range.
fn factors<T: Scalar>(shape: &[usize]) -> Tensor<T> {
    let sign = |i: usize| if i.is_multiple_of(3) { -1.0 } else { 1.0 };
    Tensor::from_fn(shape, |i| T::from_f64(sign(i) * (1.0 + ((i * 37 % 64) as f64 - 32.0) / 1024.0)))
}

/// For each line along the middle axis its elements.
fn lines<T: Scalar>(x: &Tensor<T>) -> Vec<Vec<f64>> {
    let [outer, count, inner] = [0, 1, 2].map(|axis| x.shape()[axis]);
    let line =
        |at: usize| (0..count).map(|k| x.as_slice()[(at / inner * count + k) * inner + at % inner].to_f64()).collect();
    (0..outer * inner).map(line).collect()
}

#[track_caller]
fn check<T: Scalar>(what: &str, got: &Tensor<T>, exact: impl Fn(usize) -> Vec<f64>, units: f64) {
    for (i, line) in lines(got).into_iter().enumerate() {
        let exact = exact(i);
        let size = exact.iter().fold(0.0, |most: f64, x| if x.abs() <= most { most } else { x.abs() });
        assert_eq!(line.len(), exact.len());
        for (k, (got, exact)) in line.into_iter().zip(exact).enumerate() {
            let error = (got - exact).abs();
            let within = error <= units * T::EPSILON * size;
            assert!(within, "{what} in {}: line {i}, entry {k}: {got} for {exact}", T::NAME);
        }
    }
}

fn backwards(mut x: Vec<f64>) -> Vec<f64> {
    x.reverse();
    x
}

/// `y[i] = a[i] y[i - 1] + b[i]`.
fn recurrence(a: &[f64], b: &[f64]) -> Vec<f64> {
    let step = |y: &mut f64, (a, b): (&f64, &f64)| {
        *y = a * *y + b;
        Some(*y)
    };
    a.iter().zip(b).scan(0.0, step).collect()
}

fn scans<T: Scalar>(shape: [usize; 3]) {
    let tape = Tape::<T>::new();
    let grads = |y: &Var<'_, T>, g: &Tensor<T>, x: &[&Var<'_, T>]| (y * tape.constant(g.clone())).sum().grad(x);
    let (x, a, g) = (tape.leaf(values(&shape, 1)), tape.leaf(factors(&shape)), values(&shape, 2));
    let (x_lines, a_lines, g_lines) = (lines(x.value()), lines(a.value()), lines(&g));
    let ones = vec![1.0; shape[1]];
    // Sums are carried in f64 and rounded once.
    let sums = |x: &[f64]| recurrence(&ones, x);
    let y = x.cumsum(1);
    check("cumsum", y.value(), |i| sums(&x_lines[i]), 0.5);
    let back = |i: usize| backwards(sums(&backwards(g_lines[i].clone())));
    check("gradient of cumsum", &grads(&y, &g, &[&x])[0], back, 0.5);
    let y = x.reverse_cumsum(1);
    check("reverse cumsum", y.value(), |i| backwards(sums(&backwards(x_lines[i].clone()))), 0.5);
    check("gradient of reverse cumsum", &grads(&y, &g, &[&x])[0], |i| sums(&g_lines[i]), 0.5);

    let products = |a: &[f64]| -> Vec<f64> {
        a.iter()
            .scan(1.0, |product, a| {
                *product *= a;
                Some(*product)
            })
            .collect()
    };
    let y = a.cumprod(1);
    // Those that are compared with are in f64: each step rounds.
    let of_products = if T::NAME == "f64" { 0.5 * shape[1] as f64 } else { 0.0 };
    check("cumprod", y.value(), |i| products(&a_lines[i]), 2.0 + of_products);
    // dy[j] / da[i] = y[j] / a[i] for j >= i: no factor is 0.
    let slope = |i: usize| {
        let terms: Vec<f64> = products(&a_lines[i]).iter().zip(&g_lines[i]).map(|(y, g)| y * g).collect();
        backwards(sums(&backwards(terms))).iter().zip(&a_lines[i]).map(|(sum, a)| sum / a).collect()
    };
    check("gradient of cumprod", &grads(&y, &g, &[&a])[0], slope, 64.0);

    let y = a.recurrence(&x, 1);
    let exact = |i: usize| recurrence(&a_lines[i], &x_lines[i]);
    check("recurrence", y.value(), exact, 8.0);
    let db = |i: usize| {
        let next: Vec<f64> = a_lines[i][1..].iter().copied().chain([0.0]).collect();
        backwards(recurrence(&backwards(next), &backwards(g_lines[i].clone())))
    };
    let da = |i: usize| -> Vec<f64> {
        let before = std::iter::once(0.0).chain(exact(i));
        db(i).into_iter().zip(before).map(|(db, y)| db * y).collect()
    };
    let found = grads(&y, &g, &[&a, &x]);
    check("gradient of the factors", &found[0], da, 64.0);
    check("gradient of the summands", &found[1], db, 16.0);
}

#[test]
fn scans_without_columns_are_immediate() {
    let tape = Tape::<f32>::new();
    let x = tape.leaf(Tensor::zeros(&[1 << 40, 1, 0]));
    assert_eq!([x.cumsum(1), x.cumprod(1)].map(|y| y.shape().to_vec()), [[1 << 40, 1, 0]; 2]);
}

#[test]
fn scans_of_lines_side_by_side() {
    for outer in [1, 2, 7, 8, 9, 15, 16, 17, 29] {
        for count in [1, 2, 33, 300] {
            for inner in [1, 2, 9] {
                scans::<f32>([outer, count, inner]);
                scans::<f64>([outer, count, inner]);
            }
        }
    }
}
