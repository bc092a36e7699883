//! Optical depths of intervals.

use crate::field::MOST_LOG_DENSITY;
use crate::{Error, Result};
#[cfg(any(test, feature = "check"))]
use raygrad_autograd::check::Entry;
use raygrad_autograd::{Grads, Op, Pool, Reads, Scalar, Shape, ShapeError, Tensor, Var, Vjp};
use raygrad_tensor::map;

/// The operation `x_i = sigma_i delta_i`: densities `[samples]` to optical depths `[samples]`.
///
/// Densities are at least 0, or given as logarithms (see [`of_log_density`](Self::of_log_density)). A density of 0 has
/// the optical depth 0 even if `delta` is infinite; where `delta` is infinite the gradient is defined as 0.
#[derive(Debug, Clone)]
pub struct OpticalDepth<T: Scalar> {
    delta: Tensor<T>,
    log_density: bool,
}

impl<T: Scalar> OpticalDepth<T> {
    /// Creates the operation for intervals of length `delta` `[samples]`, in scene units.
    ///
    /// Applying it panics if a density is negative; call [`check`](Self::check) first if one may be.
    ///
    /// # Panics
    /// If an interval is negative or NaN.
    #[track_caller]
    pub fn new(delta: Tensor<T>) -> Self {
        OpticalDepth::try_new(delta).unwrap_or_else(|error| panic!("{error}"))
    }

    /// Creates the operation as [`new`](Self::new), with an error instead of a panic.
    ///
    /// # Errors
    /// If an interval is negative or NaN.
    pub fn try_new(delta: Tensor<T>) -> Result<Self> {
        match delta.as_slice().iter().position(|&delta| !(delta >= T::ZERO)) {
            Some(i) => Err(Error::setting(
                format!("delta[{i}]"),
                format!("is {}; use lengths of at least 0", delta.as_slice()[i]),
            )),
            None => Ok(OpticalDepth { delta, log_density: false }),
        }
    }

    /// Creates the operation for log densities z, `sigma = e^z`.
    ///
    /// The fused exponential keeps gradients finite: its gradient is `x`, and [weights](super::Weights) multiply it by
    /// `e^-x`. A separate exponential would give infinity times 0.
    ///
    /// # Panics
    /// If an interval is negative or NaN.
    #[track_caller]
    pub fn of_log_density(delta: Tensor<T>) -> Self {
        OpticalDepth { log_density: true, ..OpticalDepth::new(delta) }
    }

    /// Checks that no density is negative. NaN passes, and so does any log density.
    ///
    /// # Errors
    /// If a density is negative; the error names its index.
    pub fn check(&self, density: &Tensor<T>) -> Result<()> {
        let density = density.as_slice();
        match density.iter().position(|&sigma| !self.log_density && sigma < T::ZERO) {
            Some(i) => {
                let what = format!("is {}; use densities of at least 0, for instance by a softplus", density[i]);
                Err(Error::setting(format!("density[{i}]"), what))
            }
            None => Ok(()),
        }
    }
}

impl<T: Scalar> Op<T> for OpticalDepth<T> {
    fn name(&self) -> &'static str {
        "optical_depth"
    }

    fn arity(&self) -> Option<usize> {
        Some(1)
    }

    fn shape(&self, x: &[&[usize]]) -> std::result::Result<Shape, ShapeError> {
        match x[0] == self.delta.shape() {
            true => Ok(x[0].into()),
            false => Err(format!("densities must be {:?}, one per interval", self.delta.shape())),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        if let Err(error) = self.check(x[0]) {
            panic!("{error}");
        }
        let most = T::from_f64(MOST_LOG_DENSITY);
        if self.log_density {
            map(
                [x[0], &self.delta],
                pool,
                #[inline(always)]
                // A plain product would be NaN for 0 times infinity.
                |[z, delta]| {
                    let sigma = (if z > most { most } else { z }).exp();
                    if sigma == T::ZERO { T::ZERO } else { sigma * delta }
                },
            )
        } else {
            map(
                [x[0], &self.delta],
                pool,
                #[inline(always)]
                // A plain product would be NaN for 0 times infinity.
                |[sigma, delta]| if sigma == T::ZERO { T::ZERO } else { sigma * delta },
            )
        }
    }

    fn reads(&self) -> Reads {
        // dx/dz = x for x = e^z delta, and dx/dsigma = delta.
        Reads::INPUTS.and_if(self.log_density, Reads::OUTPUT)
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (g, most) = (cx.g().value(), T::from_f64(MOST_LOG_DENSITY));
        let grad = if self.log_density {
            map(
                [g, cx.input(0), cx.output(), &self.delta],
                cx.pool(),
                #[inline(always)]
                // An infinite depth blocks everything, so its gradient is 0; NaN passes through.
                |[g, z, x, delta]| {
                    let infinite = !delta.is_finite() || (x > T::ZERO && !x.is_finite());
                    if infinite || z > most { T::ZERO } else { g * x }
                },
            )
        } else {
            map(
                [g, &self.delta],
                cx.pool(),
                #[inline(always)]
                |[g, delta]| if delta.is_finite() { g * delta } else { T::ZERO },
            )
        };
        Grads::one(cx.constant(grad))
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let sigma = if self.log_density { x[0].minimum(MOST_LOG_DENSITY).exp() } else { x[0].clone() };
        let constant = |f: &dyn Fn(T, T) -> T| {
            let pairs = self.delta.as_slice().iter().zip(sigma.value().as_slice());
            let values = pairs.map(|(&delta, &sigma)| f(delta, sigma)).collect();
            sigma.tape().constant(Tensor::from_vec(self.delta.shape(), values))
        };
        // An infinite interval adds a constant: 0 without density, otherwise infinity.
        let finite = constant(&|delta, _| if delta.is_finite() { delta } else { T::ZERO });
        let infinite = constant(&|delta, sigma| if delta.is_finite() || sigma == T::ZERO { T::ZERO } else { delta });
        Some(sigma * finite + infinite)
    }
}

/// The catalogue entries of this file. [`OpticalDepth`] holds a tensor of its own number type, so each precision has
/// its own.
#[cfg(any(test, feature = "check"))]
pub(crate) fn entries() -> Vec<Entry> {
    let delta = || Tensor::<f64>::from_vec(&[7], vec![0.25, 0.5, 0.125, 0.5, 1.0, 0.0, 0.375]);
    let sigma = |values: [f64; 7]| Tensor::from_vec(&[7], values.to_vec());
    vec![
        Entry::of(OpticalDepth::new(delta()), OpticalDepth::new(delta().cast::<f32>()))
            .sample_of(vec![sigma([0.4, 1.3, 2.0, 0.1, 3.0, 0.7, 0.2])])
            .sample_of(vec![sigma([30.0, 0.5, 9.0, 0.01, 20.0, 5.0, 40.0])]),
        Entry::of(OpticalDepth::of_log_density(delta()), OpticalDepth::of_log_density(delta().cast::<f32>()))
            .sample_of(vec![sigma([0.4, -1.3, 2.0, -3.1, 1.0, 0.7, 0.2])]),
        Entry::of(OpticalDepth::<f64>::new(Tensor::zeros(&[0])), OpticalDepth::<f32>::new(Tensor::zeros(&[0])))
            .sample(&[&[0]]),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::Tape;

    #[test]
    fn log_density_is_capped_and_infinite_delta_finite() {
        let depth = |z: f32, delta: f32| {
            let tape = Tape::new();
            let z = tape.leaf(Tensor::from([z]));
            let x = tape.apply(OpticalDepth::of_log_density(Tensor::from([delta])), &[&z]);
            (x.item(), x.sum().grad(&[&z])[0].item())
        };
        assert_eq!(depth(-200.0, f32::INFINITY), (0.0, 0.0), "no density, however far");
        assert_eq!(depth(0.0, f32::INFINITY), (f32::INFINITY, 0.0));
        assert_eq!(depth(100.0, 0.0), (0.0, 0.0));
        assert_eq!(depth(31.6, 7.3e25), (f32::INFINITY, 0.0), "a product that overflows");
        assert_eq!(depth(100.0, 1.0), (80.0_f32.exp(), 0.0), "beyond the end nothing changes");
        let (x, slope) = depth(f32::NAN, 1.0);
        assert!(x.is_nan() && slope.is_nan(), "a NaN passes through");
        // A second recording is the same function.
        let tape = Tape::new();
        let z = tape.leaf(Tensor::from([100.0_f32, 2.0]));
        let x = tape.apply(OpticalDepth::of_log_density(Tensor::from([0.0, 0.5])), &[&z]);
        let first = x.sum().grad_graph(&[&z]).remove(0);
        assert_eq!(first.value().as_slice(), [0.0, 2.0_f32.exp() * 0.5]);
    }
}
