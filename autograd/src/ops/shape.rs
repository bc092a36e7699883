//! Operations that move elements: reshape, permute, slice, flip, pad, concat.

use crate::error::ensure;
use crate::{Grads, Op, Reads, ShapeError, SparseGrad, Var, Vjp};
use raygrad_tensor::{Layout, Pool, Scalar, Shape, Slice, SliceInfoElem, Tensor, checked_len, concat, inferred};
use std::sync::Arc;

/// y = x with another shape.
#[derive(Clone)]
pub struct Reshape {
    /// The shape of the output.
    pub shape: Shape,
}

impl<T: Scalar> Op<T> for Reshape {
    fn name(&self) -> &'static str {
        "reshape"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if checked_len(x[0]) != checked_len(&self.shape) {
            return Err(format!("{:?} holds another number of elements", self.shape));
        }
        Ok(self.shape.clone())
    }

    fn forward(&self, x: &[&Tensor<T>], _pool: &Pool<T>) -> Tensor<T> {
        x[0].reshape(&self.shape)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.g().reshape(cx.shape(0)))
    }
}

/// y = the elements of x that a layout selects: permute, slice and flip. Without a copy. dx = [`Scatter`] of g, or a
/// [`ViewGrad`] in an unrecorded pass.
#[derive(Clone)]
pub struct View {
    /// The shape of the input.
    pub from: Shape,
    /// The position of each output element in the input.
    pub layout: Layout,
}

/// The adjoint of [`View`]: zeros of the input's shape, with g added at the positions of the layout.
#[derive(Clone)]
pub struct Scatter(
    /// The view.
    pub View,
);

impl<T: Scalar> Op<T> for View {
    fn name(&self) -> &'static str {
        "view"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0] != self.from.as_slice() {
            return Err(format!("the layout was made for {:?}", self.from));
        }
        Ok(Shape::from_slice(self.layout.shape()))
    }

    fn forward(&self, x: &[&Tensor<T>], _pool: &Pool<T>) -> Tensor<T> {
        x[0].seen_through(&self.layout)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        // A view of every element once is inverted without a copy.
        if let Some(layout) = self.layout.inverted() {
            let back = View { from: Shape::from_slice(self.layout.shape()), layout };
            return Grads::one(cx.tape().apply(back, &[cx.g()]).reshape(cx.shape(0)));
        }
        if cx.recording() {
            return Grads::one(cx.tape().apply(Scatter(self.clone()), &[cx.g()]));
        }
        Grads::new([None]).with_sparse(0, Arc::new(ViewGrad { view: self.clone(), g: cx.g().value().clone() }))
    }
}

/// The gradient of a [`View`]. It is added in place, so that many views of one tensor share one sum.
struct ViewGrad<T: Scalar> {
    view: View,
    /// The gradient of the view.
    g: Tensor<T>,
}

impl<T: Scalar> SparseGrad<T> for ViewGrad<T> {
    fn shape(&self) -> &[usize] {
        &self.view.from
    }

    fn add_to(&self, dense: &mut Tensor<T>) {
        self.view.layout.add(self.g.as_slice(), dense.as_mut_slice());
    }

    fn is_passing(&self) -> bool {
        true
    }
}

impl<T: Scalar> Op<T> for Scatter {
    fn name(&self) -> &'static str {
        "scatter_view"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0] != self.0.layout.shape() {
            return Err(format!("the layout covers {:?}", self.0.layout.shape()));
        }
        Ok(self.0.from.clone())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.full(&self.0.from, T::ZERO);
        self.0.layout.add(x[0].as_slice(), out.as_mut_slice());
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(self.0.clone(), &[cx.g()]))
    }
}

/// y = a constant, with x at the elements that a layout selects; dx = the [`View`] of g.
#[derive(Clone)]
pub struct Pad {
    /// The position of x in the output.
    pub view: View,
    /// The value elsewhere.
    pub value: f64,
}

impl<T: Scalar> Op<T> for Pad {
    fn name(&self) -> &'static str {
        "pad"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0] != self.view.layout.shape() {
            return Err(format!("the layout covers {:?}", self.view.layout.shape()));
        }
        Ok(self.view.from.clone())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.full(&self.view.from, T::from_f64(self.value));
        self.view.layout.write(x[0].as_slice(), out.as_mut_slice());
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(self.view.clone(), &[cx.g()]))
    }
}

/// y = tensors joined along an axis; each gradient is the input's slice of g.
#[derive(Clone, Copy)]
pub struct Concat {
    /// The axis.
    pub axis: usize,
}

impl<T: Scalar> Op<T> for Concat {
    fn name(&self) -> &'static str {
        "concat"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let mut shape = Shape::from_slice(x[0]);
        if self.axis >= shape.len() {
            return Err(format!("there is no axis {}", self.axis));
        }
        for other in &x[1..] {
            let same = |i: usize| i == self.axis || other[i] == shape[i];
            if other.len() != shape.len() || !(0..shape.len()).all(same) {
                return Err(format!("the extents differ elsewhere than along axis {}", self.axis));
            }
        }
        let extent = x.iter().try_fold(0_usize, |sum, x| sum.checked_add(x[self.axis]));
        shape[self.axis] = extent.ok_or("the sum of the extents is too large")?;
        Ok(shape)
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        concat(x, self.axis, pool)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let mut start = 0;
        Grads::new((0..cx.len()).map(|i| {
            let len = cx.shape(i)[self.axis];
            start += len;
            cx.needs(i).then(|| cx.g().slice_axis(self.axis as isize, start - len..start))
        }))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The same elements with another shape, without a copy. One extent may be [`INFER`](crate::INFER): it follows from
    /// the others.
    ///
    /// ```
    /// use raygrad_autograd::{INFER, Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let images = tape.constant(Tensor::zeros(&[8, 3, 4, 4]));
    /// assert_eq!(images.reshape(&[8, INFER]).shape(), [8, 48]);
    /// ```
    ///
    /// # Panics
    /// If the shape has another number of elements, or more than one extent is [`INFER`](crate::INFER). If an inferred
    /// extent does not follow from the others, because they do not divide the number of elements or one is 0.
    #[track_caller]
    pub fn reshape(&self, shape: &[usize]) -> Self {
        if self.shape() == shape {
            return self.clone();
        }
        let shape = self.fits("reshape", inferred(shape, self.value().len()));
        if self.shape() == shape.as_slice() {
            return self.clone();
        }
        self.tape().apply(Reshape { shape }, &[self])
    }

    /// The elements that a layout of this tensor's shape selects. An invalid layout is an error of operation `op`.
    #[track_caller]
    pub(crate) fn view(&self, op: &'static str, layout: impl FnOnce(&Layout) -> Result<Layout, ShapeError>) -> Self {
        let whole = Layout::contiguous(self.shape());
        let layout = self.fits(op, layout(&whole));
        if layout == whole {
            return self.clone();
        }
        self.tape().apply(View { from: self.shape().into(), layout }, &[self])
    }

    /// Zeros of this shape, with this tensor added at the positions of the layout.
    #[track_caller]
    pub(crate) fn scatter_view(&self, shape: &[usize], layout: Layout) -> Self {
        self.tape().apply(Scatter(View { from: shape.into(), layout }), &[self])
    }

    /// Axis `i` of the result is axis `order[i]` of this tensor, for a valid order.
    #[track_caller]
    pub(crate) fn reordered(&self, order: &[usize]) -> Self {
        self.view("permute", |layout| Ok(layout.permuted(order)))
    }

    /// Pads with `value`: `padding[i]` entries before and after along each axis `i`.
    ///
    /// # Panics
    /// If there is not one pair for each axis, or the result is too large.
    #[track_caller]
    pub fn pad(&self, padding: &[[usize; 2]], value: f64) -> Self {
        let one_each = ensure(padding.len() == self.shape().len(), || format!("{padding:?} names other axes"));
        self.fits("pad", one_each);
        let wide = |(&extent, [a, b]): (&usize, &[usize; 2])| a.checked_add(extent)?.checked_add(*b);
        let from: Option<Shape> = self.shape().iter().zip(padding).map(wide).collect();
        let from = from.filter(|from| checked_len(from).is_some()).ok_or_else(|| format!("{padding:?} is too much"));
        let from = self.fits("pad", from);
        let mut layout = Layout::contiguous(&from);
        for (axis, (&extent, pad)) in self.shape().iter().zip(padding).enumerate() {
            layout = layout.sliced(axis, pad[0], extent, 1);
        }
        self.tape().apply(Pad { view: View { from, layout }, value }, &[self])
    }

    /// Reorders the axes, without a copy: axis `i` of the result is axis `axes[i]` of this tensor.
    ///
    /// # Panics
    /// If `axes` does not list every axis once.
    #[track_caller]
    pub fn permute(&self, axes: &[isize]) -> Self {
        self.view("permute", |layout| layout.permuted_by(axes))
    }

    /// Slices, single entries and new axes, in the notation of ndarray's `s![]`, without a copy. Negative positions
    /// count from the end. A negative step walks backwards from the last entry of its range. Axes that are not listed
    /// stay whole.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor, s};
    /// let tape = Tape::<f64>::new();
    /// let x = tape.leaf(Tensor::from_fn(&[2, 3], |i| i as f64));
    /// let y = x.slice(s![-1, ..;2]);
    /// assert_eq!(y.value(), [3.0, 5.0]);
    /// assert_eq!(y.sum().grad(&[&x])[0], [[0.0, 0.0, 0.0], [1.0, 0.0, 1.0]]);
    /// ```
    ///
    /// # Panics
    /// If more axes are listed than the tensor has, a position is outside its axis, or a step is 0.
    #[track_caller]
    pub fn slice(&self, places: impl AsRef<[SliceInfoElem]>) -> Self {
        self.view("slice", |layout| layout.sliced_by(places.as_ref()))
    }

    /// The entries of a range along one axis, without a copy. The range may be known only at run time: `1..3`, `..-1`,
    /// or with a step `Slice::from(..).step_by(-2)`.
    ///
    /// ```
    /// use raygrad_autograd::{Slice, Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from_fn(&[6], |i| i as f32));
    /// assert_eq!(x.slice_axis(-1, 1..3).value(), [1.0, 2.0]);
    /// assert_eq!(x.slice_axis(0, Slice::from(..-1).step_by(-3)).value(), [4.0, 1.0]);
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist, the range leaves it, or the step is 0.
    #[track_caller]
    #[doc(alias = "narrow")]
    pub fn slice_axis(&self, axis: isize, range: impl Into<Slice>) -> Self {
        self.view("slice_axis", |layout| layout.sliced_axis(axis, range))
    }

    /// Reverses the entries along `axis`, without a copy.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn flip(&self, axis: isize) -> Self {
        self.view("flip", |layout| layout.flipped(axis))
    }

    /// Sliding windows of `size` entries along `axis`, every `step`-th of them, without a copy. The axis counts
    /// windows, and a new last axis the entries of a window.
    ///
    /// # Panics
    /// If the axis does not exist or is shorter than a window, or `size` or `step` is 0.
    #[track_caller]
    pub fn windows(&self, axis: isize, size: usize, step: usize) -> Self {
        self.view("windows", |layout| layout.windows(axis, size, step))
    }

    /// Joins tensors along `axis`.
    ///
    /// # Panics
    /// If there are none, the axis does not exist, or other extents differ.
    #[track_caller]
    #[doc(alias = "cat")]
    pub fn concat(parts: &[&Self], axis: isize) -> Self {
        let Some(first) = parts.first() else { panic!("concat of no tensors") };
        first.tape().apply(Concat { axis: first.axis("concat", axis) }, parts)
    }
}
