//! The scenes as datasets.

use glam::DVec3;
use raygrad_nerf::dataset::{Dataset, Frame, Image, SceneTransform, SceneType, Split};
use raygrad_nerf::{Camera, Ndc};

use crate::{DISTANCE, Landscape, Scene, test_cameras, train_cameras, val_cameras, walk_cameras, window_cameras};

/// Rays per pixel, for anti-aliasing.
const SAMPLES: usize = 5;
/// The near plane, in scene units.
const NEAR: f64 = 0.05;
/// The far plane, in scene units. Only the sky is farther.
const FAR: f64 = 1e4;

/// Renders a split of the bulldozer: 60 training, 10 validation or 20 test images, each a square of `size` pixels.
///
/// It takes about a second at 200 pixels on the current rayon pool.
pub fn embedded(split: Split, size: usize) -> Dataset {
    let scene = Scene::bulldozer();
    // A margin around the model, as in a real capture.
    let [low, high] = scene.bounds();
    let bounds = [low - 0.02, high + 0.02];
    let reach = bounds[1].max(-bounds[0]).length();
    let frames = frames(split, embedded_cameras(split, size), |camera| scene.render(camera, SAMPLES).color);
    dataset(frames, bounds, [DISTANCE - reach, DISTANCE + reach], SceneType::Bounded)
}

/// Returns the cameras of a split of [`embedded`], for images of `size` pixels a side.
pub fn embedded_cameras(split: Split, size: usize) -> Vec<Camera> {
    match split {
        Split::Train => train_cameras(60, size),
        Split::Val => val_cameras(10, size),
        Split::Test => test_cameras(20, size),
    }
}

/// Renders a split of the bulldozer in an unbounded landscape: 100 training, 10 validation or 20 test images.
///
/// [`landscape_distances`] tells what in them is near, far and sky. The bounds are those of the bulldozer and the
/// cameras: most visible surfaces lie beyond them.
///
/// Ray-traced on the current rayon pool in about ten seconds at 400 pixels on two cores.
///
/// # Panics
/// If `width` is not a multiple of 4.
#[track_caller]
pub fn landscape(split: Split, width: usize) -> Dataset {
    let eyes = Split::ALL.into_iter().flat_map(|split| walk_cameras(split, 4)).map(|camera| camera.pose.translation);
    let bounds = eyes.fold(Landscape::new().bulldozer_bounds(), |[low, high], eye| [low.min(eye), high.max(eye)]);
    let frames = outdoors(split, width, walk_cameras);
    dataset(frames, [bounds[0] - 0.02, bounds[1] + 0.02], [NEAR, FAR], SceneType::Unbounded)
}

/// Renders a split of forward-facing images of the landscape: 30 training, 3 validation or 6 test images.
///
/// The scene box is the cube of +-1.5 around the bulldozer, and nothing is nearer than half a unit.
///
/// # Panics
/// If `width` is not a multiple of 4.
#[track_caller]
pub fn landscape_ahead(split: Split, width: usize) -> Dataset {
    let near = 0.5;
    let cameras: Vec<Camera> = Split::ALL.into_iter().flat_map(|split| window_cameras(split, 4)).collect();
    let frames = outdoors(split, width, window_cameras);
    let data = dataset(frames, [DVec3::splat(-1.5), DVec3::splat(1.5)], [near, FAR], SceneType::ForwardFacing);
    // `Some`, since the cameras are forward-facing.
    Dataset { ndc: Ndc::around(&cameras, near).ok(), ..data }
}

fn dataset(frames: Vec<Frame>, bounds: [DVec3; 2], [near, far]: [f64; 2], scene_type: SceneType) -> Dataset {
    Dataset {
        frames,
        bounds,
        near,
        far,
        scene_type,
        ndc: None,
        transform: SceneTransform::default(),
        skipped: vec![],
        masked: vec![],
    }
}

/// Frames with the images of some cameras.
fn frames(split: Split, cameras: Vec<Camera>, render: impl Fn(&Camera) -> Image) -> Vec<Frame> {
    let frame = |(i, camera): (usize, Camera)| {
        let image = render(&camera).into();
        Frame { name: format!("{split}/{i}"), camera, image, mask: None, distances: None }
    };
    cameras.into_iter().enumerate().map(frame).collect()
}

/// The landscape's frames for the cameras of a split.
#[track_caller]
fn outdoors(split: Split, width: usize, cameras: fn(Split, usize) -> Vec<Camera>) -> Vec<Frame> {
    assert!(width.is_multiple_of(4), "the width must be a multiple of 4, is {width}");
    let landscape = Landscape::new();
    frames(split, cameras(split, width), |camera| landscape.render(camera, SAMPLES))
}

/// Computes exact distances to the [`landscape`]: one channel, along the unit ray through each pixel's centre, in scene
/// units; 0 for the sky.
pub fn landscape_distances(camera: &Camera) -> Image {
    Landscape::new().distances(camera)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn landscape_images_are_opaque_finite_and_in_range() {
        for (split, count) in Split::ALL.into_iter().zip([100, 10, 20]) {
            let data = landscape(split, 16);
            assert_eq!(data.frames.len(), count);
            for (i, frame) in data.frames.iter().enumerate() {
                assert_eq!(frame.name, format!("{split}/{i}"));
                let image = &frame.image;
                assert_eq!([image.width, image.height, image.channels], [16, 12, 3]);
                assert!(image.to_image().data.iter().all(|v| (0.0..=1.0).contains(v)));
                let distances = landscape_distances(&frame.camera);
                assert!(
                    distances.data.iter().all(|d| *d == 0.0 || f64::from(*d) > data.near && f64::from(*d) < data.far)
                );
                let eye = frame.camera.pose.translation;
                assert!(eye.cmpgt(data.bounds[0]).all() && eye.cmplt(data.bounds[1]).all(), "{eye}");
            }
            assert!(!data.has_alpha());
        }
    }

    #[test]
    fn window_sees_nothing_near() {
        let data = landscape_ahead(Split::Test, 16);
        assert_eq!((data.frames.len(), data.scene_type), (6, SceneType::ForwardFacing));
        for frame in &data.frames {
            let distances = landscape_distances(&frame.camera);
            assert!(distances.data.iter().all(|d| *d == 0.0 || f64::from(*d) > data.near));
            let ndc = data.ndc.unwrap();
            let local = ndc.axes.transpose() * (frame.camera.pose.translation - ndc.eye);
            assert!(local.z <= 0.0 && local.x.abs() < 2.0, "seen from behind: {local}");
        }
        let nearest = |split| {
            landscape_ahead(split, 16)
                .frames
                .into_iter()
                .flat_map(|frame| landscape_distances(&frame.camera).data.into_iter().filter(|d| *d > 0.0))
                .fold(f32::INFINITY, f32::min)
        };
        assert!(nearest(Split::Train) < 4.0 * data.near as f32);
        assert_eq!(landscape_ahead(Split::Train, 8).ndc, data.ndc);
    }

    #[test]
    fn landscape_bounds_are_equal_in_all_splits() {
        let [train, val, test] = Split::ALL.map(|split| landscape(split, 4).bounds);
        assert!(train == val && val == test);
    }
}
