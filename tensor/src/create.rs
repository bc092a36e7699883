//! Tensors from ranges, lists and other tensors.

use crate::{Indices, Pool, Scalar, Shape, Tensor};

/// Joins tensors along an axis.
///
/// # Panics
/// If there are none, the axis does not exist, other extents differ, or the sum of the extents is too large.
#[track_caller]
pub fn concat<T: Scalar>(parts: &[&Tensor<T>], axis: usize, pool: &Pool<T>) -> Tensor<T> {
    let Some(first) = parts.first() else { panic!("concat of no tensors") };
    let mut shape = Shape::from_slice(first.shape());
    assert!(axis < shape.len(), "concat along axis {axis} of a tensor of shape {shape:?}");
    for part in &parts[1..] {
        let same = |i: usize| i == axis || part.shape()[i] == shape[i];
        let fits = part.ndim() == shape.len() && (0..shape.len()).all(same);
        assert!(fits, "concat of shapes {:?} and {:?} along axis {axis}", first.shape(), part.shape());
    }
    let extent = parts.iter().try_fold(0_usize, |sum, part| sum.checked_add(part.shape()[axis]));
    let Some(extent) = extent else { panic!("concat along axis {axis} to a tensor that is too large") };
    shape[axis] = extent;
    pool.filled(&shape, |out| {
        let run = |shape: &[usize]| shape[axis..].iter().product::<usize>();
        let (total, mut start) = (run(&shape), 0);
        for part in parts {
            let count = run(part.shape());
            if count > 0 {
                for (out, part) in out.chunks_exact_mut(total).zip(part.as_slice().chunks_exact(count)) {
                    out[start..start + count].copy_from_slice(part);
                }
            }
            start += count;
        }
    })
}

impl<T: Scalar> Tensor<T> {
    /// The numbers `start + i step` for i = 0, 1, ... that are below `end`, or above it if `step` is negative
    /// (`numpy.arange`). They are computed in f64 and rounded to this type, so `end` itself is never an element.
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// assert_eq!(Tensor::arange(0.0, 1.0, 0.25), Tensor::from([0.0, 0.25, 0.5, 0.75]));
    /// assert_eq!(Tensor::arange(3.0_f32, 0.0, -1.0), Tensor::from([3.0, 2.0, 1.0]));
    /// ```
    ///
    /// # Panics
    /// If the step is 0, one of the numbers is not finite, or the result has more elements than memory can hold.
    #[track_caller]
    pub fn arange(start: T, end: T, step: T) -> Self {
        let (first, by) = (start.to_f64(), step.to_f64());
        let most = ((end.to_f64() - first) / by).ceil();
        assert!(most.is_finite() && by.is_finite(), "arange from {start} to {end} by {step}");
        let at = |i: usize| T::from_f64(first + i as f64 * by);
        // The last numbers may round to the end, and the quotient to less than their number.
        let (mut count, mut rest) = (0, (most + 1.0).max(0.0) as usize);
        while rest > 0 {
            let half = rest / 2;
            let is_element = if by > 0.0 { at(count + half) < end } else { at(count + half) > end };
            (count, rest) = if is_element { (count + half + 1, rest - half - 1) } else { (count, half) };
        }
        Tensor::from_fn(&[count], at)
    }

    /// `count` equally spaced numbers from `start` to `end`, both included (`numpy.linspace`). For `count` 1 it is
    /// `start` alone.
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// assert_eq!(Tensor::linspace(0.0_f32, 1.0, 3), Tensor::from([0.0, 0.5, 1.0]));
    /// assert_eq!(Tensor::linspace(-1e308_f64, 1e308, 3), Tensor::from([-1e308, 0.0, 1e308]));
    /// ```
    pub fn linspace(start: T, end: T, count: usize) -> Self {
        let (first, last, most) = (start.to_f64(), end.to_f64(), count.saturating_sub(1).max(1) as f64);
        let step = last - first;
        // From the nearer end, so that both are exact and numbers never turn back.
        let at = |i: usize| {
            let (part, rest) = (i as f64 / most, (most - i as f64) / most);
            match (step.is_finite(), part <= 0.5) {
                (true, true) => first + step * part,
                (true, false) => last - step * rest,
                // Of both ends, as their difference overflows.
                (false, true) => first * (1.0 - part) + last * part,
                (false, false) => last * (1.0 - rest) + first * rest,
            }
        };
        Tensor::from_fn(&[count], |i| match i {
            0 => start,
            i if i + 1 == count => end,
            i => T::from_f64(at(i)),
        })
    }

    /// The identity matrix `[n, n]`.
    ///
    /// # Panics
    /// If it has more elements than memory can hold.
    #[track_caller]
    pub fn eye(n: usize) -> Self {
        let mut out = Tensor::zeros(&[n, n]);
        out.as_mut_slice().iter_mut().step_by(n + 1).for_each(|x| *x = T::ONE);
        out
    }

    /// Joins tensors along `axis`.
    ///
    /// # Panics
    /// If there are none, the axis does not exist, other extents differ, or the sum of the extents is too large.
    #[track_caller]
    pub fn concat(parts: &[&Self], axis: isize) -> Self {
        let Some(first) = parts.first() else { panic!("concat of no tensors") };
        concat(parts, crate::axis_of(axis, first.shape()), &first.pool())
    }

    /// Joins tensors of one shape along a new axis at position `axis`.
    ///
    /// # Panics
    /// If there are none, their shapes differ, or there is no such position.
    #[track_caller]
    pub fn stack(parts: &[&Self], axis: isize) -> Self {
        let Some(first) = parts.first() else { panic!("stack of no tensors") };
        for part in parts {
            assert_eq!(part.shape(), first.shape(), "stack of tensors of different shapes");
        }
        let parts: Vec<_> = parts.iter().map(|part| part.unsqueeze(axis)).collect();
        Tensor::concat(&parts.iter().collect::<Vec<_>>(), axis)
    }
}

impl<T: Scalar> From<Vec<T>> for Tensor<T> {
    /// A vector.
    fn from(values: Vec<T>) -> Self {
        Tensor::from_vec(&[values.len()], values)
    }
}

impl<T: Scalar> From<&[T]> for Tensor<T> {
    /// A vector of copies.
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// let rows = vec![1.0, 2.0, 3.0, 4.0];
    /// assert_eq!(Tensor::from(&rows[1..3]), [2.0, 3.0]);
    /// assert_eq!(Tensor::from(&rows).shape(), [4]);
    /// assert_eq!(Tensor::from([[[1.0], [2.0]]]).shape(), [1, 2, 1]);
    /// ```
    fn from(values: &[T]) -> Self {
        Tensor::from(values.to_vec())
    }
}

impl<T: Scalar> From<&Vec<T>> for Tensor<T> {
    /// A vector of copies.
    fn from(values: &Vec<T>) -> Self {
        Tensor::from(values.clone())
    }
}

impl<T: Scalar, const N: usize> From<[T; N]> for Tensor<T> {
    /// A vector.
    fn from(values: [T; N]) -> Self {
        Tensor::from(values.to_vec())
    }
}

impl<T: Scalar, const N: usize, const M: usize> From<[[T; M]; N]> for Tensor<T> {
    /// A matrix of these rows.
    fn from(rows: [[T; M]; N]) -> Self {
        Tensor::from_vec(&[N, M], rows.as_flattened().to_vec())
    }
}

impl<T: Scalar, const N: usize, const M: usize, const K: usize> From<[[[T; K]; M]; N]> for Tensor<T> {
    /// A tensor of three axes: matrices of rows.
    fn from(matrices: [[[T; K]; M]; N]) -> Self {
        Tensor::from_vec(&[N, M, K], matrices.as_flattened().as_flattened().to_vec())
    }
}

impl<T: Scalar> From<&Tensor<T>> for Tensor<T> {
    /// Clones the tensor, which copies a reference.
    fn from(x: &Tensor<T>) -> Self {
        x.clone()
    }
}

impl<T: Scalar> FromIterator<T> for Tensor<T> {
    /// A vector.
    fn from_iter<I: IntoIterator<Item = T>>(values: I) -> Self {
        Tensor::from(values.into_iter().collect::<Vec<T>>())
    }
}

impl<T: Scalar> From<&Indices> for Tensor<T> {
    /// The indices as numbers. In f32, indices above 2^24 are rounded to nearest.
    fn from(indices: &Indices) -> Self {
        Tensor::from_vec(indices.shape(), indices.as_slice().iter().map(|&i| T::from_f64(f64::from(i))).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::s;

    #[test]
    fn linspace_stays_between_its_ends_and_never_turns_back() {
        for (start, end) in
            [(0.1, 0.1), (0.3, 0.3), (0.1, 0.1 + f64::EPSILON), (0.7, -0.1), (-1e308, 1.7e308), (1.0, 2.0)]
        {
            for count in 2..60 {
                let all = Tensor::linspace(start, end, count).to_vec();
                let turns = all.windows(2).any(|pair| if start <= end { pair[0] > pair[1] } else { pair[0] < pair[1] });
                assert!(!turns && all[0] == start && all[count - 1] == end, "{start} {end} {all:?}");
            }
        }
        assert_eq!(Tensor::linspace(0.0, f64::INFINITY, 1), Tensor::from([0.0]));
    }

    #[test]
    #[should_panic(expected = "concat along axis 0 to a tensor that is too large")]
    fn concat_extents_that_wrap_panic() {
        // Three times this is 2^63 - 3 in 64 bits.
        let long = Tensor::<f32>::zeros(&[usize::MAX / 2, 0]);
        Tensor::concat(&[&long, &long, &long], 0);
    }

    #[test]
    fn rules_give_what_numpy_gives() {
        assert_eq!(Tensor::arange(0.0_f64, 0.95, 0.1).len(), 10);
        assert_eq!(Tensor::arange(1.0_f32, 1.0, 2.0).len(), 0);
        assert_eq!(Tensor::arange(5.0_f32, 1.0, 2.0).len(), 0);
        assert_eq!(Tensor::arange(0.0_f32, 0.3, 0.1).to_vec(), [0.0, 0.1, 0.2]);
        assert_eq!(Tensor::arange(1.0_f32, 0.1, -0.3).len(), 3);
        // All numbers before the end are there, and none beyond it.
        for (i, j) in (0..40_u8).flat_map(|i| (1..30).map(move |j| (i, i + j))) {
            for sign in [1.0_f32, -1.0] {
                let [start, end] = [i, j].map(|tenths| sign * f32::from(tenths) / 10.0);
                let x = Tensor::arange(start, end, 0.1 * sign);
                let next = (f64::from(start) + x.len() as f64 * f64::from(0.1 * sign)) as f32;
                assert!(x.iter().all(|x| sign * x < sign * end) && sign * next >= sign * end, "{start} {end}: {x:?}");
                let [start, end] = [i, j].map(|tenths| f64::from(sign) * f64::from(tenths) / 10.0);
                let step = 0.15 * f64::from(sign);
                let x = Tensor::arange(start, end, step);
                let next = start + x.len() as f64 * step;
                let sign = f64::from(sign);
                assert!(x.iter().all(|x| sign * x < sign * end) && sign * next >= sign * end, "{start} {end}: {x:?}");
            }
        }
        assert_eq!(Tensor::arange(-3.0, 0.6, 0.15).len(), 25, "the last is 0.5999999999999996");
        // Steps below the rounding of the end.
        let x = Tensor::arange(1.0_f32, 1.0 + f32::EPSILON, 1e-8);
        assert!(x.len() == 6 && x.iter().all(|x| x == 1.0), "{x:?}");
        let grid = Tensor::linspace(-0.1_f32, 0.3, 11);
        assert_eq!((grid[[0]], grid[[10]]), (-0.1, 0.3));
        assert!(grid.as_slice().is_sorted());
        assert_eq!(Tensor::linspace(2.0_f64, 9.0, 1).to_vec(), [2.0]);
        assert_eq!(Tensor::linspace(2.0_f64, 9.0, 0).len(), 0);
        assert_eq!(Tensor::<f32>::eye(2), Tensor::from([[1.0, 0.0], [0.0, 1.0]]));
        assert!(std::panic::catch_unwind(|| Tensor::arange(0.0, 1.0, 0.0_f32)).is_err());
        assert!(std::panic::catch_unwind(|| Tensor::arange(0.0, f32::NAN, 1.0)).is_err());
    }

    #[test]
    fn parts_come_together_from_views_too() {
        let x = Tensor::<f64>::arange(0.0, 6.0, 1.0).reshape(&[2, 3]);
        let both = Tensor::concat(&[&x, &x.slice(s![.., ..;-1])], -1);
        assert_eq!(both, Tensor::from([[0.0, 1.0, 2.0, 2.0, 1.0, 0.0], [3.0, 4.0, 5.0, 5.0, 4.0, 3.0]]));
        assert_eq!(Tensor::concat(&[&x, &x.slice(s![..0])], 0), x);
        let pile = Tensor::stack(&[&x.t(), &x.t().flip(0)], 0);
        assert_eq!((pile.shape(), pile[[1, 0, 1]]), (&[2, 3, 2][..], 5.0));
        assert_eq!(Tensor::stack(&[&x, &x], -1).slice(s![.., .., 1]), x);
        assert!(std::panic::catch_unwind(|| Tensor::concat(&[&x, &x.t()], 0)).is_err());
    }
}
