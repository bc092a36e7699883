//! Medians and outliers.

/// The value in the middle; 0 of none.
pub(crate) fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.into_iter().filter(|x| !x.is_nan()).collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// How far values usually are from their median: 1.4826 times the median of the distances from it, which is the standard
/// deviation of normal numbers and is not moved by a few that are not.
pub(crate) fn spread(values: &[f64]) -> f64 {
    let middle = median(values.iter().copied());
    1.4826 * median(values.iter().map(|x| (x - middle).abs()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outliers_do_not_move_them() {
        let values = [1.0, 2.0, 3.0, 4.0, 1e9, f64::NAN];
        assert_eq!(median(values), 3.0);
        assert_eq!(spread(&values[..5]), 1.4826);
        assert_eq!(median([]), 0.0);
    }
}
