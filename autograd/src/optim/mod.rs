//! Optimisers and what belongs to them: schedules, clipping, averages.

mod adam;
mod clip;
mod ema;
pub(crate) mod limits;
mod schedule;
pub(crate) mod settings;
mod sgd;
mod table;

pub use adam::{Adam, AdamConfig, AdamW};
pub use clip::{Clipped, clip_norm, clip_value, global_norm};
pub use ema::Ema;
pub use schedule::Schedule;
pub use settings::SettingError;
pub use sgd::{Sgd, SgdConfig};
pub use table::TableAdam;

use crate::Params;
use raygrad_tensor::{Scalar, Tensor};

/// One parameter that an optimiser is to move.
#[derive(Debug)]
pub struct Move<'a, T: Scalar> {
    /// Which parameter it is: what the optimiser remembers of it is kept under this number.
    pub slot: usize,
    /// Its value.
    pub value: &'a mut Tensor<T>,
    /// Its gradient.
    pub grad: &'a Tensor<T>,
    /// Its learning rate.
    pub rate: f64,
    /// A factor of the optimiser's weight decay.
    pub decay: f64,
}

/// Moves parameters against their gradients.
///
/// All optimisers here leave an element alone, and count it, if its gradient is infinite or NaN; set what they remember
/// to 0 once it is below 1e-30 (1e-300 in f64), so that no denormal numbers slow them down; and give the same bits at any number of
/// threads.
///
/// ```
/// use raygrad_autograd::{Optimizer, Params, Schedule, Sgd, SgdConfig, Tape, Tensor};
/// let mut params = Params::<f64>::new();
/// let x = params.add("x", Tensor::scalar(5.0));
/// let mut optimizer = Sgd::new(SgdConfig { momentum: 0.9, ..SgdConfig::default() });
/// let schedule = Schedule::Cosine { from: 0.1, to: 0.0, warmup: 0.1 };
/// for step in 0..200 {
///     let tape = Tape::new();
///     let bound = params.bind(&tape);
///     let loss = (&bound[x] - 2.0).square();
///     let grads = loss.grad_once(&bound.vars());
///     optimizer.update(&mut params, &grads, schedule.at_step(step, 200));
/// }
/// assert!((params.get(x).item() - 2.0).abs() < 1e-3);
/// ```
pub trait Optimizer<T: Scalar> {
    /// Moves these parameters, each of them once, and returns how many elements were left alone because their gradient
    /// was infinite or NaN.
    ///
    /// # Panics
    /// If a gradient has another shape than its parameter, or a parameter another size than the last one of its slot.
    #[track_caller]
    fn advance<'a>(&mut self, moves: &mut dyn Iterator<Item = Move<'a, T>>) -> usize
    where
        T: 'a;

    /// Moves all parameters of a store that are not frozen, with the learning rate and the weight decay of each
    /// ([`Params::set_rate`], [`Params::set_decay`]), and returns how many elements were left alone.
    ///
    /// # Panics
    /// If there is not one gradient of the same shape for each parameter, frozen or not.
    #[track_caller]
    fn update(&mut self, params: &mut Params<T>, grads: &[Tensor<T>], rate: f64) -> usize {
        self.advance(&mut params.moves(grads, rate))
    }
}

/// Elements that one task updates.
const CHUNK: usize = 1 << 14;

/// What an optimiser keeps under a number.
fn slot<S: Default>(states: &mut Vec<S>, slot: usize) -> &mut S {
    if states.len() <= slot {
        states.resize_with(slot + 1, S::default);
    }
    &mut states[slot]
}

#[track_caller]
fn check_shapes<T: Scalar>(part: &Move<'_, T>) {
    assert_eq!(part.value.shape(), part.grad.shape(), "a gradient has the shape of its parameter");
}

/// The memory of a parameter, made at its first step.
#[track_caller]
fn remember<T: Scalar>(memory: &mut Vec<T>, len: usize, first: bool) -> &mut [T] {
    if first {
        *memory = vec![T::ZERO; len];
    }
    assert_eq!(memory.len(), len, "the same parameters as in the first step");
    memory
}
