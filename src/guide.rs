//! A guide: from a first gradient to a custom operation and a trained model.
//!
//! # A gradient
//!
//! A [`Tape`](crate::Tape) writes down what is done with its variables, and a gradient reads that backwards. A *leaf* is
//! what gradients are taken by; a *constant* is not. Arithmetic broadcasts as in NumPy.
//!
//! ```
//! use raygrad::{Tape, Tensor};
//! let tape = Tape::<f64>::new();
//! let x = tape.leaf(Tensor::from([1.0, 2.0, 3.0]));
//! let y = (0.5 * x.square()).sum();
//! assert_eq!(y.item(), 7.0);
//! assert_eq!(y.grad(&[&x])[0], [1.0, 2.0, 3.0]);
//! ```
//!
//! Tapes share no state: any number of them run on any threads, and a tape's memory goes with it. An operation on large
//! tensors uses all of rayon's threads (`RAYON_NUM_THREADS` sets how many), or those of the caller's own pool in
//! `ThreadPool::install`; inside [`parallel::serial`](crate::tensor::parallel::serial) it keeps to its thread.
//!
//! # Gradients of gradients
//!
//! [`Var::grad_graph`](crate::Var::grad_graph) puts the gradient itself on the tape, so that it can be part of a loss or
//! be differentiated again.
//!
//! ```
//! use raygrad::{Tape, Tensor};
//! let tape = Tape::<f64>::new();
//! let x = tape.leaf(Tensor::scalar(2.0));
//! let y = x.powi(4);
//! let slope = &y.grad_graph(&[&x])[0]; // 4 x^3
//! let penalty = (slope - 30.0).square();
//! assert_eq!(penalty.grad(&[&x])[0].item(), 192.0); // 2 (4 x^3 - 30) 12 x^2
//! ```
//!
//! For a function rather than a graph, [`derivatives`](crate::derivatives) has what is usually wanted: value and
//! gradient, products with the Jacobian from either side, Jacobian, Hessian and products with it.
//!
//! ```
//! use raygrad::{Tensor, derivatives::hvp};
//! let x = Tensor::from([3.0, -1.0]);
//! let v = Tensor::from([1.0, 0.0]);
//! let product = hvp(|x| x[0].powi(3).sum(), &[x], &[v]); // the Hessian is diag(6 x)
//! assert_eq!(product[0], [18.0, 0.0]);
//! ```
//!
//! # What goes wrong, and how one hears of it
//!
//! A wrong shape says which operation, which shapes and where it was called, as a panic. Where it should be an error
//! instead, [`Tape::try_run`](crate::Tape::try_run) runs any code out of ordinary methods and operators and gives the first
//! error, [`Tape::try_apply`](crate::Tape::try_apply) runs a single operation, and every kind of gradient has a form that
//! begins with `try_`.
//!
//! ```
//! use raygrad::{Error, Tape, Tensor};
//! let tape = Tape::<f64>::new();
//! let (x, w) = (tape.leaf(Tensor::ones(&[4, 3])), tape.leaf(Tensor::ones(&[5, 2])));
//! let loss = tape.try_run(|| x.matmul(&w).tanh().square().sum());
//! assert!(matches!(loss, Err(Error::Shape { op: "matmul", .. })));
//! ```
//!
//! A gradient of a constant, or with respect to one, is such an error too, and never a zero: what was computed in
//! [`Tape::no_grad`](crate::Tape::no_grad) has none. Code that takes a gradient as a part of what it computes, as a force is
//! the gradient of an energy, says so with [`Tape::enable_grad`](crate::Tape::enable_grad). The NaN finder names the operation, the line and the index
//! of the first number that is not finite, forwards or backwards. What operations give at kinks, ties and the edges of
//! their domains is one table: [`conventions`](crate::conventions).
//!
//! ```
//! use raygrad::{Tape, Tensor};
//! let tape = Tape::<f64>::new();
//! tape.check_finite(true);
//! let x = tape.leaf(Tensor::from([4.0, 0.0]));
//! let error = x.sqrt().sum().try_grad(&[&x]).unwrap_err();
//! assert!(error.to_string().starts_with("sqrt: the gradient of input 0 is inf at index [1]"));
//! ```
//!
//! # A custom operation
//!
//! A chain of elementwise operations passes over memory once for each of them, and once more for each gradient. Written
//! as a [`formula!`](crate::formula), it is one pass forward, without arrays in between, and one backward for the
//! gradients of all operands. Nothing else is to be written: the gradients follow from the formula, which is read for
//! [`Dual`](crate::Dual) numbers, and higher derivatives too.
//!
//! ```
//! use raygrad::{Tape, Tensor, formula};
//! let tape = Tape::<f64>::new();
//! let x = tape.leaf(Tensor::from([[0.0, 1.0], [2.0, 3.0]]));
//! let shift = tape.leaf(Tensor::from([0.5, -0.5]));
//! let (steepness, limit) = (2.0, 6.0); // constants from outside are listed
//! let y = formula!([steepness, limit] |x, b| (steepness * (x - b)).minimum(limit).exp() / 2.0).on([&x, &shift]);
//! let grads = y.sum().grad(&[&x, &shift]);
//! assert_eq!(grads[1], [-((-1.0_f64).exp() + 3.0_f64.exp()), -3.0_f64.exp()]); // 3.5 is beyond the limit
//! ```
//!
//! An operation with a name is a [`Formula`](crate::Formula): a function written once for every kind of number. Its
//! derivative can be written too, where another form has more digits or is faster.
//!
//! ```
//! use raygrad::check::{Cases, Check, Entry, check_op};
//! use raygrad::{Formula, Real, Tape, Tensor};
//!
//! /// y = 1 / (1 + x^2); dx = -2 g x y^2.
//! #[derive(Clone, Copy)]
//! struct Lorentz;
//!
//! impl Formula<1> for Lorentz {
//!     const NAME: &'static str = "lorentz";
//!     #[inline(always)]
//!     fn f<E: Real>(&self, [x]: [E; 1]) -> E {
//!         let one = x.like(1.0);
//!         one / (one + x * x)
//!     }
//!     #[inline(always)]
//!     fn vjp<E: Real>(&self, g: E, [x]: [E; 1], y: E) -> [E; 1] {
//!         [-(g.like(2.0) * g * (x * y) * y)] // the square of a large x would overflow
//!     }
//! }
//!
//! let tape = Tape::<f64>::new();
//! let x = tape.leaf(Tensor::scalar(1.0));
//! let y = Lorentz.on([&x]);
//! assert_eq!((y.item(), y.grad(&[&x])[0].item()), (0.5, -0.5));
//!
//! // Where it is sampled, and exact values and gradients at points where formulas like to fail.
//! let mut cases = Cases::default();
//! cases.domain(-3.0..3.0).at([0.0], 1.0, [0.0]).at([1e10], 1e-20, [-2e-30]);
//! let report = check_op(&Check::default(), &Entry::formula(Lorentz, &cases)).unwrap();
//! assert!(report.first_order < 1e-9 && report.second_order < 1e-9);
//! ```
//!
//! With the feature `check`, [`check_op`](crate::autograd::check::check_op) runs the checks that every operation of this
//! crate passes: finite differences of first and second order, dual numbers, f32 against f64, extremes, inputs of any
//! origin, the same bits twice. They find a wrong sign, a forgotten factor or a missing sum. An operation that is not
//! elementwise is an [`Op`](crate::Op), whose derivative is written with variables. An operation may be *fused*: then it carries a `reference` made of plain
//! operations, which is its oracle and its second derivative. A function that is made of operations needs no derivative
//! at all, and [`check_function`](crate::autograd::check::check_function) checks what it uses.
//!
//! # A model that learns
//!
//! Parameters live in a store, [`Params`](crate::Params), outside of any tape. A layer is a handle on some of them and a
//! function of (parameters, input). A training step binds the store to a fresh tape, takes the gradient of a loss, and
//! hands it to an optimiser. [`Bound::backward`](crate::Bound::backward) gives up the bound parameters and frees what the
//! tape holds, so that the optimiser moves them in place, without a copy. What an update did has to be looked at: elements
//! whose gradient is infinite or NaN stay where they are, and `check` is an error if there are any.
//!
//! ```
//! use rand::SeedableRng;
//! use raygrad::{Activation, Adam, AdamConfig, Init, Linear, Optimizer, Params, Mode, Schedule, Sequential};
//! use raygrad::{Tape, Tensor};
//!
//! let mut rng = rand::rngs::StdRng::seed_from_u64(1);
//! let mut params = Params::<f32>::new();
//! let hidden = Linear::new(&mut params, "hidden", [1, 24], Activation::Identity, Init::Glorot, &mut rng);
//! let out = Linear::new(&mut params, "out", [24, 1], Activation::Identity, Init::Glorot, &mut rng);
//! let model = Sequential::new().then(hidden).map(|x| x.tanh()).then(out);
//!
//! let x = Tensor::from_fn(&[64, 1], |i| i as f32 / 16.0 - 2.0);
//! let wave = (&x * 1.5).sin();
//! let mut adam = Adam::new(AdamConfig::default());
//! let schedule = Schedule::Cosine { from: 3e-2, to: 0.0, warmup: 0.1 };
//! let mut last = f32::NAN;
//! for step in 0..2000 {
//!     let tape = Tape::new();
//!     let bound = params.bind(&tape);
//!     let y = model.forward(&bound, &tape.constant(x.clone()), Mode::Train(step));
//!     let loss = y.mse_loss(&tape.constant(wave.clone()));
//!     last = loss.item();
//!     let grads = bound.backward(&loss);
//!     adam.update(&mut params, &grads, schedule.at_step(step, 2000)).check().unwrap();
//! }
//! assert!(last < 2e-3, "{last}");
//! ```
//!
//! `backward` frees what it has used as it goes; a tape made with [`Tape::with_pool`](crate::Tape::with_pool) gets its
//! buffers from the last step, so that a running loop allocates nothing of tensor size. A large model's activations
//! need not all be kept: [`Tape::checkpoint`](crate::Tape::checkpoint) computes a part again when its gradient is due.
//! [`Params`](crate::Params) reads and writes safetensors and NumPy's npz, and chooses by name which parameters are frozen,
//! have a learning rate or a weight decay of their own, or are tables of which only the rows with a gradient are moved.
//! [`Optimizer::state`](crate::Optimizer::state) is what a run needs besides to go on later, bit for bit.
