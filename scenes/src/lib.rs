//! Ray-traced test scenes that need no download: a bulldozer of plastic bricks, and an unbounded landscape around it.
//!
//! Start with the datasets [`embedded`], [`landscape`] (unbounded) and [`landscape_ahead`] (forward-facing).
//! [`Scene::render`] also returns exact depth and normals.
//!
//! The bulldozer stands at the origin with z up and fits the cube of +-1.5; cameras are 4 units away, as in the
//! synthetic scenes of the NeRF paper. Its plastic is glossy, so colours depend on the viewing direction. All solids
//! are analytic: depth is exact to rounding at any resolution, and images have the same bits on every run.
//!
//! ```
//! use raygrad_scenes::{Scene, train_cameras};
//!
//! let scene = Scene::bulldozer();
//! let cameras = train_cameras(3, 32);
//! let views: Vec<_> = cameras.iter().map(|camera| scene.render(camera, 5)).collect();
//!
//! // Depth is the distance along the ray through the pixel's centre.
//! let ray = cameras[0].pixel_ray(16, 16);
//! let depth = views[0].depth.pixel(16, 16)[0];
//! let hit = scene.trace(&ray).expect("the bulldozer is in the middle of every view");
//! assert_eq!(depth, hit.distance as f32);
//! ```

mod bulldozer;
mod bvh;
mod dataset;
mod form;
mod golden;
mod kit;
mod landscape;
mod noise;
mod paint;
mod render;
mod scenery;
mod shade;
mod shape;
mod views;
mod walk;
mod window;

use glam::DVec3;

pub use bvh::Hit;
pub use dataset::{embedded, embedded_cameras, landscape, landscape_ahead, landscape_distances};
pub use landscape::Landscape;
pub use render::View;
pub use views::{ANGLE_X, DISTANCE, test_cameras, train_cameras, val_cameras};
pub use walk::walk_cameras;
pub use window::window_cameras;

use bvh::Bvh;
use raygrad_nerf::Ray;
use shade::Material;

/// Solids under a fixed sun and sky.
#[derive(Debug, Clone)]
pub struct Scene {
    bvh: Bvh,
    /// The material of each solid.
    materials: Vec<Material>,
}

impl Scene {
    /// Creates a yellow bulldozer with its driver and some loose bricks on a studded base plate.
    ///
    /// It is about 2.3 long (x, the blade towards +x), 1.4 wide and 1.15 high.
    pub fn bulldozer() -> Self {
        let (shapes, materials) = bulldozer::solids().into_iter().unzip();
        Scene { bvh: Bvh::new(shapes), materials }
    }

    /// Returns the lower and upper corner of the bounding box, in scene units.
    pub fn bounds(&self) -> [DVec3; 2] {
        self.bvh.bounds()
    }

    /// Returns the first hit of a ray, or `None` if it leaves the scene. A ray that starts inside a solid hits where it
    /// leaves it.
    pub fn trace(&self, ray: &Ray) -> Option<Hit> {
        self.bvh.trace(ray)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scene_lies_within_its_bounds() {
        let scene = Scene::bulldozer();
        let [min, max] = scene.bounds();
        assert!(min.min_element() > -1.5 && max.max_element() < 1.5, "{min} {max}");
        for camera in train_cameras(10, 40) {
            for (column, row) in (0..40).flat_map(|row| (0..40).map(move |column| (column, row))) {
                let ray = camera.pixel_ray(column, row);
                if let Some(hit) = scene.trace(&ray) {
                    let point = ray.at(hit.distance);
                    assert!(point.cmpge(min).all() && point.cmple(max).all(), "{point}");
                    assert!(hit.normal.is_normalized() && hit.normal.dot(ray.direction) <= 0.0);
                }
            }
        }
    }

    /// One point of the cab's roof differs in colour between two sides.
    #[test]
    fn colors_depend_on_the_viewing_direction() {
        let scene = Scene::bulldozer();
        let above = Ray { origin: DVec3::new(-0.17, 0.056, 4.0), direction: DVec3::NEG_Z };
        let roof = above.at(scene.trace(&above).expect("the roof").distance);
        let color = |viewer: DVec3| {
            let ray = Ray { origin: roof + 4.0 * viewer, direction: -viewer };
            let hit = scene.trace(&ray).expect("the roof");
            assert!(ray.at(hit.distance).distance(roof) < 1e-9, "something stands before the roof");
            let material = &scene.materials[hit.solid];
            shade::radiance(|ray| scene.bvh.occluded(ray), material, &ray, &hit, shade::sun_direction(0, 1), 1.0)
        };
        let (left, right) = (color(DVec3::new(0.48, 0.36, 0.8)), color(DVec3::new(-0.48, -0.36, 0.8)));
        assert!(right.min_element() > 0.0 && (right - left).min_element() > 0.1, "{left} {right}");
    }
}
