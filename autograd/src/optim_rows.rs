//! An optimiser for tables of which a step touches few rows: embeddings, hash grids.

use crate::AdamConfig;
use raygrad_tensor::{Scalar, simd};
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

    /// One row's values, gradient and moments; each slice as long as the first.
    #[inline(always)]
    fn update(&self, [x, g, m, v]: [&mut [T]; 4], rate: T, epsilon: T) {
        let tiny = T::from_f64(1e-30);
        for i in 0..x.len() {
            let first = self.beta[0] * m[i] + self.rest[0] * g[i];
            // The square of a large finite gradient overflows to infinity, which makes the step 0.
            let second = self.beta[1] * v[i] + self.rest[1] * (g[i] * g[i]);
            m[i] = if first > tiny || first < -tiny { first } else { T::ZERO };
            v[i] = if second > tiny { second } else { T::ZERO };
            x[i] -= rate * m[i] / (v[i].sqrt() + epsilon);
        }
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
        let groups = rows.div_ceil(Touched::GROUP);
        RowAdam {
            rule: Arc::new(Rule::new(config)),
            features,
            moments: vec![T::ZERO; groups * Touched::GROUP * features * 2],
            steps: vec![0; rows],
        }
    }

    /// The same constants, and nothing seen, for another range of `rows` rows.
    pub fn fresh(&self, rows: usize) -> Self {
        let groups = rows.div_ceil(Touched::GROUP);
        RowAdam {
            rule: self.rule.clone(),
            features: self.features,
            moments: vec![T::ZERO; groups * Touched::GROUP * self.features * 2],
            steps: vec![0; rows],
        }
    }

    /// Moves the marked rows of `table` `[rows, features]` against their gradient with learning rate `rate`, in
    /// ascending order; then `grad` is zero and nothing is marked any more.
    ///
    /// # Panics
    /// If a length is not that of this optimiser's rows.
    #[track_caller]
    pub fn step(&mut self, table: &mut [T], grad: &mut [T], touched: &mut Touched, rate: f64) -> RowStats {
        let len = self.steps.len() * self.features;
        assert_eq!((table.len(), grad.len()), (len, len), "a table and a gradient of the optimiser's rows");
        assert_eq!(touched.groups(), self.steps.len().div_ceil(Touched::GROUP), "marks for the optimiser's rows");
        let rate = T::from_f64(rate);
        // The number of features as a constant where it is a usual one: the loops below are then unrolled.
        simd::dispatch(
            #[inline(always)]
            || match self.features {
                1 => self.update(1, table, grad, touched, rate),
                2 => self.update(2, table, grad, touched, rate),
                4 => self.update(4, table, grad, touched, rate),
                8 => self.update(8, table, grad, touched, rate),
                features => self.update(features, table, grad, touched, rate),
            },
        )
    }

    #[inline(always)]
    fn update(&mut self, features: usize, x: &mut [T], g: &mut [T], touched: &mut Touched, rate: T) -> RowStats {
        let mut stats = RowStats::default();
        let size = Touched::GROUP * features;
        for (group, mark) in touched.0.iter_mut().enumerate() {
            if *mark == 0 {
                continue;
            }
            *mark = 0;
            let (m, v) = self.moments[2 * group * size..2 * (group + 1) * size].split_at_mut(size);
            let first = group * Touched::GROUP;
            let rows = (self.steps.len() - first).min(Touched::GROUP);
            for k in 0..rows {
                let (row, in_group) = ((first + k) * features, k * features);
                let x = &mut x[row..row + features];
                let g = &mut g[row..row + features];
                let m = &mut m[in_group..in_group + features];
                let v = &mut v[in_group..in_group + features];
                let (mut any, mut finite) = (false, true);
                for &g in g.iter() {
                    any |= g != T::ZERO;
                    finite &= g.is_finite();
                }
                if any && finite {
                    let steps = &mut self.steps[first + k];
                    *steps = (*steps + 1).min(self.rule.corrections.len() as u32);
                    let [rate_factor, epsilon_factor] = self.rule.corrections[*steps as usize - 1];
                    self.rule.update([x, g, m, v], rate * rate_factor, self.rule.epsilon * epsilon_factor);
                }
                stats.touched += usize::from(any && finite);
                stats.skipped += usize::from(!finite);
                for g in g {
                    *g = T::ZERO;
                }
            }
        }
        stats
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Adam;
    use raygrad_tensor::Tensor;

    /// A table, its gradient and marks for all of it.
    fn touched(rows: usize) -> Touched {
        let mut touched = Touched::new(rows);
        (0..rows).for_each(|row| touched.mark(row));
        touched
    }

    #[test]
    fn equals_dense_adam_where_every_row_has_a_gradient() {
        for (rows, features) in [(21, 1), (8, 2), (13, 4), (30, 8), (5, 3), (1, 70)] {
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
