//! Activations and logarithms at their ends.

use super::support::*;
use raygrad::{Scalar, Tape, Var};

/// The value and the gradient of a function of one number.
fn at<T: Scalar>(x: f64, f: impl for<'t> Fn(&Var<'t, T>) -> Var<'t, T>) -> [f64; 2] {
    let tape = Tape::new();
    let x = tape.leaf(vector::<T>(&[x]));
    let y = f(&x).sum();
    [y.item().to_f64(), y.grad(&[&x])[0].item().to_f64()]
}

/// Matrix: softplus at +-17, +-20, +-89, +-104, +-inf. Catalogue: `log(1 + e^x)`.
fn softplus<T: Scalar>() {
    let two_ulp = 2.0 * T::EPSILON;
    for x in [17.0, 20.0, 89.0, 104.0_f64] {
        for x in [x, -x] {
            let [y, slope] = at::<T>(x, |x| x.softplus());
            near::<T>(&format!("softplus({x})"), y, x.max(0.0) + (-x.abs()).exp().ln_1p(), two_ulp);
            near::<T>(&format!("softplus'({x})"), slope, 1.0 / (1.0 + (-x).exp()), two_ulp);
        }
    }
    for name in ["softplus(-20)", "softplus(89)", "softplus(17)", "softplus(-17)", "softplus(-89)", "softplus(-104)"] {
        let x: f64 = name[9..name.len() - 1].parse().unwrap();
        near::<T>(name, at::<T>(x, |x| x.softplus())[0], constant(name), two_ulp);
    }
    assert_eq!(at::<T>(f64::INFINITY, |x| x.softplus()), [f64::INFINITY, 1.0]);
    assert_eq!(at::<T>(f64::NEG_INFINITY, |x| x.softplus()), [0.0, 0.0]);
}

/// Matrix: sigmoid at the same places, and s(x) + s(-x) = 1. Catalogue: `s (1 - s)` is 0 at 17.
fn sigmoid<T: Scalar>() {
    let two_ulp = 2.0 * T::EPSILON;
    for name in
        ["sigmoid(17)", "sigmoid(-17)", "sigmoid(20)", "sigmoid(-20)", "sigmoid(89)", "sigmoid(-89)", "sigmoid(-104)"]
    {
        let x: f64 = name[8..name.len() - 1].parse().unwrap();
        let [y, slope] = at::<T>(x, |x| x.sigmoid());
        near::<T>(name, y, constant(name), two_ulp);
        near::<T>("slope", slope, (-x.abs()).exp() / (1.0 + (-x.abs()).exp()).powi(2), 2.0 * two_ulp);
        within("s(x) + s(-x)", y + at::<T>(-x, |x| x.sigmoid())[0], 1.0, T::EPSILON);
    }
    near::<T>("sigmoid'(17)", at::<T>(17.0, |x| x.sigmoid())[1], constant("sigmoid'(17)"), 2.0 * two_ulp);
    assert_eq!(at::<T>(f64::INFINITY, |x| x.sigmoid()), [1.0, 0.0]);
    assert_eq!(at::<T>(f64::NEG_INFINITY, |x| x.sigmoid()), [0.0, 0.0]);
}

/// Catalogue: log 0. The entropy -p ln p at 0 is 0, and so is a cross-entropy of sure and right logits.
fn logarithm_of_zero<T: Scalar>() {
    let tape = Tape::new();
    let p = tape.leaf(vector::<T>(&[0.0, 0.5, 1.0]));
    // The exact slope of the entropy at 0 is infinite; that of x ln y is 0 by convention where x is 0.
    let weight = tape.leaf(vector::<T>(&[0.0, 0.5, 1.0]));
    let entropy = -weight.xlogy(&p);
    within("entropy", entropy.value().as_slice()[0].to_f64(), 0.0, 0.0);
    within("entropy", entropy.sum().item().to_f64(), 0.5 * 2.0_f64.ln(), 1e-7);
    let slopes = entropy.sum().grad(&[&weight, &p]);
    finite("by the weight", &slopes[0]);
    finite("by the probability", &slopes[1]);
    for logit in [-104.0, -89.0, 0.0, 89.0, 104.0] {
        let x = tape.leaf(vector::<T>(&[logit]));
        let target = tape.constant(vector::<T>(&[1.0]));
        let loss = x.binary_cross_entropy_with_logits_loss(&target);
        near::<T>("cross-entropy", loss.item().to_f64(), (-logit).max(0.0) + (-logit.abs()).exp().ln_1p(), 1e-6);
        finite("its gradient", &loss.grad(&[&x])[0]);
        let two = tape.leaf(tensor::<T>(&[1, 2], &[logit, 0.0]));
        let loss = two.cross_entropy_loss([0]);
        near::<T>("of classes", loss.item().to_f64(), (-logit).max(0.0) + (-logit.abs()).exp().ln_1p(), 1e-6);
        finite("its gradient", &loss.grad(&[&two])[0]);
    }
}

both!(softplus, sigmoid, logarithm_of_zero);
