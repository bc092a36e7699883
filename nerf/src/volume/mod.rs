//! Volume rendering: from densities and colours of samples to the colours of rays.
//!
//! Training, renders and references share the operations [density](crate::Density) → [`OpticalDepth`] → [`Weights`] →
//! [`Accumulate`] (of colours, distances or normals). [`Rendered`] holds all results of a batch of rays. A
//! [`quadrature::Quadrature`] chooses the samples and their weights.
//!
//! # Notation
//!
//! | letter | meaning | shape | unit |
//! |---|---|---|---|
//! | `t` | distance of a sample along its ray | `[samples]` | scene unit |
//! | `delta` | length of a sample's interval | `[samples]` | scene unit |
//! | `sigma` | density | `[samples]` | 1 / scene unit |
//! | `x = sigma delta` | optical depth of an interval | `[samples]` | |
//! | `alpha = 1 - exp(-x)` | opacity of an interval | `[samples]` | 0 to 1 |
//! | `T_i = exp(-sum of x_j for j < i)` | transmittance in front of a sample | `[samples]` | 0 to 1 |
//! | `w = T alpha` | weight of a sample | `[samples]` | 0 to 1 |
//! | `c` | colour of a sample | `[samples, 3]` | 0 to 1 |
//!
//! The colour of a ray is `sum w c`, its opacity `sum w`, its depth sum `sum w t` (Mildenhall et al. 2020, equation 3;
//! Max 1995). Samples are packed: those of all rays stand one after another, and `Segments` holds the rows of each ray.
//!
//! # Example
//!
//! ```
//! use raygrad_autograd::{Segments, Tape, Tensor};
//! use raygrad_nerf::volume::{OpticalDepth, accumulate, weights};
//! let tape = Tape::<f64>::new();
//! // Two rays, of three samples and of one.
//! let segments = Segments::new([0, 3, 4]);
//! let sigma = tape.leaf(Tensor::from([0.0, 0.5, 2.0, 1e9]));
//! let x = tape.apply(OpticalDepth::new(Tensor::full(&[4], 0.1)), &[&sigma]);
//! let w = weights(&x, &segments);
//! let color = tape.constant(Tensor::from([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.5]]));
//! let seen = accumulate(&w, &color, &segments);
//! assert_eq!(seen.shape(), [2, 3]);
//! assert_eq!(seen.slice_axis(0, 1..).value(), [[0.5, 0.5, 0.5]]); // an opaque wall
//! assert_eq!(seen.sum().grad(&[&sigma])[0].as_slice()[3], 0.0); // its opacity is saturated
//! ```

pub(crate) mod accumulate;
pub(crate) mod depth;
pub(crate) mod distortion;
pub(crate) mod early_termination;
pub mod quadrature;
pub(crate) mod query;
pub(crate) mod regions;
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
pub use regions::{Region, composite};
pub use render::{Evaluations, RayWeights, Rendered, accumulate, weights};
pub use weights::Weights;
