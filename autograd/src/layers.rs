//! Layers: handles on parameters, and pure functions of (parameters, input).

use crate::{Activation, Bound, ParamId, Params, Var};
use rand::{Rng, RngExt};
use raygrad_tensor::{Scalar, Tensor};

/// How the weights of a dense layer start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Init {
    /// Uniform within `sqrt(6 / (inputs + outputs))` of 0 (Glorot and Bengio 2010, equation 16).
    Glorot,
    /// Uniform within `sqrt(6 / inputs)` of 0 (He et al. 2015, equation 10): keeps the variance through ReLU layers.
    He,
    /// Uniform within this bound of 0.
    Uniform(f64),
}

impl Init {
    /// A weight matrix `[inputs, outputs]`.
    pub fn weight<T: Scalar>(self, inputs: usize, outputs: usize, rng: &mut (impl Rng + ?Sized)) -> Tensor<T> {
        let bound = match self {
            Init::Glorot => (6.0 / (inputs + outputs).max(1) as f64).sqrt(),
            Init::He => (6.0 / inputs.max(1) as f64).sqrt(),
            Init::Uniform(bound) => bound,
        };
        Tensor::from_fn(&[inputs, outputs], |_| T::from_f64(bound * (2.0 * rng.random::<f64>() - 1.0)))
    }
}

/// A dense layer: `activation(x weight + bias)`, or without the bias.
#[derive(Debug, Clone)]
pub struct Linear {
    weight: ParamId,
    bias: Option<ParamId>,
    activation: Activation,
}

impl Linear {
    /// A layer `[.., inputs] -> [.., outputs]` whose parameters are `<name>.weight` and `<name>.bias`; the bias is 0.
    pub fn new<T: Scalar>(
        params: &mut Params<T>,
        name: &str,
        sizes: [usize; 2],
        activation: Activation,
        init: Init,
        rng: &mut (impl Rng + ?Sized),
    ) -> Self {
        let layer = Linear::without_bias(params, name, sizes, activation, init, rng);
        Linear { bias: Some(params.add(format!("{name}.bias"), Tensor::zeros(&sizes[1..]))), ..layer }
    }

    /// As [`new`](Self::new), with a weight only.
    pub fn without_bias<T: Scalar>(
        params: &mut Params<T>,
        name: &str,
        [inputs, outputs]: [usize; 2],
        activation: Activation,
        init: Init,
        rng: &mut (impl Rng + ?Sized),
    ) -> Self {
        Linear {
            weight: params.add(format!("{name}.weight"), init.weight(inputs, outputs, rng)),
            bias: None,
            activation,
        }
    }

    /// The layer's output.
    ///
    /// # Panics
    /// If the last extent of `x` is not the number of inputs.
    #[track_caller]
    pub fn forward<'t, T: Scalar>(&self, params: &Bound<'t, T>, x: &Var<'t, T>) -> Var<'t, T> {
        x.linear(&params[self.weight], self.bias.map(|bias| &params[bias]), self.activation)
    }
}

/// A stack of dense ReLU layers of one width; before the layers in `skips`, the stack's input is joined to theirs.
#[derive(Debug, Clone)]
pub struct Mlp {
    layers: Vec<Linear>,
    skips: Vec<usize>,
}

impl Mlp {
    /// `depth` layers `inputs -> width -> .. -> width` with parameters `<name>.0.weight` and so on. Layer numbers in
    /// `skips` count from 0; the classic NeRF has depth 8 and skips `[5]`.
    ///
    /// # Panics
    /// If a skip names the first layer or one that does not exist.
    #[track_caller]
    pub fn new<T: Scalar>(
        params: &mut Params<T>,
        name: &str,
        [inputs, width, depth]: [usize; 3],
        skips: &[usize],
        rng: &mut (impl Rng + ?Sized),
    ) -> Self {
        assert!(skips.iter().all(|&skip| (1..depth).contains(&skip)), "skips {skips:?} of {depth} layers");
        let fan_in = |i: usize| match i {
            0 => inputs,
            _ if skips.contains(&i) => inputs + width,
            _ => width,
        };
        let layer = |i: usize, params: &mut Params<T>, rng: &mut _| {
            Linear::new(params, &format!("{name}.{i}"), [fan_in(i), width], Activation::Relu, Init::He, rng)
        };
        let mut layers = Vec::with_capacity(depth);
        for i in 0..depth {
            layers.push(layer(i, params, &mut *rng));
        }
        Mlp { layers, skips: skips.into() }
    }

    /// The output of the last layer.
    ///
    /// # Panics
    /// If the last extent of `x` is not the number of inputs.
    #[track_caller]
    pub fn forward<'t, T: Scalar>(&self, params: &Bound<'t, T>, x: &Var<'t, T>) -> Var<'t, T> {
        let mut h = x.clone();
        for (i, layer) in self.layers.iter().enumerate() {
            if self.skips.contains(&i) {
                h = Var::concat(&[x, &h], h.shape().len() - 1);
            }
            h = layer.forward(params, &h);
        }
        h
    }
}
