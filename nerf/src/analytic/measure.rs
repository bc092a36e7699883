//! Quadrature of analytic scenes.

use super::{AnalyticField, AnalyticScene};
use crate::camera::rays::Rays;
use crate::camera::rays::stratified;
use crate::random::Jitter;
use crate::volume::early_termination::VisibleSamples;
use crate::volume::quadrature::Quadrature;
use crate::volume::query::Query;
use raygrad_autograd::{Scalar, Tape, Var};
use raygrad_nn::Params;

/// An approximation of [`Exact`](crate::analytic::Exact), with its number of evaluations.
#[derive(Debug, Clone, PartialEq)]
pub struct Integral {
    /// Colour over the background.
    pub color: f64,
    /// Depth sum, in scene units.
    pub depth: f64,
    /// Transmittance at the end of the ray, 0 to 1.
    pub transmittance: f64,
    /// Derivative of the colour with respect to each amplitude.
    pub d_color: Vec<f64>,
    /// Derivative of the depth with respect to each amplitude.
    pub d_depth: Vec<f64>,
    /// Number of evaluations of density and colour.
    pub evaluations: usize,
}

/// Renders and differentiates a scene in the precision `T`, with at most `evaluations` evaluations. An adaptive rule
/// starts with as many intervals and takes what it needs.
#[inline(never)]
pub fn integrate<T: Scalar>(scene: &AnalyticScene, rule: Quadrature, evaluations: usize) -> Integral {
    let mut params = Params::<T>::new();
    let field = AnalyticField::new(scene.medium.clone(), &mut params);
    let mut rays = Rays::new();
    rays.push(&scene.ray, [0.0, scene.length]);
    let tape = Tape::new();
    let bound = params.bind(&tape);
    let query = Query::new(&field, &bound);
    let steps = stratified(&rays, rule.intervals(evaluations), &mut Jitter::Middle, tape.pool());
    let VisibleSamples { rendered: seen, density_queries: evaluations, .. } = rule.render(&query, &steps, 0.0);
    let color = seen.color.slice_axis(1, 1..2).sum() + seen.transmittance().sum() * scene.background;
    let depth = seen.depth().sum();
    let gradient = |value: &Var<'_, T>| value.grad(&bound.vars())[0].as_slice().iter().map(|x| x.to_f64()).collect();
    Integral {
        color: color.item().to_f64(),
        depth: depth.item().to_f64(),
        transmittance: seen.transmittance().item().to_f64(),
        d_color: gradient(&color),
        d_depth: gradient(&depth),
        evaluations,
    }
}
