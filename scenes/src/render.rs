//! Images of a scene: colour and coverage by supersampling, exact depth and normals at pixel centres.

use glam::{DVec2, DVec3};
use raygrad_tensor::parallel;

use super::{Hit, Scene, shade};
use raygrad_autograd::Formula;
use raygrad_nerf::Camera;
use raygrad_nerf::Image;
use raygrad_nerf::SrgbEncode;

/// A rendered image of a scene with exact depth and normals.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// RGBA, 0 to 1: sRGB colour with straight alpha, the share of the pixel that the scene covers. Empty pixels are 0.
    pub color: Image,
    /// One channel: distance along the unit ray through the pixel's centre, in scene units; 0 without a hit.
    pub depth: Image,
    /// Three channels: the outward unit normal in world space where that ray hits; 0 without a hit.
    pub normal: Image,
}

impl Scene {
    /// Renders the scene with `samples` rays per pixel: 1 leaves jagged edges, 9 few, 25 hardly any.
    ///
    /// The first ray passes through the pixel's centre and gives depth and normal. The others lie around it in opposite
    /// pairs, so an odd number has its mean at the centre. Rows are rendered in parallel; the result does not depend on
    /// the number of threads.
    ///
    /// # Panics
    /// If `samples` is 0.
    pub fn render(&self, camera: &Camera, samples: usize) -> View {
        assert!(samples > 0, "`samples` must be at least 1");
        let Camera { width, height, .. } = *camera;
        let mut view = View {
            color: Image::new(width, height, 4),
            depth: Image::new(width, height, 1),
            normal: Image::new(width, height, 3),
        };
        if width == 0 {
            return view;
        }
        let pattern = Pattern::new(samples);
        let colors = view.color.data.chunks_mut(4 * width);
        let rest = view.depth.data.chunks_mut(width).zip(view.normal.data.chunks_mut(3 * width));
        parallel::each_of(colors.zip(rest), |row, (colors, (depths, normals))| {
            for column in 0..width {
                let (color, centre) = self.pixel(camera, column, row, &pattern);
                colors[4 * column..][..4].copy_from_slice(&color);
                if let Some(hit) = centre {
                    depths[column] = hit.distance as f32;
                    normals[3 * column..][..3].copy_from_slice(&hit.normal.as_vec3().to_array());
                }
            }
        });
        view
    }

    /// The colour and coverage of a pixel, and the hit of the ray through its centre.
    fn pixel(&self, camera: &Camera, column: usize, row: usize, pattern: &Pattern) -> ([f32; 4], Option<Hit>) {
        let (mut sum, mut covered, mut centre) = (DVec3::ZERO, 0, None);
        // Sky occlusion varies slowly: within a pixel it is sampled once per run of hits on one side of a solid.
        let mut last: Option<(Hit, f64)> = None;
        for (i, &(offset, sun)) in pattern.0.iter().enumerate() {
            let ray = camera.ray(column as f64 + 0.5 + offset.x, row as f64 + 0.5 + offset.y);
            let Some(hit) = self.trace(&ray) else { continue };
            if i == 0 {
                centre = Some(hit);
            }
            let openness = self.openness(&hit, ray.at(hit.distance), &mut last);
            let light =
                shade::radiance(|ray| self.bvh.occluded(ray), &self.materials[hit.solid], &ray, &hit, sun, openness);
            // Clamped before the mean: otherwise the edge of a highlight would be jagged.
            sum += light.clamp(DVec3::ZERO, DVec3::ONE);
            covered += 1;
        }
        if covered == 0 {
            return ([0.0; 4], None);
        }
        let [r, g, b] = (sum / covered as f64).to_array().map(|c| SrgbEncode.f([c]) as f32);
        ([r, g, b, covered as f32 / pattern.0.len() as f32], centre)
    }

    /// The share of the sky that is visible from a hit, sampled once per run of hits on one side of a solid; `last`
    /// keeps the last sample.
    pub(super) fn openness(&self, hit: &Hit, point: DVec3, last: &mut Option<(Hit, f64)>) -> f64 {
        let openness = match *last {
            Some((near, openness)) if near.solid == hit.solid && near.normal.dot(hit.normal) > 0.9 => openness,
            _ => shade::openness(&self.bvh, point, hit.normal),
        };
        *last = Some((*hit, openness));
        openness
    }
}

/// The offsets of a pixel's rays from its centre, in pixels, with a direction to the sun's disc each. The means over
/// the pixel's area and the sun's disc are taken together.
pub(super) struct Pattern(pub(super) Vec<(DVec2, DVec3)>);

impl Pattern {
    pub(super) fn new(samples: usize) -> Self {
        // The R2 sequence: multiples of (1/p, 1/p^2) modulo the pixel, where p is the plastic number, p^3 = p + 1. Its
        // terms 0, 1, -1, 2, -2 .. are as uniform as 0, 1, 2 .. and symmetric about the centre.
        let plastic = 1.324717957244746;
        let step = DVec2::new(1.0 / plastic, 1.0 / (plastic * plastic));
        let term = |i: usize| {
            let multiple = i.div_ceil(2) as f64 * step;
            let offset = multiple - multiple.round();
            if i.is_multiple_of(2) { -offset } else { offset }
        };
        Pattern((0..samples).map(|i| (term(i), shade::sun_direction(i, samples))).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{test_cameras, train_cameras};

    fn render(threads: usize) -> View {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| Scene::bulldozer().render(&test_cameras(5, 40)[1], 5))
    }

    #[test]
    fn same_image_at_any_thread_count() {
        assert_eq!(render(1), render(2));
    }

    #[test]
    fn sample_pattern_is_centred_in_the_pixel() {
        for samples in [1, 5, 9, 25] {
            let Pattern(pattern) = Pattern::new(samples);
            assert_eq!(pattern[0].0, DVec2::ZERO);
            assert!(pattern.iter().all(|(offset, _)| offset.abs().max_element() <= 0.5));
            assert!(pattern.iter().map(|(offset, _)| *offset).sum::<DVec2>().length() < 1e-12);
        }
    }

    #[test]
    fn rendered_values_are_in_range() {
        let view = render(2);
        assert!(view.color.data.iter().all(|v| (0.0..=1.0).contains(v)));
        assert!(view.color.data.chunks(4).all(|p| p[3] > 0.0 || p == [0.0; 4]));
        assert!(view.depth.data.iter().all(|d| *d == 0.0 || (2.0..6.0).contains(d)));
        assert!(view.normal.data.iter().all(|n| n.is_finite()));
        let partly = view.color.data.chunks(4).filter(|p| p[3] > 0.0 && p[3] < 1.0).count();
        assert!(partly > 20, "{partly} pixels on the outline");
    }

    #[test]
    fn depth_and_normal_belong_to_the_pixel_centre() {
        let scene = Scene::bulldozer();
        for camera in train_cameras(4, 50) {
            let view = scene.render(&camera, 1);
            for (column, row) in (0..50).flat_map(|row| (0..50).map(move |column| (column, row))) {
                let ray = camera.pixel_ray(column, row);
                let (depth, alpha) = (view.depth.pixel(column, row)[0], view.color.pixel(column, row)[3]);
                let normal = DVec3::from_slice(&[0, 1, 2].map(|i| view.normal.pixel(column, row)[i] as f64));
                if alpha == 0.0 {
                    assert_eq!((depth, normal), (0.0, DVec3::ZERO));
                    continue;
                }
                let point = ray.at(depth as f64);
                assert!(scene.bvh.distance(point, 1.0).abs() < 1e-5, "depth {depth} at ({column}, {row})");
                assert!((normal.length() - 1.0).abs() < 1e-6 && normal.dot(ray.direction) <= 1e-6);
            }
        }
    }

    #[test]
    fn supersampling_converges() {
        let (scene, camera) = (Scene::bulldozer(), &test_cameras(5, 40)[2]);
        let [few, some, many] = [1, 9, 225].map(|samples| scene.render(camera, samples).color);
        let rms = |a: &Image, b: &Image| {
            let premultiplied = |p: &[f32]| [p[0] * p[3], p[1] * p[3], p[2] * p[3], p[3]];
            let (a, b) = (a.data.chunks(4).flat_map(premultiplied), b.data.chunks(4).flat_map(premultiplied));
            let squares: f32 = a.zip(b).map(|(a, b)| (a - b).powi(2)).sum();
            (squares / (4 * 40 * 40) as f32).sqrt()
        };
        assert!(rms(&some, &many) < 0.03, "{}", rms(&some, &many));
        assert!(rms(&some, &many) < 0.4 * rms(&few, &many), "{} {}", rms(&some, &many), rms(&few, &many));
    }

    #[test]
    fn render_of_a_camera_looking_away_is_empty() {
        let mut camera = test_cameras(1, 8).remove(0);
        camera.pose.translation *= -1.0;
        let view = Scene::bulldozer().render(&camera, 3);
        assert!([view.color, view.depth, view.normal].iter().all(|image| image.data.iter().all(|v| *v == 0.0)));
    }
}
