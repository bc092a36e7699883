//! Parameters: named tensors outside any tape, so that many tapes share one model.

use crate::ParamUpdate;
use raygrad_autograd::{Gradient, Tape};
use raygrad_tensor::{Scalar, Tensor};
use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

mod bound;

pub use bound::{Bound, ParamLayout};

/// A handle of a parameter of one [`Params`] and its copies. Other stores reject it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct ParamId {
    place: usize,
    /// Unique among all parameters of this program.
    key: u64,
}

/// The named parameters of a model, in the order in which they were added.
///
/// Layers hold [`ParamId`]s and are pure functions of the bound parameters and their input. A parameter can be frozen,
/// and can have its own factors of the learning rate and of the weight decay. Methods select parameters by name.
/// Handles of a store are valid for its clones and casts too, for the parameters that they share.
///
/// ```
/// use raygrad_autograd::{Tape, Tensor};
/// use raygrad_nn::Params;
/// let mut params = Params::<f32>::new();
/// let weight = params.add("weight", Tensor::full(&[2], 3.0));
/// let tape = Tape::new();
/// let bound = params.bind(&tape);
/// let loss = bound[weight].square().sum();
/// assert_eq!(loss.grad(&bound.vars())[0], [6.0, 6.0]);
/// ```
#[derive(Debug, Clone, Default)]
pub struct Params<T: Scalar> {
    /// Shared with bound parameters and copies.
    names: Arc<Names>,
    values: Vec<Tensor<T>>,
    settings: Vec<Setting>,
}

/// The names of the parameters of a store.
#[derive(Debug, Clone, Default)]
struct Names {
    names: Vec<String>,
    places: HashMap<String, usize>,
    /// For each parameter, the key of its handles.
    keys: Vec<u64>,
}

impl Names {
    #[track_caller]
    fn add(&mut self, name: String) -> ParamId {
        static KEYS: AtomicU64 = AtomicU64::new(0);
        // Before anything changes: a caller that catches the panic has the store as it was.
        assert!(!self.places.contains_key(&name), "there is already a parameter `{name}`");
        let (place, key) = (self.names.len(), KEYS.fetch_add(1, Ordering::Relaxed));
        self.places.insert(name.clone(), place);
        self.names.push(name);
        self.keys.push(key);
        ParamId { place, key }
    }

    /// The position of a handle's parameter.
    #[track_caller]
    fn place(&self, ParamId { place, key }: ParamId) -> usize {
        if self.keys.get(place) != Some(&key) {
            match self.names.get(place) {
                Some(name) => panic!("a handle of another store: its parameter {place} is not this store's `{name}`"),
                None => panic!(
                    "a handle of another store: its parameter {place}, of {} here. If it is younger than this binding, bind \
                     the parameters again",
                    self.names.len()
                ),
            }
        }
        place
    }
}

/// The settings of a parameter for optimizers.
#[derive(Debug, Clone, Copy)]
struct Setting {
    frozen: bool,
    rate: f64,
    decay: f64,
    lazy: bool,
}

impl Setting {
    /// Whether an optimizer updates single rows. An empty parameter has none.
    fn moves_rows<T: Scalar>(&self, value: &Tensor<T>) -> bool {
        self.lazy && !value.is_empty()
    }
}

impl<T: Scalar> Params<T> {
    /// An empty store.
    pub fn new() -> Self {
        Params { names: Arc::default(), values: vec![], settings: vec![] }
    }

    /// Adds a parameter and returns its handle.
    ///
    /// # Panics
    /// If there is already a parameter of this name.
    #[track_caller]
    pub fn add(&mut self, name: impl Into<String>, value: Tensor<T>) -> ParamId {
        let id = Arc::make_mut(&mut self.names).add(name.into());
        self.values.push(value);
        self.settings.push(Setting { frozen: false, rate: 1.0, decay: 1.0, lazy: false });
        id
    }

    /// Panics as [`add`](Self::add) does if one of these names is taken, before any is added.
    #[track_caller]
    pub(crate) fn assert_free(&self, layer: &str, names: &[&str]) {
        for name in names.iter().map(|name| format!("{layer}.{name}")) {
            assert!(self.find(&name).is_none(), "there is already a parameter `{name}`");
        }
    }

    /// Number of parameters; each is one tensor.
    pub fn len(&self) -> usize {
        self.values.len()
    }

    /// Whether there are no parameters.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Total number of elements of all parameters.
    pub fn elements(&self) -> usize {
        self.values.iter().map(Tensor::len).sum()
    }

    /// Total number of elements of the parameters that are not frozen.
    pub fn trainable_elements(&self) -> usize {
        let free = self.values.iter().zip(&self.settings).filter(|(_, setting)| !setting.frozen);
        free.map(|(value, _)| value.len()).sum()
    }

    /// The names in order.
    pub fn names(&self) -> impl ExactSizeIterator<Item = &str> {
        self.names.names.iter().map(String::as_str)
    }

    /// The name of a parameter.
    ///
    /// # Panics
    /// If the handle belongs to another store.
    #[track_caller]
    pub fn name(&self, id: ParamId) -> &str {
        &self.names.names[self.names.place(id)]
    }

    /// The handles of the parameters that are not frozen, in order. These have gradients.
    pub fn trainable(&self) -> impl Iterator<Item = ParamId> + '_ {
        self.ids().zip(&self.settings).filter(|(_, setting)| !setting.frozen).map(|(id, _)| id)
    }

    /// The gradient of a parameter, or None if it is frozen. `grads` has one entry for each parameter that is not
    /// frozen, in the order of [`trainable`](Self::trainable): [`Bound::backward`], [`TileSums::grads`], or the tensors
    /// and variables that [`Var::grad`] and [`Var::grad_graph`] return for [`Bound::vars`].
    ///
    /// ```
    /// use raygrad_autograd::{Activation, Tape, Tensor};
    /// use raygrad_nn::{Init, Linear, Params};
    /// use rand::SeedableRng;
    /// let mut rng = rand::rngs::StdRng::seed_from_u64(1);
    /// let mut params = Params::<f32>::new();
    /// let layer = Linear::new(&mut params, "layer", [2, 3], Activation::Identity, Init::Glorot, &mut rng);
    /// params.freeze(|name| name == "layer.weight");
    /// let tape = Tape::new();
    /// let bound = params.bind(&tape);
    /// let loss = layer.forward(&bound, &tape.constant(Tensor::ones(&[5, 2]))).sum();
    /// let grads = bound.backward(&loss);
    /// let bias = params.grad(&grads, layer.bias().unwrap()).unwrap();
    /// assert_eq!(bias.dense().unwrap(), &Tensor::full(&[3], 5.0));
    /// assert!(params.grad(&grads, layer.weight()).is_none());
    /// ```
    ///
    /// # Panics
    /// If the handle belongs to another store, or there is not one gradient for each parameter that is not frozen.
    ///
    /// [`TileSums::grads`]: crate::TileSums::grads
    /// [`Var::grad`]: raygrad_autograd::Var::grad
    /// [`Var::grad_graph`]: raygrad_autograd::Var::grad_graph
    #[track_caller]
    pub fn grad<'a, G>(&self, grads: &'a [G], id: ParamId) -> Option<&'a G> {
        let place = self.names.place(id);
        self.check_count(grads.len());
        let before = self.settings[..place].iter().filter(|setting| !setting.frozen).count();
        if self.settings[place].frozen { None } else { grads.get(before) }
    }

    /// Panics if there is not one gradient for each parameter that is not frozen.
    #[track_caller]
    fn check_count(&self, grads: usize) {
        let free = self.settings.iter().filter(|setting| !setting.frozen).count();
        assert_eq!(grads, free, "one gradient for each parameter that is not frozen");
    }

    /// The handles in order.
    pub fn ids(&self) -> impl ExactSizeIterator<Item = ParamId> + '_ {
        self.names.keys.iter().enumerate().map(|(place, &key)| ParamId { place, key })
    }

    /// The handle of the parameter of this name, if there is one.
    pub fn find(&self, name: &str) -> Option<ParamId> {
        self.names.places.get(name).map(|&place| ParamId { place, key: self.names.keys[place] })
    }

    /// Changes the settings of the parameters that `which` selects, and returns their number.
    fn set(&mut self, which: impl Fn(&str) -> bool, change: impl Fn(&mut Setting)) -> usize {
        let mut count = 0;
        for (_, setting) in self.names.names.iter().zip(&mut self.settings).filter(|(name, _)| which(name)) {
            change(setting);
            count += 1;
        }
        count
    }

    /// Freezes the parameters whose name `which` selects, and returns their number. A frozen parameter is a constant on
    /// a tape, so it has no gradient, and optimizers skip it.
    ///
    /// ```
    /// use raygrad_autograd::Tensor;
    /// use raygrad_nn::Params;
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

    /// Unfreezes the parameters whose name `which` selects, and returns their number.
    pub fn unfreeze(&mut self, which: impl Fn(&str) -> bool) -> usize {
        self.set(which, |setting| setting.frozen = false)
    }

    /// Whether a parameter is frozen.
    ///
    /// # Panics
    /// If the handle belongs to another store.
    #[track_caller]
    pub fn is_frozen(&self, id: ParamId) -> bool {
        self.settings[self.names.place(id)].frozen
    }

    /// Sets the lr scale of the parameters whose name `which` selects, and returns their number. The lr scale is a
    /// factor of the learning rate, 1 by default.
    ///
    /// # Panics
    /// If the factor is negative, infinite or NaN.
    #[track_caller]
    pub fn set_lr_scale(&mut self, which: impl Fn(&str) -> bool, factor: f64) -> usize {
        assert!(
            factor >= 0.0 && factor.is_finite(),
            "a learning rate times {factor}: use a finite factor of at least 0"
        );
        self.set(which, |setting| setting.rate = factor)
    }

    /// Sets the factor of the weight decay of the parameters whose name `which` selects, and returns their number. The
    /// default is 1; biases and gains usually have 0.
    ///
    /// # Panics
    /// If the factor is negative, infinite or NaN.
    #[track_caller]
    pub fn set_weight_decay_scale(&mut self, which: impl Fn(&str) -> bool, factor: f64) -> usize {
        assert!(
            factor >= 0.0 && factor.is_finite(),
            "a weight decay times {factor}: use a finite factor of at least 0"
        );
        self.set(which, |setting| setting.decay = factor)
    }

    /// Sets whether the parameters whose name `which` selects are lazy, and returns their number. By default no
    /// parameter is lazy.
    ///
    /// A lazy parameter is a table, such as an embedding, of which a step uses few rows along the first axis.
    /// Optimizers then read and update only the rows whose gradient is not zero. The state of other rows does not
    /// change either.
    ///
    /// Results differ from those of a dense update. A row with one late gradient changes once, where momentum would
    /// change it over the following steps too ([`Adam`](crate::Adam)). Set this before the first step.
    pub fn set_lazy(&mut self, which: impl Fn(&str) -> bool, lazy: bool) -> usize {
        self.set(which, |setting| setting.lazy = lazy)
    }

    /// Whether a parameter is lazy; see [`set_lazy`](Self::set_lazy).
    ///
    /// # Panics
    /// If the handle belongs to another store.
    #[track_caller]
    pub fn is_lazy(&self, id: ParamId) -> bool {
        self.settings[self.names.place(id)].lazy
    }

    /// Whether optimizers update single rows of a parameter: it is lazy, and not empty.
    pub(crate) fn moves_rows(&self, id: ParamId) -> bool {
        let place = self.names.place(id);
        self.settings[place].moves_rows(&self.values[place])
    }

    /// The lr scale of a parameter: the factor of its learning rate.
    ///
    /// # Panics
    /// If the handle belongs to another store.
    #[track_caller]
    pub fn lr_scale(&self, id: ParamId) -> f64 {
        self.settings[self.names.place(id)].rate
    }

    /// The factor of a parameter's weight decay.
    ///
    /// # Panics
    /// If the handle belongs to another store.
    #[track_caller]
    pub fn weight_decay_scale(&self, id: ParamId) -> f64 {
        self.settings[self.names.place(id)].decay
    }

    /// The updates for these gradients: one [`ParamUpdate`] for each parameter that is not frozen and whose gradient is
    /// not [zero](Gradient::is_zero). For implementations of [`Optimizer`](crate::Optimizer). `rate` maps the position
    /// of a parameter in the store to its learning rate, before its lr scale.
    ///
    /// # Panics
    /// If there is not one gradient of the same shape for each parameter that is not frozen. If a rate is not in 0 to
    /// 1e30.
    #[track_caller]
    pub fn updates<'a>(
        &'a mut self,
        grads: &'a [Gradient<T>],
        rate: impl Fn(usize) -> f64,
    ) -> impl Iterator<Item = ParamUpdate<'a, T>> {
        self.check_count(grads.len());
        // Before anything is moved.
        for (id, grad) in self.trainable().zip(grads) {
            let rate = rate(id.place);
            assert!((0.0..=1e30).contains(&rate), "a learning rate of {rate:?}; use 0 to 1e30");
            assert_eq!(self.get(id).shape(), grad.shape(), "the gradient of `{}` has its shape", self.name(id));
        }
        let (names, values) = (&self.names.names, self.values.iter_mut());
        let parts = names.iter().zip(values).zip(&self.settings).enumerate();
        let free = parts.filter(|(_, (_, setting))| !setting.frozen);
        let moves = free.zip(grads).map(move |((slot, ((name, value), setting)), grad)| {
            let lazy = setting.moves_rows(value);
            ParamUpdate { slot, name, value, grad, lr: rate(slot) * setting.rate, weight_decay: setting.decay, lazy }
        });
        moves.filter(|part| !part.grad.is_zero())
    }

    /// Names and values in order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = (&str, &Tensor<T>)> {
        self.names().zip(&self.values)
    }

    /// The values in order.
    pub fn values(&self) -> &[Tensor<T>] {
        &self.values
    }

    /// The values in order, for an optimizer to change.
    pub fn values_mut(&mut self) -> &mut [Tensor<T>] {
        &mut self.values
    }

    /// The value of a parameter.
    ///
    /// # Panics
    /// If the handle belongs to another store.
    #[track_caller]
    pub fn get(&self, id: ParamId) -> &Tensor<T> {
        &self.values[self.names.place(id)]
    }

    /// The value of a parameter, for an optimizer to change.
    ///
    /// # Panics
    /// If the handle belongs to another store.
    #[track_caller]
    pub fn get_mut(&mut self, id: ParamId) -> &mut Tensor<T> {
        &mut self.values[self.names.place(id)]
    }

    /// Puts the parameters on a tape as leaves. Frozen ones become constants, which have no gradient.
    #[track_caller]
    pub fn bind<'t>(&self, tape: &'t Tape<T>) -> Bound<'t, T> {
        let mut vars = Vec::with_capacity(self.len());
        for (value, setting) in self.values.iter().zip(&self.settings) {
            vars.push(if setting.frozen { tape.constant(value.clone()) } else { tape.leaf(value.clone()) });
        }
        Bound { names: self.names.clone(), vars, tape: Some(tape) }
    }

    /// Puts the parameters on a tape as constants, for evaluation.
    pub fn bind_constant<'t>(&self, tape: &'t Tape<T>) -> Bound<'t, T> {
        let vars = self.values.iter().map(|value| tape.constant(value.clone())).collect();
        Bound { names: self.names.clone(), vars, tape: Some(tape) }
    }

    /// The names and handles of this store, without its values.
    pub fn layout(&self) -> ParamLayout {
        ParamLayout(self.names.clone())
    }

    /// Copies values and settings from a store of the same names and shapes, which may have another precision. So the
    /// handles of a new model become valid for the parameters of an old one.
    ///
    /// ```
    /// use raygrad_autograd::Tensor;
    /// use raygrad_nn::Params;
    /// let (mut old, mut new) = (Params::<f64>::new(), Params::<f32>::new());
    /// old.add("x", Tensor::scalar(0.5));
    /// let x = new.add("x", Tensor::scalar(9.0));
    /// new.assign(&old);
    /// assert_eq!(new.get(x).item(), 0.5);
    /// ```
    ///
    /// # Panics
    /// If names, their order or shapes differ.
    #[track_caller]
    pub fn assign<U: Scalar>(&mut self, other: &Params<U>) {
        self.check_fits(other);
        self.values = other.values.iter().map(Tensor::cast).collect();
        self.settings.clone_from(&other.settings);
    }

    /// Copies the settings from a store with the same names: frozen parameters, lr scales, factors of the weight decay,
    /// laziness. It copies the values of frozen parameters too; all others keep their values.
    ///
    /// # Panics
    /// If names or shapes differ.
    #[track_caller]
    pub fn inherit(&mut self, other: &Params<T>) {
        self.check_fits(other);
        for ((value, theirs), setting) in self.values.iter_mut().zip(&other.values).zip(&other.settings) {
            if setting.frozen {
                value.clone_from(theirs);
            }
        }
        self.settings.clone_from(&other.settings);
    }

    /// Checks that another store has parameters of the same names and shapes.
    #[track_caller]
    pub(crate) fn check_fits<U: Scalar>(&self, other: &Params<U>) {
        let [own, others] = [&self.names.names, &other.names.names];
        if let Some(i) = (0..own.len().max(others.len())).find(|&i| own.get(i) != others.get(i)) {
            let shown = |names: &[String]| names.get(i).map_or("none".to_owned(), |name| format!("`{name}`"));
            panic!(
                "two stores with other parameters: parameter {i} is {} in one and {} in the other. Make copies such as an \
                 average after the last parameter",
                shown(own),
                shown(others)
            );
        }
        for ((name, value), theirs) in self.iter().zip(&other.values) {
            assert_eq!(value.shape(), theirs.shape(), "two parameters `{name}`");
        }
    }

    /// The same parameters in another precision.
    pub fn cast<U: Scalar>(&self) -> Params<U> {
        Params {
            names: self.names.clone(),
            values: self.values.iter().map(Tensor::cast).collect(),
            settings: self.settings.clone(),
        }
    }

    /// Replaces the values with others of the same shapes.
    pub(crate) fn replace(&mut self, values: Vec<Tensor<T>>) {
        self.values = values;
    }
}

#[cfg(test)]
mod tests;
