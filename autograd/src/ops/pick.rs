//! Indexing along an axis by integer arrays, and its adjoint. Indices are not on the graph; gradients flow through the
//! values.

use super::row_grad::{RowGrad, add_rows};
use crate::error::ensure;
use crate::{Grads, Op, Reads, ShapeError, Tape, Var, Vjp};
use raygrad_tensor::parallel::chunks;
use raygrad_tensor::{Indices, Pool, Scalar, Shape, Tensor};
use std::sync::Arc;

/// The method that picks.
#[derive(Debug, Clone, Copy)]
pub struct Method {
    /// Its name, and that of its adjoint.
    pub names: [&'static str; 2],
    /// Whether few elements meet at one place, so that sums do not need f64.
    pub few_meet: bool,
}

/// Rows: [`Var::gather_rows`], [`Var::scatter_rows`].
pub const ROWS: Method = Method { names: ["gather_rows", "scatter_rows"], few_meet: false };
/// Entries along an axis: [`Var::index_select`], [`Var::index_add`].
pub const ENTRIES: Method = Method { names: ["index_select", "index_add"], few_meet: false };
/// Elements: [`Var::gather`], [`Var::scatter_add`].
pub const ELEMENTS: Method = Method { names: ["gather", "scatter_add"], few_meet: false };
/// Pixels of planes: [`Var::max_pool2d`], if a pixel is in few windows.
pub const PIXELS: Method = Method { names: ["gather_planes", "scatter_planes"], few_meet: true };

/// The indices along an axis.
#[derive(Clone)]
pub enum Places {
    /// Entry `i` of the result is the whole entry `index[i]`.
    Entries(Arc<[u32]>),
    /// Each element of the result has its own index.
    Elements(Indices),
}

/// y[.., i, ..] = x[.., index[i], ..] along an axis, or x[.., index[.., i, ..], ..]. dx = [`Put`] of g, or a sparse
/// [`RowGrad`] for whole rows in an unrecorded pass.
#[derive(Clone)]
pub struct Pick {
    /// The method.
    pub method: Method,
    /// The axis.
    pub axis: usize,
    /// The indices along it.
    pub places: Places,
}

/// The adjoint of [`Pick`]: zeros to which each entry or element of x is added at its place; dx = [`Pick`] of g.
#[derive(Clone)]
pub struct Put {
    /// The inverse selection.
    pub pick: Pick,
    /// The extent of the output along the axis.
    pub extent: usize,
}

/// Whether every index is below `extent`.
pub(super) fn check_index(index: &[u32], extent: usize, axis: usize) -> Result<(), ShapeError> {
    match index.iter().enumerate().find(|&(_, &at)| at as usize >= extent) {
        None => Ok(()),
        Some((i, at)) => Err(format!("index {i} is {at}, but axis {axis} has {extent} entries")),
    }
}

impl Pick {
    /// The shape with another extent along the axis.
    fn resized(&self, x: &[usize], extent: usize) -> Result<Shape, ShapeError> {
        let mut shape = Shape::from_slice(x);
        *shape.get_mut(self.axis).ok_or_else(|| format!("there is no axis {}", self.axis))? = extent;
        Ok(shape)
    }

    /// The extent of the result along the axis.
    fn count(&self) -> usize {
        match &self.places {
            Places::Entries(index) => index.len(),
            Places::Elements(index) => index.shape().get(self.axis).copied().unwrap_or(0),
        }
    }

    /// Checks that the indices fit a result of the shape `picked` and are below `extent`. `x` is the shape of the
    /// input.
    fn check(&self, x: &[usize], picked: &[usize], extent: usize) -> Result<(), ShapeError> {
        match &self.places {
            Places::Entries(index) => {
                let one_each = picked[self.axis] == index.len();
                ensure(one_each, || format!("{} indices for {picked:?} along axis {}", index.len(), self.axis))?;
                check_index(index, extent, self.axis)
            }
            Places::Elements(index) => {
                let same = picked == index.shape();
                ensure(same, || {
                    let (axis, own) = (self.axis, index.shape());
                    format!(
                        "indices of shape {own:?} for {x:?}: they need {} axes, of the same extents except along axis {axis}",
                        x.len()
                    )
                })?;
                check_index(index.as_slice(), extent, self.axis)
            }
        }
    }

    /// `[elements of a block, elements of an entry]` of a shape. A block is the part for one index of the axes before.
    fn sizes(&self, x: &[usize]) -> [usize; 2] {
        [self.axis, self.axis + 1].map(|axis| x[axis..].iter().product())
    }
}

/// Calls `f(i, j)` for each index of a block; `i` counts the indices, and `j` the elements of the source.
#[inline(always)]
fn each_element(index: &[u32], inner: usize, mut f: impl FnMut(usize, usize)) {
    for (row, index) in index.chunks_exact(inner).enumerate() {
        for (k, &at) in index.iter().enumerate() {
            f(row * inner + k, at as usize * inner + k);
        }
    }
}

impl<T: Scalar> Op<T> for Pick {
    fn name(&self) -> &'static str {
        self.method.names[0]
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let picked = self.resized(x[0], self.count())?;
        self.check(x[0], &picked, x[0][self.axis])?;
        Ok(picked)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let ([from, inner], x) = (self.sizes(x[0].shape()), (x[0].as_slice(), x[0].shape()));
        let mut shape = Shape::from_slice(x.1);
        shape[self.axis] = self.count();
        let (mut out, to) = (pool.tensor(&shape), self.count() * inner);
        let block = |_: &mut (), i: usize, out: &mut [T]| {
            let x = &x.0[i * from..][..from];
            match &self.places {
                Places::Entries(index) => {
                    for (out, &at) in out.chunks_exact_mut(inner).zip(index.iter()) {
                        out.copy_from_slice(&x[at as usize * inner..][..inner]);
                    }
                }
                Places::Elements(index) => {
                    each_element(&index.as_slice()[i * to..][..to], inner, |i, j| out[i] = x[j]);
                }
            }
        };
        let work = out.len();
        chunks(out.as_mut_slice(), to, work, || (), &block);
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let extent = cx.shape(0)[self.axis];
        match &self.places {
            Places::Entries(index) if self.axis == 0 && !cx.recording() => {
                let rows = RowGrad::new(cx.shape(0), index.clone(), cx.g().value().clone());
                Grads::new([None]).with_sparse(0, Arc::new(rows))
            }
            _ => Grads::one(cx.tape().apply(Put { pick: self.clone(), extent }, &[cx.g()])),
        }
    }
}

impl<T: Scalar> Op<T> for Put {
    fn name(&self) -> &'static str {
        self.pick.method.names[1]
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let shape = self.pick.resized(x[0], self.extent)?;
        self.pick.check(x[0], x[0], self.extent)?;
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let ([from, inner], x) = (self.pick.sizes(x[0].shape()), x[0]);
        let mut shape = Shape::from_slice(x.shape());
        shape[self.pick.axis] = self.extent;
        let (mut out, x) = (pool.tensor(&shape), x.as_slice());
        let block = |sums: &mut Vec<f64>, i: usize, out: &mut [T]| {
            let x = &x[i * from..][..from];
            out.fill(T::ZERO);
            match &self.pick.places {
                // One block, which may be a large table.
                Places::Entries(index) if self.pick.axis == 0 => return add_rows(out, x, index, inner, sums),
                Places::Elements(index) if self.pick.method.few_meet => {
                    return each_element(&index.as_slice()[i * from..][..from], inner, |i, j| out[j] += x[i]);
                }
                _ => {}
            }
            sums.clear();
            sums.resize(out.len(), 0.0);
            match &self.pick.places {
                Places::Entries(index) => {
                    for (x, &at) in x.chunks_exact(inner).zip(index.iter()) {
                        sums[at as usize * inner..].iter_mut().zip(x).for_each(|(sum, x)| *sum += x.to_f64());
                    }
                }
                Places::Elements(index) => {
                    each_element(&index.as_slice()[i * from..][..from], inner, |i, j| sums[j] += x[i].to_f64());
                }
            }
            out.iter_mut().zip(sums).for_each(|(out, sum)| *out = T::from_f64(*sum));
        };
        let work = 2 * x.len() + out.len();
        chunks(out.as_mut_slice(), self.extent * inner, work, Vec::new, &block);
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(self.pick.clone(), &[cx.g()]))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Selects rows by index: `[rows, ..]` to `[index.len(), ..]`. Row `i` of the result is row `index[i]` of this
    /// tensor. In [`backward`](Self::backward), the gradient is sparse.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::from([[1.0, 2.0], [3.0, 4.0]]));
    /// let y = x.gather_rows([1, 0, 1]);
    /// assert_eq!(y.value(), [[3.0, 4.0], [1.0, 2.0], [3.0, 4.0]]);
    /// assert_eq!(y.sum().grad(&[&x])[0], [[1.0, 1.0], [2.0, 2.0]]);
    /// ```
    ///
    /// # Panics
    /// If this is a scalar or an index is not below the number of rows.
    #[track_caller]
    pub fn gather_rows(&self, index: impl Into<Indices>) -> Self {
        let index = self.line("gather_rows", index);
        self.tape().apply(Pick { method: ROWS, axis: 0, places: Places::Entries(index) }, &[self])
    }

    /// The adjoint of [`gather_rows`](Self::gather_rows): `[index.len(), ..]` to `[rows, ..]`. The result is zeros to
    /// which row `i` of this tensor is added at row `index[i]`. Sums are in f64.
    ///
    /// # Panics
    /// If there is not one index for each row, or one is not below `rows`.
    #[track_caller]
    pub fn scatter_rows(&self, index: impl Into<Indices>, rows: usize) -> Self {
        let pick = Pick { method: ROWS, axis: 0, places: Places::Entries(self.line("scatter_rows", index)) };
        self.tape().apply(Put { pick, extent: rows }, &[self])
    }

    /// Selects elements by index along `axis` (`torch.gather`, `numpy.take_along_axis`): `y[i][j] = x[index[i][j]][j]`
    /// for axis 0 of two.
    ///
    /// The result has the shape of `index`, which agrees with this tensor in all other axes. The gradient is that of
    /// [`scatter_add`](Self::scatter_add).
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
        let axis = self.axis("gather", axis);
        self.tape().apply(Pick { method: ELEMENTS, axis, places: Places::Elements(index.into()) }, &[self])
    }

    /// Adds the elements of `source` to this tensor at the positions of `index` along `axis`:
    /// `y[index[i][j]][j] += source[i][j]` for axis 0 of two.
    ///
    /// `source` has the shape of `index`, which agrees with this tensor in all other axes. Elements at one position are
    /// added in row-major order of `index`.
    ///
    /// # Panics
    /// If the axis does not exist, the shapes do not fit, or an index is not below the extent of the axis.
    #[track_caller]
    pub fn scatter_add(&self, axis: isize, index: impl Into<Indices>, source: &Self) -> Self {
        let axis = self.axis("scatter_add", axis);
        self.plus(Pick { method: ELEMENTS, axis, places: Places::Elements(index.into()) }, source)
    }

    /// Selects entries along `axis` by index (`numpy.take`): `[.., n, ..]` to `[.., index.len(), ..]`. The gradient is
    /// [added](Self::index_add) to the selected entries. Along the first axis it is sparse, as that of
    /// [`gather_rows`](Self::gather_rows).
    ///
    /// # Panics
    /// If the axis does not exist, or an index is not below its extent.
    #[doc(alias = "take")]
    #[track_caller]
    pub fn index_select(&self, axis: isize, index: impl Into<Indices>) -> Self {
        let (axis, index) = (self.axis("index_select", axis), self.line("index_select", index));
        self.tape().apply(Pick { method: ENTRIES, axis, places: Places::Entries(index) }, &[self])
    }

    /// Adds entry `i` of `source` along `axis` to entry `index[i]` of this tensor, in the order of `i`.
    ///
    /// # Panics
    /// If the axis does not exist, the shapes do not fit, or an index is not below the extent of the axis.
    #[track_caller]
    pub fn index_add(&self, axis: isize, index: impl Into<Indices>, source: &Self) -> Self {
        let (axis, index) = (self.axis("index_add", axis), self.line("index_add", index));
        self.plus(Pick { method: ENTRIES, axis, places: Places::Entries(index) }, source)
    }

    /// The sum with `source` at the places that `pick` selects.
    #[track_caller]
    fn plus(&self, pick: Pick, source: &Self) -> Self {
        let (name, extent) = (pick.method.names[1], self.shape()[pick.axis]);
        let sum = self.tape().apply(Put { pick, extent }, &[source]);
        let same = ensure(sum.shape() == self.shape(), || "other extents differ".into());
        self.tape().fits(name, &[self, source], same);
        self + sum
    }

    /// The indices as a list.
    #[track_caller]
    pub(crate) fn line(&self, op: &'static str, index: impl Into<Indices>) -> Arc<[u32]> {
        let index = index.into();
        self.fits(op, ensure(index.shape().len() == 1, || format!("indices of shape {:?} are no list", index.shape())));
        index.values().clone()
    }
}

impl<T: Scalar> Tape<T> {
    /// One-hot vectors `[.., classes]` as a constant: 1 at each index, 0 elsewhere.
    ///
    /// # Panics
    /// If an index is not below `classes`.
    #[track_caller]
    pub fn one_hot(&self, index: impl Into<Indices>, classes: usize) -> Var<'_, T> {
        let index = index.into();
        let known = index.as_slice().iter().enumerate().find(|&(_, &at)| at as usize >= classes);
        let known = known.map_or(Ok(()), |(i, at)| Err(format!("index {i} is {at}, but there are {classes} classes")));
        self.fits("one_hot", &[], known);
        self.constant(index.one_hot(classes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_tensor::parallel::PIECE;

    #[test]
    fn pick_many_blocks_are_put_back() {
        let (rows, label) = (PIECE + 7, |row: usize| (row * 7 % 3) as u32);
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::from_fn(&[rows, 3], |i| i as f64));
        let y = x.gather(1, Indices::new(&[rows, 1], (0..rows).map(label).collect::<Vec<_>>()));
        let grad = y.square().sum().grad(&[&x]).remove(0);
        for row in 0..rows {
            let picked = 3 * row + label(row) as usize;
            assert_eq!(y.value()[[row, 0]], picked as f64);
            for place in 3 * row..3 * row + 3 {
                assert_eq!(grad.as_slice()[place], if place == picked { 2.0 * place as f64 } else { 0.0 });
            }
        }
    }

    #[test]
    fn indices_that_do_not_fit_are_shape_errors() {
        let tape = Tape::<f32>::new();
        let x = tape.constant(Tensor::zeros(&[2, 3]));
        let rows = |index: &[u32]| Pick { method: ROWS, axis: 0, places: Places::Entries(index.into()) };
        let elements = |axis, shape: &[usize], index: &[u32]| Pick {
            method: ELEMENTS,
            axis,
            places: Places::Elements(Indices::new(shape, index)),
        };
        let picked = |pick: Pick| tape.try_apply(pick, &[&x]).unwrap_err().to_string();
        let put = |pick, extent| tape.try_apply(Put { pick, extent }, &[&x]).unwrap_err().to_string();
        for (error, expected) in [
            (picked(rows(&[0, 2])), "index 1 is 2, but axis 0 has 2 entries"),
            (put(rows(&[0, 5]), 5), "index 1 is 5, but axis 0 has 5 entries"),
            (put(rows(&[0]), 5), "1 indices for [2, 3] along axis 0"),
            (picked(Pick { axis: 2, ..rows(&[0]) }), "there is no axis 2"),
            (picked(elements(1, &[2, 1], &[0, 3])), "index 1 is 3, but axis 1 has 3 entries"),
            (
                picked(elements(1, &[1, 2], &[0, 0])),
                "indices of shape [1, 2] for [2, 3]: they need 2 axes, of the same extents except along axis 1",
            ),
            (
                picked(elements(1, &[2], &[0, 0])),
                "indices of shape [2] for [2, 3]: they need 2 axes, of the same extents except along axis 1",
            ),
            (
                put(elements(0, &[1, 3], &[0, 0, 0]), 4),
                "indices of shape [1, 3] for [2, 3]: they need 2 axes, of the same extents except along axis 0",
            ),
            (put(elements(0, &[2, 3], &[0, 0, 0, 1, 1, 4]), 4), "index 5 is 4, but axis 0 has 4 entries"),
            // A result that is larger than memory.
            (put(rows(&[0, 0]), 1 << 63), "too many elements"),
            (
                tape.try_run(|| tape.one_hot([1, 3], 3)).unwrap_err().to_string(),
                "index 1 is 3, but there are 3 classes",
            ),
        ] {
            assert!(error.contains(expected), "{error} and {expected}");
        }
        assert!(tape.try_apply(rows(&[0]), &[&tape.constant(Tensor::scalar(1.0))]).is_err());
    }

    #[test]
    fn sums_into_one_row_keep_their_digits() {
        let tape = Tape::<f32>::new();
        let x = tape.constant(Tensor::from_vec(&[3], vec![1e8, 1.0, -1e8]));
        assert_eq!(x.scatter_rows([1, 1, 1], 2).value().as_slice(), [0.0, 1.0]);
        assert_eq!(x.scatter_rows([1, 0, 1], 2).value().as_slice(), [1.0, 0.0]);
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
    fn gather_middle_axis_matches_definition() {
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
