//! Optimisers and what belongs to them: schedules, clipping, averages.

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

/// One parameter that an optimiser is to move.
#[derive(Debug)]
pub struct ParamUpdate<'a, T: Scalar> {
    /// Which parameter of its store it is.
    pub slot: usize,
    /// Its name.
    pub name: &'a str,
    /// Its value.
    pub value: &'a mut Tensor<T>,
    /// Its gradient, of the same shape and not without a share.
    pub grad: &'a Gradient<T>,
    /// Its learning rate.
    pub rate: f64,
    /// A factor of the optimiser's weight decay.
    pub decay: f64,
    /// Whether only the rows whose gradient is not zero are to be visited ([`Params::set_lazy`]).
    pub lazy: bool,
}

impl<'a, T: Scalar> ParamUpdate<'a, T> {
    /// The gradient as one tensor, from `pool` if it is not one already.
    pub fn dense_grad(&self, pool: &Pool<T>) -> Cow<'a, Tensor<T>> {
        match self.grad.dense() {
            Some(dense) if self.grad.is_dense() => Cow::Borrowed(dense),
            _ => Cow::Owned(self.grad.clone().into_dense(pool)),
        }
    }

    /// The parameter as a table `[rows, features]`, of one row unless it is lazy.
    fn table(&self) -> [usize; 2] {
        match self.value.shape() {
            [rows, row @ ..] if self.lazy => [*rows, row.iter().product()],
            _ => [1, self.value.len()],
        }
    }

    /// The shares of a gradient that consists of rows, and the rows of the parts that can be added up by themselves; `None`
    /// where shares disagree on these, or where there are others.
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

/// Moves parameters against their gradients.
///
/// Every optimiser takes every gradient ([`Gradient`]): dense ones, rows of a table, and both. What it does depends on
/// the gradient's value alone, unless a parameter is lazy ([`Params::set_lazy`]). Frozen parameters rest, and so does one
/// whose gradient has no share because nothing depends on it; others move with the learning rate and the weight decay
/// of their own ([`Params::set_lr_scale`], [`Params::set_weight_decay_scale`]).
///
/// All optimizers here share three rules.
/// - An element whose gradient or new value is infinite or NaN keeps its value and its state, and is counted. Its row or
///   parameter counts the step all the same. This holds for lazy and other parameters.
/// - State below 1e-30 (1e-300 in f64) becomes 0, so that no denormal numbers slow the update down.
/// - The bits are the same at any number of threads.
///
/// [`Bound::backward`](crate::Bound::backward) gives the gradients and lets go of the parameters, which can then be
/// moved in place. While a tape or a variable still holds one, an update copies it first.
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
    /// Moves the parameters of a store at learning rate `rate`. An implementation goes through [`Params::updates`].
    ///
    /// # Panics
    /// If there is not one gradient of the same shape for each parameter that is not frozen or the rate is not within 0 to
    /// 1e30; then nothing changes. If a parameter has another size than at its first step, or is lazy and was not, or the
    /// reverse.
    #[track_caller]
    fn update(&mut self, params: &mut Params<T>, grads: &[Gradient<T>], rate: f64) -> UpdateReport;

    /// What the optimiser remembers of the parameters of this store, so that a run can go on later.
    fn state(&self, params: &Params<T>) -> OptimizerState<T>;

    /// Remembers what [`state`](Self::state) gave, in place of everything else: the next steps then are, bit for bit,
    /// what they would have been. Parameters that were [lazy](Params::set_lazy) have to be so before.
    ///
    /// # Errors
    /// If the state is that of another kind of optimiser or of other parameters, or of a lazy parameter that is not lazy,
    /// or the reverse; then nothing changes.
    fn load_state(&mut self, params: &Params<T>, state: &OptimizerState<T>) -> Result<(), StateError>;
}
