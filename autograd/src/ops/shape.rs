//! Operations that move elements: reshape, permute, slice, flip, pad, concat.

use crate::{Grads, Op, Reads, ShapeError, SparseGrad, Var, Vjp};
use raygrad_tensor::{Layout, Pool, Scalar, Shape, Tensor, checked_len, concat};
use std::sync::Arc;

/// Stands for the extent that follows from the others, in [`Var::reshape`].
pub const INFER: usize = usize::MAX;

/// y = x under another shape.
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

/// y = the elements of x that a layout names: permute, slice and flip; nothing is copied. dx = [`Scatter`] of g, unrecorded
/// a [`ViewGrad`].
#[derive(Clone)]
pub struct View {
    /// The shape of the input.
    pub from: Shape,
    /// Where each element of the output stands in the input.
    pub layout: Layout,
}

/// The adjoint of [`View`]: zeros of the input's shape, with g added where the layout says.
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
        if cx.recording() {
            return Grads::one(cx.tape().apply(Scatter(self.clone()), &[cx.g()]));
        }
        // What shows every element once leads back without a copy.
        if let Some(back) = self.layout.inverted() {
            return Grads::one(cx.constant(cx.g().value().seen_through(&back).reshape(cx.shape(0))));
        }
        Grads::new([None]).with_sparse(0, Arc::new(ViewGrad { view: self.clone(), g: cx.g().value().clone() }))
    }
}

/// The gradient of what a [`View`] looks at: it is added in place, so that many views of one tensor cost one sum.
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

/// y = a constant, with x at the elements that a layout names; dx = the [`View`] of g.
#[derive(Clone)]
pub struct Pad {
    /// Where x stands in the output.
    pub view: View,
    /// What stands elsewhere.
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

/// y = several tensors one after another along an axis; each gradient is the slice of g that it made.
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
        shape[self.axis] = x.iter().map(|x| x[self.axis]).sum();
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
            cx.needs(i).then(|| cx.g().slice(self.axis, start - len, len))
        }))
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The same elements under another shape; nothing is copied. One extent may be [`INFER`]: it follows from the
    /// others.
    ///
    /// ```
    /// use raygrad_autograd::{INFER, Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let images = tape.constant(Tensor::zeros(&[8, 3, 4, 4]));
    /// assert_eq!(images.reshape(&[8, INFER]).shape(), [8, 48]);
    /// ```
    ///
    /// # Panics
    /// If the shape holds another number of elements, more than one extent is to be inferred, or the one does not
    /// follow from the others because they do not divide the number of elements or one of them is 0.
    #[track_caller]
    pub fn reshape(&self, shape: &[usize]) -> Self {
        if let Some(axis) = shape.iter().position(|&extent| extent == INFER) {
            let mut known = Shape::from_slice(shape);
            known[axis] = 1;
            assert!(!known.contains(&INFER), "reshape: only one extent can be inferred");
            let (len, product) = (self.value().len(), known.iter().product::<usize>());
            let divides = product > 0 && len.is_multiple_of(product);
            assert!(divides, "reshape of {:?}: no extent follows from the others, {known:?}", self.shape());
            known[axis] = len / product;
            return self.reshape(&known);
        }
        if self.shape() == shape {
            return self.clone();
        }
        self.tape().apply(Reshape { shape: shape.into() }, &[self])
    }

    /// The elements that a layout of this tensor's shape names.
    #[track_caller]
    pub(crate) fn view(&self, layout: Layout) -> Self {
        self.tape().apply(View { from: self.shape().into(), layout }, &[self])
    }

    /// Zeros of this shape, with this tensor added where the layout says.
    #[track_caller]
    pub(crate) fn scatter_view(&self, shape: &[usize], layout: Layout) -> Self {
        self.tape().apply(Scatter(View { from: shape.into(), layout }), &[self])
    }

    /// This tensor with `padding[i]` entries of `value` before and behind along each axis `i`.
    ///
    /// # Panics
    /// If there is not one pair for each axis.
    #[track_caller]
    pub fn pad(&self, padding: &[[usize; 2]], value: f64) -> Self {
        assert_eq!(padding.len(), self.shape().len(), "pad by {padding:?} a tensor of shape {:?}", self.shape());
        let from: Shape = self.shape().iter().zip(padding).map(|(&extent, [a, b])| a + extent + b).collect();
        let mut layout = Layout::contiguous(&from);
        for (axis, (&extent, pad)) in self.shape().iter().zip(padding).enumerate() {
            layout = layout.sliced(axis, pad[0], extent, 1);
        }
        self.tape().apply(Pad { view: View { from, layout }, value }, &[self])
    }

    /// Axis `i` of the result is axis `axes[i]` of this tensor.
    ///
    /// # Panics
    /// If `axes` does not name every axis once.
    #[track_caller]
    pub fn permute(&self, axes: &[usize]) -> Self {
        self.view(Layout::contiguous(self.shape()).permuted(axes))
    }

    /// `len` entries along `axis`, from `start` on.
    ///
    /// # Panics
    /// If the axis does not exist or the entries leave it.
    #[track_caller]
    pub fn slice(&self, axis: usize, start: usize, len: usize) -> Self {
        assert!(axis < self.shape().len(), "slice along axis {axis} of a tensor of shape {:?}", self.shape());
        if start == 0 && len == self.shape()[axis] {
            return self.clone();
        }
        self.view(Layout::contiguous(self.shape()).sliced(axis, start, len, 1))
    }

    /// The entries along `axis` in reverse order.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn flip(&self, axis: usize) -> Self {
        assert!(axis < self.shape().len(), "flip along axis {axis} of a tensor of shape {:?}", self.shape());
        let len = self.shape()[axis];
        self.view(Layout::contiguous(self.shape()).sliced(axis, len.saturating_sub(1), len, -1))
    }

    /// Tensors one after another along `axis`.
    ///
    /// # Panics
    /// If there is none, the axis does not exist, or other extents differ.
    #[track_caller]
    pub fn concat(parts: &[&Self], axis: usize) -> Self {
        let Some(first) = parts.first() else { panic!("concat of no tensors") };
        first.tape().apply(Concat { axis }, parts)
    }
}
