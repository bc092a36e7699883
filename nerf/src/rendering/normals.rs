//! Rendering of normals.

use crate::camera::pinhole::Camera;
use crate::camera::rays::Rays;
use crate::dataset::image::Image;
use crate::model::Model;
use crate::rendering::picture::RenderOptions;
use crate::volume::query::Query;
use crate::volume::render::Evaluations;
use raygrad_autograd::{Pool, Scalar};

/// Rays per tile: one tape holds the densities of all their samples.
const TILE: usize = 64;

impl<T: Scalar> Model<T> {
    /// Renders normals, three channels in the scene's axes: along each ray the sum of `-w grad sigma / |grad sigma|`
    /// (Verbin et al. 2022, equation 3 and after).
    ///
    /// A normal's length is the pixel's opacity where all visible surfaces face one way, and less elsewhere. Light
    /// beyond [early termination](crate::RayTolerance) does not count. The gradient of each sample takes about as long
    /// as a training step on as many rays.
    ///
    /// # Panics
    /// If the field's density does not depend on positions through operations of the tape.
    #[inline(never)]
    pub fn normals(&self, camera: &Camera) -> Image {
        self.normals_cancellable(camera, &RenderOptions::over([0.0; 3])).expect("never cancelled")
    }

    /// Renders as [`normals`](Self::normals), with a crop box and cancellation; returns `None` if
    /// [`keep_going`](RenderOptions::keep_going) returned `false`.
    ///
    /// # Panics
    /// As [`normals`](Self::normals).
    #[inline(never)]
    pub fn normals_cancellable(&self, camera: &Camera, viewing: &RenderOptions<'_>) -> Option<Image> {
        let mut image = Image::new(camera.width, camera.height, 3);
        let out = image.data.chunks_mut(3 * TILE);
        let see = |pool: &Pool<T>, _, rays: &Rays<T>, out: &mut [f32]| self.normals_along(rays, viewing, pool, out);
        self.tiles(camera, viewing, TILE, out, see)?;
        Some(image)
    }

    fn normals_along(
        &self,
        rays: &Rays<T>,
        viewing: &RenderOptions<'_>,
        pool: &Pool<T>,
        out: &mut [f32],
    ) -> Evaluations {
        self.along(rays, 1, pool, |query, sampled| {
            if sampled.samples.is_empty() {
                return sampled.evaluations;
            }
            let early_stop_eps = viewing.tolerance.unwrap_or_else(|| self.sampler.tolerance()).early_stop_eps.into();
            let query = Query { position_grad: true, ..*query };
            let seen = self.sampler.quadrature().render(&query, &sampled.samples, early_stop_eps);
            let normals = seen.rendered.accumulated_normals();
            out.iter_mut().zip(normals.as_slice()).for_each(|(out, value)| *out = value.to_f64() as f32);
            sampled.evaluations
                + Evaluations { density: seen.density_queries as u64, color: seen.visible as u64, unskipped: 0 }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::field::{Density, Field, ViewInputs};
    use crate::model::SceneBox;
    use crate::model::{Config, Preset};
    use glam::DVec3;
    use raygrad_autograd::{Tensor, Var};
    use raygrad_nn::Bound;
    use std::sync::Arc;

    const CENTRE: [f64; 3] = [0.2, -0.1, 0.3];
    const RADII: [f64; 3] = [0.9, 0.6, 0.7];

    /// A solid ellipsoid with a steep surface, whose density or log density falls outwards; `q` is 1 on the surface.
    struct Ellipsoid {
        log: bool,
    }

    impl<T: Scalar> Field<T> for Ellipsoid {
        fn density<'t>(&self, _: &Bound<'t, T>, positions: &Var<'t, T>) -> Density<'t, T> {
            let tape = positions.tape();
            let row = |values: [f64; 3]| tape.constant(Tensor::from_vec(&[1, 3], values.map(T::from_f64).to_vec()));
            let q = ((positions - row(CENTRE)) / row(RADII)).square().sum_over(-1);
            let fall = (q - 1.0) * -60.0;
            let value = if self.log { fall } else { fall.sigmoid() * 200.0 };
            Density { value, log: self.log, features: positions.clone() }
        }

        fn color<'t>(&self, _: &Bound<'t, T>, features: &Var<'t, T>, _: &ViewInputs<'_, 't, T>) -> Var<'t, T> {
            features.sigmoid()
        }
    }

    fn model(log: bool) -> Model<f32> {
        let config = Config::preset(Preset::Small);
        let mut model =
            Model::new(config, SceneBox::new([DVec3::splat(-1.5), DVec3::splat(1.5)], [2.0, 6.0]), 0).unwrap();
        model.field = Arc::new(Ellipsoid { log });
        model
    }

    #[test]
    fn normals_equal_those_of_the_visible_surface() {
        // The image is wider than high; the camera looks from the side and from above.
        let pose = Camera::look_at(DVec3::new(2.0, -3.0, 1.5), DVec3::new(0.1, 0.0, 0.2), DVec3::Z);
        let camera = Camera::from_angle(21, 13, 0.8, pose);
        let local = |point: DVec3| (point - DVec3::from(CENTRE)) / DVec3::from(RADII);
        for log in [false, true] {
            let model = model(log);
            let (normals, depth) = (model.normals(&camera), model.render(&camera, [1.0; 3]).depth);
            let (mut hits, mut misses) = (0, 0);
            for pixel in 0..21 * 13 {
                let [x, y] = [pixel % 21, pixel / 21];
                let ray = camera.pixel_ray(x, y);
                let found = DVec3::from_slice(&[0, 1, 2].map(|i| f64::from(normals.pixel(x, y)[i])));
                // The intersection of a ray with the surface, by a quadratic equation.
                let (origin, direction) = (local(ray.origin), ray.direction / DVec3::from(RADII));
                let (a, b) = (direction.length_squared(), origin.dot(direction));
                let root = b * b - a * (origin.length_squared() - 1.0);
                if root < -0.1 * a {
                    misses += 1;
                    assert!(found.length() < 0.02, "{log} {x} {y}: {found}");
                } else if root > 0.3 * a {
                    hits += 1;
                    // The surface is soft: the visible one is another ellipsoid around the same centre.
                    let t = f64::from(depth.pixel(x, y)[0]);
                    assert!((t - (-b - root.sqrt()) / a).abs() < 0.1, "{t}");
                    let normal = (local(ray.at(t)) / DVec3::from(RADII)).normalize();
                    assert!(found.normalize().dot(normal) > 1.0_f64.to_radians().cos(), "{found} {normal}");
                    assert!((0.99..=1.0 + 1e-6).contains(&found.length()), "{log} {x} {y}: {found}");
                    assert!(normal.dot(ray.direction) < 0.0 && found.dot(ray.direction) < 0.0, "it faces the camera");
                }
            }
            assert!(hits > 30 && misses > 80, "{hits} {misses}");
        }
    }

    #[test]
    fn view_of_nothing_has_no_normals() {
        let model = model(false);
        let away = Camera::look_at(DVec3::new(0.0, -4.0, 0.0), DVec3::new(0.0, -9.0, 0.0), DVec3::Z);
        assert!(model.normals(&Camera::from_angle(9, 5, 0.6, away)).data.iter().all(|x| *x == 0.0));
        let towards = Camera::look_at(DVec3::new(0.0, -4.0, 0.0), DVec3::ZERO, DVec3::Z);
        let render = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| model.normals(&Camera::from_angle(19, 11, 0.6, towards)))
        };
        assert_eq!(render(1), render(2));
    }
}
