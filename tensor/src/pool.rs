//! A pool that reuses the buffers of dropped tensors.

use crate::layout::len_of;
use crate::parallel::locked;
use crate::{Scalar, Shape, Tensor};
use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, Weak};

/// Reuses the buffers of dropped tensors for new tensors of similar size.
///
/// A clone is another handle to the same pool. A tensor made by a pool returns its buffer when its last reference is
/// dropped, on any thread. If no handle to the pool exists then, the buffer is freed. So a loop that builds and drops
/// the same graph allocates no tensor-sized buffers after its first round. [`Pool::none`] makes plain tensors that free
/// their memory.
#[derive(Clone)]
pub struct Pool<T: Scalar>(Option<Arc<Mutex<Shelves<T>>>>);

/// The reference of a buffer to its pool. It does not keep the pool and its buffers alive.
pub(crate) struct Home<T>(Weak<Mutex<Shelves<T>>>);

impl<T: Scalar> Home<T> {
    /// The pool if a handle to it exists, else none.
    pub fn pool(&self) -> Pool<T> {
        Pool(self.0.upgrade())
    }
}

/// Free buffers by capacity class.
struct Shelves<T> {
    free: HashMap<usize, Shelf<T>>,
    allocated: usize,
}

/// Free buffers of one class.
struct Shelf<T> {
    buffers: Vec<Vec<T>>,
    /// The smallest number of buffers here since the last [`Pool::trim`].
    idle: usize,
}

// Not derived: that would ask the same of T.
impl<T> Default for Shelf<T> {
    fn default() -> Self {
        Shelf { buffers: vec![], idle: 0 }
    }
}

impl<T> Shelf<T> {
    fn take(&mut self) -> Option<Vec<T>> {
        let buffer = self.buffers.pop();
        self.idle = self.idle.min(self.buffers.len());
        buffer
    }
}

/// Tensors of at most this many elements do not use the pool: the allocator is faster for them.
const SMALL: usize = 64;

/// Number of elements from which the operating system clears new memory.
const LARGE: usize = 1 << 18;

/// Rounds a buffer size up to a quarter of a power of two, so that sizes that vary from step to step share buffers. At
/// most 25 % of a buffer is unused.
fn class(len: usize) -> usize {
    let quarter = (len.next_power_of_two() / 8).max(1);
    len.div_ceil(quarter) * quarter
}

/// A new buffer to be overwritten. Where assertions are on, elements that are not overwritten show as NaN.
///
/// Small buffers are cleared here: the allocator would be slower. For large ones the system provides zero pages on
/// first use, on all threads that write.
fn unspecified<T: Scalar>(len: usize, capacity: usize) -> Vec<T> {
    if capacity >= LARGE && !cfg!(debug_assertions) {
        let mut values = vec![T::ZERO; capacity];
        values.truncate(len);
        return values;
    }
    let mut values = Vec::with_capacity(capacity);
    values.resize(len, if cfg!(debug_assertions) { T::from_f64(f64::NAN) } else { T::ZERO });
    values
}

impl<T: Scalar> Pool<T> {
    /// An empty pool.
    pub fn new() -> Self {
        Pool(Some(Arc::new(Mutex::new(Shelves { free: HashMap::new(), allocated: 0 }))))
    }

    /// No pool: tensors allocate and free memory as vectors do.
    pub fn none() -> Self {
        Pool(None)
    }

    fn shelves(&self) -> Option<MutexGuard<'_, Shelves<T>>> {
        // The shelves are whole at every point where a panic could strike, so a poisoned lock is still good.
        self.0.as_ref().map(|pool| locked(pool))
    }

    /// Number of elements that this pool has allocated so far. It is constant in a steady state.
    pub fn allocated(&self) -> usize {
        self.shelves().map_or(0, |shelves| shelves.allocated)
    }

    /// A vector of `len` elements with unspecified (old) values, from the pool if it has one.
    pub fn take(&self, len: usize) -> Vec<T> {
        let Some(mut shelves) = self.shelves() else { return unspecified(len, len) };
        let class = class(len);
        let mut buffer = match shelves.free.get_mut(&class).and_then(Shelf::take) {
            Some(buffer) => buffer,
            None => {
                shelves.allocated += class;
                drop(shelves);
                return unspecified(len, class);
            }
        };
        drop(shelves);
        buffer.resize(len, T::ZERO);
        buffer
    }

    /// Returns a vector from [`take`](Self::take) to the pool. A vector of another capacity is freed.
    pub fn give(&self, buffer: Vec<T>) {
        let capacity = buffer.capacity();
        if capacity > 0
            && capacity == class(capacity)
            && let Some(mut shelves) = self.shelves()
        {
            shelves.free.entry(capacity).or_default().buffers.push(buffer);
        }
    }

    /// Frees the buffers that no tensor has needed since the last call, such as those of sizes that are no longer used.
    pub fn trim(&self) {
        let Some(mut shelves) = self.shelves() else { return };
        for shelf in shelves.free.values_mut() {
            // The oldest: those on top were the last to be used.
            shelf.buffers.drain(..shelf.idle);
            shelf.idle = shelf.buffers.len();
        }
        shelves.free.retain(|_, shelf| !shelf.buffers.is_empty());
    }

    /// A tensor of this shape with unspecified (old) values, to be overwritten.
    ///
    /// # Panics
    /// If the shape has more elements than memory can hold.
    #[track_caller]
    pub fn tensor(&self, shape: &[usize]) -> Tensor<T> {
        self.filled(shape, |_| ())
    }

    /// A tensor of this shape whose elements `fill` writes. `fill` gets unspecified (old) values.
    ///
    /// It is faster than [`tensor`](Self::tensor) and a later write.
    ///
    /// # Panics
    /// If the shape has more elements than memory can hold.
    #[track_caller]
    pub fn filled(&self, shape: &[usize], fill: impl FnOnce(&mut [T])) -> Tensor<T> {
        let len = len_of(shape);
        if len == 1 {
            let mut one = [if cfg!(debug_assertions) { T::from_f64(f64::NAN) } else { T::ZERO }];
            fill(&mut one);
            return Tensor::one(Shape::from_slice(shape), one[0]);
        }
        let mut values = self.buffer(len);
        fill(&mut values);
        self.wrap(shape, values)
    }

    /// A vector with unspecified (old) values, for [`wrap`](Self::wrap).
    pub(crate) fn buffer(&self, len: usize) -> Vec<T> {
        if len <= SMALL { unspecified(len, len) } else { self.take(len) }
    }

    /// A tensor of this shape with the elements of a [`buffer`](Self::buffer).
    pub(crate) fn wrap(&self, shape: &[usize], values: Vec<T>) -> Tensor<T> {
        let small = values.len() <= SMALL;
        Tensor::pooled(Shape::from_slice(shape), values, if small { Pool::none() } else { self.clone() })
    }

    /// A tensor filled with `value`, with memory for each element, for later writes.
    ///
    /// # Panics
    /// If the shape has more elements than memory can hold.
    #[track_caller]
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

    /// The reference to this pool for its buffers.
    pub(crate) fn home(&self) -> Home<T> {
        Home(self.0.as_ref().map_or_else(Weak::new, Arc::downgrade))
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
    fn a_tensor_that_outlives_its_pool_does_not_keep_it() {
        let pool = Pool::<f32>::new();
        drop(pool.full(&[1000], 1.0));
        let survivor = pool.full(&[2000], 2.0);
        let Home(shelves) = pool.home();
        drop(pool);
        assert!(shelves.upgrade().is_none());
        assert_eq!((&survivor + 1.0).as_slice(), [3.0; 2000]);
        assert_eq!(survivor.reshape(&[40, 50]).t().into_vec(), [2.0; 2000]);
    }

    #[test]
    fn a_vector_that_was_taken_out_leaves_nothing_behind() {
        let pool = Pool::<f32>::new();
        drop(pool.full(&[100], 1.0).into_vec());
        assert!(pool.shelves().unwrap().free.is_empty());
    }

    #[test]
    fn what_is_not_written_shows_where_assertions_are_on() {
        for len in [1, SMALL, SMALL + 1, 5000] {
            assert!(Pool::<f32>::new().tensor(&[len]).as_slice().iter().all(|x| x.is_nan() == cfg!(debug_assertions)));
        }
    }

    #[test]
    fn only_what_lies_idle_is_trimmed() {
        let pool = Pool::<f32>::new();
        let free = || pool.shelves().unwrap().free.values().map(|shelf| shelf.buffers.len()).sum::<usize>();
        drop([100, 100, 100, 2000].map(|len| pool.tensor(&[len])));
        pool.trim();
        assert_eq!(free(), 4, "all were in use since the start");
        drop([100, 100].map(|len| pool.tensor(&[len])));
        pool.trim();
        assert_eq!(free(), 2, "one of 100 and the one of 2000 lay idle");
        let allocated = pool.allocated();
        drop([100, 100].map(|len| pool.tensor(&[len])));
        assert_eq!(pool.allocated(), allocated);
        pool.trim();
        pool.trim();
        assert_eq!(free(), 0);
    }

    #[test]
    fn size_class_wastes_at_most_a_quarter() {
        for len in (65..5000).chain([1 << 20, (1 << 20) + 1]) {
            let class_ = class(len);
            assert!(class_ >= len && class_ * 4 <= len * 5 + 4, "{len} -> {class_}");
            assert_eq!(class(class_), class_);
        }
    }
}
