//! A sequence of layers.

use super::{Layer, Mode};
use crate::Bound;
use raygrad_autograd::Var;
use raygrad_tensor::Scalar;
use std::fmt;
use std::sync::Arc;

/// A sequence of layers and functions (`torch.nn.Sequential`). Clones share the layers.
///
/// ```
/// use raygrad_autograd::{Activation, Tape, Tensor};
/// use raygrad_nn::{Dropout, Init, Linear, Params, Mode, Sequential};
/// use rand::SeedableRng;
/// let mut rng = rand::rngs::StdRng::seed_from_u64(1);
/// let mut params = Params::<f32>::new();
/// let mut dense = |params: &mut _, name: &str, sizes| {
///     Linear::new(params, name, sizes, Activation::Identity, Init::Glorot, &mut rng)
/// };
/// let model = Sequential::new()
///     .then(dense(&mut params, "hidden", [2, 16]))
///     .map(|x| x.tanh())
///     .then(Dropout::new(0.1))
///     .then(dense(&mut params, "out", [16, 3]));
/// let tape = Tape::new();
/// let x = tape.constant(Tensor::ones(&[5, 2]));
/// assert_eq!(model.forward(&params.bind(&tape), &x, Mode::Evaluate).shape(), [5, 3]);
/// ```
pub struct Sequential<T: Scalar> {
    layers: Vec<Arc<dyn Layer<T>>>,
}

/// A function without parameters as a layer.
struct Function<F>(F);

impl<T, F> Layer<T> for Function<F>
where
    T: Scalar,
    F: for<'t> Fn(&Var<'t, T>) -> Var<'t, T> + Send + Sync,
{
    #[track_caller]
    fn apply<'t>(&self, _params: &Bound<'t, T>, x: &Var<'t, T>, _mode: Mode) -> Var<'t, T> {
        (self.0)(x)
    }
}

impl<T: Scalar> Sequential<T> {
    /// An empty sequence: the identity.
    pub fn new() -> Self {
        Sequential { layers: vec![] }
    }

    /// Appends a layer.
    pub fn then(mut self, layer: impl Layer<T> + 'static) -> Self {
        self.layers.push(Arc::new(layer));
        self
    }

    /// Appends a function without parameters.
    pub fn map(self, f: impl for<'t> Fn(&Var<'t, T>) -> Var<'t, T> + Send + Sync + 'static) -> Self {
        self.then(Function(f))
    }

    /// Number of layers and functions.
    pub fn len(&self) -> usize {
        self.layers.len()
    }

    /// Whether there are no layers.
    pub fn is_empty(&self) -> bool {
        self.layers.is_empty()
    }

    /// Computes the output of the last layer. Each layer has a separate random stream.
    ///
    /// # Panics
    /// If a shape does not fit.
    #[track_caller]
    pub fn forward<'t>(&self, params: &Bound<'t, T>, x: &Var<'t, T>, mode: Mode) -> Var<'t, T> {
        let mut h = x.clone();
        for (i, layer) in self.layers.iter().enumerate() {
            h = layer.apply(params, &h, mode.part(i as u64));
        }
        h
    }
}

impl<T: Scalar> Layer<T> for Sequential<T> {
    #[track_caller]
    fn apply<'t>(&self, params: &Bound<'t, T>, x: &Var<'t, T>, mode: Mode) -> Var<'t, T> {
        self.forward(params, x, mode)
    }
}

impl<T: Scalar> Default for Sequential<T> {
    fn default() -> Self {
        Sequential::new()
    }
}

impl<T: Scalar> Clone for Sequential<T> {
    fn clone(&self) -> Self {
        Sequential { layers: self.layers.clone() }
    }
}

impl<T: Scalar> fmt::Debug for Sequential<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Sequential({} layers)", self.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Dropout, Init, Linear, Mlp, Params};
    use rand::SeedableRng;
    use raygrad_autograd::check::{Check, check_function};
    use raygrad_autograd::{Activation, Tape, Tensor};

    fn model(params: &mut Params<f64>) -> Sequential<f64> {
        let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(2);
        let inner = Sequential::new().then(Dropout::new(0.5)).then(Dropout::new(0.5));
        Sequential::new()
            .then(Mlp::new(params, "trunk", [2, 8, 2], &[], &mut rng))
            .then(inner)
            .map(|x| x.tanh() * 2.0)
            .then(Linear::new(params, "head", [8, 1], Activation::Identity, Init::Glorot, &mut rng))
    }

    #[test]
    fn is_the_layers_one_after_another() {
        let mut params = Params::new();
        let model = model(&mut params);
        assert_eq!(model.len(), 4);
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let x = tape.constant(Tensor::from_fn(&[6, 2], |i| (i as f64).sin()));
        let mut h = x.clone();
        for layer in [0, 1] {
            let [w, b] = [0, 1].map(|k| bound.vars()[2 * layer + k]);
            h = (h.matmul(w) + b).relu();
        }
        let expected = (h.tanh() * 2.0).matmul(bound.vars()[4]) + bound.vars()[5];
        let got = model.forward(&bound, &x, Mode::Evaluate);
        for (got, expected) in got.value().as_slice().iter().zip(expected.value().as_slice()) {
            assert!((got - expected).abs() < 1e-14);
        }
        assert_eq!(Sequential::new().forward(&bound, &x, Mode::Evaluate).value(), x.value());
    }

    #[test]
    fn every_layer_has_a_stream_of_its_own() {
        let tape = Tape::<f64>::new();
        let bound = Params::new().bind(&tape);
        let x = tape.constant(Tensor::ones(&[4000]));
        // If both layers dropped the same elements, half would be left instead of a quarter.
        let two = Sequential::new().then(Dropout::new(0.5)).then(Dropout::new(0.5));
        let left = |model: &Sequential<f64>, mode| {
            let y = model.forward(&bound, &x, mode);
            y.value().as_slice().iter().map(|&y| y != 0.0).collect::<Vec<_>>()
        };
        let count = |left: &[bool]| left.iter().filter(|&&left| left).count();
        let first = left(&two, Mode::Train(1));
        assert!((900..1100).contains(&count(&first)), "{}", count(&first));
        // Nor do the inner layers of two parts.
        let nested = Sequential::new().then(two.clone()).then(two.clone());
        let left_of_four = count(&left(&nested, Mode::Train(1)));
        assert!((190..310).contains(&left_of_four), "{left_of_four}");
        assert_eq!(first, left(&two.clone(), Mode::Train(1)));
        assert_ne!(first, left(&two, Mode::Train(2)));
    }

    #[test]
    fn checkpointed_dropout_network_gives_same_bits() {
        let mut params = Params::new();
        let model = model(&mut params);
        let run = |checked: bool| {
            let tape = Tape::new();
            let bound = params.bind(&tape);
            let x = tape.leaf(Tensor::from_fn(&[6, 2], |i| (i as f64 * 0.7).sin()));
            let mut inputs = vec![&x];
            inputs.extend(bound.vars());
            let (whole, layout) = (model.clone(), params.layout());
            let y = match checked {
                true => tape
                    .checkpoint(&inputs, move |x| whole.forward(&layout.bind(x[1..].to_vec()), &x[0], Mode::Train(9))),
                false => model.forward(&bound, &x, Mode::Train(9)),
            };
            y.square().sum().grad(&inputs)
        };
        assert_eq!(run(true), run(false));
    }

    #[test]
    fn derivatives_of_a_whole_model_are_right() {
        let mut params = Params::new();
        let model = model(&mut params);
        let mut inputs = vec![Tensor::from_fn(&[3, 2], |i| (i as f64 + 0.5).cos())];
        inputs.extend(params.values().iter().cloned());
        check_function(&Check::default(), &inputs, |x| {
            model.forward(&params.layout().bind(x[1..].to_vec()), &x[0], Mode::Train(5)).square()
        })
        .unwrap();
    }
}
