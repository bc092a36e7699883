//! What rays from cameras meet: the place where half of their light is blocked.

use crate::camera::Camera;
use crate::camera::rays::Rays;
use crate::model::Model;
use crate::random::Jitter;
use crate::rendering::view::front_to_back;
use crate::sampling::Purpose;
use crate::volume::query::Query;
use crate::volume::render::Evaluations;
use glam::DVec3;
use raygrad_autograd::{Pool, Tape};
use raygrad_tensor::parallel;
use std::f64::consts::LN_2;

/// Rays that let more light through than this meet nothing.
const MOST_LEFT: f64 = 0.05;
/// Rays that are worked out together.
const TILE: usize = 256;

/// Where a ray ends, for whoever looks along it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sight {
    /// The place up to which half of the light is blocked, in scene units.
    pub place: DVec3,
    /// Its distance from where the ray starts.
    pub distance: f64,
    /// The density there, in 1 / scene unit.
    pub sigma: f64,
}

/// What the pixels of a camera see.
pub(super) struct Seen {
    /// Row by row; `None` for those that see nothing solid.
    pub sights: Vec<Option<Sight>>,
    /// How often the model was asked.
    pub evaluations: Evaluations,
}

/// What a ray has met so far.
#[derive(Clone, Copy, Default)]
struct State {
    /// Optical depth.
    depth: f64,
    /// The distance at which that was ln 2, and the density there.
    half: Option<[f64; 2]>,
}

/// What a camera's pixels see. Distances are exact to a share of the sampler's steps for views.
pub(super) fn sights(model: &Model<f32>, camera: &Camera, pool: &Pool<f32>) -> Seen {
    let pixels = camera.width * camera.height;
    let tile = |tile: usize| {
        let (mut rays, bounds) = (Rays::new(), model.reach());
        for pixel in tile * TILE..pixels.min((tile + 1) * TILE) {
            let place = [pixel % camera.width, pixel / camera.width];
            rays.push_pixel(camera, place, bounds, model.view_span());
        }
        parallel::serial(|| see(model, &rays, pool))
    };
    let tiles = parallel::collect(pixels.div_ceil(TILE), tile);
    let evaluations = tiles.iter().fold(Evaluations::default(), |sum, tile| sum + tile.evaluations);
    Seen { sights: tiles.into_iter().flat_map(|tile| tile.sights).collect(), evaluations }
}

fn see(model: &Model<f32>, rays: &Rays<f32>, pool: &Pool<f32>) -> Seen {
    let tape = Tape::with_pool(pool.clone());
    let params = model.params.bind_constant(&tape);
    let query = &Query::new(&*model.field, &params);
    let sampled = model.sampler.sample(query, rays, Purpose::View { finer: 1 }, &mut Jitter::Middle);
    let mut states = vec![State::default(); rays.len()];
    let mut asked = sampled.evaluations;
    front_to_back(&sampled.steps, pool, |part, alive| {
        let depth = query.density(part).optical_depth(&part.delta);
        let (t, delta, x) = (part.t.as_slice(), part.delta.as_slice(), depth.value().as_slice());
        for (rows, &ray) in part.segments.ranges().zip(alive) {
            let state = &mut states[ray];
            for row in rows {
                let (before, x, delta) = (state.depth, f64::from(x[row]), f64::from(delta[row]));
                state.depth += x;
                if state.half.is_none() && state.depth >= LN_2 {
                    // Within a step the density is one.
                    let start = f64::from(t[row]) - 0.5 * delta;
                    state.half = Some([start + delta * (LN_2 - before) / x, x / delta]);
                }
            }
        }
        asked.density += part.len() as u64;
        alive.iter().map(|&ray| (-states[ray].depth).exp() > MOST_LEFT).collect()
    });
    let sight = |(ray, state): (usize, &State)| {
        let [origin, direction] = [&rays.origins, &rays.directions].map(|x| DVec3::from(x[ray].map(f64::from)));
        let [distance, sigma] = state.half.filter(|_| (-state.depth).exp() <= MOST_LEFT)?;
        Some(Sight { place: origin + distance * direction, distance, sigma })
    };
    Seen { sights: states.iter().enumerate().map(sight).collect(), evaluations: asked }
}
