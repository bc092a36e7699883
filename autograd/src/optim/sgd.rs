//! Gradient descent with momentum.

use super::limits::{flushed, tiny};
use super::settings::{check, check_rate, check_share, or_panic};
use super::{CHUNK, Move, Optimizer, SettingError, check_shapes, remember, slot};
use raygrad_tensor::{Scalar, simd};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// Gradient descent: `h = g + decay x`, `v = momentum v + h`, `x = x - rate d`, where the direction `d` is `v`, or
/// `h + momentum v` with Nesterov's look-ahead (Sutskever et al. 2013, in the form that PyTorch has).
///
/// An element is left alone, and counted, if its gradient or what would come of it is infinite or NaN.
#[derive(Debug, Clone)]
pub struct Sgd<T: Scalar> {
    config: SgdConfig,
    velocities: Vec<Option<Vec<T>>>,
}

/// Constants of [`Sgd`].
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct SgdConfig {
    /// How much of the last step's velocity stays, in 0..1; 0 is plain gradient descent, which remembers nothing.
    pub momentum: f64,
    /// Look ahead along the velocity.
    pub nesterov: bool,
    /// Weight decay: this times the parameter is added to the gradient.
    pub decay: f64,
}

impl SgdConfig {
    /// Whether the constants are in their ranges.
    ///
    /// # Errors
    /// If one is not, with its name; also if there is a look-ahead without momentum.
    pub fn check(&self) -> Result<(), SettingError> {
        check_share("momentum", self.momentum)?;
        check("momentum", self.momentum, !self.nesterov || self.momentum > 0.0, "more than 0 to look ahead")?;
        check_rate("decay", self.decay)
    }
}

impl<T: Scalar> Sgd<T> {
    /// An optimiser that has seen nothing.
    ///
    /// # Panics
    /// If [`SgdConfig::check`] finds something.
    #[track_caller]
    pub fn new(config: SgdConfig) -> Self {
        or_panic(config.check());
        Sgd { config, velocities: vec![] }
    }
}

impl<T: Scalar> Optimizer<T> for Sgd<T> {
    #[track_caller]
    fn advance<'a>(&mut self, moves: &mut dyn Iterator<Item = Move<'a, T>>) -> usize
    where
        T: 'a,
    {
        let mut skipped = 0;
        for part in moves {
            check_shapes(&part);
            let decay = self.config.decay * part.decay;
            let update = Update {
                rate: T::from_f64(part.rate),
                momentum: T::from_f64(self.config.momentum),
                nesterov: self.config.nesterov,
                decay: T::from_f64(decay),
                tiniest: if decay == 0.0 { T::ZERO } else { tiny() },
            };
            let len = part.value.len();
            let values = part.value.as_mut_slice().par_chunks_mut(CHUNK).zip(part.grad.as_slice().par_chunks(CHUNK));
            skipped += if self.config.momentum == 0.0 {
                values.map(|(x, g)| update.plain(x, g)).sum::<usize>()
            } else {
                let velocity = slot(&mut self.velocities, part.slot);
                let first = velocity.is_none();
                let velocity = remember(velocity.get_or_insert_default(), len, first);
                values.zip(velocity.par_chunks_mut(CHUNK)).map(|((x, g), v)| update.apply(x, g, v)).sum::<usize>()
            };
        }
        skipped
    }
}

/// One step's constants.
struct Update<T> {
    rate: T,
    momentum: T,
    nesterov: bool,
    decay: T,
    /// A decaying parameter is 0 below this.
    tiniest: T,
}

impl<T: Scalar> Update<T> {
    /// The parameter after a step along `direction`, and whether all went well.
    #[inline(always)]
    fn moved(&self, x: T, g: T, direction: T) -> (T, bool) {
        let moved = x - self.rate * direction;
        let moved = if moved < self.tiniest && moved > -self.tiniest { T::ZERO } else { moved };
        (moved, g.is_finite() && moved.is_finite())
    }

    fn plain(&self, x: &mut [T], g: &[T]) -> usize {
        let n = x.len();
        let g = &g[..n];
        simd::dispatch(
            #[inline(always)]
            || {
                let mut skipped = 0;
                for i in 0..n {
                    let (moved, good) = self.moved(x[i], g[i], g[i] + self.decay * x[i]);
                    x[i] = if good { moved } else { x[i] };
                    skipped += usize::from(!good);
                }
                skipped
            },
        )
    }

    fn apply(&self, x: &mut [T], g: &[T], v: &mut [T]) -> usize {
        let n = x.len();
        let (g, v) = (&g[..n], &mut v[..n]);
        let ahead = if self.nesterov { T::ONE } else { T::ZERO };
        simd::dispatch(
            #[inline(always)]
            || {
                let mut skipped = 0;
                for i in 0..n {
                    let h = g[i] + self.decay * x[i];
                    let velocity = flushed(self.momentum * v[i] + h);
                    let direction = if ahead > T::ZERO { h + self.momentum * velocity } else { velocity };
                    let (moved, good) = self.moved(x[i], g[i], direction);
                    v[i] = if good { velocity } else { v[i] };
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

    fn step<T: Scalar>(sgd: &mut Sgd<T>, value: &mut Tensor<T>, grad: &Tensor<T>, rate: f64) -> usize {
        sgd.advance(&mut [Move { slot: 0, value, grad, rate, decay: 1.0 }].into_iter())
    }

    #[test]
    fn follows_its_recurrences_in_f64() {
        for (momentum, nesterov, decay) in
            [(0.0, false, 0.0), (0.0, false, 0.1), (0.9, false, 0.0), (0.9, true, 0.0), (0.7, true, 0.05)]
        {
            let mut sgd = Sgd::<f64>::new(SgdConfig { momentum, nesterov, decay });
            let mut value = Tensor::from_vec(&[2], vec![0.5, -1.5]);
            let (mut x, mut v) = ([0.5, -1.5], [0.0; 2]);
            for t in 0..300 {
                let grad = Tensor::from_fn(&[2], |i| ((t + i) as f64 * 0.31).cos());
                let rate = 0.02 + 0.01 * (t as f64).sin();
                assert_eq!(step(&mut sgd, &mut value, &grad, rate), 0);
                for i in 0..2 {
                    let h = grad.as_slice()[i] + decay * x[i];
                    v[i] = momentum * v[i] + h;
                    x[i] -= rate * if nesterov { h + momentum * v[i] } else { v[i] };
                    assert!((value.as_slice()[i] - x[i]).abs() < 1e-12, "{momentum} {nesterov} {decay}: step {t}");
                }
            }
        }
    }

    #[test]
    fn momentum_on_a_quadratic_is_the_closed_form() {
        // x'' = -c x in discrete time: x_{t+1} = (1 + mu - c rate) x_t - mu x_{t-1}, whose roots solve a quadratic.
        let (mu, rate, curvature) = (0.25, 0.1, 1.0);
        let mut sgd = Sgd::<f64>::new(SgdConfig { momentum: mu, ..SgdConfig::default() });
        let mut value = Tensor::scalar(1.0);
        let b: f64 = 1.0 + mu - curvature * rate;
        let root = (b * b - 4.0 * mu).sqrt();
        let (r1, r2) = (0.5 * (b + root), 0.5 * (b - root));
        // x_0 = 1 and x_1 = 1 - c rate.
        let c1 = (1.0 - curvature * rate - r2) / (r1 - r2);
        for t in 1..100 {
            let grad = Tensor::scalar(curvature * value.item());
            step(&mut sgd, &mut value, &grad, rate);
            let expected = c1 * r1.powi(t) + (1.0 - c1) * r2.powi(t);
            assert!((value.item() - expected).abs() < 1e-13, "step {t}: {} instead of {expected}", value.item());
        }
    }

    #[test]
    fn bad_gradients_are_skipped_and_counted_and_nothing_goes_denormal() {
        for momentum in [0.0, 0.9] {
            let mut sgd = Sgd::<f32>::new(SgdConfig { momentum, decay: 0.5, ..SgdConfig::default() });
            let start = [1.0, 2.0, 3.0, -3e38, 1e-25];
            let mut value = Tensor::from_vec(&[5], start.to_vec());
            let grad = Tensor::from_vec(&[5], vec![f32::NAN, f32::NEG_INFINITY, 1.0, 3e38, 0.0]);
            // The step of element 3 would overflow.
            assert_eq!(step(&mut sgd, &mut value, &grad, 1.0), 3, "momentum {momentum}");
            assert_eq!([0, 1, 3].map(|i| value.as_slice()[i]), [1.0, 2.0, -3e38]);
            for _ in 0..5000 {
                step(&mut sgd, &mut value, &Tensor::zeros(&[5]), 0.1);
                assert!(value.as_slice().iter().all(|x| !x.is_subnormal()));
            }
            assert!(value.as_slice()[4].abs() < 4e-30, "where velocity ends, so does decay");
            assert!(sgd.velocities.iter().flatten().flatten().all(|v| !v.is_subnormal()));
            assert_eq!(sgd.velocities.is_empty(), momentum == 0.0);
        }
    }

    #[test]
    fn empty_parameters_and_long_ones_take_the_same_step() {
        for momentum in [0.0, 0.5] {
            let mut sgd = Sgd::<f32>::new(SgdConfig { momentum, ..SgdConfig::default() });
            for shape in [&[0, 3][..], &[2 * CHUNK + 3], &[]] {
                let mut value = Tensor::ones(shape);
                let grad = Tensor::ones(shape);
                let part = Move { slot: shape.len(), value: &mut value, grad: &grad, rate: 0.5, decay: 1.0 };
                assert_eq!(sgd.advance(&mut [part].into_iter()), 0);
                assert!(value.as_slice().iter().all(|&x| x == 0.5));
            }
        }
    }
}
