//! Exponential moving averages of parameters.

use super::limits::flushed;
use super::settings::{check_decay, or_panic};
use super::{OptimizerState, StateError};
use crate::Params;
use raygrad_tensor::{Scalar, simd};

/// An exponential moving average (EMA) of parameters: `a = decay a + (1 - decay) x` after each step. It is often a
/// better model than the last parameters, which are noisy (Polyak and Juditsky 1992).
///
/// The average has the parameters' type, so a change below half a unit in its last place is lost: it comes to rest within
/// a relative `2^-24 / (1 - decay)` of constant parameters (`2^-53 / (1 - decay)` in f64).
///
/// ```
/// use raygrad_autograd::Tensor;
/// use raygrad_nn::{Ema, Params};
/// let mut params = Params::<f64>::new();
/// let x = params.add("x", Tensor::scalar(0.0));
/// let mut ema = Ema::new(&params, 0.9);
/// params.get_mut(x).as_mut_slice()[0] = 1.0;
/// ema.update(&params);
/// assert!((ema.params().get(x).item() - 0.1).abs() < 1e-15);
/// ```
#[derive(Debug, Clone)]
pub struct Ema<T: Scalar> {
    average: Params<T>,
    decay: f64,
    warmup: bool,
    steps: u64,
}

impl<T: Scalar> Ema<T> {
    /// An average that starts at these parameters.
    ///
    /// # Panics
    /// If `decay` is neither 1 nor in 0 to 1 - 2^-20 (1 - 2^-49 in f64).
    #[track_caller]
    pub fn new(params: &Params<T>, decay: f64) -> Self {
        if decay != 1.0 {
            or_panic(check_decay::<T>("decay", decay));
        }
        Ema { average: params.clone(), decay, warmup: false, steps: 0 }
    }

    /// The same average with a smaller decay at first, so that it soon forgets the random start. In step `t`, from 0,
    /// the decay is at most `(1 + t) / (10 + t)`.
    pub fn with_warmup(self) -> Self {
        Ema { warmup: true, ..self }
    }

    /// Adds the parameters after a step to the average. Returns the number of skipped elements, whose parameter is
    /// infinite or NaN. An average that is infinite or NaN becomes the first parameter that is not. Averages below 1e-30
    /// (1e-300 in f64) become 0.
    ///
    /// # Panics
    /// If names or shapes of the parameters have changed. The average then does not change.
    #[track_caller]
    pub fn update(&mut self, params: &Params<T>) -> usize {
        self.average.check_fits(params);
        let t = self.steps as f64;
        let decay = if self.warmup { self.decay.min((1.0 + t) / (10.0 + t)) } else { self.decay };
        self.steps = self.steps.saturating_add(1);
        let pairs = self.average.values_mut().iter_mut().zip(params.values());
        // Only the smaller share is rounded: two rounded shares do not add up to 1, and that error would grow over steps.
        let blend = if decay > 0.5 { blend::<T, true> } else { blend::<T, false> };
        let share = T::from_f64(decay.min(1.0 - decay));
        pairs.map(|(a, x)| blend(a.as_mut_slice(), x.as_slice(), share)).sum()
    }

    /// The averages, under the names of the parameters.
    pub fn params(&self) -> &Params<T> {
        &self.average
    }

    /// The averages and the number of steps, to resume a run.
    pub fn state(&self) -> OptimizerState<T> {
        let mut state = OptimizerState::default();
        state.put_counts("", "steps", vec![self.steps]);
        for (name, value) in self.average.iter() {
            state.put(name, "average", value.shape(), value.as_slice().to_vec());
        }
        state
    }

    /// Resumes from a [`state`](Self::state).
    ///
    /// # Errors
    /// If the state belongs to other parameters. The average then does not change.
    pub fn load_state(&mut self, state: &OptimizerState<T>) -> Result<(), StateError> {
        let mut state = state.clone();
        let (steps, mut values) = (state.take_steps()?, vec![]);
        for (name, value) in self.average.iter() {
            values.push(state.take(name, "average", value.shape())?);
        }
        state.refuse_rest()?;
        self.steps = steps;
        self.average.replace(values);
        Ok(())
    }

    /// The averages, under the names of the parameters.
    pub fn into_params(self) -> Params<T> {
        self.average
    }
}

/// Elements between two looks for numbers that are not finite.
const BLOCK: usize = 1024;

/// The weighted mean of `a` and `x`, where `share` is the weight of `x` if the average is slow, else of `a`.
#[inline(always)]
fn mean<T: Scalar, const SLOW: bool>(a: T, x: T, share: T) -> T {
    let [near, far] = if SLOW { [a, x] } else { [x, a] };
    flushed(near + (share * far - share * near))
}

/// Replaces `a` by its [mean] with `x`, or by `x` if `a` is not finite. Elements of `x` that are not finite are skipped
/// and counted.
fn blend<T: Scalar, const SLOW: bool>(a: &mut [T], x: &[T], share: T) -> usize {
    simd::dispatch(
        #[inline(always)]
        || {
            let mut skipped = 0;
            for (a, x) in a.chunks_mut(BLOCK).zip(x.chunks(BLOCK)) {
                // Without a choice for each element, the loop is vectorised.
                if a.iter().zip(x).fold(true, |all, (a, x)| all & a.is_finite() & x.is_finite()) {
                    a.iter_mut().zip(x).for_each(|(a, &x)| *a = mean::<T, SLOW>(*a, x, share));
                    continue;
                }
                for (a, &x) in a.iter_mut().zip(x) {
                    match (a.is_finite(), x.is_finite()) {
                        (true, true) => *a = mean::<T, SLOW>(*a, x, share),
                        (false, true) => *a = flushed(x),
                        (_, false) => skipped += 1,
                    }
                }
            }
            skipped
        },
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_tensor::Tensor;

    fn store(values: &[f64]) -> Params<f64> {
        let mut params = Params::new();
        params.add("x", Tensor::from_vec(&[values.len()], values.to_vec()));
        params.add("empty", Tensor::zeros(&[0, 2]));
        params
    }

    #[test]
    fn follows_its_recurrence_with_and_without_warmup() {
        for warmup in [false, true] {
            let mut ema = Ema::new(&store(&[2.0, -1.0]), 0.95);
            if warmup {
                ema = ema.with_warmup();
            }
            // The weights of the values so far, as the definition unrolled gives them.
            let (mut values, mut weights) = (vec![2.0], vec![1.0]);
            for t in 0..100 {
                let decay = if warmup { 0.95_f64.min((1.0 + f64::from(t)) / (10.0 + f64::from(t))) } else { 0.95 };
                let x = (f64::from(t) * 0.3).sin();
                assert_eq!(ema.update(&store(&[x, -1.0])), 0);
                weights.iter_mut().for_each(|w| *w *= decay);
                weights.push(1.0 - decay);
                values.push(x);
                let expected: f64 = values.iter().zip(&weights).map(|(x, w)| x * w).sum();
                let got = ema.params().values()[0].as_slice();
                assert!((got[0] - expected).abs() < 1e-14 && (got[1] + 1.0).abs() < 1e-14, "step {t}");
            }
        }
    }

    #[test]
    fn update_other_parameters_panics_and_changes_nothing() {
        let mut ema = Ema::new(&store(&[1.0]), 0.5);
        let mut others = Params::new();
        others.add("x", Tensor::from_vec(&[1], vec![9.0]));
        others.add("empty", Tensor::zeros(&[1, 2]));
        let update = std::panic::AssertUnwindSafe(|| ema.update(&others));
        assert!(std::panic::catch_unwind(update).is_err());
        assert_eq!((ema.params().values()[0].as_slice(), ema.steps), (&[1.0][..], 0));
    }

    #[test]
    fn ema_skips_non_finite_parameters() {
        let mut ema = Ema::new(&store(&[1.0, 1.0]).cast::<f32>(), 0.5);
        assert_eq!(ema.update(&store(&[f64::NAN, 0.0]).cast()), 1);
        assert_eq!(ema.params().values()[0].as_slice(), [1.0, 0.5]);
        for _ in 0..300 {
            ema.update(&store(&[0.0, 0.0]).cast());
            assert!(ema.params().values()[0].as_slice().iter().all(|a| !a.is_subnormal()));
        }
        assert_eq!(ema.into_params().values()[0].as_slice(), [0.0, 0.0]);
        // An average that was never finite begins with the first finite value.
        let mut late = Ema::new(&store(&[f64::NAN, f64::INFINITY]), 0.5);
        assert_eq!(late.update(&store(&[f64::NAN, 3.0])), 1);
        assert_eq!(late.update(&store(&[2.0, 5.0])), 0);
        assert_eq!(late.params().values()[0].as_slice(), [2.0, 4.0]);
        let mut double = Ema::new(&store(&[1e-40, 1.0]), 0.5);
        double.update(&store(&[3e-40, 1.0]));
        assert_eq!(double.params().values()[0].as_slice(), [2e-40, 1.0], "f64 holds more");
        let mut copy = Ema::new(&store(&[1.0, 1.0]), 0.0);
        copy.update(&store(&[0.1, 0.7]));
        assert_eq!(copy.params().values()[0].as_slice(), [0.1, 0.7]);
    }
}
