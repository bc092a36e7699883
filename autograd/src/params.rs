//! Parameters: named tensors outside any tape, so that many tapes share one model.

use crate::{Move, Tape, Var};
use raygrad_tensor::{Scalar, Tensor};
use std::ops::Index;

/// A handle on a parameter of one [`Params`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ParamId(usize);

/// A named store of parameters, in the order in which they were added.
///
/// Layers hold [`ParamId`]s and are pure functions of the bound parameters and their input. A parameter can be frozen,
/// and can have factors of the learning rate and of the weight decay of its own; parameters are chosen by their names.
///
/// ```
/// use raygrad_autograd::{Params, Tape, Tensor};
/// let mut params = Params::<f32>::new();
/// let weight = params.add("weight", Tensor::full(&[2], 3.0));
/// let tape = Tape::new();
/// let bound = params.bind(&tape);
/// let loss = bound[weight].square().sum();
/// assert_eq!(loss.grad(&bound.vars())[0].as_slice(), [6.0, 6.0]);
/// ```
#[derive(Debug, Clone, Default)]
pub struct Params<T: Scalar> {
    names: Vec<String>,
    values: Vec<Tensor<T>>,
    settings: Vec<Setting>,
}

/// How an optimiser treats a parameter.
#[derive(Debug, Clone, Copy)]
struct Setting {
    frozen: bool,
    rate: f64,
    decay: f64,
}

impl<T: Scalar> Params<T> {
    /// An empty store.
    pub fn new() -> Self {
        Params { names: vec![], values: vec![], settings: vec![] }
    }

    /// Adds a parameter.
    ///
    /// # Panics
    /// If the name is taken.
    #[track_caller]
    pub fn add(&mut self, name: impl Into<String>, value: Tensor<T>) -> ParamId {
        let name = name.into();
        assert!(!self.names.contains(&name), "there is already a parameter `{name}`");
        self.names.push(name);
        self.values.push(value);
        self.settings.push(Setting { frozen: false, rate: 1.0, decay: 1.0 });
        ParamId(self.values.len() - 1)
    }

    /// Number of parameters (tensors).
    pub fn len(&self) -> usize {
        self.values.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Number of elements of all parameters together.
    pub fn elements(&self) -> usize {
        self.values.iter().map(Tensor::len).sum()
    }

    /// Number of elements of the parameters that are not frozen.
    pub fn trainable_elements(&self) -> usize {
        let free = self.values.iter().zip(&self.settings).filter(|(_, setting)| !setting.frozen);
        free.map(|(value, _)| value.len()).sum()
    }

    /// The names in order.
    pub fn names(&self) -> impl ExactSizeIterator<Item = &str> {
        self.names.iter().map(String::as_str)
    }

    /// The name of a parameter.
    pub fn name(&self, id: ParamId) -> &str {
        &self.names[id.0]
    }

    /// The handles in order.
    pub fn ids(&self) -> impl ExactSizeIterator<Item = ParamId> + use<T> {
        (0..self.len()).map(ParamId)
    }

    /// The parameter of this name.
    pub fn find(&self, name: &str) -> Option<ParamId> {
        self.names.iter().position(|other| other == name).map(ParamId)
    }

    /// Changes the settings of the parameters that `which` chooses, and returns how many these are.
    fn set(&mut self, which: impl Fn(&str) -> bool, change: impl Fn(&mut Setting)) -> usize {
        let mut count = 0;
        for (_, setting) in self.names.iter().zip(&mut self.settings).filter(|(name, _)| which(name)) {
            change(setting);
            count += 1;
        }
        count
    }

    /// Freezes the parameters whose name `which` chooses, and returns how many these are. A frozen parameter is a
    /// constant on a tape, so that nothing is computed for its gradient, and optimisers leave it alone.
    ///
    /// ```
    /// use raygrad_autograd::{Params, Tensor};
    /// let mut params = Params::<f32>::new();
    /// let trunk = params.add("trunk.weight", Tensor::zeros(&[3, 2]));
    /// params.add("head.weight", Tensor::zeros(&[2, 1]));
    /// assert_eq!(params.freeze(|name| name.starts_with("trunk.")), 1);
    /// assert!(params.is_frozen(trunk));
    /// assert_eq!((params.elements(), params.trainable_elements()), (8, 2));
    /// ```
    pub fn freeze(&mut self, which: impl Fn(&str) -> bool) -> usize {
        self.set(which, |setting| setting.frozen = true)
    }

    /// The opposite of [`freeze`](Self::freeze).
    pub fn unfreeze(&mut self, which: impl Fn(&str) -> bool) -> usize {
        self.set(which, |setting| setting.frozen = false)
    }

    /// Whether a parameter is frozen.
    pub fn is_frozen(&self, id: ParamId) -> bool {
        self.settings[id.0].frozen
    }

    /// Gives the parameters whose name `which` chooses a factor of the learning rate, instead of 1, and returns how many
    /// these are.
    pub fn set_rate(&mut self, which: impl Fn(&str) -> bool, factor: f64) -> usize {
        self.set(which, |setting| setting.rate = factor)
    }

    /// Gives the parameters whose name `which` chooses a factor of the weight decay, instead of 1, and returns how many
    /// these are. Biases and gains usually have 0.
    pub fn set_decay(&mut self, which: impl Fn(&str) -> bool, factor: f64) -> usize {
        self.set(which, |setting| setting.decay = factor)
    }

    /// What an optimiser is to do with these gradients at learning rate `rate`: one [`Move`] for each parameter that is
    /// not frozen.
    ///
    /// # Panics
    /// If there is not one gradient for each parameter that is not frozen.
    #[track_caller]
    pub fn moves<'a>(&'a mut self, grads: &'a [Tensor<T>], rate: f64) -> impl Iterator<Item = Move<'a, T>> {
        let free = self.settings.iter().filter(|setting| !setting.frozen).count();
        assert_eq!(free, grads.len(), "as many gradients as parameters that are not frozen");
        let parts = self.values.iter_mut().zip(&self.settings).enumerate().filter(|(_, (_, setting))| !setting.frozen);
        parts.zip(grads).map(move |((slot, (value, setting)), grad)| Move {
            slot,
            value,
            grad,
            rate: rate * setting.rate,
            decay: setting.decay,
        })
    }

    /// Names and values in order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = (&str, &Tensor<T>)> {
        self.names.iter().map(String::as_str).zip(&self.values)
    }

    /// The values in order.
    pub fn values(&self) -> &[Tensor<T>] {
        &self.values
    }

    /// The values in order, for an optimiser.
    pub fn values_mut(&mut self) -> &mut [Tensor<T>] {
        &mut self.values
    }

    /// One value.
    pub fn get(&self, id: ParamId) -> &Tensor<T> {
        &self.values[id.0]
    }

    /// One value, for an optimiser.
    pub fn get_mut(&mut self, id: ParamId) -> &mut Tensor<T> {
        &mut self.values[id.0]
    }

    /// The parameters as leaves of a tape; frozen ones as constants, which have no gradients.
    #[track_caller]
    pub fn bind<'t>(&self, tape: &'t Tape<T>) -> Bound<'t, T> {
        let mut vars = Vec::with_capacity(self.len());
        for (value, setting) in self.values.iter().zip(&self.settings) {
            vars.push(if setting.frozen { tape.constant(value.clone()) } else { tape.leaf(value.clone()) });
        }
        Bound(vars)
    }

    /// The parameters as constants of a tape, for evaluation.
    pub fn bind_constant<'t>(&self, tape: &'t Tape<T>) -> Bound<'t, T> {
        Bound(self.values.iter().map(|value| tape.constant(value.clone())).collect())
    }

    /// The same parameters in another precision.
    pub fn cast<U: Scalar>(&self) -> Params<U> {
        Params {
            names: self.names.clone(),
            values: self.values.iter().map(Tensor::cast).collect(),
            settings: self.settings.clone(),
        }
    }

    /// Other values of the same shapes.
    pub(crate) fn replace(&mut self, values: Vec<Tensor<T>>) {
        self.values = values;
    }
}

/// Parameters on a tape; index it with a [`ParamId`].
#[derive(Debug)]
pub struct Bound<'t, T: Scalar>(Vec<Var<'t, T>>);

impl<'t, T: Scalar> Bound<'t, T> {
    /// Variables in place of parameters, in the order of the store: what a check of a whole model differentiates.
    pub fn from_vars(vars: Vec<Var<'t, T>>) -> Self {
        Bound(vars)
    }

    /// The tape that the parameters are bound to.
    ///
    /// # Panics
    /// If there is none.
    #[track_caller]
    pub fn tape(&self) -> &'t Tape<T> {
        assert!(!self.0.is_empty(), "the tape of no parameters");
        self.0[0].tape()
    }

    /// The parameters to take gradients with respect to, in the order of the store: all but the frozen ones, which are
    /// constants.
    pub fn vars(&self) -> Vec<&Var<'t, T>> {
        self.0.iter().filter(|x| x.is_on_graph()).collect()
    }
}

impl<'t, T: Scalar> Index<ParamId> for Bound<'t, T> {
    type Output = Var<'t, T>;
    fn index(&self, id: ParamId) -> &Var<'t, T> {
        &self.0[id.0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Optimizer, Sgd, SgdConfig, Storage};
    use std::collections::HashMap;

    #[test]
    fn frozen_parameters_rest_and_others_have_their_own_rates() {
        let mut params = Params::<f64>::new();
        for name in ["trunk.weight", "trunk.bias", "head.weight"] {
            params.add(name, Tensor::ones(&[2]));
        }
        assert_eq!(params.set_rate(|name| name.starts_with("trunk."), 0.5), 2);
        assert_eq!(params.set_decay(|name| name.ends_with("bias"), 0.0), 1);
        assert_eq!(params.freeze(|name| name == "head.weight"), 1);
        let head = params.find("head.weight").unwrap();
        assert!(params.is_frozen(head) && params.name(head) == "head.weight" && params.find("body").is_none());
        assert_eq!((params.elements(), params.trainable_elements(), params.ids().count()), (6, 4, 3));
        assert_eq!(params.names().collect::<Vec<_>>(), ["trunk.weight", "trunk.bias", "head.weight"]);

        let mut sgd = Sgd::new(SgdConfig { decay: 1.0, ..SgdConfig::default() });
        let step = |params: &mut Params<f64>, sgd: &mut Sgd<f64>| {
            let tape = Tape::new();
            let bound = params.bind(&tape);
            let all: Vec<_> = params.ids().map(|id| &bound[id]).collect();
            let grads = (all[0] + all[1] + all[2]).sum().grad(&bound.vars());
            let constant = all.iter().map(|x| !x.is_on_graph()).collect::<Vec<_>>();
            sgd.update(params, &grads, 0.1);
            (constant, grads.len(), params.values().iter().map(|x| x.as_slice()[0]).collect::<Vec<_>>())
        };
        // Half the rate; decay adds the parameter, 1, to the gradient, 1, but for the bias.
        let (constant, grad, values) = step(&mut params, &mut sgd);
        assert_eq!((constant, grad), (vec![false, false, true], 2));
        assert_eq!(values, [0.9, 0.95, 1.0]);
        // Settings survive a change of precision and a load.
        let mut copy = params.cast::<f32>().cast::<f64>();
        let bytes = params.to_safetensors(Storage::Full, HashMap::new(), &[]).unwrap();
        copy.load_safetensors(&bytes).unwrap();
        assert!(copy.is_frozen(head) && copy.trainable_elements() == 4);
        copy.unfreeze(|_| true);
        let (constant, grad, values) = step(&mut copy, &mut sgd);
        assert_eq!((constant, grad), (vec![false; 3], 3));
        assert_eq!(values[2], 1.0 - 0.1 * 2.0);
    }
}
