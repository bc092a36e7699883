//! Rearrangements that are made of other operations: axes added and dropped, tensors stacked, split, tiled and rolled.

use crate::Var;
use raygrad_tensor::{Layout, Scalar, Shape};
use std::ops::Range;

impl<'t, T: Scalar> Var<'t, T> {
    /// Two axes exchanged.
    ///
    /// # Panics
    /// If an axis does not exist.
    #[track_caller]
    pub fn transpose(&self, a: usize, b: usize) -> Self {
        let ndim = self.shape().len();
        assert!(a < ndim && b < ndim, "transpose of axes {a} and {b} of a tensor of shape {:?}", self.shape());
        let mut axes: Shape = (0..ndim).collect();
        axes.swap(a, b);
        self.permute(&axes)
    }

    /// The last two axes exchanged: the transpose of a matrix, or of each matrix of a batch; nothing is copied.
    ///
    /// # Panics
    /// If there are less than two axes.
    #[track_caller]
    pub fn t(&self) -> Self {
        let ndim = self.shape().len();
        assert!(ndim >= 2, "transpose of a tensor of shape {:?}", self.shape());
        self.transpose(ndim - 2, ndim - 1)
    }

    /// This tensor without `axis`, which has extent 1; nothing is copied.
    ///
    /// # Panics
    /// If the axis does not exist or has another extent.
    #[track_caller]
    pub fn squeeze(&self, axis: usize) -> Self {
        assert!(self.shape().get(axis) == Some(&1), "squeeze of axis {axis} of a tensor of shape {:?}", self.shape());
        let mut shape = Shape::from_slice(self.shape());
        shape.remove(axis);
        self.reshape(&shape)
    }

    /// This tensor with a new axis of extent 1 that stands at place `axis`; nothing is copied.
    ///
    /// # Panics
    /// If `axis` is larger than the number of axes.
    #[track_caller]
    pub fn unsqueeze(&self, axis: usize) -> Self {
        let mut shape = Shape::from_slice(self.shape());
        assert!(axis <= shape.len(), "unsqueeze at axis {axis} of a tensor of shape {shape:?}");
        shape.insert(axis, 1);
        self.reshape(&shape)
    }

    /// The entries `range` along `axis`, every `step`-th of them. A negative step starts at the last entry of the range
    /// and walks backwards, as in ndarray.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from_fn(&[6], |i| i as f32));
    /// assert_eq!(x.slice_step(0, 1..6, 2).value().as_slice(), [1.0, 3.0, 5.0]);
    /// assert_eq!(x.slice_step(0, 0..5, -3).value().as_slice(), [4.0, 1.0]);
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist, the range leaves it or is reversed, or the step is 0.
    #[track_caller]
    pub fn slice_step(&self, axis: usize, range: Range<usize>, step: isize) -> Self {
        let shape = self.shape();
        let fits = axis < shape.len() && range.start <= range.end && range.end <= shape[axis];
        assert!(fits && step != 0, "slice {range:?} by {step} along axis {axis} of a tensor of shape {shape:?}");
        let start = if step > 0 { range.start } else { range.end.saturating_sub(1) };
        let len = range.len().div_ceil(step.unsigned_abs());
        self.view(Layout::contiguous(shape).sliced(axis, start, len, step))
    }

    /// Tensors of one shape along a new axis, which stands at place `axis`.
    ///
    /// # Panics
    /// If there is none, their shapes differ, or `axis` is larger than their number of axes.
    #[track_caller]
    pub fn stack(parts: &[&Self], axis: usize) -> Self {
        let Some(first) = parts.first() else { panic!("stack of no tensors") };
        for part in parts {
            assert_eq!(part.shape(), first.shape(), "stack of tensors of different shapes");
        }
        let parts: Vec<_> = parts.iter().map(|part| part.unsqueeze(axis)).collect();
        Var::concat(&parts.iter().collect::<Vec<_>>(), axis)
    }

    /// Consecutive parts along `axis`, of these extents: the inverse of [`concat`](Self::concat).
    ///
    /// # Panics
    /// If the axis does not exist or the extents do not sum up to its extent.
    #[track_caller]
    pub fn split(&self, axis: usize, extents: &[usize]) -> Vec<Self> {
        let total = Some(extents.iter().sum());
        let shape = self.shape();
        assert!(shape.get(axis).copied() == total, "split into {extents:?} along axis {axis} of shape {shape:?}");
        let mut start = 0;
        let mut parts = Vec::with_capacity(extents.len());
        for &len in extents {
            parts.push(self.slice(axis, start, len));
            start += len;
        }
        parts
    }

    /// The whole tensor `counts[i]` times along each axis `i` (`numpy.tile`, `torch.repeat`). More counts than axes add
    /// leading axes.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from_vec(&[2], vec![1.0, 2.0]));
    /// assert_eq!(x.tile(&[2]).value().as_slice(), [1.0, 2.0, 1.0, 2.0]);
    /// assert_eq!(x.repeat(0, 2).value().as_slice(), [1.0, 1.0, 2.0, 2.0]);
    /// ```
    ///
    /// # Panics
    /// If there are less counts than axes.
    #[track_caller]
    pub fn tile(&self, counts: &[usize]) -> Self {
        let shape = self.shape();
        let lead = counts.len().checked_sub(shape.len());
        let Some(lead) = lead else { panic!("{} counts to tile a tensor of shape {shape:?}", counts.len()) };
        let extent = |i: usize| if i < lead { 1 } else { shape[i - lead] };
        let narrow: Shape = (0..counts.len()).flat_map(|i| [1, extent(i)]).collect();
        let wide: Shape = (0..counts.len()).flat_map(|i| [counts[i], extent(i)]).collect();
        let out: Shape = (0..counts.len()).map(|i| counts[i] * extent(i)).collect();
        self.reshape(&narrow).broadcast_to(&wide).reshape(&out)
    }

    /// Each entry along `axis`, `count` times (`numpy.repeat`, `torch.repeat_interleave`).
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn repeat(&self, axis: usize, count: usize) -> Self {
        let mut shape = Shape::from_slice(self.shape());
        assert!(axis < shape.len(), "repeat along axis {axis} of a tensor of shape {shape:?}");
        let mut wide = shape.clone();
        wide.insert(axis + 1, count);
        shape[axis] *= count;
        self.unsqueeze(axis + 1).broadcast_to(&wide).reshape(&shape)
    }

    /// The entries along `axis` moved `shift` places towards the end; what leaves there comes in at the start. A
    /// negative shift moves towards the start.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn roll(&self, axis: usize, shift: isize) -> Self {
        assert!(axis < self.shape().len(), "roll along axis {axis} of a tensor of shape {:?}", self.shape());
        let extent = self.shape()[axis];
        let shift = shift.rem_euclid(extent.max(1) as isize) as usize;
        if shift == 0 {
            return self.clone();
        }
        let (head, tail) = (self.slice(axis, 0, extent - shift), self.slice(axis, extent - shift, shift));
        Var::concat(&[&tail, &head], axis)
    }

    /// The coordinates of a grid: for vectors of lengths `[a, b, ..]` as many tensors of shape `[a, b, ..]`, number `i`
    /// varying along axis `i` alone (`indexing="ij"`).
    ///
    /// # Panics
    /// If one is not a vector.
    #[track_caller]
    pub fn meshgrid(axes: &[&Self]) -> Vec<Self> {
        let extent = |x: &&Self| match *x.shape() {
            [extent] => extent,
            _ => panic!("meshgrid of a tensor of shape {:?}", x.shape()),
        };
        let shape: Shape = axes.iter().map(extent).collect();
        let mut grids = Vec::with_capacity(axes.len());
        for (i, x) in axes.iter().enumerate() {
            let mut own = Shape::from_elem(1, shape.len());
            own[i] = shape[i];
            grids.push(x.reshape(&own).broadcast_to(&shape));
        }
        grids
    }
}

#[cfg(test)]
mod tests {
    use crate::{INFER, Tape, Tensor, Var};
    use std::panic::{AssertUnwindSafe, catch_unwind};

    /// 0, 1, 2, .. in this shape.
    fn count<'t>(tape: &'t Tape<f64>, shape: &[usize]) -> Var<'t, f64> {
        tape.constant(Tensor::from_fn(shape, |i| i as f64))
    }

    #[test]
    fn values_stand_where_numpy_puts_them() {
        let tape = Tape::new();
        let x = count(&tape, &[2, 3]);
        let is = |y: &Var<'_, f64>, shape: &[usize], values: &[f64]| {
            assert_eq!((y.shape(), y.value().as_slice()), (shape, values));
        };
        is(&x.t(), &[3, 2], &[0.0, 3.0, 1.0, 4.0, 2.0, 5.0]);
        is(&x.roll(1, 1), &[2, 3], &[2.0, 0.0, 1.0, 5.0, 3.0, 4.0]);
        is(&x.roll(1, -4), &[2, 3], &[1.0, 2.0, 0.0, 4.0, 5.0, 3.0]);
        is(&x.slice_step(1, 0..3, -2), &[2, 2], &[2.0, 0.0, 5.0, 3.0]);
        is(&x.slice_step(1, 1..1, -2), &[2, 0], &[]);
        is(
            &x.tile(&[2, 1, 2]).slice(0, 1, 1),
            &[1, 2, 6],
            &[0.0, 1.0, 2.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 3.0, 4.0, 5.0],
        );
        is(&x.repeat(0, 2).slice(1, 0, 1), &[4, 1], &[0.0, 0.0, 3.0, 3.0]);
        is(&x.repeat(1, 0), &[2, 0], &[]);
        is(&x.reshape(&[3, INFER]).slice(0, 1, 1), &[1, 2], &[2.0, 3.0]);
        is(&Var::stack(&[&x, &x.flip(1)], 1).slice(0, 1, 1), &[1, 2, 3], &[3.0, 4.0, 5.0, 5.0, 4.0, 3.0]);
        is(&Var::stack(&[&x.sum(), &x.mean()], 0), &[2], &[15.0, 2.5]);
        let parts = x.split(1, &[1, 0, 2]);
        is(&parts[0], &[2, 1], &[0.0, 3.0]);
        is(&parts[1], &[2, 0], &[]);
        is(&parts[2], &[2, 2], &[1.0, 2.0, 4.0, 5.0]);
        is(&x.pad(&[[1, 0], [0, 1]], 9.0), &[3, 4], &[9.0, 9.0, 9.0, 9.0, 0.0, 1.0, 2.0, 9.0, 3.0, 4.0, 5.0, 9.0]);
        is(&x.tril(0), &[2, 3], &[0.0, 0.0, 0.0, 3.0, 4.0, 0.0]);
        is(&x.triu(1), &[2, 3], &[0.0, 1.0, 2.0, 0.0, 0.0, 5.0]);
        is(&x.diag(1), &[2], &[1.0, 5.0]);
        is(&count(&tape, &[2]).diag(-1), &[3, 3], &[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        let grids = Var::meshgrid(&[&count(&tape, &[2]), &count(&tape, &[3])]);
        is(&grids[0], &[2, 3], &[0.0, 0.0, 0.0, 1.0, 1.0, 1.0]);
        is(&grids[1], &[2, 3], &[0.0, 1.0, 2.0, 0.0, 1.0, 2.0]);
        is(&x.unsqueeze(2).squeeze(2), &[2, 3], x.value().as_slice());
    }

    #[test]
    fn what_does_not_fit_panics_with_the_shape() {
        let tape = Tape::new();
        let x = count(&tape, &[2, 3]);
        let panics = |f: &dyn Fn()| {
            let payload = catch_unwind(AssertUnwindSafe(f)).unwrap_err();
            let text = payload.downcast_ref::<String>().cloned();
            text.or_else(|| payload.downcast_ref::<&str>().map(|text| text.to_string())).unwrap()
        };
        for f in [
            &(|| drop(x.transpose(0, 2))) as &dyn Fn(),
            &|| drop(x.squeeze(0)),
            &|| drop(x.unsqueeze(3)),
            &|| drop(x.slice_step(1, 0..4, 1)),
            &|| drop(x.slice_step(1, 0..2, 0)),
            &|| drop(x.split(1, &[1, 1])),
            &|| drop(x.tile(&[2])),
            &|| drop(x.repeat(2, 2)),
            &|| drop(x.roll(2, 1)),
            &|| drop(x.reshape(&[4, INFER])),
            &|| drop(x.pad(&[[1, 0]], 0.0)),
        ] {
            assert!(panics(f).contains("[2, 3]"), "{}", panics(f));
        }
        assert!(panics(&|| drop(x.reshape(&[INFER, INFER]))).contains("one extent"));
        assert!(panics(&|| drop(Var::<f64>::stack(&[], 0))).contains("no tensors"));
        assert!(panics(&|| drop(Var::stack(&[&x, &x.t()], 0))).contains("different shapes"));
    }
}
