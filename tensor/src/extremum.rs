//! The largest or smallest elements along an axis, and their indices. Start with [`extremum`].

use crate::indices::index;
use crate::parallel::{ELEMENT, PIECE, chunks};
use crate::reduce::chunk;
use crate::rows::fold_lanes;
use crate::{Scalar, checked_len, simd};

/// The shape of a tensor as `[outer, count, inner]`, to reduce along the middle axis.
pub type Middle = [usize; 3];

/// Least number of columns for one task: some cache lines of each row.
const LEAST: usize = 64;

/// Checks that slices are as long as an array and its extremum.
#[track_caller]
fn check([outer, count, inner]: Middle, x: usize, out: usize) {
    let fits = checked_len(&[outer, count, inner]) == Some(x) && checked_len(&[outer, inner]) == Some(out);
    assert!(fits, "{x} and {out} numbers for an extremum of {:?}", [outer, count, inner]);
}

/// The largest elements along the middle axis, or the smallest ones if `greatest` is false: `[outer, count, inner]` to
/// `[outer, inner]`. NaN if one element is NaN.
///
/// # Panics
/// If the lengths do not fit, or `count` is 0 and `out` is not empty.
pub fn extremum<T: Scalar>(x: &[T], middle: Middle, greatest: bool, out: &mut [T]) {
    let [outer, count, inner] = middle;
    check(middle, x.len(), out.len());
    if outer == 1 && inner > 1 {
        // One group: columns of it for each task.
        let at_once = (PIECE / count.max(1)).max(LEAST);
        chunks(out, at_once, ELEMENT * x.len(), || (), &|(), i, out| columns(x, middle, i * at_once, greatest, out));
        return;
    }
    // Groups of about a piece for each task.
    let (group, at_once) = (count * inner, (PIECE / (count * inner).max(1)).max(1));
    chunks(out, (at_once * inner).max(1), ELEMENT * x.len(), || (), &|(), i, out| {
        let groups = out.len() / inner;
        let (x, middle) = (&x[i * at_once * group..][..groups * group], [groups, count, inner]);
        columns(x, middle, 0, greatest, out);
    });
}

/// [`extremum`] of the columns from `first` on: all columns, or some of one group.
fn columns<T: Scalar>(x: &[T], middle: Middle, first: usize, greatest: bool, out: &mut [T]) {
    if greatest {
        along(x, middle, first, out, T::maximum);
    } else {
        along(x, middle, first, out, T::minimum);
    }
}

fn along<T: Scalar>(x: &[T], [outer, count, inner]: Middle, first: usize, out: &mut [T], pick: impl Fn(T, T) -> T) {
    debug_assert!(x.len() == outer * count * inner && (out.len() == outer * inner || outer == 1));
    assert!(count > 0, "extremum of no elements");
    simd::dispatch(
        #[inline(always)]
        || {
            if inner == 1 {
                for (x, out) in x.chunks_exact(count).zip(out) {
                    *out = fold_lanes(x, &pick);
                }
                return;
            }
            let width = if outer == 1 { out.len() } else { inner };
            for (x, out) in x.chunks_exact(count * inner).zip(out.chunks_exact_mut(width)) {
                out.copy_from_slice(&x[first..][..width]);
                for row in x.chunks_exact(inner) {
                    let row = &row[first..][..width];
                    for i in 0..width {
                        out[i] = pick(out[i], row[i]);
                    }
                }
            }
        },
    );
}

/// The gradient of [`extremum`]: `g` of each result `y`, shared evenly among the elements equal to `y`, fewer than 2^32.
/// If `y` is NaN, all get 0.
///
/// # Panics
/// If the lengths do not fit.
pub fn extremum_grad<T: Scalar>(x: &[T], y: &[T], g: &[T], [outer, count, inner]: Middle, out: &mut [T]) {
    check([outer, count, inner], x.len(), y.len());
    assert_eq!((out.len(), g.len()), (x.len(), y.len()), "gradient of an extremum");
    if x.is_empty() {
        return;
    }
    let run = count * inner;
    // Whole numbers: a sum of ones in f32 ends at 2^24.
    let (mut counts, mut shares) = (vec![0_u32; inner], vec![T::ZERO; inner]);
    simd::dispatch(
        #[inline(always)]
        || {
            let (counts, shares) = (&mut counts[..inner], &mut shares[..inner]);
            let rows = x.chunks_exact(run).zip(out.chunks_exact_mut(run));
            for ((x, out), (y, g)) in rows.zip(y.chunks_exact(inner).zip(g.chunks_exact(inner))) {
                // 1 where an element equals the result.
                if inner == 1 {
                    let mut number = 0.0;
                    for i in 0..count {
                        out[i] = if x[i] == y[0] { T::ONE } else { T::ZERO };
                    }
                    for part in out.chunks(1 << 12) {
                        number += chunk(part).to_f64();
                    }
                    let share = T::from_f64(g[0].to_f64() / number);
                    for out in out {
                        *out = if *out > T::ZERO { share } else { T::ZERO };
                    }
                    continue;
                }
                counts.fill(0);
                for x in x.chunks_exact(inner) {
                    for i in 0..inner {
                        counts[i] += u32::from(x[i] == y[i]);
                    }
                }
                for i in 0..inner {
                    shares[i] = T::from_f64(g[i].to_f64() / f64::from(counts[i]));
                }
                for (x, out) in x.chunks_exact(inner).zip(out.chunks_exact_mut(inner)) {
                    for i in 0..inner {
                        out[i] = if x[i] == y[i] { shares[i] } else { T::ZERO };
                    }
                }
            }
        },
    );
}

/// The indices of the largest elements along the middle axis, or the smallest ones if `greatest` is false. It is the
/// first of equal elements, and the first NaN if there is one.
///
/// # Panics
/// If the length does not fit, `count` is 0 and the result is not empty, or `count` is above 2^32.
pub fn arg_extremum<T: Scalar>(x: &[T], [outer, count, inner]: Middle, greatest: bool) -> Vec<u32> {
    check([outer, count, inner], x.len(), outer.saturating_mul(inner));
    assert!(count > 0 || outer * inner == 0, "extremum of no elements");
    let better = |x: T, than: T| if greatest { x > than } else { x < than };
    let mut best = vec![0; outer * inner];
    for (x, best) in x.chunks_exact((count * inner).max(1)).zip(best.chunks_exact_mut(inner.max(1))) {
        let mut value = x[..inner].to_vec();
        for (row, x) in x.chunks_exact(inner).enumerate().skip(1) {
            let row = index(row);
            for i in 0..inner {
                let is_nan = |x: T| x.partial_cmp(&x).is_none();
                if !is_nan(value[i]) && (better(x[i], value[i]) || is_nan(x[i])) {
                    (value[i], best[i]) = (x[i], row);
                }
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn extremes_along_any_axis_agree_with_a_plain_loop(
            outer in 0usize..4, count in 1usize..90, inner in 0usize..5, greatest: bool, seed in 0usize..100
        ) {
            let x: Vec<f32> = (0..outer * count * inner).map(|i| ((i * 31 + seed * 17) % 23) as f32 - 11.0).collect();
            let mut y = vec![0.0; outer * inner];
            extremum(&x, [outer, count, inner], greatest, &mut y);
            let g: Vec<f32> = (0..y.len()).map(|i| i as f32 + 1.0).collect();
            let mut dx = vec![7.0; x.len()];
            extremum_grad(&x, &y, &g, [outer, count, inner], &mut dx);
            let arg = arg_extremum(&x, [outer, count, inner], greatest);
            for o in 0..outer {
                for i in 0..inner {
                    let column: Vec<f32> = (0..count).map(|c| x[(o * count + c) * inner + i]).collect();
                    let pick = if greatest { f32::max } else { f32::min };
                    let best = column.iter().copied().fold(column[0], pick);
                    let ties = column.iter().filter(|&&x| x == best).count() as f32;
                    let at = o * inner + i;
                    prop_assert_eq!(y[at], best);
                    prop_assert_eq!(arg[at] as usize, column.iter().position(|&x| x == best).unwrap());
                    for c in 0..count {
                        let share = if column[c] == best { g[at] / ties } else { 0.0 };
                        prop_assert_eq!(dx[(o * count + c) * inner + i], share);
                    }
                }
            }
        }
    }

    #[test]
    #[ignore = "256 MB; run with cargo test --release -p raygrad-tensor ties -- --ignored"]
    fn more_ties_than_f32_counts() {
        let x = vec![0.0_f32; 3 << 24];
        let mut dx = vec![1.0; x.len()];
        for middle @ [_, _, inner] in [[1, 3 << 24, 1], [1, 3 << 23, 2]] {
            let y = vec![0.0; inner];
            extremum_grad(&x, &y, &vec![3.0; inner], middle, &mut dx);
            let expected = 3.0 / (x.len() / inner) as f32;
            assert!(dx.iter().all(|&dx| dx == expected), "{} for {expected}", dx[0]);
        }
    }

    #[test]
    fn a_nan_wins_wherever_it_stands() {
        for count in [3, 100] {
            for at in 0..count {
                let mut x = vec![1.0_f32; count];
                x[at] = f32::NAN;
                for greatest in [true, false] {
                    let mut y = [0.0];
                    extremum(&x, [1, count, 1], greatest, &mut y);
                    assert!(y[0].is_nan(), "{count} {at}");
                    assert_eq!(arg_extremum(&x, [1, count, 1], greatest), [at as u32]);
                    let mut dx = vec![1.0; count];
                    extremum_grad(&x, &y, &[1.0], [1, count, 1], &mut dx);
                    assert!(dx.iter().all(|&dx| dx == 0.0));
                }
            }
        }
    }

    #[test]
    fn extremum_other_lengths_panic() {
        let panics = |f: &dyn Fn()| std::panic::catch_unwind(std::panic::AssertUnwindSafe(f)).is_err();
        // Each product wraps to the lengths that are given.
        let half = 1 << 63;
        for middle in [[2, 3, 2], [half, 2, 2], [2, half, 1], [1 << 32, 1, 1 << 32]] {
            assert!(panics(&|| extremum(&[0.0_f32; 4], middle, true, &mut [0.0; 4])), "{middle:?}");
            assert!(panics(&|| extremum::<f32>(&[], middle, true, &mut [])), "{middle:?}");
            assert!(panics(&|| extremum_grad::<f32>(&[], &[], &[], middle, &mut [])), "{middle:?}");
            assert!(panics(&|| drop(arg_extremum::<f32>(&[], middle, true))), "{middle:?}");
        }
    }
}
