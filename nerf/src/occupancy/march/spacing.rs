//! Where along a ray the samples of a march lie: equally far apart, or ever farther.

use crate::{Error, Result};
use serde::{Deserialize, Serialize};

/// A ray is marched for no more steps than this.
pub const MAX_STEPS: usize = 1 << 20;

/// How far apart samples are.
///
/// At distance `t` a step is `length + cone t` long. Sample `i` of a ray that enters at `near` lies at
/// `t_i = t_0 + (length + cone t_0) ((1 + cone)^i - 1) / cone` with `t_0 = near + jitter (length + cone near)`, which is
/// `t_0 + i length` for a cone of 0: each from `i` with one rounding of the sum, within 1 ULP however large `i` is.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// Length in scene units, greater than 0. Where it is less than an ULP of the distance, samples coincide.
    pub length: f32,
    /// How much longer a step is for each scene unit of distance, 0 to 1. 0 is a uniform march; about the angle of a
    /// pixel in radians makes steps grow with what a pixel covers; 1/256 is customary for large scenes.
    pub cone: f32,
    /// Samples a ray may have; what lies behind is not sampled.
    pub max_samples: usize,
}

impl Step {
    /// Steps of one length, and as many samples as there are.
    pub fn uniform(length: f32) -> Self {
        Step { length, cone: 0.0, max_samples: usize::MAX }
    }

    /// Whether the numbers make sense.
    ///
    /// # Errors
    /// If one is out of range.
    pub fn check(&self) -> Result<()> {
        if !(self.length > 0.0 && self.length.is_finite()) {
            return Err(Error::setting("step.length", format!("is {}; use more than 0", self.length)));
        }
        if !(0.0..=1.0).contains(&self.cone) {
            return Err(Error::setting("step.cone", format!("is {}; use 0 to 1", self.cone)));
        }
        Ok(())
    }
}

/// Where the samples of one ray lie.
pub(super) trait Spacing {
    /// The distance of sample `i`, which never falls with `i`.
    fn at(&self, i: usize) -> f32;
    /// The length that sample `i` stands for.
    fn width(&self, i: usize) -> f32;
    /// The number of samples before the distance `t`, but for rounding; at most `max_steps`.
    fn steps_to(&self, t: f32) -> usize;
    /// One more than the largest sample there is.
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
    pub fn new(length: f32, near: f32, jitter: f32) -> Self {
        Uniform { start: jitter.mul_add(length, near), length, inverse: 1.0 / length }
    }
}

impl Spacing for Uniform {
    #[inline(always)]
    fn at(&self, i: usize) -> f32 {
        // i is at most 2^20: exact.
        (i as f32).mul_add(self.length, self.start)
    }

    #[inline(always)]
    fn width(&self, _: usize) -> f32 {
        self.length
    }

    #[inline(always)]
    fn steps_to(&self, t: f32) -> usize {
        (((t - self.start) * self.inverse).clamp(-1.0, MAX_STEPS as f32 - 1.0) as i32 + 1) as usize
    }

    #[inline(always)]
    fn max_steps(&self) -> usize {
        MAX_STEPS
    }
}

/// Steps that grow with the distance.
pub(super) struct Cone<'a> {
    start: f32,
    /// The first step, from the start and from the entry.
    from_start: f32,
    from_near: f32,
    cone: f32,
    growth: &'a [f32],
}

impl<'a> Cone<'a> {
    /// `growth` is extended by what this ray needs.
    #[inline(always)]
    pub fn new(step: &Step, near: f32, far: f32, jitter: f32, growth: &'a mut Vec<f32>) -> Self {
        let from_near = step.cone.mul_add(near, step.length);
        let start = jitter.mul_add(from_near, near);
        let from_start = step.cone.mul_add(start, step.length);
        let cone = f64::from(step.cone);
        while growth.len() < MAX_STEPS && growth.last().is_none_or(|last| last.mul_add(from_start, start) < far) {
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
    fn width(&self, i: usize) -> f32 {
        self.from_near * self.cone.mul_add(self.growth[i], 1.0)
    }

    #[inline(always)]
    fn steps_to(&self, t: f32) -> usize {
        self.growth.partition_point(|g| g.mul_add(self.from_start, self.start) < t)
    }

    #[inline(always)]
    fn max_steps(&self) -> usize {
        self.growth.len()
    }
}
