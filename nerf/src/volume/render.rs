//! Rendered rays, with a name for each quantity.

use super::accumulate::Accumulate;
use super::depth::OpticalDepth;
use super::weights::Weights;
use crate::camera::rays::Samples;
use crate::field::Density;
use raygrad_autograd::{Scalar, Segments, Tensor, Var};
use serde::{Deserialize, Serialize};
use std::ops::Add;

/// Counts of field evaluations.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Evaluations {
    /// Density evaluations.
    pub density: u64,
    /// Colour evaluations.
    pub color: u64,
    /// Evaluations of each without skipping within the box.
    pub unskipped: u64,
}

impl Add for Evaluations {
    type Output = Evaluations;
    fn add(self, other: Evaluations) -> Evaluations {
        Evaluations {
            density: self.density + other.density,
            color: self.color + other.color,
            unskipped: self.unskipped + other.unskipped,
        }
    }
}

impl<'t, T: Scalar> Density<'t, T> {
    /// Computes the optical depth of samples with intervals of length `delta`, both `[samples]`: see [`OpticalDepth`].
    ///
    /// # Panics
    /// If an interval is negative or NaN, or there is not one per sample.
    #[track_caller]
    pub fn optical_depth(&self, delta: &Tensor<T>) -> Var<'t, T> {
        let of = if self.log { OpticalDepth::of_log_density } else { OpticalDepth::new };
        self.value.tape().apply(of(delta.clone()), &[&self.value])
    }
}

/// Computes weights `[samples]` from optical depths `x` `[samples]`: see [`Weights`].
///
/// # Panics
/// If `x` has not one entry per sample.
#[track_caller]
pub fn weights<'t, T: Scalar>(x: &Var<'t, T>, segments: &Segments) -> Var<'t, T> {
    x.tape().apply(Weights::new(segments.clone()), &[x])
}

/// Sums `values` `[samples, channels]` times `weights` `[samples]` along rays, to `[rays, channels]`: see
/// [`Accumulate`].
///
/// # Panics
/// If there is not one weight and one row of values per sample.
#[track_caller]
pub fn accumulate<'t, T: Scalar>(weights: &Var<'t, T>, values: &Var<'t, T>, segments: &Segments) -> Var<'t, T> {
    weights.tape().apply(Accumulate(segments.clone()), &[weights, values])
}

/// Weights of samples and optical depths of rays.
pub struct RayWeights<'t, T: Scalar> {
    /// The weight of each sample, `[samples]`.
    pub weights: Var<'t, T>,
    /// The optical depth of each ray, `[rays]`.
    pub optical_depth: Var<'t, T>,
}

/// Rendered rays: everything that an image or a loss can use, differentiable.
pub struct Rendered<'t, T: Scalar> {
    /// The samples at which the field was evaluated.
    pub samples: Samples<T>,
    /// Positions of the samples, `[samples, 3]`; variables if the [query](super::Query) makes them so.
    pub positions: Var<'t, T>,
    /// Unit directions of the rays, `[rays, 3]`; variables if rays are.
    pub directions: Var<'t, T>,
    /// The density at the samples.
    pub density: Density<'t, T>,
    /// Weights `w = T alpha` of the samples, `[samples]`.
    pub weights: Var<'t, T>,
    /// The optical depth of each ray, `[rays]`.
    pub optical_depth: Var<'t, T>,
    /// Colour `sum w c` without a background, `[rays, 3]`, at most the opacity.
    pub color: Var<'t, T>,
}

impl<'t, T: Scalar> Rendered<'t, T> {
    /// Sums `values` `[samples, channels]` times the weights along rays, to `[rays, channels]`.
    #[track_caller]
    pub fn accumulate(&self, values: &Var<'t, T>) -> Var<'t, T> {
        accumulate(&self.weights, values, &self.samples.segments)
    }

    /// Computes the transmittance behind the last sample, `[rays]`, 0 to 1: the factor of a background.
    #[track_caller]
    pub fn transmittance(&self) -> Var<'t, T> {
        (-&self.optical_depth).exp()
    }

    /// Computes the opacity `sum w`, `[rays]`, 0 to 1, with full relative precision where it is small.
    #[track_caller]
    pub fn opacity(&self) -> Var<'t, T> {
        -(-&self.optical_depth).expm1()
    }

    /// Computes the depth sum `sum w t`, `[rays]`, in scene units. Divided by the opacity, it is the expected distance.
    #[track_caller]
    pub fn depth(&self) -> Var<'t, T> {
        let t = self.samples.t.reshape(&[self.samples.len(), 1]);
        self.accumulate(&self.weights.tape().constant(t)).reshape(&[self.samples.segments.len()])
    }

    /// Composites the colour over a background `[rays, 3]`.
    #[track_caller]
    pub fn over(&self, background: &Tensor<T>) -> Var<'t, T> {
        let left = self.transmittance().reshape(&[self.samples.segments.len(), 1]);
        &self.color + left * self.color.tape().constant(background.clone())
    }

    /// Computes the unit normal `-grad sigma / |grad sigma|` at each sample, `[samples, 3]`; 0 where the density is
    /// constant. It is recorded, so that losses of normals are differentiable.
    ///
    /// # Panics
    /// If positions are not on the tape: see [`Query::position_grad`](super::Query::position_grad).
    #[track_caller]
    pub fn normals(&self) -> Var<'t, T> {
        // The log density falls in the same direction and does not overflow.
        downhill(&self.density.value.sum().grad_graph(&[&self.positions]).remove(0))
    }

    /// Computes the sum of weights times [normals](Self::normals) along rays, `[rays, 3]`, as plain numbers. Its length
    /// is at most the opacity.
    ///
    /// # Panics
    /// As [`normals`](Self::normals), or if the density does not depend on positions.
    #[track_caller]
    pub fn accumulated_normals(&self) -> Tensor<T> {
        let slopes = self.density.value.sum().grad(&[&self.positions]).remove(0);
        let tape = self.weights.tape();
        tape.no_grad(|| self.accumulate(&downhill(&tape.constant(slopes))).into_value())
    }
}

/// The unit vectors against slopes `[samples, 3]`; 0 for no slope.
fn downhill<'t, T: Scalar>(slopes: &Var<'t, T>) -> Var<'t, T> {
    // Relative to the largest, so that no square overflows.
    let largest = slopes.value().as_slice().chunks_exact(3);
    let least = T::from_f64(1e-30);
    let scales = largest.map(|x| x.iter().fold(least, |most, x| if x.abs() > most { x.abs() } else { most }));
    let each = &[slopes.shape()[0], 1];
    let scales = Tensor::from_vec(each, scales.collect());
    let scaled = slopes / slopes.tape().constant(scales);
    let length = (scaled.square().sum_over(-1) + 1e-12).sqrt().reshape(each);
    -(scaled / length)
}
