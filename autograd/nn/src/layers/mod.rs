//! Layers: handles of parameters, and pure functions of parameters and input.

mod conv2d;
mod dropout;
mod embedding;
mod init;
mod layer_norm;
mod linear;
mod mlp;
mod sequential;

pub use conv2d::Conv2d;
pub use dropout::Dropout;
pub use embedding::Embedding;
pub use init::Init;
pub use layer_norm::LayerNorm;
pub use linear::Linear;
pub use mlp::Mlp;
pub use sequential::Sequential;

use crate::Bound;
use raygrad_autograd::Var;
use raygrad_tensor::Scalar;

/// The interface of the layers of a [`Sequential`]: a function of one tensor, which may have parameters and may differ
/// between training and evaluation.
///
/// The `forward` method of each layer documents its shapes. This trait is for generic code.
pub trait Layer<T: Scalar>: Send + Sync {
    /// Computes the layer's output for `x`.
    ///
    /// # Panics
    /// If the shape of `x` does not fit.
    #[track_caller]
    fn apply<'t>(&self, params: &Bound<'t, T>, x: &Var<'t, T>, mode: Mode) -> Var<'t, T>;
}

/// Evaluation or training. All randomness of a layer follows from the mode. So the same mode gives the same bits on any
/// thread, and again in a [`checkpoint`](raygrad_autograd::Tape::checkpoint).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mode {
    /// Evaluation, without randomness.
    Evaluate,
    /// Training with this seed. Use another seed for each step, and for each part of a step that has a separate tape.
    Train(u64),
}

impl Mode {
    /// The mode for part number `which` of a model. Its seed differs, so that two layers do not draw the same random
    /// numbers.
    pub fn part(self, which: u64) -> Mode {
        match self {
            Mode::Evaluate => Mode::Evaluate,
            Mode::Train(seed) => {
                // The finaliser of SplitMix64 (Steele, Lea and Flood 2014).
                let mut state = seed.wrapping_add(which.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
                state = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
                state = (state ^ (state >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
                Mode::Train(state ^ (state >> 31))
            }
        }
    }
}
