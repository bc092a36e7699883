//! Adaptive quadrature: intervals are halved until that changes the pixel little.

use super::Quadrature;
use super::nodes::placed;
use crate::camera::rays::Samples;
use crate::volume::query::Query;
use raygrad_autograd::{Real, Scalar};

/// The most bisections of an interval.
const MOST_HALVINGS: usize = 24;

/// The field's values at one point.
#[derive(Debug, Clone, Copy)]
struct Node {
    t: f64,
    sigma: f64,
    color: [f64; 3],
}

/// A node and the interval after it.
#[derive(Debug, Clone, Copy)]
struct Link {
    node: Node,
    /// Length of the interval to the next node; 0 at a gap.
    length: f64,
    /// True if it may need another bisection.
    open: bool,
}

/// The [nodes](Quadrature::nodes) of an adaptive rule, and the number of density and colour queries.
///
/// Halves the intervals between the ends of `steps` until the estimated change of the pixel by one bisection is at most
/// `tolerance`. The change is bounded over all background colours in 0..=1.
///
/// Intervals that receive no more light than `least` are left out. Nothing is recorded: no gradient flows through the
/// choice of nodes. A feature that shows at no node of `steps` is missed.
pub(crate) fn refine<T: Scalar>(
    query: &Query<'_, '_, T>,
    steps: &Samples<T>,
    tolerance: f64,
    least: f64,
) -> (Samples<T>, usize) {
    let mut asker = Asker { query, steps, evaluations: 0 };
    let mut rays = asker.begin(&Quadrature::PiecewiseLinear.nodes(steps));
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
    (asker.finish(&rays, least), asker.evaluations)
}

/// The next nodes: the midpoints of open, visible intervals that this precision can halve.
fn middles<T: Scalar>(links: &[Link], least: f64) -> Vec<f64> {
    let mut depth = 0.0_f64;
    let mut out = vec![];
    for pair in links.windows(2) {
        let ([a, b], length) = ([pair[0].node, pair[1].node], pair[0].length);
        if length == 0.0 {
            continue;
        }
        let middle = T::from_f64(0.5 * (a.t + b.t)).to_f64();
        if pair[0].open && (-depth).exp() > least && a.t < middle && middle < b.t {
            out.push(middle);
        }
        depth += 0.5 * length * (a.sigma + b.sigma);
    }
    out
}

/// Halves the open intervals at `middles`; `found` has the field's values there.
fn halved(links: &[Link], middles: &[f64], found: &mut impl Iterator<Item = Node>, tolerance: f64) -> Vec<Link> {
    let mut out = Vec::with_capacity(links.len() + middles.len());
    let (mut next, mut depth) = (0, 0.0_f64);
    for (i, link) in links.iter().enumerate() {
        let length = link.length;
        let Some(end) = links.get(i + 1).filter(|_| length != 0.0) else {
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
        out.push(Link { length: half, open, ..*link });
        out.push(Link { node: middle, length: half, open });
        depth += 0.5 * half * (a.sigma + 2.0 * middle.sigma + b.sigma);
    }
    out
}

/// The largest change of a pixel by halving the interval from a to b, if all light reaches it; NaN if a value is.
fn change(a: Node, middle: Node, b: Node, length: f64) -> f64 {
    let passed = |a: Node, b: Node, length: f64| (-0.5 * length * (a.sigma + b.sigma)).exp();
    let [whole, near, far] = [passed(a, b, length), passed(a, middle, 0.5 * length), passed(middle, b, 0.5 * length)];
    let difference = near * far - whole;
    let channel = |c: usize| {
        let mean = |a: Node, b: Node| 0.5 * (a.color[c] + b.color[c]);
        let halves = (1.0 - near) * mean(a, middle) + near * (1.0 - far) * mean(middle, b);
        let emitted = halves - (1.0 - whole) * mean(a, b);
        // Over black and over white.
        Real::maximum(emitted.abs(), (emitted + difference).abs())
    };
    (0..3).map(channel).fold(0.0, Real::maximum)
}

/// Evaluates a field, unrecorded.
struct Asker<'a, 't, T: Scalar> {
    query: &'a Query<'a, 't, T>,
    steps: &'a Samples<T>,
    evaluations: usize,
}

impl<T: Scalar> Asker<'_, '_, T> {
    /// The field's values at these distances along each ray.
    fn ask(&mut self, places: &[Vec<f64>]) -> Vec<Node> {
        let mut offsets = vec![0];
        places.iter().for_each(|places| offsets.push(offsets[offsets.len() - 1] + places.len() as u32));
        let places: Vec<f64> = places.concat();
        let samples = placed(self.steps, offsets, places.iter().map(|&t| (T::from_f64(t), T::ZERO)).collect());
        self.evaluations += samples.len();
        self.query.tape().no_grad(|| {
            let density = self.query.density(&samples);
            let (sigma, color) = (density.sigma(), self.query.color(&density.features, &samples));
            let values = sigma.value().as_slice().iter().zip(color.value().as_slice().as_chunks::<3>().0);
            let node = |((sigma, color), t): ((&T, &[T; 3]), f64)| Node {
                t,
                sigma: sigma.to_f64(),
                color: color.map(T::to_f64),
            };
            values.zip(places).map(node).collect()
        })
    }

    /// The links of each ray from the initial nodes.
    fn begin(&mut self, nodes: &Samples<T>) -> Vec<Vec<Link>> {
        let (t, delta) = (nodes.t.as_slice(), nodes.delta.as_slice());
        let rays = || nodes.segments.ranges();
        let places: Vec<Vec<f64>> = rays().map(|rows| t[rows].iter().map(|t| t.to_f64()).collect()).collect();
        let found = self.ask(&places);
        let link = |i: usize| Link { node: found[i], length: delta[i].to_f64(), open: true };
        rays().map(|rows| rows.map(link).collect()).collect()
    }

    /// The nodes of the visible intervals.
    fn finish(&self, rays: &[Vec<Link>], least: f64) -> Samples<T> {
        let (mut places, mut offsets) = (vec![], vec![0]);
        for links in rays {
            let (mut depth, mut before) = (0.0_f64, 0.0);
            for (i, link) in links.iter().enumerate() {
                let length = if (-depth).exp() > least { link.length } else { 0.0 };
                // An interval begins or ends here.
                if length != 0.0 || before != 0.0 {
                    places.push((T::from_f64(link.node.t), T::from_f64(length)));
                }
                if length != 0.0 {
                    depth += 0.5 * length * (link.node.sigma + links[i + 1].node.sigma);
                }
                before = length;
            }
            offsets.push(places.len() as u32);
        }
        placed(self.steps, offsets, places)
    }
}
