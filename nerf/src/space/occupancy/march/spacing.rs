//! Spacing of samples along a ray: uniform, or growing with distance.

use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// Maximum number of steps along a ray.
pub const MAX_STEPS: usize = 1 << 20;

/// Samples that are computed at a time.
pub(super) const LANES: usize = 16;
/// Steps of a cone beyond the last, since a group may begin at the last sample of another.
const SPARE: usize = 2 * LANES;

/// The spacing of samples along rays.
///
/// At distance `t` a step is `length + cone t` long. Sample `i` of a ray that enters at `near` is at
/// `t_i = t_0 + (length + cone t_0) ((1 + cone)^i - 1) / cone`, with `t_0 = near + jitter (length + cone near)`. For a
/// cone of 0 this is `t_0 + i length`. Each is computed directly from `i`, so within 1 ULP, or 5 with a cone (its
/// factors are rounded too), for any `i`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// Step length in scene units, above 0. If it is below an ULP of the distance, samples coincide.
    pub length: f32,
    /// Growth of the step with distance, without unit, 0 to 1; 0 is uniform. The angle of a pixel in radians makes
    /// steps grow with the pixel's footprint. instant-ngp uses 1/256 for large scenes; the presets use 1/64 or 1/100 for
    /// unbounded ones.
    pub cone: f32,
    /// Maximum number of samples per ray.
    pub max_samples: usize,
}

impl Step {
    /// Creates uniform steps without a limit on samples.
    pub fn uniform(length: f32) -> Self {
        Step { length, cone: 0.0, max_samples: usize::MAX }
    }

    /// Checks that all values are in range.
    ///
    /// # Errors
    /// If a value is out of range.
    pub fn check(&self) -> Result<()> {
        if !(self.length > 0.0 && self.length.is_finite()) {
            return Err(Error::setting("step.length", format!("is {}; use a finite length above 0", self.length)));
        }
        if !(0.0..=1.0).contains(&self.cone) {
            return Err(Error::setting("step.cone", format!("is {}; use 0 to 1", self.cone)));
        }
        Ok(())
    }
}

/// The distances of one ray's samples.
pub(super) trait Spacing {
    /// The distance of sample `i`, which never falls with `i`.
    fn at(&self, i: usize) -> f32;
    /// The distances of `LANES` samples from `first` on.
    fn group(&self, first: usize) -> [f32; LANES];
    /// The lengths of their intervals.
    fn widths(&self, first: usize) -> [f32; LANES];
    /// The number of samples before the distance `t`, up to one or to rounding; at most `max_steps`.
    fn steps_to(&self, t: f32) -> usize;
    /// The largest number of samples.
    fn max_steps(&self) -> usize;
}

/// Equal steps.
pub(super) struct Uniform {
    start: f32,
    length: f32,
    inverse: f32,
}

impl Uniform {
    #[inline(always)]
    pub fn new(step: &Step, [near, _]: [f32; 2], jitter: f32) -> Self {
        let length = step.length;
        Uniform { start: jitter.mul_add(length, near), length, inverse: 1.0 / length }
    }
}

impl Spacing for Uniform {
    #[inline(always)]
    fn at(&self, i: usize) -> f32 {
        // i is little more than 2^20, so it is exact; a conversion from i32 is one instruction.
        (i as i32 as f32).mul_add(self.length, self.start)
    }

    #[inline(always)]
    fn group(&self, first: usize) -> [f32; LANES] {
        let mut out = [0.0; LANES];
        for lane in 0..LANES {
            out[lane] = self.at(first + lane);
        }
        out
    }

    #[inline(always)]
    fn widths(&self, _: usize) -> [f32; LANES] {
        [self.length; LANES]
    }

    #[inline(always)]
    fn steps_to(&self, t: f32) -> usize {
        whole((t - self.start) * self.inverse, (MAX_STEPS - 1) as f32) as usize + 1
    }

    #[inline(always)]
    fn max_steps(&self) -> usize {
        MAX_STEPS
    }
}

/// Steps that grow with the distance.
pub(super) struct Cone<'a> {
    start: f32,
    /// The first step length, at the start and at the entry.
    from_start: f32,
    from_near: f32,
    cone: f32,
    growth: &'a [f32],
}

impl<'a> Cone<'a> {
    /// `growth` is extended by what this ray needs.
    #[inline(always)]
    pub fn new(step: &Step, [near, far]: [f32; 2], jitter: f32, growth: &'a mut Vec<f32>) -> Self {
        let from_near = step.cone.mul_add(near, step.length);
        let start = jitter.mul_add(from_near, near);
        let from_start = step.cone.mul_add(start, step.length);
        let cone = f64::from(step.cone);
        // Up to `far`, and further by the group that begins at the last sample.
        let is_short = |growth: &[f32]| match growth.len().checked_sub(SPARE + 1) {
            Some(last) => last + 1 < MAX_STEPS && growth[last].mul_add(from_start, start) < far,
            None => true,
        };
        while is_short(growth) {
            growth.push(((growth.len() as f64 * cone.ln_1p()).exp_m1() / cone) as f32);
        }
        Cone { start, from_start, from_near, cone: step.cone, growth }
    }
}

impl Spacing for Cone<'_> {
    #[inline(always)]
    fn at(&self, i: usize) -> f32 {
        self.growth[i].mul_add(self.from_start, self.start)
    }

    #[inline(always)]
    fn group(&self, first: usize) -> [f32; LANES] {
        let (mut out, growth) = ([0.0; LANES], &self.growth[first..first + LANES]);
        for lane in 0..LANES {
            out[lane] = growth[lane].mul_add(self.from_start, self.start);
        }
        out
    }

    #[inline(always)]
    fn widths(&self, first: usize) -> [f32; LANES] {
        let (mut out, growth) = ([0.0; LANES], &self.growth[first..first + LANES]);
        for lane in 0..LANES {
            out[lane] = self.from_near * self.cone.mul_add(growth[lane], 1.0);
        }
        out
    }

    #[inline(always)]
    fn steps_to(&self, t: f32) -> usize {
        self.growth[..self.max_steps()].partition_point(|g| g.mul_add(self.from_start, self.start) < t)
    }

    #[inline(always)]
    fn max_steps(&self) -> usize {
        self.growth.len() - SPARE
    }
}

/// The integer part of a number clamped to `0..=last`; `last` is at most 2^30, and NaN becomes 0.
///
/// `as` also saturates, but compiles to code for one lane at a time.
#[inline(always)]
pub(super) fn whole(x: f32, last: f32) -> i32 {
    debug_assert!(last <= (1 << 30) as f32);
    let x = if x > 0.0 { x } else { 0.0 };
    let x = if x < last { x } else { last };
    // SAFETY: x is neither NaN nor infinite, and its integer part is in 0..=2^30.
    unsafe { x.to_int_unchecked() }
}
