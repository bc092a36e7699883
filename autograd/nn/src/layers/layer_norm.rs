//! Layer normalisation.

use super::{Layer, Mode};
use crate::{Bound, ParamId, Params};
use raygrad_autograd::Var;
use raygrad_tensor::{Scalar, Tensor};

/// Layer normalisation along the last axis (Ba, Kiros and Hinton 2016). It normalises to mean 0 and variance 1, then
/// applies a learned gain and bias for each entry.
#[derive(Debug, Clone, Copy)]
pub struct LayerNorm {
    gain: ParamId,
    bias: ParamId,
    eps: f64,
}

impl LayerNorm {
    /// A layer `[.., width] -> [.., width]`. Its parameters are `<name>.gain`, which starts at 1, and `<name>.bias`,
    /// which starts at 0. It adds `eps` 1e-5 to the variance.
    ///
    /// # Panics
    /// If there is already a parameter of one of these names. None is added then.
    #[track_caller]
    pub fn new<T: Scalar>(params: &mut Params<T>, name: &str, width: usize) -> Self {
        params.assert_free(name, &["gain", "bias"]);
        LayerNorm {
            gain: params.add(format!("{name}.gain"), Tensor::ones(&[width])),
            bias: params.add(format!("{name}.bias"), Tensor::zeros(&[width])),
            eps: 1e-5,
        }
    }

    /// The same layer with another `eps`, which is added to the variance.
    pub fn with_eps(self, eps: f64) -> Self {
        LayerNorm { eps, ..self }
    }

    /// The handle of the gain.
    pub fn gain(&self) -> ParamId {
        self.gain
    }

    /// The handle of the bias.
    pub fn bias(&self) -> ParamId {
        self.bias
    }

    /// Computes the layer's output.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// use raygrad_nn::{LayerNorm, Params};
    /// let mut params = Params::<f64>::new();
    /// let norm = LayerNorm::new(&mut params, "norm", 2);
    /// let tape = Tape::new();
    /// let x = tape.constant(Tensor::from_vec(&[1, 2], vec![10.0, 14.0]));
    /// let y = norm.with_eps(0.0).forward(&params.bind(&tape), &x);
    /// assert_eq!(y.value(), [[-1.0, 1.0]]);
    /// ```
    ///
    /// # Panics
    /// If the last extent of `x` is not the width.
    #[track_caller]
    pub fn forward<'t, T: Scalar>(&self, params: &Bound<'t, T>, x: &Var<'t, T>) -> Var<'t, T> {
        x.layer_norm(&params[self.gain], &params[self.bias], self.eps)
    }
}

impl<T: Scalar> Layer<T> for LayerNorm {
    #[track_caller]
    fn apply<'t>(&self, params: &Bound<'t, T>, x: &Var<'t, T>, _mode: Mode) -> Var<'t, T> {
        self.forward(params, x)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::Tape;
    use raygrad_autograd::check::{Check, check_function};

    #[test]
    fn is_the_formula_and_has_its_derivatives() {
        let mut params = Params::<f64>::new();
        let norm = LayerNorm::new(&mut params, "norm", 4).with_eps(1e-3);
        assert_eq!(params.names().collect::<Vec<_>>(), ["norm.gain", "norm.bias"]);
        let inputs = [(0.3, &[3, 4][..]), (0.9, &[4]), (1.7, &[4])]
            .map(|(salt, shape)| Tensor::from_fn(shape, |i| (i as f64 * 0.8 + salt).sin()));
        let forward = |x: &[Tensor<f64>]| {
            let tape = Tape::new();
            let vars: Vec<_> = x[1..].iter().map(|x| tape.constant(x.clone())).collect();
            norm.forward(&params.layout().bind(vars), &tape.constant(x[0].clone())).into_value()
        };
        let got = forward(&inputs);
        for (row, got) in inputs[0].as_slice().chunks(4).zip(got.as_slice().chunks(4)) {
            let mean = row.iter().sum::<f64>() / 4.0;
            let variance = row.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 4.0;
            for k in 0..4 {
                let (gain, bias) = (inputs[1].as_slice()[k], inputs[2].as_slice()[k]);
                let expected = (row[k] - mean) / (variance + 1e-3).sqrt() * gain + bias;
                assert!((got[k] - expected).abs() < 1e-13, "{} instead of {expected}", got[k]);
            }
        }
        check_function(&Check::default(), &inputs, |x| norm.forward(&params.layout().bind(x[1..].to_vec()), &x[0]))
            .unwrap();
    }
}
