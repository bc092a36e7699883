//! Elements along an axis by number: gather, select, sort, and their adjoints. Indices are whole numbers outside the
//! graph; gradients flow through what is picked.

use super::gather::{add_up, rows_gradient};
use crate::error::ensure;
use crate::{Grads, Op, Operand, Reads, ShapeError, Tape, Var, Vjp};
use raygrad_tensor::{Indices, Pool, Scalar, Shape, Tensor};
use std::sync::Arc;

/// y[.., i, ..] = x[.., index[.., i, ..], ..] along an axis; dx = [`ScatterAlong`] of g.
#[derive(Clone)]
pub struct GatherAlong {
    /// The axis.
    pub axis: usize,
    /// For each element of the output its position along the axis of the input.
    pub index: Indices,
}

/// y[.., index[.., i, ..], ..] += x[.., i, ..] along an axis, onto zeros, with sums in f64; dx = [`GatherAlong`] of g.
#[derive(Clone)]
pub struct ScatterAlong {
    /// The axis.
    pub axis: usize,
    /// For each element of the input its position along the axis of the output.
    pub index: Indices,
    /// The extent of the output along the axis.
    pub extent: usize,
}

/// y[.., i, ..] = x[.., index[i], ..] along an axis; dx = [`IndexAdd`] of g, along the first axis as rows.
#[derive(Clone)]
pub struct IndexSelect {
    /// The axis.
    pub axis: usize,
    /// For each place along the axis of the output its place in the input.
    pub index: Arc<[u32]>,
}

/// y[.., index[i], ..] += x[.., i, ..] along an axis, onto zeros, with sums in f64; dx = [`IndexSelect`] of g.
#[derive(Clone)]
pub struct IndexAdd {
    /// The axis.
    pub axis: usize,
    /// For each place along the axis of the input its place in the output.
    pub index: Arc<[u32]>,
    /// The extent of the output along the axis.
    pub extent: usize,
}

/// Whether every index is below `extent`.
fn check_index(index: &[u32], extent: usize, axis: usize) -> Result<(), ShapeError> {
    match index.iter().enumerate().find(|&(_, &at)| at as usize >= extent) {
        None => Ok(()),
        Some((i, at)) => Err(format!("index {i} is {at}, but axis {axis} has {extent} entries")),
    }
}

/// The shape with another extent along `axis`.
fn with_extent(x: &[usize], axis: usize, extent: usize) -> Result<Shape, ShapeError> {
    if axis >= x.len() {
        return Err(format!("there is no axis {axis}"));
    }
    let mut shape = Shape::from_slice(x);
    shape[axis] = extent;
    Ok(shape)
}

/// As [`with_extent`], for a shape that was accepted before.
fn resized(x: &[usize], axis: usize, extent: usize) -> Shape {
    let mut shape = Shape::from_slice(x);
    shape[axis] = extent;
    shape
}

/// Elements behind one step along the axis.
fn inner(shape: &[usize], axis: usize) -> usize {
    shape[axis + 1..].iter().product()
}

/// Calls `f(i, j)` for each index, `i` counting the indices and `j` the elements of a tensor that differs from them in
/// its extent along `axis` only.
#[inline(always)]
fn each(index: &Indices, axis: usize, extent: usize, mut f: impl FnMut(usize, usize)) {
    let (count, inner) = (index.shape()[axis], inner(index.shape(), axis));
    for (row, row_index) in index.as_slice().chunks_exact(inner.max(1)).enumerate() {
        let start = row / count * extent * inner;
        for (k, &at) in row_index.iter().enumerate() {
            f(row * inner + k, start + at as usize * inner + k);
        }
    }
}

impl<T: Scalar> Op<T> for GatherAlong {
    fn name(&self) -> &'static str {
        "gather"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let extent = *x[0].get(self.axis).ok_or_else(|| format!("there is no axis {}", self.axis))?;
        let index = self.index.shape();
        let alike = |i: usize| i == self.axis || index[i] == x[0][i];
        if index.len() != x[0].len() || !(0..index.len()).all(alike) {
            return Err(format!("indices of shape {index:?} differ elsewhere than along axis {}", self.axis));
        }
        check_index(self.index.as_slice(), extent, self.axis)?;
        Ok(index.into())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(self.index.shape());
        let (from, to) = (x[0].as_slice(), out.as_mut_slice());
        each(&self.index, self.axis, x[0].shape()[self.axis], |i, j| to[i] = from[j]);
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let op = ScatterAlong { axis: self.axis, index: self.index.clone(), extent: cx.shape(0)[self.axis] };
        Grads::one(cx.tape().apply(op, &[cx.g()]))
    }
}

impl<T: Scalar> Op<T> for ScatterAlong {
    fn name(&self) -> &'static str {
        "scatter_add"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let shape = with_extent(x[0], self.axis, self.extent)?;
        if x[0] != self.index.shape() {
            return Err(format!("the indices have shape {:?}", self.index.shape()));
        }
        check_index(self.index.as_slice(), self.extent, self.axis)?;
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.full(&resized(x[0].shape(), self.axis, self.extent), T::ZERO);
        let from = x[0].as_slice();
        add_up(out.as_mut_slice(), |sums| {
            each(&self.index, self.axis, self.extent, |i, j| sums[j] += from[i].to_f64())
        });
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.g().gather(self.axis as isize, &self.index))
    }
}

impl<T: Scalar> Op<T> for IndexSelect {
    fn name(&self) -> &'static str {
        "index_select"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let shape = with_extent(x[0], self.axis, self.index.len())?;
        check_index(&self.index, x[0][self.axis], self.axis)?;
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let (extent, inner) = (x[0].shape()[self.axis], inner(x[0].shape(), self.axis));
        let mut out = pool.tensor(&resized(x[0].shape(), self.axis, self.index.len()));
        for (row, out) in out.as_mut_slice().chunks_exact_mut(inner.max(1)).enumerate() {
            let (block, k) = (row / self.index.len(), row % self.index.len());
            let from = (block * extent + self.index[k] as usize) * inner;
            out.copy_from_slice(&x[0].as_slice()[from..from + inner]);
        }
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        if self.axis == 0 {
            return rows_gradient(cx, &self.index);
        }
        let op = IndexAdd { axis: self.axis, index: self.index.clone(), extent: cx.shape(0)[self.axis] };
        Grads::one(cx.tape().apply(op, &[cx.g()]))
    }
}

impl<T: Scalar> Op<T> for IndexAdd {
    fn name(&self) -> &'static str {
        "index_add"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let shape = with_extent(x[0], self.axis, self.extent)?;
        if x[0][self.axis] != self.index.len() {
            return Err(format!("there must be {} entries along axis {}", self.index.len(), self.axis));
        }
        check_index(&self.index, self.extent, self.axis)?;
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let inner = inner(x[0].shape(), self.axis);
        let mut out = pool.full(&resized(x[0].shape(), self.axis, self.extent), T::ZERO);
        add_up(out.as_mut_slice(), |sums| {
            for (row, x) in x[0].as_slice().chunks_exact(inner.max(1)).enumerate() {
                let (block, k) = (row / self.index.len(), row % self.index.len());
                let to = (block * self.extent + self.index[k] as usize) * inner;
                sums[to..to + inner].iter_mut().zip(x).for_each(|(sum, x)| *sum += x.to_f64());
            }
        });
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.g().index_select(self.axis as isize, &self.index))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Elements by number along `axis`: `y[i][j] = x[index[i][j]][j]` for axis 0 of two, and likewise for others. The
    /// result has the shape of `index`, which agrees with this tensor in all other axes. The gradient is
    /// [scattered](Self::scatter_add) back.
    ///
    /// ```
    /// use raygrad_autograd::{Indices, Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let logits = tape.leaf(Tensor::from_vec(&[2, 3], vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6]));
    /// let labels = Indices::new(&[2, 1], [2, 0]);
    /// assert_eq!(logits.gather(1, &labels).value(), [[0.3], [0.4]]);
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist, other extents differ, or an index is not below the extent of the axis.
    #[doc(alias = "take_along_axis")]
    #[track_caller]
    pub fn gather(&self, axis: isize, index: impl Into<Indices>) -> Self {
        self.tape().apply(GatherAlong { axis: self.axis("gather", axis), index: index.into() }, &[self])
    }

    /// This tensor with the elements of `source` added at the positions that `index` names along `axis`:
    /// `y[index[i][j]][j] += source[i][j]` for axis 0 of two. `source` has the shape of `index`, which agrees with this
    /// tensor in all other axes. Elements that meet are added in row-major order of `index`.
    ///
    /// # Panics
    /// If the axis does not exist, the shapes do not fit, or an index is not below the extent of the axis.
    #[track_caller]
    pub fn scatter_add(&self, axis: isize, index: impl Into<Indices>, source: &Self) -> Self {
        let axis = self.axis("scatter_add", axis);
        let op = ScatterAlong { axis, index: index.into(), extent: self.shape()[axis] };
        self.plus("scatter_add", self.tape().apply(op, &[source]), source)
    }

    /// Entries along `axis` by number: `[.., n, ..]` to `[.., index.len(), ..]`. The gradient is
    /// [added](Self::index_add) back to the entries that were picked; along the first axis it is sparse, as that of
    /// [`gather_rows`](Self::gather_rows).
    ///
    /// # Panics
    /// If the axis does not exist, or an index is not below its extent.
    #[track_caller]
    pub fn index_select(&self, axis: isize, index: impl Into<Indices>) -> Self {
        let (axis, index) = (self.axis("index_select", axis), self.line("index_select", index));
        self.tape().apply(IndexSelect { axis, index }, &[self])
    }

    /// This tensor with entry `i` of `source` along `axis` added to entry `index[i]`, in the order of `i`.
    ///
    /// # Panics
    /// If the axis does not exist, the shapes do not fit, or an index is not below the extent of the axis.
    #[track_caller]
    pub fn index_add(&self, axis: isize, index: impl Into<Indices>, source: &Self) -> Self {
        let (axis, index) = (self.axis("index_add", axis), self.line("index_add", index));
        let op = IndexAdd { axis, index, extent: self.shape()[axis] };
        self.plus("index_add", self.tape().apply(op, &[source]), source)
    }

    /// The sum with what was made of `source`.
    #[track_caller]
    fn plus(&self, op: &'static str, sum: Self, source: &Self) -> Self {
        let same = ensure(sum.shape() == self.shape(), || "other extents differ".into());
        self.tape().fits(op, &[self, source], same);
        self + sum
    }

    /// Indices along one axis.
    #[track_caller]
    pub(crate) fn line(&self, op: &'static str, index: impl Into<Indices>) -> Arc<[u32]> {
        let index = index.into();
        self.fits(op, ensure(index.shape().len() == 1, || format!("indices of shape {:?} are no list", index.shape())));
        index.values().clone()
    }

    /// The elements sorted along `axis`, and where each stood: `y = x.gather(axis, &index)`. Equal elements keep their
    /// order, and NaN counts as larger than every number ([`Tensor::argsort`]). The gradient goes back through the
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

    /// Where `values` would be inserted in the sorted rows of this tensor ([`Tensor::searchsorted`]); nothing to
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

impl<T: Scalar> Tape<T> {
    /// Indicator vectors `[.., classes]` as a constant: 1 at each index, 0 elsewhere.
    ///
    /// # Panics
    /// If an index is not below `classes`.
    #[track_caller]
    pub fn one_hot(&self, index: impl Into<Indices>, classes: usize) -> Var<'_, T> {
        let index = index.into();
        self.fits("one_hot", &[], check_index(index.as_slice(), classes, 0));
        self.constant(index.one_hot(classes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn indices_that_do_not_fit_are_shape_errors() {
        let tape = Tape::<f32>::new();
        let x = tape.constant(Tensor::zeros(&[2, 3]));
        let gather = |axis, shape: &[usize], index: &[u32]| {
            let op = GatherAlong { axis, index: Indices::new(shape, index) };
            tape.try_apply(op, &[&x]).unwrap_err().to_string()
        };
        assert!(gather(1, &[2, 1], &[0, 3]).contains("index 1 is 3, but axis 1 has 3 entries"));
        assert!(gather(0, &[2, 1], &[0, 0]).contains("differ elsewhere than along axis 0"));
        assert!(gather(2, &[2, 3], &[0; 6]).contains("there is no axis 2"));
        let select = IndexSelect { axis: 1, index: [3].into() };
        assert!(tape.try_apply(select, &[&x]).unwrap_err().to_string().contains("index 0 is 3"));
        let add = |extent, index: &[u32]| IndexAdd { axis: 0, index: index.into(), extent };
        assert!(tape.try_apply(add(2, &[0]), &[&x]).unwrap_err().to_string().contains("1 entries along axis 0"));
        assert!(tape.try_apply(add(2, &[0, 2]), &[&x]).unwrap_err().to_string().contains("axis 0 has 2 entries"));
    }

    #[test]
    #[should_panic(expected = "other extents differ")]
    fn a_source_of_another_width_is_not_broadcast() {
        let tape = Tape::<f32>::new();
        let x = tape.constant(Tensor::zeros(&[2, 3]));
        x.index_add(0, [1], &tape.constant(Tensor::ones(&[1, 1])));
    }

    #[test]
    fn entries_that_meet_are_added_in_f64() {
        let tape = Tape::<f32>::new();
        let zero = tape.constant(Tensor::zeros(&[1, 2]));
        let source = tape.constant(Tensor::from_vec(&[1, 3], vec![1e8, 1.0, -1e8]));
        assert_eq!(zero.index_add(1, [1, 1, 1], &source).value().as_slice(), [0.0, 1.0]);
        assert_eq!(zero.scatter_add(1, Indices::new(&[1, 3], [1, 0, 1]), &source).value().as_slice(), [1.0, 0.0]);
    }
    #[test]
    fn rows_that_are_selected_have_a_sparse_gradient() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::from_fn(&[3, 2], |i| i as f64));
        let rows = x.index_select(0, [1, 0, 1]).square().sum().backward(&[&x]).remove(0);
        assert!(rows.is_rows());
        assert_eq!(rows.into_dense(tape.pool()), [[0.0, 2.0], [8.0, 12.0], [0.0, 0.0]]);
        let x = tape.leaf(Tensor::from_fn(&[3, 2], |i| i as f64));
        let columns = x.index_select(1, [1, 0, 1]).square().sum().backward(&[&x]).remove(0);
        assert!(columns.is_dense());
        assert_eq!(columns.into_dense(tape.pool()), [[0.0, 4.0], [4.0, 12.0], [8.0, 20.0]]);
    }

    /// An axis with entries before and behind it, and fewer or more indices than entries.
    #[test]
    fn gathering_along_an_axis_in_the_middle_is_what_its_definition_says() {
        let tape = Tape::<f64>::new();
        let x = tape.constant(Tensor::from_fn(&[3, 4, 2], |i| i as f64));
        for count in [1, 2, 4, 7] {
            let index = |i: usize| (i * 7 % 4) as u32;
            let indices = Indices::new(&[3, count, 2], (0..6 * count).map(index).collect::<Vec<_>>());
            let place = |i: usize| (i / (2 * count) * 4 + index(i) as usize) * 2 + i % 2;
            let y = x.gather(1, &indices);
            let expected: Vec<f64> = (0..6 * count).map(|i| place(i) as f64).collect();
            assert_eq!(y.value().as_slice(), expected);
            let mut sums = vec![0.0; 24];
            (0..6 * count).for_each(|i| sums[place(i)] += expected[i]);
            let zero = tape.constant(Tensor::zeros(&[3, 4, 2]));
            assert_eq!(zero.scatter_add(1, &indices, &y).value().as_slice(), sums);
        }
    }
}
