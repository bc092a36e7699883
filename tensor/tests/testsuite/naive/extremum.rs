//! The greatest and smallest elements along an axis, with ties and NaN.

use super::support::{around, in_both, same, values};
use raygrad_tensor::Scalar;
use raygrad_tensor::extremum::{arg_extremum, extremum, extremum_grad};

fn extremes<T: Scalar>() {
    let counts = [1, 2, 3].into_iter().chain(around(32)).chain([255]).chain(around(4096));
    for (count, inner) in counts.flat_map(|count| [1, 2, 33].map(|inner| (count, inner))) {
        let outer = if count * inner > 4096 { 2 } else { 3 };
        let middle = [outer, count, inner];
        let mut x = values::<T>(outer * count * inner, count);
        // The last column has its extremes at its very end, and the one before it twice the same.
        for (sign, back) in [(1.0, 1), (-1.0, 2)] {
            if count > 4 {
                let end = x.len();
                x[end - 1 - (back - 1) * inner] = T::from_f64(sign * 7.0);
                x[end - 1 - (back + 1) * inner] = T::from_f64(sign * 7.0);
            }
        }
        let column =
            |o: usize, i: usize| -> Vec<f64> { (0..count).map(|c| x[(o * count + c) * inner + i].to_f64()).collect() };
        let columns: Vec<_> = (0..outer * inner).map(|at| column(at / inner, at % inner)).collect();
        for greatest in [true, false] {
            let what = format!("{middle:?}, greatest {greatest}");
            let better = |a: f64, b: f64| if (b > a) == greatest && a != b { b } else { a };
            let best: Vec<f64> = columns.iter().map(|x| x.iter().copied().fold(x[0], better)).collect();
            let mut y = vec![T::from_f64(f64::NAN); outer * inner];
            extremum(&x, middle, greatest, &mut y);
            same(&what, &y, best.iter().copied());
            let first = columns.iter().zip(&best).map(|(x, best)| x.iter().position(|x| x == best).unwrap() as u32);
            assert_eq!(arg_extremum(&x, middle, greatest), first.collect::<Vec<_>>(), "{what}");
            let g = values::<T>(y.len(), 3);
            let mut dx = vec![T::from_f64(f64::NAN); x.len()];
            extremum_grad(&x, &y, &g, middle, &mut dx);
            let ties = |(x, best): (&Vec<f64>, &f64)| x.iter().filter(|&x| x == best).count() as f64;
            let ties: Vec<f64> = columns.iter().zip(&best).map(ties).collect();
            let share = |i: usize| {
                let at = i / (count * inner) * inner + i % inner;
                if x[i].to_f64() == best[at] { g[at].to_f64() / ties[at] } else { 0.0 }
            };
            same(&what, &dx, (0..x.len()).map(share));
        }
        // A NaN anywhere, alone in its column.
        for at in [0, x.len() / 2, x.len() - 1] {
            let mut x = x.clone();
            x[at] = T::from_f64(f64::NAN);
            let mut y = vec![T::ZERO; outer * inner];
            extremum(&x, middle, false, &mut y);
            let nan: Vec<_> = (0..y.len()).filter(|&i| y[i].to_f64().is_nan()).collect();
            assert_eq!(nan, [at / (count * inner) * inner + at % inner], "{middle:?}");
            assert_eq!(arg_extremum(&x, middle, false)[nan[0]] as usize, at / inner % count, "{middle:?}");
        }
    }
}

#[test]
fn extremes_along_an_axis() {
    in_both!(extremes);
}
