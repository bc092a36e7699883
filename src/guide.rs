//! A guide from a first gradient to a custom operation and a trained model.
//!
//! # A gradient
//!
//! A [`Tape`](crate::Tape) records operations on its variables, and a gradient runs through the record backwards. A
//! *leaf* is a variable to differentiate by; a *constant* has no gradient. Arithmetic broadcasts as in NumPy.
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
//! Tapes share no state: any number of them run on any threads, and dropping a tape frees its memory. An operation on
//! large tensors uses all of rayon's threads (`RAYON_NUM_THREADS` sets their number), or those of the caller's pool in
//! `ThreadPool::install`. Inside [`parallel::serial`](crate::tensor::parallel::serial) it stays on its thread.
//!
//! # Gradients of gradients
//!
//! [`Var::grad_graph`](crate::Var::grad_graph) puts the gradient itself on the tape. So it can be part of a loss, or be
//! differentiated again.
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
//! To differentiate a function rather than a graph, use [`derivatives`](crate::derivatives). It has value and gradient,
//! Jacobian, Hessian, and products with them.
//!
//! ```
//! use raygrad::{Tensor, derivatives::hvp};
//! let x = Tensor::from([3.0, -1.0]);
//! let v = Tensor::from([1.0, 0.0]);
//! let product = hvp(|x| x[0].powi(3).sum(), &[x], &[v]); // the Hessian is diag(6 x)
//! assert_eq!(product[0], [18.0, 0.0]);
//! ```
//!
//! # Errors
//!
//! An operation with wrong shapes panics. The message names the operation, the shapes and the line of the call. There
//! are three ways to get an error instead:
//!
//! * [`Tape::try_run`](crate::Tape::try_run) runs any code with plain methods and operators, and returns the first
//!   error;
//! * [`Tape::try_apply`](crate::Tape::try_apply) runs a single operation;
//! * `grad`, `backward`, `grad_graph`, `vjp`, `jacobian`, `hessian` and `value_and_grad` have forms that begin with
//!   `try_`.
//!
//! ```
//! use raygrad::{Error, Tape, Tensor};
//! let tape = Tape::<f64>::new();
//! let (x, w) = (tape.leaf(Tensor::ones(&[4, 3])), tape.leaf(Tensor::ones(&[5, 2])));
//! let loss = tape.try_run(|| x.matmul(&w).tanh().square().sum());
//! assert!(matches!(loss, Err(Error::Shape { op: "matmul", .. })));
//! ```
//!
//! A gradient of a constant, or with respect to one, is such an error too, and never a zero. Results computed in
//! [`Tape::no_grad`](crate::Tape::no_grad) are constants. Code that takes a gradient inside a computation, such as a
//! force that is the gradient of an energy, uses [`Tape::enable_grad`](crate::Tape::enable_grad).
//!
//! [`Tape::check_finite`](crate::Tape::check_finite) reports the first number that is infinite or NaN, in the forward
//! or backward pass. The error names the operation, the line and the index. The table of
//! [`conventions`](crate::conventions) lists values and gradients at kinks, ties and the edges of domains.
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
//! A chain of elementwise operations passes over memory once for each operation, and once more for each gradient. A
//! [`formula!`](crate::formula) takes one forward pass, without temporary arrays, and one backward pass for the
//! gradients of all operands. Gradients follow from the formula, which runs on [`Dual`](crate::Dual) numbers; so do
//! higher derivatives.
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
//! An operation with a name is a [`Formula`](crate::Formula): a function that is generic over the number type. It can
//! define its derivative too, if another form is more accurate or faster. The feature `check` has its examination.
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
//! With the feature `check`, [`check_op`](crate::autograd::check::check_op) runs the checks that every operation of
//! this crate passes. They include finite differences of first and second order, dual numbers, f32 against f64, exact
//! values, views and repeated runs. They find a wrong sign, a forgotten factor or a missing sum.
//!
//! An operation that is not elementwise is an [`Op`](crate::Op), whose derivative is written with variables. An
//! operation may be *fused*: then it has a `reference` made of plain operations, for its tests and its second
//! derivative. A derivative on plain tensors without a reference has no second derivative: asking for one is
//! [`Error::Unrecorded`](crate::Error::Unrecorded), and never 0. A function made of operations needs no derivative.
//! [`check_function`](crate::autograd::check::check_function) checks it.
//!
//! # A model that learns
//!
//! Parameters are stored in [`Params`](crate::Params), outside any tape. A layer has handles of some of them and is a
//! function of parameters and input. A training step binds the parameters to a fresh tape, takes the gradient of a
//! loss, and passes it to an optimizer.
//!
//! [`Bound::backward`](crate::Bound::backward) drops the bound parameters and frees the tape's values, so that the
//! optimizer updates the parameters in place. An update skips elements whose gradient is infinite or NaN. Call `check`
//! on its report: it is an error if elements were skipped.
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
//! `backward` frees values after their last use. A tape made with [`Tape::with_pool`](crate::Tape::with_pool) reuses
//! the buffers of the last step, so that a loop allocates no tensor-sized memory.
//! [`Tape::checkpoint`](crate::Tape::checkpoint) saves memory in large models: it computes activations again in the
//! backward pass.
//!
//! [`Params`](crate::Params) reads and writes safetensors and NumPy's npz. It selects by name the parameters that are
//! frozen, that have their own learning rate or weight decay, or that are tables updated by row.
//! [`Optimizer::state`](crate::Optimizer::state) is the rest of a checkpoint, to resume a run bit for bit.
