//! The start-up detector: restarts networks that have no density anywhere at the start, and so would never learn.

use crate::Result;
use crate::camera::Camera;
use crate::field::Field;
use crate::model::config::Config;
use crate::model::{Model, SceneBox};
use crate::random::stream;
use rand::RngExt;
use raygrad_autograd::{Gradient, Tape, Tensor};

/// Points at which a new field is evaluated.
const PROBES: usize = 512;
/// The least share of points with a density gradient.
const ALIVE: f64 = 0.01;
/// Seeds to try; the last one is accepted in any case.
const ATTEMPTS: u32 = 32;
/// The steps of a model in which its opacity is checked for a collapse.
const JUDGED: std::ops::Range<u64> = 100..1000;
/// The most restarts of a run: an empty scene must not restart for ever.
const COLLAPSES: u32 = 3;

/// The first model of the seeds `seed`, `seed + 1`, .. whose fields have a gradient, and the number of rejected ones.
pub(crate) fn living_model(
    config: &Config,
    extent: SceneBox,
    cameras: &[Camera],
    seed: u64,
) -> Result<(Model<f32>, u32)> {
    let mut attempt = 0;
    loop {
        let model = Model::with_cameras(config.clone(), extent, cameras, seed.wrapping_add(attempt.into()))?;
        let alive = model.fields().iter().all(|field| alive_share(&model, *field) > ALIVE);
        if alive || attempt + 1 == ATTEMPTS {
            return Ok((model, attempt));
        }
        attempt += 1;
    }
}

/// The share of random points in the box with a density gradient. It is 1 if there are none but parameters have a
/// gradient.
fn alive_share(model: &Model<f32>, field: &dyn Field<f32>) -> f64 {
    let mut rng = stream(0, [0, 0]);
    let [low, high] = model.scene_box.bounds.map(|corner| corner.to_array());
    let at = |i: usize, u: f64| (low[i % 3] + u * (high[i % 3] - low[i % 3])) as f32;
    let points = Tensor::from_fn(&[PROBES, 3], |i| at(i, rng.random()));
    let tape = Tape::new();
    let params = model.params.bind(&tape);
    let positions = tape.leaf(points);
    let density = field.density(&params, &positions).sigma().sum().tracked();
    let slopes = density.grad(&[&positions]);
    let moved = slopes[0].as_slice().chunks_exact(3).filter(|slope| slope.iter().any(|x| *x != 0.0)).count();
    if moved == 0 {
        // A field may be constant, or without slopes, and still learn.
        let learns = |grad: &Gradient<f32>| {
            !grad.is_dense() || grad.dense().is_some_and(|grad| grad.as_slice().iter().any(|x| *x != 0.0))
        };
        let vars = params.vars();
        return if !vars.is_empty() && density.backward(&vars).iter().any(learns) { 1.0 } else { 0.0 };
    }
    moved as f64 / PROBES as f64
}

/// Returns true if a model renders an empty image in its first steps: the collapse to the background. `steps` counts
/// its steps, and `collapses` the earlier collapses of the run.
pub(crate) fn has_collapsed(steps: u64, opacity: f64, collapses: u32) -> bool {
    JUDGED.contains(&steps) && opacity < 1e-3 && collapses < COLLAPSES
}
