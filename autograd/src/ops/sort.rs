//! Order along an axis: sorting and searching. Indices are whole numbers outside the graph; gradients flow through what is
//! sorted.

use crate::error::ensure;
use crate::{Operand, Var};
use raygrad_tensor::{Indices, Scalar};

impl<'t, T: Scalar> Var<'t, T> {
    /// The elements sorted along `axis`, and where each stood: `y = x.gather(axis, &index)`. Equal elements keep their
    /// order, and NaN counts as larger than every number ([`Tensor::argsort`](crate::Tensor::argsort)). The gradient goes back through the
    /// permutation.
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

    /// Where the elements of the [sorted](Self::sort) tensor stand in this one; nothing to differentiate.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn argsort(&self, axis: isize, descending: bool) -> Indices {
        self.axis("argsort", axis);
        self.value().argsort(axis, descending)
    }

    /// Where `values` would be inserted in the sorted rows of this tensor ([`Tensor::searchsorted`](crate::Tensor::searchsorted)); nothing to
    /// differentiate.
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
