//! The update of elements by one rule: of all elements of a parameter, or of some rows.

use raygrad_tensor::{Scalar, simd};
use std::marker::PhantomData;

/// The update of one element, with `M` state numbers.
pub(super) trait Rule<T: Scalar, const M: usize>: Sync {
    /// The new value of an element `x` and its new state, after a step against `grad`.
    fn element(&self, x: T, grad: T, memory: [T; M]) -> (T, [T; M]);
}

/// A step of one element: its new value and state, and whether it is skipped. It is skipped, and keeps its state, if
/// its gradient or new value is infinite or NaN.
#[inline(always)]
fn step<T: Scalar, const M: usize>(rule: &impl Rule<T, M>, x: T, grad: T, memory: [T; M]) -> (T, [T; M], bool) {
    let (moved, mut new) = rule.element(x, grad, memory);
    let good = grad.is_finite() && moved.is_finite();
    for k in 0..M {
        new[k] = if good { new[k] } else { memory[k] };
    }
    (if good { moved } else { x }, new, !good)
}

/// Updates all these elements, whose state has one slice for each kind. Returns the number of skipped elements.
pub(super) fn move_all<T: Scalar, const M: usize>(
    x: &mut [T],
    grad: &[T],
    memory: [&mut [T]; M],
    rule: &impl Rule<T, M>,
) -> usize {
    simd::dispatch(
        #[inline(always)]
        || {
            let n = x.len();
            let (grad, mut memory, mut skipped) = (&grad[..n], memory, 0);
            for part in &mut memory {
                *part = &mut std::mem::take(part)[..n];
            }
            for i in 0..n {
                let mut old = [T::ZERO; M];
                for k in 0..M {
                    old[k] = memory[k][i];
                }
                let (moved, new, skip) = step(rule, x[i], grad[i], old);
                x[i] = moved;
                for k in 0..M {
                    memory[k][i] = new[k];
                }
                skipped += usize::from(skip);
            }
            skipped
        },
    )
}

/// Updates `W` elements of a row from position `at` on, whose state has one kind after the other. Returns the number of
/// skipped elements.
#[inline(always)]
fn move_piece<T: Scalar, const M: usize, const W: usize>(
    x: &mut [T],
    grad: &[T],
    memory: &mut [T],
    at: usize,
    rule: &impl Rule<T, M>,
) -> usize {
    let features = x.len();
    // Copies cannot overlap the slices that are written, so that the loop vectorises.
    let (mut values, mut g, mut kept, mut skipped) = ([T::ZERO; W], [T::ZERO; W], [[T::ZERO; W]; M], 0);
    values.copy_from_slice(&x[at..at + W]);
    g.copy_from_slice(&grad[at..at + W]);
    for k in 0..M {
        kept[k].copy_from_slice(&memory[k * features + at..][..W]);
    }
    for i in 0..W {
        let mut old = [T::ZERO; M];
        for k in 0..M {
            old[k] = kept[k][i];
        }
        let (moved, new, skip) = step(rule, values[i], g[i], old);
        values[i] = moved;
        for k in 0..M {
            kept[k][i] = new[k];
        }
        skipped += usize::from(skip);
    }
    x[at..at + W].copy_from_slice(&values);
    for k in 0..M {
        memory[k * features + at..][..W].copy_from_slice(&kept[k]);
    }
    skipped
}

/// A table and the state of its rows, for several tasks that each update other rows.
pub(super) struct Table<'a, T> {
    /// Elements of a row.
    pub features: usize,
    pub values: Shared<'a, T>,
    /// For each row, the numbers of the first kind, then those of the next, so that they are at one place in memory.
    pub memory: Shared<'a, T>,
    /// Steps of each row.
    pub steps: Shared<'a, u32>,
}

/// Distance of prefetching, in rows: rows are at random places.
const AHEAD: usize = 16;

impl<T: Scalar> Table<'_, T> {
    /// Updates those of `rows`, counted from `first` on, whose gradient `[rows, features]` is not zero, by the rule for
    /// their next step. Returns the numbers of updated and skipped elements.
    ///
    /// # Safety
    /// Counted from `first` on, `rows` are rows of the table. No other code accesses them meanwhile.
    #[inline(always)]
    // SAFETY: kept by `Memory`, the only caller, which gives each row to one task.
    pub unsafe fn move_rows<const M: usize, R: Rule<T, M>>(
        &self,
        first: usize,
        rows: &[u32],
        grads: &[T],
        rule: &impl Fn(u32) -> R,
    ) -> [usize; 2] {
        // The usual widths as constants: the loops over a row then unroll into one vector.
        // SAFETY: the caller's promise is the same.
        unsafe {
            match self.features {
                1 => self.move_rows_by::<M, 1, R>(first, rows, grads, rule),
                2 => self.move_rows_by::<M, 2, R>(first, rows, grads, rule),
                4 => self.move_rows_by::<M, 4, R>(first, rows, grads, rule),
                _ => self.move_rows_by::<M, 8, R>(first, rows, grads, rule),
            }
        }
    }

    /// As [`move_rows`](Self::move_rows), in pieces of `W` elements.
    ///
    /// # Safety
    /// As for [`move_rows`](Self::move_rows).
    #[inline(always)]
    // SAFETY: kept by `move_rows`, the only caller.
    unsafe fn move_rows_by<const M: usize, const W: usize, R: Rule<T, M>>(
        &self,
        first: usize,
        rows: &[u32],
        grads: &[T],
        rule: &impl Fn(u32) -> R,
    ) -> [usize; 2] {
        let features = if self.features == W { W } else { self.features };
        let (mut visited, mut skipped) = (0, 0);
        for (place, (&row, grad)) in rows.iter().zip(grads.chunks_exact(features)).enumerate() {
            if let Some(&later) = rows.get(place + AHEAD) {
                let later = first + later as usize;
                self.values.prefetch(later * features, features);
                self.memory.prefetch(M * later * features, M * features);
                self.steps.prefetch(later, 1);
            }
            let mut any = false;
            for i in 0..features {
                any |= grad[i] != T::ZERO;
            }
            if !any {
                continue;
            }
            let row = first + row as usize;
            // SAFETY: the row is in the table, so the products do not overflow, and the elements of another row are
            // others. The caller promises that no other code has this row; the borrows of the last turn have ended.
            let (x, memory, step) = unsafe {
                let x = self.values.get(row * features, features);
                (x, self.memory.get(M * row * features, M * features), self.steps.get(row, 1))
            };
            step[0] = step[0].saturating_add(1);
            let (rule, whole) = (rule(step[0]), features - features % W);
            for at in (0..whole).step_by(W) {
                skipped += move_piece::<T, M, W>(x, grad, memory, at, &rule);
            }
            for at in whole..features {
                skipped += move_piece::<T, M, 1>(x, grad, memory, at, &rule);
            }
            visited += features;
        }
        [visited - skipped, skipped]
    }
}

/// Bytes of a cache line.
pub(super) const LINE: usize = 64;

/// A slice that several tasks write to, each to other elements.
pub(super) struct Shared<'a, T> {
    first: *mut T,
    len: usize,
    _borrow: PhantomData<&'a mut [T]>,
}

// SAFETY: it stands for an exclusive borrow of a slice, whose parts may go to other threads. The callers of `get` ensure
// that no element is borrowed twice. `tasks_share_a_table` has several tasks write.
unsafe impl<T: Send> Sync for Shared<'_, T> {}

impl<'a, T> Shared<'a, T> {
    pub fn new(slice: &'a mut [T]) -> Self {
        Shared { first: slice.as_mut_ptr(), len: slice.len(), _borrow: PhantomData }
    }

    /// `len` elements from `start` on.
    ///
    /// # Safety
    /// No other borrow of any of them may be alive.
    ///
    /// # Panics
    /// If there are fewer.
    #[inline(always)]
    #[allow(clippy::mut_from_ref)] // that is its point
    // SAFETY: kept by `Table::move_rows_by`, the only caller.
    unsafe fn get(&self, start: usize, len: usize) -> &mut [T] {
        assert!(start <= self.len && len <= self.len - start, "elements beyond the table");
        // SAFETY: the range lies within the slice that `new` borrowed, and the caller ensures that no other borrow exists.
        unsafe { std::slice::from_raw_parts_mut(self.first.add(start), len) }
    }

    /// Prefetches the elements from `start` on.
    #[inline(always)]
    fn prefetch(&self, start: usize, len: usize) {
        let line = LINE / size_of::<T>();
        for at in (0..len).step_by(line).chain(len.checked_sub(1)) {
            simd::prefetch(self.first.wrapping_add(start + at));
        }
    }
}
