//! How the elements of a parameter move: by one rule, whether all of them do or those of some rows.

use raygrad_tensor::{Scalar, simd};
use std::marker::PhantomData;

/// How an optimiser moves one element, of which it remembers `M` numbers.
pub(super) trait Rule<T: Scalar, const M: usize>: Sync {
    /// The new value of an element `x` and what is remembered of it, after a step against `grad`.
    fn element(&self, x: T, grad: T, memory: [T; M]) -> (T, [T; M]);
}

/// A step of one element: its new value and memory, and whether it is left alone with what is remembered of it, because its
/// gradient or its new value is infinite or NaN.
#[inline(always)]
fn step<T: Scalar, const M: usize>(rule: &impl Rule<T, M>, x: T, grad: T, memory: [T; M]) -> (T, [T; M], bool) {
    let (moved, mut new) = rule.element(x, grad, memory);
    let good = grad.is_finite() && moved.is_finite();
    for k in 0..M {
        new[k] = if good { new[k] } else { memory[k] };
    }
    (if good { moved } else { x }, new, !good)
}

/// Moves all these elements, whose memory of each kind lies apart; returns how many were left alone.
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

/// Moves `W` elements of a row from place `at` on, whose memory of one kind lies behind that of another; returns how many
/// were left alone.
#[inline(always)]
fn move_piece<T: Scalar, const M: usize, const W: usize>(
    x: &mut [T],
    grad: &[T],
    memory: &mut [T],
    at: usize,
    rule: &impl Rule<T, M>,
) -> usize {
    let features = x.len();
    // Copies cannot overlap what is written meanwhile, so that the loop vectorises.
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

/// A table and what is remembered of its rows, for several tasks that move rows of their own.
pub(super) struct Table<'a, T> {
    /// Elements of a row.
    pub features: usize,
    pub values: Shared<'a, T>,
    /// For each row the numbers of one kind behind those of another: one place in memory to visit.
    pub memory: Shared<'a, T>,
    /// Steps of each row.
    pub steps: Shared<'a, u32>,
}

/// How many rows ahead of the one that moves are prefetched: they lie at random places.
const AHEAD: usize = 16;

impl<T: Scalar> Table<'_, T> {
    /// Moves those of `rows`, counted from `first` on, whose gradient `[rows, features]` is not zero, by the rule for
    /// their next step. Returns how many of their elements were moved and left alone.
    ///
    /// # Safety
    /// `rows` has no row twice, and nothing else accesses them meanwhile.
    #[inline(always)]
    pub unsafe fn move_rows<const M: usize, R: Rule<T, M>>(
        &self,
        first: usize,
        rows: &[u32],
        grads: &[T],
        rule: &impl Fn(u32) -> R,
    ) -> [usize; 2] {
        // The usual widths as constants: the loops over a row then unroll into one vector.
        // SAFETY: as the caller's.
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
    /// As there.
    #[inline(always)]
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
            // SAFETY: the caller vouches that the row is this call's alone.
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

/// Bytes of a line of the caches.
pub(super) const LINE: usize = 64;

/// A slice that several tasks write to, each to elements of its own.
pub(super) struct Shared<'a, T> {
    first: *mut T,
    len: usize,
    _borrow: PhantomData<&'a mut [T]>,
}

// SAFETY: it stands for an exclusive borrow of a slice whose parts may go to other threads; `get` leaves it to its callers
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
    /// If there are not as many.
    #[inline(always)]
    #[allow(clippy::mut_from_ref)] // that is its point
    // SAFETY: kept by the callers, whose elements are all different.
    unsafe fn get(&self, start: usize, len: usize) -> &mut [T] {
        assert!(start <= self.len && len <= self.len - start, "elements beyond the table");
        // SAFETY: the range lies within the slice that `new` borrowed, and the caller vouches that nobody else holds it.
        unsafe { std::slice::from_raw_parts_mut(self.first.add(start), len) }
    }

    /// Asks the caches for the elements from `start` on.
    #[inline(always)]
    fn prefetch(&self, start: usize, len: usize) {
        let line = LINE / size_of::<T>();
        for at in (0..len).step_by(line).chain(len.checked_sub(1)) {
            simd::prefetch(self.first.wrapping_add(start + at));
        }
    }
}
