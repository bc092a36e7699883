//! Softmax, logarithms of sums, cross-entropy, moments and layer normalisation of rows.

use super::support::{around, close, in_both, sum, values, wide};
use raygrad_tensor::rows::{
    cross_entropy_rows, cross_entropy_rows_grad, layer_norm_rows, layer_norm_rows_grad, log_softmax_rows,
    log_softmax_rows_grad, logsumexp_rows, softmax_rows, softmax_rows_grad, variance_rows,
};
use raygrad_tensor::{Pool, Scalar};

/// Numbers of rows and their lengths: around the lanes (32) and blocks (4096) of a row, blocks of several rows, groups of
/// 16 rows and parts of 64, and enough for all threads.
fn sizes() -> impl Iterator<Item = (usize, usize)> {
    let lengths = [1, 2, 7].into_iter().chain(around(32)).chain(around(1024)).chain(around(4096)).chain([32_769]);
    let few = lengths.map(|n| (3, n));
    let many =
        [(4099, 1), (2051, 2), (1025, 7), (129, 33), (65, 64), (15, 17), (16, 17), (17, 17), (64, 5), (1031, 79)];
    few.chain(many)
}

fn nan<T: Scalar>(n: usize) -> Vec<T> {
    vec![T::from_f64(f64::NAN); n]
}

fn softmaxes<T: Scalar>() {
    let pool = Pool::new();
    for (rows, n) in sizes() {
        let (x, g) = (values::<T>(rows * n, 1), values::<T>(rows * n, 2));
        let (wide_x, wide_g) = (wide(&x), wide(&g));
        let what = |name: &str| format!("{name} of {rows} rows of {n}");
        let row = |i: usize| i / n * n..i / n * n + n;
        // Sums of each row, by row.
        let by_row =
            |f: &dyn Fn(usize) -> f64| -> Vec<f64> { (0..rows).map(|r| sum((r * n..r * n + n).map(f))).collect() };
        let totals = by_row(&|i| wide_x[i].exp());
        let mut y = nan::<T>(x.len());
        softmax_rows(&x, n, &mut y, &pool);
        let p: Vec<f64> = (0..x.len()).map(|i| wide_x[i].exp() / totals[i / n]).collect();
        close(&what("softmax"), &y, 12.0, p.iter().map(|&p| [p, p]));
        let mut logs = nan::<T>(x.len());
        log_softmax_rows(&x, n, &mut logs, &pool);
        let exact = |i: usize| wide_x[i] - totals[i / n].ln();
        close(&what("log softmax"), &logs, 4.0, (0..x.len()).map(|i| [exact(i), 8.0 + totals[i / n].ln().abs()]));
        let mut ln = nan::<T>(rows);
        logsumexp_rows(&x, n, &mut ln, &pool);
        close(&what("logsumexp"), &ln, 4.0, totals.iter().map(|total| [total.ln(), 4.0 + total.ln().abs()]));

        // Gradients, of what the kernels are given.
        let wide_y = wide(&y);
        let mut dx = nan::<T>(x.len());
        softmax_rows_grad(&x, &y, &g, n, &mut dx);
        let means = by_row(&|i| wide_y[i] * wide_g[i]);
        let exact = (0..x.len()).map(|i| wide_y[i] * (wide_g[i] - means[i / n]));
        close(&what("gradient of softmax"), &dx, 24.0, exact.zip(&wide_y).map(|(d, y)| [d, 4.0 * y]));
        dx = nan(x.len());
        log_softmax_rows_grad(&x, &g, n, &mut dx, &pool);
        let sums = by_row(&|i| wide_g[i]);
        let sizes = by_row(&|i| wide_g[i].abs());
        let exact = (0..x.len()).map(|i| [wide_g[i] - p[i] * sums[i / n], wide_g[i].abs() + p[i] * sizes[i / n]]);
        close(&what("gradient of log softmax"), &dx, 24.0, exact);

        let classes: Vec<u32> = (0..rows).map(|r| ((r * 7 + n - 1) % n) as u32).collect();
        let mut loss = nan::<T>(rows);
        cross_entropy_rows(&x, n, &classes, &mut loss, &pool);
        let exact = |r: usize| {
            let (total, at) = (totals[r], r * n + classes[r] as usize);
            [total.ln() - wide_x[at], 8.0 + total.ln().abs()]
        };
        close(&what("cross-entropy"), &loss, 4.0, (0..rows).map(exact));
        let mut dx = nan::<T>(x.len());
        cross_entropy_rows_grad(&x, n, &classes, &g[..rows], &mut dx, &pool);
        let is_class = |i: usize| i % n == classes[i / n] as usize;
        let exact = |i: usize| {
            let others = || -> f64 { sum(row(i).filter(|&j| j != i).map(|j| p[j])) };
            let d = wide_g[i / n] * if is_class(i) { -others() } else { p[i] };
            [d, d.abs()]
        };
        close(&what("gradient of cross-entropy"), &dx, 24.0, (0..x.len()).map(exact));
    }
}

#[test]
fn softmax_and_its_relatives() {
    in_both!(softmaxes);
}

/// Mean and mean squared deviation of a row.
fn moments(x: &[f64]) -> [f64; 2] {
    let mean = sum(x.iter().copied()) / x.len() as f64;
    [mean, sum(x.iter().map(|x| (x - mean).powi(2))) / x.len() as f64]
}

fn norms<T: Scalar>() {
    const EPS: f64 = 1.0 / 1024.0;
    for (rows, n) in sizes() {
        let what = |name: &str| format!("{name} of {rows} rows of {n}");
        let x: Vec<T> = values::<T>(rows * n, 1).iter().map(|&x| x + T::from_f64(8.0)).collect();
        let [gain, bias, g] = [(n, 2), (n, 3), (rows * n, 4)].map(|(n, seed)| values::<T>(n, seed));
        let [wide_x, wide_gain, wide_bias, wide_g] = [&x, &gain, &bias, &g].map(|x| wide(x));
        let moments: Vec<_> = wide_x.chunks(n).map(moments).collect();
        let mut variances = nan::<T>(rows);
        variance_rows(&x, n, T::ONE, false, &mut variances);
        // Of a row of one nothing but rounding is left.
        close(&what("variance"), &variances, 16.0, moments.iter().map(|[_, variance]| [*variance, *variance]));
        let mut y = nan::<T>(x.len());
        layer_norm_rows(&x, &gain, &bias, EPS, &mut y);
        let unit = |i: usize| (wide_x[i] - moments[i / n][0]) / (moments[i / n][1] + EPS).sqrt();
        let exact = |i: usize| {
            let part = unit(i) * wide_gain[i % n];
            [part + wide_bias[i % n], part.abs() + wide_bias[i % n].abs() + wide_gain[i % n].abs()]
        };
        close(&what("layer norm"), &y, 16.0, (0..x.len()).map(exact));

        let (mut dx, mut dgain, mut dbias) = (nan::<T>(x.len()), nan::<T>(n), nan::<T>(n));
        let sums = Some([&mut dgain[..], &mut dbias[..]]);
        layer_norm_rows_grad(&x, &gain, &g, EPS, &mut dx, sums, &Pool::new());
        let h = |i: usize| wide_g[i] * wide_gain[i % n];
        let row = |r: usize| r * n..r * n + n;
        let mean = |r: usize, f: &dyn Fn(usize) -> f64| sum(row(r).map(f)) / n as f64;
        let means: Vec<_> = (0..rows)
            .map(|r| {
                let slope = |i: usize| h(i) * unit(i);
                [mean(r, &h), mean(r, &slope), mean(r, &|i| h(i).abs()), mean(r, &|i| slope(i).abs())]
            })
            .collect();
        let exact = |i: usize| {
            let ([level, slope, size, slope_size], scale) = (means[i / n], 1.0 / (moments[i / n][1] + EPS).sqrt());
            let d = (h(i) - level - unit(i) * slope) * scale;
            [d, (h(i).abs() + size + (1.0 + unit(i).abs()) * slope_size) * scale]
        };
        close(&what("gradient of layer norm"), &dx, 24.0, (0..x.len()).map(exact));
        let down = |f: &dyn Fn(usize) -> f64| -> Vec<[f64; 2]> {
            let column = |j: usize| (0..rows).map(move |r| f(r * n + j));
            (0..n).map(|j| [sum(column(j)), sum(column(j).map(f64::abs))]).collect()
        };
        // Groups of 16 are added up in their own type; a unit is as accurate as a row of its length.
        let size_of = |[sum, size]: [f64; 2]| [sum, size + 4.0 * rows as f64 / 16.0];
        close(&what("gradient of the gain"), &dgain, 24.0, down(&|i| wide_g[i] * unit(i)).into_iter().map(size_of));
        close(&what("gradient of the bias"), &dbias, 17.0, down(&|i| wide_g[i]));
        // Without the sums the rest is the same.
        let mut alone = nan::<T>(x.len());
        layer_norm_rows_grad(&x, &gain, &g, EPS, &mut alone, None, &Pool::new());
        assert!(alone == dx);
    }
}

#[test]
fn moments_and_layer_normalisation() {
    in_both!(norms);
}

/// Numbers a few units in the last place apart: what the rounding of their mean adds is a share of their variance.
fn narrow<T: Scalar>() {
    let unit = T::EPSILON * 16_384.0;
    for n in [2, 7, 31, 32, 33, 101, 4097] {
        let offsets: Vec<f64> = (0..3 * n).map(|i| ((i * 7919 + i / 1013) % 11) as f64).collect();
        let x: Vec<T> = offsets.iter().map(|offset| T::from_f64(30_000.0 + offset * unit)).collect();
        let mut variances = nan::<T>(3);
        variance_rows(&x, n, T::ONE, false, &mut variances);
        let exact = offsets.chunks(n).map(|row| moments(row)[1] * unit * unit);
        close(&format!("variance of {n} far from 0"), &variances, 256.0, exact.map(|variance| [variance, variance]));
    }
}

#[test]
fn variances_of_rows_far_from_zero() {
    in_both!(narrow);
}
