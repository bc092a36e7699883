//! Adam and AdamW.

use super::limits::{flushed, limited, loaded_moment, moment_root, saved_moment, smallest_eps, tiny_square};
use super::memory::Memory;
use super::rule::Rule;
use super::settings::{check, check_decay, check_rate, or_panic};
use super::{Optimizer, OptimizerState, SettingError, StateError, UpdateReport};
use crate::Params;
use raygrad_autograd::Gradient;
use raygrad_tensor::Scalar;
use serde::{Deserialize, Serialize};

/// Adam (Kingma and Ba 2015, algorithm 1), with bias correction. Parameter [groups](Self::add_group) can have their own
/// constants, learning rate and decoupled weight decay. [`AdamW`] makes an optimizer with decay.
///
/// Bias corrections are computed in f64 from an integer step count, which each parameter has separately. First moments
/// below 1e-30 (1e-300 in f64) and second moments below 4.7e-41 (1e-307) are set to 0. So long runs without gradient do
/// not fill memory with denormal numbers, which are slow. Gradients count as at most 1.1e18 (1e154 in f64), so that their
/// squares are finite. Work runs on the current rayon pool; the result does not depend on the number of threads.
///
/// For a lazy parameter ([`Params::set_lazy`]), rows without gradient are not read, as in PyTorch's `SparseAdam`. Unlike
/// there, each row counts its own steps, and eps is corrected as in Adam. So without gradient a row's moments do not
/// decay and its bias correction does not change. A row with one late gradient changes by about one learning rate.
/// Dense Adam, whose bias correction has ended by then, changes it over the following steps too. If every row has a
/// gradient in every step, both agree. A penalty on the whole table makes a gradient that does not consist of rows
/// alone. A step then visits every row whose gradient is not zero.
#[derive(Debug, Clone)]
pub struct Adam<T: Scalar> {
    /// Group 0 has the parameters of no other group.
    groups: Vec<Group<T>>,
    /// For each parameter of the store, its group; parameters beyond the end are in group 0.
    members: Vec<usize>,
    steps: u64,
    memory: Memory<T>,
}

/// Makes an [`Adam`] with decoupled weight decay (Loshchilov and Hutter 2019, algorithm 2). Before each step a
/// parameter is multiplied by `1 - rate decay`, even where that rounds to 1 in the parameter's type. There is no decay
/// of an element whose gradient is infinite or NaN, or of a row without gradient of a lazy parameter.
#[derive(Debug, Clone, Copy)]
pub struct AdamW;

/// The constants of [`Adam`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct AdamConfig {
    /// Decay of the first moment. In f64 it can be up to 1 - 2^-49. Range: 0 to 1 - 2^-20.
    pub beta1: f64,
    /// Decay of the second moment. In f64 it can be up to 1 - 2^-49. Range: 0 to 1 - 2^-20.
    pub beta2: f64,
    /// Added to the root of the second moment. It bounds the step of elements with tiny gradients: 1e-8 suits dense
    /// networks, 1e-15 hash tables. A `beta2` above 0.9999 takes at least 1e-10. In f64 it is at least 1e-30, for any
    /// `beta2`. Range: 1e-15 to 1e30.
    #[serde(alias = "epsilon")]
    pub eps: f64,
}

impl Default for AdamConfig {
    /// The usual constants 0.9, 0.999 and 1e-8.
    fn default() -> Self {
        AdamConfig { beta1: 0.9, beta2: 0.999, eps: 1e-8 }
    }
}

impl AdamConfig {
    /// Checks that the constants are in their ranges for parameters of type `T`.
    ///
    /// # Errors
    /// If one is not. The error has its name.
    pub fn check<T: Scalar>(&self) -> Result<(), SettingError> {
        check_decay::<T>("beta1", self.beta1)?;
        check_decay::<T>("beta2", self.beta2)?;
        let least = smallest_eps::<T>(self.beta2);
        check("eps", self.eps, (least..=1e30).contains(&self.eps), &format!("{least:e} to 1e30"))
    }
}

/// Parameters with the same constants.
#[derive(Debug, Clone)]
struct Group<T> {
    config: AdamConfig,
    decay: f64,
    /// The [`correction`] of each step of a row, from 1 on. Filled for the first lazy parameter.
    corrections: Vec<[T; 2]>,
}

/// `1 - beta^step` of both moments, without cancellation.
fn biases(AdamConfig { beta1, beta2, .. }: AdamConfig, step: u32) -> [f64; 2] {
    [beta1, beta2].map(|beta| -(f64::from(step) * beta.ln()).exp_m1())
}

/// The factors of learning rate and epsilon that correct the moments' bias at a step, from 1 on:
/// `sqrt(1 - beta2^t) / (1 - beta1^t)` and `sqrt(1 - beta2^t)`.
fn correction<T: Scalar>(config: AdamConfig, step: u32) -> [T; 2] {
    let [first, second] = biases(config, step);
    [second.sqrt() / first, second.sqrt()].map(T::from_f64)
}

impl<T: Scalar> Group<T> {
    /// Largest number of corrections that are kept. For later steps, a beta2 above 0.9998 computes them for each row.
    const LONGEST: usize = 1 << 17;

    #[track_caller]
    fn new(config: AdamConfig, decay: f64) -> Self {
        or_panic(config.check::<T>().and(check_rate("decay", decay)));
        Group { config, decay, corrections: vec![] }
    }

    /// Fills the corrections if they are empty.
    fn correct_rows(&mut self) {
        while self.corrections.len() < Self::LONGEST && self.corrections.last() != Some(&[T::ONE; 2]) {
            self.corrections.push(correction(self.config, self.corrections.len() as u32 + 1));
        }
    }

    /// The correction of a step, from 1 on.
    fn correction(&self, step: u32) -> [T; 2] {
        match self.corrections.get(step as usize - 1) {
            Some(known) => *known,
            None if self.corrections.last() == Some(&[T::ONE; 2]) => [T::ONE; 2],
            None => correction(self.config, step),
        }
    }

    /// A step at this learning rate, without bias correction.
    fn update(&self, rate: f64) -> Update<T> {
        let (AdamConfig { beta1, beta2, eps: epsilon }, scale) = (self.config, moment_root::<T>());
        Update {
            beta: [beta1, beta2].map(T::from_f64),
            rest: [1.0 - beta1, (1.0 - beta2) * scale * scale].map(T::from_f64),
            rate: T::from_f64(rate * scale),
            epsilon: T::from_f64(epsilon * scale),
        }
    }
}

impl<T: Scalar> Adam<T> {
    /// A new optimizer with empty state and without weight decay.
    ///
    /// # Panics
    /// If [`AdamConfig::check`] fails.
    #[track_caller]
    pub fn new(config: AdamConfig) -> Self {
        AdamW::new(config, 0.0)
    }

    /// Adds a parameter group (PyTorch's `add_param_group`) and returns its number of parameters. It gets the
    /// parameters whose name `which` selects and that are still in group 0. Groups are numbered from 1; group 0 has all
    /// other parameters. Call it before the first step.
    ///
    /// ```
    /// use raygrad_autograd::{Gradient, Tensor};
    /// use raygrad_nn::{Adam, AdamConfig, Params};
    /// let mut params = Params::<f32>::new();
    /// for name in ["trunk.weight", "trunk.bias", "head.weight"] {
    ///     params.add(name, Tensor::scalar(1.0));
    /// }
    /// let mut adam = Adam::new(AdamConfig::default());
    /// let fast = AdamConfig { beta2: 0.99, ..AdamConfig::default() };
    /// assert_eq!(adam.add_group(&params, |name| name.starts_with("head."), fast, 0.01), 1);
    /// let grads = [1.0, 1.0, 1.0].map(|g| Gradient::from(Tensor::scalar(g)));
    /// adam.update_groups(&mut params, &grads, |group| [0.001, 0.1][group]).check().unwrap();
    /// let moved: Vec<f32> = params.values().iter().map(|value| value.item()).collect();
    /// assert!((moved[0] - 0.999).abs() < 1e-6 && (moved[2] - 0.899).abs() < 1e-6);
    /// ```
    ///
    /// # Panics
    /// If [`AdamConfig::check`] fails, or the decay is not in 0 to 1e30.
    #[track_caller]
    pub fn add_group(
        &mut self,
        params: &Params<T>,
        which: impl Fn(&str) -> bool,
        config: AdamConfig,
        decay: f64,
    ) -> usize {
        self.groups.push(Group::new(config, decay));
        self.members.resize(params.len(), 0);
        let mut count = 0;
        for (member, _) in
            self.members.iter_mut().zip(params.names()).filter(|(member, name)| **member == 0 && which(name))
        {
            *member = self.groups.len() - 1;
            count += 1;
        }
        count
    }

    /// Number of steps taken.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// As [`update`](Optimizer::update), with a learning rate for each group: `rate` maps the number of a group to its
    /// learning rate.
    ///
    /// # Panics
    /// Where [`update`](Optimizer::update) panics.
    #[track_caller]
    pub fn update_groups(
        &mut self,
        params: &mut Params<T>,
        grads: &[Gradient<T>],
        rate: impl Fn(usize) -> f64,
    ) -> UpdateReport {
        let mut report = UpdateReport::default();
        let group = |slot: usize| self.members.get(slot).copied().unwrap_or(0);
        let moves = params.updates(grads, |slot| rate(group(slot)));
        self.steps = self.steps.saturating_add(1);
        for part in moves {
            let group = &mut self.groups[group(part.slot)];
            if part.lazy {
                group.correct_rows();
            }
            let (group, rate) = (&*group, part.lr);
            let (update, decay) = (group.update(rate), group.decay * part.weight_decay);
            let whole = |step| {
                let [first, second] = biases(group.config, step);
                let root = second.sqrt() * moment_root::<T>();
                let rate = T::from_f64(rate * root / first);
                Update { rate, epsilon: T::from_f64(group.config.eps * root), ..update }
            };
            let row = |step: u32| {
                let [rate, epsilon] = group.correction(step);
                Update { rate: update.rate * rate, epsilon: update.epsilon * epsilon, ..update }
            };
            if decay == 0.0 {
                self.memory.update(part, whole, row, &mut report);
            } else {
                let decayed = |update| Decayed::new(update, rate * decay);
                self.memory.update(part, |step| decayed(whole(step)), |step| decayed(row(step)), &mut report);
            }
        }
        report
    }
}

impl<T: Scalar> Optimizer<T> for Adam<T> {
    #[track_caller]
    fn update(&mut self, params: &mut Params<T>, grads: &[Gradient<T>], rate: f64) -> UpdateReport {
        self.update_groups(params, grads, |_| rate)
    }

    fn state(&self, params: &Params<T>) -> OptimizerState<T> {
        let mut state = self.memory.state(params);
        second_moments(&mut state, saved_moment);
        state.put_counts("", "steps", vec![self.steps]);
        state
    }

    fn load_state(&mut self, params: &Params<T>, state: &OptimizerState<T>) -> Result<(), StateError> {
        let mut state = state.clone();
        second_moments(&mut state, loaded_moment);
        let (steps, memory) = (state.take_steps()?, self.memory.loaded(params, state)?);
        (self.steps, self.memory) = (steps, memory);
        Ok(())
    }
}

/// Maps the second moments of a state.
fn second_moments<T: Scalar>(state: &mut OptimizerState<T>, map: impl Fn(T) -> T) {
    for (_, moments) in state.tensors.iter_mut().filter(|(name, _)| name.ends_with(".second")) {
        moments.as_mut_slice().iter_mut().for_each(|moment| *moment = map(*moment));
    }
}

impl AdamW {
    /// A new optimizer with empty state. `decay` is the fraction by which a step at learning rate 1 shrinks a
    /// parameter. The usual value is 0.01. Parameters can scale it, such as 0 for biases
    /// ([`Params::set_weight_decay_scale`](crate::Params::set_weight_decay_scale)).
    ///
    /// # Panics
    /// If [`AdamConfig::check`] fails, or the decay is not in 0 to 1e30.
    #[allow(clippy::new_ret_no_self)] // PyTorch's name, for a constructor
    #[track_caller]
    pub fn new<T: Scalar>(config: AdamConfig, decay: f64) -> Adam<T> {
        let groups = vec![Group::new(config, decay)];
        Adam { groups, members: vec![], steps: 0, memory: Memory::new(&["first", "second"], true) }
    }
}

/// The constants of one step. Those of the denominator and of the second moment have the factor of [`moment_root`].
#[derive(Clone, Copy)]
struct Update<T> {
    beta: [T; 2],
    rest: [T; 2],
    rate: T,
    epsilon: T,
}

impl<T: Scalar> Update<T> {
    /// The step of an element, and its new moments.
    #[inline(always)]
    fn step(&self, grad: T, [first, second]: [T; 2]) -> (T, [T; 2]) {
        let g = limited(grad);
        let first = flushed(self.beta[0] * first + self.rest[0] * g);
        let second = self.beta[1] * second + self.rest[1] * (g * g);
        let second = if second > tiny_square() { second } else { T::ZERO };
        (self.rate * first / (second.sqrt() + self.epsilon), [first, second])
    }
}

impl<T: Scalar> Rule<T, 2> for Update<T> {
    #[inline(always)]
    fn element(&self, x: T, grad: T, moments: [T; 2]) -> (T, [T; 2]) {
        let (step, moments) = self.step(grad, moments);
        (x - step, moments)
    }
}

/// A step with weight decay. Decaying parameters become 0 where state does.
#[derive(Clone, Copy)]
struct Decayed<T> {
    update: Update<T>,
    /// The factor of the parameter, and its rounding error: without it, a decay below the rounding of 1 would be none.
    keep: [T; 2],
}

impl<T: Scalar> Decayed<T> {
    fn new(update: Update<T>, share: f64) -> Self {
        let keep = T::from_f64(1.0 - share);
        Decayed { update, keep: [keep, T::from_f64(1.0 - keep.to_f64() - share)] }
    }
}

impl<T: Scalar> Rule<T, 2> for Decayed<T> {
    #[inline(always)]
    fn element(&self, x: T, grad: T, moments: [T; 2]) -> (T, [T; 2]) {
        let (step, moments) = self.update.step(grad, moments);
        (flushed(x * self.keep[0]) - (step - x * self.keep[1]), moments)
    }
}

#[cfg(test)]
mod tests {
    use super::super::memory::CHUNK;
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
        let mut adam = Adam::new(AdamConfig { eps: epsilon, ..AdamConfig::default() });
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
    fn adam_f64_follows_the_algorithm() {
        let gradient = |t: usize| (t as f64 * 0.7).sin();
        for (factor, decay) in [(1.0, 0.1), (0.0, 0.1), (3.0, 0.02)] {
            let (mut adam, mut params) = (AdamW::new(AdamConfig::default(), decay), store(Tensor::scalar(0.5)));
            let (mut plain, mut free) = (Adam::new(AdamConfig::default()), store(Tensor::scalar(0.5)));
            params.set_weight_decay_scale(|_| true, factor);
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
    fn adam_nan_is_skipped_and_counted() {
        let mut adam = Adam::<f32>::new(AdamConfig::default());
        let mut params = store(Tensor::from_vec(&[4], vec![1.0, 2.0, 3.0, f32::MAX]));
        params.set_lr_scale(|_| true, 1e3);
        let grad = Tensor::from_vec(&[4], vec![1.0, f32::NAN, f32::INFINITY, -1.0]);
        let report = adam.update(&mut params, &[grad.into()], 1e30);
        assert_eq!(
            (report.updated, report.skipped, report.has_only_non_finite()),
            (1, 3, false),
            "the last step overflows"
        );
        assert_eq!(report.non_finite, [("x".to_owned(), 3)]);
        let message = report.check().unwrap_err().to_string();
        assert_eq!(
            message,
            "3 of 4 elements were not updated, because the gradient or the new value is not finite: 3 of `x`; lower the \
                 learning rate or clip the gradients"
        );
        assert_eq!(&params.values()[0].as_slice()[1..], [2.0, 3.0, f32::MAX]);
        for _ in 0..10_000 {
            step(&mut adam, &mut params, Tensor::zeros(&[4]), 0.1);
        }
        let state = adam.state(&params);
        assert!(state.tensors.values().flat_map(Tensor::as_slice).all(|x| *x == 0.0 || x.is_normal()), "{state:?}");
        assert!(params.values()[0].is_finite());
        assert!(adam.update(&mut params, &[Tensor::full(&[4], f32::NAN).into()], 0.1).has_only_non_finite());
        assert!(!adam.update(&mut params, &[Tensor::zeros(&[4]).into()], 0.1).has_only_non_finite());
    }

    #[test]
    fn decayed_parameter_ends_at_zero() {
        let mut adam = AdamW::new::<f32>(AdamConfig::default(), 1.0);
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
    fn row_bias_correction_ends_at_one() {
        for (beta2, least, most) in [(0.0, 1, 200), (0.999, 10_000, 40_000), (0.99999, 1 << 17, 1 << 17)] {
            let mut params = store(Tensor::<f32>::zeros(&[2, 1]));
            params.set_lazy(|_| true, true);
            let mut adam = Adam::new(AdamConfig { beta2, ..AdamConfig::default() });
            for _ in 0..3 {
                step(&mut adam, &mut params, Tensor::ones(&[2, 1]), 0.1);
                let count = adam.groups[0].corrections.len();
                assert!((least..=most).contains(&count), "{count} for a beta2 of {beta2}");
            }
            for step in [1, 5, 1 << 17, (1 << 17) + 1, 1 << 20, u32::MAX] {
                let root = (1.0 - f64::powf(beta2, step.into())).sqrt();
                let [rate, epsilon] = adam.groups[0].correction(step).map(f64::from);
                let expected = root / (1.0 - f64::powf(0.9, step.into()));
                assert!((rate - expected).abs() < 1e-6 * expected, "{rate} for {expected} at {step}");
                assert!((epsilon - root).abs() < 1e-6 * root, "{epsilon} for {root} at {step}");
            }
        }
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
