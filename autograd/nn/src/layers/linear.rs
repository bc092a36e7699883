//! The dense layer.

use super::{Init, Layer, Mode};
use crate::{Bound, ParamId, Params};
use rand::Rng;
use raygrad_autograd::{Activation, Var};
use raygrad_tensor::{Scalar, Tensor};

/// A dense layer: `activation(x weight + bias)`, with or without a bias.
#[derive(Debug, Clone)]
pub struct Linear {
    weight: ParamId,
    bias: Option<ParamId>,
    activation: Activation,
}

impl Linear {
    /// A layer `[.., inputs] -> [.., outputs]`. Its parameters are `<name>.weight` `[inputs, outputs]` and
    /// `<name>.bias` `[outputs]`. The bias starts at 0.
    ///
    /// # Panics
    /// If there is already a parameter of one of these names, or `init` is a negative deviation. None is added then.
    #[track_caller]
    pub fn new<T: Scalar>(
        params: &mut Params<T>,
        name: &str,
        sizes: [usize; 2],
        activation: Activation,
        init: Init,
        rng: &mut (impl Rng + ?Sized),
    ) -> Self {
        params.assert_free(name, &["weight", "bias"]);
        let layer = Linear::without_bias(params, name, sizes, activation, init, rng);
        Linear { bias: Some(params.add(format!("{name}.bias"), Tensor::zeros(&sizes[1..]))), ..layer }
    }

    /// As [`new`](Self::new), without a bias.
    ///
    /// # Panics
    /// As [`new`](Self::new).
    #[track_caller]
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

    /// The handle of the weight.
    pub fn weight(&self) -> ParamId {
        self.weight
    }

    /// The handle of the bias, if there is one.
    pub fn bias(&self) -> Option<ParamId> {
        self.bias
    }

    /// Computes the layer's output.
    ///
    /// # Panics
    /// If the last extent of `x` is not the number of inputs.
    #[track_caller]
    pub fn forward<'t, T: Scalar>(&self, params: &Bound<'t, T>, x: &Var<'t, T>) -> Var<'t, T> {
        x.linear(&params[self.weight], self.bias.map(|bias| &params[bias]), self.activation)
    }
}

impl<T: Scalar> Layer<T> for Linear {
    #[track_caller]
    fn apply<'t>(&self, params: &Bound<'t, T>, x: &Var<'t, T>, _mode: Mode) -> Var<'t, T> {
        self.forward(params, x)
    }
}
