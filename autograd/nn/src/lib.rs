//! Models and their training on the tape of [`raygrad_autograd`]: parameters, layers, optimisers, and their files.
//!
//! * [`Params`]: named parameters outside any tape; [`Bound`]: the same on one.
//! * [`Layer`] and the layers: [`Linear`], [`Mlp`], [`Conv2d`], [`LayerNorm`], [`Dropout`], [`Embedding`], [`Sequential`].
//! * [`Optimizer`]: [`Sgd`], [`Adam`], [`AdamW`]; [`Schedule`], [`clip_norm`], [`Ema`].
//! * [`OptimizerState`] and [`Params`] as files, with the feature `files`: safetensors, and NumPy's npz.

#[cfg(feature = "files")]
mod files;
mod layers;
#[cfg(feature = "files")]
mod npz;
mod optim;
mod params;
#[cfg(feature = "files")]
mod storage;
mod tiles;

#[cfg(feature = "files")]
pub use files::write_atomic;
pub use layers::{Conv2d, Dropout, Embedding, Init, Layer, LayerNorm, Linear, Mlp, Mode, Sequential};
#[cfg(feature = "files")]
pub use npz::NpzError;
pub use optim::{Adam, AdamConfig, AdamW, Clipped, Ema, NonFinite, Optimizer, OptimizerState, ParamUpdate, Schedule};
pub use optim::{SettingError, Sgd, SgdConfig, StateError, UpdateReport, clip_norm, clip_value, global_norm};
pub use params::{Bound, ParamId, ParamLayout, Params};
#[cfg(feature = "files")]
pub use storage::{ParamsError, Storage, stored_bytes, stored_words};
pub use tiles::{SLOTS, TileSums, Tiles};
