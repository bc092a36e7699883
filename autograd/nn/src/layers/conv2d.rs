//! The convolutional layer.

use super::{Init, Layer, Mode};
use crate::{Bound, ParamId, Params};
use rand::Rng;
use raygrad_autograd::{Activation, Conv2dConfig, Var};
use raygrad_tensor::{Scalar, Tensor};

/// A 2-D convolution of images `[n, channels, height, width]`, with an activation and a bias for each output channel.
#[derive(Debug, Clone, Copy)]
pub struct Conv2d {
    weight: ParamId,
    bias: Option<ParamId>,
    config: Conv2dConfig,
    activation: Activation,
}

impl Conv2d {
    /// A layer `[n, channels, h, w] -> [n, outputs, oh, ow]`. Its parameters are `<name>.weight`
    /// `[outputs, channels, kernel height, kernel width]` and `<name>.bias` `[outputs]`. The bias starts at 0.
    /// [`Var::conv2d`] has the formulas for `oh` and `ow`.
    ///
    /// # Panics
    /// If there is already a parameter of one of these names, or `init` is a negative deviation. None is added then.
    #[track_caller]
    pub fn new<T: Scalar>(
        params: &mut Params<T>,
        name: &str,
        [channels, outputs]: [usize; 2],
        kernel: [usize; 2],
        config: Conv2dConfig,
        activation: Activation,
        init: Init,
        rng: &mut (impl Rng + ?Sized),
    ) -> Self {
        params.assert_free(name, &["weight", "bias"]);
        let layer = Conv2d::without_bias(params, name, [channels, outputs], kernel, config, activation, init, rng);
        Conv2d { bias: Some(params.add(format!("{name}.bias"), Tensor::zeros(&[outputs]))), ..layer }
    }

    /// As [`new`](Self::new), without a bias.
    ///
    /// # Panics
    /// As [`new`](Self::new).
    #[track_caller]
    pub fn without_bias<T: Scalar>(
        params: &mut Params<T>,
        name: &str,
        [channels, outputs]: [usize; 2],
        kernel: [usize; 2],
        config: Conv2dConfig,
        activation: Activation,
        init: Init,
        rng: &mut (impl Rng + ?Sized),
    ) -> Self {
        let window = kernel[0] * kernel[1];
        let shape = [outputs, channels, kernel[0], kernel[1]];
        let weight = init.tensor(&shape, [channels * window, outputs * window], rng);
        Conv2d { weight: params.add(format!("{name}.weight"), weight), bias: None, config, activation }
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
    /// ```
    /// use raygrad_autograd::{Activation, Conv2dConfig, Tape, Tensor};
    /// use raygrad_nn::{Conv2d, Init, Params};
    /// use rand::SeedableRng;
    /// let mut rng = rand::rngs::StdRng::seed_from_u64(1);
    /// let mut params = Params::<f32>::new();
    /// let halved = Conv2dConfig { stride: [2, 2], padding: [1, 1], ..Conv2dConfig::default() };
    /// let layer = Conv2d::new(&mut params, "conv", [3, 8], [3, 3], halved, Activation::Relu, Init::He, &mut rng);
    /// let tape = Tape::new();
    /// let images = tape.constant(Tensor::ones(&[4, 3, 16, 16]));
    /// assert_eq!(layer.forward(&params.bind(&tape), &images).shape(), [4, 8, 8, 8]);
    /// ```
    ///
    /// # Panics
    /// If the shape of `x` does not fit.
    #[track_caller]
    pub fn forward<'t, T: Scalar>(&self, params: &Bound<'t, T>, x: &Var<'t, T>) -> Var<'t, T> {
        let weight = &params[self.weight];
        let y = match self.bias {
            Some(bias) => x.conv2d_bias(weight, &params[bias], &self.config),
            None => x.conv2d(weight, &self.config),
        };
        match self.activation {
            Activation::Identity => y,
            Activation::Relu => y.relu(),
        }
    }
}

impl<T: Scalar> Layer<T> for Conv2d {
    #[track_caller]
    fn apply<'t>(&self, params: &Bound<'t, T>, x: &Var<'t, T>, _mode: Mode) -> Var<'t, T> {
        self.forward(params, x)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{LayerNorm, Linear, Optimizer, Sequential, Sgd, SgdConfig};
    use rand::SeedableRng;
    use rand_pcg::Pcg64Mcg;
    use raygrad_autograd::Tape;
    use raygrad_autograd::check::{Check, check_function};

    fn rng() -> Pcg64Mcg {
        Pcg64Mcg::seed_from_u64(8)
    }

    #[test]
    fn conv2d_layer_equals_operation() {
        let config = Conv2dConfig { stride: [2, 1], padding: [1, 0], ..Conv2dConfig::default() };
        for bias in [false, true] {
            let mut params = Params::<f64>::new();
            let (name, sizes, kernel, none) = ("conv", [2, 3], [3, 2], Activation::Identity);
            let layer = if bias {
                Conv2d::new(&mut params, name, sizes, kernel, config, none, Init::Glorot, &mut rng())
            } else {
                Conv2d::without_bias(&mut params, name, sizes, kernel, config, none, Init::Glorot, &mut rng())
            };
            assert_eq!(params.values()[0].shape(), [3, 2, 3, 2]);
            assert_eq!(params.len(), 1 + usize::from(bias));
            // Glorot's bound counts the window: sqrt(6 / (2 * 6 + 3 * 6)).
            assert!(params.values()[0].as_slice().iter().all(|w| w.abs() <= 0.2_f64.sqrt()));
            let mut inputs = vec![Tensor::from_fn(&[2, 2, 4, 3], |i| (i as f64 * 0.7).sin())];
            inputs.extend(params.values().iter().cloned());
            check_function(&Check::default(), &inputs, |x| {
                layer.forward(&params.layout().bind(x[1..].to_vec()), &x[0])
            })
            .unwrap();
        }
    }

    #[test]
    fn a_small_image_network_learns_which_way_stripes_run() {
        let mut params = Params::<f32>::new();
        let config = Conv2dConfig { stride: [2, 2], ..Conv2dConfig::default() };
        let mut rng = rng();
        let conv = Conv2d::new(&mut params, "conv", [1, 16], [2, 2], config, Activation::Relu, Init::He, &mut rng);
        let norm = LayerNorm::new(&mut params, "norm", 144);
        let head = Linear::new(&mut params, "head", [144, 1], Activation::Identity, Init::Glorot, &mut rng);
        let model = Sequential::new().then(conv).map(|x| x.reshape(&[x.shape()[0], 144])).then(norm).then(head);
        // Half of the images have stripes along rows, half along columns, each with a phase of its own.
        let image = |i: usize| {
            let (which, row, column) = (i / 36, i / 6 % 6, i % 6);
            let along = if which % 2 == 0 { row } else { column };
            if (along + which / 2) % 2 == 0 { 1.0 } else { -1.0 }
        };
        let labels = Tensor::from_fn(&[8, 1], |i| if i % 2 == 0 { 1.0 } else { -1.0 });
        let mut sgd = Sgd::new(SgdConfig { momentum: 0.9, nesterov: true, ..SgdConfig::default() });
        let mut losses = vec![];
        for _ in 0..60 {
            let tape = Tape::new();
            let bound = params.bind(&tape);
            let x = tape.constant(Tensor::from_fn(&[8, 1, 6, 6], image));
            let y = model.forward(&bound, &x, Mode::Train(0));
            let loss = (y - tape.constant(labels.clone())).square().mean();
            losses.push(loss.item());
            let grads = bound.backward(&loss);
            sgd.update(&mut params, &grads, 0.01).check().unwrap();
        }
        assert!(losses[0] > 0.1 && losses[59] < 1e-2, "{} to {}", losses[0], losses[59]);
    }
}
