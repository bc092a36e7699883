//! Marching rays through the occupied cells of a grid.

use super::OccupancyGrid;
use super::lattice::{EDGE, Lattice};
use crate::rays::{Rays, Samples};
use crate::sampler::Jitter;
use raygrad_autograd::{Pool, Segments};
use raygrad_tensor::simd;

mod spacing;
#[cfg(test)]
mod tests;

use spacing::{Cone, Spacing, Uniform};
pub use spacing::{MAX_STEPS, Step};

/// The samples that rays have in occupied cells, packed. Kept from call to call, so that nothing is allocated.
#[derive(Debug, Clone, Default)]
pub struct MarchBuffer {
    /// Distances along the rays in scene units, those of all rays one after another, never falling within a ray.
    pub t: Vec<f32>,
    /// For each sample the length of the interval that it stands for, in scene units.
    pub delta: Vec<f32>,
    /// The samples of ray `r` are `offsets[r]..offsets[r + 1]`.
    pub offsets: Vec<u32>,
    /// How many samples there would be if every cell were occupied: what skipping is measured against.
    pub steps: u64,
    /// `growth[i] = ((1 + c)^i - 1) / c` for the cone `c` of the last call that had one.
    growth: Vec<f32>,
    cone: f32,
}

impl MarchBuffer {
    /// The samples with positions and directions.
    ///
    /// # Panics
    /// If these are not the rays that were marched.
    pub fn samples(&self, rays: &Rays<f32>, pool: &Pool<f32>) -> Samples<f32> {
        let copy = |values: &[f32]| pool.copy_of(&[values.len()], values);
        Samples::new(rays, Segments::new(&self.offsets[..]), copy(&self.t), copy(&self.delta), pool)
    }
}

/// A ray in units of the smallest cells, mirrored so that no coordinate falls along it.
///
/// Mirroring leaves one case of each comparison, and makes a sample on a face belong to the cell that the ray enters.
struct LatticeRay {
    origin: [f32; 3],
    slope: [f32; 3],
    /// Reciprocals of the slopes; infinite for a slope of 0.
    inverse: [f32; 3],
    /// Bit `a` is set if axis `a` is mirrored.
    octant: usize,
}

impl LatticeRay {
    /// `None` if a number is not finite.
    #[inline(always)]
    fn new(origin: [f32; 3], direction: [f32; 3], frame: &Frame) -> Option<Self> {
        let mut ray = LatticeRay { origin: [0.0; 3], slope: [0.0; 3], inverse: [0.0; 3], octant: 0 };
        let mut sum = 0.0;
        for axis in 0..3 {
            // Far from the origin of the scene the difference has no digits in f32.
            let place = (f64::from(origin[axis]) - frame.low[axis]) * frame.scale[axis];
            let slope = f64::from(direction[axis]) * frame.scale[axis];
            let mirrored = slope < 0.0;
            ray.octant |= usize::from(mirrored) << axis;
            ray.origin[axis] = (if mirrored { frame.size - place } else { place }) as f32;
            ray.slope[axis] = slope.abs() as f32;
            if ray.slope[axis] == 0.0 {
                // The upper face belongs to the box, but to no cell.
                ray.origin[axis] = if place == frame.size { frame.size.next_down() as f32 } else { ray.origin[axis] };
            }
            ray.inverse[axis] = 1.0 / ray.slope[axis];
            sum += ray.origin[axis] + ray.slope[axis];
        }
        sum.is_finite().then_some(ray)
    }

    /// The point at distance `t`. Fused, so that it never falls with rising `t`.
    #[inline(always)]
    fn at(&self, t: f32) -> [f32; 3] {
        std::array::from_fn(
            #[inline(always)]
            |axis| t.mul_add(self.slope[axis], self.origin[axis]),
        )
    }

    /// The distance at which the ray has reached `planes` on all axes (entering a box by its lower planes), or on any
    /// (leaving it by its upper ones).
    #[inline(always)]
    fn reaches(&self, planes: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(
            #[inline(always)]
            |axis| (planes[axis] - self.origin[axis]) * self.inverse[axis],
        )
    }
}

/// What all rays of a batch need to know of the grid.
struct Frame {
    /// Lower corner of the outermost box, in scene units.
    low: [f64; 3],
    /// Smallest cells in a scene unit.
    scale: [f64; 3],
    /// Smallest cells along the outermost box.
    size: f64,
    cells: i32,
    /// Half the cells of a cascade.
    half: i32,
    cascades: u32,
    side: isize,
    blocks: isize,
}

impl Frame {
    fn new(lattice: &Lattice) -> Self {
        let [low, high] = lattice.extent(lattice.cascades - 1);
        // At most 2^17: exact in every number type here.
        let cells = lattice.resolution << (lattice.cascades - 1);
        Frame {
            low: low.to_array(),
            scale: (cells as f64 / (high - low)).to_array(),
            size: cells as f64,
            cells: cells as i32,
            half: (lattice.resolution / 2) as i32,
            cascades: lattice.cascades as u32,
            side: lattice.side() as isize,
            blocks: lattice.blocks() as isize,
        }
    }

    /// The cascade that a cell belongs to.
    #[inline(always)]
    fn cascade(&self, cell: [i32; 3]) -> u32 {
        let mut cascade = 0;
        if self.cascades > 1 {
            let outward = |x: i32| x.max(self.cells - 1 - x) - self.cells / 2;
            let radius = outward(cell[0]).max(outward(cell[1])).max(outward(cell[2]));
            while radius >= self.half << cascade {
                cascade += 1;
            }
        }
        cascade
    }
}

impl OccupancyGrid {
    /// The samples of rays that lie in occupied cells.
    ///
    /// A ray's samples lie `step` apart from where it enters the outermost box (or from the near end of its span, or 0)
    /// up to where it leaves it (or the far end), as [`Step`] describes; the first after `jitter` of a step, drawn once
    /// for each ray. Exactly those are returned that lie in occupied cells, up to the step's `max_samples` a ray. Sample
    /// `i` is at the same distance whatever is occupied, and stands for the interval between `i` and `i + 1` whole steps
    /// from the entry: the last one may stick out of the box, and with a random jitter the integral has no bias. A
    /// sample that rounding puts outside of the box is dropped. A ray with a number that is not finite has no samples.
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
            (out.cone, _) = (step.cone, out.growth.clear());
        }
        let mut found = Found { t: std::mem::take(&mut out.t), delta: std::mem::take(&mut out.delta), len: 0 };
        simd::dispatch(
            #[inline(always)]
            || {
                for i in 0..rays.len() {
                    let jitter = jitter.draw() as f32;
                    out.steps += self.march_ray(&frame, rays, i, step, jitter, &mut out.growth, &mut found);
                    // 2^32 samples are 16 GiB of distances.
                    out.offsets.push(u32::try_from(found.len).unwrap_or_else(|_| panic!("2^32 samples or more")));
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

    /// Adds one ray's samples and returns how many it would have if every cell were occupied.
    #[inline(always)]
    fn march_ray(
        &self,
        frame: &Frame,
        rays: &Rays<f32>,
        which: usize,
        step: &Step,
        jitter: f32,
        growth: &mut Vec<f32>,
        found: &mut Found,
    ) -> u64 {
        let [mut near, mut far] = rays.spans[which];
        let Some(ray) = LatticeRay::new(rays.origins[which], rays.directions[which], frame) else { return 0 };
        if !(near < far) {
            return 0;
        }
        let (enter, leave) = (ray.reaches([0.0; 3]), ray.reaches([frame.size as f32; 3]));
        for axis in 0..3 {
            (near, far) = (near.max(enter[axis]), far.min(leave[axis]));
        }
        near = near.max(0.0);
        if !(near < far) {
            return 0;
        }
        if step.cone > 0.0 {
            let spacing = Cone::new(step, near, far, jitter, growth);
            self.walk::<_, true>(frame, &ray, &spacing, far, step.max_samples, found)
        } else {
            let spacing = Uniform::new(step.length, near, jitter);
            self.walk::<_, false>(frame, &ray, &spacing, far, step.max_samples, found)
        }
    }

    /// Leaps from block to block, and tests the samples in blocks that are not empty.
    #[inline(always)]
    fn walk<S: Spacing, const DELTA: bool>(
        &self,
        frame: &Frame,
        ray: &LatticeRay,
        spacing: &S,
        far: f32,
        max_samples: usize,
        found: &mut Found,
    ) -> u64 {
        let (first, end) = inside(frame, ray, spacing, far);
        let limit = found.len.saturating_add(max_samples);
        let leaps = self.leaps.octant(ray.octant);
        // In the mirrored numbering blocks count down along mirrored axes, from the far corner.
        let (mut stride, mut corner, mut flip) = ([1, frame.side, frame.side * frame.side], 0, 0);
        for axis in 0..3 {
            if ray.octant >> axis & 1 == 1 {
                corner += stride[axis] * (frame.side - 1);
                stride[axis] = -stride[axis];
                flip |= (EDGE - 1) << (2 * axis);
            }
        }
        let mut i = first;
        while i < end && found.len < limit {
            let cell = ray.at(spacing.at(i)).map(
                #[inline(always)]
                |x| x as i32,
            );
            let cascade = frame.cascade(cell);
            let (shift, offset) = (cascade + 2, frame.cells / 2 - (frame.half << cascade));
            let block = cell.map(
                #[inline(always)]
                |x| (x - offset) >> shift,
            );
            let index = corner
                + cascade as isize * frame.blocks
                + stride[0] * block[0] as isize
                + stride[1] * block[1] as isize
                + stride[2] * block[2] as isize;
            let leap = leaps[index as usize];
            let faces = block.map(
                #[inline(always)]
                |b| (((b + i32::from(leap.max(1))) << shift) + offset) as f32,
            );
            let next = first_beyond(ray, spacing, faces, i, end);
            if leap == 0 {
                let word = self.words[index as usize];
                found.test::<_, DELTA>(ray, spacing, i..next, Block { word, cascade, flip });
                found.len = found.len.min(limit);
            }
            i = next;
        }
        (end - first) as u64
    }
}

/// The first sample and the one after the last that are before `far` and in the box.
#[inline(always)]
fn inside<S: Spacing>(frame: &Frame, ray: &LatticeRay, spacing: &S, far: f32) -> (usize, usize) {
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

/// The first sample after sample `i` that is beyond one of the upper `faces` of a box that holds sample `i`; at most
/// `end`. In rare cases of rounding an earlier one, which is in the box too.
#[inline(always)]
fn first_beyond<S: Spacing>(ray: &LatticeRay, spacing: &S, faces: [f32; 3], i: usize, end: usize) -> usize {
    let leave = ray.reaches(faces);
    let mut next = (spacing.steps_to(leave[0].min(leave[1]).min(leave[2]))).clamp(i + 1, end);
    // No coordinate falls along the ray: if the last sample before `next` is in the box, then all between are.
    loop {
        let last = ray.at(spacing.at(next - 1));
        if next == i + 1 || last[0] < faces[0] && last[1] < faces[1] && last[2] < faces[2] {
            return next;
        }
        next -= (next - i) / 2;
    }
}

/// A block that is not empty.
#[derive(Clone, Copy)]
struct Block {
    word: u64,
    cascade: u32,
    /// What to flip in the number of a cell in the mirrored block.
    flip: usize,
}

/// Samples so far: the first `len` elements, of more that are there to be overwritten.
struct Found {
    t: Vec<f32>,
    delta: Vec<f32>,
    len: usize,
}

impl Found {
    /// Adds those of a range of samples, all in one block, whose cells are occupied.
    #[inline(always)]
    fn test<S: Spacing, const DELTA: bool>(
        &mut self,
        ray: &LatticeRay,
        spacing: &S,
        samples: std::ops::Range<usize>,
        block: Block,
    ) {
        let needed = self.len + samples.len();
        if self.t.len() < needed {
            self.t.resize(2 * needed, 0.0);
        }
        if DELTA && self.delta.len() < needed {
            self.delta.resize(2 * needed, 0.0);
        }
        for i in samples {
            let t = spacing.at(i);
            let cell = ray.at(t).map(
                #[inline(always)]
                |x| (x as i32 >> block.cascade) as usize % EDGE,
            );
            let bit = (cell[0] + EDGE * cell[1] + EDGE * EDGE * cell[2]) ^ block.flip;
            // Written in any case, counted if it is occupied: no branch to predict.
            self.t[self.len] = t;
            if DELTA {
                self.delta[self.len] = spacing.width(i);
            }
            self.len += (block.word >> bit & 1) as usize;
        }
    }
}
