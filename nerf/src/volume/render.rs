//! What arrives at the eye from samples along rays, with a name for everything.

use super::accumulate::Accumulate;
use super::depth::OpticalDepth;
use super::weights::Weights;
use crate::camera::rays::Samples;
use crate::field::Density;
use raygrad_autograd::{Scalar, Segments, Tensor, Var};
use std::ops::Add;

/// How often fields were asked.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Evaluations {
    /// For a density.
    pub density: u64,
    /// For a colour.
    pub color: u64,
    /// How often it would have been for each if nothing but the outside of the box were left out.
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
    /// The optical depth of samples that stand for intervals of length `delta`, each `[samples]`: see [`OpticalDepth`].
    ///
    /// # Panics
    /// If an interval is negative or NaN, or there is not one for each sample.
    #[track_caller]
    pub fn optical_depth(&self, delta: &Tensor<T>) -> Var<'t, T> {
        let of = if self.log { OpticalDepth::of_log_density } else { OpticalDepth::new };
        self.value.tape().apply(of(delta.clone()), &[&self.value])
    }
}

/// The weights of samples of optical depths `x` `[samples]`, front to back along their rays: see [`Weights`].
///
/// # Panics
/// If there is not one optical depth for each sample.
#[track_caller]
pub fn weights<'t, T: Scalar>(x: &Var<'t, T>, segments: &Segments) -> Var<'t, T> {
    x.tape().apply(Weights::new(segments.clone()), &[x])
}

/// The sums of `values` `[samples, channels]` times `weights` `[samples]` along rays, `[rays, channels]`: see
/// [`Accumulate`].
///
/// # Panics
/// If there is not one weight and one row of values for each sample.
#[track_caller]
pub fn accumulate<'t, T: Scalar>(weights: &Var<'t, T>, values: &Var<'t, T>, segments: &Segments) -> Var<'t, T> {
    weights.tape().apply(Accumulate(segments.clone()), &[weights, values])
}

/// How samples are weighted.
pub struct RayWeights<'t, T: Scalar> {
    /// The weight of each sample, `[samples]`.
    pub weights: Var<'t, T>,
    /// The optical depth of each ray, `[rays]`.
    pub optical_depth: Var<'t, T>,
}

/// What is seen along rays, front to back: everything that a picture shows or a loss can use. Each may be differentiated.
pub struct Rendered<'t, T: Scalar> {
    /// Where the field was asked.
    pub samples: Samples<T>,
    /// The places, `[samples, 3]`: on the tape where a [query](super::Query) has them there.
    pub positions: Var<'t, T>,
    /// Unit directions of the rays, `[rays, 3]`: on the tape where rays are variables.
    pub directions: Var<'t, T>,
    /// The density there.
    pub density: Density<'t, T>,
    /// How much of each sample arrives at the eye, `[samples]`.
    pub weights: Var<'t, T>,
    /// The optical depth of each ray, `[rays]`.
    pub optical_depth: Var<'t, T>,
    /// Colour without a background, `[rays, 3]`: at most the opacity.
    pub color: Var<'t, T>,
}

impl<'t, T: Scalar> Rendered<'t, T> {
    /// The sums of `values` `[samples, channels]` times the weights along rays, `[rays, channels]`.
    #[track_caller]
    pub fn accumulate(&self, values: &Var<'t, T>) -> Var<'t, T> {
        accumulate(&self.weights, values, &self.samples.segments)
    }

    /// Light that is left behind the last sample, `[rays]`, 0 to 1: what a background is multiplied by.
    #[track_caller]
    pub fn transmittance(&self) -> Var<'t, T> {
        (-&self.optical_depth).exp()
    }

    /// Light that samples have blocked, `[rays]`, 0 to 1: the sum of the weights, with all digits where it is small.
    #[track_caller]
    pub fn opacity(&self) -> Var<'t, T> {
        -(-&self.optical_depth).expm1()
    }

    /// The distance times the light that comes from there, `[rays]`, in scene units: divided by the opacity, the expected
    /// distance of what is seen.
    #[track_caller]
    pub fn depth(&self) -> Var<'t, T> {
        let t = self.samples.t.reshape(&[self.samples.len(), 1]);
        self.accumulate(&self.weights.tape().constant(t)).reshape(&[self.samples.segments.len()])
    }

    /// The colour over a background `[rays, 3]`.
    #[track_caller]
    pub fn over(&self, background: &Tensor<T>) -> Var<'t, T> {
        let left = self.transmittance().reshape(&[self.samples.segments.len(), 1]);
        &self.color + left * self.color.tape().constant(background.clone())
    }

    /// The unit normal at each sample, `-grad sigma / |grad sigma|`, `[samples, 3]`; 0 where the density is constant. It
    /// is recorded, so that losses of normals have gradients of their own.
    ///
    /// # Panics
    /// If positions are not on the tape: see [`Query::slopes`](super::Query::slopes).
    #[track_caller]
    pub fn normals(&self) -> Var<'t, T> {
        // The logarithm falls in the same direction, and does not overflow.
        downhill(&self.density.value.sum().grad_graph(&[&self.positions]).remove(0))
    }

    /// The normals that are seen along the rays: the sums of [those of samples](Self::normals) times the weights,
    /// `[rays, 3]`, no longer than the opacity, as numbers.
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

/// The unit vectors against slopes `[samples, 3]`, and 0 for none.
fn downhill<'t, T: Scalar>(slopes: &Var<'t, T>) -> Var<'t, T> {
    // In units of the largest, so that no square overflows.
    let largest = slopes.value().as_slice().chunks_exact(3);
    let least = T::from_f64(1e-30);
    let scales = largest.map(|x| x.iter().fold(least, |most, x| if x.abs() > most { x.abs() } else { most }));
    let each = &[slopes.shape()[0], 1];
    let scales = Tensor::from_vec(each, scales.collect());
    let scaled = slopes / slopes.tape().constant(scales);
    let length = (scaled.square().sum_over(-1) + 1e-12).sqrt().reshape(each);
    -(scaled / length)
}
