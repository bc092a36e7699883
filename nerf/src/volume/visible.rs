//! Compositing marched samples in training: only those that light reaches.

use crate::camera::rays::Samples;
use crate::field::Field;
use crate::volume::pass::composite_density;
use raygrad_autograd::{Scalar, Tape, Tensor, Var};
use raygrad_nn::Bound;

/// Marched samples, composited.
pub struct Marched<'t, T: Scalar> {
    /// `[rays, 4 or 5]`: colour, distance if asked for, and the transmittance that is left.
    pub rendered: Var<'t, T>,
    /// Samples whose density was evaluated.
    pub evaluated: usize,
    /// Samples that had light left in front of them.
    pub kept: usize,
}

/// Composites marched samples in two passes: an unrecorded one for the densities, and a recorded one on the samples that
/// more than `termination` of the light reaches, which takes its encodings from the first. What is dropped changes a
/// pixel by at most `termination` times the range of colours.
pub fn composite_visible<'t, T: Scalar>(
    field: &dyn Field<T>,
    params: &Bound<'t, T>,
    samples: &Samples<T>,
    termination: f64,
    with_depth: bool,
    tape: &'t Tape<T>,
) -> Marched<'t, T> {
    let Visible { rows, encoding, evaluated } = tape.no_grad(|| visible(field, params, samples, termination, tape));
    let visible = samples.select(&rows, tape.pool());
    let encoding = field.encode_known(params, &tape.constant(visible.positions.clone()), encoding);
    let density = field.density(params, &encoding);
    let rendered = composite_density(field, params, &visible, &density, with_depth, tape);
    Marched { rendered, evaluated, kept: rows.len() }
}

/// The samples that light reaches.
struct Visible<T: Scalar> {
    /// Their numbers, rising.
    rows: Vec<u32>,
    /// Their encodings.
    encoding: Tensor<T>,
    /// How many samples were asked for their density.
    evaluated: usize,
}

/// Samples that each ray takes in the first round. Each further round takes twice as many: few rounds, and at most about
/// as many samples in vain as there were needed.
const FIRST_ROUND: usize = 4;

/// Where an evaluated sample is: its number, and round and row of its encoding.
struct Place {
    sample: u32,
    round: usize,
    row: usize,
}

/// Follows all rays front to back in rounds, each until its light is used up.
fn visible<'t, T: Scalar>(
    field: &dyn Field<T>,
    params: &Bound<'t, T>,
    samples: &Samples<T>,
    termination: f64,
    tape: &'t Tape<T>,
) -> Visible<T> {
    let pool = tape.pool();
    // The optical depth behind which too little light is left.
    let opaque = -termination.ln();
    let ranges: Vec<_> = samples.segments.ranges().collect();
    let mut depths = vec![0.0; ranges.len()];
    let mut alive: Vec<usize> = (0..ranges.len()).collect();
    let (mut rounds, mut found, mut rows): (Vec<Tensor<T>>, Vec<Place>, Vec<u32>) = (vec![], vec![], vec![]);
    let (mut done, mut size, mut evaluated) = (0, FIRST_ROUND, 0);
    loop {
        alive.retain(|&ray| ranges[ray].len() > done && depths[ray] < opaque);
        if alive.is_empty() {
            break;
        }
        rows.clear();
        for &ray in &alive {
            let first = ranges[ray].start + done;
            rows.extend(first as u32..(first + size).min(ranges[ray].end) as u32);
        }
        let part = samples.select(&rows, pool);
        let encoding = field.encode(params, &tape.constant(part.positions.clone()));
        let density = field.density(params, &encoding);
        let composite = density.composite(part.delta.clone(), part.segments.clone());
        let depth = composite.optical_depth(density.value.value(), pool);
        let depth = depth.as_slice();
        for (range, total) in part.segments.ranges().zip(&mut depths) {
            for row in range {
                if *total < opaque {
                    found.push(Place { sample: rows[row], round: rounds.len(), row });
                }
                *total += depth[row].to_f64();
            }
        }
        evaluated += rows.len();
        rounds.push(encoding.into_value());
        (done, size) = (done + size, 2 * size);
    }
    found.sort_unstable_by_key(|place| place.sample);
    let width = rounds.first().map_or_else(|| empty_width(field, params, tape), |encoding| encoding.shape()[1]);
    let mut encoding = pool.tensor(&[found.len(), width]);
    let slices: Vec<&[T]> = rounds.iter().map(|round| round.as_slice()).collect();
    for (out, place) in encoding.as_mut_slice().chunks_exact_mut(width.max(1)).zip(&found) {
        out.copy_from_slice(&slices[place.round][place.row * width..(place.row + 1) * width]);
    }
    Visible { rows: found.iter().map(|place| place.sample).collect(), encoding, evaluated }
}

/// Channels of an encoding, where there is no sample to tell.
fn empty_width<'t, T: Scalar>(field: &dyn Field<T>, params: &Bound<'t, T>, tape: &'t Tape<T>) -> usize {
    field.encode(params, &tape.constant(Tensor::zeros(&[0, 3]))).shape()[1]
}
