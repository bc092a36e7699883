//! Medians and outliers, means and principal axes.

use glam::{DMat3, DVec3};

/// The median; 0 for no values.
pub(crate) fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.into_iter().filter(|x| !x.is_nan()).collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// The robust standard deviation: 1.4826 times the median distance from the median. It equals the standard deviation of
/// normal numbers and ignores a few outliers.
pub(crate) fn spread(values: &[f64]) -> f64 {
    let middle = median(values.iter().copied());
    1.4826 * median(values.iter().map(|x| (x - middle).abs()))
}

/// The mean of points; NaN for none.
pub(crate) fn mean(points: impl IntoIterator<Item = DVec3>) -> DVec3 {
    let (sum, count) = points.into_iter().fold((DVec3::ZERO, 0.0), |(sum, count), point| (sum + point, count + 1.0));
    sum / count
}

/// The matrix `v v'`.
pub(crate) fn outer(v: DVec3) -> DMat3 {
    DMat3::from_cols(v * v.x, v * v.y, v * v.z)
}

/// The eigenvalues of a symmetric matrix, the largest first, and the eigenvector of the largest, by Jacobi rotations.
pub(crate) fn eigen<const N: usize>(mut a: [[f64; N]; N]) -> ([f64; N], [f64; N]) {
    /// Sweeps; each squares the off-diagonal part.
    const SWEEPS: usize = 30;
    let mut vectors: [[f64; N]; N] = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
    for (p, q) in (0..SWEEPS).flat_map(|_| (0..N).flat_map(|p| (p + 1..N).map(move |q| (p, q)))) {
        if a[p][q] == 0.0 {
            continue;
        }
        let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
        let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
        let cos = 1.0 / t.hypot(1.0);
        let sin = t * cos;
        let turn = |row: &mut [f64; N]| (row[p], row[q]) = (cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]);
        a.iter_mut().for_each(turn);
        vectors.iter_mut().for_each(turn);
        for k in 0..N {
            (a[p][k], a[q][k]) = (cos * a[p][k] - sin * a[q][k], sin * a[p][k] + cos * a[q][k]);
        }
    }
    let mut order: [usize; N] = std::array::from_fn(|i| i);
    order.sort_by(|&i, &j| a[j][j].total_cmp(&a[i][i]));
    (order.map(|i| a[i][i]), vectors.map(|row| row[order[0]]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn median_and_spread_ignore_outliers() {
        let values = [1.0, 2.0, 3.0, 4.0, 1e9, f64::NAN];
        assert_eq!(median(values), 3.0);
        assert_eq!(spread(&values[..5]), 1.4826);
        assert_eq!(median([]), 0.0);
    }
}
