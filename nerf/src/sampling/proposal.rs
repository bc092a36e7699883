//! Proposal sampling: small density fields guide the samples of the field (mip-NeRF 360).

use super::steps::{even_edges, invert_cdf};
use super::{BatchSize, Progress, ProposalHistogram, Purpose, RayTolerance, Sampled, Sampler, Samplers};
use crate::camera::rays::{Rays, Samples};
use crate::component::{BuildContext, ComponentConfig};
use crate::encoding::hash_grid::HashGridConfig;
use crate::field::{Density, DensityNetwork, Field, ViewInputs};
use crate::random::Jitter;
use crate::range::check_range;
use crate::space::occupancy::DensityFn;
use crate::volume::query::Query;
use crate::volume::render::{Evaluations, weights};
use crate::{Error, Result};
use raygrad_autograd::{Scalar, Segments, Tensor, Var};
use raygrad_nn::Bound;
use serde::{Deserialize, Serialize};

/// The spacing of the first samples along a ray.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Spacing {
    /// Evenly in distance.
    Linear,
    /// For unbounded scenes: evenly up to 1 scene unit from the camera, then evenly in inverse distance. These are the
    /// piecewise samples of nerfacto (Tancik et al. 2023, section 4.1), after Barron et al. 2022, section 4.
    Disparity,
}

/// Configuration of one proposal field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProposalLevel {
    /// Hash grid of the proposal network.
    pub grid: HashGridConfig,
    /// Width of the one hidden layer between the grid and the density. Range: 1 to 4096.
    pub width: usize,
    /// Samples a ray for this proposal network. Range: 1 to 4096.
    pub samples: usize,
}

/// Configuration of a [`Proposal`] sampler.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ProposalConfig {
    /// Proposal networks, at least one. Each is sampled where the one before it found density.
    pub levels: Vec<ProposalLevel>,
    /// Samples a ray for the field itself. Range: 1 to 4096.
    pub samples: usize,
    /// Share of all samples that is spread evenly. Range: 0 to 1.
    pub uniform_share: f64,
    /// Training steps over which the proposal weights reach their full effect (Barron et al. 2022, section 4,
    /// "annealing"). Unit: steps.
    pub anneal: u64,
    /// Spacing of the first samples of a ray. null: disparity in an unbounded scene, else linear.
    pub spacing: Option<Spacing>,
    /// Rays in a training step. Range: 1 to 1048576.
    pub batch: usize,
    /// Rays in a tile, which one core computes on one tape. Range: 1 to 65536.
    pub tile: usize,
    /// Early termination: samples are dropped where the transmittance is below this. A colour changes by at most as
    /// much. Views also leave out colours of samples that weigh as much together. Range: 0 to 1.
    #[serde(alias = "termination")]
    pub early_stop_eps: f64,
}

impl Default for ProposalConfig {
    /// Two proposals of 48 and 24 samples, and 16 of the field: see docs/benchmarks/results.md, section Samplers.
    fn default() -> Self {
        let level = |finest, samples| ProposalLevel {
            grid: HashGridConfig { levels: 4, features: 2, log2_table: 14, coarsest: 16, finest },
            width: 16,
            samples,
        };
        ProposalConfig {
            levels: vec![level(64, 48), level(128, 24)],
            samples: 16,
            uniform_share: 0.01,
            anneal: 500,
            spacing: None,
            batch: 2048,
            tile: 256,
            early_stop_eps: 1e-3,
        }
    }
}

impl ComponentConfig<Samplers> for ProposalConfig {
    const KIND: &'static str = "proposal";

    fn check(&self) -> Result<()> {
        if self.levels.is_empty() {
            return Err(Error::setting("levels", "is empty; use at least one proposal"));
        }
        for level in &self.levels {
            check_range("levels.samples", level.samples, 1, 1 << 12)?;
            check_range("levels.width", level.width, 1, 1 << 12)?;
        }
        check_range("samples", self.samples, 1, 1 << 12)?;
        check_range("batch", self.batch, 1, 1 << 20)?;
        check_range("tile", self.tile, 1, 1 << 16)?;
        check_range("early_stop_eps", self.early_stop_eps, 0.0, 1.0)?;
        check_range("uniform_share", self.uniform_share, 0.0, 1.0)
    }

    fn build<T: Scalar>(&self, mut site: BuildContext<'_, T>) -> Result<Box<dyn Sampler<T>>> {
        let mut fields = vec![];
        for (i, level) in self.levels.iter().enumerate() {
            let name = format!("proposal.{i}");
            fields.push(Proposer(DensityNetwork::new(&level.grid, level.width, 1, site.child(&name))?));
        }
        let usual = if site.space.unbounded { Spacing::Disparity } else { Spacing::Linear };
        let spacing = self.spacing.unwrap_or(usual);
        Ok(Box::new(Proposal { config: self.clone(), spacing, fields, trust: 0.0 }))
    }
}

/// A field of which only the density is used.
#[derive(Debug, Clone)]
struct Proposer(DensityNetwork);

impl<T: Scalar> Field<T> for Proposer {
    fn density<'t>(&self, params: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
        self.0.density(params, positions)
    }

    /// A placeholder, never used.
    fn color<'t>(&self, _: &Bound<'t, T>, features: &Var<'t, T>, _: &ViewInputs<'_, 't, T>) -> Var<'t, T> {
        features.tape().constant(Tensor::full(&[features.shape()[0], 3], T::from_f64(0.5)))
    }
}

/// Proposal sampling (Barron et al. 2022, mip-NeRF 360, section 3).
///
/// Each proposal is a small density field. Its weights along a ray are the histogram from which the next proposal's
/// samples are drawn, and finally those of the field. Proposals are not trained on images but on the field's weights,
/// with [`interlevel`](crate::losses::interlevel).
#[derive(Debug, Clone)]
pub struct Proposal {
    /// The configuration.
    pub config: ProposalConfig,
    spacing: Spacing,
    fields: Vec<Proposer>,
    /// The annealing exponent of the proposals' weights: 0 ignores them.
    trust: f64,
}

/// The map from shares of a ray's span, even in the spacing, to distances.
struct Scale {
    /// Near and far, in the coordinate in which samples are even.
    ends: [f64; 2],
    spacing: Spacing,
}

impl Scale {
    fn new<T: Scalar>(spacing: Spacing, span: [T; 2]) -> Self {
        let ends = span.map(|t| match (spacing, t.to_f64()) {
            (Spacing::Linear, t) => t,
            (Spacing::Disparity, t) if t < 1.0 => 0.5 * t,
            (Spacing::Disparity, t) => 1.0 - 0.5 / t,
        });
        Scale { ends, spacing }
    }

    fn distance(&self, share: f64) -> f64 {
        let [near, far] = self.ends;
        let place = near + share * (far - near);
        match self.spacing {
            Spacing::Linear => place,
            Spacing::Disparity if place < 0.5 => 2.0 * place,
            Spacing::Disparity => 0.5 / (1.0 - place),
        }
    }
}

impl Proposal {
    /// The samples at the centres of bins, with bin edges as distances; `shares` are the edges as shares of each ray's
    /// span.
    fn steps<T: Scalar>(
        &self,
        rays: &Rays<T>,
        shares: &[f64],
        bins: usize,
        query: &Query<'_, '_, T>,
    ) -> (Samples<T>, Vec<f64>) {
        let pool = query.tape().pool();
        let segments = Segments::uniform(rays.len(), bins);
        let (mut t, mut delta) = (pool.tensor(&[segments.rows()]), pool.tensor(&[segments.rows()]));
        let mut edges = Vec::with_capacity(shares.len());
        let mut out = t.as_mut_slice().iter_mut().zip(delta.as_mut_slice());
        for (span, shares) in rays.spans.iter().zip(shares.chunks_exact(bins + 1)) {
            let scale = Scale::new(self.spacing, *span);
            let first = edges.len();
            edges.extend(shares.iter().map(|&share| scale.distance(share)));
            for (pair, (t, delta)) in edges[first..].windows(2).zip(&mut out) {
                *t = T::from_f64(0.5 * (pair[0] + pair[1]));
                *delta = T::from_f64((pair[1] - pair[0]).max(0.0));
            }
        }
        (Samples::new(rays, segments, t, delta, pool), edges)
    }

    /// Edges of `bins` bins per ray, as shares of its span, around samples drawn from a histogram over `shares`. With
    /// `whole` the outermost bins extend to the ends of the span.
    fn resampled<T: Scalar>(
        &self,
        shares: &[f64],
        weights: &[T],
        [old, bins]: [usize; 2],
        whole: bool,
        jitter: &mut Jitter<'_>,
    ) -> Vec<f64> {
        let rays = weights.len() / old;
        let (mut u, mut places, mut out) = (vec![0.0; bins], vec![0.0; bins], Vec::with_capacity(rays * (bins + 1)));
        let mut tempered = vec![0.0_f64; old];
        for (shares, weights) in shares.chunks_exact(old + 1).zip(weights.chunks_exact(old)) {
            let shift = jitter.draw();
            u.iter_mut().enumerate().for_each(|(i, u)| *u = (i as f64 + shift) / bins as f64);
            // Bad weights count as 0 here; the colours show them.
            let temper = |weight: &T| match weight.to_f64() {
                weight if !(weight.is_finite() && weight > 0.0) => 0.0,
                // Exact, as a power is not needed from the end of annealing on.
                weight if self.trust == 1.0 => weight,
                weight => weight.powf(self.trust),
            };
            tempered.iter_mut().zip(weights).for_each(|(out, weight)| *out = temper(weight));
            if invert_cdf(shares, &tempered, self.config.uniform_share, &u, &mut places).is_err() {
                places.copy_from_slice(&u);
            }
            let first = out.len();
            out.push(0.0);
            out.extend(places.windows(2).map(|pair| 0.5 * (pair[0] + pair[1])));
            out.push(1.0);
            if !whole && bins > 1 {
                // Symmetric around the outermost positions.
                out[first] = (2.0 * places[0] - out[first + 1]).max(0.0);
                out[first + bins] = (2.0 * places[bins - 1] - out[first + bins - 1]).min(1.0);
            }
        }
        out
    }
}

impl<T: Scalar> Sampler<T> for Proposal {
    fn sample<'t>(
        &self,
        query: &Query<'_, 't, T>,
        rays: &Rays<T>,
        _: Purpose,
        jitter: &mut Jitter<'_>,
    ) -> Sampled<'t, T> {
        // Proposals follow the field; no other gradient flows to them.
        let query = &Query { rays: None, ..*query };
        let mut shares: Vec<f64> = even_edges(self.config.levels[0].samples).repeat(rays.len());
        let (mut levels, mut asked) = (vec![], 0);
        for (i, (level, field)) in self.config.levels.iter().zip(&self.fields).enumerate() {
            let (samples, edges) = self.steps(rays, &shares, level.samples, query);
            let density = query.of(field).density(&samples);
            let weights = weights(&density.optical_depth(&samples.delta), &samples.segments);
            let next = self.config.levels.get(i + 1);
            let bins = [level.samples, next.map_or(self.config.samples, |next| next.samples)];
            shares = self.resampled(&shares, weights.value().as_slice(), bins, next.is_some(), jitter);
            asked += samples.len() as u64;
            levels.push(ProposalHistogram { edges, weights, segments: samples.segments });
        }
        let steps = self.steps(rays, &shares, self.config.samples, query).0;
        let unskipped = asked + steps.len() as u64;
        Sampled {
            samples: steps,
            coarse: vec![],
            histograms: levels,
            evaluations: Evaluations { density: asked, color: 0, unskipped },
        }
    }

    fn batch_size(&self) -> BatchSize {
        BatchSize::Rays { step: self.config.batch, tile: self.config.tile }
    }

    fn boxed(&self) -> Box<dyn Sampler<T>> {
        Box::new(self.clone())
    }

    fn early_stop_eps(&self) -> f64 {
        self.config.early_stop_eps
    }

    fn tolerance(&self) -> RayTolerance {
        RayTolerance {
            early_stop_eps: self.config.early_stop_eps as f32,
            color_budget: self.config.early_stop_eps as f32,
        }
    }

    fn view_tile(&self) -> usize {
        256
    }

    fn fields(&self) -> Vec<&dyn Field<T>> {
        self.fields.iter().map(|field| field as &dyn Field<T>).collect()
    }

    fn update(&mut self, progress: &Progress, _: &DensityFn<'_>) -> bool {
        // Schlick's bias function with the slope 10.
        let x = (progress.step as f64 / self.config.anneal.max(1) as f64).min(1.0);
        self.trust = 10.0 * x / (9.0 * x + 1.0);
        false
    }

    fn finish(&mut self, _: &DensityFn<'_>) {
        self.trust = 1.0;
    }

    fn load_state(&mut self, _: &std::collections::HashMap<String, Vec<u8>>) -> Result<()> {
        self.trust = 1.0;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn proposal_samples_follow_histograms() {
        let config = ProposalConfig { uniform_share: 0.0, samples: 8, ..ProposalConfig::default() };
        let sampler = Proposal { config, spacing: Spacing::Linear, fields: vec![], trust: 1.0 };
        let shares = even_edges(10).repeat(2);
        let mut weights = vec![0.0; 20];
        (weights[3], weights[15]) = (0.5, 1.0);
        let found = sampler.resampled::<f64>(&shares, &weights, [10, 8], false, &mut Jitter::Middle);
        for (edges, range) in found.chunks_exact(9).zip([0.2999999..=0.4000001, 0.4999999..=0.6000001]) {
            assert!(edges.iter().all(|edge| range.contains(edge)), "{edges:?}");
            assert!(edges.windows(2).all(|pair| pair[0] < pair[1]), "{edges:?}");
        }
        let whole = sampler.resampled::<f64>(&shares, &weights, [10, 8], true, &mut Jitter::Middle);
        assert!(whole.chunks_exact(9).all(|edges| edges[0] == 0.0 && edges[8] == 1.0));
        // Two samples in a quarter of the weight, and six in three quarters.
        (weights[3], weights[7]) = (0.25, 0.75);
        let found = sampler.resampled::<f64>(&shares, &weights, [10, 8], false, &mut Jitter::Middle);
        assert_eq!(found[..9].iter().filter(|edge| **edge < 0.5).count(), 2, "{found:?}");
        // An exponent of 0 ignores the weights: the bins are uniform.
        let sampler = Proposal { trust: 0.0, ..sampler };
        let even = sampler.resampled::<f64>(&shares, &[0.25; 20], [10, 4], true, &mut Jitter::Middle);
        assert!(even.iter().zip([0.0, 0.25, 0.5, 0.75, 1.0].repeat(2)).all(|(a, b)| (a - b).abs() < 1e-12));
    }

    #[test]
    fn proposal_anneal_follows_schlick_bias() {
        let config = ProposalConfig { anneal: 100, early_stop_eps: 0.125, ..ProposalConfig::default() };
        let mut sampler = Box::new(Proposal { config, spacing: Spacing::Disparity, fields: vec![], trust: 0.0 });
        assert_eq!(Sampler::<f64>::early_stop_eps(&*sampler), 0.125);
        let mut at = |step: u64| {
            let progress = Progress { step, train_frac: 0.0, seed: 0 };
            Sampler::<f64>::update(&mut *sampler, &progress, &|_, _| {});
            sampler.trust
        };
        for (step, expected) in [(1, 0.1 / 1.09), (50, 5.0 / 5.5), (100, 1.0), (1000, 1.0), (10, 1.0 / 1.9)] {
            assert!((at(step) - expected).abs() < 1e-12, "{step}: {}", at(step));
        }
        Sampler::<f64>::finish(&mut *sampler, &|_, _| {});
        assert_eq!(sampler.trust, 1.0);
        // The steps use the configured spacing.
        let params = raygrad_nn::Params::<f64>::new();
        let tape = raygrad_autograd::Tape::new();
        let bound = params.bind(&tape);
        let field = crate::analytic::AnalyticField::new(
            crate::analytic::scenes().remove(0).medium,
            &mut raygrad_nn::Params::<f64>::new(),
        );
        let mut rays = Rays::new();
        let ray = crate::camera::pinhole::Ray { origin: glam::DVec3::ZERO, direction: glam::DVec3::Z };
        rays.push(&ray, [1.0, 5.0]);
        let (samples, edges) = sampler.steps(&rays, &even_edges(2), 2, &Query::new(&field, &bound));
        assert!((edges[1] - 5.0 / 3.0).abs() < 1e-12 && (edges[2] - 5.0).abs() < 1e-12, "{edges:?}");
        assert!((samples.t.as_slice()[0] - 4.0 / 3.0).abs() < 1e-12);
    }

    #[test]
    fn spacings_range_from_near_to_far() {
        let close = |a: f64, b: f64| (a - b).abs() <= 1e-9 * b;
        for spacing in [Spacing::Linear, Spacing::Disparity] {
            for [near, far] in [[2.0, 10.0], [0.0, 10.0], [0.2, 0.9], [0.05, 1e4], [3.0, 3000.0]] {
                let scale = Scale::new(spacing, [near, far]);
                assert!(
                    close(scale.distance(0.0), near) && close(scale.distance(1.0), far),
                    "{spacing:?} {near} {far}"
                );
            }
            let nothing = Scale::new(spacing, [0.0, 0.0]);
            assert_eq!([nothing.distance(0.0), nothing.distance(1.0)], [0.0; 2], "a ray without length");
        }
        assert!(close(Scale::new(Spacing::Disparity, [2.0, 10.0]).distance(0.5), 10.0 / 3.0));
        // Half of the samples of an endless ray from the camera are within 1 unit, evenly.
        let endless = Scale::new(Spacing::Disparity, [0.0, 1e12]);
        for (share, distance) in [(0.25, 0.5), (0.5, 1.0), (0.75, 2.0), (0.875, 4.0)] {
            assert!(close(endless.distance(share), distance), "{}", endless.distance(share));
        }
    }

    #[test]
    fn spacing_follows_the_scene_unless_it_is_set() {
        let built = |unbounded: bool, spacing: Option<Spacing>| {
            let config = ProposalConfig { spacing, ..ProposalConfig::default() };
            let space = crate::Space { unbounded, ..crate::Space::within([glam::DVec3::NEG_ONE, glam::DVec3::ONE]) };
            let params = &mut raygrad_nn::Params::<f32>::new();
            let rng = &mut <rand_pcg::Pcg64Mcg as rand::SeedableRng>::seed_from_u64(0);
            let sampler = config.build(BuildContext { space, frames: 0, params, name: "sampler", rng }).unwrap();
            let sampler: Box<dyn std::any::Any> = sampler;
            sampler.downcast::<Proposal>().unwrap().spacing
        };
        assert_eq!([false, true].map(|unbounded| built(unbounded, None)), [Spacing::Linear, Spacing::Disparity]);
        assert_eq!(built(true, Some(Spacing::Linear)), Spacing::Linear);
    }
}
