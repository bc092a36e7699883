//! Integer arrays: indices for gathering, and the results of sorting and searching.

use crate::{Scalar, Shape, Tensor, axis_of, checked_len};
use std::cmp::Ordering;
use std::fmt;
use std::sync::Arc;

/// An array of `u32` indices in row-major order: positions along an axis, or classes. Cloning copies a reference.
#[derive(Clone, PartialEq, Eq)]
pub struct Indices {
    shape: Shape,
    values: Arc<[u32]>,
}

impl From<Arc<[u32]>> for Indices {
    fn from(values: Arc<[u32]>) -> Self {
        Indices { shape: Shape::from_slice(&[values.len()]), values }
    }
}

macro_rules! from {
    ($(<$(const $n:ident: usize)?> $list:ty;)+) => {
        $(
            impl<$(const $n: usize)?> From<$list> for Indices {
                /// A vector of indices.
                fn from(values: $list) -> Self {
                    Indices::from(Arc::<[u32]>::from(values))
                }
            }
        )+
    };
}

from! { <> Vec<u32>; <> &[u32]; <const N: usize> [u32; N]; }

impl<const N: usize> From<&[u32; N]> for Indices {
    /// A vector of indices.
    fn from(values: &[u32; N]) -> Self {
        Indices::from(&values[..])
    }
}

impl From<&Vec<u32>> for Indices {
    /// A vector of indices.
    fn from(values: &Vec<u32>) -> Self {
        Indices::from(&values[..])
    }
}

impl From<&Arc<[u32]>> for Indices {
    /// A vector of indices, without a copy.
    fn from(values: &Arc<[u32]>) -> Self {
        Indices::from(values.clone())
    }
}

impl From<&Indices> for Indices {
    fn from(indices: &Indices) -> Self {
        indices.clone()
    }
}

impl Indices {
    /// Indices of this shape, from values in row-major order.
    ///
    /// # Panics
    /// If the number of values is not the product of the shape.
    #[track_caller]
    pub fn new(shape: &[usize], values: impl Into<Arc<[u32]>>) -> Self {
        let values = values.into();
        let fits = checked_len(shape) == Some(values.len());
        assert!(fits, "{} values for indices of shape {shape:?}", values.len());
        Indices { shape: Shape::from_slice(shape), values }
    }

    /// The extent of each axis.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The values in row-major order.
    pub fn as_slice(&self) -> &[u32] {
        &self.values
    }

    /// The values in row-major order, as a shared slice.
    pub fn values(&self) -> &Arc<[u32]> {
        &self.values
    }

    /// One-hot vectors `[.., classes]`: 1 at each index, 0 elsewhere.
    ///
    /// ```
    /// use raygrad_tensor::{Indices, Tensor};
    /// let labels = Indices::new(&[2], [2, 0]);
    /// assert_eq!(labels.one_hot::<f32>(3), Tensor::from_vec(&[2, 3], vec![0.0, 0.0, 1.0, 1.0, 0.0, 0.0]));
    /// ```
    ///
    /// # Panics
    /// If an index is not below `classes`.
    #[track_caller]
    pub fn one_hot<T: Scalar>(&self, classes: usize) -> Tensor<T> {
        let mut shape = self.shape.clone();
        shape.push(classes);
        let mut out = Tensor::zeros(&shape);
        let values = out.as_mut_slice();
        for (i, &index) in self.values.iter().enumerate() {
            assert!((index as usize) < classes, "one_hot: index {i} is {index}, but there are {classes} classes");
            values[i * classes + index as usize] = T::ONE;
        }
        out
    }
}

impl<const N: usize> PartialEq<[u32; N]> for Indices {
    /// Whether this is a vector of these numbers.
    fn eq(&self, other: &[u32; N]) -> bool {
        self.shape() == [N] && self.as_slice() == other
    }
}

impl fmt::Debug for Indices {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Indices{:?} {:?}", self.shape, self.values)
    }
}

/// The sort order of numbers: NaN after all others, -0 and +0 equal.
fn order<T: Scalar>(a: &T, b: &T) -> Ordering {
    // Only a NaN is not comparable with itself.
    let nan = |x: &T| x.partial_cmp(x).is_none();
    a.partial_cmp(b).unwrap_or_else(|| nan(a).cmp(&nan(b)))
}

/// A position along an axis as an index.
#[track_caller]
pub(crate) fn index(i: usize) -> u32 {
    u32::try_from(i).unwrap_or_else(|_| panic!("an axis of more than 2^32 entries cannot be indexed"))
}

impl<T: Scalar> Tensor<T> {
    /// The indices that sort the elements along `axis`: entry `k` is the position of the element that sorting puts at
    /// `k`.
    ///
    /// Equal elements keep their order (the sort is stable), ascending or `descending`. NaN counts as larger than every
    /// number: it comes last in ascending order and first in descending order.
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// let x = Tensor::from([3.0, 1.0, 3.0, 2.0_f32]);
    /// assert_eq!(x.argsort(0, false), [1, 3, 0, 2]);
    /// assert_eq!(x.argsort(0, true), [0, 2, 3, 1]);
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn argsort(&self, axis: isize, descending: bool) -> Indices {
        let axis = axis_of(axis, self.shape());
        let extent = self.shape()[axis];
        let inner: usize = self.shape()[axis + 1..].iter().product();
        let mut values = vec![0; self.len()];
        let mut lane: Vec<(T, u32)> = Vec::with_capacity(extent);
        for block in 0..self.len() / (extent * inner).max(1) {
            for i in 0..inner {
                let at = |k: usize| block * extent * inner + k * inner + i;
                lane.clear();
                lane.extend((0..extent).map(|k| (self.as_slice()[at(k)], index(k))));
                lane.sort_by(|a, b| if descending { order(&b.0, &a.0) } else { order(&a.0, &b.0) });
                lane.iter().enumerate().for_each(|(k, &(_, from))| values[at(k)] = from);
            }
        }
        Indices::new(self.shape(), values)
    }

    /// The positions at which to insert `values` into the rows of this tensor, which are sorted in ascending order, to
    /// keep them sorted. A position is before equal elements, or after them if `right`.
    ///
    /// This tensor is `[.., n]` and `values` is `[.., m]` with the same leading extents, or this tensor is `[n]` and
    /// `values` has any shape. The result has the shape of `values` and is in `0..=n`. For rows that are not sorted the
    /// result is unspecified, but in this range.
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// let edges = Tensor::from([0.0, 0.5, 1.0_f32]);
    /// let x = Tensor::from([[-1.0, 0.5], [0.7, 2.0]]);
    /// assert_eq!(edges.searchsorted(&x, false).as_slice(), [0, 1, 2, 3]);
    /// assert_eq!(edges.searchsorted(&x, true).as_slice(), [0, 2, 2, 3]);
    /// ```
    ///
    /// # Panics
    /// If the shapes do not fit.
    #[track_caller]
    pub fn searchsorted(&self, values: &Tensor<T>, right: bool) -> Indices {
        let shapes = (self.shape(), values.shape());
        let Some((&n, lead)) = self.shape().split_last() else { panic!("searchsorted in a scalar") };
        let shared = self.ndim() == 1;
        let fits = shared || values.shape().split_last().is_some_and(|(_, other)| other == lead);
        assert!(fits, "searchsorted of shapes {shapes:?}: the leading extents differ");
        let m = if shared { values.len() } else { values.shape()[values.ndim() - 1] };
        let find = |(i, value): (usize, &T)| {
            let row = if shared { self.as_slice() } else { &self.as_slice()[i / m * n..][..n] };
            let before = |x: &T| match order(x, value) {
                Ordering::Less => true,
                Ordering::Equal => right,
                Ordering::Greater => false,
            };
            index(row.partition_point(before))
        };
        Indices::new(values.shape(), values.as_slice().iter().enumerate().map(find).collect::<Vec<_>>())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_for_each_place_and_no_more() {
        for shape in [&[3][..], &[1 << 32, 1 << 32], &[0, 2]] {
            assert!(std::panic::catch_unwind(|| Indices::new(shape, [0, 1])).is_err(), "{shape:?}");
        }
        let list: Arc<[u32]> = [4, 5].into();
        let all =
            [Indices::from(&list), Indices::from(&vec![4, 5]), Indices::from(&[4, 5]), Indices::from(&[4, 5][..])];
        assert!(all.iter().all(|x| x == &Indices::new(&[2], [4, 5])));
    }

    use proptest::prelude::*;

    proptest! {
        #[test]
        fn sorting_is_stable_along_any_axis(
            shape in prop::collection::vec(0usize..5, 1..4), axis in 0usize..3, descending: bool
        ) {
            let axis = axis % shape.len();
            let x = Tensor::<f32>::from_fn(&shape, |i| match (i * 7) % 5 { 4 => f32::NAN, k => k as f32 });
            let got = x.argsort(axis as isize, descending);
            prop_assert_eq!(got.shape(), &shape[..]);
            let inner: usize = shape[axis + 1..].iter().product();
            let rank = |i: usize| if x.as_slice()[i].is_nan() { 9 } else { x.as_slice()[i] as i32 };
            for start in (0..x.len()).filter(|i| (i / inner.max(1)).is_multiple_of(shape[axis])) {
                let lane: Vec<_> = (0..shape[axis]).map(|k| got.as_slice()[start + k * inner]).collect();
                let mut all = lane.clone();
                all.sort();
                prop_assert!(all.iter().copied().eq(0..shape[axis] as u32), "{lane:?} is no permutation");
                for pair in lane.windows(2) {
                    let (a, b) = (rank(start + pair[0] as usize * inner), rank(start + pair[1] as usize * inner));
                    let sorted = if a == b { pair[0] < pair[1] } else { (a > b) == descending };
                    prop_assert!(sorted);
                }
            }
        }

        #[test]
        fn searching_agrees_with_counting(n in 0usize..9, m in 0usize..5, rows in 1usize..4, right: bool) {
            let sorted = Tensor::<f64>::from_fn(&[rows, n], |i| ((i % n.max(1)) / 2) as f64 + (i / n.max(1)) as f64);
            let values = Tensor::<f64>::from_fn(&[rows, m], |i| ((i * 5) % 9) as f64 / 2.0);
            let got = sorted.searchsorted(&values, right);
            for i in 0..rows * m {
                let x = values.as_slice()[i];
                let row = &sorted.as_slice()[i / m * n..][..n];
                let count = row.iter().filter(|&&y| y < x || right && y == x).count();
                prop_assert_eq!(got.as_slice()[i] as usize, count);
            }
        }
    }

    #[test]
    #[should_panic(expected = "index 1 is 3, but there are 3 classes")]
    fn a_class_beyond_the_last_panics() {
        Indices::new(&[2], [0, 3]).one_hot::<f32>(3);
    }

    #[test]
    fn nan_is_found_behind_every_number() {
        let x = Tensor::from_vec(&[3], vec![0.0, 1.0, f64::NAN]);
        let nan = Tensor::scalar(f64::NAN);
        assert_eq!(
            (x.searchsorted(&nan, false).as_slice(), x.searchsorted(&nan, true).as_slice()),
            (&[2][..], &[3][..])
        );
    }
}
