//! Optimisers and schedules.

use raygrad_tensor::{Scalar, Tensor, simd};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Adam (Kingma and Ba 2015, algorithm 1).
///
/// Bias corrections are computed in f64 from an integer step count. Moments below 1e-30 are set to 0, so that long runs
/// without gradient do not fill memory with denormal numbers, which are slow. Work is spread over the current rayon
/// pool; the result does not depend on the number of threads.
#[derive(Debug, Clone)]
pub struct Adam<T: Scalar> {
    config: AdamConfig,
    step: u64,
    /// First and second moment of each parameter.
    moments: Vec<(Vec<T>, Vec<T>)>,
}

/// Constants of [`Adam`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct AdamConfig {
    /// Decay of the first moment, in 0..1.
    pub beta1: f64,
    /// Decay of the second moment, in 0..1.
    pub beta2: f64,
    /// Added to the root of the second moment. It bounds the step of elements with tiny gradients: 1e-8 suits dense
    /// networks, 1e-15 hash tables.
    pub epsilon: f64,
}

impl Default for AdamConfig {
    /// 0.9, 0.999, 1e-8.
    fn default() -> Self {
        AdamConfig { beta1: 0.9, beta2: 0.999, epsilon: 1e-8 }
    }
}

/// Elements that one task updates.
const CHUNK: usize = 1 << 14;

impl<T: Scalar> Adam<T> {
    /// An optimiser that has seen nothing.
    pub fn new(config: AdamConfig) -> Self {
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
        let first = self.step == 0;
        self.step += 1;
        let AdamConfig { beta1, beta2, epsilon } = self.config;
        // 1 - beta^t without cancellation.
        let correction = |beta: f64| -(self.step as f64 * beta.ln()).exp_m1();
        let root = correction(beta2).sqrt();
        let update = Update {
            beta: [beta1, beta2].map(T::from_f64),
            rest: [1.0 - beta1, 1.0 - beta2].map(T::from_f64),
            rate: T::from_f64(rate * root / correction(beta1)),
            epsilon: T::from_f64(epsilon * root),
        };
        let (mut skipped, mut count) = (0, 0);
        for (i, (param, grad)) in pairs.enumerate() {
            assert_eq!(param.shape(), grad.shape(), "a gradient has the shape of its parameter");
            if first {
                self.moments.push((vec![T::ZERO; param.len()], vec![T::ZERO; param.len()]));
            }
            let (m, v) = &mut self.moments[i];
            assert_eq!(m.len(), param.len(), "the same parameters as in the first step");
            let moments = m.par_chunks_mut(CHUNK).zip(v.par_chunks_mut(CHUNK));
            let values = param.as_mut_slice().par_chunks_mut(CHUNK).zip(grad.as_slice().par_chunks(CHUNK));
            skipped += values.zip(moments).map(|((x, g), (m, v))| update.apply(x, g, m, v)).sum::<usize>();
            count += 1;
        }
        assert_eq!(count, self.moments.len(), "as many parameters as in the first step");
        skipped
    }
}

/// One step's constants.
struct Update<T> {
    beta: [T; 2],
    rest: [T; 2],
    rate: T,
    epsilon: T,
}

impl<T: Scalar> Update<T> {
    fn apply(&self, x: &mut [T], g: &[T], m: &mut [T], v: &mut [T]) -> usize {
        let tiny = T::from_f64(1e-30);
        let n = x.len();
        let (g, m, v) = (&g[..n], &mut m[..n], &mut v[..n]);
        simd::dispatch(
            #[inline(always)]
            || {
                let mut skipped = 0;
                for i in 0..n {
                    let good = g[i].is_finite();
                    let first = self.beta[0] * m[i] + self.rest[0] * g[i];
                    // The square of a large finite gradient overflows to infinity, which makes the step 0.
                    let second = self.beta[1] * v[i] + self.rest[1] * (g[i] * g[i]);
                    let first = if first > tiny || first < -tiny { first } else { T::ZERO };
                    let second = if second > tiny { second } else { T::ZERO };
                    let moved = x[i] - self.rate * first / (second.sqrt() + self.epsilon);
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

/// A learning rate over the course of a run, as a function of the fraction that is done.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Schedule {
    /// The same throughout.
    Constant {
        /// The rate.
        rate: f64,
    },
    /// `from * (to / from)^fraction`, after a linear rise from 0 over the first `warmup` of the run.
    Exponential {
        /// The rate at the start.
        from: f64,
        /// The rate at the end.
        to: f64,
        /// The fraction of the run over which the rate rises.
        warmup: f64,
    },
}

impl Schedule {
    /// The learning rate when `fraction` (0 to 1) of the run is done.
    pub fn rate(&self, fraction: f64) -> f64 {
        let fraction = fraction.clamp(0.0, 1.0);
        match *self {
            Schedule::Constant { rate } => rate,
            Schedule::Exponential { from, to, warmup } => {
                let rise = if fraction < warmup { fraction / warmup } else { 1.0 };
                rise * from * (to / from).powf(fraction)
            }
        }
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
        assert_eq!(one_step(1e30, 1e-8), 0.0, "the square overflows: no step rather than a wild one");
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
        let (m, v) = &adam.moments[0];
        assert!(m.iter().chain(v).all(|x| *x == 0.0 || x.is_normal()), "{m:?} {v:?}");
        assert!(x[0].is_finite());
    }

    #[test]
    fn schedules_hit_their_ends() {
        let decay = Schedule::Exponential { from: 1e-2, to: 1e-4, warmup: 0.1 };
        assert_eq!(decay.rate(0.0), 0.0);
        assert!((decay.rate(0.5) - 1e-3).abs() < 1e-12);
        assert!((decay.rate(1.0) - 1e-4).abs() < 1e-12 && decay.rate(2.0) == decay.rate(1.0));
    }
}
