//! Rearrangements made of other operations: transpose, squeeze, stack, split, tile, repeat, roll.

use crate::Var;
use crate::error::ensure;
use raygrad_tensor::{Layout, Scalar, Shape, repeated, split_places, tiled};

impl<'t, T: Scalar> Var<'t, T> {
    /// Swaps two axes, without a copy. Negative axes count from the last one.
    ///
    /// # Panics
    /// If an axis does not exist.
    #[track_caller]
    pub fn transpose(&self, a: isize, b: isize) -> Self {
        self.view("transpose", |layout| layout.transposed(a, b))
    }

    /// Transposes the last two axes, of a matrix or of each matrix of a batch, without a copy.
    ///
    /// # Panics
    /// If there are fewer than two axes.
    #[track_caller]
    pub fn t(&self) -> Self {
        self.view("t", |layout| layout.transposed(-1, -2))
    }

    /// Removes `axis`, whose extent is 1, without a copy.
    ///
    /// # Panics
    /// If the axis does not exist or has another extent.
    #[track_caller]
    pub fn squeeze(&self, axis: isize) -> Self {
        self.reshape(self.fits("squeeze", Layout::contiguous(self.shape()).squeezed(axis)).shape())
    }

    /// Adds a new axis of extent 1 at position `axis`, without a copy. A negative position counts from behind the last
    /// axis.
    ///
    /// # Panics
    /// If there is no such position.
    #[track_caller]
    pub fn unsqueeze(&self, axis: isize) -> Self {
        self.reshape(self.fits("unsqueeze", Layout::contiguous(self.shape()).unsqueezed(axis)).shape())
    }

    /// Joins tensors of one shape along a new axis at position `axis`.
    ///
    /// # Panics
    /// If there are no tensors, their shapes differ, or there is no position `axis`.
    #[track_caller]
    pub fn stack(parts: &[&Self], axis: isize) -> Self {
        let Some(first) = parts.first() else { panic!("stack of no tensors") };
        let same = parts.iter().all(|part| part.shape() == first.shape());
        first.tape().fits("stack", parts, ensure(same, || "the shapes differ".into()));
        first.tape().as_one(|| {
            let parts: Vec<_> = parts.iter().map(|part| part.unsqueeze(axis)).collect();
            // Of negative places those of the axes that are there now.
            Var::concat(&parts.iter().collect::<Vec<_>>(), axis)
        })
    }

    /// Splits along `axis` into consecutive parts of these extents: the inverse of [`concat`](Self::concat).
    ///
    /// # Panics
    /// If the axis does not exist or the extents do not sum up to its extent.
    #[track_caller]
    pub fn split(&self, axis: isize, extents: &[usize]) -> Vec<Self> {
        let places = self.fits("split", split_places(self.shape(), axis, extents));
        places.into_iter().map(|place| self.slice_axis(axis, place)).collect()
    }

    /// Repeats the whole tensor `counts[i]` times along each axis `i` (`numpy.tile`, `torch.Tensor.repeat`). More
    /// counts than axes add leading axes; fewer leave the leading axes unchanged.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from([1.0, 2.0]));
    /// assert_eq!(x.tile(&[2]).value(), [1.0, 2.0, 1.0, 2.0]);
    /// assert_eq!(x.repeat(0, 2).value(), [1.0, 1.0, 2.0, 2.0]);
    /// ```
    ///
    /// # Panics
    /// If there would be more elements than memory can hold.
    #[track_caller]
    pub fn tile(&self, counts: &[usize]) -> Self {
        let [narrow, wide, shape] = self.fits("tile", tiled(self.shape(), counts));
        self.reshape(&narrow).broadcast_to(&wide).reshape(&shape)
    }

    /// Repeats each entry along `axis` `count` times (`numpy.repeat`, `torch.repeat_interleave`).
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn repeat(&self, axis: isize, count: usize) -> Self {
        let [narrow, wide, shape] = self.fits("repeat", repeated(self.shape(), axis, count));
        self.reshape(&narrow).broadcast_to(&wide).reshape(&shape)
    }

    /// Rotates the entries along `axis` by `shift` places towards the end. Entries that leave at the end enter at the
    /// start. A negative shift rotates towards the start. (`numpy.roll` and `torch.roll` take the shift first.)
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn roll(&self, axis: isize, shift: isize) -> Self {
        let extent = self.shape()[self.axis("roll", axis)];
        let shift = shift.rem_euclid(extent.max(1) as isize) as usize;
        if shift == 0 {
            return self.clone();
        }
        let (head, tail) =
            (self.slice_axis(axis, ..(extent - shift) as isize), self.slice_axis(axis, -(shift as isize)..));
        Var::concat(&[&tail, &head], axis)
    }

    /// The coordinates of a grid. Vectors of lengths `[a, b, ..]` give as many tensors of shape `[a, b, ..]`; tensor
    /// `i` varies along axis `i` alone (`indexing="ij"`).
    ///
    /// # Panics
    /// If an operand is not a vector.
    #[track_caller]
    pub fn meshgrid(axes: &[&Self]) -> Vec<Self> {
        for x in axes {
            x.fits("meshgrid", ensure(x.shape().len() == 1, || "not a vector".into()));
        }
        let shape: Shape = axes.iter().map(|x| x.shape()[0]).collect();
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
    use crate::{INFER, Slice, Tape, Tensor, Var};
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
        is(&x.slice_axis(1, Slice::from(0..3).step_by(-2)), &[2, 2], &[2.0, 0.0, 5.0, 3.0]);
        is(&x.slice_axis(1, Slice::from(1..1).step_by(-2)), &[2, 0], &[]);
        is(
            &x.tile(&[2, 1, 2]).slice_axis(0, 1..2),
            &[1, 2, 6],
            &[0.0, 1.0, 2.0, 0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 3.0, 4.0, 5.0],
        );
        is(&x.repeat(0, 2).slice_axis(1, ..1), &[4, 1], &[0.0, 0.0, 3.0, 3.0]);
        is(&x.repeat(1, 0), &[2, 0], &[]);
        is(&x.reshape(&[3, INFER]).slice_axis(0, 1..2), &[1, 2], &[2.0, 3.0]);
        is(&Var::stack(&[&x, &x.flip(1)], 1).slice_axis(0, 1..2), &[1, 2, 3], &[3.0, 4.0, 5.0, 5.0, 4.0, 3.0]);
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
            &|| drop(x.slice_axis(1, 0..4)),
            &|| drop(x.split(1, &[1, 1])),
            &|| drop(x.tile(&[2, usize::MAX])),
            &|| drop(x.repeat(2, 2)),
            &|| drop(x.roll(2, 1)),
            &|| drop(x.reshape(&[4, INFER])),
            &|| drop(x.pad(&[[1, 0]], 0.0)),
        ] {
            let text = panics(f);
            assert!(text.contains("[2, 3]") && text.contains("arrange.rs"), "{text}");
        }
        assert!(panics(&|| drop(x.reshape(&[INFER, INFER]))).contains("one extent"));
        assert!(panics(&|| drop(Var::<f64>::stack(&[], 0))).contains("no tensors"));
        assert!(panics(&|| drop(Var::stack(&[&x, &x.t()], 0))).contains("the shapes differ"));
    }
}
