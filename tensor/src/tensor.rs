//! The tensor: a contiguous array and the pool it came from.

use crate::{Pool, Scalar};
use ndarray::{ArcArray, Array, ArrayView, Dimension, IxDyn};
use smallvec::SmallVec;
use std::fmt;

/// The extents of a tensor's axes; `[]` is a scalar.
pub type Shape = SmallVec<[usize; 4]>;

/// A dense n-dimensional array of `f32` or `f64`, always contiguous and row-major.
///
/// It wraps [`ndarray::ArcArray`]: a clone is a reference count, and conversion from and to ndarray is free where the
/// layout allows. Writing to a shared tensor copies it first.
///
/// ```
/// use raygrad_tensor::Tensor;
/// let x = Tensor::from_vec(&[2, 3], vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0_f32]);
/// assert_eq!(x.shape(), [2, 3]);
/// let y = ndarray::arr2(&[[1.0, 2.0], [3.0, 4.0_f32]]);
/// assert_eq!(Tensor::from(y.t().to_owned()).as_slice(), [1.0, 3.0, 2.0, 4.0]);
/// ```
pub struct Tensor<T: Scalar> {
    /// Some until `drop` takes it apart.
    array: Option<ArcArray<T, IxDyn>>,
    pool: Pool<T>,
}

impl<T: Scalar> Tensor<T> {
    pub(crate) fn pooled(shape: Shape, values: Vec<T>, pool: Pool<T>) -> Self {
        let array = match Array::from_shape_vec(IxDyn(&shape), values) {
            Ok(array) => array.into_shared(),
            Err(_) => unreachable!("the callers give as many values as the shape holds"),
        };
        Tensor { array: Some(array), pool }
    }

    fn inner(&self) -> &ArcArray<T, IxDyn> {
        match &self.array {
            Some(array) => array,
            None => unreachable!("only `drop` and `into_array` take the array"),
        }
    }

    /// A tensor of this shape from its values in row-major order.
    ///
    /// # Panics
    /// If the number of values is not the product of the shape.
    #[track_caller]
    pub fn from_vec(shape: &[usize], values: Vec<T>) -> Self {
        let len: usize = shape.iter().product();
        assert_eq!(len, values.len(), "{} values for a tensor of shape {shape:?}", values.len());
        Tensor::pooled(Shape::from_slice(shape), values, Pool::none())
    }

    /// A tensor of this shape whose element number `i` (row-major) is `f(i)`.
    pub fn from_fn(shape: &[usize], f: impl FnMut(usize) -> T) -> Self {
        Tensor::from_vec(shape, (0..shape.iter().product()).map(f).collect())
    }

    /// A tensor filled with one value.
    pub fn full(shape: &[usize], value: T) -> Self {
        Tensor::from_vec(shape, vec![value; shape.iter().product()])
    }

    /// A tensor of zeros.
    pub fn zeros(shape: &[usize]) -> Self {
        Tensor::full(shape, T::ZERO)
    }

    /// A tensor of ones.
    pub fn ones(shape: &[usize]) -> Self {
        Tensor::full(shape, T::ONE)
    }

    /// A tensor without axes that holds one value.
    pub fn scalar(value: T) -> Self {
        Tensor::from_vec(&[], vec![value])
    }

    /// The extent of each axis.
    pub fn shape(&self) -> &[usize] {
        self.inner().shape()
    }

    /// Number of axes.
    pub fn ndim(&self) -> usize {
        self.inner().ndim()
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        self.inner().len()
    }

    /// Whether an axis has extent 0.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The elements in row-major order.
    pub fn as_slice(&self) -> &[T] {
        match self.inner().as_slice() {
            Some(slice) => slice,
            None => unreachable!("tensors are contiguous by construction"),
        }
    }

    /// The elements for writing; a shared tensor is copied first.
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        if let Some(array) = self.array.take() {
            self.array = Some(match array.try_into_owned_nocopy() {
                Ok(owned) => owned.into_shared(),
                Err(shared) => {
                    let copy = match shared.as_slice() {
                        Some(values) => self.pool.copy_of(shared.shape(), values),
                        None => unreachable!("tensors are contiguous by construction"),
                    };
                    copy.into_shared()
                }
            });
        }
        match self.array.as_mut().and_then(|array| array.as_slice_mut()) {
            Some(slice) => slice,
            None => unreachable!("tensors are contiguous by construction"),
        }
    }

    /// The one element of a tensor with one element.
    ///
    /// # Panics
    /// If the tensor has another number of elements.
    #[track_caller]
    pub fn item(&self) -> T {
        assert_eq!(self.len(), 1, "item() of a tensor of shape {:?}", self.shape());
        self.as_slice()[0]
    }

    /// The same elements under another shape; no copy is made.
    ///
    /// # Panics
    /// If the shapes hold different numbers of elements.
    #[track_caller]
    pub fn reshape(&self, shape: &[usize]) -> Self {
        let len: usize = shape.iter().product();
        assert_eq!(len, self.len(), "cannot reshape {:?} to {shape:?}", self.shape());
        match self.inner().clone().into_shape_with_order(IxDyn(shape)) {
            Ok(array) => Tensor { array: Some(array), pool: self.pool.clone() },
            Err(_) => unreachable!("contiguous tensors of equal length"),
        }
    }

    /// The pool that gave this tensor its buffer.
    pub fn pool(&self) -> &Pool<T> {
        &self.pool
    }

    /// The elements as an ndarray view, for ndarray's own indexing and iteration.
    pub fn view(&self) -> ArrayView<'_, T, IxDyn> {
        self.inner().view()
    }

    fn into_shared(mut self) -> ArcArray<T, IxDyn> {
        match self.array.take() {
            Some(array) => array,
            None => unreachable!("only `drop` and `into_array` take the array"),
        }
    }

    /// The elements as an ndarray array; copied only if another tensor shares them.
    pub fn into_array(self) -> Array<T, IxDyn> {
        self.into_shared().into_owned()
    }

    /// The elements as another number type, rounded to nearest.
    pub fn cast<U: Scalar>(&self) -> Tensor<U> {
        Tensor::from_vec(self.shape(), self.as_slice().iter().map(|&x| U::from_f64(x.to_f64())).collect())
    }

    /// Whether every element is finite.
    pub fn is_finite(&self) -> bool {
        self.as_slice().iter().all(|x| x.is_finite())
    }
}

impl<T: Scalar> Clone for Tensor<T> {
    fn clone(&self) -> Self {
        Tensor { array: self.array.clone(), pool: self.pool.clone() }
    }
}

impl<T: Scalar> Drop for Tensor<T> {
    fn drop(&mut self) {
        if self.pool.is_some()
            && let Some(array) = self.array.take()
            && let Ok(owned) = array.try_into_owned_nocopy()
        {
            self.pool.give(owned.into_raw_vec_and_offset().0);
        }
    }
}

impl<T: Scalar, D: Dimension> From<Array<T, D>> for Tensor<T> {
    /// Free for arrays in standard (row-major) layout; others are copied.
    fn from(array: Array<T, D>) -> Self {
        let array = array.into_dyn();
        let array = if array.is_standard_layout() { array } else { array.as_standard_layout().into_owned() };
        Tensor { array: Some(array.into_shared()), pool: Pool::none() }
    }
}

impl<T: Scalar, D: Dimension> From<ArrayView<'_, T, D>> for Tensor<T> {
    /// A copy of the viewed elements, whatever their strides.
    fn from(view: ArrayView<'_, T, D>) -> Self {
        Tensor::from(view.as_standard_layout().into_owned())
    }
}

impl<T: Scalar> PartialEq for Tensor<T> {
    /// Same shape and equal elements; NaN equals nothing.
    fn eq(&self, other: &Self) -> bool {
        self.inner() == other.inner()
    }
}

impl<T: Scalar> fmt::Debug for Tensor<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Tensor<{}>{:?} {}", T::NAME, self.shape(), self.inner())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writing_to_a_shared_tensor_leaves_the_other_alone() {
        let a = Tensor::full(&[2, 2], 1.0_f64);
        let mut b = a.reshape(&[4]);
        b.as_mut_slice()[0] = 5.0;
        assert_eq!(a.as_slice(), [1.0; 4]);
        assert_eq!(b.as_slice(), [5.0, 1.0, 1.0, 1.0]);
    }

    #[test]
    fn arrays_of_any_layout_become_row_major() {
        let a = Array::from_shape_vec((2, 3), vec![0.0, 1.0, 2.0, 3.0, 4.0, 5.0_f32]).unwrap();
        let reversed = a.slice(ndarray::s![..;-1, ..]);
        assert_eq!(Tensor::from(reversed).as_slice(), [3.0, 4.0, 5.0, 0.0, 1.0, 2.0]);
        let part = a.clone().slice_move(ndarray::s![1.., ..]);
        let mut part = Tensor::from(part);
        assert_eq!(part.as_slice(), [3.0, 4.0, 5.0]);
        part.as_mut_slice()[0] = 9.0;
        assert_eq!(part.into_array().into_raw_vec_and_offset().0.last(), Some(&5.0));
    }

    #[test]
    fn scalars_and_empty_tensors() {
        assert_eq!(Tensor::scalar(3.0_f32).item(), 3.0);
        let empty = Tensor::<f32>::zeros(&[0, 3]);
        assert!(empty.is_empty() && empty.reshape(&[3, 0]).as_slice().is_empty());
    }
}
