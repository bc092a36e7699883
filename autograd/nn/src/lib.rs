//! Neural-network layers, optimizers and parameter files on the tape of [`raygrad_autograd`].
//!
//! Start with [`Params`], which holds the parameters of a model outside any tape. A training step binds them to a fresh
//! tape and passes the gradients to an [`Optimizer`]:
//!
//! ```
//! use rand::SeedableRng;
//! use raygrad_autograd::{Activation, Tape, Tensor};
//! use raygrad_nn::{Adam, AdamConfig, Init, Linear, Optimizer, Params};
//!
//! let mut rng = rand::rngs::StdRng::seed_from_u64(1);
//! let mut params = Params::<f32>::new();
//! let layer = Linear::new(&mut params, "line", [1, 1], Activation::Identity, Init::Glorot, &mut rng);
//! let x = Tensor::from_fn(&[100, 1], |i| i as f32 / 100.0);
//! let target = &x * 3.0 - 1.0;
//!
//! let mut adam = Adam::new(AdamConfig::default());
//! for _ in 0..500 {
//!     let tape = Tape::new();
//!     let bound = params.bind(&tape);
//!     let loss = layer.forward(&bound, &tape.constant(x.clone())).mse_loss(&target);
//!     let grads = bound.backward(&loss);
//!     adam.update(&mut params, &grads, 0.05).check().unwrap();
//! }
//! assert!((params.values()[0].item() - 3.0).abs() < 0.05); // the slope
//! assert!((params.values()[1].item() + 1.0).abs() < 0.05); // the bias
//! ```
//!
//! * [`Params`]: named parameters outside any tape. [`Bound`]: the same parameters on one tape.
//! * [`Layer`] and the layers: [`Linear`], [`Mlp`], [`Conv2d`], [`LayerNorm`], [`Dropout`], [`Embedding`],
//!   [`Sequential`].
//! * [`Optimizer`]: [`Sgd`], [`Adam`], [`AdamW`]. Around it: [`Schedule`], [`clip_norm`], [`Ema`].
//! * [`Tiles`]: a training step in parallel, with the same bits for any number of threads. With an [`Exchange`]:
//!   on several machines.
//! * [`OptimizerState`] and [`Params`] as files, with the feature `files`: safetensors, and NumPy's npz. [`npy`]: one
//!   array.

mod exchange;
#[cfg(feature = "files")]
mod files;
mod layers;
#[cfg(feature = "files")]
pub mod npy;
#[cfg(feature = "files")]
mod npz;
mod optim;
mod params;
#[cfg(feature = "files")]
mod storage;
mod tiles;

#[cfg(feature = "mpi")]
pub use exchange::Mpi;
pub use exchange::{Exchange, ExchangeError, InProcess, Link, Simulated, Tcp};
#[cfg(feature = "files")]
pub use files::{TEMPORARY_PREFIX, create_folder, rename_durable, write_atomic};
pub use layers::{Conv2d, Dropout, Embedding, Init, Layer, LayerNorm, Linear, Mlp, Mode, Sequential};
#[cfg(feature = "files")]
pub use npz::NpzError;
pub use optim::{Adam, AdamConfig, AdamW, Clipped, Ema, NonFinite, Optimizer, OptimizerState, ParamUpdate, Schedule};
pub use optim::{SettingError, Sgd, SgdConfig, StateError, UpdateReport, clip_norm, clip_value, global_norm};
pub use params::{Bound, ParamId, ParamLayout, Params};
#[cfg(feature = "files")]
pub use storage::{ParamsError, Storage, stored_bytes, stored_words};
pub use tiles::{TileSums, Tiles};
