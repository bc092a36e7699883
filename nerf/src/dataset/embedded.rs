//! The embedded scene as a dataset: needs no files.

use super::{Dataset, Frame, Placement, Scope, Split};
use crate::camera::pinhole::Camera;
use crate::dataset::scene::{DISTANCE, Scene, test_cameras, train_cameras, val_cameras};

/// Rays a pixel, for anti-aliasing.
const SAMPLES: usize = 5;

/// The views of the procedural bulldozer: 60 to train on, 10 to validate, 20 to test, each a square of `size` pixels.
///
/// Ray-traced on the current rayon pool in about a second at 200 pixels.
pub fn embedded(split: Split, size: usize) -> Dataset {
    let scene = Scene::bulldozer();
    let cameras: Vec<Camera> = match split {
        Split::Train => train_cameras(60, size),
        Split::Val => val_cameras(10, size),
        Split::Test => test_cameras(20, size),
    };
    let frame = |(i, camera): (usize, Camera)| {
        let image = scene.render(&camera, SAMPLES).color.into();
        Frame { name: format!("{split}/{i}"), camera, image, mask: None, distances: None }
    };
    // Room around the model, as a real capture would have it.
    let [low, high] = scene.bounds();
    let bounds = [low - 0.02, high + 0.02];
    let reach = bounds[1].max(-bounds[0]).length();
    Dataset {
        frames: cameras.into_iter().enumerate().map(frame).collect(),
        bounds,
        near: DISTANCE - reach,
        far: DISTANCE + reach,
        scope: Scope::Bounded,
        ndc: None,
        placement: Placement::default(),
        skipped: vec![],
    }
}
