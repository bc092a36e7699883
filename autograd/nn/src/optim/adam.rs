//! Adam and AdamW.

use super::limits::{flushed, limited, tiny, tiny_square};
use super::settings::{check, check_rate, check_share, or_panic};
use super::state::{Reader, memories};
use super::{CHUNK, Move, Optimizer, OptimizerState, SettingError, StateError, UpdateReport, counted, remember, slot};
use crate::{Params, RowAdam};
use raygrad_autograd::{Gradient, RowSums};
use raygrad_tensor::{Pool, Scalar, simd};
use serde::{Deserialize, Serialize};

/// Adam (Kingma and Ba 2015, algorithm 1).
///
/// Bias corrections are computed in f64 from an integer step count, which each parameter has for itself. First moments
/// below 1e-30 (1e-300 in f64) and second ones below 1e-37 (1e-307) are set to 0, so that long runs without gradient do not fill memory with
/// denormal numbers, which are slow. Gradients count as at most 1e19 (1e154 in f64), so that their squares are finite. Work
/// is spread over the current rayon pool; the result does not depend on the number of threads.
///
/// A lazy parameter ([`Params::set_lazy`]) is moved by [`RowAdam`]: rows without gradient are not read, and each counts
/// its own steps. A step whose gradient does not consist of rows alone, because a penalty on the whole table is part of
/// the loss, visits every row whose gradient is not zero.
#[derive(Debug, Clone)]
pub struct Adam<T: Scalar> {
    config: AdamConfig,
    step: u64,
    memory: Vec<Memory<T>>,
    /// Made for the first lazy parameter: its constants are for all.
    rows: Option<RowAdam<T>>,
    /// For gradients that have to be added up.
    pool: Pool<T>,
}

/// Adam with decoupled weight decay (Loshchilov and Hutter 2019, algorithm 2): before each step a parameter is
/// multiplied by `1 - rate decay`. An element whose gradient is infinite or NaN does not decay either, nor does a row of
/// a lazy parameter without gradient.
#[derive(Debug, Clone)]
pub struct AdamW<T: Scalar> {
    adam: Adam<T>,
    decay: f64,
}

/// Constants of [`Adam`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct AdamConfig {
    /// Decay of the first moment, at least 0 and less than 1.
    pub beta1: f64,
    /// Decay of the second moment, at least 0 and less than 1.
    pub beta2: f64,
    /// Added to the root of the second moment. It bounds the step of elements with tiny gradients: 1e-8 suits dense
    /// networks, 1e-15 hash tables. At least 1e-30.
    pub epsilon: f64,
}

impl Default for AdamConfig {
    /// 0.9, 0.999, 1e-8.
    fn default() -> Self {
        AdamConfig { beta1: 0.9, beta2: 0.999, epsilon: 1e-8 }
    }
}

impl AdamConfig {
    /// Whether the constants are in their ranges.
    ///
    /// # Errors
    /// If one is not, with its name.
    pub fn check(&self) -> Result<(), SettingError> {
        check_share("beta1", self.beta1)?;
        check_share("beta2", self.beta2)?;
        check("epsilon", self.epsilon, (1e-30..=1e30).contains(&self.epsilon), "1e-30 to 1e30")
    }
}

/// What Adam knows of one parameter.
#[derive(Debug, Clone, Default)]
enum Memory<T> {
    /// Not moved so far.
    #[default]
    Nothing,
    Dense(Moments<T>),
    Rows(Box<Table<T>>),
}

/// Moments of a parameter that is moved as a whole.
#[derive(Debug, Clone, Default)]
struct Moments<T> {
    step: u64,
    first: Vec<T>,
    second: Vec<T>,
}

/// A parameter of which only rows are moved.
#[derive(Debug, Clone)]
struct Table<T> {
    adam: RowAdam<T>,
    /// For each part that is summed by itself; nothing between steps.
    sums: Vec<RowSums<T>>,
}

impl<T: Scalar> Adam<T> {
    /// An optimiser that has seen nothing.
    ///
    /// # Panics
    /// If [`AdamConfig::check`] finds something.
    #[track_caller]
    pub fn new(config: AdamConfig) -> Self {
        or_panic(config.check());
        Adam { config, step: 0, memory: vec![], rows: None, pool: Pool::new() }
    }

    /// Number of steps taken.
    pub fn steps(&self) -> u64 {
        self.step
    }

    /// A step with decoupled weight decay.
    #[track_caller]
    fn decayed(&mut self, params: &mut Params<T>, grads: &[Gradient<T>], rate: f64, decay: f64) -> UpdateReport {
        let mut report = UpdateReport::default();
        let moves = params.moves(grads, rate);
        self.step = self.step.saturating_add(1);
        for part in moves {
            let decay = decay * part.decay;
            let (name, moved, skipped) = if part.lazy { self.rows(part, decay) } else { self.dense(part, decay) };
            report.count(name, moved, skipped);
        }
        report
    }

    /// Moves a parameter as a whole; returns its name and how many elements were moved and left alone.
    #[track_caller]
    fn dense<'a>(&mut self, part: Move<'a, T>, decay: f64) -> (&'a str, usize, usize) {
        let memory = slot(&mut self.memory, part.slot);
        if let Memory::Nothing = memory {
            *memory = Memory::Dense(Moments::default());
        }
        let Memory::Dense(moments) = memory else { panic!("`{}` was lazy until now", part.name) };
        moments.step = moments.step.saturating_add(1);
        let AdamConfig { beta1, beta2, epsilon } = self.config;
        // 1 - beta^t without cancellation.
        let correction = |beta: f64| -(moments.step as f64 * beta.ln()).exp_m1();
        let root = correction(beta2).sqrt();
        let update = Update {
            beta: [beta1, beta2].map(T::from_f64),
            rest: [1.0 - beta1, 1.0 - beta2].map(T::from_f64),
            rate: T::from_f64(part.rate * root / correction(beta1)),
            epsilon: T::from_f64(epsilon * root),
            keep: T::from_f64(1.0 - part.rate * decay),
            tiniest: if decay == 0.0 { T::ZERO } else { tiny() },
        };
        let m = remember(&mut moments.first, &part);
        let v = remember(&mut moments.second, &part);
        let (len, grad) = (part.value.len(), part.dense_grad(&self.pool));
        let moments = m.chunks_mut(CHUNK).zip(v.chunks_mut(CHUNK));
        let values = part.value.as_mut_slice().chunks_mut(CHUNK).zip(grad.as_slice().chunks(CHUNK));
        let skipped = counted(values.zip(moments), |((x, g), (m, v))| update.apply(x, g, m, v));
        (part.name, len - skipped, skipped)
    }

    /// Moves the rows of a table whose gradient is not zero; returns the same.
    #[track_caller]
    fn rows<'a>(&mut self, part: Move<'a, T>, decay: f64) -> (&'a str, usize, usize) {
        let [rows, features] = part.table();
        let memory = slot(&mut self.memory, part.slot);
        if let Memory::Nothing = memory {
            let config = self.config;
            let adam = self.rows.get_or_insert_with(|| RowAdam::new(config, 0, 1)).fresh([rows, features]);
            *memory = Memory::Rows(Box::new(Table { adam, sums: vec![] }));
        }
        let Memory::Rows(table) = memory else { panic!("`{}` was not lazy until now", part.name) };
        let (shares, parts) = part.row_parts();
        let (in_parts, sizes) = (parts.is_some(), parts.unwrap_or_else(|| vec![rows]));
        // They come back empty, or not at all: what a panic leaves in them is not for the next step.
        let mut sums = std::mem::take(&mut table.sums);
        if !sums.iter().map(RowSums::table_rows).eq(sizes.iter().copied()) {
            sums = sizes.iter().map(|&rows| RowSums::new(rows, features)).collect();
        }
        // A gradient that does not consist of rows is added up first: then all its rows are there.
        let dense = shares.is_none().then(|| part.dense_grad(&self.pool));
        let fill = |i: usize, sums: &mut RowSums<T>| {
            for share in shares.iter().flatten() {
                if in_parts { share.scatter_part(i, sums) } else { share.scatter(sums) }
            }
            if let Some(dense) = &dense {
                dense.as_slice().chunks_exact(features).enumerate().for_each(|(row, share)| sums.add(row, share));
            }
        };
        let stats = table.adam.step_parts(part.value.as_mut_slice(), &mut sums, fill, part.rate, decay);
        table.sums = sums;
        (part.name, stats.touched * features, stats.skipped * features)
    }
}

impl<T: Scalar> Optimizer<T> for Adam<T> {
    #[track_caller]
    fn update(&mut self, params: &mut Params<T>, grads: &[Gradient<T>], rate: f64) -> UpdateReport {
        self.decayed(params, grads, rate, 0.0)
    }

    fn state(&self, params: &Params<T>) -> OptimizerState<T> {
        let mut state = OptimizerState::default();
        state.put_counts("", "steps", vec![self.step]);
        for (name, shape, memory) in memories(params, &self.memory) {
            let [first, second] = match memory {
                Memory::Nothing => continue,
                Memory::Dense(Moments { step, first, second }) => {
                    state.put_counts(name, "step", vec![*step]);
                    [first.clone(), second.clone()]
                }
                Memory::Rows(table) => {
                    state.put_counts(name, "row_steps", table.adam.row_steps());
                    table.adam.moments()
                }
            };
            state.put(name, "first", shape, first);
            state.put(name, "second", shape, second);
        }
        state
    }

    fn load_state(&mut self, params: &Params<T>, state: &OptimizerState<T>) -> Result<(), StateError> {
        let mut reader = Reader::new(state);
        let (step, mut memory) = (reader.steps()?, vec![]);
        for ((name, value), id) in params.iter().zip(params.ids()) {
            let (shape, config) = (value.shape(), self.config);
            let rows = shape.first().copied().unwrap_or(1);
            let (entry, what) = match params.moves_rows(id) {
                true => ("step", "belongs to a parameter that was not lazy, and this one is"),
                false => ("row_steps", "belongs to a lazy parameter, and this one is not"),
            };
            reader.refuse(name, entry, &format!("{what}: call Params::set_lazy as before"))?;
            memory.push(if let Some(steps) = reader.counts(name, "row_steps", rows)? {
                let moments = [reader.expect(name, "first", shape)?, reader.expect(name, "second", shape)?];
                let adam = self.rows.get_or_insert_with(|| RowAdam::new(config, 0, 1));
                let mut adam = adam.fresh([rows, value.len() / rows.max(1)]);
                adam.load(moments.each_ref().map(Vec::as_slice), steps);
                Memory::Rows(Box::new(Table { adam, sums: vec![] }))
            } else if let Some(steps) = reader.counts(name, "step", 1)? {
                let [first, second] = [reader.expect(name, "first", shape)?, reader.expect(name, "second", shape)?];
                Memory::Dense(Moments { step: steps[0], first, second })
            } else {
                Memory::Nothing
            });
        }
        reader.finish()?;
        (self.step, self.memory) = (step, memory);
        Ok(())
    }
}

impl<T: Scalar> AdamW<T> {
    /// An optimiser that has seen nothing. `decay` is the part of a parameter that goes at each step at learning rate 1,
    /// customarily 0.01; parameters can have a factor of their own, such as 0 for biases
    /// ([`Params::set_decay`](crate::Params::set_decay)).
    ///
    /// # Panics
    /// If [`AdamConfig::check`] finds something, or the decay is not within 0 to 1e30.
    #[track_caller]
    pub fn new(config: AdamConfig, decay: f64) -> Self {
        or_panic(check_rate("decay", decay));
        AdamW { adam: Adam::new(config), decay }
    }

    /// Number of steps taken.
    pub fn steps(&self) -> u64 {
        self.adam.step
    }
}

impl<T: Scalar> Optimizer<T> for AdamW<T> {
    #[track_caller]
    fn update(&mut self, params: &mut Params<T>, grads: &[Gradient<T>], rate: f64) -> UpdateReport {
        self.adam.decayed(params, grads, rate, self.decay)
    }

    fn state(&self, params: &Params<T>) -> OptimizerState<T> {
        self.adam.state(params)
    }

    fn load_state(&mut self, params: &Params<T>, state: &OptimizerState<T>) -> Result<(), StateError> {
        self.adam.load_state(params, state)
    }
}

/// One step's constants.
struct Update<T> {
    beta: [T; 2],
    rest: [T; 2],
    rate: T,
    epsilon: T,
    /// What weight decay leaves of a parameter.
    keep: T,
    /// A decaying parameter is 0 below this.
    tiniest: T,
}

impl<T: Scalar> Update<T> {
    fn apply(&self, x: &mut [T], g: &[T], m: &mut [T], v: &mut [T]) -> usize {
        let n = x.len();
        let (g, m, v) = (&g[..n], &mut m[..n], &mut v[..n]);
        simd::dispatch(
            #[inline(always)]
            || {
                let mut skipped = 0;
                for i in 0..n {
                    let (finite, g) = (g[i].is_finite(), limited(g[i]));
                    let first = flushed(self.beta[0] * m[i] + self.rest[0] * g);
                    let second = self.beta[1] * v[i] + self.rest[1] * (g * g);
                    let second = if second > tiny_square() { second } else { T::ZERO };
                    let kept = x[i] * self.keep;
                    let kept = if kept < self.tiniest && kept > -self.tiniest { T::ZERO } else { kept };
                    let moved = kept - self.rate * first / (second.sqrt() + self.epsilon);
                    let good = finite && moved.is_finite();
                    m[i] = if good { first } else { m[i] };
                    v[i] = if good { second } else { v[i] };
                    x[i] = if good { moved } else { x[i] };
                    skipped += usize::from(!good);
                }
                skipped
            },
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_tensor::Tensor;

    fn store<T: Scalar>(value: Tensor<T>) -> Params<T> {
        let mut params = Params::new();
        params.add("x", value);
        params
    }

    /// One step of a single parameter; returns how many elements were left alone.
    fn step<T: Scalar>(adam: &mut impl Optimizer<T>, params: &mut Params<T>, grad: Tensor<T>, rate: f64) -> usize {
        adam.update(params, &[grad.into()], rate).skipped
    }

    fn one_step(g: f64, epsilon: f64) -> f64 {
        let mut params = store(Tensor::scalar(0.0_f32));
        let mut adam = Adam::new(AdamConfig { epsilon, ..AdamConfig::default() });
        step(&mut adam, &mut params, Tensor::scalar(g as f32), 1.0);
        f64::from(params.values()[0].item())
    }

    #[test]
    fn the_first_step_is_the_learning_rate() {
        assert!((one_step(1e-3, 1e-8) + 1.0).abs() < 1e-4);
        assert!((one_step(-1e10, 1e-8) - 1.0).abs() < 1e-6);
        // A gradient of 1e-10 drowns in an epsilon of 1e-8 and does not in one of 1e-15.
        assert!((one_step(1e-10, 1e-8) + 0.0099).abs() < 1e-4);
        assert!((one_step(1e-10, 1e-15) + 1.0).abs() < 1e-2);
        assert_eq!(one_step(0.0, 1e-8), 0.0);
        assert!((one_step(1e30, 1e-8) + 1.0).abs() < 1e-6, "the square of the gradient would overflow");
    }

    #[test]
    fn follows_the_algorithm_in_f64_with_and_without_decay() {
        let gradient = |t: usize| (t as f64 * 0.7).sin();
        for (factor, decay) in [(1.0, 0.1), (0.0, 0.1), (3.0, 0.02)] {
            let (mut adam, mut params) = (AdamW::new(AdamConfig::default(), decay), store(Tensor::scalar(0.5)));
            let (mut plain, mut free) = (Adam::new(AdamConfig::default()), store(Tensor::scalar(0.5)));
            params.set_decay(|_| true, factor);
            let (mut m, mut v, mut expected, mut undecayed) = (0.0, 0.0, 0.5, 0.5);
            for t in 1..=500 {
                let (g, rate) = (gradient(t), 0.01 * (1.0 + (t as f64).cos().abs()));
                assert_eq!(step(&mut adam, &mut params, Tensor::scalar(g), rate), 0);
                assert_eq!(step(&mut plain, &mut free, Tensor::scalar(g), rate), 0);
                m = 0.9 * m + 0.1 * g;
                v = 0.999 * v + 0.001 * g * g;
                let (mh, vh): (f64, f64) = (m / (1.0 - 0.9_f64.powi(t as i32)), v / (1.0 - 0.999_f64.powi(t as i32)));
                let way = rate * mh / (vh.sqrt() + 1e-8);
                expected = expected - rate * factor * decay * expected - way;
                undecayed -= way;
                assert!((params.values()[0].item() - expected).abs() < 1e-10, "step {t}");
                assert!((free.values()[0].item() - undecayed).abs() < 1e-10, "step {t}");
            }
        }
    }

    #[test]
    fn nan_is_skipped_and_counted_and_nothing_goes_denormal() {
        let mut adam = Adam::<f32>::new(AdamConfig::default());
        let mut params = store(Tensor::from_vec(&[4], vec![1.0, 2.0, 3.0, f32::MAX]));
        params.set_rate(|_| true, 1e3);
        let grad = Tensor::from_vec(&[4], vec![1.0, f32::NAN, f32::INFINITY, -1.0]);
        let report = adam.update(&mut params, &[grad.into()], 1e30);
        assert_eq!((report.moved, report.skipped, report.is_stuck()), (1, 3, false), "the last step overflows");
        assert_eq!(report.bad, [("x".to_owned(), 3)]);
        let message = report.check().unwrap_err().to_string();
        assert_eq!(message, "3 of 4 elements stay where they are, for their gradient is not finite: 3 of `x`");
        assert_eq!(&params.values()[0].as_slice()[1..], [2.0, 3.0, f32::MAX]);
        for _ in 0..10_000 {
            step(&mut adam, &mut params, Tensor::zeros(&[4]), 0.1);
        }
        let Memory::Dense(Moments { first, second, .. }) = &adam.memory[0] else { panic!("no moments") };
        assert!(first.iter().chain(second).all(|x| *x == 0.0 || x.is_normal()), "{first:?} {second:?}");
        assert!(params.values()[0].is_finite());
        assert!(adam.update(&mut params, &[Tensor::full(&[4], f32::NAN).into()], 0.1).is_stuck());
        assert!(!adam.update(&mut params, &[Tensor::zeros(&[4]).into()], 0.1).is_stuck());
    }

    #[test]
    fn a_decaying_parameter_ends_at_zero_and_a_bad_gradient_stops_it() {
        let mut adam = AdamW::<f32>::new(AdamConfig::default(), 1.0);
        let mut params = store(Tensor::from_vec(&[2], vec![1e-25_f32, 1e-25]));
        let mut skipped = 0;
        for _ in 0..300 {
            skipped += step(&mut adam, &mut params, Tensor::from_vec(&[2], vec![0.0, f32::NAN]), 0.1);
            assert!(params.values()[0].as_slice().iter().all(|x| !x.is_subnormal()));
        }
        assert_eq!((params.values()[0].as_slice(), skipped), (&[0.0, 1e-25][..], 300));
        // Without decay a tiny parameter stays as it is.
        let mut params = store(Tensor::scalar(1e-40_f32));
        step(&mut Adam::new(AdamConfig::default()), &mut params, Tensor::scalar(0.0), 0.1);
        assert_eq!(params.values()[0].item(), 1e-40);
    }

    #[test]
    fn a_parameter_that_rests_at_first_has_its_own_count() {
        let mut adam = Adam::<f64>::new(AdamConfig::default());
        let mut params = Params::new();
        let [a, b, c] = ["a", "b", "c"].map(|name| params.add(name, Tensor::scalar(0.0)));
        let one = || Gradient::from(Tensor::scalar(1.0));
        for step in 0..50 {
            // One is frozen, of the other one nothing depends.
            let late = step >= 40;
            params.freeze(|name| name == "c");
            params.unfreeze(|name| late && name == "c");
            let mut grads = vec![one(), if late { one() } else { Gradient::zero(&[]) }];
            grads.extend(late.then(one));
            assert_eq!(adam.update(&mut params, &grads, 0.1).check(), Ok(if late { 3 } else { 1 }));
        }
        // With a constant gradient every step is one learning rate, from the first one on.
        let way = |id| -params.get(id).item();
        assert!((way(a) - 5.0).abs() < 1e-6 && (way(b) - 1.0).abs() < 1e-6 && (way(c) - 1.0).abs() < 1e-6);
        assert_eq!(adam.steps(), 50);
    }

    #[test]
    fn empty_parameters_and_long_ones_take_the_same_step() {
        for lazy in [false, true] {
            let mut params = Params::<f32>::new();
            let len = 2 * CHUNK + 3;
            let shapes = [&[0, 3][..], &[3, 0], &[len], &[]];
            for (i, shape) in shapes.iter().enumerate() {
                params.add(i.to_string(), Tensor::zeros(shape));
            }
            params.set_lazy(|_| true, lazy);
            let grads = shapes.map(|shape| Tensor::from_fn(shape, |i| 1.0 + (i % 7) as f32).into());
            assert_eq!(Adam::new(AdamConfig::default()).update(&mut params, &grads, 0.5).check(), Ok(len + 1));
            assert!(params.values().iter().flat_map(Tensor::as_slice).all(|x| (x + 0.5).abs() < 1e-6));
        }
    }
}
