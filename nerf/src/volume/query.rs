//! Evaluation of a field at samples along rays.

use crate::camera::rays::Samples;
use crate::field::{Density, Field, ViewInputs};
use raygrad_autograd::{Scalar, Tape, Tensor, Var};
use raygrad_nn::Bound;

/// Rays as variables of the tape, for pose refinement.
#[derive(Clone)]
pub struct RayVars<'t, T: Scalar> {
    /// Origins, `[rays, 3]`, in scene units.
    pub origins: Var<'t, T>,
    /// Unit directions, `[rays, 3]`.
    pub directions: Var<'t, T>,
}

/// A field with its parameters and the context of the rays along which it is evaluated.
#[derive(Clone, Copy)]
pub struct Query<'a, 't, T: Scalar> {
    /// The field.
    pub field: &'a dyn Field<T>,
    /// The parameters.
    pub params: &'a Bound<'t, T>,
    /// The image index of each ray, `[rays]`; `None` uses the mean appearance.
    pub frames: Option<&'a [u32]>,
    /// The rays as variables; `None` makes them constants.
    pub rays: Option<&'a RayVars<'t, T>>,
    /// Whether positions are variables even if rays are constants, as normals need.
    pub position_grad: bool,
    /// The gradient scaling distance, in scene units; 0 turns it off. See
    /// [`Config::gradient_scaling_distance`](crate::Config::gradient_scaling_distance).
    pub gradient_scaling_distance: f64,
}

impl<'a, 't, T: Scalar> Query<'a, 't, T> {
    /// Creates a query with constant rays and the mean appearance.
    pub fn new(field: &'a dyn Field<T>, params: &'a Bound<'t, T>) -> Self {
        Query { field, params, frames: None, rays: None, position_grad: false, gradient_scaling_distance: 0.0 }
    }

    /// Returns the query for another field.
    pub fn of(self, field: &'a dyn Field<T>) -> Self {
        Query { field, ..self }
    }

    /// Returns the tape of the parameters.
    pub fn tape(&self) -> &'t Tape<T> {
        self.params.tape()
    }

    /// Returns the positions of samples, `[samples, 3]`, in scene units.
    #[track_caller]
    pub fn positions(&self, samples: &Samples<T>) -> Var<'t, T> {
        let tape = self.tape();
        match self.rays {
            Some(RayVars { origins, directions }) => {
                let t = tape.constant(samples.t.reshape(&[samples.len(), 1]));
                origins.segment_expand(&samples.segments) + directions.segment_expand(&samples.segments) * t
            }
            None if self.position_grad => tape.leaf(samples.positions(tape.pool())),
            None => tape.constant(samples.positions(tape.pool())),
        }
    }

    /// Returns the unit directions of the samples' rays, `[rays, 3]`.
    pub fn directions(&self, samples: &Samples<T>) -> Var<'t, T> {
        match self.rays {
            Some(rays) => rays.directions.clone(),
            None => self.tape().constant(samples.directions.clone()),
        }
    }

    /// Computes the density at samples.
    #[track_caller]
    pub fn density(&self, samples: &Samples<T>) -> Density<'t, T> {
        self.density_at(samples, &self.positions(samples))
    }

    /// Computes the density as [`density`](Self::density), with known [positions](Self::positions).
    #[track_caller]
    pub fn density_at(&self, samples: &Samples<T>, positions: &Var<'t, T>) -> Density<'t, T> {
        let density = self.field.density(self.params, positions);
        match self.gradient_scale(samples) {
            Some(shares) => Density { value: scale_gradient(density.value, &shares), ..density },
            None => density,
        }
    }

    /// The gradient scale of each sample, `[samples]`, if any is below 1.
    fn gradient_scale(&self, samples: &Samples<T>) -> Option<Tensor<T>> {
        let near = self.gradient_scaling_distance;
        if near == 0.0 || !self.tape().is_recording() || !samples.t.as_slice().iter().any(|t| t.to_f64() < near) {
            return None;
        }
        Some(samples.t.map(|t| T::from_f64((t.to_f64() / near).powi(2).min(1.0))))
    }

    /// Computes the colour of samples with these features, `[samples, 3]`.
    #[track_caller]
    pub fn color(&self, features: &Var<'t, T>, samples: &Samples<T>) -> Var<'t, T> {
        let directions = &self.directions(samples);
        let seen = ViewInputs { directions, segments: &samples.segments, frames: self.frames };
        let color = self.field.color(self.params, features, &seen);
        match self.gradient_scale(samples) {
            Some(shares) => scale_gradient(color, &shares.reshape(&[samples.len(), 1])),
            None => color,
        }
    }
}

/// The same values with scaled gradients.
fn scale_gradient<'t, T: Scalar>(x: Var<'t, T>, shares: &Tensor<T>) -> Var<'t, T> {
    // The added term is 0.
    let moved = (&x - x.detach()) * x.tape().constant(shares.clone());
    x.detach() + moved
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Ray;
    use crate::camera::rays::{Rays, stratified};
    use crate::random::Jitter;
    use crate::volume::quadrature::Quadrature;
    use glam::DVec3;
    use raygrad_autograd::{Pool, Tape};
    use raygrad_nn::Params;

    /// A density and a colour that are one parameter everywhere.
    struct Here;

    impl Field<f64> for Here {
        fn density<'t>(&self, params: &Bound<'t, f64>, positions: &Var<'t, f64>) -> Density<'t, f64> {
            let value = params.vars()[0].broadcast_to(&[positions.shape()[0]]);
            Density { value, log: false, features: positions.clone() }
        }
        fn color<'t>(
            &self,
            params: &Bound<'t, f64>,
            features: &Var<'t, f64>,
            _: &ViewInputs<'_, 't, f64>,
        ) -> Var<'t, f64> {
            params.vars()[0].broadcast_to(&[features.shape()[0], 3])
        }
    }

    #[test]
    fn gradient_scaling_follows_square_of_distance() {
        let mut params = Params::<f64>::new();
        params.add("much", Tensor::scalar(0.7));
        let mut rays = Rays::new();
        rays.push(&Ray { origin: DVec3::ZERO, direction: DVec3::Z }, [0.0, 4.0]);
        // At the middles of four bins: 0.5, 1.5, 2.5 and 3.5.
        let samples = stratified(&rays, 4, &mut Jitter::Middle, &Pool::new());
        assert_eq!(samples.t.as_slice(), [0.5, 1.5, 2.5, 3.5]);
        for (near, shares) in [(0.0, [1.0; 4]), (0.5, [1.0; 4]), (2.0, [1.0 / 16.0, 9.0 / 16.0, 1.0, 1.0])] {
            let tape = Tape::new();
            let bound = params.bind(&tape);
            let query = Query { gradient_scaling_distance: near, ..Query::new(&Here, &bound) };
            let weights = Tensor::from_vec(&[4], vec![1.0, 10.0, 100.0, 1000.0]);
            let expected = [1.0, 10.0, 100.0, 1000.0].iter().zip(shares).map(|(w, share)| w * share).sum::<f64>();
            let density = query.density(&samples);
            assert!(density.value.value().as_slice().iter().all(|x| *x == 0.7));
            let found = (&density.value * tape.constant(weights.clone())).sum().grad(&[bound.vars()[0]]);
            assert!((found[0].item() - expected).abs() < 1e-9, "{near}: {} {expected}", found[0].item());
            let color = query.color(&density.features, &samples);
            let weighted = color * tape.constant(weights.reshape(&[4, 1]));
            let found = weighted.sum().grad(&[bound.vars()[0]]);
            assert!((found[0].item() - 3.0 * expected).abs() < 1e-9, "{near}: {} {expected}", found[0].item());
        }
    }

    #[test]
    fn all_render_paths_scale_density_gradients() {
        let mut params = Params::<f64>::new();
        params.add("much", Tensor::scalar(0.7));
        let mut rays = Rays::new();
        rays.push(&Ray { origin: DVec3::ZERO, direction: DVec3::Z }, [0.0, 4.0]);
        let steps = stratified(&rays, 4, &mut Jitter::Middle, &Pool::new());
        for rule in [Quadrature::Midpoint, Quadrature::PiecewiseLinear, Quadrature::Adaptive { tolerance: 1e-3 }] {
            for early_stop_eps in [0.0, 1e-9] {
                let learned = |near: f64| {
                    let tape = Tape::new();
                    let bound = params.bind(&tape);
                    let query = Query { gradient_scaling_distance: near, ..Query::new(&Here, &bound) };
                    let rendered = rule.render(&query, &steps, early_stop_eps).rendered;
                    rendered.weights.sum().grad(&[bound.vars()[0]])[0].item()
                };
                let (usual, less) = (learned(0.0), learned(1e6));
                assert!(usual > 1e-3 && less.abs() < 1e-9, "{rule:?} {early_stop_eps}: {usual} {less}");
            }
        }
    }

    #[test]
    fn with_slopes_scales_gradients_alone() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::from([[1.0, 2.0], [0.1, -1e300], [7.0, 0.0]]));
        let y = scale_gradient(x.clone(), &Tensor::from_vec(&[3, 1], vec![0.25, 0.0, 1.0]));
        assert_eq!(y.value(), x.value());
        let grads = (y * 2.0).sum().grad(&[&x]);
        assert_eq!(grads[0].as_slice(), [0.5, 0.5, 0.0, 0.0, 2.0, 2.0]);
    }
}
