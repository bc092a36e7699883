//! Nodes of the rules, and their weights.

use super::Quadrature;
use super::share::gauss_share;
use crate::camera::rays::Samples;
use crate::field::Density;
use crate::volume::query::Query;
use crate::volume::render::{RayWeights, Rendered, accumulate, weights};
use crate::volume::weights::Weights;
use raygrad_autograd::{Scalar, Segments, Tensor, Var};
use std::sync::Arc;

/// Positions of the two Gauss nodes, from the middle of the interval.
const GAUSS: f64 = 0.288_675_134_594_812_9;

/// Intervals of two nodes each.
///
/// Interval k of length h with nodes a and b has the optical depth `x_k = h (sigma_a + sigma_b) / 2` and the features
/// `(1 - f) c_a + f c_b`. f is 0.5 for nodes at both ends, and [`gauss_share`](super::gauss_share) for Gauss nodes. So
/// its [weight](Weights) is divided between its two nodes.
struct Intervals<T: Scalar> {
    /// The first and the second node of each, as rows of the nodes.
    ends: [Arc<[u32]>; 2],
    /// Their lengths, `[intervals]`.
    length: Tensor<T>,
    /// The intervals of each ray.
    segments: Segments,
}

impl<T: Scalar> Intervals<T> {
    fn between(nodes: &Samples<T>) -> Self {
        let delta = nodes.delta.as_slice();
        let first: Arc<[u32]> = (0..delta.len()).filter(|&i| delta[i] != T::ZERO).map(|i| i as u32).collect();
        let offsets = nodes.segments.offsets().iter().map(|&end| first.partition_point(|&node| node < end) as u32);
        Intervals {
            length: Tensor::from_vec(&[first.len()], first.iter().map(|&node| delta[node as usize]).collect()),
            segments: Segments::new(offsets.collect::<Vec<_>>()),
            ends: [first.clone(), first.iter().map(|node| node + 1).collect()],
        }
    }

    /// The density at both ends of each interval, and its optical depth, each `[intervals]`.
    #[track_caller]
    fn optical_depth<'t>(&self, density: &Density<'t, T>) -> ([Var<'t, T>; 2], Var<'t, T>) {
        // `sigma` caps log densities, so that they are finite.
        let sigma = density.sigma();
        let [a, b] = self.ends.each_ref().map(|nodes| sigma.gather_rows(nodes.clone()));
        let half = sigma.tape().constant(self.length.clone()) * 0.5;
        // Halved before the sum, which may overflow.
        let depth = &a * &half + &b * &half;
        ([a, b], depth)
    }
}

/// Samples on the rays of `steps` at given distances and lengths; `offsets` are the ends of each ray's samples.
pub(super) fn placed<T: Scalar>(steps: &Samples<T>, offsets: Vec<u32>, places: Vec<(T, T)>) -> Samples<T> {
    let (t, delta): (Vec<T>, Vec<T>) = places.into_iter().unzip();
    let tensor = |values: Vec<T>| Tensor::from_vec(&[values.len()], values);
    steps.at(Segments::new(offsets), tensor(t), tensor(delta))
}

impl Quadrature {
    /// Returns true if the rule weights intervals of two nodes instead of samples.
    pub(crate) fn has_intervals(self) -> bool {
        !matches!(self, Quadrature::Left | Quadrature::Midpoint)
    }

    /// Returns the nodes of the rule for `steps`, each the centre of an interval of length `delta`. An adaptive rule
    /// starts with these.
    ///
    /// With two nodes per interval, `delta` of the first one is the interval's length; it is 0 for nodes where no
    /// interval begins.
    pub fn nodes<T: Scalar>(self, steps: &Samples<T>) -> Samples<T> {
        if self == Quadrature::Midpoint {
            return steps.clone();
        }
        let (t, delta) = (steps.t.as_slice(), steps.delta.as_slice());
        let place = |i: usize, offset: f64| t[i] + T::from_f64(offset) * delta[i];
        let (mut nodes, mut offsets) = (Vec::<(T, T)>::new(), vec![0]);
        for rows in steps.segments.ranges() {
            for i in rows.clone() {
                // Adjacent steps share a node.
                let follows = |i: usize| {
                    let gap = (t[i] - t[i - 1]).to_f64() - 0.5 * (delta[i] + delta[i - 1]).to_f64();
                    gap < 0.25 * delta[i].to_f64()
                };
                match self {
                    Quadrature::Left | Quadrature::Midpoint => nodes.push((place(i, -0.5), delta[i])),
                    Quadrature::Gauss2 => nodes.extend([(place(i, -GAUSS), delta[i]), (place(i, GAUSS), T::ZERO)]),
                    Quadrature::PiecewiseLinear | Quadrature::Adaptive { .. } => {
                        match nodes.last_mut().filter(|_| i > rows.start && follows(i)) {
                            Some((_, length)) => *length = delta[i],
                            None => nodes.push((place(i, -0.5), delta[i])),
                        }
                        nodes.push((place(i, 0.5), T::ZERO));
                    }
                }
            }
            offsets.push(nodes.len() as u32);
        }
        placed(steps, offsets, nodes)
    }

    /// Returns the number of intervals per ray for at most `evaluations` nodes, at least one. An adaptive rule starts
    /// with as many.
    pub fn intervals(self, evaluations: usize) -> usize {
        let intervals = match self {
            Quadrature::Left | Quadrature::Midpoint | Quadrature::Adaptive { .. } => evaluations,
            Quadrature::PiecewiseLinear => evaluations.saturating_sub(1),
            Quadrature::Gauss2 => evaluations / 2,
        };
        intervals.max(1)
    }

    /// Computes the weights of the rule's [nodes](Self::nodes) from their density.
    #[track_caller]
    #[inline(never)]
    pub fn weighted<'t, T: Scalar>(self, density: &Density<'t, T>, nodes: &Samples<T>) -> RayWeights<'t, T> {
        if !self.has_intervals() {
            let depth = density.optical_depth(&nodes.delta);
            let weights = weights(&depth, &nodes.segments);
            return RayWeights { weights, optical_depth: depth.segment_sum(&nodes.segments) };
        }
        let intervals = Intervals::between(nodes);
        let ([a, b], depth) = intervals.optical_depth(density);
        let weights = weights(&depth, &intervals.segments);
        let second = match self {
            Quadrature::Gauss2 => &weights * gauss_share(&a, &b, &depth),
            _ => &weights * 0.5,
        };
        let [first, second] = [weights - &second, second];
        let [a, b] = intervals.ends;
        let weights = first.scatter_rows(a, nodes.len()) + second.scatter_rows(b, nodes.len());
        RayWeights { weights, optical_depth: depth.segment_sum(&intervals.segments) }
    }

    /// Renders the rule's [nodes](Self::nodes) of a field.
    #[track_caller]
    pub fn render_nodes<'t, T: Scalar>(self, query: &Query<'_, 't, T>, nodes: Samples<T>) -> Rendered<'t, T> {
        let positions = query.positions(&nodes);
        let density = query.density_at(&nodes, &positions);
        self.render_density(query, nodes, positions, density)
    }

    /// Renders as [`render_nodes`](Self::render_nodes), with a known density at the nodes.
    #[track_caller]
    pub(crate) fn render_density<'t, T: Scalar>(
        self,
        query: &Query<'_, 't, T>,
        samples: Samples<T>,
        positions: Var<'t, T>,
        density: Density<'t, T>,
    ) -> Rendered<'t, T> {
        let RayWeights { weights, optical_depth } = self.weighted(&density, &samples);
        let color = query.color(&density.features, &samples);
        let color = accumulate(&weights, &color, &samples.segments);
        let directions = query.directions(&samples);
        Rendered { samples, positions, directions, density, weights, optical_depth, color }
    }

    /// The nodes of the intervals with more than `termination` of the light left in front, and their rows among all
    /// nodes.
    pub(crate) fn visible_nodes<T: Scalar>(
        self,
        density: &Density<'_, T>,
        nodes: &Samples<T>,
        early_stop_eps: f64,
    ) -> (Samples<T>, Vec<u32>) {
        let (intervals, pool) = (Intervals::between(nodes), density.value.tape().pool());
        let depth = intervals.optical_depth(density).1;
        let light = Weights::new(intervals.segments).transmittance(depth.value(), pool);
        let mut delta = pool.full(&[nodes.len()], T::ZERO);
        let length = delta.as_mut_slice();
        for ((&node, &own), &light) in intervals.ends[0].iter().zip(intervals.length.as_slice()).zip(light.as_slice()) {
            if light > T::from_f64(early_stop_eps) {
                length[node as usize] = own;
            }
        }
        let is_end = |&i: &usize| length[i] != T::ZERO || i > 0 && length[i - 1] != T::ZERO;
        let rows: Vec<u32> = (0..length.len()).filter(is_end).map(|i| i as u32).collect();
        (Samples { delta, ..nodes.clone() }.select(&rows, pool), rows)
    }
}
