//! Ten steps of every optimizer, clipping, averages and schedules against PyTorch in f64. `reference/make_optim.py` says
//! what the reference holds and writes it.

use raygrad_autograd::{Gradient, RowGrad, Scalar, Tensor};
use raygrad_nn::{Adam, AdamConfig, AdamW, Ema, Optimizer, Params, Schedule, Sgd, SgdConfig, clip_norm};
use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;

const STEPS: usize = 10;

struct Reference {
    arrays: Params<f64>,
}

impl Reference {
    fn read() -> Self {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference/optim.npz");
        Reference { arrays: Params::read_npz(path).unwrap() }
    }

    fn get(&self, name: &str) -> &Tensor<f64> {
        let id = self.arrays.find(name).unwrap_or_else(|| panic!("the reference has no {name}"));
        self.arrays.get(id)
    }

    /// Part number `step` of an array `[step, ..]`.
    fn part<T: Scalar>(&self, name: &str, step: usize) -> Tensor<T> {
        let all = self.get(name);
        assert_eq!(all.shape()[0], STEPS, "{name}");
        let len = all.len() / STEPS;
        let values = all.as_slice()[step * len..][..len].iter().map(|&x| T::from_f64(x)).collect();
        Tensor::from_vec(&all.shape()[1..], values)
    }

    fn start<T: Scalar>(&self) -> Params<T> {
        let mut params = Params::new();
        for name in ["a", "b"] {
            params.add(name, self.get(&format!("start.{name}")).cast());
        }
        params
    }

    fn gradients<T: Scalar>(&self, step: usize) -> [Gradient<T>; 2] {
        ["grads.a", "grads.b"].map(|name| self.part(name, step).into())
    }

    fn rate(&self, step: usize) -> f64 {
        self.get("rates").as_slice()[step]
    }

    #[track_caller]
    fn check<T: Scalar>(&self, case: &str, step: usize, params: &Params<T>) {
        for (name, value) in params.iter() {
            close(&format!("{case}.{name}, step {step}"), value, &self.part(&format!("{case}.{name}"), step));
        }
    }
}

/// Within some roundings, relative to the numbers themselves or to 0.1.
#[track_caller]
fn close<T: Scalar>(what: &str, got: &Tensor<T>, expected: &Tensor<f64>) {
    assert_eq!(got.shape(), expected.shape(), "{what}");
    for (got, expected) in got.as_slice().iter().zip(expected.as_slice()) {
        let error = (got.to_f64() - expected).abs() / expected.abs().max(0.1);
        assert!(error <= 50.0 * T::EPSILON, "{what}: {got} instead of {expected}, off by {error:e}");
    }
}

fn sgd(momentum: f64, nesterov: bool, decay: f64) -> SgdConfig {
    SgdConfig { momentum, nesterov, weight_decay: decay }
}

fn adam(beta1: f64, beta2: f64, epsilon: f64) -> AdamConfig {
    AdamConfig { beta1, beta2, eps: epsilon }
}

fn cases<T: Scalar>() -> Vec<(&'static str, Box<dyn Optimizer<T>>)> {
    let default = AdamConfig::default();
    vec![
        ("sgd", Box::new(Sgd::new(sgd(0.0, false, 0.0)))),
        ("sgd_decay", Box::new(Sgd::new(sgd(0.0, false, 0.25)))),
        ("momentum", Box::new(Sgd::new(sgd(0.75, false, 0.0)))),
        ("momentum_decay", Box::new(Sgd::new(sgd(0.75, false, 0.25)))),
        ("nesterov", Box::new(Sgd::new(sgd(0.75, true, 0.0)))),
        ("nesterov_decay", Box::new(Sgd::new(sgd(0.75, true, 0.25)))),
        ("adam", Box::new(Adam::new(default))),
        ("adam_table", Box::new(Adam::new(adam(0.9, 0.99, 1e-15)))),
        ("adam_odd", Box::new(Adam::new(adam(0.5, 0.25, 0.125)))),
        ("adamw", Box::new(AdamW::new(default, 0.25))),
        ("adamw_odd", Box::new(AdamW::new(adam(0.5, 0.75, 1e-3), 2.0))),
    ]
}

fn ten_steps<T: Scalar>() {
    let reference = Reference::read();
    for (case, mut optimizer) in cases::<T>() {
        let mut params = reference.start::<T>();
        for step in 0..STEPS {
            let grads = reference.gradients(step);
            assert_eq!(optimizer.update(&mut params, &grads, reference.rate(step)).check(), Ok(10));
            reference.check(case, step, &params);
        }
    }
}

#[test]
fn ten_steps_in_f64() {
    ten_steps::<f64>();
}

#[test]
fn ten_steps_in_f32() {
    ten_steps::<f32>();
}

#[test]
fn an_average_of_parameters() {
    let reference = Reference::read();
    let mut params = reference.start::<f64>();
    let (mut ema, mut optimizer) = (Ema::new(&params, 0.75), Sgd::new(sgd(0.75, false, 0.0)));
    for step in 0..STEPS {
        optimizer.update(&mut params, &reference.gradients(step), reference.rate(step)).check().unwrap();
        assert_eq!(ema.update(&params), 0);
        reference.check("ema", step, ema.params());
    }
}

/// PyTorch's counts one step for the whole table, which is the same where a row is used in every step.
#[test]
fn rows_of_a_lazy_table() {
    let reference = Reference::read();
    let mut params = Params::new();
    params.add("table", reference.get("table").clone());
    params.set_lazy(|_| true, true);
    let mut optimizer = Adam::new(adam(0.9, 0.999, 1e-20));
    for step in 0..STEPS {
        let mut gradient = Gradient::zero(&[5, 2]);
        gradient.add_sparse(Arc::new(RowGrad::new(&[5, 2], [3, 1, 3].into(), reference.part("shares", step))));
        assert_eq!(optimizer.update(&mut params, &[gradient], reference.rate(step)).check(), Ok(4));
        close("sparse_adam", &params.values()[0], &reference.part("sparse_adam", step));
    }
}

#[test]
fn gradients_of_a_limited_norm() {
    let reference = Reference::read();
    for step in 0..STEPS {
        let mut grads = reference.gradients::<f64>(step);
        let clipped = clip_norm(&mut grads, 1.0);
        let norm = reference.get("clip.norms").as_slice()[step];
        assert!((clipped.norm / norm - 1.0).abs() <= 1e-15, "{} instead of {norm}", clipped.norm);
        for (grad, name) in grads.iter().zip(["clip.a", "clip.b"]) {
            // PyTorch adds 1e-6 to the norm that it divides by.
            let factor = if norm > 1.0 { (norm + 1e-6) / norm } else { 1.0 };
            let expected: Tensor<f64> = reference.part(name, step);
            let expected = Tensor::from_fn(expected.shape(), |i| factor * expected.as_slice()[i]);
            close(name, grad.dense().unwrap(), &expected);
        }
    }
}

#[test]
fn learning_rates() {
    let reference = Reference::read();
    let (from, warmup) = (0.5, 0.0);
    for (name, schedule) in [
        ("cosine", Schedule::Cosine { from, to: 0.01, warmup }),
        ("exponential", Schedule::Exponential { from, to: 0.05, warmup }),
        ("step", Schedule::Step { from, factor: 0.5, every: 0.3, warmup }),
        ("linear", Schedule::Linear { from, to: 0.125, warmup }),
        ("warmup", Schedule::Linear { from, to: from, warmup: 0.4 }),
    ] {
        for (step, expected) in reference.get(&format!("schedule.{name}")).as_slice().iter().enumerate() {
            let rate = schedule.lr(step as f64 / STEPS as f64);
            assert!((rate - expected).abs() <= 1e-15, "{name}, step {step}: {rate} instead of {expected}");
        }
    }
}

#[test]
fn nothing_of_the_reference_is_left_out() {
    let mut known: BTreeSet<String> =
        ["rates", "table", "shares", "sparse_adam", "clip.norms"].map(String::from).into_iter().collect();
    let optimizers = cases::<f64>();
    let pairs = optimizers.iter().map(|(case, _)| *case).chain(["start", "grads", "clip", "ema"]);
    known.extend(pairs.flat_map(|case| ["a", "b"].map(|name| format!("{case}.{name}"))));
    known.extend(["cosine", "exponential", "step", "linear", "warmup"].map(|name| format!("schedule.{name}")));
    assert_eq!(Reference::read().arrays.names().map(String::from).collect::<BTreeSet<_>>(), known);
}
