//! Ray marching through the occupied cells of a grid.

use super::OccupancyGrid;
use crate::camera::rays::{Rays, Samples};
use crate::random::Jitter;
use raygrad_autograd::{Pool, Scalar, Segments};
use raygrad_tensor::simd;

mod frame;
mod spacing;
#[cfg(test)]
mod tests;

use frame::{Frame, LatticeRay, Numbering};
use spacing::{Cone, LANES, Spacing, Uniform};
pub use spacing::{MAX_STEPS, Step};

/// Packed samples of rays in occupied cells. Reuse it across calls to avoid allocations.
#[derive(Debug, Clone, Default)]
pub struct MarchBuffer {
    /// Distances `t` along the rays in scene units, ray after ray, never falling within a ray.
    pub t: Vec<f32>,
    /// Interval length of each sample, in scene units.
    pub delta: Vec<f32>,
    /// The samples of ray `r` are `offsets[r]..offsets[r + 1]`.
    pub offsets: Vec<u32>,
    /// Number of samples if every cell were occupied, to measure skipping against.
    pub steps: u64,
    /// `growth[i] = ((1 + c)^i - 1) / c` for the last cone `c` above 0.
    growth: Vec<f32>,
    cone: f32,
}

impl MarchBuffer {
    /// Converts to [`Samples`], in any precision.
    ///
    /// # Panics
    /// If `rays` has another number of rays than were marched.
    pub fn samples<T: Scalar>(&self, rays: &Rays<T>, pool: &Pool<T>) -> Samples<T> {
        let copy = |values: &[f32]| {
            let mut out = pool.tensor(&[values.len()]);
            out.as_mut_slice().iter_mut().zip(values).for_each(|(out, &x)| *out = T::from_f64(x.into()));
            out
        };
        Samples::new(rays, Segments::new(&self.offsets[..]), copy(&self.t), copy(&self.delta), pool)
    }
}

impl OccupancyGrid {
    /// Places the samples of rays that lie in occupied cells, into `out`.
    ///
    /// Samples are spaced by [`Step`] between the ray's entry into the outermost box (or its near plane, or 0) and its
    /// exit (or the far plane). The first lies `jitter` of a step behind the entry, drawn once per ray. Each ray has at
    /// most `step.max_samples`.
    ///
    /// Sample `i` lies at the same distance whatever is occupied. Its interval is that between `i` and `i + 1` whole
    /// steps from the entry, so the last may reach beyond the box. With random jitter the integral is unbiased.
    /// Samples that rounding puts outside of the box are dropped. A ray with a non-finite number has no samples.
    ///
    /// # Panics
    /// If the step is out of range, or there are 2^32 samples or more.
    pub fn march(&self, rays: &Rays<f32>, step: &Step, jitter: &mut Jitter<'_>, out: &mut MarchBuffer) {
        if let Err(error) = step.check() {
            panic!("{error}");
        }
        let frame = Frame::new(&self.lattice);
        out.steps = 0;
        out.offsets.clear();
        out.offsets.reserve(rays.len() + 1);
        out.offsets.push(0);
        if step.cone > 0.0 && step.cone != out.cone {
            out.growth.clear();
            out.cone = step.cone;
        }
        let mut found = Found { t: std::mem::take(&mut out.t), delta: std::mem::take(&mut out.delta), len: 0 };
        // Equal lengths, in case the caller changed one.
        found.delta.resize(found.t.len(), 0.0);
        simd::dispatch(
            #[inline(always)]
            || {
                for i in 0..rays.len() {
                    let jitter = jitter.draw() as f32;
                    let ray = LatticeRay::new(rays.origins[i], rays.directions[i], rays.spans[i], &frame);
                    if let Some(ray) = ray {
                        let growth = &mut out.growth;
                        out.steps += if frame.cascades > 1 {
                            self.march_ray::<true>(&frame, &ray, step, jitter, growth, &mut found)
                        } else {
                            self.march_ray::<false>(&frame, &ray, step, jitter, growth, &mut found)
                        };
                    }
                    // 2^32 samples are 16 GiB of distances.
                    out.offsets.push(
                        u32::try_from(found.len)
                            .unwrap_or_else(|_| panic!("there are 2^32 samples or more; march fewer rays")),
                    );
                }
            },
        );
        found.t.truncate(found.len);
        if step.cone > 0.0 {
            found.delta.truncate(found.len);
        } else {
            found.delta.clear();
            found.delta.resize(found.len, step.length);
        }
        (out.t, out.delta) = (found.t, found.delta);
    }

    /// Adds one ray's samples and returns the number that a fully occupied grid would give.
    #[inline(always)]
    fn march_ray<const NESTED: bool>(
        &self,
        frame: &Frame,
        ray: &LatticeRay,
        step: &Step,
        jitter: f32,
        growth: &mut Vec<f32>,
        found: &mut Found,
    ) -> u64 {
        if step.cone > 0.0 {
            let spacing = Cone::new(step, ray.span, jitter, growth);
            self.walk::<_, true, NESTED>(frame, ray, &spacing, step.max_samples, found)
        } else {
            let spacing = Uniform::new(step, ray.span, jitter);
            self.walk::<_, false, NESTED>(frame, ray, &spacing, step.max_samples, found)
        }
    }

    /// Skips empty blocks, and tests samples in groups from the first block that is not empty.
    #[inline(always)]
    fn walk<S: Spacing, const DELTA: bool, const NESTED: bool>(
        &self,
        frame: &Frame,
        ray: &LatticeRay,
        spacing: &S,
        max_samples: usize,
        found: &mut Found,
    ) -> u64 {
        let (first, end) = inside(frame, ray, spacing);
        let limit = found.len.saturating_add(max_samples);
        let leaps = self.leaps.octant(ray.octant);
        let numbering = Numbering::new(frame, ray.octant);
        let mut i = first;
        while i < end && found.len < limit {
            let (cascade, block, _) = frame.locate::<NESTED>(ray.at(spacing.at(i)));
            let leap = leaps[numbering.word(cascade, block)];
            if leap == 0 {
                let occupied = self.test::<NESTED>(frame, &numbering, ray, &spacing.group(i)) & first_lanes(end - i);
                found.add::<_, DELTA>(spacing, i, occupied);
                found.len = found.len.min(limit);
                i += LANES;
            } else {
                let faces = block.map(
                    #[inline(always)]
                    |b| frame.face(cascade, b + i32::from(leap)),
                );
                i = first_beyond(ray, spacing, faces, i, end);
            }
        }
        (end - first) as u64
    }

    /// A bit for each of the samples at these distances, set if its cell is occupied. Beyond the box bits are
    /// arbitrary.
    #[inline(always)]
    fn test<const NESTED: bool>(
        &self,
        frame: &Frame,
        numbering: &Numbering,
        ray: &LatticeRay,
        t: &[f32; LANES],
    ) -> u32 {
        let (mut words, mut bits) = ([0; LANES], [0; LANES]);
        for lane in 0..LANES {
            let (cascade, block, cell) = frame.locate::<NESTED>(ray.at(t[lane]));
            words[lane] = numbering.word(cascade, block) as u32;
            bits[lane] = numbering.bit(cell);
        }
        let mut occupied = 0;
        for lane in 0..LANES {
            occupied |= ((self.words[words[lane] as usize] >> bits[lane]) as u32 & 1) << lane;
        }
        occupied
    }
}

/// A bit for each of the first `count` lanes, at most all.
#[inline(always)]
fn first_lanes(count: usize) -> u32 {
    (1 << count.min(LANES)) - 1
}

/// The range of the samples that are before `far` and in the box.
#[inline(always)]
fn inside<S: Spacing>(frame: &Frame, ray: &LatticeRay, spacing: &S) -> (usize, usize) {
    let far = ray.span[1];
    let mut end = spacing.steps_to(far);
    while end > 0 && spacing.at(end - 1) >= far {
        end -= 1;
    }
    while end < spacing.max_steps() && spacing.at(end) < far {
        end += 1;
    }
    let mut first = 0;
    while first < end && ray.at(spacing.at(first)).iter().any(|x| *x < 0.0) {
        first += 1;
    }
    while end > first && ray.at(spacing.at(end - 1)).iter().any(|x| *x >= frame.size as f32) {
        end -= 1;
    }
    (first, end)
}

/// The first sample after sample `i` beyond one of the upper `faces` of a box that contains sample `i`; at most `end`.
/// Rounding may give an earlier one, which is also in the box.
#[inline(always)]
fn first_beyond<S: Spacing>(ray: &LatticeRay, spacing: &S, faces: [f32; 3], i: usize, end: usize) -> usize {
    let leave = ray.reaches(faces);
    let mut next = (spacing.steps_to(leave[0].min(leave[1]).min(leave[2]))).clamp(i + 1, end);
    // No coordinate falls along the ray: if the last sample before `next` is in the box, all between are.
    loop {
        let last = ray.at(spacing.at(next - 1));
        if next == i + 1 || last[0] < faces[0] && last[1] < faces[1] && last[2] < faces[2] {
            return next;
        }
        next -= (next - i) / 2;
    }
}

/// The samples so far: the first `len` elements; later ones are overwritten.
struct Found {
    t: Vec<f32>,
    delta: Vec<f32>,
    len: usize,
}

impl Found {
    /// Adds the samples of a group whose bits are set.
    #[inline(always)]
    fn add<S: Spacing, const DELTA: bool>(&mut self, spacing: &S, group: usize, mut set: u32) {
        if self.t.len() < self.len + 2 * LANES {
            let room = 2 * self.len + 4 * LANES;
            self.t.resize(room, 0.0);
            if DELTA {
                self.delta.resize(room, 0.0);
            }
        }
        // A group has few runs of set bits. Each run is written as a whole group from its first sample, and the next
        // one overwrites the excess.
        while set != 0 {
            let (skipped, count) = (set.trailing_zeros(), (set >> set.trailing_zeros()).trailing_ones());
            let first = group + skipped as usize;
            self.t[self.len..][..LANES].copy_from_slice(&spacing.group(first));
            if DELTA {
                self.delta[self.len..][..LANES].copy_from_slice(&spacing.widths(first));
            }
            self.len += count as usize;
            set &= !(((1 << count) - 1) << skipped);
        }
    }
}
