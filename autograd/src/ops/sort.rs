//! Sorting and searching along an axis. Indices are not on the graph; gradients flow through sorted values.

use crate::error::ensure;
use crate::{Operand, Var};
use raygrad_tensor::{Indices, Scalar};

impl<'t, T: Scalar> Var<'t, T> {
    /// Sorts the elements along `axis`, and returns their indices too: `y = x.gather(axis, &index)`.
    ///
    /// Equal elements keep their order, and NaN counts as larger than every number
    /// ([`Tensor::argsort`](crate::Tensor::argsort)). The gradient goes back through the permutation.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::from([5.0, 1.0, 3.0]));
    /// let (sorted, index) = x.sort(0, false);
    /// assert_eq!((sorted.value().as_slice(), index.as_slice()), (&[1.0, 3.0, 5.0][..], &[1, 2, 0][..]));
    /// assert_eq!(sorted.slice_axis(0, ..1).sum().grad(&[&x])[0], [0.0, 1.0, 0.0]);
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn sort(&self, axis: isize, descending: bool) -> (Self, Indices) {
        let index = self.argsort(axis, descending);
        (self.gather(axis, &index), index)
    }

    /// The indices that [`sort`](Self::sort) the elements along `axis`. There is no gradient.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn argsort(&self, axis: isize, descending: bool) -> Indices {
        self.axis("argsort", axis);
        self.value().argsort(axis, descending)
    }

    /// The insertion positions of `values` in the sorted rows of this tensor
    /// ([`Tensor::searchsorted`](crate::Tensor::searchsorted)). There is no gradient.
    ///
    /// # Panics
    /// If the shapes do not fit.
    #[track_caller]
    pub fn searchsorted(&self, values: impl Operand<'t, T>, right: bool) -> Indices {
        let values = values.on(self.tape());
        let lead = self.shape().split_last().map(|(_, lead)| lead);
        let same = values.shape().split_last().map(|(_, lead)| lead) == lead;
        let what = || "the leading extents differ, or there is no axis to search in".into();
        let fits = ensure(lead.is_some_and(|lead| lead.is_empty() || same), what);
        self.tape().fits("searchsorted", &[self, &values], fits);
        self.value().searchsorted(values.value(), right)
    }
}
