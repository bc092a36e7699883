//! The tensor: a shared buffer with a shape and strides.

use crate::layout::{checked_len, len_of};
use crate::pool::Home;
use crate::{Layout, Pool, Scalar};
use smallvec::SmallVec;
use std::slice;
use std::sync::{Arc, OnceLock};

/// The extents of a tensor's axes; `[]` is a scalar.
pub type Shape = SmallVec<[usize; 4]>;

/// An n-dimensional array of `f32` or `f64`: a shared buffer with a shape and strides, as in ndarray.
///
/// Cloning copies a reference. A view (a slice, a transpose, a broadcast, ..) shares the buffer. Writing to a shared
/// tensor copies it first, so a view never changes. A single number needs no buffer, even if it is broadcast.
///
/// Kernels read views without a copy where that is faster. [`as_slice`](Self::as_slice) of a view that is not
/// contiguous copies its elements in row-major order, once for the view and its clones.
///
/// ```
/// use raygrad_tensor::Tensor;
/// let x = Tensor::from_vec(&[2, 3], vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0_f32]);
/// assert_eq!(x.shape(), [2, 3]);
/// let y = ndarray::arr2(&[[1.0, 2.0], [3.0, 4.0_f32]]);
/// assert_eq!(Tensor::from(y.t()), [[1.0, 3.0], [2.0, 4.0]]);
/// ```
#[derive(Clone)]
pub struct Tensor<T: Scalar> {
    shape: Shape,
    data: Data<T>,
    /// None if the elements are the whole buffer in row-major order.
    view: Option<Arc<View<T>>>,
}

#[derive(Clone)]
enum Data<T: Scalar> {
    /// One number, without a buffer.
    One(T),
    Shared(Arc<Buffer<T>>),
}

/// Elements, and the pool that gets them when the last tensor is dropped.
struct Buffer<T: Scalar> {
    values: Vec<T>,
    home: Home<T>,
}

impl<T: Scalar> Drop for Buffer<T> {
    fn drop(&mut self) {
        self.home.pool().give(std::mem::take(&mut self.values));
    }
}

struct View<T: Scalar> {
    layout: Layout,
    /// The elements in row-major order, if the layout has another order and [`Tensor::as_slice`] was called.
    packed: OnceLock<Buffer<T>>,
}

impl<T: Scalar> Tensor<T> {
    /// A tensor with as many values as the shape has elements.
    pub(crate) fn pooled(shape: Shape, values: Vec<T>, pool: Pool<T>) -> Self {
        debug_assert_eq!(checked_len(&shape), Some(values.len()));
        let data = match values[..] {
            [one] => Data::One(one),
            _ => Data::Shared(Arc::new(Buffer { values, home: pool.home() })),
        };
        Tensor { shape, data, view: None }
    }

    /// One number with a shape of one element.
    pub(crate) fn one(shape: Shape, value: T) -> Self {
        Tensor { shape, data: Data::One(value), view: None }
    }

    /// The elements of a buffer that a layout selects.
    pub(crate) fn strided(values: Vec<T>, layout: Layout) -> Self {
        Tensor::pooled(Shape::from_elem(values.len(), 1), values, Pool::none()).with_layout(layout)
    }

    /// Another view of the same buffer.
    pub(crate) fn with_layout(&self, layout: Layout) -> Self {
        debug_assert_eq!(layout.source(), self.buffer().len());
        let shape = Shape::from_slice(layout.shape());
        if layout.is_empty() {
            return Tensor::pooled(shape, vec![], Pool::none());
        }
        let whole = layout.offset() == 0 && layout.len() == layout.source() && layout.is_packed();
        let view = (!whole).then(|| Arc::new(View { layout, packed: OnceLock::new() }));
        Tensor { shape, data: self.data.clone(), view }
    }

    /// The pool of the buffer, for results computed from this tensor.
    pub(crate) fn pool(&self) -> Pool<T> {
        match &self.data {
            Data::One(_) => Pool::none(),
            Data::Shared(buffer) => buffer.home.pool(),
        }
    }

    /// A tensor of this shape, from values in row-major order.
    ///
    /// # Panics
    /// If the number of values is not the product of the shape.
    #[track_caller]
    pub fn from_vec(shape: &[usize], values: Vec<T>) -> Self {
        assert_eq!(checked_len(shape), Some(values.len()), "{} values for a tensor of shape {shape:?}", values.len());
        Tensor::pooled(Shape::from_slice(shape), values, Pool::none())
    }

    /// A tensor of this shape whose element number `i`, in row-major order, is `f(i)`.
    ///
    /// # Panics
    /// If the shape has more elements than memory can hold.
    #[track_caller]
    pub fn from_fn(shape: &[usize], f: impl FnMut(usize) -> T) -> Self {
        Tensor::from_vec(shape, (0..len_of(shape)).map(f).collect())
    }

    /// A tensor filled with one value, which is stored once.
    ///
    /// # Panics
    /// If the shape has more elements than memory can hold.
    #[track_caller]
    pub fn full(shape: &[usize], value: T) -> Self {
        if shape.iter().all(|&extent| extent == 1) {
            return Tensor::one(Shape::from_slice(shape), value);
        }
        Tensor::scalar(value).with_layout(Layout::contiguous(&[]).stretched(shape))
    }

    /// A tensor of zeros.
    ///
    /// # Panics
    /// If the shape has more elements than memory can hold.
    #[track_caller]
    pub fn zeros(shape: &[usize]) -> Self {
        Tensor::full(shape, T::ZERO)
    }

    /// A tensor of ones.
    ///
    /// # Panics
    /// If the shape has more elements than memory can hold.
    #[track_caller]
    pub fn ones(shape: &[usize]) -> Self {
        Tensor::full(shape, T::ONE)
    }

    /// A scalar: a tensor without axes, with one value.
    pub fn scalar(value: T) -> Self {
        Tensor::one(Shape::new(), value)
    }

    /// The extent of each axis.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// Number of axes.
    pub fn ndim(&self) -> usize {
        self.shape.len()
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether an axis has extent 0.
    pub fn is_empty(&self) -> bool {
        self.shape.contains(&0)
    }

    /// The buffer that [`layout`](Self::layout) maps to. It may have elements that this tensor does not use, or fewer
    /// elements than this tensor if some repeat.
    pub fn buffer(&self) -> &[T] {
        match &self.data {
            Data::One(value) => slice::from_ref(value),
            Data::Shared(buffer) => &buffer.values,
        }
    }

    /// The map from each index to an element of [`buffer`](Self::buffer).
    pub fn layout(&self) -> Layout {
        match &self.view {
            Some(view) => view.layout.clone(),
            None => Layout::contiguous(&self.shape),
        }
    }

    /// Whether the elements are contiguous in row-major order, so that [`as_slice`](Self::as_slice) is free.
    pub fn is_packed(&self) -> bool {
        self.view.as_ref().is_none_or(|view| view.layout.is_packed())
    }

    /// The elements in row-major order. If a view has another order, the first call copies the elements; the view and
    /// its clones keep the copy.
    pub fn as_slice(&self) -> &[T] {
        let Some(view) = &self.view else { return self.buffer() };
        if view.layout.is_packed() {
            return &self.buffer()[view.layout.offset()..][..self.len()];
        }
        if let Some(packed) = view.packed.get() {
            return &packed.values;
        }
        // The copy is made before `get_or_init`, where other threads would wait for it: a thread that waits for its
        // helpers may start a task that waits here. The second of two threads drops its copy.
        let pool = self.pool();
        let mut values = pool.take(self.len());
        view.layout.read(self.buffer(), &mut values);
        // The buffer that is dropped returns to the pool.
        let buffer = Buffer { values, home: pool.home() };
        &view.packed.get_or_init(|| buffer).values
    }

    /// The elements in row-major order, for writing. It copies the elements first if another tensor shares them, or if
    /// a view has another order.
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        let whole = self.view.is_none();
        if !(whole && matches!(&self.data, Data::Shared(buffer) if Arc::strong_count(buffer) == 1)) {
            self.own();
        }
        match &mut self.data {
            Data::One(value) => slice::from_mut(value),
            Data::Shared(buffer) => match Arc::get_mut(buffer) {
                Some(buffer) => &mut buffer.values,
                None => unreachable!("`own` leaves a buffer that nobody shares"),
            },
        }
    }

    /// Gives this tensor a buffer that holds its elements alone, in row-major order, and that it does not share.
    fn own(&mut self) {
        if matches!(self.data, Data::One(_)) && self.view.is_none() {
            return;
        }
        let (layout, pool) = (self.layout(), self.pool());
        // A packed copy that no other tensor uses can be taken.
        let packed = self.view.take().and_then(|mut view| Arc::get_mut(&mut view).and_then(|view| view.packed.take()));
        let buffer = packed.unwrap_or_else(|| {
            let mut values = pool.take(layout.len());
            layout.read(self.buffer(), &mut values);
            Buffer { values, home: pool.home() }
        });
        self.data = match buffer.values[..] {
            [one] => Data::One(one),
            _ => Data::Shared(Arc::new(buffer)),
        };
    }

    /// The same elements as a whole buffer in row-major order: this tensor if it is one, else a copy.
    pub fn packed(&self) -> Self {
        if self.view.is_none() {
            return self.clone();
        }
        let mut copy = self.clone();
        copy.own();
        copy
    }

    /// A copy of the elements in row-major order.
    pub fn to_vec(&self) -> Vec<T> {
        match self.is_packed() {
            true => self.as_slice().to_vec(),
            false => {
                let mut values = vec![T::ZERO; self.len()];
                self.layout().read(self.buffer(), &mut values);
                values
            }
        }
    }

    /// As [`to_vec`](Self::to_vec), without a copy if no other tensor shares the buffer.
    pub fn into_vec(mut self) -> Vec<T> {
        if self.view.is_none()
            && let Data::Shared(buffer) = &mut self.data
            && let Some(buffer) = Arc::get_mut(buffer)
        {
            return std::mem::take(&mut buffer.values);
        }
        self.to_vec()
    }

    /// The element of a tensor with one element.
    ///
    /// # Panics
    /// If the tensor does not have exactly one element.
    #[track_caller]
    pub fn item(&self) -> T {
        assert_eq!(self.len(), 1, "item() of a tensor of shape {:?}", self.shape());
        self.as_slice()[0]
    }

    /// Converts the elements to another number type, rounded to nearest.
    pub fn cast<U: Scalar>(&self) -> Tensor<U> {
        // A view stays a view: repeated elements are converted once.
        let cast = |values: &[T]| values.iter().map(|&x| U::from_f64(x.to_f64())).collect();
        match &self.view {
            Some(view) if view.layout.len() >= self.buffer().len() => {
                Tensor::strided(cast(self.buffer()), view.layout.clone())
            }
            _ => Tensor::from_vec(&self.shape, cast(self.as_slice())),
        }
    }

    /// Whether every element is finite.
    pub fn is_finite(&self) -> bool {
        match &self.data {
            Data::One(value) if !self.is_empty() => value.is_finite(),
            // A block has no early end, so that it is vectorised.
            _ => self.as_slice().chunks(1024).all(|block| block.iter().fold(true, |all, x| all & x.is_finite())),
        }
    }
}

impl<T: Scalar> PartialEq for Tensor<T> {
    /// Whether shapes and elements are equal. NaN equals no number.
    fn eq(&self, other: &Self) -> bool {
        self.shape == other.shape && self.view() == other.view()
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
        let a = Tensor::from_fn(&[2, 3], |i| i as f64);
        let (column, mut row) = (a.slice_axis(1, 1..2), a.slice_axis(0, 1..2));
        row.as_mut_slice()[2] = 9.0;
        assert_eq!((a.as_slice(), column.as_slice()), (&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0][..], &[1.0, 4.0][..]));
        assert_eq!(row.as_slice(), [3.0, 4.0, 9.0]);
        // The last owner of a part writes without touching what is gone.
        let mut part = Tensor::from_fn(&[4], |i| i as f64).slice_axis(0, 1..3);
        part.as_mut_slice()[0] = 7.0;
        assert_eq!(part.into_vec(), [7.0, 2.0]);
    }

    #[test]
    fn a_view_is_packed_once_for_all_its_clones() {
        let x = Tensor::from_fn(&[2, 3], |i| i as f32).t();
        let copy = x.clone();
        assert_eq!(x.as_slice(), [0.0, 3.0, 1.0, 4.0, 2.0, 5.0]);
        assert!(std::ptr::eq(x.as_slice(), copy.as_slice()));
        assert!(!x.is_packed() && x.packed().is_packed());
    }

    #[test]
    fn scalars_and_empty_tensors() {
        assert_eq!(Tensor::scalar(3.0_f32).item(), 3.0);
        let mut empty = Tensor::<f32>::zeros(&[0, 3]);
        assert!(empty.is_empty() && empty.reshape(&[3, 0]).as_slice().is_empty());
        assert!(empty.as_mut_slice().is_empty() && empty.into_vec().is_empty());
        // Steps along other axes lead out of a buffer that holds nothing.
        let empty = Tensor::<f32>::from_vec(&[0, 3], vec![]);
        for view in
            [empty.slice(crate::s![.., 1..]), empty.flip(1), empty.t().diagonal(1), empty.slice(crate::s![.., 2])]
        {
            assert!(view.to_vec().is_empty() && view.as_slice().is_empty() && (&view + 1.0).is_empty());
            assert_eq!(view.sum(), 0.0);
        }
        let repeated = Tensor::full(&[3], f32::NAN);
        assert!(
            !repeated.is_finite()
                && Tensor::full(&[0], f32::NAN).is_finite()
                && !repeated.slice(crate::s![1..]).is_finite()
        );
        assert!(Tensor::from([1.0, f32::INFINITY, 2.0]).slice(crate::s![..;2]).is_finite());
        let mut one = Tensor::scalar(1.0_f32);
        one.as_mut_slice()[0] = 2.0;
        assert_eq!((one.item(), one.reshape(&[1, 1]).into_vec()), (2.0, vec![2.0]));
        let mut many = Tensor::scalar(1.0_f32).broadcast_to(&[2, 2]);
        many.as_mut_slice()[3] = 5.0;
        assert_eq!(many.as_slice(), [1.0, 1.0, 1.0, 5.0]);
    }

    #[test]
    fn sizes_that_no_memory_holds_are_refused() {
        for shape in [&[1_usize << 63][..], &[1 << 40, 1 << 40], &[0, 1 << 63, 2]] {
            assert!(std::panic::catch_unwind(|| Tensor::<f32>::zeros(shape)).is_err());
            assert!(std::panic::catch_unwind(|| Tensor::<f32>::from_vec(shape, vec![])).is_err());
        }
        assert!(Tensor::<f32>::zeros(&[0, 1 << 40]).is_empty());
    }
}
