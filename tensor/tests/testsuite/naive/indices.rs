//! Sorting, searching and indicator vectors.

use super::support::{around, in_both, values};
use raygrad_tensor::{Indices, Scalar, Tensor};

fn sorts<T: Scalar>() {
    for extent in [0, 1, 2].into_iter().chain(around(20)).chain(around(1024)) {
        for (outer, inner) in [(1, 1), (3, 1), (1, 5), (2, 3)] {
            let mut x = Tensor::from_vec(&[outer, extent, inner], values::<T>(outer * extent * inner, 1));
            // Many equal ones, both zeros, and some NaN.
            for (i, x) in x.as_mut_slice().iter_mut().enumerate() {
                let whole = x.to_f64().trunc();
                *x = T::from_f64(if i % 97 == 5 { f64::NAN } else { whole });
            }
            for descending in [false, true] {
                let got = x.argsort(1, descending);
                assert_eq!(got.shape(), [outer, extent, inner]);
                let at = |o: usize, k: usize, i: usize| (o * extent + k) * inner + i;
                for (o, i) in (0..outer).flat_map(|o| (0..inner).map(move |i| (o, i))) {
                    let key = |k: usize| x.as_slice()[at(o, k, i)].to_f64();
                    // Selection of one after another: the first that none of those left is before.
                    let mut expected: Vec<usize> = (0..extent).collect();
                    let number = |k: usize| if key(k).is_nan() { 1e9 } else { key(k) };
                    let sign = if descending { -1.0 } else { 1.0 };
                    expected.sort_by(|&a, &b| (sign * number(a)).total_cmp(&(sign * number(b))).then(a.cmp(&b)));
                    // -0 and 0 are equal.
                    let zero = |k: usize| number(k) == 0.0;
                    let start = expected.iter().position(|&k| zero(k)).unwrap_or(0);
                    let zeros = expected.iter().filter(|&&k| zero(k)).count();
                    expected[start..start + zeros].sort();
                    let found: Vec<_> = (0..extent).map(|k| got.as_slice()[at(o, k, i)] as usize).collect();
                    assert_eq!(found, expected, "{:?} {descending}", x.shape());
                }
            }
        }
    }
}

#[test]
fn sorting_along_an_axis() {
    in_both!(sorts);
}

fn searches<T: Scalar>() {
    for n in [0, 1, 2, 3].into_iter().chain(around(1024)) {
        for (rows, m) in [(1, 7), (3, 40)] {
            let mut x = values::<T>(rows * n, 1);
            x.chunks_mut(n.max(1)).for_each(|row| row.sort_by(|a, b| a.to_f64().total_cmp(&b.to_f64())));
            let sorted = Tensor::from_vec(&[rows, n], x);
            let wanted = Tensor::from_vec(&[rows, m], values::<T>(rows * m, 2));
            let one = Tensor::from_vec(&[n], sorted.as_slice()[..n].to_vec());
            for right in [false, true] {
                let each = sorted.searchsorted(&wanted, right);
                let shared = one.searchsorted(&wanted, right);
                assert_eq!((each.shape(), shared.shape()), (&[rows, m][..], &[rows, m][..]));
                for (i, &x) in wanted.as_slice().iter().enumerate() {
                    let count = |row: &[T]| row.iter().filter(|&&y| y < x || right && y == x).count();
                    assert_eq!(each.as_slice()[i] as usize, count(&sorted.as_slice()[i / m * n..][..n]));
                    assert_eq!(shared.as_slice()[i] as usize, count(one.as_slice()));
                }
            }
        }
    }
}

#[test]
fn searching_in_sorted_rows() {
    in_both!(searches);
}

#[test]
fn indicator_vectors() {
    for (count, classes) in [(0, 3), (1, 1), (7, 5), (1025, 33)] {
        let index = |i: usize| (i * 7 % classes) as u32;
        let indices = Indices::new(&[count], (0..count).map(index).collect::<Vec<_>>());
        let y = indices.one_hot::<f32>(classes);
        assert_eq!(y.shape(), [count, classes]);
        for (i, &y) in y.as_slice().iter().enumerate() {
            assert_eq!(y == 1.0, index(i / classes) as usize == i % classes);
            assert!(y == 1.0 || y == 0.0);
        }
    }
}
