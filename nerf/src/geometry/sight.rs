//! The visible surface: the point on each ray where half of the light is blocked.

use crate::camera::Camera;
use crate::camera::rays::Rays;
use crate::model::Model;
use crate::rendering::picture::RenderOptions;
use crate::volume::render::Evaluations;
use crate::volume::rounds::{FrontToBack, Stretch};
use glam::DVec3;
use raygrad_autograd::Pool;
use std::f64::consts::LN_2;

/// Rays with a higher transmittance hit nothing.
const MOST_LEFT: f64 = 0.05;
/// Rays per tile.
const TILE: usize = 256;

/// The hit point of a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sight {
    /// The place up to which half of the light is blocked, in scene units.
    pub place: DVec3,
    /// Its distance from where the ray starts.
    pub distance: f64,
    /// The density there, in 1 / scene unit.
    pub sigma: f64,
}

/// The hit points of a camera's pixels.
pub(super) struct Seen {
    /// Row by row; `None` for those that see nothing solid.
    pub sights: Vec<Option<Sight>>,
    /// The number of evaluations of the model.
    pub evaluations: Evaluations,
}

/// Renders the hit points of cameras resized by `scale`, one after another; also returns the resized cameras. `progress`
/// receives the finished share.
pub(super) fn views(
    model: &Model<f32>,
    cameras: &[Camera],
    scale: impl Fn(&Camera) -> f64,
    progress: &mut dyn FnMut(f64),
) -> impl Iterator<Item = (Camera, Seen)> {
    cameras.iter().enumerate().map(move |(i, camera)| {
        let [width, height] = [camera.width, camera.height].map(|side| (scale(camera) * side as f64).ceil() as usize);
        let camera = camera.resized(width, height);
        let seen = sights(model, &camera);
        progress((i + 1) as f64 / cameras.len() as f64);
        (camera, seen)
    })
}

/// The hit points of a camera's pixels. Distances are exact up to a share of a render's step.
fn sights(model: &Model<f32>, camera: &Camera) -> Seen {
    let mut sights = vec![None; camera.width * camera.height];
    let see = |pool: &Pool<f32>, _, rays: &Rays<f32>, out: &mut [Option<Sight>]| see(model, rays, pool, out);
    let evaluations = model.tiles(camera, &RenderOptions::over([0.0; 3]), TILE, sights.chunks_mut(TILE), see);
    Seen { sights, evaluations: evaluations.expect("never cancelled") }
}

fn see(model: &Model<f32>, rays: &Rays<f32>, pool: &Pool<f32>, out: &mut [Option<Sight>]) -> Evaluations {
    model.along(rays, 1, pool, |query, sampled| {
        let (mut asked, mut followed) = (sampled.evaluations, FrontToBack::new(&sampled.samples, MOST_LEFT));
        // The distance at which the optical depth of each ray is ln 2, and the density there.
        let mut halves: Vec<Option<[f64; 2]>> = vec![None; rays.len()];
        while let Some(round) = followed.round(query, followed.round_size()) {
            let (Stretch { samples, pieces }, x) = (&round.stretch, round.optical_depth.value().as_slice());
            for (rows, (ray, _)) in samples.segments.ranges().zip(pieces) {
                for row in rows {
                    let [t, delta, x] = [samples.t.as_slice(), samples.delta.as_slice(), x].map(|x| f64::from(x[row]));
                    let before = round.in_front[row];
                    if halves[*ray].is_none() && before + x >= LN_2 {
                        // The density is constant within a step.
                        halves[*ray] = Some([t - 0.5 * delta + delta * (LN_2 - before) / x, x / delta]);
                    }
                }
            }
            asked.density += samples.len() as u64;
        }
        for (ray, out) in out.iter_mut().enumerate() {
            let [origin, direction] = [&rays.origins, &rays.directions].map(|x| DVec3::from(x[ray].map(f64::from)));
            let half = halves[ray].filter(|_| followed.has_ended(followed.depths[ray]));
            *out = half.map(|[distance, sigma]| Sight { place: origin + distance * direction, distance, sigma });
        }
        asked
    })
}
