//! An optimiser for tables of which a step touches few rows: embeddings, hash grids.

use super::limits::{flushed, limited, tiny_square};
use super::settings::or_panic;
use crate::AdamConfig;
use raygrad_autograd::RowSums;
use raygrad_tensor::{Scalar, checked_len, parallel, simd};
use std::marker::PhantomData;
use std::ops::Add;
use std::sync::{Arc, Mutex, PoisonError};

/// What a step of [`RowAdam`] did.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct RowStats {
    /// Rows that were moved.
    pub touched: usize,
    /// Rows that were left alone because their gradient holds an infinite value or NaN.
    pub skipped: usize,
}

impl Add for RowStats {
    type Output = RowStats;
    fn add(self, other: RowStats) -> RowStats {
        RowStats { touched: self.touched + other.touched, skipped: self.skipped + other.skipped }
    }
}

/// Rows that one task visits: so many that the levels of a hash grid, whose sums are still in the caches of the core that
/// added them up, are not torn apart, and so few that a large voxel grid keeps several cores busy.
const CHUNK: usize = 1 << 16;

/// Lazy Adam: the update of [`Adam`](crate::Adam) for those rows of a table whose gradient is not zero.
///
/// Rows without gradient are not read: their moments do not decay, and their bias correction stands still, because each
/// row counts its own steps. This is another optimiser than Adam: a row that gets one late gradient moves by about one
/// learning rate, where dense Adam, which has corrected its moments away by then, moves it over the following steps too.
/// Where every row has a gradient in every step, the two agree.
///
/// One `RowAdam` looks after one range of rows; a table that several workers share has one for each range, and as
/// every row is updated by itself, in place, the result depends neither on the ranges nor on the threads.
#[derive(Debug, Clone)]
pub struct RowAdam<T> {
    rule: Arc<Rule<T>>,
    features: usize,
    /// For each row first its first moments, then its second ones: one place in memory to visit.
    moments: Lines<T>,
    /// Steps of each row, at most the length of the rule's corrections.
    steps: Vec<u32>,
}

/// The constants of an update.
#[derive(Debug)]
struct Rule<T> {
    beta: [T; 2],
    rest: [T; 2],
    epsilon: T,
    /// For each step count, from 1 on, the factors of learning rate and epsilon that correct the moments' bias:
    /// `sqrt(1 - beta2^t) / (1 - beta1^t)` and `sqrt(1 - beta2^t)`. The last stands for all later ones.
    corrections: Vec<[T; 2]>,
}

impl<T: Scalar> Rule<T> {
    /// Where the corrections end even if they are not yet 1, which matters to a beta2 above 0.9998 only.
    const LONGEST: usize = 1 << 17;

    fn new(AdamConfig { beta1, beta2, epsilon }: AdamConfig) -> Self {
        let mut corrections = vec![];
        for t in 1..=Self::LONGEST {
            // 1 - beta^t without cancellation.
            let [first, second] = [beta1, beta2].map(|beta| -(t as f64 * beta.ln()).exp_m1());
            let factors = [second.sqrt() / first, second.sqrt()].map(T::from_f64);
            corrections.push(factors);
            if factors == [T::ONE; 2] {
                break;
            }
        }
        Rule {
            beta: [beta1, beta2].map(T::from_f64),
            rest: [1.0 - beta1, 1.0 - beta2].map(T::from_f64),
            epsilon: T::from_f64(epsilon),
            corrections,
        }
    }

    /// Learning rate and epsilon with the bias corrected after `step` steps, at least 1.
    #[inline(always)]
    fn corrected(&self, step: u32, rate: T) -> [T; 2] {
        let [rate_factor, epsilon_factor] = self.corrections[step as usize - 1];
        [rate * rate_factor, self.epsilon * epsilon_factor]
    }

    /// The new value and moments of an element with gradient `g`.
    #[inline(always)]
    fn element(&self, [x, g, m, v]: [T; 4], [rate, epsilon]: [T; 2]) -> [T; 3] {
        let g = limited(g);
        let m = flushed(self.beta[0] * m + self.rest[0] * g);
        let v = self.beta[1] * v + self.rest[1] * (g * g);
        let v = if v > tiny_square() { v } else { T::ZERO };
        [x - rate * m / (v.sqrt() + epsilon), m, v]
    }
}

impl<T: Scalar> RowAdam<T> {
    /// An optimiser of `rows` rows of `features` numbers that has seen nothing.
    ///
    /// # Panics
    /// If `features` is 0, the table is larger than memory, or [`AdamConfig::check`] finds something.
    #[track_caller]
    pub fn new(config: AdamConfig, rows: usize, features: usize) -> Self {
        or_panic(config.check());
        RowAdam { rule: Arc::new(Rule::new(config)), features, moments: Lines::zeros(0), steps: vec![] }
            .fresh([rows, features])
    }

    /// The same constants, shared, and nothing seen, for another range of `rows` rows of `features` numbers.
    ///
    /// # Panics
    /// If `features` is 0, or the table is larger than memory.
    #[track_caller]
    pub fn fresh(&self, [rows, features]: [usize; 2]) -> Self {
        assert!(features > 0, "rows without features");
        // Rows are found by products of these.
        assert!(checked_len(&[2, rows, features]).is_some(), "a table of {rows} rows of {features} numbers");
        RowAdam { rule: self.rule.clone(), features, moments: Lines::zeros(2 * rows * features), steps: vec![0; rows] }
    }

    /// Moves the rows of `table` `[rows, features]` that `sums` names against their sum with learning rate `rate`, except
    /// those whose sum is zero; then nothing is in `sums` any more. A row that is moved is multiplied by `1 - rate decay`
    /// before (as in [`AdamW`](crate::AdamW)). Work on many rows is spread over the current rayon pool.
    ///
    /// # Panics
    /// If a length is not that of this optimiser's rows.
    #[track_caller]
    pub fn step(&mut self, table: &mut [T], sums: &mut RowSums<T>, rate: f64, decay: f64) -> RowStats {
        self.step_parts(table, std::slice::from_mut(sums), |_, _| {}, rate, decay)
    }

    /// As [`step`](Self::step) for a table in parts, one after another, each with its own sums: `fill` adds to the sums of
    /// the part of that number what it has to, and the part's rows are moved while the sums are in the caches. Parts are
    /// worked on side by side.
    ///
    /// # Panics
    /// If a length is not that of this optimiser's rows, or `fill` puts sums of another length in the place of a part's.
    #[track_caller]
    pub fn step_parts(
        &mut self,
        table: &mut [T],
        parts: &mut [RowSums<T>],
        fill: impl Fn(usize, &mut RowSums<T>) + Sync,
        rate: f64,
        decay: f64,
    ) -> RowStats {
        assert_eq!(table.len(), self.steps.len() * self.features, "a table of the optimiser's rows");
        let rows: usize = parts.iter().map(RowSums::table_rows).sum();
        assert!(
            rows == self.steps.len() && parts.iter().all(|sums| sums.features() == self.features),
            "sums of its rows"
        );
        // A factor of a parameter may take the rate where `f32` ends; a row is not to become infinite there.
        let rate = rate.min(1e30);
        let (features, keep, rate) = (self.features, T::from_f64(1.0 - rate * decay), T::from_f64(rate));
        let update = Update {
            rule: &self.rule,
            features,
            rate,
            keep,
            table: Rows::new(table),
            moments: Rows::new(self.moments.as_mut_slice()),
            steps: Rows::new(&mut self.steps),
        };
        let sizes: Vec<usize> = parts.iter().map(RowSums::table_rows).collect();
        let firsts = sizes.iter().scan(0, |end, size| {
            *end += size;
            Some(*end - size)
        });
        let firsts: Vec<usize> = firsts.collect();
        let stats = Mutex::new(RowStats::default());
        let step = |part: usize, sums: &mut RowSums<T>| {
            fill(part, sums);
            // The sums were the caller's for that long. Those of more rows would reach into the next part.
            let size = [sums.table_rows(), sums.features()];
            assert_eq!(size, [sizes[part], features], "rows and features of part {part} after `fill`");
            parallel::each_of(
                sums.rows().chunks(CHUNK).zip(sums.sums().chunks(CHUNK * features)),
                |_, (rows, sums)| {
                    let moved = simd::dispatch(
                        #[inline(always)]
                        || update.visit(firsts[part], rows, sums),
                    );
                    let mut stats = parallel::locked(&stats);
                    *stats = stats.add(moved);
                },
            );
            sums.clear();
        };
        parallel::each_of(parts, step);
        stats.into_inner().unwrap_or_else(PoisonError::into_inner)
    }

    /// The first and the second moments, `[rows, features]` each.
    pub fn moments(&self) -> [Vec<T>; 2] {
        let features = self.features;
        let rows = self.moments.as_slice().chunks_exact(2 * features);
        let half = |which: usize| rows.clone().flat_map(|row| row[which * features..][..features].to_vec()).collect();
        [half(0), half(1)]
    }

    /// How many steps each row has taken. Counting ends where the bias is corrected away.
    pub fn row_steps(&self) -> Vec<u64> {
        self.steps.iter().map(|&step| step.into()).collect()
    }

    /// Goes on from what [`moments`](Self::moments) and [`row_steps`](Self::row_steps) gave.
    ///
    /// # Panics
    /// If a length is not that of this optimiser's rows.
    #[track_caller]
    pub fn load(&mut self, [first, second]: [&[T]; 2], row_steps: &[u64]) {
        let features = self.features;
        assert_eq!([first.len(), second.len()], [self.steps.len() * features; 2], "moments of the optimiser's rows");
        assert_eq!(row_steps.len(), self.steps.len(), "steps of the optimiser's rows");
        let moments = first.chunks_exact(features).zip(second.chunks_exact(features));
        for (row, (first, second)) in self.moments.as_mut_slice().chunks_exact_mut(2 * features).zip(moments) {
            row[..features].copy_from_slice(first);
            row[features..].copy_from_slice(second);
        }
        let most = self.rule.corrections.len() as u64;
        self.steps = row_steps.iter().map(|&step| step.min(most) as u32).collect();
    }
}

/// Numbers that begin where a line of the caches begins, so that a row of a power of two of them takes as few lines as it
/// can. (A clone may begin elsewhere.)
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

/// Bytes of a line of the caches.
const LINE: usize = 64;

/// Rows that several tasks write to, each to rows of its own.
struct Rows<'a, T> {
    first: *mut T,
    len: usize,
    _borrow: PhantomData<&'a mut [T]>,
}

// SAFETY: it stands for an exclusive borrow of a slice whose parts may go to other threads; `get` leaves it to its callers
// that no element is borrowed twice. `tasks_share_a_table` has several tasks write.
unsafe impl<T: Send> Sync for Rows<'_, T> {}

impl<'a, T> Rows<'a, T> {
    fn new(rows: &'a mut [T]) -> Self {
        Rows { first: rows.as_mut_ptr(), len: rows.len(), _borrow: PhantomData }
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
    // SAFETY: kept by the callers, whose rows are all different.
    unsafe fn get(&self, start: usize, len: usize) -> &mut [T] {
        assert!(start <= self.len && len <= self.len - start, "rows beyond the table");
        // SAFETY: the range lies within the slice that `new` borrowed, and the caller vouches that nobody else holds it.
        unsafe { std::slice::from_raw_parts_mut(self.first.add(start), len) }
    }

    /// Asks the caches for the elements from `start` on.
    #[inline(always)]
    fn prefetch(&self, start: usize, len: usize) {
        let line = LINE / size_of::<T>();
        for at in (start..start + len).step_by(line).chain([start + len - 1]) {
            simd::prefetch(self.first.wrapping_add(at));
        }
    }
}

/// How many rows ahead of the one that is updated the caches are told of: they lie at random places.
const AHEAD: usize = 16;

/// A step of all rows: what its tasks share.
struct Update<'a, T> {
    rule: &'a Rule<T>,
    features: usize,
    rate: T,
    /// What weight decay leaves of a row.
    keep: T,
    table: Rows<'a, T>,
    moments: Rows<'a, T>,
    steps: Rows<'a, u32>,
}

impl<T: Scalar> Update<'_, T> {
    /// Updates some rows.
    #[inline(always)]
    fn visit(&self, first: usize, rows: &[u32], sums: &[T]) -> RowStats {
        match self.keep == T::ONE {
            true => self.visit_with::<false>(first, rows, sums),
            false => self.visit_with::<true>(first, rows, sums),
        }
    }

    #[inline(always)]
    fn visit_with<const DECAY: bool>(&self, first: usize, rows: &[u32], sums: &[T]) -> RowStats {
        // The usual widths as constants: the loops over a row then unroll into one vector.
        match self.features {
            1 => self.visit_by::<1, DECAY>(first, rows, sums),
            2 => self.visit_by::<2, DECAY>(first, rows, sums),
            4 => self.visit_by::<4, DECAY>(first, rows, sums),
            8 => self.visit_by::<8, DECAY>(first, rows, sums),
            wide if wide % 8 == 0 => self.visit_by::<8, DECAY>(first, rows, sums),
            _ => self.visit_by::<1, DECAY>(first, rows, sums),
        }
    }

    /// Updates each row by itself, in pieces of `W` features, of which a row is a multiple.
    #[inline(always)]
    fn visit_by<const W: usize, const DECAY: bool>(&self, first: usize, rows: &[u32], sums: &[T]) -> RowStats {
        let (rule, features) = (self.rule, if self.features == W { W } else { self.features });
        let mut stats = RowStats::default();
        for (place, (&row, sum)) in rows.iter().zip(sums.chunks_exact(features)).enumerate() {
            if let Some(&later) = rows.get(place + AHEAD) {
                let later = first + later as usize;
                self.table.prefetch(later * features, features);
                self.moments.prefetch(2 * later * features, 2 * features);
                self.steps.prefetch(later, 1);
            }
            let (mut any, mut finite) = (false, true);
            for i in 0..features {
                any |= sum[i] != T::ZERO;
                finite &= sum[i].is_finite();
            }
            stats.touched += usize::from(any & finite);
            stats.skipped += usize::from(!finite);
            if !(any & finite) {
                continue;
            }
            let row = first + row as usize;
            // SAFETY: `RowSums` names each row once and below the number of its rows, which `step_parts` has checked after
            // anybody else could change it, and the rows of one part end where those of the next begin: so no other task and
            // no other turn of this loop has this one. `tasks_share_a_table` and `parts_share_a_table` run it.
            let (x, moments, step) = unsafe {
                let x = self.table.get(row * features, features);
                (x, self.moments.get(2 * row * features, 2 * features), self.steps.get(row, 1))
            };
            let (m, v) = moments.split_at_mut(features);
            step[0] = (step[0] + 1).min(rule.corrections.len() as u32);
            let corrected = rule.corrected(step[0], self.rate);
            for piece in 0..features / W {
                let at = piece * W;
                let [mut new_x, g, mut new_m, mut new_v]: [[T; W]; 4] =
                    [load(x, at), load(sum, at), load(m, at), load(v, at)];
                for i in 0..W {
                    let kept = if DECAY { flushed(new_x[i] * self.keep) } else { new_x[i] };
                    let old = [kept, g[i], new_m[i], new_v[i]];
                    [new_x[i], new_m[i], new_v[i]] = rule.element(old, corrected);
                }
                x[at..at + W].copy_from_slice(&new_x);
                m[at..at + W].copy_from_slice(&new_m);
                v[at..at + W].copy_from_slice(&new_v);
            }
        }
        stats
    }
}

/// `W` numbers from place `at` on. A copy cannot overlap what is written meanwhile, so that the loops over it vectorise.
#[inline(always)]
fn load<T: Scalar, const W: usize>(from: &[T], at: usize) -> [T; W] {
    let mut piece = [T::ZERO; W];
    piece.copy_from_slice(&from[at..at + W]);
    piece
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Adam, AdamW, Optimizer, Params};
    use raygrad_autograd::Gradient;
    use raygrad_tensor::Tensor;

    /// The sums of a dense gradient, for all rows.
    fn sums<T: Scalar>(grad: &[T], features: usize) -> RowSums<T> {
        let mut sums = RowSums::new(grad.len() / features, features);
        grad.chunks(features).enumerate().for_each(|(row, g)| sums.add(row, g));
        sums
    }

    #[test]
    fn equals_dense_adam_where_every_row_has_a_gradient() {
        let shapes = [(21, 1), (8, 2), (13, 4), (30, 8), (5, 3), (1, 70), (3, 24)];
        for ((rows, features), decay) in shapes.into_iter().flat_map(|shape| [(shape, 0.0), (shape, 0.5)]) {
            let config = AdamConfig { beta2: 0.99, epsilon: 1e-15, ..AdamConfig::default() };
            let mut dense: Box<dyn Optimizer<f32>> = match decay {
                0.0 => Box::new(Adam::new(config)),
                _ => Box::new(AdamW::new(config, decay)),
            };
            let mut lazy = RowAdam::<f32>::new(config, rows, features);
            let mut table = vec![0.5; rows * features];
            let mut expected = Params::new();
            expected.add("table", Tensor::full(&[rows, features], 0.5_f32));
            for t in 1..=1500 {
                let grad: Vec<f32> = (0..table.len()).map(|i| ((i * 7 + t * 13) as f32).sin() + 1e-3).collect();
                let whole = Gradient::from(Tensor::from_vec(&[rows, features], grad.clone()));
                dense.update(&mut expected, &[whole], 1e-3).check().unwrap();
                let mut sums = sums(&grad, features);
                let stats = lazy.step(&mut table, &mut sums, 1e-3, decay);
                assert_eq!((stats, sums.rows().is_empty()), (RowStats { touched: rows, skipped: 0 }, true));
            }
            for (got, expected) in table.iter().zip(expected.values()[0].as_slice()) {
                assert!((got - expected).abs() <= 1e-5, "{got} instead of {expected}");
            }
        }
    }

    #[test]
    fn a_row_counts_its_own_steps_and_forgets_nothing_in_between() {
        // One row gets a gradient at every third step, the other at every step: lazily, both take the same way.
        let gradient = |t: usize| (0.3 * t as f64).sin() + 0.1;
        let run = |every: usize| {
            let mut adam = RowAdam::<f64>::new(AdamConfig::default(), 9, 1);
            let mut table = [0.0; 9];
            for t in 0..60 * every {
                let mut sums = RowSums::new(9, 1);
                if t % every == 0 {
                    sums.add(8, &[gradient(t / every)]);
                }
                adam.step(&mut table, &mut sums, 0.01, 0.0);
            }
            table
        };
        assert_eq!(run(1), run(3));
        // The documented recurrence.
        let (mut m, mut v, mut x) = (0.0, 0.0, 0.0);
        for t in 1..=60 {
            let g = gradient(t - 1);
            (m, v) = (0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g);
            let (first, second) = (m / (1.0 - 0.9_f64.powi(t as i32)), v / (1.0 - 0.999_f64.powi(t as i32)));
            x -= 0.01 * first / (second.sqrt() + 1e-8);
        }
        assert!((run(1)[8] - x).abs() <= 1e-12);
    }

    #[test]
    fn rows_without_gradient_rest_and_bad_ones_are_counted() {
        let mut adam = RowAdam::<f32>::new(AdamConfig::default(), 16, 2);
        let mut table = [1.0; 32];
        let mut grad = [0.0; 32];
        (grad[2], grad[7], grad[9]) = (1.0, f32::NAN, f32::INFINITY);
        let mut sums = sums(&grad, 2);
        let stats = adam.step(&mut table, &mut sums, 0.1, 0.0);
        assert_eq!(stats, RowStats { touched: 1, skipped: 2 });
        let moved: Vec<_> = (0..32).filter(|&i| table[i] != 1.0).collect();
        assert_eq!(moved, [2], "row 1 moves, and in it the element that has a gradient");
        assert_eq!(adam.step(&mut table, &mut sums, 0.1, 0.0), RowStats::default());
    }

    #[test]
    fn extreme_gradients_move_nothing_wildly_and_leave_no_denormals() {
        let mut adam = RowAdam::<f32>::new(AdamConfig { epsilon: 1e-15, ..AdamConfig::default() }, 8, 1);
        let mut table = [0.0; 8];
        let gradients = [1e-30, 1e-10, 1e30, -1e30, 1.0, f32::MIN_POSITIVE, 1e-42, 0.0];
        for _ in 0..1000 {
            let before = table;
            adam.step(&mut table, &mut sums(&gradients, 1), 1.0, 0.0);
            assert!(table.iter().zip(before).all(|(x, before)| (x - before).abs() <= 3.2), "{table:?}");
        }
        assert!(adam.moments.as_mut_slice().iter().all(|m| !m.is_subnormal()), "{:?}", adam.moments);
        // Nor does decay leave any.
        let mut table = [1e-37; 8];
        for _ in 0..10 {
            adam.step(&mut table, &mut sums(&[1e-30; 8], 1), 1e-30, 0.5e30);
            assert!(table.iter().all(|x| !x.is_subnormal()), "{table:?}");
        }
    }

    #[test]
    fn parts_share_a_table() {
        // Three parts, filled in the step itself, against the whole.
        let sizes = [5, 300, 4];
        let run = |in_parts: bool| {
            let rows: usize = sizes.iter().sum();
            let (mut adam, mut table) = (RowAdam::<f32>::new(AdamConfig::default(), rows, 2), vec![0.25; 2 * rows]);
            let mut parts: Vec<_> = sizes.iter().map(|&rows| RowSums::new(rows, 2)).collect();
            let share = |row: usize, step: usize| [(row * 7 + step) as f32 % 5.0 - 2.0, 1.0 + row as f32];
            for step in 0..3 {
                let stats = if in_parts {
                    let fill = |part: usize, sums: &mut RowSums<f32>| {
                        let first: usize = sizes[..part].iter().sum();
                        (0..sizes[part]).step_by(2).for_each(|row| sums.add(row, &share(first + row, step)));
                    };
                    adam.step_parts(&mut table, &mut parts, fill, 0.1, 0.0)
                } else {
                    let mut sums = RowSums::new(rows, 2);
                    let firsts = [0, 5, 305];
                    for (first, size) in firsts.into_iter().zip(sizes) {
                        (first..first + size).step_by(2).for_each(|row| sums.add(row, &share(row, step)));
                    }
                    adam.step(&mut table, &mut sums, 0.1, 0.0)
                };
                assert_eq!(stats, RowStats { touched: 3 + 150 + 2, skipped: 0 });
                assert!(parts.iter().all(|sums| sums.rows().is_empty()));
            }
            (table, adam.row_steps())
        };
        assert_eq!(run(true), run(false));
    }

    #[test]
    fn step_parts_replaced_sums_panic() {
        // Sums of four rows in the place of the first part's two would move the row that the second part moves.
        let replace = |[rows, features]: [usize; 2]| {
            let mut adam = RowAdam::<f32>::new(AdamConfig::default(), 4, 2);
            let (mut table, mut parts) = ([1.0; 8], [RowSums::new(2, 2), RowSums::new(2, 2)]);
            let fill = |part: usize, sums: &mut RowSums<f32>| match part {
                0 => {
                    *sums = RowSums::new(rows, features);
                    sums.add(rows - 1, &vec![1.0; features]);
                }
                _ => sums.add(0, &[1.0; 2]),
            };
            adam.step_parts(&mut table, &mut parts, fill, 0.1, 0.0)
        };
        for other in [[4, 2], [3, 2], [1, 2], [2, 1], [2, 4]] {
            let error = std::panic::catch_unwind(|| replace(other)).expect_err("sums of another size");
            let message = error.downcast_ref::<String>().map_or("", String::as_str);
            assert!(message.contains("rows and features of part 0"), "{message}");
        }
        // Others of the same size are as good.
        assert_eq!(replace([2, 2]), RowStats { touched: 2, skipped: 0 });
    }

    #[test]
    #[should_panic(expected = "a table of 4 rows of 4611686018427387904 numbers")]
    fn tables_whose_size_wraps_are_refused() {
        RowAdam::<f32>::new(AdamConfig::default(), 4, 1 << 62);
    }

    #[test]
    fn tasks_share_a_table() {
        // More rows than one task takes, backwards: each is moved once, whoever does it.
        let rows = 3 * CHUNK + 5;
        let mut sums = RowSums::<f32>::new(rows, 2);
        (0..rows).rev().for_each(|row| sums.add(row, &[1.0, -1.0]));
        let mut table = vec![0.0; 2 * rows];
        let mut adam = RowAdam::new(AdamConfig::default(), rows, 2);
        assert_eq!(adam.step(&mut table, &mut sums, 0.5, 0.0), RowStats { touched: rows, skipped: 0 });
        assert!(table.chunks(2).all(|row| (row[0] + 0.5).abs() < 1e-6 && (row[1] - 0.5).abs() < 1e-6));
    }
}
