//! What a store of parameters does.

use super::*;
use crate::{Init, LayerNorm, Linear, Mlp, Optimizer, Sgd, SgdConfig, Storage, Tiles};
use rand::SeedableRng;
use rand::rngs::StdRng;
use raygrad_autograd::Activation;

#[test]
fn frozen_parameters_rest_others_have_own_lr() {
    let mut params = Params::<f64>::new();
    for name in ["trunk.weight", "trunk.bias", "head.weight"] {
        params.add(name, Tensor::ones(&[2]));
    }
    assert_eq!(params.set_lr_scale(|name| name.starts_with("trunk."), 0.5), 2);
    assert_eq!(params.set_weight_decay_scale(|name| name.ends_with("bias"), 0.0), 1);
    assert_eq!(params.freeze(|name| name == "head.weight"), 1);
    let head = params.find("head.weight").unwrap();
    assert!(params.is_frozen(head) && params.name(head) == "head.weight" && params.find("body").is_none());
    assert_eq!((params.elements(), params.trainable_elements(), params.ids().count()), (6, 4, 3));
    assert_eq!(params.names().collect::<Vec<_>>(), ["trunk.weight", "trunk.bias", "head.weight"]);

    let mut sgd = Sgd::new(SgdConfig { weight_decay: 1.0, ..SgdConfig::default() });
    let step = |params: &mut Params<f64>, sgd: &mut Sgd<f64>| {
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let sum = params.ids().map(|id| bound[id].sum()).reduce(|a, b| a + b).unwrap();
        assert_eq!(bound.vars().len(), params.trainable().count());
        let grads = bound.backward(&sum);
        let moved = sgd.update(params, &grads, 0.1).check().unwrap();
        (moved, params.values().iter().map(|x| x.as_slice()[0]).collect::<Vec<_>>())
    };
    // Half the rate; decay adds the parameter, 1, to the gradient, 1, but for the bias.
    assert_eq!(step(&mut params, &mut sgd), (4, vec![0.9, 0.95, 1.0]));
    assert_eq!((params.lr_scale(head), params.lr_scale(params.find("trunk.bias").unwrap())), (1.0, 0.5));
    // Settings survive a change of precision and a load.
    let mut copy = params.cast::<f32>().cast::<f64>();
    let bytes = params.to_safetensors(Storage::Full, &Default::default(), &[]).unwrap();
    copy.load_safetensors(&bytes).unwrap();
    assert!(copy.is_frozen(head) && copy.trainable_elements() == 4);
    copy.unfreeze(|_| true);
    let (moved, values) = step(&mut copy, &mut sgd);
    assert_eq!((moved, values[2]), (6, 1.0 - 0.1 * 2.0));
}

#[test]
fn handles_fit_copies_and_no_other_store() {
    let mut params = Params::<f64>::new();
    let x = params.add("x", Tensor::scalar(1.0));
    let (single, mut copy) = (params.cast::<f32>(), params.clone());
    let y = copy.add("y", Tensor::scalar(2.0));
    assert_eq!((single.get(x).item(), copy.get(x).item(), copy.get(y).item()), (1.0, 1.0, 2.0));
    assert_eq!(params.find("x"), Some(x));
    assert_eq!(copy.ids().collect::<Vec<_>>(), [x, y]);
    // Both stores have a second parameter, but not the same one.
    let z = params.add("z", Tensor::scalar(3.0));
    let mut other = Params::<f64>::new();
    let stranger = other.add("x", Tensor::scalar(4.0));
    let tape = Tape::new();
    let bound = params.bind(&tape);
    let message = |f: &dyn Fn()| {
        let error = std::panic::catch_unwind(std::panic::AssertUnwindSafe(f)).expect_err("refused");
        error.downcast_ref::<String>().cloned().unwrap_or_default()
    };
    for (f, expected) in [
        (&(|| drop(params.get(y).clone())) as &dyn Fn(), "its parameter 1 is not this store's `z`"),
        (&|| drop(copy.name(z).to_owned()), "its parameter 1 is not this store's `y`"),
        (&|| drop(bound[stranger].clone()), "its parameter 0 is not this store's `x`"),
        (&|| assert!(single.is_frozen(y)), "its parameter 1, of 1 here"),
    ] {
        assert!(message(f).contains(expected), "{} and {expected}", message(f));
    }
    other.add("z", Tensor::scalar(5.0));
    other.freeze(|name| name == "z");
    params.assign(&other.cast::<f32>());
    assert_eq!((params.get(x).item(), params.get(z).item(), params.is_frozen(z)), (4.0, 5.0, true));
}

#[test]
fn gradients_are_found_by_handle() {
    let mut params = Params::<f64>::new();
    let [a, b, c] = ["a", "b", "c"].map(|name| params.add(name, Tensor::scalar(1.0)));
    params.freeze(|name| name == "b");
    let of = |grads: &[Tensor<f64>]| [a, b, c].map(|id| params.grad(grads, id).map(Tensor::item));
    let tape = Tape::new();
    let bound = params.bind(&tape);
    let loss = &bound[a] * 2.0 + &bound[b] * 3.0 + &bound[c] * 4.0;
    assert_eq!(of(&loss.grad(&bound.vars())), [Some(2.0), None, Some(4.0)]);
    let recorded = loss.grad_graph(&bound.vars());
    assert_eq!(params.grad(&recorded, c).unwrap().item(), 4.0);
    let grads = bound.backward(&loss);
    assert_eq!(params.grad(&grads, c).unwrap().dense().unwrap().item(), 4.0);
    let step = Tiles::<f64>::new().differentiate(&params, 2, |_, params, _| (&params[a] + &params[c] * 5.0, ()));
    assert_eq!(params.grad(&step.grads, c).unwrap().dense().unwrap().item(), 10.0);
    assert!(params.grad(&step.grads, b).is_none());
    let stranger = Params::<f64>::new().add("a", Tensor::scalar(1.0));
    assert!(panic_of(|| assert!(params.grad(&grads, stranger).is_none())).contains("a handle of another store"));
    assert!(panic_of(|| assert!(params.grad(&grads[..1], a).is_none())).contains("one gradient for each parameter"));
}

#[test]
fn layers_show_their_handles() {
    use crate::{Conv2d, Init, LayerNorm, Linear, Mlp};
    use rand::SeedableRng;
    use raygrad_autograd::Activation;
    let mut rng = rand_pcg::Pcg64Mcg::seed_from_u64(1);
    let (mut params, none) = (Params::<f32>::new(), Activation::Identity);
    let linear = Linear::new(&mut params, "linear", [2, 3], none, Init::Glorot, &mut rng);
    let plain = Linear::without_bias(&mut params, "plain", [2, 3], none, Init::Glorot, &mut rng);
    let conv = Conv2d::new(&mut params, "conv", [1, 2], [3, 3], Default::default(), none, Init::Glorot, &mut rng);
    let norm = LayerNorm::new(&mut params, "norm", 3);
    let mlp = Mlp::new(&mut params, "mlp", [2, 3, 2], &[], &mut rng);
    assert!(plain.bias().is_none() && mlp.layers().len() == 2);
    for (id, name) in [
        (linear.weight(), "linear.weight"),
        (linear.bias().unwrap(), "linear.bias"),
        (plain.weight(), "plain.weight"),
        (conv.weight(), "conv.weight"),
        (conv.bias().unwrap(), "conv.bias"),
        (norm.gain(), "norm.gain"),
        (norm.bias(), "norm.bias"),
        (mlp.layers()[1].weight(), "mlp.1.weight"),
    ] {
        assert_eq!(params.name(id), name);
    }
}

#[test]
fn many_parameters_are_added_and_found_in_linear_time() {
    let mut params = Params::<f32>::new();
    let start = std::time::Instant::now();
    for i in 0..100_000 {
        let id = params.add(format!("layer{i}.weight"), Tensor::zeros(&[0]));
        assert_eq!(params.find(&format!("layer{i}.weight")), Some(id));
    }
    // A search through all names takes minutes.
    assert!(start.elapsed().as_secs() < 10, "{:?}", start.elapsed());
}

/// Runs `f`, which panics, and returns its message.
fn panic_of(f: impl FnOnce()) -> String {
    let error = std::panic::catch_unwind(std::panic::AssertUnwindSafe(f)).expect_err("no panic");
    error.downcast_ref::<String>().cloned().unwrap_or_default()
}

#[test]
fn layers_with_a_taken_name_add_nothing() {
    for taken in ["layer.weight", "layer.gain", "layer.bias"] {
        let mut params = Params::<f32>::new();
        params.add(taken, Tensor::scalar(1.0));
        let rng = &mut StdRng::seed_from_u64(1);
        if taken != "layer.gain" {
            let linear = || {
                Linear::new(&mut params, "layer", [2, 3], Activation::Identity, Init::Glorot, rng);
            };
            assert_eq!(panic_of(linear), format!("there is already a parameter `{taken}`"));
        }
        if taken != "layer.weight" {
            let norm = || {
                LayerNorm::new(&mut params, "layer", 3);
            };
            assert_eq!(panic_of(norm), format!("there is already a parameter `{taken}`"));
        }
        assert_eq!(params.len(), 1);
    }
    let mut params = Params::<f32>::new();
    params.add("net.2.bias", Tensor::scalar(1.0));
    let rng = &mut StdRng::seed_from_u64(1);
    let mlp = || drop(Mlp::new(&mut params, "net", [2, 3, 4], &[], rng));
    assert_eq!(panic_of(mlp), "there is already a parameter `net.2.bias`");
    assert_eq!(params.len(), 1);
}

#[test]
fn add_taken_name_panics_and_changes_nothing() {
    let mut params = Params::<f32>::new();
    let x = params.add("x", Tensor::scalar(1.0));
    params.add("y", Tensor::scalar(2.0));
    let message = panic_of(|| assert_ne!(params.add("x", Tensor::zeros(&[2])), x));
    assert_eq!(message, "there is already a parameter `x`");
    assert_eq!((params.find("x"), params.len(), params.names().len()), (Some(x), 2, 2));
    assert_eq!(params.get(x).item(), 1.0);
    // What is added next has the place that its handle says.
    let z = params.add("z", Tensor::scalar(3.0));
    assert_eq!((params.find("z"), params.get(z).item(), params.name(z)), (Some(z), 3.0, "z"));
}

#[test]
fn stores_that_do_not_fit_change_nothing() {
    let store = |a: f32, b: &[usize]| {
        let mut params = Params::new();
        params.add("a", Tensor::scalar(a));
        params.add("b", Tensor::zeros(b));
        params
    };
    let (mut params, mut other) = (store(1.0, &[2]), store(7.0, &[3]));
    other.freeze(|_| true);
    for f in [(|params, other| Params::assign(params, other)) as fn(&mut Params<f32>, &Params<f32>), Params::inherit] {
        let message = panic_of(|| f(&mut params, &other));
        assert!(message.contains("two parameters `b`"), "{message}");
        assert_eq!((params.values()[0].item(), params.trainable_elements()), (1.0, 3), "all as before");
    }
}
