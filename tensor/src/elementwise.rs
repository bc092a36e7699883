//! Elementwise loops with NumPy's broadcasting.

use crate::fused::cut;
use crate::{Block, Pool, Scalar, Shape, Tensor, map_fused, simd};

/// The common shape of tensors that broadcast together, with NumPy's rules. Shapes are aligned at their last axis. An
/// axis of extent 1, or a missing one, is repeated to the extent of the others. `None` if two extents disagree.
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

/// Applies `f` to the elements at each index of `N` tensors that broadcast together, in one vectorised pass.
///
/// The loop vectorises if `f` is branch-free and inlined.
///
/// # Panics
/// If the shapes do not broadcast.
#[track_caller]
pub fn map<T: Scalar, const N: usize>(x: [&Tensor<T>; N], pool: &Pool<T>, f: impl Fn([T; N]) -> T + Sync) -> Tensor<T> {
    map_block(&x, pool, &|x, out| lanes::<T, N>(std::array::from_fn(|k| x[k]), out[0], &f))
}

/// [`map`] for a formula that is generic over [`Real`](crate::Real); see [`lanes_real!`](crate::lanes_real).
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
        $crate::map_block(&$x, $pool, &|x, out| $crate::lanes_real!(x, out[0], |$arguments| $formula))
    };
}

/// `out[i] = formula([x[0][i], x[1][i], ..])` with the processor's best instruction set. A formula with a sine or
/// cosine runs with the short argument reduction first. If an argument was too large for that, it runs again with the
/// full reduction (see [`Lane`](crate::Lane)). In most cases it takes a third of the time, and the bits are the same.
#[macro_export]
macro_rules! lanes_real {
    ($x:expr, $out:expr, |$arguments:pat_param| $formula:expr) => {{
        const ANGLES: bool = $crate::has_angle(stringify!($formula));
        let x: &[&[_]] = $x;
        let out: &mut [_] = $out;
        let is_to_be_plain = !ANGLES
            || $crate::lanes_fused::<_, { $crate::QUICK }, 0, _, 1>(
                x,
                &mut [&mut *out],
                #[inline(always)]
                |[], $arguments| [$formula],
            );
        if is_to_be_plain {
            $crate::lanes_fused::<_, { $crate::PLAIN }, 0, _, 1>(
                x,
                &mut [out],
                #[inline(always)]
                |[], $arguments| [$formula],
            );
        }
    }};
}

/// One result of a pass over tensors; see [`map_fused`].
#[doc(hidden)]
#[track_caller]
pub fn map_block<T: Scalar>(x: &[&Tensor<T>], pool: &Pool<T>, block: &Block<'_, T>) -> Tensor<T> {
    let [result] = map_fused(x, [true], pool, block);
    match result {
        Some(result) => result,
        None => unreachable!("it is wanted"),
    }
}

/// `out[i] = f([x[0][i], x[1][i], ..])` with the processor's best instruction set.
///
/// # Panics
/// If a slice is shorter than `out`.
pub fn lanes<T: Scalar, const N: usize>(x: [&[T]; N], out: &mut [T], f: impl Fn([T; N]) -> T) {
    simd::dispatch(
        #[inline(always)]
        || {
            // Cut to one length in here, where the compiler can still drop the bounds checks.
            let n = out.len();
            let x = cut::<T, N>(&x, 0, n);
            for i in 0..n {
                let (mut values, mut k) = ([T::ZERO; N], 0);
                while k < N {
                    values[k] = x[k][i];
                    k += 1;
                }
                out[i] = f(values);
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
    use crate::fused::BLOCK;

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
    fn sine_one_large_angle_in_block_is_reduced() {
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
