//! What all optimizers have in common: forms of gradients, frozen and lazy parameters, states, limits, ranges.

use rand::{Rng, RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Gradient, Pool, RowGrad, RowShare, RowSums, Scalar, SparseGrad, Tape, Tensor, Var};
use raygrad_nn::{
    Adam, AdamConfig, AdamW, Bound, Ema, NonFinite, Optimizer, OptimizerState, ParamId, Params, Sgd, SgdConfig,
};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

type Make<T> = fn() -> Box<dyn Optimizer<T>>;

/// All optimizers, under names for messages.
fn optimizers<T: Scalar>() -> [(&'static str, Make<T>); 6] {
    const NESTEROV: SgdConfig = SgdConfig { momentum: 0.75, nesterov: true, weight_decay: 0.01 };
    [
        ("plain", || Box::new(Sgd::new(SgdConfig::default()))),
        ("momentum", || Box::new(Sgd::new(SgdConfig { nesterov: false, ..NESTEROV }))),
        ("nesterov", || Box::new(Sgd::new(NESTEROV))),
        ("adam", || Box::new(Adam::new(AdamConfig::default()))),
        ("table", || Box::new(Adam::new(AdamConfig { beta2: 0.99, eps: 1e-15, ..AdamConfig::default() }))),
        ("adamw", || Box::new(AdamW::new(AdamConfig::default(), 0.1))),
    ]
}

fn random<T: Scalar>(shape: &[usize], rng: &mut impl Rng) -> Tensor<T> {
    Tensor::from_fn(shape, |_| T::from_f64(rng.random::<f64>() - 0.5))
}

fn bits<T: Scalar>(params: &Params<T>) -> Vec<u64> {
    params.values().iter().flat_map(Tensor::as_slice).map(|x| x.to_f64().to_bits()).collect()
}

/// A table, a vector and a number.
fn model<T: Scalar>(lazy: bool) -> (Params<T>, [ParamId; 3]) {
    let mut rng = Pcg64Mcg::seed_from_u64(3);
    let mut params = Params::new();
    let ids = [("table", &[40, 3][..]), ("vector", &[3]), ("number", &[])]
        .map(|(name, shape)| params.add(name, random(shape, &mut rng)));
    params.set_lazy(|name| name == "table", lazy);
    (params, ids)
}

/// A loss of a few rows of the table, some of them twice; with `dense`, of its other elements too.
fn loss<'t, T: Scalar>(bound: &Bound<'t, T>, ids: [ParamId; 3], step: usize, dense: bool) -> Var<'t, T> {
    let [table, vector, number] = ids.map(|id| &bound[id]);
    let rows: Arc<[u32]> = [step % 40, (step * 7 + 3) % 40, step % 40, 11].map(|row| row as u32).into();
    let used = (table.gather_rows(&rows) * vector).sin().sum() + table.gather_rows([11]).square().sum();
    let sum = used * number + number.square();
    if dense { sum + table.square().sum() * 0.01 } else { sum }
}

/// The gradients of that loss.
fn gradients<T: Scalar>(params: &Params<T>, ids: [ParamId; 3], step: usize, dense: bool) -> Vec<Gradient<T>> {
    let tape = Tape::new();
    let bound = params.bind(&tape);
    let loss = loss(&bound, ids, step, dense);
    bound.backward(&loss)
}

/// A step of training; returns how many elements were moved.
fn train<T: Scalar>(
    optimizer: &mut dyn Optimizer<T>,
    params: &mut Params<T>,
    ids: [ParamId; 3],
    step: usize,
    dense: bool,
) -> Result<usize, NonFinite> {
    let grads = gradients(params, ids, step, dense);
    optimizer.update(params, &grads, 0.05).check()
}

#[test]
fn a_sparse_gradient_gives_exactly_the_dense_result() {
    for (name, make) in optimizers::<f32>() {
        let (mut sparse, ids) = model::<f32>(false);
        let mut dense = sparse.clone();
        let (mut one, mut other) = (make(), make());
        for step in 0..30 {
            let with_penalty = step % 4 == 3;
            let grads = gradients(&sparse, ids, step, with_penalty);
            assert!(grads[0].sparse().len() == 2 && grads[0].dense().is_some() == with_penalty);
            let added: Vec<_> = grads.iter().map(|grad| grad.clone().into_dense(&Pool::none()).into()).collect();
            let moved = one.update(&mut sparse, &grads, 0.05).check();
            assert_eq!(moved, Ok(124));
            assert_eq!(moved, other.update(&mut dense, &added, 0.05).check());
            assert_eq!(bits(&sparse), bits(&dense), "{name}: step {step}");
        }
    }
}

#[test]
fn lazy_table_moves_rows_of_any_gradient_form() {
    for (name, make) in optimizers::<f64>() {
        let (mut rows, ids) = model::<f64>(true);
        let (mut whole, mut eager) = (rows.clone(), rows.clone());
        eager.set_lazy(|_| true, false);
        let [mut one, mut other, mut third] = [make(), make(), make()];
        for step in 0..30 {
            let before = rows.get(ids[0]).clone();
            let grads = gradients(&rows, ids, step, false);
            let dense: Vec<_> = grads.iter().map(|grad| grad.clone().into_dense(&Pool::none()).into()).collect();
            let used = 3 - usize::from(step % 40 == 11 || (step * 7 + 3) % 40 == 11 || step == (step * 7 + 3) % 40);
            assert_eq!(one.update(&mut rows, &grads, 0.05).check(), Ok(3 * used + 4), "{name}: step {step}");
            assert_eq!(other.update(&mut whole, &dense, 0.05).check(), Ok(3 * used + 4), "{name}: step {step}");
            let moved = |row: usize| rows.get(ids[0]).as_slice()[3 * row..][..3] != before.as_slice()[3 * row..][..3];
            assert_eq!((0..40).filter(|&row| moved(row)).count(), used, "{name}: step {step}");
            train(&mut *third, &mut eager, ids, step, false).unwrap();
        }
        let close = |a: &Params<f64>, b: &Params<f64>| {
            let pairs = a.values().iter().flat_map(Tensor::as_slice).zip(b.values().iter().flat_map(Tensor::as_slice));
            pairs.map(|(a, b)| (a - b).abs()).all(|error| error <= 1e-12)
        };
        assert!(close(&rows, &whole), "{name}");
        // What rests without momentum and decay rests lazily too.
        assert_eq!(close(&rows, &eager), name == "plain", "{name}");
    }
}

#[test]
fn a_penalty_on_a_lazy_table_visits_every_row() {
    for (name, make) in optimizers::<f64>() {
        let (mut params, ids) = model::<f64>(true);
        let mut optimizer = make();
        for step in 0..10 {
            let moved = train(&mut *optimizer, &mut params, ids, step, step == 4).unwrap();
            assert_eq!(moved == 124, step == 4, "{name}: {moved} at step {step}");
        }
    }
}

#[test]
fn lazy_table_with_full_gradient_equals_eager() {
    for (name, make) in optimizers::<f64>() {
        let (mut lazy, ids) = model::<f64>(true);
        let mut eager = lazy.clone();
        eager.set_lazy(|_| true, false);
        let [mut one, mut other] = [make(), make()];
        for step in 0..30 {
            train(&mut *one, &mut lazy, ids, step, true).unwrap();
            train(&mut *other, &mut eager, ids, step, true).unwrap();
        }
        for (a, b) in lazy.values().iter().zip(eager.values()) {
            assert!(a.allclose(b, 1e-11, 1e-12), "{name}: {a} and {b}");
        }
    }
}

/// A state survives its file.
fn stored<T: Scalar>(state: &OptimizerState<T>) -> OptimizerState<T> {
    let read = OptimizerState::from_safetensors(&state.to_safetensors().unwrap()).unwrap();
    assert_eq!(read, *state);
    read
}

fn a_run_goes_on_from_its_state_bit_for_bit<T: Scalar>() {
    for (name, make) in optimizers::<T>() {
        for lazy in [false, true] {
            let (mut through, ids) = model::<T>(lazy);
            let mut halted = through.clone();
            // One of them is not moved before the pause.
            let step = |params: &mut Params<T>, optimizer: &mut dyn Optimizer<T>, step: usize| {
                params.freeze(|name| name == "vector");
                params.unfreeze(|_| step >= 8);
                let grads = gradients(params, ids, step, step % 5 == 2);
                optimizer.update(params, &grads, 0.05).check().unwrap();
            };
            let mut whole = make();
            (0..20).for_each(|t| step(&mut through, &mut *whole, t));
            let mut first = make();
            (0..10).for_each(|t| step(&mut halted, &mut *first, t));
            let state = stored(&first.state(&halted));
            let mut second = make();
            second.load_state(&halted, &state).unwrap();
            assert_eq!(second.state(&halted), state, "{name}, lazy: {lazy}");
            (10..20).for_each(|t| step(&mut halted, &mut *second, t));
            assert_eq!(bits(&halted), bits(&through), "{name}, lazy: {lazy}");
            assert_eq!(second.state(&halted), whole.state(&through), "{name}, lazy: {lazy}");
            // A fresh optimizer would have done something else, if there is anything to remember.
            assert_eq!(state.tensors.is_empty(), name == "plain");
        }
    }
}

#[test]
fn runs_in_f32_go_on_bit_for_bit() {
    a_run_goes_on_from_its_state_bit_for_bit::<f32>();
}

#[test]
fn runs_in_f64_go_on_bit_for_bit() {
    a_run_goes_on_from_its_state_bit_for_bit::<f64>();
}

#[test]
fn averages_go_on_bit_for_bit() {
    let (mut params, _) = model::<f32>(false);
    let mut whole = Ema::new(&params, 0.99).with_warmup();
    let mut second = whole.clone();
    let mut next = |ema: &mut Ema<f32>, t: i32| {
        params.values_mut().iter_mut().for_each(|x| x.as_mut_slice().fill(t as f32));
        assert_eq!(ema.update(&params), 0);
    };
    (0..10).for_each(|t| next(&mut whole, t));
    second.load_state(&stored(&whole.state())).unwrap();
    (10..20).for_each(|t| [&mut whole, &mut second].into_iter().for_each(|ema| next(ema, t)));
    assert_eq!(bits(whole.params()), bits(second.params()));
}

#[test]
fn optimizer_state_of_other_shape_is_refused() {
    let (mut params, ids) = model::<f32>(true);
    let mut adam = Adam::new(AdamConfig::default());
    for step in 0..3 {
        train(&mut adam, &mut params, ids, step, false).unwrap();
    }
    let good = adam.state(&params);
    type Change = fn(&mut OptimizerState<f32>);
    let changes: [(Change, &str); 6] = [
        (|s| drop(s.tensors.remove("vector.first")), "`vector.first` is missing"),
        (|s| drop(s.counts.remove("steps")), "`steps` is missing"),
        (|s| drop(s.counts.remove("vector.step")), "`vector.first` is unknown"),
        (|s| drop(s.counts.insert("table.row_steps".into(), vec![1; 3])), "`table.row_steps` has 3 counts, and not 40"),
        (|s| drop(s.tensors.insert("number.second".into(), Tensor::zeros(&[1]))), "has the shape [1], and not []"),
        (|s| drop(s.tensors.insert("stranger.first".into(), Tensor::zeros(&[1]))), "`stranger.first` is unknown"),
    ];
    for (change, expected) in changes {
        let mut state = good.clone();
        change(&mut state);
        let message = adam.load_state(&params, &state).unwrap_err().to_string();
        assert!(message.contains(expected), "{message} and {expected}");
        assert_eq!(adam.state(&params), good);
    }
    let error = Sgd::new(SgdConfig::default()).load_state(&params, &good).unwrap_err().to_string();
    assert!(error.contains("the state belongs to another optimizer"), "{error}");
    assert!(OptimizerState::<f64>::from_safetensors(&good.to_safetensors().unwrap()).is_err());
}

#[test]
fn frozen_parameters_rest_others_have_own_lr() {
    for (name, make) in optimizers::<f64>() {
        let (mut params, ids) = model::<f64>(false);
        params.set_lr_scale(|name| name == "vector", 0.5);
        params.set_weight_decay_scale(|_| true, 0.0);
        let mut other = params.clone();
        other.freeze(|name| name == "table");
        let start = params.clone();
        let (mut one, mut two) = (make(), make());
        assert_eq!(train(&mut *one, &mut params, ids, 0, true), Ok(124));
        assert_eq!(train(&mut *two, &mut other, ids, 0, true), Ok(4));
        assert_eq!(start.get(ids[0]), other.get(ids[0]), "{name}");
        assert_ne!(start.get(ids[0]), params.get(ids[0]), "{name}");
        // Half of the rate is half of the way, of the first step.
        let way = |params: &Params<f64>| params.get(ids[1]).as_slice()[0] - start.get(ids[1]).as_slice()[0];
        other.assign(&start);
        other.set_lr_scale(|_| true, 1.0);
        train(&mut *make(), &mut other, ids, 0, true).unwrap();
        assert!((way(&params) / way(&other) - 0.5).abs() < 1e-12, "{name}");
    }
}

/// Numbers that f32 cannot hold are nothing special in f64.
#[test]
fn small_numbers_of_f64_are_kept() {
    let once = |optimizer: &mut dyn Optimizer<f64>, x: f64, g: f64| {
        let mut params = Params::new();
        let id = params.add("x", Tensor::scalar(x));
        optimizer.update(&mut params, &[Tensor::scalar(g).into()], 1.0).check().unwrap();
        params.get(id).item()
    };
    let momentum = SgdConfig { momentum: 0.9, ..SgdConfig::default() };
    assert_eq!(once(&mut Sgd::new(momentum), 0.0, 1e-40), -1e-40);
    assert_eq!(once(&mut Sgd::new(SgdConfig { weight_decay: 0.5, ..SgdConfig::default() }), 1e-40, 0.0), 0.5e-40);
    assert_eq!(once(&mut AdamW::new(AdamConfig::default(), 0.5), 1e-40, 0.0), 0.5e-40);
    let config = AdamConfig { eps: 1e-30, ..AdamConfig::default() };
    let expected = -1e-35 / (1e-35 + 1e-30);
    assert!((once(&mut Adam::new(config), 0.0, 1e-35) / expected - 1.0).abs() < 1e-12);
    let mut params = Params::new();
    params.add("table", Tensor::zeros(&[2, 1]));
    params.set_lazy(|_| true, true);
    let grad = Tensor::from_vec(&[2, 1], vec![0.0, 1e-35]).into();
    assert_eq!(Adam::new(config).update(&mut params, &[grad], 1.0).check(), Ok(1));
    let table = params.values()[0].as_slice();
    assert!(table[0] == 0.0 && (table[1] / expected - 1.0).abs() < 1e-12);
}

fn message(f: impl FnOnce()) -> String {
    let error = catch_unwind(AssertUnwindSafe(f)).expect_err("refused");
    let words = error.downcast_ref::<&str>().map(|words| (*words).to_owned());
    words.or_else(|| error.downcast_ref::<String>().cloned()).unwrap_or_default()
}

#[test]
fn settings_out_of_their_range_are_refused_by_name() {
    let adam = AdamConfig::default();
    for (config, expected) in [
        (AdamConfig { beta1: 1.0, ..adam }, "`beta1` is 1.0; use 0 to 1 - 2^-"),
        (AdamConfig { beta2: 2.0, ..adam }, "`beta2` is 2.0;"),
        (AdamConfig { beta2: f64::NAN, ..adam }, "`beta2` is NaN;"),
        (AdamConfig { eps: 0.0, ..adam }, "`eps` is 0.0; use 1e-"),
    ] {
        for message in [
            message(|| drop(Adam::<f32>::new(config))),
            message(|| drop(AdamW::new::<f64>(config, 0.0))),
            message(|| assert_eq!(Adam::new(adam).add_group(&Params::<f32>::new(), |_| true, config, 0.0), 0)),
            config.check::<f32>().unwrap_err().to_string(),
        ] {
            assert!(message.contains(expected), "{message} and {expected}");
        }
    }
    assert!(message(|| drop(AdamW::new::<f32>(adam, -1.0))).contains("`decay` is -1.0; use 0 to 1e30"));
    let sgd = SgdConfig::default();
    for (config, expected) in [
        (SgdConfig { momentum: 1.0, ..sgd }, "`momentum` is 1.0; use 0 to 1 - 2^-"),
        (SgdConfig { nesterov: true, ..sgd }, "`momentum` is 0.0; use more than 0 to look ahead"),
        (SgdConfig { weight_decay: f64::INFINITY, ..sgd }, "`weight_decay` is inf;"),
    ] {
        assert!(message(|| drop(Sgd::<f32>::new(config))).contains(expected), "{config:?}");
    }
    let (mut params, ids) = model::<f32>(false);
    let grads = gradients(&params, ids, 0, false);
    let mut update = |grads: &[Gradient<f32>], rate| {
        message(|| drop(Adam::new(AdamConfig::default()).update(&mut params, grads, rate)))
    };
    for rate in [1e300, -1e-3, f64::NAN] {
        assert!(update(&grads, rate).contains(&format!("a learning rate of {rate:?}; use 0 to 1e30")));
    }
    assert!(update(&grads[1..], 0.1).contains("one gradient for each parameter that is not frozen"));
    let swapped = [grads[1].clone(), grads[0].clone(), grads[2].clone()];
    assert!(update(&swapped, 0.1).contains("the gradient of `table` has its shape"));
    assert!(message(|| assert_eq!(params.set_lr_scale(|_| true, -1.0), 0)).contains("a learning rate times -1"));
}

#[test]
fn a_lazy_parameter_stays_so() {
    let (mut params, ids) = model::<f32>(true);
    let mut adam = Adam::new(AdamConfig::default());
    train(&mut adam, &mut params, ids, 0, false).unwrap();
    params.set_lazy(|_| true, false);
    let grads = gradients(&params, ids, 1, false);
    assert!(message(|| drop(adam.update(&mut params, &grads, 0.1))).contains("`table` was lazy until now"));
    // What is remembered is saved as what it is, whatever the flag says now.
    let state = adam.state(&params);
    assert!(adam.clone().load_state(&params, &state).is_err());
    params.set_lazy(|name| name == "table", true);
    adam.load_state(&params, &state).unwrap();
    let (mut params, mut adam) = (Params::<f32>::new(), Adam::new(AdamConfig::default()));
    let x = params.add("x", Tensor::zeros(&[4, 2]));
    params.set_lazy(|_| true, true);
    adam.update(&mut params, &[Tensor::ones(&[4, 2]).into()], 0.1).check().unwrap();
    *params.get_mut(x) = Tensor::zeros(&[2, 4]);
    let grads = [Tensor::ones(&[2, 4]).into()];
    assert!(message(|| drop(adam.update(&mut params, &grads, 0.1))).contains("`x` has 2 rows, and had 4"));
}

/// A gradient of four rows of one feature in two parts, which puts sums of its own in the place of those it is given.
struct Replaced {
    rows: usize,
}

impl SparseGrad<f32> for Replaced {
    fn shape(&self) -> &[usize] {
        &[4, 1]
    }
    fn add_to(&self, _: &mut Tensor<f32>) {}
    fn as_rows(&self) -> Option<&dyn RowShare<f32>> {
        Some(self)
    }
}

impl RowShare<f32> for Replaced {
    fn scatter(&self, sums: &mut RowSums<f32>) {
        *sums = RowSums::new(self.rows, 1);
        sums.add(self.rows - 1, &[1.0]);
    }
    fn parts(&self) -> Vec<usize> {
        vec![2, 2]
    }
}

#[test]
fn row_share_replaced_sums_panic() {
    let mut params = Params::<f32>::new();
    params.add("table", Tensor::zeros(&[4, 1]));
    params.set_lazy(|_| true, true);
    let mut update = |rows: usize, optimizer: &mut dyn Optimizer<f32>| {
        let mut grad = Gradient::zero(&[4, 1]);
        grad.add_sparse(Arc::new(Replaced { rows }));
        message(|| drop(optimizer.update(&mut params, &[grad], 0.1)))
    };
    // Parts of two rows; the sums of three reach into the second part.
    assert!(update(3, &mut Adam::new(AdamConfig::default())).contains("rows and features of part"));
    assert!(update(5, &mut Sgd::new(SgdConfig::default())).contains("rows and features of part 0 of `table`"));
}

#[test]
fn a_panic_leaves_nothing_for_the_next_step() {
    /// Adds a share to row 0, and panics where it is told to.
    struct Panics(bool);
    impl SparseGrad<f32> for Panics {
        fn shape(&self) -> &[usize] {
            &[2, 1]
        }
        fn add_to(&self, _: &mut Tensor<f32>) {}
        fn as_rows(&self) -> Option<&dyn RowShare<f32>> {
            Some(self)
        }
    }
    impl RowShare<f32> for Panics {
        fn scatter(&self, sums: &mut RowSums<f32>) {
            sums.add(0, &[1.0]);
            assert!(!self.0, "half-way");
        }
    }
    let grad = |share: Arc<dyn SparseGrad<f32>>| {
        let mut grad = Gradient::zero(share.shape());
        grad.add_sparse(share);
        [grad]
    };
    for (name, make) in optimizers::<f32>() {
        let run = |panics: bool| {
            let mut params = Params::<f32>::new();
            params.add("table", Tensor::ones(&[2, 1]));
            params.set_lazy(|_| true, true);
            let mut optimizer = make();
            for _ in 0..3 {
                if panics {
                    let update = || drop(optimizer.update(&mut params, &grad(Arc::new(Panics(true))), 0.1));
                    assert!(message(update).contains("half-way"));
                }
                optimizer.update(&mut params, &grad(Arc::new(Panics(false))), 0.1).check().unwrap();
            }
            bits(&params)
        };
        assert_eq!(run(true), run(false), "{name}");
    }
    // Nor do sums of another size that were refused.
    let mut params = Params::<f32>::new();
    params.add("table", Tensor::zeros(&[4, 1]));
    params.set_lazy(|_| true, true);
    for (_, make) in optimizers::<f32>() {
        let mut optimizer = make();
        let refused = message(|| drop(optimizer.update(&mut params, &grad(Arc::new(Replaced { rows: 5 })), 0.1)));
        assert!(refused.contains("rows and features of"), "{refused}");
        let honest = RowGrad::new(&[4, 1], [3].into(), Tensor::ones(&[1, 1]));
        optimizer.update(&mut params, &grad(Arc::new(honest)), 0.1).check().unwrap();
    }
}

#[test]
fn update_gradient_of_other_shape_moves_nothing() {
    for (name, make) in optimizers::<f32>() {
        let mut params = Params::<f32>::new();
        params.add("a", Tensor::scalar(1.0));
        params.add("b", Tensor::zeros(&[2]));
        let (mut optimizer, before) = (make(), bits(&params));
        let grads = [Gradient::from(Tensor::scalar(1.0)), Gradient::from(Tensor::ones(&[3]))];
        let refused = message(|| drop(optimizer.update(&mut params, &grads, 0.1)));
        assert!(refused.contains("the gradient of `b` has its shape"), "{name}: {refused}");
        assert_eq!(bits(&params), before, "{name}");
        assert_eq!(optimizer.state(&params), make().state(&params), "{name}: no step was counted");
    }
}

#[test]
fn sparse_gradient_of_another_shape_panics() {
    /// Puts another tensor in the place of the one that it is to be added to.
    struct Other(bool);
    impl SparseGrad<f32> for Other {
        fn shape(&self) -> &[usize] {
            &[4]
        }
        fn add_to(&self, dense: &mut Tensor<f32>) {
            *dense = Tensor::ones(&[2]);
        }
        fn is_passing(&self) -> bool {
            self.0
        }
    }
    let mut grad = Gradient::zero(&[4]);
    grad.add_sparse(Arc::new(Other(false)));
    let mut params = Params::<f32>::new();
    params.add("x", Tensor::zeros(&[4]));
    let refused = message(|| drop(Sgd::new(SgdConfig::default()).update(&mut params, &[grad], 0.1)));
    assert!(refused.contains("the shape of a gradient after `SparseGrad::add_to`"), "{refused}");
}

#[test]
fn load_state_lazy_and_not_lazy_is_an_error() {
    for (lazy, expected) in [
        (true, "`table.row_steps` belongs to a lazy parameter, and this one is not: call Params::set_lazy as before"),
        (
            false,
            "`table.step` belongs to a parameter that was not lazy, and this one is: call Params::set_lazy as before",
        ),
    ] {
        let (mut params, ids) = model::<f32>(lazy);
        let [mut first, mut second] = [(); 2].map(|()| Adam::new(AdamConfig::default()));
        train(&mut first, &mut params, ids, 0, false).unwrap();
        let state = first.state(&params);
        params.set_lazy(|name| name == "table", !lazy);
        assert_eq!(second.load_state(&params, &state).unwrap_err().to_string(), expected);
        // Nothing has changed: it takes its first step.
        assert_eq!(second.steps(), 0);
        train(&mut second, &mut params, ids, 0, false).unwrap();
        params.set_lazy(|name| name == "table", lazy);
        second.load_state(&params, &state).unwrap();
        train(&mut second, &mut params, ids, 1, false).unwrap();
    }
    // A lazy parameter without elements moves as others do.
    let mut params = Params::<f32>::new();
    params.add("empty", Tensor::zeros(&[0, 3]));
    params.set_lazy(|_| true, true);
    let mut adam = Adam::new(AdamConfig::default());
    adam.update(&mut params, &[Gradient::from(Tensor::zeros(&[0, 3]))], 0.1).check().unwrap();
    let state = adam.state(&params);
    Adam::new(AdamConfig::default()).load_state(&params, &state).unwrap();
}

#[test]
fn state_of_impossible_size_is_an_error() {
    let file = |dtype: &str, shape: &str, data: &[u8]| {
        let mut header =
            format!(r#"{{"x.first":{{"dtype":"{dtype}","shape":{shape},"data_offsets":[0,{}]}}}}"#, data.len());
        header.extend(std::iter::repeat_n(' ', header.len().next_multiple_of(8) - header.len()));
        [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), data].concat()
    };
    // Extents whose product is beyond every number, and 0 all the same.
    for shape in ["[0,9223372036854775808,2]", "[4294967296,0,4294967296]"] {
        let error = OptimizerState::<f32>::from_safetensors(&file("F32", shape, &[])).unwrap_err().to_string();
        assert!(error.starts_with("`x.first` has shape [") && error.ends_with("which is too large"), "{error}");
    }
    for (dtype, shape) in [("F32", "[9223372036854775808,2,0]"), ("U64", "[9223372036854775808,2]")] {
        assert!(OptimizerState::<f32>::from_safetensors(&file(dtype, shape, &[])).is_err(), "{dtype} {shape}");
    }
    assert!(OptimizerState::<f32>::from_safetensors(&file("F32", "[0,4294967296]", &[])).is_ok());
}

#[test]
fn states_that_cannot_be_stored_are_errors() {
    let mut state = OptimizerState::<f32>::default();
    state.tensors.insert("x".into(), Tensor::zeros(&[1]));
    assert!(state.to_safetensors().is_ok());
    state.counts.insert("x".into(), vec![1]);
    let expected = "`x` is there twice, or has a name of the format's own";
    assert_eq!(state.to_safetensors().unwrap_err().to_string(), expected);
}

#[test]
fn steps_count_no_further_than_their_numbers() {
    let mut params = Params::<f32>::new();
    params.add("x", Tensor::scalar(1.0));
    let mut adam = Adam::new(AdamConfig::default());
    let grads = [Gradient::from(Tensor::scalar(1.0))];
    adam.update(&mut params, &grads, 0.1).check().unwrap();
    let mut state = adam.state(&params);
    state.counts.values_mut().for_each(|counts| counts.fill(u64::MAX));
    adam.load_state(&params, &state).unwrap();
    assert_eq!(adam.update(&mut params, &grads, 0.1).check(), Ok(1));
    assert_eq!(adam.steps(), u64::MAX);
    let mut ema = Ema::new(&params, 0.5);
    let mut state = ema.state();
    state.counts.values_mut().for_each(|counts| counts.fill(u64::MAX));
    ema.load_state(&state).unwrap();
    ema.update(&params);
    assert_eq!(ema.state().counts["steps"], [u64::MAX]);
    params.set_lazy(|_| true, true);
    let mut adam = Adam::new(AdamConfig::default());
    adam.update(&mut params, &grads, 0.1).check().unwrap();
    let mut state = adam.state(&params);
    state.counts.values_mut().for_each(|counts| counts.fill(u64::MAX));
    adam.load_state(&params, &state).unwrap();
    assert_eq!(adam.update(&mut params, &grads, 0.1).check(), Ok(1));
}

#[test]
fn bad_elements_rest_alone_lazy_or_not() {
    for ((name, make), lazy) in optimizers::<f32>().into_iter().flat_map(|each| [(each, true), (each, false)]) {
        let (mut params, ids) = model::<f32>(lazy);
        let before = params.get(ids[0]).clone();
        let rows = Tensor::from_vec(&[2, 3], vec![1.0, f32::NAN, 1.0, 1.0, 2.0, f32::NEG_INFINITY]);
        let mut table = Gradient::zero(&[40, 3]);
        table.add_sparse(Arc::new(RowGrad::new(&[40, 3], [5, 6].into(), rows)));
        let grads = [table, Gradient::zero(&[3]), Gradient::zero(&[])];
        let report = make().update(&mut params, &grads, 0.1);
        let moved = if lazy { 4 } else { 118 };
        assert_eq!(
            (report.updated, report.skipped, report.non_finite),
            (moved, 2, vec![("table".to_owned(), 2)]),
            "{name}"
        );
        let (after, before) = (params.get(ids[0]).as_slice(), before.as_slice());
        let stays = |i: &usize| after[*i].to_bits() == before[*i].to_bits();
        assert_eq!((15..21).filter(stays).collect::<Vec<_>>(), [16, 20], "{name}, lazy: {lazy}");
    }
}

#[test]
fn groups_have_constants_rates_and_decay_of_their_own() {
    let (start, ids) = model::<f64>(true);
    let fast = AdamConfig { beta1: 0.5, beta2: 0.9, ..AdamConfig::default() };
    let rates = [0.05, 0.1, 0.02];
    let mut params = start.clone();
    let mut adam = Adam::new(AdamConfig::default());
    // Each parameter is in the first group that chooses it; one that is chosen by none has the optimizer's constants.
    assert_eq!(adam.add_group(&params, |name| name == "table", fast, 0.0), 1);
    assert_eq!(adam.add_group(&params, |name| name != "number", fast, 0.5), 1);
    let alone = [(fast, 0.0, 1), (fast, 0.5, 2), (AdamConfig::default(), 0.0, 0)];
    let mut others = alone.map(|(config, decay, group)| (AdamW::new(config, decay), start.clone(), rates[group]));
    for step in 0..20 {
        // All see the same gradients.
        let grads = gradients(&start, ids, step, false);
        assert!(adam.update_groups(&mut params, &grads, |group| rates[group]).check().is_ok());
        for (adam, params, rate) in &mut others {
            adam.update(params, &grads, *rate).check().unwrap();
        }
    }
    for ((_, other, _), id) in others.iter().zip(ids) {
        assert_eq!(params.get(id), other.get(id), "{}", params.name(id));
    }
    assert_eq!(adam.steps(), 20);
    let grads = gradients(&start, ids, 0, false);
    let refused = message(|| drop(adam.update_groups(&mut params, &grads, |group| [0.1, 0.1, -1.0][group])));
    assert!(refused.contains("a learning rate of -1.0; use 0 to 1e30"), "{refused}");
}

/// A step of training leaves every parameter where it is in memory; with something that holds one, it is copied.
#[test]
fn a_step_copies_no_parameter() {
    for (name, make) in optimizers::<f32>() {
        let (mut params, ids) = model::<f32>(false);
        let mut optimizer = make();
        let places = |params: &Params<f32>| params.values().iter().map(|x| x.as_slice().as_ptr()).collect::<Vec<_>>();
        let start = places(&params);
        for step in 0..3 {
            let tape = Tape::new();
            let bound = params.bind(&tape);
            let loss = loss(&bound, ids, step, true);
            // A second use of the parameters that has no part in the loss is recorded too.
            let metric = (&bound[ids[0]] * &bound[ids[1]]).exp().sum();
            let grads = bound.backward(&loss);
            optimizer.update(&mut params, &grads, 0.05).check().unwrap();
            assert!(metric.item().is_finite() && loss.item().is_finite());
            assert_eq!(places(&params)[..2], start[..2], "{name}: step {step}");
        }
        let held = params.get(ids[0]).clone();
        train(&mut *optimizer, &mut params, ids, 3, true).unwrap();
        assert_ne!(places(&params)[0], start[0], "{name}");
        assert_ne!(held, *params.get(ids[0]));
    }
}

#[test]
fn optimizer_invalid_input_is_refused() {
    let panics = |f: &dyn Fn()| assert!(catch_unwind(AssertUnwindSafe(f)).is_err());
    let store = |name: &str, shape: &[usize]| {
        let mut params = Params::<f32>::new();
        params.add(name, Tensor::zeros(shape));
        params
    };
    panics(&|| store("x", &[2]).assign(&store("y", &[2])));
    panics(&|| store("x", &[2]).assign(&store("x", &[3])));
    panics(&|| assert_eq!(store("x", &[2]).set_weight_decay_scale(|_| true, -1.0), 1));
    panics(&|| drop(store("x", &[2]).layout().bind(Vec::<Var<'_, f32>>::new())));
    let grads = || [Gradient::from(Tensor::<f32>::zeros(&[1]))];
    panics(&|| assert_eq!(raygrad_nn::clip_value(&mut grads(), f64::NAN), 0));
    panics(&|| assert!(raygrad_nn::clip_norm(&mut grads(), -1.0).norm >= 0.0));
    // A frozen store has no gradients, a bound constant none either.
    let mut params = store("x", &[2]);
    params.freeze(|_| true);
    let tape = Tape::new();
    let bound = params.bind(&tape);
    let loss = tape.leaf(Tensor::scalar(1.0)).square();
    assert!(bound.backward(&loss).is_empty());
    assert!(params.bind_constant(&tape).vars().is_empty());
}

#[test]
fn averages_that_cannot_go_on_stay_as_they_are() {
    let mut params = Params::<f64>::new();
    params.add("x", Tensor::from([1.0, 2.0]));
    let mut ema = Ema::new(&params, 0.5);
    params.values_mut()[0] = Tensor::from([3.0, 4.0]);
    ema.update(&params);
    let state = ema.state();
    let mut stranger = state.clone();
    stranger.counts.insert("steps".into(), vec![77]);
    stranger.tensors.insert("y.average".into(), Tensor::zeros(&[1]));
    assert!(ema.load_state(&stranger).is_err());
    assert_eq!(ema.state(), state);
}

#[test]
fn dense_gradient_reaches_optimizer_uncopied() {
    let mut params = Params::<f32>::new();
    params.add("x", Tensor::from([1.0, 2.0]));
    let dense = [Gradient::from(Tensor::from([3.0, 4.0]))];
    let part = params.updates(&dense, |_| 0.1).next().unwrap();
    assert!(matches!(part.dense_grad(&Pool::none()), std::borrow::Cow::Borrowed(_)));
    let mut rows = Gradient::zero(&[2]);
    rows.add_sparse(Arc::new(RowGrad::new(&[2], [1].into(), Tensor::from([5.0]))));
    let rows = [rows];
    let part = params.updates(&rows, |_| 0.1).next().unwrap();
    assert_eq!(part.dense_grad(&Pool::none()).into_owned(), Tensor::from([0.0, 5.0]));
}
