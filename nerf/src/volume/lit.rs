//! Rendering only those samples that light reaches.

use super::quadrature::{Plan, Quadrature, refine};
use super::query::{Query, RayVars};
use super::render::Rendered;
use crate::camera::rays::Samples;
use raygrad_autograd::{Memo, Pool, Scalar};

/// What is seen, and what it took.
pub struct Lit<'t, T: Scalar> {
    /// What is seen.
    pub rendered: Rendered<'t, T>,
    /// Evaluations of a density alone.
    pub asked: usize,
    /// Samples that had light left in front of them, which were evaluated with colour and for gradients.
    pub kept: usize,
}

/// Samples that each ray takes in the first round. Each further round takes twice as many: few rounds, and at most about
/// as many samples in vain as there were needed.
const FIRST_ROUND: usize = 4;

impl Quadrature {
    /// What the intervals of `steps` show of a field by this rule, in two passes: an unrecorded one for the densities, and a
    /// recorded one on the samples that more than `termination` of the light reaches, which takes what was dear to work out
    /// from the first. Without a termination there is only the second, on all samples. What is left out changes a pixel by at most `termination` times the range of colours.
    pub fn render<'t, T: Scalar>(self, query: &Query<'_, 't, T>, steps: &Samples<T>, termination: f64) -> Lit<'t, T> {
        let (tape, pool) = (query.tape(), query.tape().pool());
        if let Quadrature::Adaptive { tolerance } = self {
            let refined = refine(query, steps, tolerance, termination);
            let kept = refined.plan.len();
            return Lit { rendered: refined.plan.render(query), asked: refined.evaluations, kept };
        }
        let plan = self.plan(steps, pool);
        if !(termination > 0.0) {
            return Lit { rendered: plan.render(query), asked: plan.len(), kept: plan.len() };
        }
        // What is found out unrecorded needs no variables.
        let plain = &Query { rays: None, slopes: false, ..*query };
        let (lit, memo, asked) = match &plan.intervals {
            None => {
                let Visible { rows, memo, asked } = tape.no_grad(|| visible(plain, &plan.samples, termination));
                (Plan { samples: plan.samples.select(&rows, pool), intervals: None }, memo, asked)
            }
            Some(intervals) => {
                let (transmittance, memo) = tape.no_grad(|| {
                    let (density, memo) = tape.remember(|| plain.density(&plan.samples));
                    (intervals.transmittance(&density), memo)
                });
                let (lit, rows) = plan.lit(intervals, &transmittance, T::from_f64(termination), pool);
                let rows: Vec<[u32; 2]> = rows.into_iter().map(|row| [0, row]).collect();
                (lit, gathered(vec![memo], &rows, &[plan.len()], pool), plan.len())
            }
        };
        let positions = query.positions(&lit.samples);
        // Rays that are variables may be other rays than those that were marched.
        let same = |rays: &RayVars<'t, T>| {
            rays.origins.value() == &lit.samples.origins && rays.directions.value() == &lit.samples.directions
        };
        let memo = if query.rays.is_none_or(same) { memo } else { Memo::gather(&[], &[], pool) };
        let density = tape.recall(memo, || query.density_at(&lit.samples, &positions));
        Lit { kept: lit.len(), rendered: lit.render_density(query, positions, density), asked }
    }
}

/// The samples that light reaches.
struct Visible<T: Scalar> {
    /// Their numbers, rising.
    rows: Vec<u32>,
    /// What was dear to work out for them.
    memo: Memo<T>,
    /// Samples whose density was evaluated.
    asked: usize,
}

/// Finds the samples in front of which more than `termination` of the light is left, following the rays in rounds.
fn visible<T: Scalar>(query: &Query<'_, '_, T>, samples: &Samples<T>, termination: f64) -> Visible<T> {
    let (tape, pool): (_, &Pool<T>) = (query.tape(), query.tape().pool());
    // The optical depth behind which too little light is left.
    let opaque = -termination.ln();
    let ranges: Vec<_> = samples.segments.ranges().collect();
    let mut depths = vec![0.0; ranges.len()];
    let mut alive: Vec<usize> = (0..ranges.len()).collect();
    // Of what is found: the number of the sample, and its place among what was asked.
    let (mut found, mut memos, mut sizes) = (Vec::<(u32, [u32; 2])>::new(), vec![], vec![]);
    let (mut done, mut size, mut asked) = (0, FIRST_ROUND, 0);
    loop {
        alive.retain(|&ray| ranges[ray].len() > done && depths[ray] < opaque);
        if alive.is_empty() {
            break;
        }
        let piece =
            |&ray: &usize| (ray, ranges[ray].start + done..(ranges[ray].start + done + size).min(ranges[ray].end));
        let pieces: Vec<_> = alive.iter().map(piece).collect();
        let part = samples.pieces(&pieces, pool);
        let (density, memo) = tape.remember(|| query.density(&part));
        let depth = density.optical_depth(&part.delta);
        let depth = depth.value().as_slice();
        for (to, (ray, rows)) in part.segments.ranges().zip(pieces) {
            let total = &mut depths[ray];
            for (row, sample) in to.zip(rows) {
                if *total < opaque {
                    found.push((sample as u32, [memos.len() as u32, row as u32]));
                }
                *total += depth[row].to_f64();
            }
        }
        asked += part.len();
        sizes.push(part.len());
        memos.push(memo);
        (done, size) = (done + size, 2 * size);
    }
    found.sort_unstable_by_key(|(sample, _)| *sample);
    let (rows, places): (Vec<u32>, Vec<[u32; 2]>) = found.into_iter().unzip();
    Visible { rows, memo: gathered(memos, &places, &sizes, pool), asked }
}

/// Rows of what was dear to work out for so many samples at a time; nothing if it has other rows than samples.
fn gathered<T: Scalar>(memos: Vec<Memo<T>>, rows: &[[u32; 2]], sizes: &[usize], pool: &Pool<T>) -> Memo<T> {
    let fits = |(memo, size): (&Memo<T>, &usize)| memo.values().iter().all(|value| value.shape().first() == Some(size));
    match memos.iter().zip(sizes).all(fits) {
        true => Memo::gather(&memos, rows, pool),
        false => Memo::gather(&[], &[], pool),
    }
}
