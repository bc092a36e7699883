//! The photometric loss.

use crate::Result;
use crate::range::check_range;
use raygrad_autograd::{Scalar, Tensor, Var};
use serde::{Deserialize, Serialize};

/// The photometric loss, as a function of the error `e` of one colour channel. Training minimises its mean.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Loss {
    /// Squared error, `e^2`.
    #[default]
    Mse,
    /// Huber loss (Huber 1964, equation 2.3), doubled: `e^2` up to `|e| = delta`, and `2 delta |e| - delta^2`
    /// beyond. Outliers count less.
    Huber {
        /// Largest error that is squared. Colours lie in 0 to 1; 0.1 is usual. Range: 0.0001 to 1.
        delta: f64,
    },
}

impl Loss {
    pub(crate) fn check(self) -> Result<()> {
        match self {
            Loss::Mse => Ok(()),
            Loss::Huber { delta } => check_range("delta", delta, 1e-4, 1.0),
        }
    }

    /// Returns the summed loss of `color` `[rays, 3]` against `target` `[rays, 3]`.
    ///
    /// The second derivative of Huber's loss jumps at `|e| = delta`, where that of the inner part counts.
    #[track_caller]
    pub fn sum<'t, T: Scalar>(self, color: &Var<'t, T>, target: &Tensor<T>) -> Var<'t, T> {
        let error = color - color.tape().constant(target.clone());
        match self {
            Loss::Mse => error.square().sum(),
            Loss::Huber { delta } => {
                // 2 d |e| - d^2 = e^2 - (|e| - d)^2.
                let beyond = (&error - delta).relu() + (-&error - delta).relu();
                (error.square() - beyond.square()).sum()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::Tape;
    use raygrad_autograd::check::{Check, check_function};

    /// Colours and their targets.
    fn pixels() -> [Tensor<f64>; 2] {
        let rendered = vec![0.5, 0.55, 0.61, 0.5, 0.44, 0.39, 1.0, 0.0, 0.62];
        [Tensor::from_vec(&[3, 3], rendered), Tensor::full(&[3, 3], 0.5)]
    }

    #[test]
    fn huber_is_square_then_linear() {
        let tape = Tape::new();
        let [rendered, target] = pixels();
        let sum = |loss: Loss| loss.sum(&tape.constant(rendered.clone()), &target).item();
        let errors = [0.0, 0.05, 0.11, 0.0, 0.06, 0.11, 0.5, 0.5, 0.12_f64];
        let line = |e: f64| if e <= 0.1 { e * e } else { 0.2 * e - 0.01 };
        assert!((sum(Loss::Huber { delta: 0.1 }) - errors.map(line).iter().sum::<f64>()).abs() <= 1e-15);
        assert!((sum(Loss::Mse) - errors.map(|e| e * e).iter().sum::<f64>()).abs() <= 1e-15);
        assert!((sum(Loss::Huber { delta: 1.0 }) - sum(Loss::Mse)).abs() <= 1e-15);
    }

    #[test]
    fn photometric_gradients_equal_differences() {
        let [rendered, target] = pixels();
        for loss in [Loss::Mse, Loss::Huber { delta: 0.1 }] {
            let report =
                check_function(&Check::default(), std::slice::from_ref(&rendered), |x| loss.sum(&x[0], &target));
            assert!(report.unwrap().comparisons > 15, "{loss:?}");
        }
    }

    #[test]
    fn photometric_settings_are_checked() {
        let read = |text: &str| serde_json::from_str::<Loss>(text);
        assert_eq!(read(r#""mse""#).unwrap(), Loss::Mse);
        assert_eq!(read(r#"{"huber": {"delta": 0.1}}"#).unwrap(), Loss::Huber { delta: 0.1 });
        assert!(read(r#""huber""#).is_err() && read(r#"{"huber": {"delta": 0.1, "gamma": 1}}"#).is_err());
        for delta in [0.0, -0.1, 1.5, f64::NAN] {
            let error = Loss::Huber { delta }.check().unwrap_err().to_string();
            assert!(error.starts_with("`delta`"), "{error}");
        }
    }
}
