//! One loop for every elementwise kernel, with broadcasting as NumPy does it.

use crate::{Lane, Pool, Scalar, Shape, Tensor, map_fused, simd};

/// The common shape of tensors that broadcast together: shapes are aligned at their last axis, and an axis of extent 1
/// (or an absent one) stretches to the extent of the others. `None` if two extents disagree.
///
/// ```
/// use raygrad_tensor::broadcast_shape;
/// assert_eq!(broadcast_shape(&[&[4, 1], &[3]]).unwrap().as_slice(), [4, 3]);
/// assert!(broadcast_shape(&[&[4], &[3]]).is_none());
/// ```
pub fn broadcast_shape(shapes: &[&[usize]]) -> Option<Shape> {
    let ndim = shapes.iter().map(|shape| shape.len()).max().unwrap_or(0);
    let mut out = Shape::from_elem(1, ndim);
    for shape in shapes {
        let lead = ndim - shape.len();
        for (o, &extent) in out[lead..].iter_mut().zip(*shape) {
            match (*o, extent) {
                (_, 1) => {}
                (1, _) => *o = extent,
                (a, b) if a == b => {}
                _ => return None,
            }
        }
    }
    Some(out)
}

/// `f` of the elements at each index of `N` tensors that broadcast together, in one vectorised pass.
///
/// `f` should be branch-free and inlined for the loop to vectorise.
///
/// # Panics
/// If the shapes do not broadcast.
#[track_caller]
pub fn map<T: Scalar, const N: usize>(x: [&Tensor<T>; N], pool: &Pool<T>, f: impl Fn([T; N]) -> T + Sync) -> Tensor<T> {
    map_block(x, pool, |x, out| lanes(x, out, &f))
}

/// As [`map`], for a formula that is read for quick numbers and for plain ones (see [`Lane`]): sines and cosines cost a
/// third that way, and the bits are the same. Both closures have to compute the same; [`map_real!`](crate::map_real)
/// writes the second.
///
/// # Panics
/// If the shapes do not broadcast.
#[track_caller]
pub fn map_either<T: Scalar, const N: usize>(
    x: [&Tensor<T>; N],
    pool: &Pool<T>,
    quick: impl Fn([Lane<T, true>; N]) -> Lane<T, true> + Sync,
    plain: impl Fn([Lane<T, false>; N]) -> Lane<T, false> + Sync,
) -> Tensor<T> {
    map_block(x, pool, |x, out| lanes_either(x, out, &quick, &plain))
}

/// [`map_either`] for a formula that is generic over [`Real`](crate::Real), written once.
///
/// ```
/// use raygrad_tensor::{Pool, Real, Tensor, map_real};
/// let (x, amplitude) = (Tensor::from([0.0, 1e30]), Tensor::scalar(2.0));
/// let y = map_real!([&x, &amplitude], &Pool::none(), |[x, a]| a * x.sin());
/// assert_eq!(y, [0.0, 0.01866293786235165]);
/// ```
#[macro_export]
macro_rules! map_real {
    ($x:expr, $pool:expr, |$arguments:pat_param| $formula:expr) => {
        $crate::map_either(
            $x,
            $pool,
            #[inline(always)]
            |$arguments| $formula,
            #[inline(always)]
            |$arguments| $formula,
        )
    };
}

/// One result of a pass over `N` tensors: see [`map_fused`].
#[track_caller]
fn map_block<T: Scalar, const N: usize>(
    x: [&Tensor<T>; N],
    pool: &Pool<T>,
    block: impl Fn([&[T]; N], &mut [T]) + Sync,
) -> Tensor<T> {
    let [result] = map_fused(&x, [true], pool, &|x, out| block(std::array::from_fn(|k| x[k]), out[0]));
    match result {
        Some(result) => result,
        None => unreachable!("it is wanted"),
    }
}

/// The `n` elements of each slice from `start` on.
#[inline(always)]
fn cut<T, const N: usize>(mut x: [&[T]; N], start: usize, n: usize) -> [&[T]; N] {
    let mut k = 0;
    while k < N {
        x[k] = &x[k][start..][..n];
        k += 1;
    }
    x
}

/// Element `i` of each slice.
#[inline(always)]
fn gather<T: Scalar, const N: usize>(x: &[&[T]; N], i: usize) -> [T; N] {
    let mut values = [T::ZERO; N];
    let mut k = 0;
    while k < N {
        values[k] = x[k][i];
        k += 1;
    }
    values
}

/// [`gather`] into the numbers of [`lanes_either`].
#[inline(always)]
fn gather_lanes<T: Scalar, const N: usize, const QUICK: bool>(x: &[&[T]; N], i: usize) -> [Lane<T, QUICK>; N] {
    let mut values = [Lane::new(T::ZERO); N];
    let mut k = 0;
    while k < N {
        values[k] = Lane::new(x[k][i]);
        k += 1;
    }
    values
}

/// `out[i] = f([x[0][i], x[1][i], ..])` with the best instruction set of the processor.
///
/// # Panics
/// If a slice is shorter than `out`.
pub fn lanes<T: Scalar, const N: usize>(x: [&[T]; N], out: &mut [T], f: impl Fn([T; N]) -> T) {
    simd::dispatch(
        #[inline(always)]
        || {
            // Cut to one length in here, where the compiler can still drop the bounds checks.
            let n = out.len();
            let x = cut(x, 0, n);
            for i in 0..n {
                out[i] = f(gather(&x, i));
            }
        },
    );
}

/// Elements that [`lanes_either`] computes before it looks whether the quick formula held for all of them.
const BLOCK: usize = 1024;

/// `out[i] = plain([x[0][i], x[1][i], ..])`, by way of `quick` where that gives the same: see [`map_either`].
///
/// # Panics
/// If a slice is shorter than `out`.
pub fn lanes_either<T: Scalar, const N: usize>(
    x: [&[T]; N],
    out: &mut [T],
    quick: impl Fn([Lane<T, true>; N]) -> Lane<T, true>,
    plain: impl Fn([Lane<T, false>; N]) -> Lane<T, false>,
) {
    simd::dispatch(
        #[inline(always)]
        || {
            let mut start = 0;
            for out in out.chunks_mut(BLOCK) {
                let n = out.len();
                let x = cut(x, start, n);
                let mut outside = T::Flags::default();
                for i in 0..n {
                    let (value, flags) = quick(gather_lanes(&x, i)).parts();
                    out[i] = value;
                    outside = outside | flags;
                }
                if T::is_set(outside) {
                    for i in 0..n {
                        out[i] = plain(gather_lanes(&x, i)).parts().0;
                    }
                }
                start += n;
            }
        },
    );
}

/// `a += b`, elementwise.
///
/// # Panics
/// If the lengths differ.
pub fn add_assign<T: Scalar>(a: &mut [T], b: &[T]) {
    assert_eq!(a.len(), b.len(), "add_assign of slices of different lengths");
    simd::dispatch(
        #[inline(always)]
        || {
            for (a, &b) in a.iter_mut().zip(b) {
                *a += b;
            }
        },
    );
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Real;

    #[test]
    fn broadcasting_follows_numpy() {
        let pool = Pool::new();
        let column = Tensor::from_vec(&[2, 1], vec![10.0, 20.0_f64]);
        let row = Tensor::from_vec(&[3], vec![1.0, 2.0, 3.0]);
        let sum = map([&column, &row], &pool, |[a, b]| a + b);
        assert_eq!(sum.shape(), [2, 3]);
        assert_eq!(sum.as_slice(), [11.0, 12.0, 13.0, 21.0, 22.0, 23.0]);
        let empty = Tensor::zeros(&[0, 1]);
        assert_eq!(map([&empty, &row], &pool, |[a, b]| a * b).shape(), [0, 3]);
    }

    #[test]
    fn one_large_angle_in_a_block_is_reduced_as_it_must_be() {
        fn check<T: Scalar>(large: f64) {
            let mut x = vec![T::from_f64(0.7); 3 * BLOCK];
            for i in [5, BLOCK, 3 * BLOCK - 1] {
                x[i] = T::from_f64(large);
            }
            let x = Tensor::from_vec(&[x.len()], x);
            let half = Tensor::scalar(T::from_f64(0.5));
            // The angle is an intermediate result, and the last operation is not the sine.
            let y = crate::map_real!([&x, &half], &Pool::none(), |[x, h]| (x * x).sin() + h.cos());
            for (&x, &y) in x.as_slice().iter().zip(y.as_slice()) {
                assert_eq!(y, Real::sin(x * x) + Real::cos(T::from_f64(0.5)));
            }
        }
        check::<f32>(1e9);
        check::<f64>(1e100);
    }

    #[test]
    #[should_panic(expected = "do not broadcast")]
    fn shapes_that_disagree_panic() {
        map([&Tensor::<f32>::zeros(&[2]), &Tensor::zeros(&[3])], &Pool::none(), |[a, b]| a + b);
    }
}
