//! Stochastic gradient descent with momentum.

use super::limits::{flushed, tiny};
use super::memory::Memory;
use super::rule::Rule;
use super::settings::{check, check_decay, check_rate, or_panic};
use super::{Optimizer, OptimizerState, SettingError, StateError, UpdateReport};
use crate::Params;
use raygrad_autograd::Gradient;
use raygrad_tensor::Scalar;
use serde::{Deserialize, Serialize};

/// Stochastic gradient descent with momentum and weight decay: `h = g + decay x`, `v = momentum v + h`,
/// `x = x - rate d`.
///
/// The direction `d` is `v`, or `h + momentum v` with Nesterov momentum (Sutskever et al. 2013, in PyTorch's form).
///
/// Rows without gradient of a lazy parameter do not change, for any velocity and decay. Without momentum and decay,
/// lazy parameters are updated as others. Velocities below 1e-30 (1e-300 in f64) become 0.
///
/// A parameter without gradients so far has no entry in the state, and starts with a velocity of 0, as in PyTorch. So
/// momentum also accepts the empty state of descent without momentum.
#[derive(Debug, Clone)]
pub struct Sgd<T: Scalar> {
    config: SgdConfig,
    memory: Memory<T>,
}

/// The constants of [`Sgd`].
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct SgdConfig {
    /// Fraction of the last step's velocity that stays. Range: 0 to 1 - 2^-20 (1 - 2^-49 in f64). 0 is plain gradient
    /// descent, without state.
    pub momentum: f64,
    /// Whether to use Nesterov momentum.
    pub nesterov: bool,
    /// Weight decay: `decay` times the parameter is added to the gradient. Range: 0 to 1e30.
    pub weight_decay: f64,
}

impl SgdConfig {
    /// Checks that the constants are in their ranges for parameters of type `T`.
    ///
    /// # Errors
    /// If one is not; the error has its name. Also if Nesterov momentum is on and `momentum` is 0.
    pub fn check<T: Scalar>(&self) -> Result<(), SettingError> {
        check_decay::<T>("momentum", self.momentum)?;
        check("momentum", self.momentum, !self.nesterov || self.momentum > 0.0, "more than 0 to look ahead")?;
        check_rate("weight_decay", self.weight_decay)
    }
}

impl<T: Scalar> Sgd<T> {
    /// A new optimizer with empty state.
    ///
    /// # Panics
    /// If [`SgdConfig::check`] fails.
    #[track_caller]
    pub fn new(config: SgdConfig) -> Self {
        or_panic(config.check::<T>());
        Sgd { config, memory: Memory::new(if config.momentum == 0.0 { &[] } else { &["velocity"] }, false) }
    }
}

impl<T: Scalar> Optimizer<T> for Sgd<T> {
    #[track_caller]
    fn update(&mut self, params: &mut Params<T>, grads: &[Gradient<T>], rate: f64) -> UpdateReport {
        let mut report = UpdateReport::default();
        for part in params.updates(grads, |_| rate) {
            let decay = self.config.weight_decay * part.weight_decay;
            let update = Update {
                rate: T::from_f64(part.lr),
                momentum: T::from_f64(self.config.momentum),
                nesterov: self.config.nesterov,
                decay: T::from_f64(decay),
                tiniest: if decay == 0.0 { T::ZERO } else { tiny() },
            };
            match self.config.momentum {
                0.0 => self.memory.update::<0, _>(part, |_| update, |_| update, &mut report),
                _ => self.memory.update::<1, _>(part, |_| update, |_| update, &mut report),
            }
        }
        report
    }

    fn state(&self, params: &Params<T>) -> OptimizerState<T> {
        self.memory.state(params)
    }

    fn load_state(&mut self, params: &Params<T>, state: &OptimizerState<T>) -> Result<(), StateError> {
        self.memory = self.memory.loaded(params, state.clone())?;
        Ok(())
    }
}

/// The constants of one step.
#[derive(Clone, Copy)]
struct Update<T> {
    rate: T,
    momentum: T,
    nesterov: bool,
    decay: T,
    /// Decaying parameters smaller than this become 0.
    tiniest: T,
}

impl<T: Scalar> Update<T> {
    /// The parameter after a step along `direction`.
    #[inline(always)]
    fn moved(&self, x: T, direction: T) -> T {
        let moved = x - self.rate * direction;
        if moved < self.tiniest && moved > -self.tiniest { T::ZERO } else { moved }
    }
}

impl<T: Scalar> Rule<T, 0> for Update<T> {
    #[inline(always)]
    fn element(&self, x: T, grad: T, _memory: [T; 0]) -> (T, [T; 0]) {
        (self.moved(x, grad + self.decay * x), [])
    }
}

impl<T: Scalar> Rule<T, 1> for Update<T> {
    #[inline(always)]
    fn element(&self, x: T, grad: T, [velocity]: [T; 1]) -> (T, [T; 1]) {
        let h = grad + self.decay * x;
        let velocity = flushed(self.momentum * velocity + h);
        let direction = if self.nesterov { h + self.momentum * velocity } else { velocity };
        (self.moved(x, direction), [velocity])
    }
}

#[cfg(test)]
mod tests {
    use super::super::memory::CHUNK;
    use super::*;
    use raygrad_tensor::Tensor;

    /// One step of a single parameter.
    fn step<T: Scalar>(sgd: &mut Sgd<T>, params: &mut Params<T>, grad: &Tensor<T>, rate: f64) -> usize {
        sgd.update(params, &[grad.clone().into()], rate).skipped
    }

    fn store<T: Scalar>(value: Tensor<T>) -> Params<T> {
        let mut params = Params::new();
        params.add("x", value);
        params
    }

    #[test]
    fn follows_its_recurrences_in_f64() {
        for (momentum, nesterov, decay) in
            [(0.0, false, 0.0), (0.0, false, 0.1), (0.9, false, 0.0), (0.9, true, 0.0), (0.7, true, 0.05)]
        {
            let mut sgd = Sgd::<f64>::new(SgdConfig { momentum, nesterov, weight_decay: decay });
            let mut params = store(Tensor::from_vec(&[2], vec![0.5, -1.5]));
            let (mut x, mut v) = ([0.5, -1.5], [0.0; 2]);
            for t in 0..300 {
                let grad = Tensor::from_fn(&[2], |i| ((t + i) as f64 * 0.31).cos());
                let rate = 0.02 + 0.01 * (t as f64).sin();
                assert_eq!(step(&mut sgd, &mut params, &grad, rate), 0);
                for i in 0..2 {
                    let h = grad.as_slice()[i] + decay * x[i];
                    v[i] = momentum * v[i] + h;
                    x[i] -= rate * if nesterov { h + momentum * v[i] } else { v[i] };
                    let got = params.values()[0].as_slice()[i];
                    assert!((got - x[i]).abs() < 1e-12, "{momentum} {nesterov} {decay}: step {t}");
                }
            }
        }
    }

    #[test]
    fn momentum_on_a_quadratic_is_the_closed_form() {
        // x'' = -c x in discrete time: x_{t+1} = (1 + mu - c rate) x_t - mu x_{t-1}, whose roots solve a quadratic.
        let (mu, rate, curvature) = (0.25, 0.1, 1.0);
        let mut sgd = Sgd::<f64>::new(SgdConfig { momentum: mu, ..SgdConfig::default() });
        let mut params = store(Tensor::scalar(1.0));
        let b: f64 = 1.0 + mu - curvature * rate;
        let root = (b * b - 4.0 * mu).sqrt();
        let (r1, r2) = (0.5 * (b + root), 0.5 * (b - root));
        // x_0 = 1 and x_1 = 1 - c rate.
        let c1 = (1.0 - curvature * rate - r2) / (r1 - r2);
        for t in 1..100 {
            let grad = Tensor::scalar(curvature * params.values()[0].item());
            step(&mut sgd, &mut params, &grad, rate);
            let (got, expected) = (params.values()[0].item(), c1 * r1.powi(t) + (1.0 - c1) * r2.powi(t));
            assert!((got - expected).abs() < 1e-13, "step {t}: {got} instead of {expected}");
        }
    }

    #[test]
    fn sgd_non_finite_gradients_are_skipped_and_counted() {
        for momentum in [0.0, 0.9] {
            let mut sgd = Sgd::<f32>::new(SgdConfig { momentum, weight_decay: 0.5, ..SgdConfig::default() });
            let start = [1.0, 2.0, 3.0, -3e38, 1e-25];
            let mut params = store(Tensor::from_vec(&[5], start.to_vec()));
            let grad = Tensor::from_vec(&[5], vec![f32::NAN, f32::NEG_INFINITY, 1.0, 3e38, 0.0]);
            // The step of element 3 would overflow.
            assert_eq!(step(&mut sgd, &mut params, &grad, 1.0), 3, "momentum {momentum}");
            assert_eq!([0, 1, 3].map(|i| params.values()[0].as_slice()[i]), [1.0, 2.0, -3e38]);
            for _ in 0..5000 {
                step(&mut sgd, &mut params, &Tensor::zeros(&[5]), 0.1);
                assert!(params.values()[0].as_slice().iter().all(|x| !x.is_subnormal()));
            }
            assert!(params.values()[0].as_slice()[4].abs() < 4e-30, "where velocity ends, so does decay");
            let state = sgd.state(&params);
            assert!(state.tensors.values().flat_map(Tensor::as_slice).all(|v| !v.is_subnormal()));
            assert_eq!(state.tensors.is_empty(), momentum == 0.0);
        }
    }

    #[test]
    fn empty_parameters_and_long_ones_take_the_same_step() {
        for momentum in [0.0, 0.5] {
            let mut sgd = Sgd::<f32>::new(SgdConfig { momentum, ..SgdConfig::default() });
            let mut params = Params::new();
            for (i, shape) in [&[0, 3][..], &[2 * CHUNK + 3], &[]].into_iter().enumerate() {
                params.add(i.to_string(), Tensor::ones(shape));
            }
            params.set_lazy(|_| true, true);
            for lazy in [true, false] {
                params.set_lazy(|_| true, lazy);
                let grads: Vec<_> = params.values().iter().map(|x| Gradient::from(Tensor::ones(x.shape()))).collect();
                assert_eq!(sgd.update(&mut params, &grads, 0.5).check(), Ok(2 * CHUNK + 4));
            }
            let expected = if momentum == 0.0 { 0.0 } else { -0.25 };
            assert!(params.values().iter().flat_map(Tensor::as_slice).all(|&x| x == expected));
        }
    }
}
