//! An optimiser for tables of which a step touches few rows: embeddings, hash grids.

use crate::AdamConfig;
use raygrad_tensor::{Scalar, simd};
use rayon::prelude::*;
use std::ops::Add;
use std::sync::Arc;

/// Which rows of a table may hold a gradient, by groups of [`Touched::GROUP`] neighbours.
///
/// A group costs one byte that is only ever stored to, so marking is cheap enough to do at every scatter; that a marked
/// row really has a gradient is seen when the group is visited.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Touched(Vec<u8>);

impl Touched {
    /// Rows of a group.
    pub const GROUP: usize = 8;

    /// No row of `rows` is touched.
    pub fn new(rows: usize) -> Self {
        Touched(vec![0; rows.div_ceil(Self::GROUP)])
    }

    /// Marks the group of `row`.
    ///
    /// # Panics
    /// If there is no such row.
    #[inline(always)]
    pub fn mark(&mut self, row: usize) {
        self.0[row / Self::GROUP] = 1;
    }

    /// Number of groups.
    pub fn groups(&self) -> usize {
        self.0.len()
    }

    /// Whether a row of the group is marked.
    pub fn group(&self, group: usize) -> bool {
        self.0[group] != 0
    }
}

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

/// Groups that one task visits.
const CHUNK: usize = 1 << 12;

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
    /// For each group of rows first its first moments, then its second ones: one place in memory to visit.
    moments: Vec<T>,
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
        let tiny = T::from_f64(1e-30);
        let m = self.beta[0] * m + self.rest[0] * g;
        // The square of a large finite gradient overflows to infinity, which makes the step 0.
        let v = self.beta[1] * v + self.rest[1] * (g * g);
        let m = if m > tiny || m < -tiny { m } else { T::ZERO };
        let v = if v > tiny { v } else { T::ZERO };
        [x - rate * m / (v.sqrt() + epsilon), m, v]
    }
}

impl<T: Scalar> RowAdam<T> {
    /// An optimiser of `rows` rows of `features` numbers that has seen nothing.
    ///
    /// # Panics
    /// If `features` is 0.
    #[track_caller]
    pub fn new(config: AdamConfig, rows: usize, features: usize) -> Self {
        assert!(features > 0, "rows without features");
        RowAdam { rule: Arc::new(Rule::new(config)), features, moments: vec![], steps: vec![] }.fresh(rows)
    }

    /// The same constants, shared, and nothing seen, for another range of `rows` rows.
    pub fn fresh(&self, rows: usize) -> Self {
        let padded = rows.next_multiple_of(Touched::GROUP);
        RowAdam {
            rule: self.rule.clone(),
            features: self.features,
            moments: vec![T::ZERO; 2 * padded * self.features],
            steps: vec![0; rows],
        }
    }

    /// Moves the marked rows of `table` `[rows, features]` against their gradient with learning rate `rate`; then `grad`
    /// is zero and nothing is marked any more. Work on many rows is spread over the current rayon pool.
    ///
    /// # Panics
    /// If a length is not that of this optimiser's rows.
    #[track_caller]
    pub fn step(&mut self, table: &mut [T], grad: &mut [T], touched: &mut Touched, rate: f64) -> RowStats {
        let len = self.steps.len() * self.features;
        assert_eq!((table.len(), grad.len()), (len, len), "a table and a gradient of the optimiser's rows");
        assert_eq!(touched.groups(), self.steps.len().div_ceil(Touched::GROUP), "marks for the optimiser's rows");
        let rate = T::from_f64(rate);
        let RowAdam { rule, features, moments, steps } = self;
        let (rule, features, rows) = (&**rule, *features, CHUNK * Touched::GROUP);
        let state = moments.par_chunks_mut(2 * rows * features).zip(steps.par_chunks_mut(rows));
        let values = table.par_chunks_mut(rows * features).zip(grad.par_chunks_mut(rows * features));
        let chunks = touched.0.par_chunks_mut(CHUNK).zip(state.zip(values));
        let stats = chunks.map(|(marks, ((moments, steps), (table, grad)))| {
            simd::dispatch(
                #[inline(always)]
                || Chunk { rule, features, marks, moments, steps, table, grad }.visit(rate),
            )
        });
        stats.reduce(RowStats::default, RowStats::add)
    }
}

/// Neighbouring groups of rows and all that belongs to them.
struct Chunk<'a, T> {
    rule: &'a Rule<T>,
    features: usize,
    marks: &'a mut [u8],
    moments: &'a mut [T],
    steps: &'a mut [u32],
    table: &'a mut [T],
    grad: &'a mut [T],
}

impl<T: Scalar> Chunk<'_, T> {
    #[inline(always)]
    fn visit(self, rate: T) -> RowStats {
        let Chunk { rule, features, marks, moments, steps, table, grad } = self;
        let (mut stats, total) = (RowStats::default(), steps.len());
        let size = Touched::GROUP * features;
        // Marked groups up to `ahead` have been told to the caches; `told` of them are still to be visited.
        let (mut ahead, mut told) = (0, 0);
        for group in 0..marks.len() {
            if marks[group] == 0 {
                continue;
            }
            marks[group] = 0;
            while told < AHEAD && ahead + 1 < marks.len() {
                ahead = ahead.max(group) + 1;
                if marks.get(ahead).is_some_and(|mark| *mark != 0) {
                    told += 1;
                    let rows = ahead * Touched::GROUP;
                    let at = rows * features;
                    prefetch_lines(&table[at..], size);
                    prefetch_lines(&grad[at..], size);
                    prefetch_lines(&moments[2 * at..], 2 * size);
                    prefetch_lines(&steps[rows..], Touched::GROUP);
                }
            }
            told = told.saturating_sub(1);
            let rows = group * Touched::GROUP..total.min((group + 1) * Touched::GROUP);
            let elements = rows.start * features..rows.end * features;
            let (m, v) = moments[2 * group * size..2 * (group + 1) * size].split_at_mut(size);
            let steps = &mut steps[rows];
            let group = Group { x: &mut table[elements.clone()], g: &mut grad[elements], m, v, steps };
            // The usual widths as constants: the loops over a row then unroll into one vector.
            match features {
                1 => group.update::<1>(1, rule, rate, &mut stats),
                2 => group.update::<2>(2, rule, rate, &mut stats),
                4 => group.update::<4>(4, rule, rate, &mut stats),
                8 => group.update::<8>(8, rule, rate, &mut stats),
                wide if wide % 8 == 0 => group.update::<8>(wide, rule, rate, &mut stats),
                odd => group.update::<1>(odd, rule, rate, &mut stats),
            }
        }
        stats
    }
}

/// How many groups ahead of the one that is updated the caches are told of: rows are visited in ascending order, but
/// with gaps that the processor cannot foresee.
const AHEAD: usize = 8;

/// Asks for the cache lines of the first `len` of `values`.
#[inline(always)]
fn prefetch_lines<T>(values: &[T], len: usize) {
    let line = 64 / size_of::<T>();
    for i in (0..len.min(values.len())).step_by(line) {
        simd::prefetch(&values[i]);
    }
}

/// Neighbouring rows and all that belongs to them.
struct Group<'a, T> {
    x: &'a mut [T],
    g: &'a mut [T],
    m: &'a mut [T],
    v: &'a mut [T],
    steps: &'a mut [u32],
}

impl<T: Scalar> Group<'_, T> {
    /// Updates each row by itself, in pieces of `W` features, of which `features` is a multiple.
    #[inline(always)]
    fn update<const W: usize>(self, features: usize, rule: &Rule<T>, rate: T, stats: &mut RowStats) {
        let len = self.steps.len() * features;
        let (x, g, m, v) = (&mut self.x[..len], &mut self.g[..len], &mut self.m[..len], &mut self.v[..len]);
        for (row, step) in self.steps.iter_mut().enumerate() {
            let start = row * features;
            let (mut any, mut finite) = (false, true);
            for piece in 0..features / W {
                let g: [T; W] = load(g, start + piece * W);
                for i in 0..W {
                    any |= g[i] != T::ZERO;
                    finite &= g[i].is_finite();
                }
            }
            stats.touched += usize::from(any & finite);
            stats.skipped += usize::from(!finite);
            if any & finite {
                *step = (*step + 1).min(rule.corrections.len() as u32);
                let corrected = rule.corrected(*step, rate);
                for piece in 0..features / W {
                    let at = start + piece * W;
                    let [mut new_x, g, mut new_m, mut new_v]: [[T; W]; 4] =
                        [load(x, at), load(g, at), load(m, at), load(v, at)];
                    for i in 0..W {
                        let old = [new_x[i], g[i], new_m[i], new_v[i]];
                        [new_x[i], new_m[i], new_v[i]] = rule.element(old, corrected);
                    }
                    x[at..at + W].copy_from_slice(&new_x);
                    m[at..at + W].copy_from_slice(&new_m);
                    v[at..at + W].copy_from_slice(&new_v);
                }
            }
            g[start..start + features].fill(T::ZERO);
        }
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
    use crate::Adam;
    use raygrad_tensor::Tensor;

    /// Marks for all rows.
    fn touched(rows: usize) -> Touched {
        let mut touched = Touched::new(rows);
        (0..rows).for_each(|row| touched.mark(row));
        touched
    }

    #[test]
    fn equals_dense_adam_where_every_row_has_a_gradient() {
        for (rows, features) in [(21, 1), (8, 2), (13, 4), (30, 8), (5, 3), (1, 70), (3, 24)] {
            let config = AdamConfig { beta2: 0.99, epsilon: 1e-15, ..AdamConfig::default() };
            let mut dense = Adam::<f32>::new(config);
            let mut lazy = RowAdam::<f32>::new(config, rows, features);
            let mut table = vec![0.5; rows * features];
            let mut expected = [Tensor::full(&[rows, features], 0.5_f32)];
            for t in 1..=3000 {
                let grad: Vec<f32> = (0..table.len()).map(|i| ((i * 7 + t * 13) as f32).sin() + 1e-3).collect();
                dense.step(&mut expected, &[Tensor::from_vec(&[rows, features], grad.clone())], 1e-3);
                let mut grad = grad;
                let stats = lazy.step(&mut table, &mut grad, &mut touched(rows), 1e-3);
                assert_eq!((stats, grad.iter().all(|&g| g == 0.0)), (RowStats { touched: rows, skipped: 0 }, true));
            }
            for (got, expected) in table.iter().zip(expected[0].as_slice()) {
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
                let (mut grad, mut marks) = ([0.0; 9], Touched::new(9));
                if t % every == 0 {
                    grad[8] = gradient(t / every);
                    marks.mark(8);
                }
                adam.step(&mut table, &mut grad, &mut marks, 0.01);
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
        (grad[2], grad[7], grad[9], grad[20]) = (1.0, f32::NAN, f32::INFINITY, 1.0);
        let mut marks = Touched::new(16);
        marks.mark(0); // The group of rows 0 to 7; row 10 has a gradient but no mark.
        let stats = adam.step(&mut table, &mut grad, &mut marks, 0.1);
        assert_eq!(stats, RowStats { touched: 1, skipped: 2 });
        let moved: Vec<_> = (0..32).filter(|&i| table[i] != 1.0).collect();
        assert_eq!(moved, [2], "row 1 moves, and in it the element that has a gradient");
        assert_eq!(grad.iter().filter(|&&g| g != 0.0).count(), 1, "the gradient of the marked group is used up");
        assert_eq!(adam.step(&mut table, &mut grad, &mut marks, 0.1), RowStats::default());
    }

    #[test]
    fn extreme_gradients_move_nothing_wildly_and_leave_no_denormals() {
        let mut adam = RowAdam::<f32>::new(AdamConfig { epsilon: 1e-15, ..AdamConfig::default() }, 8, 1);
        let mut table = [0.0; 8];
        let gradients = [1e-30, 1e-10, 1e30, -1e30, 1.0, f32::MIN_POSITIVE, 1e-42, 0.0];
        for _ in 0..1000 {
            let before = table;
            adam.step(&mut table, &mut gradients.clone(), &mut touched(8), 1.0);
            assert!(table.iter().zip(before).all(|(x, before)| (x - before).abs() <= 3.2), "{table:?}");
        }
        assert!(adam.moments.iter().all(|m| !m.is_subnormal()), "{:?}", adam.moments);
    }
}
