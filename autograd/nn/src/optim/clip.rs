//! Gradient clipping.

use super::limits::{by_type, flushed};
use super::memory::CHUNK;
use raygrad_autograd::{Gradient, RowGrad, RowSums};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, simd};
use std::sync::Arc;

/// The result of [`clip_norm`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Clipped {
    /// The common norm of all finite elements before clipping.
    pub norm: f64,
    /// The factor of all finite elements: 1 if the norm was within its bound.
    pub factor: f64,
    /// Number of elements that are infinite or NaN, which are not changed.
    pub bad: usize,
}

/// Limits every element to `-bound..=bound`, and returns the number of changed elements
/// (`torch.nn.utils.clip_grad_value_`).
///
/// Infinite elements and NaN stay unchanged. Optimizers skip and count elements with such a gradient; a full step in
/// the direction of an overflow would be a guess. Sparse contributions are summed first, as for [`clip_norm`].
///
/// # Panics
/// If `bound` is neither 0 nor at least 1e-30 (1e-300 in f64).
#[track_caller]
pub fn clip_value<T: Scalar>(grads: &mut [Gradient<T>], bound: f64) -> usize {
    check_bound::<T>("gradients", bound);
    with_values(grads, |values| limit_values(values, T::from_f64(bound)))
}

/// The common Euclidean norm of all finite elements, and the number of other elements.
///
/// Elements are scaled by the largest one, and squares are added in f64. So the sum overflows or underflows only if the
/// norm does.
pub fn global_norm<T: Scalar>(grads: &[Gradient<T>]) -> (f64, usize) {
    let (largest, sum, bad) = with_values(&mut grads.to_vec(), |values| parts(values));
    (largest * sum.sqrt(), bad)
}

/// Gradient clipping by norm: scales all gradients so that their common norm is at most `bound` (Pascanu, Mikolov and
/// Bengio 2013, algorithm 1; `torch.nn.utils.clip_grad_norm_` without its 1e-6).
///
/// The norm is that of the finite elements. Infinite elements and NaN stay unchanged, so that one bad element neither
/// zeroes all others nor is hidden. Optimizers skip and count elements with such a gradient. Products below 1e-30
/// (1e-300 in f64) become 0.
///
/// The norm of a sum is not that of its contributions, so these are summed first. A gradient of rows then has each row
/// once; a gradient with other contributions is dense.
///
/// ```
/// use raygrad_autograd::{Gradient, Tensor};
/// use raygrad_nn::clip_norm;
/// let values = [Tensor::from([3.0, f64::NAN]), Tensor::scalar(4.0)];
/// let mut grads = values.map(Gradient::from);
/// let clipped = clip_norm(&mut grads, 1.0);
/// assert_eq!((clipped.norm, clipped.factor, clipped.bad), (5.0, 0.2, 1));
/// assert!((grads[1].dense().unwrap().item() - 0.8).abs() < 1e-15);
/// ```
///
/// # Panics
/// If `bound` is neither 0 nor at least 1e-30 (1e-300 in f64).
#[track_caller]
pub fn clip_norm<T: Scalar>(grads: &mut [Gradient<T>], bound: f64) -> Clipped {
    check_bound::<T>("a norm", bound);
    with_values(grads, |values| limit_norm(values, bound))
}

#[track_caller]
fn check_bound<T: Scalar>(what: &str, bound: f64) {
    let least = by_type::<T>(1e-30, 1e-300);
    assert!(bound == 0.0 || bound >= least, "{what} limited to {bound:e}; use 0, or at least {least:e} in {}", T::NAME);
}

/// Runs `f` on the values of all gradients. Each is one dense tensor, or rows with each index once.
fn with_values<T: Scalar, R>(grads: &mut [Gradient<T>], f: impl FnOnce(&mut [Tensor<T>]) -> R) -> R {
    let (mut forms, mut values) = (vec![], vec![]);
    for (place, grad) in grads.iter_mut().enumerate().filter(|(_, grad)| !grad.is_zero()) {
        let shape = Shape::from_slice(grad.shape());
        let whole = std::mem::replace(grad, Gradient::zero(&shape));
        let len: usize = shape.iter().product();
        let (index, value) = if whole.is_dense() || len == 0 || !whole.is_rows() {
            (None, whole.into_dense(&Pool::none()))
        } else {
            let mut sums = RowSums::new(shape[0], len / shape[0]);
            whole.scatter(&mut sums);
            let mut rows = shape;
            rows[0] = sums.rows().len();
            (Some(Arc::from(sums.rows())), Tensor::from_vec(&rows, sums.sums().to_vec()))
        };
        forms.push((place, index));
        values.push(value);
    }
    let result = f(&mut values);
    for ((place, index), value) in forms.into_iter().zip(values) {
        match index {
            None => grads[place].add_dense(value),
            Some(index) => {
                let rows = RowGrad::new(grads[place].shape(), index, value);
                grads[place].add_sparse(Arc::new(rows));
            }
        }
    }
    result
}

fn limit_values<T: Scalar>(values: &mut [Tensor<T>], bound: T) -> usize {
    let clip = |x: &mut [T]| {
        simd::dispatch(
            #[inline(always)]
            || {
                let mut changed = 0;
                for x in x.iter_mut() {
                    let clipped = if *x > bound { bound } else { *x };
                    let clipped = if clipped < -bound { -bound } else { clipped };
                    let out = x.is_finite() && clipped != *x;
                    *x = if out { clipped } else { *x };
                    changed += usize::from(out);
                }
                changed
            },
        )
    };
    values.iter_mut().map(|value| clip(value.as_mut_slice())).sum()
}

fn limit_norm<T: Scalar>(values: &mut [Tensor<T>], bound: f64) -> Clipped {
    let (largest, sum, bad) = parts(values);
    let norm = largest * sum.sqrt();
    if norm <= bound {
        return Clipped { norm, factor: 1.0, bad };
    }
    // Not `bound / norm`, since the norm itself may be too large for an f64. The factor may be too small for the type
    // where no product is: it is applied as a power of two near its root, which rounds nothing, and the rest.
    let root = sum.sqrt();
    let power = ((bound.log2() - largest.log2() - root.log2()) / 2.0).max(-1020.0) as i32;
    let power = 2.0_f64.powi(power.min(0));
    for value in values {
        scale(value.as_mut_slice(), [power, bound / power / root / largest]);
    }
    Clipped { norm, factor: bound / largest / root, bad }
}

/// The largest finite magnitude, the sum of squares of all finite elements divided by it, and the number of other
/// elements.
fn parts<T: Scalar>(grads: &[Tensor<T>]) -> (f64, f64, usize) {
    let (mut largest, mut bad) = (T::ZERO, 0);
    for grad in grads {
        let (top, others) = extent(grad.as_slice());
        largest = if top > largest { top } else { largest };
        bad += others;
    }
    let largest = largest.to_f64();
    // Sums of sums, so that rounding errors do not add up over all elements.
    let chunks = grads.iter().flat_map(|grad| grad.as_slice().chunks(CHUNK));
    let sum = if largest > 0.0 { chunks.map(|chunk| squares(chunk, largest)).sum() } else { 0.0 };
    (largest, sum, bad)
}

/// The largest finite magnitude, and the number of elements that are not finite.
fn extent<T: Scalar>(x: &[T]) -> (T, usize) {
    simd::dispatch(
        #[inline(always)]
        || {
            let (mut top, mut bad) = (T::ZERO, 0);
            for &x in x {
                let magnitude = if x < T::ZERO { -x } else { x };
                let good = x.is_finite();
                top = if good && magnitude > top { magnitude } else { top };
                bad += usize::from(!good);
            }
            (top, bad)
        },
    )
}

/// The sum of `(x / largest)^2` over the finite elements, in eight interleaved sums.
fn squares<T: Scalar>(x: &[T], largest: f64) -> f64 {
    simd::dispatch(
        #[inline(always)]
        || {
            let mut sums = [0.0; 8];
            let (body, rest) = x.as_chunks::<8>();
            for chunk in body {
                for k in 0..8 {
                    sums[k] += square(chunk[k], largest);
                }
            }
            for (k, &x) in rest.iter().enumerate() {
                sums[k] += square(x, largest);
            }
            sums.iter().sum()
        },
    )
}

#[inline(always)]
fn square<T: Scalar>(x: T, largest: f64) -> f64 {
    let x = if x.is_finite() { x.to_f64() / largest } else { 0.0 };
    x * x
}

fn scale<T: Scalar>(x: &mut [T], factors: [f64; 2]) {
    let [power, factor] = factors.map(T::from_f64);
    simd::dispatch(
        #[inline(always)]
        || {
            for x in x.iter_mut() {
                *x = if x.is_finite() { flushed(*x * power * factor) } else { *x };
            }
        },
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    fn norm<T: Scalar>(values: &[Tensor<T>]) -> f64 {
        let (largest, sum, _) = parts(values);
        largest * sum.sqrt()
    }

    #[test]
    fn shares_of_a_gradient_count_by_their_sum() {
        let rows = |places: &[u32], values: &[f64]| {
            Arc::new(RowGrad::new(&[4, 1], places.into(), Tensor::from_vec(&[places.len(), 1], values.to_vec())))
        };
        let mut table = Gradient::zero(&[4, 1]);
        table.add_sparse(rows(&[2, 0, 2], &[1.0, 4.0, 3.0]));
        table.add_sparse(rows(&[0], &[-1.0]));
        let mut mixed = table.clone();
        mixed.add_dense(Tensor::from_vec(&[4, 1], vec![-3.0, 0.0, -4.0, 12.0]));
        let nothing = Gradient::zero(&[3]);
        let mut grads = [table, mixed, nothing];
        assert_eq!(global_norm(&grads), (13.0, 0));
        assert_eq!(clip_norm(&mut grads, 6.5), Clipped { norm: 13.0, factor: 0.5, bad: 0 });
        assert_eq!(grads.each_ref().map(Gradient::is_rows), [true, false, true]);
        assert!(grads[0].sparse().len() == 1 && grads[2].is_zero());
        let dense = |grad: &Gradient<f64>| grad.clone().into_dense(&Pool::none()).as_slice().to_vec();
        assert_eq!(dense(&grads[0]), [1.5, 0.0, 2.0, 0.0]);
        assert_eq!(dense(&grads[1]), [0.0, 0.0, 0.0, 6.0]);
        assert_eq!(clip_value(&mut grads, 1.75), 2);
        assert_eq!((dense(&grads[0]), dense(&grads[1])), (vec![1.5, 0.0, 1.75, 0.0], vec![0.0, 0.0, 0.0, 1.75]));
    }

    #[test]
    fn values_are_limited_and_bad_ones_stay() {
        let values = [0.5, -3.0, 2.0, f32::INFINITY, f32::NEG_INFINITY, f32::NAN, 1e30, -1.0];
        let mut grads = [Tensor::from_vec(&[8], values.to_vec()), Tensor::zeros(&[0])];
        assert_eq!(limit_values(&mut grads, 1.0), 3);
        let bits: Vec<_> = grads[0].as_slice().iter().map(|x| x.to_bits()).collect();
        let expected = [0.5, -1.0, 1.0, f32::INFINITY, f32::NEG_INFINITY, f32::NAN, 1.0, -1.0];
        assert_eq!(bits, expected.map(f32::to_bits));
        assert_eq!(limit_values(&mut grads, 0.0), 5, "everything finite becomes 0");
    }

    #[test]
    fn the_norm_is_that_of_all_tensors_together() {
        let make = || [Tensor::from_fn(&[1001], |i| (i as f32 * 0.37).sin()), Tensor::scalar(-7.0_f32)];
        let mut grads = make();
        let exact = make().iter().flat_map(|x| x.as_slice().to_vec()).map(|x| f64::from(x).powi(2)).sum::<f64>().sqrt();
        let clipped = limit_norm(&mut grads, 2.0);
        assert!((clipped.norm / exact - 1.0).abs() < 1e-14 && clipped.bad == 0);
        assert!((clipped.factor * exact / 2.0 - 1.0).abs() < 1e-14);
        for (got, x) in
            grads.iter().zip(make()).flat_map(|(a, b)| a.as_slice().to_vec().into_iter().zip(b.as_slice().to_vec()))
        {
            assert!((f64::from(got) - f64::from(x) * clipped.factor).abs() <= 1e-6 * f64::from(x).abs());
        }
        assert!((norm(&grads) - 2.0).abs() < 1e-6);
        // Within the bound nothing moves, not even by rounding.
        let mut grads = make();
        assert_eq!(limit_norm(&mut grads, exact + 1e-6).factor, 1.0);
        assert_eq!(grads, make());
    }

    #[test]
    fn global_norm_survives_overflow_nan_and_zeros() {
        let mut grads = [Tensor::from_vec(&[4], vec![f64::MAX, -f64::MAX, f64::MAX, f64::INFINITY])];
        let clipped = limit_norm(&mut grads, 3.0_f64.sqrt());
        assert_eq!((clipped.norm, clipped.bad), (f64::INFINITY, 1));
        assert!(grads[0].as_slice()[..3].iter().all(|x| (x.abs() - 1.0).abs() < 1e-14), "{grads:?}");
        assert_eq!(grads[0].as_slice()[3], f64::INFINITY);
        let mut tiny = [Tensor::from_vec(&[2], vec![3e-200, 4e-200])];
        assert!((norm(&tiny) / 5e-200 - 1.0).abs() < 1e-14);
        assert_eq!(limit_norm(&mut tiny, 1.0).factor, 1.0);
        for mut empty in
            [vec![], vec![Tensor::zeros(&[0, 2])], vec![Tensor::zeros(&[3])], vec![Tensor::scalar(f64::NAN)]]
        {
            let before = empty.clone();
            let clipped = limit_norm(&mut empty, 0.0);
            assert_eq!((clipped.norm, clipped.factor), (0.0, 1.0), "{before:?}");
        }
        let mut uneven = [Tensor::from_vec(&[2], vec![1e10_f32, 1e-25])];
        limit_norm(&mut uneven, 1.0);
        assert_eq!(uneven[0].as_slice(), [1.0, 0.0], "no denormals");
        let power = |exponent| 2.0_f64.powi(exponent);
        let mut uneven = [Tensor::from_vec(&[3], [40, -100, -990].map(power).to_vec())];
        limit_norm(&mut uneven, 1.0);
        assert_eq!(uneven[0].as_slice(), [1.0, power(-140), 0.0], "f64 holds more");
    }
}
