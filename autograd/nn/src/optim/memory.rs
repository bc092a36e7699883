//! The state of an optimizer, and the steps that use it.

use super::rule::{LINE, Rule, Shared, Table, move_all};
use super::{OptimizerState, ParamUpdate, StateError, UpdateReport};
use crate::Params;
use raygrad_autograd::RowSums;
use raygrad_tensor::{Pool, Scalar, parallel, simd};
use std::sync::atomic::{AtomicUsize, Ordering};

/// The state of an optimizer for the parameters of a store.
#[derive(Debug, Clone)]
pub(super) struct Memory<T: Scalar> {
    /// The names of the state numbers of each element.
    kinds: &'static [&'static str],
    /// Whether a saved state has step counts.
    counts_steps: bool,
    slots: Vec<Slot<T>>,
    /// For gradients that have to be summed.
    pool: Pool<T>,
}

/// The state of one parameter. A parameter that is updated as a whole is a table of one row.
#[derive(Debug, Clone)]
struct Slot<T> {
    /// For each row, the numbers of the first kind, then those of the next.
    numbers: Lines<T>,
    /// Steps of each row; empty before the parameter's first step.
    steps: Vec<u32>,
    /// For each part of the table, its row sums; empty between steps.
    sums: Vec<RowSums<T>>,
}

/// Elements of a whole parameter for one task.
pub(super) const CHUNK: usize = 1 << 14;

/// Rows for one task. The levels of a hash grid must not be split, since the core that summed them has the sums in its
/// caches. A large voxel grid must occupy several cores.
const ROWS: usize = 1 << 16;

impl<T: Scalar> Memory<T> {
    /// An empty state.
    pub fn new(kinds: &'static [&'static str], counts_steps: bool) -> Self {
        Memory { kinds, counts_steps, slots: vec![], pool: Pool::new() }
    }

    /// Updates a parameter by the rule for its next step, counted from 1: `whole`, or `row` for each row of a lazy
    /// parameter. `M` is the number of kinds.
    ///
    /// # Panics
    /// If the parameter has another size than at its first step. Also if the parameter has become lazy, or is not lazy
    /// any more, and there is more than one kind.
    #[track_caller]
    pub fn update<const M: usize, R: Rule<T, M>>(
        &mut self,
        part: ParamUpdate<'_, T>,
        whole: impl FnOnce(u32) -> R,
        row: impl Fn(u32) -> R + Sync,
        report: &mut UpdateReport,
    ) {
        if self.slots.len() <= part.slot {
            self.slots.resize_with(part.slot + 1, || Slot::new(0, 0));
        }
        let (slot, name) = (&mut self.slots[part.slot], part.name);
        let (rows, numbers) = (part.table()[0], M * part.value.len());
        if slot.steps.is_empty() {
            *slot = Slot::new(rows, numbers);
        }
        assert_eq!(slot.numbers.len, numbers, "numbers that are remembered of `{name}`, as at its first step");
        if M < 2 {
            // One number of each element lies at the same place, lazy or not.
            slot.steps.resize(rows, 0);
        }
        let counts = slot.steps.len();
        assert!(
            counts == rows || counts.min(rows) > 1,
            "`{name}` was {}lazy until now",
            if part.lazy { "not " } else { "" }
        );
        assert!(counts == rows, "`{name}` has {rows} rows, and had {counts} at its first step");
        let [moved, skipped] = match part.lazy {
            true => slot.move_rows(part, &self.pool, row),
            false => slot.move_whole(part, &self.pool, whole),
        };
        report.count(name, moved, skipped);
    }

    /// The state of the parameters of this store.
    pub fn state(&self, params: &Params<T>) -> OptimizerState<T> {
        let mut state = OptimizerState::default();
        for (((name, value), id), slot) in params.iter().zip(params.ids()).zip(&self.slots) {
            if slot.steps.is_empty() {
                continue;
            }
            if self.counts_steps {
                // Of one row nothing says whether it was lazy; of several, that they were counted does.
                let rows = value.shape().first().copied().unwrap_or(1);
                let lazy = if rows == 1 { params.moves_rows(id) } else { slot.steps.len() > 1 };
                let steps = slot.steps.iter().map(|&step| step.into()).collect();
                state.put_counts(name, steps_name(lazy), steps);
            }
            let features = value.len() / slot.steps.len();
            for (k, kind) in self.kinds.iter().enumerate() {
                let rows = slot.numbers.as_slice().chunks_exact((self.kinds.len() * features).max(1));
                let numbers = rows.flat_map(|row| &row[k * features..][..features]).copied().collect();
                state.put(name, kind, value.shape(), numbers);
            }
        }
        state
    }

    /// A copy with the state of this store's parameters replaced by a saved one.
    ///
    /// # Errors
    /// If an entry is missing, unknown or of another shape. If it belongs to a lazy parameter that is not lazy here, or
    /// the reverse.
    pub fn loaded(&self, params: &Params<T>, mut state: OptimizerState<T>) -> Result<Self, StateError> {
        let mut slots = vec![];
        for ((name, value), id) in params.iter().zip(params.ids()) {
            let lazy = params.moves_rows(id);
            let rows = if lazy { value.shape().first().copied().unwrap_or(1) } else { 1 };
            let steps = if self.counts_steps {
                let what = match lazy {
                    true => "belongs to a parameter that was not lazy, and this one is",
                    false => "belongs to a lazy parameter, and this one is not",
                };
                state.refuse(name, steps_name(!lazy), &format!("{what}: call Params::set_lazy as before"))?;
                state.take_counts(name, steps_name(lazy), rows)?
            } else {
                self.kinds.iter().any(|kind| state.has(name, kind)).then(|| vec![0; rows])
            };
            let Some(steps) = steps else {
                slots.push(Slot::new(0, 0));
                continue;
            };
            let mut slot = Slot::new(rows, self.kinds.len() * value.len());
            slot.steps = steps.into_iter().map(|step| u32::try_from(step).unwrap_or(u32::MAX)).collect();
            let features = (value.len() / rows).max(1);
            for (k, kind) in self.kinds.iter().enumerate() {
                let numbers = state.take(name, kind, value.shape())?;
                let rows = slot.numbers.as_mut_slice().chunks_exact_mut(self.kinds.len() * features);
                for (row, numbers) in rows.zip(numbers.as_slice().chunks_exact(features)) {
                    row[k * features..][..features].copy_from_slice(numbers);
                }
            }
            slots.push(slot);
        }
        state.refuse_rest()?;
        Ok(Memory { slots, ..Memory::new(self.kinds, self.counts_steps) })
    }
}

/// The name of a parameter's step counts in a saved state.
fn steps_name(lazy: bool) -> &'static str {
    if lazy { "row_steps" } else { "step" }
}

impl<T: Scalar> Slot<T> {
    fn new(rows: usize, numbers: usize) -> Self {
        Slot { numbers: Lines::zeros(numbers), steps: vec![0; rows], sums: vec![] }
    }

    /// Updates all elements. Returns the numbers of updated and skipped ones.
    #[track_caller]
    fn move_whole<const M: usize, R: Rule<T, M>>(
        &mut self,
        part: ParamUpdate<'_, T>,
        pool: &Pool<T>,
        rule: impl FnOnce(u32) -> R,
    ) -> [usize; 2] {
        self.steps[0] = self.steps[0].saturating_add(1);
        let (rule, len, grad) = (rule(self.steps[0]), part.value.len(), part.dense_grad(pool));
        let mut kinds = self.numbers.as_mut_slice().chunks_mut(len.max(1));
        let mut kinds = [(); M].map(|()| kinds.next().unwrap_or_default().chunks_mut(CHUNK));
        let values = part.value.as_mut_slice().chunks_mut(CHUNK).zip(grad.as_slice().chunks(CHUNK));
        let parts = values.map(|(x, g)| (x, g, kinds.each_mut().map(|kind| kind.next().unwrap_or_default())));
        let skipped = AtomicUsize::new(0);
        parallel::each_of(parts, |_, (x, grad, memory)| {
            skipped.fetch_add(move_all(x, grad, memory, &rule), Ordering::Relaxed);
        });
        let skipped = skipped.into_inner();
        [len - skipped, skipped]
    }

    /// Updates the rows whose gradient is not zero. Returns the numbers of updated and skipped elements of these rows.
    /// Parts of the table run in parallel, and are updated while their sums are in the caches.
    #[track_caller]
    fn move_rows<const M: usize, R: Rule<T, M>>(
        &mut self,
        part: ParamUpdate<'_, T>,
        pool: &Pool<T>,
        rule: impl Fn(u32) -> R + Sync,
    ) -> [usize; 2] {
        let ([rows, features], name) = (part.table(), part.name);
        let (shares, parts) = part.row_parts();
        let (in_parts, sizes) = (parts.is_some(), parts.unwrap_or_else(|| vec![rows]));
        // They are put back empty, or not at all: after a panic, the next step must not use them.
        let mut sums = std::mem::take(&mut self.sums);
        if !sums.iter().map(RowSums::table_rows).eq(sizes.iter().copied()) {
            sums = sizes.iter().map(|&rows| RowSums::new(rows, features)).collect();
        }
        // A gradient that does not consist of rows is added up first: then all its rows are there.
        let dense = shares.is_none().then(|| part.dense_grad(pool));
        let table = Table {
            features,
            values: Shared::new(part.value.as_mut_slice()),
            memory: Shared::new(self.numbers.as_mut_slice()),
            steps: Shared::new(&mut self.steps),
        };
        let counts = [const { AtomicUsize::new(0) }; 2];
        parallel::each_of(&mut sums, |part, sums| {
            for share in shares.iter().flatten() {
                if in_parts { share.scatter_part(part, sums) } else { share.scatter(sums) }
            }
            if let Some(dense) = &dense {
                dense.as_slice().chunks_exact(features).enumerate().for_each(|(row, share)| sums.add(row, share));
            }
            // A user's `RowShare` could have replaced the sums, with rows that reach into the next part.
            let size = [sums.table_rows(), sums.features()];
            assert_eq!(size, [sizes[part], features], "rows and features of part {part} of `{name}`");
            let first = sizes[..part].iter().sum();
            parallel::each_of(sums.rows().chunks(ROWS).zip(sums.sums().chunks(ROWS * features)), |_, (rows, sums)| {
                let moved = simd::dispatch(
                    #[inline(always)]
                    // SAFETY: `RowSums` lists a row once, and only rows below its `table_rows`. The assertion above compares
                    // these, and the features, after the last call of a user's code. The sizes add up to the rows of the
                    // table, and without overflow, since sums for all of them were allocated. So the rows from `first` on
                    // are in the table, and no other task or turn of its loop has them. `tasks_share_a_table` and
                    // `parts_share_a_table` run it.
                    || unsafe { table.move_rows(first, rows, sums, &rule) },
                );
                for (count, more) in counts.iter().zip(moved) {
                    count.fetch_add(more, Ordering::Relaxed);
                }
            });
            sums.clear();
        });
        self.sums = sums;
        counts.map(AtomicUsize::into_inner)
    }
}

/// Numbers that start at a cache line, so that a row whose length is a power of two takes as few lines as possible. (A
/// clone may start elsewhere.)
#[derive(Debug, Clone)]
struct Lines<T> {
    values: Vec<T>,
    start: usize,
    len: usize,
}

impl<T: Scalar> Lines<T> {
    fn zeros(len: usize) -> Self {
        let line = LINE / size_of::<T>();
        let values = vec![T::ZERO; len + line];
        let start = values.as_ptr().align_offset(LINE).min(line);
        Lines { values, start, len }
    }

    fn as_slice(&self) -> &[T] {
        &self.values[self.start..self.start + self.len]
    }

    fn as_mut_slice(&mut self) -> &mut [T] {
        &mut self.values[self.start..self.start + self.len]
    }
}

#[cfg(test)]
mod tests;
