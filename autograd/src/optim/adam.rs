//! Adam and AdamW.

use super::limits::{flushed, limited, tiny, tiny_square};
use super::settings::{check, check_rate, check_share, or_panic};
use super::{CHUNK, Move, Optimizer, SettingError, check_shapes, remember, slot};
use raygrad_tensor::{Scalar, Tensor, simd};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Adam (Kingma and Ba 2015, algorithm 1).
///
/// Bias corrections are computed in f64 from an integer step count, which each parameter has for itself. First moments
/// below 1e-30 (1e-300 in f64) and second ones below 1e-37 (1e-307) are set to 0, so that long runs without gradient do not fill memory with
/// denormal numbers, which are slow. Gradients count as at most 1e19 (1e154 in f64), so that their squares are finite. Work
/// is spread over the current rayon pool; the result does not depend on the number of threads.
#[derive(Debug, Clone)]
pub struct Adam<T: Scalar> {
    config: AdamConfig,
    step: u64,
    moments: Vec<Moments<T>>,
}

/// Adam with decoupled weight decay (Loshchilov and Hutter 2019, algorithm 2): before each step a parameter is
/// multiplied by `1 - rate decay`. An element whose gradient is infinite or NaN does not decay either.
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
struct Moments<T> {
    step: u64,
    first: Vec<T>,
    second: Vec<T>,
}

impl<T: Scalar> Adam<T> {
    /// An optimiser that has seen nothing.
    ///
    /// # Panics
    /// If [`AdamConfig::check`] finds something.
    #[track_caller]
    pub fn new(config: AdamConfig) -> Self {
        or_panic(config.check());
        Adam { config, step: 0, moments: vec![] }
    }

    /// Number of steps taken.
    pub fn steps(&self) -> u64 {
        self.step
    }

    /// Moves each parameter against its gradient with learning rate `rate`, and returns how many elements were left
    /// alone because their gradient was infinite or NaN.
    ///
    /// # Panics
    /// If the number or a shape of the gradients is not that of the parameters, or of the parameters of the last step.
    #[track_caller]
    pub fn step(&mut self, params: &mut [Tensor<T>], grads: &[Tensor<T>], rate: f64) -> usize {
        assert_eq!(params.len(), grads.len(), "as many gradients as parameters");
        self.step_pairs(params.iter_mut().zip(grads), rate)
    }

    /// As [`step`](Self::step), for parameters that come with their gradients: always the same ones, in the same order.
    ///
    /// # Panics
    /// As [`step`](Self::step).
    #[track_caller]
    pub fn step_pairs<'a>(
        &mut self,
        pairs: impl Iterator<Item = (&'a mut Tensor<T>, &'a Tensor<T>)>,
        rate: f64,
    ) -> usize {
        let known = (self.step > 0).then_some(self.moments.len());
        let mut count = 0;
        let moves = pairs.enumerate().map(|(slot, (value, grad))| Move { slot, value, grad, rate, decay: 1.0 });
        let skipped = self.advance_with(moves.inspect(|_| count += 1), 0.0);
        assert!(known.is_none_or(|known| known == count), "as many parameters as in the first step");
        skipped
    }

    #[track_caller]
    fn advance_with<'a>(&mut self, moves: impl Iterator<Item = Move<'a, T>>, decay: f64) -> usize {
        self.step += 1;
        let AdamConfig { beta1, beta2, epsilon } = self.config;
        let mut skipped = 0;
        for part in moves {
            check_shapes(&part);
            let moments = slot(&mut self.moments, part.slot);
            let first = moments.step == 0;
            moments.step += 1;
            // 1 - beta^t without cancellation.
            let correction = |beta: f64| -(moments.step as f64 * beta.ln()).exp_m1();
            let root = correction(beta2).sqrt();
            let decay = decay * part.decay;
            let update = Update {
                beta: [beta1, beta2].map(T::from_f64),
                rest: [1.0 - beta1, 1.0 - beta2].map(T::from_f64),
                rate: T::from_f64(part.rate * root / correction(beta1)),
                epsilon: T::from_f64(epsilon * root),
                keep: T::from_f64(1.0 - part.rate * decay),
                tiniest: if decay == 0.0 { T::ZERO } else { tiny() },
            };
            let m = remember(&mut moments.first, part.value.len(), first);
            let v = remember(&mut moments.second, part.value.len(), first);
            let moments = m.par_chunks_mut(CHUNK).zip(v.par_chunks_mut(CHUNK));
            let values = part.value.as_mut_slice().par_chunks_mut(CHUNK).zip(part.grad.as_slice().par_chunks(CHUNK));
            skipped += values.zip(moments).map(|((x, g), (m, v))| update.apply(x, g, m, v)).sum::<usize>();
        }
        skipped
    }
}

impl<T: Scalar> Optimizer<T> for Adam<T> {
    #[track_caller]
    fn advance<'a>(&mut self, moves: &mut dyn Iterator<Item = Move<'a, T>>) -> usize
    where
        T: 'a,
    {
        self.advance_with(moves, 0.0)
    }
}

impl<T: Scalar> AdamW<T> {
    /// An optimiser that has seen nothing. `decay` is the part of a parameter that goes at each step at learning rate 1,
    /// customarily 0.01; parameters can have a factor of their own, such as 0 for biases
    /// ([`Params::set_decay`](crate::Params::set_decay)).
    ///
    /// # Panics
    /// If [`AdamConfig::check`] finds something, or the decay is negative, infinite or NaN.
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
    fn advance<'a>(&mut self, moves: &mut dyn Iterator<Item = Move<'a, T>>) -> usize
    where
        T: 'a,
    {
        self.adam.advance_with(moves, self.decay)
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
                    let good = g[i].is_finite();
                    let g = limited(g[i]);
                    let first = flushed(self.beta[0] * m[i] + self.rest[0] * g);
                    let second = self.beta[1] * v[i] + self.rest[1] * (g * g);
                    let second = if second > tiny_square() { second } else { T::ZERO };
                    let kept = x[i] * self.keep;
                    let kept = if kept < self.tiniest && kept > -self.tiniest { T::ZERO } else { kept };
                    let moved = kept - self.rate * first / (second.sqrt() + self.epsilon);
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

    fn one_step(g: f64, epsilon: f64) -> f64 {
        let mut adam = Adam::<f32>::new(AdamConfig { epsilon, ..AdamConfig::default() });
        let mut x = [Tensor::scalar(0.0_f32)];
        adam.step(&mut x, &[Tensor::scalar(g as f32)], 1.0);
        f64::from(x[0].item())
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
    fn follows_the_algorithm_in_f64() {
        let gradient = |t: usize| (t as f64 * 0.7).sin();
        let mut adam = Adam::<f64>::new(AdamConfig::default());
        let mut x = [Tensor::scalar(0.5)];
        let (mut m, mut v, mut expected) = (0.0, 0.0, 0.5);
        for t in 1..=500 {
            let g = gradient(t);
            adam.step(&mut x, &[Tensor::scalar(g)], 0.01);
            m = 0.9 * m + 0.1 * g;
            v = 0.999 * v + 0.001 * g * g;
            let (mh, vh) = (m / (1.0 - 0.9_f64.powi(t as i32)), v / (1.0 - 0.999_f64.powi(t as i32)));
            expected -= 0.01 * mh / (vh.sqrt() + 1e-8);
            assert!((x[0].item() - expected).abs() < 1e-10, "step {t}");
        }
    }

    #[test]
    fn nan_is_skipped_and_counted_and_nothing_goes_denormal() {
        let mut adam = Adam::<f32>::new(AdamConfig::default());
        let mut x = [Tensor::from_vec(&[3], vec![1.0, 2.0, 3.0_f32])];
        let skipped = adam.step(&mut x, &[Tensor::from_vec(&[3], vec![1.0, f32::NAN, f32::INFINITY])], 0.1);
        assert_eq!(skipped, 2);
        assert_eq!(&x[0].as_slice()[1..], [2.0, 3.0]);
        for _ in 0..10_000 {
            adam.step(&mut x, &[Tensor::zeros(&[3])], 0.1);
        }
        let Moments { first, second, .. } = &adam.moments[0];
        assert!(first.iter().chain(second).all(|x| *x == 0.0 || x.is_normal()), "{first:?} {second:?}");
        assert!(x[0].is_finite());
    }

    #[test]
    fn decoupled_decay_follows_the_algorithm_in_f64() {
        let gradient = |t: usize| (t as f64 * 0.7).sin();
        for (factor, decay) in [(1.0, 0.1), (0.0, 0.1), (3.0, 0.02)] {
            let mut adam = AdamW::<f64>::new(AdamConfig::default(), decay);
            let mut value = Tensor::scalar(0.5);
            let (mut m, mut v, mut expected) = (0.0, 0.0, 0.5);
            for t in 1..=500 {
                let (grad, rate) = (Tensor::scalar(gradient(t)), 0.01 * (1.0 + (t as f64).cos().abs()));
                let part = Move { slot: 4, value: &mut value, grad: &grad, rate, decay: factor };
                assert_eq!(adam.advance(&mut [part].into_iter()), 0);
                let g = gradient(t);
                m = 0.9 * m + 0.1 * g;
                v = 0.999 * v + 0.001 * g * g;
                let (mh, vh) = (m / (1.0 - 0.9_f64.powi(t as i32)), v / (1.0 - 0.999_f64.powi(t as i32)));
                expected = expected - rate * factor * decay * expected - rate * mh / (vh.sqrt() + 1e-8);
                assert!((value.item() - expected).abs() < 1e-10, "step {t}");
            }
        }
    }

    #[test]
    fn a_decaying_parameter_ends_at_zero_and_a_bad_gradient_stops_it() {
        let mut adam = AdamW::<f32>::new(AdamConfig::default(), 1.0);
        let mut value = Tensor::from_vec(&[2], vec![1e-25_f32, 1e-25]);
        let grad = Tensor::from_vec(&[2], vec![0.0, f32::NAN]);
        let mut skipped = 0;
        for _ in 0..300 {
            let part = Move { slot: 0, value: &mut value, grad: &grad, rate: 0.1, decay: 1.0 };
            skipped += adam.advance(&mut [part].into_iter());
            assert!(value.as_slice().iter().all(|x| !x.is_subnormal()));
        }
        assert_eq!((value.as_slice(), skipped), (&[0.0, 1e-25][..], 300));
        // Without decay a tiny parameter stays as it is.
        let mut adam = Adam::<f32>::new(AdamConfig::default());
        let mut x = [Tensor::scalar(1e-40_f32)];
        adam.step(&mut x, &[Tensor::scalar(0.0)], 0.1);
        assert_eq!(x[0].item(), 1e-40);
    }

    #[test]
    fn a_parameter_that_comes_later_has_its_own_count() {
        let mut adam = Adam::<f64>::new(AdamConfig::default());
        let (mut a, mut b) = (Tensor::scalar(0.0), Tensor::scalar(0.0));
        let grad = Tensor::scalar(1.0);
        for step in 0..50 {
            let first = Move { slot: 0, value: &mut a, grad: &grad, rate: 0.1, decay: 1.0 };
            let second = Move { slot: 7, value: &mut b, grad: &grad, rate: 0.1, decay: 1.0 };
            adam.advance(&mut [Some(first), (step >= 40).then_some(second)].into_iter().flatten());
        }
        // With a constant gradient every step is one learning rate, from the first one on.
        assert!((a.item() + 5.0).abs() < 1e-6 && (b.item() + 1.0).abs() < 1e-6, "{a:?} {b:?}");
        assert_eq!(adam.steps(), 50);
    }

    #[test]
    fn empty_parameters_and_long_ones_take_the_same_step() {
        let mut adam = Adam::<f32>::new(AdamConfig::default());
        let len = 2 * CHUNK + 3;
        let mut x = [Tensor::zeros(&[0, 3]), Tensor::zeros(&[len])];
        let grads = [Tensor::zeros(&[0, 3]), Tensor::from_fn(&[len], |i| 1.0 + (i % 7) as f32)];
        assert_eq!(adam.step(&mut x, &grads, 0.5), 0);
        assert!(x[1].as_slice().iter().all(|x| (x + 0.5).abs() < 1e-6));
    }

    #[test]
    #[should_panic(expected = "as many parameters as in the first step")]
    fn a_parameter_cannot_be_left_out_of_a_step() {
        let mut adam = Adam::<f32>::new(AdamConfig::default());
        let mut x = [Tensor::scalar(0.0), Tensor::scalar(0.0)];
        let grads = [Tensor::scalar(1.0), Tensor::scalar(1.0)];
        adam.step(&mut x, &grads, 0.1);
        adam.step(&mut x[..1], &grads[..1], 0.1);
    }
}
