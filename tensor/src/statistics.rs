//! Reductions of tensors: sum, mean, variance, maximum, minimum, norm.

use crate::extremum::{arg_extremum, extremum};
use crate::rows::{at_least_zero, in_units, variance_rows};
use crate::scale::{is_safe, scales};
use crate::{Axes, Indices, Pool, Real, Reduction, Scalar, Shape, Tensor, axis_of, map, mean_to, sum_to};
use std::ops::Range;

/// The variance over the axes whose extent is 1 in `kept`, or with `root` the standard deviation. The sum of squared
/// deviations is divided by the number of elements minus `correction`. It overflows or underflows only if the result
/// does.
///
/// # Panics
/// If `kept` has another number of axes, or does not broadcast to the shape of `x`.
#[track_caller]
pub fn variance_to<T: Scalar>(x: &Tensor<T>, kept: &[usize], correction: f64, root: bool, pool: &Pool<T>) -> Tensor<T> {
    assert_eq!(x.ndim(), kept.len(), "the variance of shape {:?} to {kept:?}", x.shape());
    let count = x.len() as f64 / kept.iter().product::<usize>() as f64;
    let ratio = T::from_f64(count / (count - correction).max(0.0));
    let first = (0..x.ndim()).find(|&axis| x.shape()[axis] != kept[axis]).unwrap_or(x.ndim());
    if kept[first..].iter().all(|&extent| extent == 1) {
        let n = x.shape()[first..].iter().product();
        return pool.filled(kept, |out| variance_rows(x.as_slice(), n, ratio, root, out));
    }
    // As `variance_rows`: deviations from the rounded mean, corrected for its rounding.
    let variance = |x: &Tensor<T>| {
        let deviation = map(
            [x, &mean_to(x, kept, pool)],
            pool,
            #[inline(always)]
            |[x, mean]| x - mean,
        );
        map(
            [&mean_to(&squares(&deviation, pool), kept, pool), &mean_to(&deviation, kept, pool)],
            pool,
            #[inline(always)]
            |[square, rest]| at_least_zero(square - rest * rest),
        )
    };
    let plain = variance(x);
    let finish = |variance: &Tensor<T>, unit: &Tensor<T>| {
        map(
            [variance, unit],
            pool,
            #[inline(always)]
            |[variance, unit]| in_units(variance, ratio, unit, root),
        )
    };
    if plain.iter().all(is_safe) {
        return finish(&plain, &pool.full(&[], T::ONE));
    }
    let [down, unit] = scales(x, kept, pool);
    finish(&variance(&times(x, &down, pool)), &unit)
}

/// The Euclidean norm over the axes whose extent is 1 in `kept`. It overflows or underflows only if the result does.
///
/// # Panics
/// If `kept` does not broadcast to the shape of `x`.
#[track_caller]
pub fn norm_to<T: Scalar>(x: &Tensor<T>, kept: &[usize], pool: &Pool<T>) -> Tensor<T> {
    assert_eq!(kept.len(), x.ndim(), "as many axes as the tensor has");
    let sums = sum_to(&squares(x, pool), kept, pool);
    if sums.iter().all(is_safe) {
        return sums.sqrt();
    }
    let [down, unit] = scales(x, kept, pool);
    map(
        [&sum_to(&squares(&times(x, &down, pool), pool), kept, pool), &unit],
        pool,
        #[inline(always)]
        |[sum, unit]| sum.sqrt() * unit,
    )
}

fn squares<T: Scalar>(x: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
    map(
        [x],
        pool,
        #[inline(always)]
        |[x]| x * x,
    )
}

fn times<T: Scalar>(x: &Tensor<T>, by: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
    map(
        [x, by],
        pool,
        #[inline(always)]
        |[x, by]| x * by,
    )
}

impl<T: Scalar> Tensor<T> {
    /// The sum of all elements. The sum is pairwise.
    pub fn sum(&self) -> T {
        sum_to(self, &[], &self.pool()).item()
    }

    /// The sum over any axes; 0 if there are no elements.
    ///
    /// ```
    /// use raygrad_tensor::{Axes, Tensor};
    /// let x = Tensor::from([[1.0, 2.0], [3.0, 4.0]]);
    /// assert_eq!(x.sum_over(-1), Tensor::from([3.0, 7.0]));
    /// assert_eq!(x.sum_over(Axes::from(0).keepdims()), Tensor::from([[4.0, 6.0]]));
    /// ```
    ///
    /// # Panics
    /// If an axis does not exist or is listed twice.
    #[track_caller]
    pub fn sum_over(&self, axes: impl Into<Axes>) -> Self {
        let axes = axes.into().resolve(self.shape());
        sum_to(self, &axes.kept(), &self.pool()).reshape(&axes.result())
    }

    /// The mean of all elements; NaN for an empty tensor. It overflows only if the mean itself is too large.
    pub fn mean(&self) -> T {
        self.mean_over(..).item()
    }

    /// The mean over any axes; NaN if there are no elements.
    ///
    /// # Panics
    /// If an axis does not exist or is listed twice.
    #[track_caller]
    pub fn mean_over(&self, axes: impl Into<Axes>) -> Self {
        let axes = axes.into().resolve(self.shape());
        mean_to(self, &axes.kept(), &self.pool()).reshape(&axes.result())
    }

    /// The reduced axes as the last one.
    fn rows(&self, axes: &Reduction) -> Self {
        let order: Vec<isize> = axes.reduced_last().iter().map(|&axis| axis as isize).collect();
        self.permute(&order).reshape(&[axes.kept().iter().product(), axes.count()])
    }

    /// The variance over any axes: the sum of squared deviations from the mean, divided by the number of elements minus
    /// `correction`. `correction` is `ddof` in NumPy; 1 gives the unbiased estimate from a sample. NaN if there are no
    /// elements.
    ///
    /// # Panics
    /// If an axis does not exist or is listed twice.
    #[track_caller]
    pub fn var_over(&self, axes: impl Into<Axes>, correction: usize) -> Self {
        let axes = axes.into().resolve(self.shape());
        variance_to(self, &axes.kept(), correction as f64, false, &self.pool()).reshape(&axes.result())
    }

    /// The variance of all elements; see [`var_over`](Self::var_over).
    pub fn var(&self, correction: usize) -> T {
        self.var_over(.., correction).item()
    }

    /// The standard deviation of all elements: the square root of [`var`](Self::var).
    pub fn std(&self, correction: usize) -> T {
        self.std_over(.., correction).item()
    }

    /// The standard deviation over any axes: the square root of [`var_over`](Self::var_over), also where the variance is
    /// out of range.
    ///
    /// # Panics
    /// If an axis does not exist or is listed twice.
    #[track_caller]
    pub fn std_over(&self, axes: impl Into<Axes>, correction: usize) -> Self {
        let axes = axes.into().resolve(self.shape());
        variance_to(self, &axes.kept(), correction as f64, true, &self.pool()).reshape(&axes.result())
    }

    #[track_caller]
    fn extremum_over(&self, axes: Axes, greatest: bool) -> Self {
        let axes = axes.resolve(self.shape());
        let result = axes.result();
        let none = axes.count() == 0 && !result.contains(&0);
        assert!(!none, "the extremum of no elements of a tensor of shape {:?}", self.shape());
        let (x, middle) = match axes.run() {
            Some((first, behind)) => {
                let extent = |axes: Range<usize>| self.shape()[axes].iter().product();
                // A separate view: its packed copy is dropped with it.
                (
                    self.with_layout(self.layout().clone()),
                    [extent(0..first), extent(first..behind), extent(behind..self.ndim())],
                )
            }
            None => {
                let rows = self.rows(&axes);
                let [outer, count] = [0, 1].map(|axis| rows.shape()[axis]);
                (rows, [outer, count, 1])
            }
        };
        self.pool().filled(&result, |out| extremum(x.as_slice(), middle, greatest, out))
    }

    /// The largest elements over any axes; NaN where one is NaN.
    ///
    /// # Panics
    /// If there are no elements, or an axis does not exist or is listed twice.
    #[track_caller]
    pub fn max_over(&self, axes: impl Into<Axes>) -> Self {
        self.extremum_over(axes.into(), true)
    }

    /// The smallest elements over any axes; NaN where one is NaN.
    ///
    /// # Panics
    /// Where [`max_over`](Self::max_over) panics.
    #[track_caller]
    pub fn min_over(&self, axes: impl Into<Axes>) -> Self {
        self.extremum_over(axes.into(), false)
    }

    /// The largest element; NaN if one is NaN.
    ///
    /// # Panics
    /// If the tensor is empty.
    #[track_caller]
    pub fn max(&self) -> T {
        self.max_over(..).item()
    }

    /// The smallest element; NaN if one is NaN.
    ///
    /// # Panics
    /// If the tensor is empty.
    #[track_caller]
    pub fn min(&self) -> T {
        self.min_over(..).item()
    }

    #[track_caller]
    fn arg_over(&self, axis: isize, greatest: bool) -> Indices {
        let axis = axis_of(axis, self.shape());
        let (outer, inner) = (self.shape()[..axis].iter().product(), self.shape()[axis + 1..].iter().product());
        let mut shape = Shape::from_slice(self.shape());
        let count = shape.remove(axis);
        Indices::new(&shape, arg_extremum(self.as_slice(), [outer, count, inner], greatest))
    }

    /// The indices of the largest elements along an axis: the first of equal elements, and the first NaN if there is
    /// one.
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// assert_eq!(Tensor::from([[1.0, 5.0, 5.0], [9.0, 0.0, 3.0]]).argmax(-1), [1, 0]);
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist, or has extent 0 while others do not.
    #[track_caller]
    pub fn argmax(&self, axis: isize) -> Indices {
        self.arg_over(axis, true)
    }

    /// The indices of the smallest elements along an axis; see [`argmax`](Self::argmax).
    ///
    /// # Panics
    /// Where [`argmax`](Self::argmax) panics.
    #[track_caller]
    pub fn argmin(&self, axis: isize) -> Indices {
        self.arg_over(axis, false)
    }

    /// The inner product of two vectors. The sum is pairwise.
    ///
    /// # Panics
    /// If the tensors are not vectors of equal length.
    #[track_caller]
    pub fn dot(&self, other: &Self) -> T {
        let vectors = self.ndim() == 1 && self.shape() == other.shape();
        assert!(vectors, "dot of shapes {:?} and {:?}: not two vectors of one length", self.shape(), other.shape());
        (self * other).sum()
    }

    /// The Euclidean norm of all elements. It overflows only if the norm itself is too large.
    pub fn norm(&self) -> T {
        norm_to(self, &Axes::from(..).resolve(self.shape()).kept(), &self.pool()).item()
    }

    /// The largest absolute difference of two tensors of one shape. It is 0 for empty tensors, and NaN if a difference
    /// is NaN.
    ///
    /// # Panics
    /// If the shapes differ.
    #[track_caller]
    pub fn max_abs_diff(&self, other: &Self) -> T {
        assert_eq!(self.shape(), other.shape(), "the distance of tensors of different shapes");
        if self.is_empty() { T::ZERO } else { self.zip(other, |a, b| Real::abs(a - b)).max() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Axis;

    #[test]
    fn reduction_any_axes_and_views_equals_ndarray() {
        let x = Tensor::<f64>::from_fn(&[3, 4, 5], |i| ((i * 37) % 23) as f64 - 9.5);
        for x in [x.clone(), x.permute(&[2, 0, 1]), x.flip(1).t()] {
            let array = x.view();
            for axis in 0..3 {
                for signed in [axis as isize, axis as isize - 3] {
                    assert!(x.sum_over(signed).allclose(&array.sum_axis(Axis(axis)).into(), 1e-13, 1e-13));
                    assert!(x.mean_over(signed).allclose(&array.mean_axis(Axis(axis)).unwrap().into(), 1e-13, 1e-13));
                    assert!(x.var_over(signed, 0).allclose(&array.var_axis(Axis(axis), 0.0).into(), 1e-13, 0.0));
                    assert!(x.std_over(signed, 1).allclose(&array.std_axis(Axis(axis), 1.0).into(), 1e-13, 0.0));
                    let fold =
                        |start: f64, f: fn(f64, f64) -> f64| array.fold_axis(Axis(axis), start, |&a, &b| f(a, b));
                    assert_eq!(x.max_over(signed), Tensor::from(fold(f64::MIN, f64::max)));
                    assert_eq!(x.min_over(signed), Tensor::from(fold(f64::MAX, f64::min)));
                    let (most, least) = (x.argmax(signed), x.argmin(signed));
                    let lanes = array.lanes(Axis(axis)).into_iter().map(|lane| lane.to_vec());
                    for ((lane, &most), &least) in lanes.zip(most.as_slice()).zip(least.as_slice()) {
                        assert!(
                            lane.iter().enumerate().all(
                                |(i, &y)| y < lane[most as usize] || i >= most as usize && y == lane[most as usize]
                            )
                        );
                        assert!(lane.iter().enumerate().all(
                            |(i, &y)| y > lane[least as usize] || i >= least as usize && y == lane[least as usize]
                        ));
                    }
                }
            }
            assert_eq!((x.sum(), x.max(), x.min()), (array.sum(), 12.5, -9.5));
            assert_eq!(x.mean(), array.sum() / 60.0);
            assert!((x.norm() - array.mapv(|x| x * x).sum().sqrt()).abs() < 1e-12);
            // Several axes are one.
            let middle = x.permute(&[1, 0, 2]).reshape(&[x.shape()[1], x.len() / x.shape()[1]]);
            assert!(x.var_over([0, -1], 1).allclose(&middle.var_over(1, 1), 1e-13, 0.0));
            assert_eq!(x.max_over(Axes::from([2, 0]).keepdims()).to_vec(), middle.max_over(1).to_vec());
            assert!(x.sum_over([0, -1]).allclose(&middle.sum_over(1), 1e-13, 1e-13));
        }
    }

    #[test]
    fn extremes_and_empty_tensors() {
        let huge = Tensor::from([3e200, -4e200]);
        assert!((huge.norm() / 5e200 - 1.0).abs() < 1e-15 && Tensor::<f32>::zeros(&[3]).norm() == 0.0);
        assert!(Tensor::from([1.0, f32::NAN]).max().is_nan() && Tensor::from([f32::NAN]).norm().is_nan());
        let none = Tensor::<f32>::zeros(&[0, 2]);
        assert_eq!((none.sum(), none.norm(), none.sum_over(0).to_vec()), (0.0, 0.0, vec![0.0; 2]));
        assert!(none.mean().is_nan() && none.var_over(0, 0)[[1]].is_nan() && none.max_over(1).is_empty());
        assert!(std::panic::catch_unwind(|| none.max_over(0)).is_err());
        assert_eq!((huge.max_abs_diff(&huge), none.max_abs_diff(&none)), (0.0, 0.0));
        let (zero, far) = (Tensor::from([0.0, 0.0]), Tensor::from([1.0_f32, -3.0]));
        assert_eq!((zero.max_abs_diff(&far), far.max_abs_diff(&zero)), (3.0, 3.0));
        assert!(Tensor::from([f32::NAN, 0.0]).max_abs_diff(&Tensor::from([0.0, 1.0])).is_nan());
    }

    #[test]
    fn numbers_of_all_elements() {
        let x = Tensor::from([[1.0, 4.0], [2.0, 9.0_f64]]);
        assert_eq!((x.var(0), x.var(1)), (9.5, 38.0 / 3.0));
        assert_eq!((x.std(0), x.std(1)), (9.5_f64.sqrt(), (38.0_f64 / 3.0).sqrt()));
        assert_eq!(Tensor::from([1.0, 2.0, 3.0]).dot(&Tensor::from([4.0, -5.0, 6.0])), 12.0);
        assert_eq!((x.max_over(..), x.flip(0).t().max_over(0)), (Tensor::scalar(9.0), Tensor::from([9.0, 4.0])));
        assert!(Tensor::<f32>::zeros(&[0]).var(0).is_nan());
    }

    #[test]
    fn extremes_over_neighbouring_axes() {
        let x = Tensor::from_fn(&[2, 3, 1, 4], |i| ((i * 7) % 24) as f64);
        let of = |keep: &dyn Fn(usize) -> usize, n: usize| {
            let mut greatest = vec![f64::MIN; n];
            x.iter().enumerate().for_each(|(i, x)| greatest[keep(i)] = greatest[keep(i)].max(x));
            greatest
        };
        assert_eq!(x.max_over([0, 1]).to_vec(), of(&|i| i % 4, 4));
        assert_eq!(x.max_over([1, 3]).to_vec(), of(&|i| i / 12, 2));
        assert_eq!(x.max_over([1, 2]).to_vec(), of(&|i| i / 12 * 4 + i % 4, 8));
        assert_eq!(x.max_over([0, 3]).to_vec(), of(&|i| i / 4 % 3, 3));
        let none: [isize; 0] = [];
        assert_eq!(x.max_over(none), x);
        // Enough columns, groups and elements for several tasks.
        for shape in [[1, 700, 330], [900, 30, 11], [4000, 60, 1]] {
            let x = Tensor::<f32>::from_fn(&shape, |i| ((i * 7919) % 230_003) as f32);
            let [outer, count, inner] = shape;
            let least = x.min_over(1);
            for (i, value) in x.max_over(1).iter().enumerate() {
                let column = (0..count).map(|k| x[[i / inner, k, i % inner]]);
                assert_eq!(value, column.clone().fold(f32::MIN, f32::max), "{shape:?} {i}");
                assert_eq!(least[[i / inner, i % inner]], column.fold(f32::MAX, f32::min));
            }
            assert_eq!(least.len(), outer * inner);
        }
    }
}
