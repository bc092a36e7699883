//! The gradient of a variable: a dense sum, and sparse contributions beside it.

use crate::RowSums;
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};
use std::any::Any;
use std::borrow::Cow;
use std::fmt;
use std::sync::Arc;

/// A sparse contribution as plain data, to send it to another process or to store it.
#[derive(Debug, Clone, PartialEq)]
pub struct SparseParts<T: Scalar> {
    /// The name of its type, from which the receiver knows how to read it.
    pub kind: Cow<'static, str>,
    /// Its integers, such as the rows of a table.
    pub integers: Arc<[u32]>,
    /// Its numbers.
    pub tensors: Vec<Tensor<T>>,
}

/// Makes a sparse contribution to the gradient of a variable of this shape from its parts. `None` if the parts do not
/// fit the type or the shape: they may come from another program.
pub type ReadSparse<T> = fn(shape: &[usize], parts: SparseParts<T>) -> Option<Arc<dyn SparseGrad<T>>>;

/// A sparse contribution to a gradient. For a table with few used rows (an embedding, a hash grid), it is much smaller
/// than the table.
///
/// An operation returns one with [`Grads::with_sparse`](crate::Grads::with_sparse). It reaches an optimizer unchanged,
/// in a [`Gradient`]. [`Gradient::into_dense`] adds it to a dense tensor.
pub trait SparseGrad<T: Scalar>: Any + Send + Sync {
    /// The shape of the variable.
    fn shape(&self) -> &[usize];

    /// Adds this contribution to a dense gradient of that shape.
    fn add_to(&self, dense: &mut Tensor<T>);

    /// This contribution as rows along the first axis, if it consists of rows. Optimizers that update single rows use
    /// it.
    fn as_rows(&self) -> Option<&dyn RowShare<T>> {
        None
    }

    /// Whether the backward pass adds this contribution to a dense gradient on arrival. The default keeps it sparse
    /// until the end.
    ///
    /// The gradient of a slice is added on arrival: most of it is zero, and many slices of one tensor then share one
    /// dense sum.
    fn is_passing(&self) -> bool {
        false
    }

    /// This contribution as plain data, from which its [`ReadSparse`] function makes one that adds the same bits.
    /// `None`, the default, if it cannot be sent to another process.
    fn to_parts(&self) -> Option<SparseParts<T>> {
        None
    }
}

/// A sparse contribution that consists of rows along the first axis.
pub trait RowShare<T: Scalar>: Send + Sync {
    /// Adds the rows to the sums of their table rows, in a fixed order.
    ///
    /// # Panics
    /// If `sums` belongs to a table of another size.
    #[track_caller]
    fn scatter(&self, sums: &mut RowSums<T>);

    /// Numbers of rows of the parts of the table, in order, such as the levels of a hash grid.
    /// [`scatter_part`](Self::scatter_part) can add each part separately and in parallel. Empty for a table without
    /// parts.
    fn parts(&self) -> Vec<usize> {
        vec![]
    }

    /// As [`scatter`](Self::scatter) for the rows of one part. Row 0 of `sums` is the first row of the part.
    ///
    /// # Panics
    /// If `sums` belongs to a table of another size.
    #[track_caller]
    fn scatter_part(&self, _part: usize, sums: &mut RowSums<T>) {
        self.scatter(sums);
    }
}

/// The gradient of one variable, as [`Var::backward`](crate::Var::backward) returns it. It is the sum of a dense tensor
/// and of sparse contributions, in the order of their arrival. With neither it is zero.
///
/// ```
/// use raygrad_autograd::{Pool, RowSums, Tape, Tensor};
/// let tape = Tape::<f64>::new();
/// let table = tape.leaf(Tensor::ones(&[4, 2]));
/// let used = table.gather_rows([3, 1, 3]).sum();
/// let gradient = used.backward(&[&table]).remove(0);
/// let mut sums = RowSums::new(4, 2);
/// assert!(gradient.scatter(&mut sums)); // it consists of rows
/// assert_eq!(sums.rows(), [3, 1]);
/// assert_eq!(gradient.into_dense(&Pool::none()), [[0.0, 0.0], [1.0, 1.0], [0.0, 0.0], [2.0, 2.0]]);
/// ```
#[derive(Clone)]
pub struct Gradient<T: Scalar> {
    shape: Shape,
    dense: Option<Tensor<T>>,
    sparse: Vec<Arc<dyn SparseGrad<T>>>,
}

impl<T: Scalar> Gradient<T> {
    /// The zero gradient, without contributions.
    pub fn zero(shape: &[usize]) -> Self {
        Gradient { shape: shape.into(), dense: None, sparse: vec![] }
    }

    /// The shape of the variable.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// Whether there is no contribution: the result does not depend on the variable.
    pub fn is_zero(&self) -> bool {
        self.dense.is_none() && self.sparse.is_empty()
    }

    /// Whether no contribution is sparse.
    pub fn is_dense(&self) -> bool {
        self.sparse.is_empty()
    }

    /// Whether all contributions are rows.
    pub fn is_rows(&self) -> bool {
        self.dense.is_none() && self.sparse.iter().all(|share| share.as_rows().is_some())
    }

    /// The sum of the dense contributions, if there are any.
    pub fn dense(&self) -> Option<&Tensor<T>> {
        self.dense.as_ref()
    }

    /// The sparse contributions, in the order of their arrival.
    pub fn sparse(&self) -> &[Arc<dyn SparseGrad<T>>] {
        &self.sparse
    }

    /// The gradient as a dense tensor: the dense sum, plus the sparse contributions in their order.
    ///
    /// # Panics
    /// If [`SparseGrad::add_to`] replaces the sum with a tensor of another shape.
    #[track_caller]
    pub fn into_dense(self, pool: &Pool<T>) -> Tensor<T> {
        let mut sum = self.dense.unwrap_or_else(|| pool.full(&self.shape, T::ZERO));
        self.sparse.iter().for_each(|share| share.add_to(&mut sum));
        assert_eq!(sum.shape(), &self.shape[..], "the shape of a gradient after `SparseGrad::add_to`");
        sum
    }

    /// Adds the gradient to the row sums of a table if all contributions are rows, and returns whether it did.
    /// Otherwise `sums` does not change.
    ///
    /// # Panics
    /// If `sums` belongs to a table of another size.
    #[track_caller]
    pub fn scatter(&self, sums: &mut RowSums<T>) -> bool {
        let is_rows = self.is_rows();
        if is_rows {
            self.sparse.iter().filter_map(|share| share.as_rows()).for_each(|rows| rows.scatter(sums));
        }
        is_rows
    }

    /// Removes and returns all sparse contributions, in their order.
    pub fn take_sparse(&mut self) -> Vec<Arc<dyn SparseGrad<T>>> {
        std::mem::take(&mut self.sparse)
    }

    /// Removes and returns the sparse contributions of type `G`, in their order. All others stay.
    pub fn take<G: SparseGrad<T>>(&mut self) -> Vec<Arc<G>> {
        let mut taken = vec![];
        for share in std::mem::take(&mut self.sparse) {
            let any: Arc<dyn Any + Send + Sync> = share.clone();
            match any.downcast() {
                Ok(share) => taken.push(share),
                Err(_) => self.sparse.push(share),
            }
        }
        taken
    }

    /// Adds the contributions of another gradient. The sparse ones come after those of this gradient.
    ///
    /// # Panics
    /// If it has another shape.
    #[track_caller]
    pub fn add(&mut self, other: Gradient<T>) {
        if let Some(dense) = other.dense {
            self.add_dense(dense);
        }
        other.sparse.into_iter().for_each(|share| self.add_sparse(share));
    }

    /// Adds a dense contribution.
    ///
    /// # Panics
    /// If it has another shape.
    #[track_caller]
    pub fn add_dense(&mut self, share: Tensor<T>) {
        assert_eq!(share.shape(), self.shape(), "a share of a gradient has the shape of the whole");
        match &mut self.dense {
            Some(sum) => *sum += &share,
            None => self.dense = Some(share),
        }
    }

    /// Adds a sparse contribution.
    ///
    /// # Panics
    /// If it has another shape.
    #[track_caller]
    pub fn add_sparse(&mut self, share: Arc<dyn SparseGrad<T>>) {
        assert_eq!(share.shape(), self.shape(), "a share of a gradient has the shape of the whole");
        self.sparse.push(share);
    }
}

impl<T: Scalar> From<Tensor<T>> for Gradient<T> {
    fn from(dense: Tensor<T>) -> Self {
        Gradient { shape: dense.shape().into(), dense: Some(dense), sparse: vec![] }
    }
}

impl<T: Scalar> fmt::Debug for Gradient<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Gradient<{}>{:?} {:?} and {} sparse shares", T::NAME, self.shape, self.dense, self.sparse.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RowGrad, Tape};

    /// A share of another type, which consists of no rows: `value` at one place.
    struct Single(usize, f64);

    impl SparseGrad<f64> for Single {
        fn shape(&self) -> &[usize] {
            &[3, 2]
        }
        fn add_to(&self, dense: &mut Tensor<f64>) {
            dense.as_mut_slice()[self.0] += self.1;
        }
    }

    fn rows() -> Arc<dyn SparseGrad<f64>> {
        Arc::new(RowGrad::new(&[3, 2], [2, 2].into(), Tensor::from_vec(&[2, 2], vec![1.0, 2.0, 3.0, 4.0])))
    }

    #[test]
    fn nothing_gets_lost_whatever_is_taken_out() {
        let mut gradient = Gradient::zero(&[3, 2]);
        assert!(gradient.is_zero() && gradient.is_dense() && gradient.is_rows());
        gradient.add_sparse(rows());
        assert!(gradient.is_rows() && !gradient.is_dense() && !gradient.is_zero());
        let mut other = Gradient::from(Tensor::full(&[3, 2], 10.0));
        other.add_sparse(Arc::new(Single(0, 100.0)));
        other.add_sparse(rows());
        gradient.add(other);
        gradient.add_dense(Tensor::full(&[3, 2], 0.5));
        let all = [110.5, 10.5, 10.5, 10.5, 18.5, 22.5];
        assert_eq!(gradient.clone().into_dense(&Pool::none()).as_slice(), all);
        let mut sums = RowSums::new(3, 2);
        assert!(!gradient.scatter(&mut sums) && sums.rows().is_empty(), "rows are not all that is there");
        let taken = gradient.take::<RowGrad<f64>>();
        assert_eq!((taken.len(), gradient.sparse().len()), (2, 1));
        assert_eq!(gradient.into_dense(&Pool::none()).as_slice(), [110.5, 10.5, 10.5, 10.5, 10.5, 10.5]);
    }

    #[test]
    fn sparse_and_dense_shares_of_one_table_come_together() {
        let tape = Tape::<f64>::new();
        let table = tape.leaf(Tensor::from_fn(&[3, 2], |i| i as f64));
        let used = || table.gather_rows([2, 0, 2]).square().sum();
        let loss = used() + table.square().sum() * 0.5 + used();
        let expected = loss.grad(&[&table]).remove(0);
        let gradient = loss.backward(&[&table]).remove(0);
        assert!(gradient.dense().is_some() && gradient.sparse().len() == 2);
        assert_eq!(gradient.into_dense(tape.pool()), expected);
        assert_eq!(expected.as_slice(), [0.0, 5.0, 2.0, 3.0, 4.0 * 9.0, 5.0 * 9.0]);
    }

    #[test]
    #[should_panic(expected = "a share of a gradient has the shape of the whole")]
    fn a_share_of_another_shape_is_refused() {
        Gradient::<f64>::zero(&[2]).add_sparse(rows());
    }
}
