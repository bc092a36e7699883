//! Asking a field at samples along rays.

use crate::camera::rays::Samples;
use crate::field::{Density, Field, Seen};
use raygrad_autograd::{Scalar, Tape, Tensor, Var};
use raygrad_nn::Bound;

/// Rays that are variables: what learns poses.
#[derive(Clone)]
pub struct RayVars<'t, T: Scalar> {
    /// Where they start, `[rays, 3]`.
    pub origins: Var<'t, T>,
    /// Unit directions, `[rays, 3]`.
    pub directions: Var<'t, T>,
}

/// A field with its parameters, and what is known of the rays along which it is asked.
#[derive(Clone, Copy)]
pub struct Query<'a, 't, T: Scalar> {
    /// What is asked.
    pub field: &'a dyn Field<T>,
    /// The parameters.
    pub params: &'a Bound<'t, T>,
    /// The number of the photograph that each ray belongs to.
    pub frames: Option<&'a [u32]>,
    /// The rays as variables; without them rays are constants.
    pub rays: Option<&'a RayVars<'t, T>>,
    /// Whether positions are variables of the tape although rays are not: what normals need.
    pub slopes: bool,
}

impl<'a, 't, T: Scalar> Query<'a, 't, T> {
    /// Of a field, along rays of which nothing is known.
    pub fn new(field: &'a dyn Field<T>, params: &'a Bound<'t, T>) -> Self {
        Query { field, params, frames: None, rays: None, slopes: false }
    }

    /// The same of another field.
    pub fn of(self, field: &'a dyn Field<T>) -> Self {
        Query { field, ..self }
    }

    /// The tape that the parameters are on.
    pub fn tape(&self) -> &'t Tape<T> {
        self.params.tape()
    }

    /// Positions of samples, `[samples, 3]`, in scene units.
    #[track_caller]
    pub fn positions(&self, samples: &Samples<T>) -> Var<'t, T> {
        let tape = self.tape();
        match self.rays {
            Some(RayVars { origins, directions }) => {
                let t = tape.constant(samples.t.reshape(&[samples.len(), 1]));
                origins.segment_expand(&samples.segments) + directions.segment_expand(&samples.segments) * t
            }
            None if self.slopes => tape.leaf(samples.positions(tape.pool())),
            None => tape.constant(samples.positions(tape.pool())),
        }
    }

    /// Unit directions of the rays of samples, `[rays, 3]`.
    pub fn directions(&self, samples: &Samples<T>) -> Var<'t, T> {
        match self.rays {
            Some(rays) => rays.directions.clone(),
            None => self.tape().constant(samples.directions.clone()),
        }
    }

    /// The density at samples.
    #[track_caller]
    pub fn density(&self, samples: &Samples<T>) -> Density<'t, T> {
        self.field.density(self.params, &self.positions(samples))
    }

    /// The density at samples in 1 / scene unit, `[samples]`, as numbers.
    #[track_caller]
    pub fn sigma(&self, samples: &Samples<T>) -> Tensor<T> {
        self.tape().no_grad(|| self.density(samples).sigma().into_value())
    }

    /// The colour of samples with these features, `[samples, 3]`.
    #[track_caller]
    pub fn color(&self, features: &Var<'t, T>, samples: &Samples<T>) -> Var<'t, T> {
        let directions = &self.directions(samples);
        let seen = Seen { directions, segments: &samples.segments, frames: self.frames };
        self.field.color(self.params, features, &seen)
    }
}
