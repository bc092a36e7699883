//! Early ray termination: rendering only the visible samples.

use super::quadrature::{Quadrature, refine};
use super::query::{Query, RayVars};
use super::render::Rendered;
use super::rounds::FrontToBack;
use crate::camera::rays::Samples;
use raygrad_autograd::{CachedOutputs, Pool, Scalar};

/// The result of rendering the visible samples only.
pub struct VisibleSamples<'t, T: Scalar> {
    /// The rendered rays.
    pub rendered: Rendered<'t, T>,
    /// Number of density evaluations.
    pub density_queries: usize,
    /// Number of visible samples, which were evaluated for colour and gradients.
    pub visible: usize,
}

/// Samples per ray in the first round. Each further round takes twice as many. There are few rounds, and at most about
/// as many unneeded samples as needed ones.
const FIRST_ROUND: usize = 4;

impl Quadrature {
    /// Renders `steps` by this rule, with early ray termination in two passes.
    ///
    /// An unrecorded pass finds the visible samples, where the transmittance exceeds `early_stop_eps`. A recorded pass
    /// evaluates those and reuses the outputs of [cacheable](raygrad_autograd::Op::is_cacheable) operations. With a
    /// `early_stop_eps` of 0 there is only the second pass, on all samples. Dropped samples change a pixel by at most
    /// `early_stop_eps` times the range of colours.
    pub fn render<'t, T: Scalar>(
        self,
        query: &Query<'_, 't, T>,
        steps: &Samples<T>,
        early_stop_eps: f64,
    ) -> VisibleSamples<'t, T> {
        let tape = query.tape();
        if let Quadrature::Adaptive { tolerance } = self {
            let (nodes, asked) = refine(query, steps, tolerance, early_stop_eps);
            return VisibleSamples {
                density_queries: asked,
                visible: nodes.len(),
                rendered: self.render_nodes(query, nodes),
            };
        }
        let nodes = self.nodes(steps);
        if !(early_stop_eps > 0.0) {
            return VisibleSamples {
                density_queries: nodes.len(),
                visible: nodes.len(),
                rendered: self.render_nodes(query, nodes),
            };
        }
        // The unrecorded pass needs no variables.
        let plain = &Query { rays: None, position_grad: false, ..*query };
        let Visible { samples, memo, asked } = tape.no_grad(|| match self.has_intervals() {
            false => visible(plain, &nodes, early_stop_eps),
            true => {
                let (density, memo) = tape.cache_outputs(|| plain.density(&nodes));
                let (samples, rows) = self.visible_nodes(&density, &nodes, early_stop_eps);
                let rows: Vec<[u32; 2]> = rows.into_iter().map(|row| [0, row]).collect();
                Visible { samples, memo: gathered(vec![memo], &rows, &[nodes.len()], tape.pool()), asked: nodes.len() }
            }
        });
        let positions = query.positions(&samples);
        // Refined rays may differ from the marched ones.
        let same = |rays: &RayVars<'t, T>| {
            rays.origins.value() == &samples.origins && rays.directions.value() == &samples.directions
        };
        let memo = if query.rays.is_none_or(same) { memo } else { CachedOutputs::gather(&[], &[], tape.pool()) };
        let density = tape.reuse_outputs(memo, || query.density_at(&samples, &positions));
        VisibleSamples {
            visible: samples.len(),
            rendered: self.render_density(query, samples, positions, density),
            density_queries: asked,
        }
    }
}

/// The visible samples.
struct Visible<T: Scalar> {
    samples: Samples<T>,
    /// Cached outputs of operations for them.
    memo: CachedOutputs<T>,
    /// Density queries.
    asked: usize,
}

/// The samples with more than `early_stop_eps` of the light left in front, found in rounds.
fn visible<T: Scalar>(query: &Query<'_, '_, T>, samples: &Samples<T>, early_stop_eps: f64) -> Visible<T> {
    let (tape, mut rays) = (query.tape(), FrontToBack::new(samples, early_stop_eps));
    // For each found sample: its index, and its position among the queries.
    let (mut found, mut memos, mut sizes) = (Vec::<(u32, [u32; 2])>::new(), vec![], vec![]);
    while let (Some(round), memo) = tape.cache_outputs(|| rays.round(query, FIRST_ROUND << memos.len())) {
        let numbers = round.stretch.pieces.into_iter().flat_map(|(_, rows)| rows);
        for ((row, sample), depth) in (0..).zip(numbers).zip(&round.in_front) {
            if rays.has_light(*depth) {
                found.push((sample as u32, [memos.len() as u32, row]));
            }
        }
        sizes.push(round.in_front.len());
        memos.push(memo);
    }
    found.sort_unstable_by_key(|(sample, _)| *sample);
    let (rows, places): (Vec<u32>, Vec<[u32; 2]>) = found.into_iter().unzip();
    let memo = gathered(memos, &places, &sizes, tape.pool());
    Visible { samples: samples.select(&rows, tape.pool()), memo, asked: sizes.iter().sum() }
}

/// Gathers rows of the memos of `sizes` samples; an empty memo if an output has other rows than samples.
fn gathered<T: Scalar>(
    memos: Vec<CachedOutputs<T>>,
    rows: &[[u32; 2]],
    sizes: &[usize],
    pool: &Pool<T>,
) -> CachedOutputs<T> {
    let fits = |(memo, size): (&CachedOutputs<T>, &usize)| {
        memo.values().iter().all(|value| value.shape().first() == Some(size))
    };
    match memos.iter().zip(sizes).all(fits) {
        true => CachedOutputs::gather(&memos, rows, pool),
        false => CachedOutputs::gather(&[], &[], pool),
    }
}
