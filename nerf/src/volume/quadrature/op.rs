//! Compositing of intervals between two nodes.

use crate::volume::composite::Composite;
#[cfg(feature = "check")]
use raygrad_autograd::check::Entry;
use raygrad_autograd::{Grads, Op, Pool, Reads, Scalar, Segments, Shape, ShapeError, Tensor, Var, Vjp};
use raygrad_tensor::map;
use std::sync::Arc;

/// How much of an interval's colour comes from its second node; the rest comes from its first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Share {
    /// Half, for nodes at both ends.
    Mean,
    /// What is exact for colour linear in optical depth, for the nodes of two-point Gauss quadrature: at `1/2 -+ sqrt(3)/6`
    /// of the interval, see [`gauss_share`].
    Gauss,
}

/// Intervals, and the nodes where the field was asked.
#[derive(Debug, Clone)]
pub struct Intervals<T: Scalar> {
    /// The first and the second node of each interval, as rows of the samples.
    pub nodes: [Arc<[u32]>; 2],
    /// Length of each interval, `[intervals]`, at least 0 and finite.
    pub length: Tensor<T>,
    /// The intervals of each ray.
    pub segments: Segments,
    /// How colours are weighted.
    pub share: Share,
}

/// Composites intervals, front to back, whose optical depth and colour come from two nodes each.
///
/// Inputs are the density `[samples]`, at least 0 (or its logarithm), and `features [samples, channels]`. Interval k of
/// length h with nodes a and b has the optical depth `x_k = h (sigma_a + sigma_b) / 2` and the features
/// `(1 - f) c_a + f c_b` with a [`Share`] f. What follows is [`Composite`]'s, and so is the output
/// `[rays, channels + 1]`. The gradient is that of the formula; where f is cut to 0 or 1, or where both densities are 0, f
/// counts as a constant.
#[derive(Debug, Clone)]
pub struct CompositeIntervals<T: Scalar> {
    intervals: Intervals<T>,
    samples: usize,
    log_density: bool,
    /// For optical depths.
    inner: Composite<T>,
}

/// Logarithms of densities are cut here, as in [`Composite`]; the square of a length times that is finite.
const MOST_LOG_DENSITY: f64 = 80.0;
const SQRT_3: f64 = 1.732_050_807_568_877_3;

/// `1/2 - 1/x + 1/(e^x - 1)`: how far in front of the middle of an interval of optical depth x the light that leaves it
/// comes from on average, as a share of the interval's optical depth. And its derivative.
fn lead(x: f64) -> [f64; 2] {
    if x < SERIES_BELOW {
        let square = x * x;
        // B_(2n) / (2n)!.
        let (mut value, mut slope) = (0.0, 0.0);
        for (n, c) in LEAD_SERIES.iter().enumerate().rev() {
            value = value * square + c;
            slope = slope * square + c * (2 * n + 1) as f64;
        }
        return [x * value, slope];
    }
    let opacity = -(-x).exp_m1();
    [0.5 - 1.0 / x + 1.0 / x.exp_m1(), (1.0 / x).powi(2) - (-x).exp() / (opacity * opacity)]
}

const SERIES_BELOW: f64 = 0.5;
const LEAD_SERIES: [f64; 6] =
    [1.0 / 12.0, -1.0 / 720.0, 1.0 / 30240.0, -1.0 / 1_209_600.0, 1.0 / 47_900_160.0, -691.0 / 1_307_674_368_000.0];

/// The share of the second node for densities a and b of the two and optical depth x of the interval, in 0..=1.
///
/// With the nodes at optical depths `tau_a = h (a/4 + b (1/4 - s/6))` and `tau_b = h (a (1/4 + s/6) + b/4)`, s the root of
/// 3, colour linear in optical depth gives `f = (m - tau_a) / (tau_b - tau_a)` with the mean optical depth
/// `m = 1 - x / (e^x - 1)` from which light comes. That is `b / (a + b) - s (1/2 - 1/x + 1/(e^x - 1))`. Beyond a depth of
/// about 5 that would extrapolate: it is cut at 0.
pub fn gauss_share(a: f64, b: f64, x: f64) -> f64 {
    let ratio = if a + b > 0.0 { b / (a + b) } else { 0.5 };
    (ratio - SQRT_3 * lead(x)[0]).clamp(0.0, 1.0)
}

/// What becomes of the nodes' values: for each interval the optical depth, the share and the features.
struct Gathered<T: Scalar> {
    sigma: Tensor<T>,
    depth: Tensor<T>,
    share: Vec<T>,
    features: Tensor<T>,
}

impl<T: Scalar> CompositeIntervals<T> {
    /// For these intervals between rows of `samples` densities, or logarithms of densities.
    ///
    /// # Panics
    /// If there are not two nodes and a length for each interval, a node is not a sample, or a length is negative or not
    /// finite.
    #[track_caller]
    pub fn new(intervals: Intervals<T>, samples: usize, log_density: bool) -> Self {
        let count = intervals.segments.rows();
        let [first, second] = &intervals.nodes;
        assert_eq!([first.len(), second.len(), intervals.length.len()], [count; 3], "two nodes and a length each");
        assert!(first.iter().chain(&**second).all(|&node| (node as usize) < samples), "nodes are samples");
        let lengths = intervals.length.as_slice();
        assert!(lengths.iter().all(|&h| h >= T::ZERO && h.is_finite()), "lengths are at least 0 and finite");
        let inner = Composite::new(Tensor::ones(&[count]), intervals.segments.clone());
        CompositeIntervals { intervals, samples, log_density, inner }
    }

    fn sigma(&self, density: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        if !self.log_density {
            return density.clone();
        }
        let most = T::from_f64(MOST_LOG_DENSITY);
        map(
            [density],
            pool,
            #[inline(always)]
            |[z]| (if z > most { most } else { z }).exp(),
        )
    }

    /// The intervals with the numbers of their nodes and their lengths.
    fn each(&self) -> impl Iterator<Item = (usize, [usize; 2], T)> + '_ {
        let Intervals { nodes: [first, second], length, .. } = &self.intervals;
        let nodes = first.iter().zip(&**second).map(|(&a, &b)| [a as usize, b as usize]);
        nodes.zip(length.as_slice()).enumerate().map(|(k, (nodes, &length))| (k, nodes, length))
    }

    fn gather(&self, density: &Tensor<T>, features: &Tensor<T>, pool: &Pool<T>) -> Gathered<T> {
        let channels = features.shape()[1];
        let sigma = self.sigma(density, pool);
        let count = self.intervals.segments.rows();
        let (mut depth, mut share) = (pool.tensor(&[count]), Vec::with_capacity(count));
        let mut mixed = pool.tensor(&[count, channels]);
        let (depth_out, mixed_out) = (depth.as_mut_slice(), mixed.as_mut_slice());
        let (s, c) = (sigma.as_slice(), features.as_slice());
        for (k, [a, b], length) in self.each() {
            let x = T::from_f64(0.5) * length * (s[a] + s[b]);
            let f = match self.intervals.share {
                Share::Mean => T::from_f64(0.5),
                Share::Gauss => T::from_f64(gauss_share(s[a].to_f64(), s[b].to_f64(), x.to_f64())),
            };
            depth_out[k] = x;
            share.push(f);
            for channel in 0..channels {
                let [c_a, c_b] = [c[a * channels + channel], c[b * channels + channel]];
                mixed_out[k * channels + channel] = c_a + f * (c_b - c_a);
            }
        }
        Gathered { sigma, depth, share, features: mixed }
    }

    /// The transmittance in front of each interval and its weight, each `[intervals]`.
    ///
    /// # Panics
    /// If there is not one density for each sample.
    pub fn transmittance_and_weights(&self, density: &Tensor<T>, pool: &Pool<T>) -> [Tensor<T>; 2] {
        assert_eq!(density.shape(), [self.samples], "one density for each sample");
        let no_features = Tensor::zeros(&[self.samples, 0]);
        self.inner.transmittance_and_weights(&self.gather(density, &no_features, pool).depth, pool)
    }

    /// The share as plain operations on both densities and the optical depth, each `[intervals]`.
    fn share_of<'t>(&self, a: &Var<'t, T>, b: &Var<'t, T>, x: &Var<'t, T>) -> Var<'t, T> {
        let constant = |value: f64| x.constant(value);
        if self.intervals.share == Share::Mean {
            return x * 0.0 + 0.5;
        }
        let sum = a + b;
        let ratio = (b / sum.maximum(1e-37)).where_(&sum.gt(0.0), 0.5);
        let (near, far) = (x.minimum(SERIES_BELOW), x.maximum(SERIES_BELOW));
        let square = near.square();
        let series = LEAD_SERIES.iter().rev().fold(constant(0.0), |sum, &c| sum * &square + c) * near;
        let closed = far.expm1().reciprocal() - far.reciprocal() + 0.5;
        let lead = series.where_(&x.lt(SERIES_BELOW), &closed);
        (ratio - lead * SQRT_3).clamp(0.0, 1.0)
    }
}

impl<T: Scalar> Op<T> for CompositeIntervals<T> {
    fn name(&self) -> &'static str {
        "composite_intervals"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let samples = self.samples;
        match (x[0], x[1]) {
            (&[density], &[features, channels]) if density == samples && features == samples => {
                Ok([self.intervals.segments.len(), channels + 1].into_iter().collect())
            }
            _ => Err(format!("densities must be [{samples}] and features [{samples}, channels]")),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let Gathered { depth, features, .. } = self.gather(x[0], x[1], pool);
        self.inner.forward(&[&depth, &features], pool)
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (density, features) = (cx.x(0).into_value(), cx.x(1).into_value());
        let (channels, pool) = (features.shape()[1], cx.pool());
        let gathered = self.gather(&density, &features, pool);
        let [d_depth, d_mixed] = self.inner.backward(&gathered.depth, &gathered.features, cx.g().value(), pool);
        let (mut d_density, mut d_features) =
            (pool.full(density.shape(), T::ZERO), pool.full(features.shape(), T::ZERO));
        let (d_sigma, d_c) = (d_density.as_mut_slice(), d_features.as_mut_slice());
        let (s, c) = (gathered.sigma.as_slice(), features.as_slice());
        for (k, [a, b], length) in self.each() {
            let f = gathered.share[k];
            let mut d_share = T::ZERO;
            for channel in 0..channels {
                let (i, j, d) =
                    (a * channels + channel, b * channels + channel, d_mixed.as_slice()[k * channels + channel]);
                d_c[i] += (T::ONE - f) * d;
                d_c[j] += f * d;
                d_share += d * (c[j] - c[i]);
            }
            let (x, sum) = (gathered.depth.as_slice()[k], s[a] + s[b]);
            let mut d_x = d_depth.as_slice()[k];
            if self.intervals.share == Share::Gauss && f > T::ZERO && f < T::ONE && sum > T::ZERO {
                d_x -= d_share * T::from_f64(SQRT_3 * lead(x.to_f64())[1]);
                // In this order nothing overflows.
                let d_ratio = d_share / sum;
                d_sigma[a] -= d_ratio * (s[b] / sum);
                d_sigma[b] += d_ratio * (s[a] / sum);
            }
            let d_each = T::from_f64(0.5) * length * d_x;
            d_sigma[a] += d_each;
            d_sigma[b] += d_each;
        }
        if self.log_density {
            d_sigma.iter_mut().zip(s).for_each(|(d, &sigma)| *d *= sigma);
        }
        Grads::new([Some(cx.constant(d_density)), Some(cx.constant(d_features))])
    }

    fn is_fused(&self) -> bool {
        true
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let sigma = if self.log_density { x[0].exp() } else { x[0].clone() };
        let [a, b] = self.intervals.nodes.each_ref().map(|nodes| sigma.gather_rows(nodes));
        let depth = (&a + &b) * 0.5 * sigma.tape().constant(self.intervals.length.clone());
        let share = self.share_of(&a, &b, &depth).reshape(&[self.intervals.segments.rows(), 1]);
        let [first, second] = self.intervals.nodes.each_ref().map(|nodes| x[1].gather_rows(nodes));
        let features = &first + (second - &first) * share;
        self.inner.reference(&[depth, features])
    }
}

/// The catalogue entries of this file.
#[cfg(feature = "check")]
pub(crate) fn entries() -> Vec<Entry> {
    fn op<T: Scalar>(share: Share, log_density: bool) -> CompositeIntervals<T> {
        // Nodes that two intervals share, one that stands alone, one that is not used, and a ray without intervals.
        let nodes = [[0, 1, 2, 4, 5].into(), [1, 2, 3, 4, 6].into()];
        let length = Tensor::from_vec(&[5], [0.25, 0.5, 1.25, 0.75, 0.5].map(T::from_f64).to_vec());
        CompositeIntervals::new(
            Intervals { nodes, length, segments: Segments::new([0, 3, 3, 5]), share },
            8,
            log_density,
        )
    }
    let entry = |share, log| Entry::of(op::<f64>(share, log), op::<f32>(share, log));
    let values = |values: [f64; 8]| Tensor::from_vec(&[8], values.to_vec());
    let features = |channels: usize| Tensor::from_fn(&[8, channels], |i| ((i * 29) % 17) as f64 / 17.0);
    let (thin, thick) = ([0.4, 0.6, 0.2, 0.3, 0.1, 0.7, 0.9, 0.5], [2.0, 3.0, 4.0, 1.5, 2.5, 30.0, 40.0, 1.0]);
    let logs = values([-1.4, 0.3, 1.2, 0.4, 0.1, -0.3, 0.9, 0.2]);
    [Share::Mean, Share::Gauss]
        .into_iter()
        .flat_map(|share| {
            [
                entry(share, false).sample_of(vec![values(thin), features(3)]),
                entry(share, false).sample_of(vec![values(thick), features(1)]),
                entry(share, true).sample_of(vec![logs.clone(), features(2)]),
            ]
        })
        .collect()
}
