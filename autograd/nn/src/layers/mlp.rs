//! The multilayer perceptron.

use super::{Init, Layer, Linear, Mode};
use crate::{Bound, Params};
use rand::Rng;
use raygrad_autograd::{Activation, Var};
use raygrad_tensor::Scalar;

/// A multilayer perceptron: dense ReLU layers of one width. Layers in `skips` get the input of the stack too,
/// concatenated to their own input.
#[derive(Debug, Clone)]
pub struct Mlp {
    layers: Vec<Linear>,
    skips: Vec<usize>,
}

impl Mlp {
    /// `depth` layers `inputs -> width -> .. -> width`, with parameters `<name>.0.weight` and so on. Layer numbers in
    /// `skips` count from 0. The classic NeRF has depth 8 and skips `[5]`.
    ///
    /// # Panics
    /// If `skips` has the first layer, or a layer that does not exist. If there is already a parameter of one of these
    /// names; none is added then.
    #[track_caller]
    pub fn new<T: Scalar>(
        params: &mut Params<T>,
        name: &str,
        [inputs, width, depth]: [usize; 3],
        skips: &[usize],
        rng: &mut (impl Rng + ?Sized),
    ) -> Self {
        assert!(skips.iter().all(|&skip| (1..depth).contains(&skip)), "skips {skips:?} of {depth} layers");
        (0..depth).for_each(|i| params.assert_free(&format!("{name}.{i}"), &["weight", "bias"]));
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

    /// The dense layers in order.
    pub fn layers(&self) -> &[Linear] {
        &self.layers
    }

    /// Computes the output of the last layer.
    ///
    /// # Panics
    /// If the last extent of `x` is not the number of inputs.
    #[track_caller]
    pub fn forward<'t, T: Scalar>(&self, params: &Bound<'t, T>, x: &Var<'t, T>) -> Var<'t, T> {
        let mut h = x.clone();
        for (i, layer) in self.layers.iter().enumerate() {
            if self.skips.contains(&i) {
                h = Var::concat(&[x, &h], -1);
            }
            h = layer.forward(params, &h);
        }
        h
    }
}

impl<T: Scalar> Layer<T> for Mlp {
    #[track_caller]
    fn apply<'t>(&self, params: &Bound<'t, T>, x: &Var<'t, T>, _mode: Mode) -> Var<'t, T> {
        self.forward(params, x)
    }
}
