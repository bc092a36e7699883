//! Optimizers, learning-rate schedules, gradient clipping and parameter averages.

mod adam;
mod clip;
mod ema;
mod limits;
mod memory;
mod report;
mod rule;
mod schedule;
mod settings;
mod sgd;
mod state;

pub use adam::{Adam, AdamConfig, AdamW};
pub use clip::{Clipped, clip_norm, clip_value, global_norm};
pub use ema::Ema;
pub use report::{NonFinite, UpdateReport};
pub use schedule::Schedule;
pub use settings::SettingError;
pub use sgd::{Sgd, SgdConfig};
pub use state::{OptimizerState, StateError};

use crate::Params;
use raygrad_autograd::{Gradient, RowShare};
use raygrad_tensor::{Pool, Scalar, Tensor};
use std::borrow::Cow;

/// One parameter to update, with its gradient and settings.
#[derive(Debug)]
pub struct ParamUpdate<'a, T: Scalar> {
    /// Its position in the store, from 0.
    pub slot: usize,
    /// Its name.
    pub name: &'a str,
    /// Its value.
    pub value: &'a mut Tensor<T>,
    /// Its gradient, of the same shape and not empty.
    pub grad: &'a Gradient<T>,
    /// Its learning rate, including its lr scale.
    pub lr: f64,
    /// Its factor of the optimizer's weight decay.
    pub weight_decay: f64,
    /// Whether to update only the rows whose gradient is not zero ([`Params::set_lazy`]).
    pub lazy: bool,
}

impl<'a, T: Scalar> ParamUpdate<'a, T> {
    /// The gradient as one dense tensor. A sparse one is summed into a tensor from `pool`.
    pub fn dense_grad(&self, pool: &Pool<T>) -> Cow<'a, Tensor<T>> {
        match self.grad.dense() {
            Some(dense) if self.grad.is_dense() => Cow::Borrowed(dense),
            _ => Cow::Owned(self.grad.clone().into_dense(pool)),
        }
    }

    /// The shape of the parameter as a table `[rows, features]`; one row unless it is lazy.
    fn table(&self) -> [usize; 2] {
        match self.value.shape() {
            [rows, row @ ..] if self.lazy => [*rows, row.iter().product()],
            _ => [1, self.value.len()],
        }
    }

    /// The contributions to a gradient that consists of rows, and the rows of the parts that can be summed separately.
    /// `None` if contributions disagree on the parts, or if there are others.
    #[allow(clippy::type_complexity)]
    fn row_parts(&self) -> (Option<Vec<&'a dyn RowShare<T>>>, Option<Vec<usize>>) {
        let [rows, _] = self.table();
        let shares: Option<Vec<_>> = self.grad.sparse().iter().map(|share| share.as_rows()).collect();
        let shares = shares.filter(|_| self.grad.dense().is_none());
        let mut parts = shares.iter().flatten().map(|share| share.parts());
        let first = parts.next().unwrap_or_default();
        let agreed = first.iter().sum::<usize>() == rows && parts.all(|other| other == first);
        (shares, agreed.then_some(first))
    }
}

/// Updates parameters along their negative gradients.
///
/// Every optimizer takes every gradient ([`Gradient`]): dense, rows of a table, or both. The result depends on the
/// gradient's value alone, unless a parameter is lazy ([`Params::set_lazy`]). An optimizer skips frozen parameters, and
/// parameters whose gradient is [zero](Gradient::is_zero). Each parameter can scale the learning rate and the weight
/// decay ([`Params::set_lr_scale`], [`Params::set_weight_decay_scale`]).
///
/// All optimizers here share three rules:
/// - An element whose gradient or new value is infinite or NaN keeps its value and its state, and is counted. Its row
///   or parameter counts the step all the same. This holds for lazy and other parameters.
/// - State below 1e-30 (1e-300 in f64) becomes 0, so that no denormal numbers slow the update down. So does a parameter
///   below it that weight decay shrinks.
/// - The bits are the same for any number of threads.
///
/// [`Bound::backward`](crate::Bound::backward) returns the gradients and releases the parameters, so that they are
/// updated in place. If a tape or a variable still holds a parameter, an update copies it first.
///
/// ```
/// use raygrad_autograd::{Tape, Tensor};
/// use raygrad_nn::{Optimizer, Params, Schedule, Sgd, SgdConfig};
/// let mut params = Params::<f64>::new();
/// let x = params.add("x", Tensor::scalar(5.0));
/// let mut optimizer = Sgd::new(SgdConfig { momentum: 0.9, ..SgdConfig::default() });
/// let schedule = Schedule::Cosine { from: 0.1, to: 0.0, warmup: 0.1 };
/// for step in 0..200 {
///     let tape = Tape::new();
///     let bound = params.bind(&tape);
///     let loss = (&bound[x] - 2.0).square();
///     let grads = bound.backward(&loss);
///     optimizer.update(&mut params, &grads, schedule.at_step(step, 200)).check().unwrap();
/// }
/// assert!((params.get(x).item() - 2.0).abs() < 1e-3);
/// ```
pub trait Optimizer<T: Scalar> {
    /// Updates the parameters of a store at learning rate `rate`. Implementations use [`Params::updates`].
    ///
    /// # Panics
    /// If there is not one gradient of the same shape for each parameter that is not frozen. If the rate is not in 0 to
    /// 1e30. No parameter changes in these cases. Also if a parameter has another size than at its first step, has
    /// become lazy, or is not lazy any more.
    #[track_caller]
    fn update(&mut self, params: &mut Params<T>, grads: &[Gradient<T>], rate: f64) -> UpdateReport;

    /// The state of the optimizer for the parameters of this store, to resume a run.
    fn state(&self, params: &Params<T>) -> OptimizerState<T>;

    /// Replaces the optimizer's state with a saved [`state`](Self::state). The next steps are then those of the saved
    /// run, bit for bit. First make the same parameters [lazy](Params::set_lazy) as in that run.
    ///
    /// # Errors
    /// If the state belongs to another kind of optimizer or to other parameters. If it counts the steps of a lazy
    /// parameter, as [`Adam`]'s does, and the parameter is not lazy here, or the reverse. The optimizer then does not
    /// change.
    fn load_state(&mut self, params: &Params<T>, state: &OptimizerState<T>) -> Result<(), StateError>;
}
