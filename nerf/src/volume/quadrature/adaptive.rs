//! Intervals that are halved until halving them changes little.

use super::{Intervals, Plan, Quadrature, Share};
use crate::camera::rays::Samples;
use crate::volume::query::Query;
use raygrad_autograd::{Real, Scalar, Segments, Tensor};

/// No interval is halved more often.
const MOST_HALVINGS: usize = 24;

/// A plan that follows the field, and what it took to find it.
#[derive(Debug, Clone)]
pub struct Refined<T: Scalar> {
    /// Nodes and intervals, without those that too little light reaches.
    pub plan: Plan<T>,
    /// Evaluations of density and colour.
    pub evaluations: usize,
}

/// What the field says at one place.
#[derive(Debug, Clone, Copy)]
struct Node {
    t: f64,
    sigma: f64,
    color: [f64; 3],
}

/// A node, and what follows it up to the next one.
#[derive(Debug, Clone, Copy)]
struct Link {
    node: Node,
    /// Length of the interval to the next node; `None` where there is a gap.
    length: Option<f64>,
    /// Whether it may have to be halved.
    open: bool,
}

/// Halves the intervals between the ends of `steps` (see [`Quadrature::plan`]) until the estimated change of the pixel by
/// halving one is at most `tolerance`. The change is bounded over all colours in 0..=1 that may lie behind.
///
/// Intervals that no more light than `least` reaches are left out. Nothing is recorded: no gradient flows through the
/// choice of places. A feature that shows at no node of `steps` is not found.
pub fn refine<'t, T: Scalar>(query: &Query<'_, 't, T>, steps: &Samples<T>, tolerance: f64, least: f64) -> Refined<T> {
    let first = Quadrature::PiecewiseLinear.plan(steps, query.tape().pool());
    let mut asker = Asker { query, steps, evaluations: 0 };
    let mut rays = asker.begin(&first);
    for _ in 0..MOST_HALVINGS {
        let middles: Vec<Vec<f64>> = rays.iter().map(|links| middles::<T>(links, least)).collect();
        if middles.iter().all(Vec::is_empty) {
            break;
        }
        let mut found = asker.ask(&middles).into_iter();
        for (links, middles) in rays.iter_mut().zip(&middles) {
            *links = halved(links, middles, &mut found, tolerance);
        }
    }
    Refined { plan: asker.finish(&rays, least), evaluations: asker.evaluations }
}

impl Quadrature {
    /// The plan for steps along rays that is made for this field: an adaptive rule asks it where to look, and leaves out
    /// what no more light than `least` reaches.
    pub fn plan_for<'t, T: Scalar>(self, query: &Query<'_, 't, T>, steps: &Samples<T>, least: f64) -> Refined<T> {
        if let Quadrature::Adaptive { tolerance } = self {
            return refine(query, steps, tolerance, least);
        }
        let plan = self.plan(steps, query.tape().pool());
        Refined { evaluations: plan.len(), plan }
    }
}

/// Places to ask at next: the middles of open intervals that light reaches and that can be halved in this precision.
fn middles<T: Scalar>(links: &[Link], least: f64) -> Vec<f64> {
    let mut depth = 0.0_f64;
    let mut out = vec![];
    for pair in links.windows(2) {
        let Some(length) = pair[0].length else { continue };
        let [a, b] = [pair[0].node, pair[1].node];
        let middle = T::from_f64(0.5 * (a.t + b.t)).to_f64();
        if pair[0].open && (-depth).exp() > least && a.t < middle && middle < b.t {
            out.push(middle);
        }
        depth += 0.5 * length * (a.sigma + b.sigma);
    }
    out
}

/// The links with the open intervals halved at `middles`, where the field said what `found` gives.
fn halved(links: &[Link], middles: &[f64], found: &mut impl Iterator<Item = Node>, tolerance: f64) -> Vec<Link> {
    let mut out = Vec::with_capacity(links.len() + middles.len());
    let (mut next, mut depth) = (0, 0.0_f64);
    for (i, link) in links.iter().enumerate() {
        let (Some(length), Some(end)) = (link.length, links.get(i + 1)) else {
            out.push(*link);
            continue;
        };
        let (a, b) = (link.node, end.node);
        let inside = middles.get(next).is_some_and(|&middle| a.t < middle && middle < b.t);
        let Some(middle) = (if inside { found.next() } else { None }) else {
            out.push(Link { open: false, ..*link });
            depth += 0.5 * length * (a.sigma + b.sigma);
            continue;
        };
        next += 1;
        let half = 0.5 * length;
        let open = (-depth).exp() * change(a, middle, b, length) > tolerance;
        out.push(Link { length: Some(half), open, ..*link });
        out.push(Link { node: middle, length: Some(half), open });
        depth += 0.5 * half * (a.sigma + 2.0 * middle.sigma + b.sigma);
    }
    out
}

/// The most that a pixel can change when the interval from a to b of this length is halved, if all light reaches it; NaN if
/// a number is.
fn change(a: Node, middle: Node, b: Node, length: f64) -> f64 {
    let passed = |a: Node, b: Node, length: f64| (-0.5 * length * (a.sigma + b.sigma)).exp();
    let [whole, near, far] = [passed(a, b, length), passed(a, middle, 0.5 * length), passed(middle, b, 0.5 * length)];
    let difference = near * far - whole;
    let channel = |c: usize| {
        let mean = |a: Node, b: Node| 0.5 * (a.color[c] + b.color[c]);
        let halves = (1.0 - near) * mean(a, middle) + near * (1.0 - far) * mean(middle, b);
        let emitted = halves - (1.0 - whole) * mean(a, b);
        // With black and with white behind.
        Real::maximum(emitted.abs(), (emitted + difference).abs())
    };
    (0..3).map(channel).fold(0.0, Real::maximum)
}

/// Asks a field, unrecorded.
struct Asker<'a, 't, T: Scalar> {
    query: &'a Query<'a, 't, T>,
    steps: &'a Samples<T>,
    evaluations: usize,
}

impl<T: Scalar> Asker<'_, '_, T> {
    /// Samples at these distances along each ray.
    fn samples(&self, places: &[Vec<f64>]) -> Samples<T> {
        let t: Vec<T> = places.iter().flatten().map(|&place| T::from_f64(place)).collect();
        let ends = places.iter().scan(0, |end, places| {
            *end += places.len() as u32;
            Some(*end)
        });
        let segments = Segments::new([0].into_iter().chain(ends).collect::<Vec<_>>());
        let count = t.len();
        self.steps.at(segments, Tensor::from_vec(&[count], t), Tensor::zeros(&[count]))
    }

    /// What the field says at these distances along each ray, ray after ray.
    fn ask(&mut self, places: &[Vec<f64>]) -> Vec<Node> {
        let samples = self.samples(places);
        self.evaluations += samples.len();
        self.query.tape().no_grad(|| {
            let density = self.query.density(&samples);
            let (sigma, color) = (density.sigma(), self.query.color(&density.features, &samples));
            let places = places.iter().flatten();
            let values = sigma.value().as_slice().iter().zip(color.value().as_slice().chunks_exact(3)).zip(places);
            let node = |((sigma, color), &t): ((&T, &[T]), &f64)| Node {
                t,
                sigma: sigma.to_f64(),
                color: [color[0], color[1], color[2]].map(T::to_f64),
            };
            values.map(node).collect()
        })
    }

    /// The links of each ray between the nodes of a plan.
    fn begin(&mut self, plan: &Plan<T>) -> Vec<Vec<Link>> {
        let t = plan.samples.t.as_slice();
        let places: Vec<Vec<f64>> =
            plan.samples.segments.ranges().map(|rows| t[rows].iter().map(|t| t.to_f64()).collect()).collect();
        let nodes = self.ask(&places);
        let mut length = vec![None; nodes.len()];
        if let Some(Intervals { nodes: [first, _], length: lengths, .. }) = &plan.intervals {
            first.iter().zip(lengths.as_slice()).for_each(|(&a, h)| length[a as usize] = Some(h.to_f64()));
        }
        let link = |i: usize| Link { node: nodes[i], length: length[i], open: true };
        plan.samples.segments.ranges().map(|rows| rows.map(link).collect()).collect()
    }

    /// The plan of what light reaches.
    fn finish(&self, rays: &[Vec<Link>], least: f64) -> Plan<T> {
        let (mut places, mut ends) = (Vec::with_capacity(rays.len()), vec![0_u32]);
        let (mut first, mut length) = (vec![], vec![]);
        let mut total = 0_u32;
        for links in rays {
            let mut depth = 0.0_f64;
            let mut last = 0;
            for (i, pair) in links.windows(2).enumerate() {
                let Some(h) = pair[0].length else { continue };
                if !((-depth).exp() > least) {
                    break;
                }
                depth += 0.5 * h * (pair[0].node.sigma + pair[1].node.sigma);
                first.push(total + i as u32);
                length.push(T::from_f64(h));
                last = i + 2;
            }
            places.push(links[..last].iter().map(|link| link.node.t).collect());
            total += last as u32;
            ends.push(first.len() as u32);
        }
        let second = first.iter().map(|a| a + 1).collect();
        let intervals = Intervals {
            nodes: [first.into(), second],
            length: Tensor::from_vec(&[length.len()], length),
            segments: Segments::new(ends),
            share: Share::Mean,
        };
        Plan { samples: self.samples(&places), intervals: Some(intervals) }
    }
}
