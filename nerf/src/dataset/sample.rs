//! Images for unit tests: a ball of two colours at the origin.

use super::{Dataset, Frame, Image, SceneTransform, SceneType, Split};
use crate::camera::{Camera, Ndc, Ray};
use glam::DVec3;

/// Half of the cameras' field of view, in radians, and their distance from the centre.
const ANGLE: f64 = 0.35;
const DISTANCE: f64 = 4.0;

/// Cameras on a spiral over the upper hemisphere around the centre, looking at it.
pub(crate) fn cameras_around(count: usize, size: usize) -> Vec<Camera> {
    let camera = |i: usize| {
        let (azimuth, height) = (2.4 * i as f64, (i as f64 + 0.5) / count as f64);
        let eye = (1.0 - height * height).sqrt() * DVec3::new(azimuth.cos(), azimuth.sin(), 0.0) + height * DVec3::Z;
        Camera::from_angle(size, size, 2.0 * ANGLE, Camera::look_at(DISTANCE * eye, DVec3::ZERO, DVec3::Z))
    };
    (0..count).map(camera).collect()
}

/// The ball in 60 square training images, 10 validation images and 20 test images, without a background.
pub(crate) fn ball(split: Split, size: usize) -> Dataset {
    let (count, skipped) = match split {
        Split::Train => (60, 0),
        Split::Val => (10, 60),
        Split::Test => (20, 70),
    };
    Dataset {
        frames: frames(cameras_around(90, size).into_iter().skip(skipped).take(count)),
        bounds: [DVec3::splat(-1.3), DVec3::splat(1.3)],
        near: DISTANCE - 2.3,
        far: DISTANCE + 2.3,
        scene_type: SceneType::Bounded,
        ndc: None,
        transform: SceneTransform::default(),
        skipped: vec![],
        masked: vec![],
    }
}

/// The ball in four forward-facing images.
pub(crate) fn ball_ahead(size: usize) -> Dataset {
    let corners = [[-1.0, -0.5], [1.0, -0.5], [-1.0, 0.5], [1.0, 0.5]];
    let camera = |[x, z]: [f64; 2]| {
        let eye = 0.3 * DVec3::new(x, -10.0, z);
        Camera::from_angle(size, size, 2.0 * ANGLE, Camera::look_at(eye, eye + DVec3::Y, DVec3::Z))
    };
    let cameras = corners.map(camera);
    let (near, far) = (0.5, 1e4);
    let ndc = Ndc::around(&cameras, near).ok();
    let frames = frames(cameras.into_iter());
    Dataset { frames, near, far, scene_type: SceneType::ForwardFacing, ndc, ..ball(Split::Val, 1) }
}

/// Renders the ball for each camera.
fn frames(cameras: impl Iterator<Item = Camera>) -> Vec<Frame> {
    let frame = |(i, camera): (usize, Camera)| {
        let mut image = Image::new(camera.width, camera.height, 4);
        for (pixel, rgba) in image.data.chunks_exact_mut(4).enumerate() {
            if let Some([r, g, b]) = color(&camera.pixel_ray(pixel % camera.width, pixel / camera.width)) {
                rgba.copy_from_slice(&[r, g, b, 1.0]);
            }
        }
        Frame { name: i.to_string(), camera, image: image.into(), mask: None, distances: None }
    };
    cameras.enumerate().map(frame).collect()
}

/// The colour along a ray: two-coloured stripes on the ball, brighter above.
fn color(ray: &Ray) -> Option<[f32; 3]> {
    let along = -ray.origin.dot(ray.direction);
    let half = (1.0 - (ray.origin.length_squared() - along * along)).max(-1.0);
    let place = (half > 0.0).then(|| ray.at(along - half.sqrt()))?;
    let paint = if (6.0 * place.x).sin() > 0.0 { [0.9, 0.7, 0.1] } else { [0.1, 0.3, 0.8] };
    Some(paint.map(|x: f64| (x * (0.7 + 0.3 * place.z)) as f32))
}
