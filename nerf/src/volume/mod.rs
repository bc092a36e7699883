//! Volume rendering: what arrives at the eye from samples along rays.
//!
//! There is one way from a density to a picture, for training, views and references alike:
//! [density](crate::Density) → [`OpticalDepth`] of each interval → [`Weights`], front to back → [`Accumulate`] of colours,
//! distances or whatever else. Each arrow is an operation of its own (functions of the same name in small letters apply
//! them), and [`Rendered`] has everything together under its name. A [`quadrature::Quadrature`] says where along a ray the
//! field is asked and how its answers are weighted.
//!
//! ```
//! use raygrad_autograd::{Segments, Tape, Tensor};
//! use raygrad_nerf::volume::{OpticalDepth, accumulate, weights};
//! let tape = Tape::<f64>::new();
//! // Two rays: of three samples and of one.
//! let segments = Segments::new([0, 3, 4]);
//! let sigma = tape.leaf(Tensor::from([0.0, 0.5, 2.0, 1e9]));
//! let x = tape.apply(OpticalDepth::new(Tensor::full(&[4], 0.1)), &[&sigma]);
//! let w = weights(&x, &segments);
//! let color = tape.constant(Tensor::from([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.5]]));
//! let seen = accumulate(&w, &color, &segments);
//! assert_eq!(seen.shape(), [2, 3]);
//! assert_eq!(seen.slice_axis(0, 1..).value(), [[0.5, 0.5, 0.5]]); // a wall
//! assert_eq!(seen.sum().grad(&[&sigma])[0].as_slice()[3], 0.0); // it cannot become more opaque
//! ```

pub(crate) mod accumulate;
pub(crate) mod depth;
pub(crate) mod distortion;
pub(crate) mod early_termination;
pub mod quadrature;
pub(crate) mod query;
pub(crate) mod render;
pub(crate) mod rounds;
#[cfg(test)]
mod tests;
pub(crate) mod weights;

pub use accumulate::Accumulate;
pub use depth::OpticalDepth;
pub use distortion::Distortion;
pub use early_termination::VisibleSamples;
pub use query::{Query, RayVars};
pub use render::{Evaluations, RayWeights, Rendered, accumulate, weights};
pub use weights::Weights;
