//! A pool of buffers: the vectors of dropped tensors, given back to the next tensor of about that size.

use crate::{Scalar, Shape, Tensor};
use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Gives out the buffers of tensors that were dropped before.
///
/// A clone is another handle on the same pool. Tensors made by a pool remember it and give their buffer back when the
/// last reference goes, on whatever thread; so a loop that builds and drops the same graph allocates nothing of tensor
/// size after its first round. [`Pool::none`] makes plain tensors that free their memory.
#[derive(Clone)]
pub struct Pool<T: Scalar>(Option<Arc<Mutex<Shelves<T>>>>);

/// Free buffers by capacity class.
struct Shelves<T> {
    free: HashMap<usize, Vec<Vec<T>>>,
    allocated: usize,
}

/// Tensors of at most this many elements, scalars above all, do without the pool: an allocator is quicker with them.
const SMALL: usize = 64;

/// Buffers are rounded up to a quarter of a power of two, so that sizes that vary from step to step share them; at
/// most 25 % of a buffer is unused.
fn class(len: usize) -> usize {
    let quarter = (len.next_power_of_two() / 8).max(1);
    len.div_ceil(quarter) * quarter
}

/// Unlike `vec!`, which asks the allocator for cleared memory; that is the slow way to get a little of it.
fn zeros<T: Scalar>(len: usize) -> Vec<T> {
    let mut values = Vec::with_capacity(len);
    values.resize(len, T::ZERO);
    values
}

impl<T: Scalar> Pool<T> {
    /// An empty pool.
    pub fn new() -> Self {
        Pool(Some(Arc::new(Mutex::new(Shelves { free: HashMap::new(), allocated: 0 }))))
    }

    /// No pool: tensors allocate and free as vectors do.
    pub fn none() -> Self {
        Pool(None)
    }

    fn shelves(&self) -> Option<MutexGuard<'_, Shelves<T>>> {
        // The shelves are whole at every point where a panic could strike, so a poisoned lock is still good.
        self.0.as_ref().map(|pool| pool.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// How many elements this pool has allocated so far: constant in a steady state.
    pub fn allocated(&self) -> usize {
        self.shelves().map_or(0, |shelves| shelves.allocated)
    }

    /// A vector of `len` elements with unspecified (old) values.
    pub fn take(&self, len: usize) -> Vec<T> {
        let Some(mut shelves) = self.shelves() else { return vec![T::ZERO; len] };
        let class = class(len);
        let mut buffer = match shelves.free.get_mut(&class).and_then(Vec::pop) {
            Some(buffer) => buffer,
            None => {
                shelves.allocated += class;
                drop(shelves);
                let mut buffer = Vec::with_capacity(class);
                buffer.resize(len, T::ZERO);
                return buffer;
            }
        };
        drop(shelves);
        buffer.resize(len, T::ZERO);
        buffer
    }

    /// Puts a vector that [`take`](Self::take) gave out back on its shelf; others are freed.
    pub fn give(&self, buffer: Vec<T>) {
        let capacity = buffer.capacity();
        if capacity == class(capacity)
            && let Some(mut shelves) = self.shelves()
        {
            shelves.free.entry(capacity).or_default().push(buffer);
        }
    }

    /// A tensor of this shape with unspecified (old) values, to be overwritten.
    pub fn tensor(&self, shape: &[usize]) -> Tensor<T> {
        self.filled(shape, |_| ())
    }

    /// A tensor of this shape whose elements `fill` writes; it finds unspecified (old) values there.
    ///
    /// It costs less than [`tensor`](Self::tensor) and writing to that.
    pub fn filled(&self, shape: &[usize], fill: impl FnOnce(&mut [T])) -> Tensor<T> {
        let len = shape.iter().product();
        let small = len <= SMALL;
        let mut values = if small { zeros(len) } else { self.take(len) };
        fill(&mut values);
        Tensor::pooled(Shape::from_slice(shape), values, if small { Pool::none() } else { self.clone() })
    }

    /// A tensor filled with `value`.
    pub fn full(&self, shape: &[usize], value: T) -> Tensor<T> {
        self.filled(shape, |out| out.fill(value))
    }

    /// A tensor of this shape with a copy of `values`.
    ///
    /// # Panics
    /// If the number of values is not the product of the shape.
    #[track_caller]
    pub fn copy_of(&self, shape: &[usize], values: &[T]) -> Tensor<T> {
        self.filled(shape, |out| {
            assert_eq!(out.len(), values.len(), "{} values for a tensor of shape {shape:?}", values.len());
            out.copy_from_slice(values);
        })
    }

    pub(crate) fn is_some(&self) -> bool {
        self.0.is_some()
    }
}

impl<T: Scalar> Default for Pool<T> {
    fn default() -> Self {
        Pool::new()
    }
}

impl<T: Scalar> fmt::Debug for Pool<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Pool({} allocated)", self.allocated())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_tensor_is_the_next_one() {
        let pool = Pool::<f32>::new();
        let first = pool.full(&[10, 100], 1.0);
        let address = first.as_slice().as_ptr();
        let alias = first.clone();
        drop(first);
        let other = pool.tensor(&[1000]);
        assert_ne!(other.as_slice().as_ptr(), address, "a shared buffer must not be given out");
        drop(alias);
        assert_eq!(pool.tensor(&[998]).as_slice().as_ptr(), address);
        assert_eq!(pool.allocated(), 2 * class(1000));
    }

    #[test]
    fn classes_waste_at_most_a_quarter_and_hold_their_size() {
        for len in (65..5000).chain([1 << 20, (1 << 20) + 1]) {
            let class_ = class(len);
            assert!(class_ >= len && class_ * 4 <= len * 5 + 4, "{len} -> {class_}");
            assert_eq!(class(class_), class_);
        }
    }
}
