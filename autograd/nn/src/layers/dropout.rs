//! Dropout.

use super::{Layer, Mode};
use crate::Bound;
use rand::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::Var;
use raygrad_tensor::{Scalar, Tensor};

/// Dropout: during training, sets random elements to 0 and scales the others so that the expectation stays. This is
/// inverted dropout (Srivastava et al. 2014, section 10). In evaluation it is the identity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dropout {
    rate: f64,
}

impl Dropout {
    /// A layer that drops each element with probability `rate`.
    ///
    /// # Panics
    /// If `rate` is not in 0..1.
    #[track_caller]
    pub fn new(rate: f64) -> Self {
        assert!((0.0..1.0).contains(&rate), "a dropout rate of {rate}: it is at least 0 and below 1");
        Dropout { rate }
    }

    /// Applies dropout to `x`. In training, each element is multiplied by 0 or divided by `1 - rate`. The choice depends
    /// on the seed and the position alone. Two layers of a model need different seeds ([`Mode::part`]), which
    /// [`Sequential`](super::Sequential) provides.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// use raygrad_nn::{Dropout, Mode};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::ones(&[1000]));
    /// let dropout = Dropout::new(0.75);
    /// assert_eq!(dropout.forward(&x, Mode::Evaluate).value(), x.value());
    /// let y = dropout.forward(&x, Mode::Train(7));
    /// assert!(y.value().as_slice().iter().all(|&y| y == 0.0 || y == 4.0));
    /// assert_eq!(dropout.forward(&x, Mode::Train(7)).value(), y.value());
    /// ```
    #[track_caller]
    pub fn forward<'t, T: Scalar>(&self, x: &Var<'t, T>, mode: Mode) -> Var<'t, T> {
        match mode {
            Mode::Train(seed) if self.rate > 0.0 => x * x.tape().constant(self.mask(x, seed)),
            _ => x.clone(),
        }
    }

    fn mask<T: Scalar>(&self, x: &Var<'_, T>, seed: u64) -> Tensor<T> {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let kept = T::from_f64(1.0 / (1.0 - self.rate));
        // Of 2^32 equally likely numbers these are dropped: the rate is met within 2^-33.
        let dropped = (self.rate * 4_294_967_296.0).round() as u64;
        let mut mask = x.tape().pool().tensor(x.shape());
        for m in mask.as_mut_slice() {
            *m = if u64::from(rng.next_u32()) < dropped { T::ZERO } else { kept };
        }
        mask
    }
}

impl<T: Scalar> Layer<T> for Dropout {
    #[track_caller]
    fn apply<'t>(&self, _params: &Bound<'t, T>, x: &Var<'t, T>, mode: Mode) -> Var<'t, T> {
        self.forward(x, mode)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::Tape;
    use raygrad_autograd::check::{Check, check_function};

    #[test]
    fn drops_the_stated_share_and_keeps_the_expectation() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::ones(&[100, 1000]));
        for rate in [0.0, 0.1, 0.5, 0.9] {
            let y = Dropout::new(rate).forward(&x, Mode::Train(3));
            let zeros = y.value().as_slice().iter().filter(|&&y| y == 0.0).count() as f64 / 1e5;
            assert!((zeros - rate).abs() < 5.0 * (rate * (1.0 - rate) / 1e5).sqrt() + 1e-12, "{rate}: {zeros}");
            assert!((y.mean().item() - 1.0).abs() < 0.05, "{rate}");
            // The gradient passes where the value does, and with its factor.
            assert_eq!(y.sum().grad(&[&x])[0], *y.value());
        }
        let other = Dropout::new(0.5).forward(&x, Mode::Train(4));
        assert_ne!(Dropout::new(0.5).forward(&x, Mode::Train(3)).value(), other.value());
    }

    #[test]
    fn derivatives_and_odd_shapes_are_right() {
        for shape in [&[][..], &[0, 3], &[4, 2]] {
            let x = Tensor::from_fn(shape, |i| 0.3 * i as f64 - 0.8);
            check_function(&Check::default(), &[x], |x| Dropout::new(0.4).forward(&x[0], Mode::Train(1)).sin())
                .unwrap();
        }
    }

    #[test]
    #[should_panic(expected = "at least 0 and below 1")]
    fn nothing_would_be_left() {
        Dropout::new(1.0);
    }
}
