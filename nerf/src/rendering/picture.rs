//! Rendering whole images, tile by tile on all cores.

use crate::camera::bounds::clip_span;
use crate::camera::pinhole::Camera;
use crate::camera::rays::Rays;
use crate::dataset::image::Image;
use crate::model::{Model, Sampler};
use crate::random::Jitter;
use crate::rendering::view::{Limits, Viewer};
use crate::space::occupancy::Skip;
use raygrad_autograd::Tape;
use raygrad_tensor::parallel;
use rayon::prelude::*;
use std::ops::Add;

/// What a model sees from a camera.
#[derive(Debug, Clone)]
pub struct Picture {
    /// Colour over the background, RGB in 0..=1.
    pub color: Image,
    /// Expected distance along the ray, in scene units, of what is visible; 0 where nothing is.
    pub depth: Image,
    /// Share of the ray's light that is blocked, 0..=1.
    pub opacity: Image,
    /// How often fields were asked.
    pub evaluations: Evaluations,
}

/// How often fields were asked.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Evaluations {
    /// For a density.
    pub density: u64,
    /// For a colour.
    pub color: u64,
    /// How often it would have been for each if nothing but the outside of the box were left out.
    pub unskipped: u64,
}

impl Add for Evaluations {
    type Output = Evaluations;
    fn add(self, other: Evaluations) -> Evaluations {
        Evaluations {
            density: self.density + other.density,
            color: self.color + other.color,
            unskipped: self.unskipped + other.unskipped,
        }
    }
}

/// Colour `[3]`, distance and transmittance of a ray, each times the light that the samples block.
pub(crate) type RayValues = [f32; 5];

/// Rays that are evaluated together: hierarchical, and marching.
const TILE: [usize; 2] = [32, 512];
/// Below this opacity a pixel has no depth.
pub(crate) const VISIBLE: f32 = 1e-3;

impl Model<f32> {
    /// The view from `camera` over a background colour, samples in the middle of their bins or steps: the same bits each
    /// time, on any number of threads.
    pub fn view(&self, camera: &Camera, background: [f32; 3]) -> Picture {
        let skip = match &self.sampler {
            Sampler::Marching(sampler) => sampler.config.occupancy.skip,
            Sampler::Hierarchical(_) => Skip::Off,
        };
        self.view_within(camera, background, &Limits::of(skip))
    }

    /// As [`view`](Self::view), with these limits in place of those that go with the configuration. A hierarchical
    /// sampler leaves out nothing and pays no heed to them.
    pub fn view_within(&self, camera: &Camera, background: [f32; 3], limits: &Limits) -> Picture {
        let pixels = camera.width * camera.height;
        let image = |channels| Image::new(camera.width, camera.height, channels);
        let (mut color, mut depth, mut opacity) = (image(3), image(1), image(1));
        let tile = TILE[usize::from(matches!(self.sampler, Sampler::Marching(_)))];
        let parts = color.data.par_chunks_mut(3 * tile).zip(depth.data.par_chunks_mut(tile));
        let parts = parts.zip(opacity.data.par_chunks_mut(tile)).enumerate();
        let evaluations = parts
            .map_init(Viewer::default, |viewer, (part, ((color, depth), opacity))| {
                let mut rays = Rays::new();
                for pixel in part * tile..((part + 1) * tile).min(pixels) {
                    let ray = camera.pixel_ray(pixel % camera.width, pixel / camera.width);
                    rays.push(&ray, clip_span(&ray, self.extent.bounds, self.extent.span));
                }
                let mut values = vec![[0.0; 5]; rays.len()];
                let evaluations = parallel::serial(|| self.view_rays(viewer, &rays, limits, &mut values));
                for (i, [r, g, b, distance, left]) in values.into_iter().enumerate() {
                    for (channel, value) in [r, g, b].into_iter().enumerate() {
                        color[3 * i + channel] = value + left * background[channel];
                    }
                    opacity[i] = 1.0 - left;
                    depth[i] = if opacity[i] > VISIBLE { distance / opacity[i] } else { 0.0 };
                }
                evaluations
            })
            .reduce(Evaluations::default, |a, b| a + b);
        Picture { color, depth, opacity, evaluations }
    }

    /// The view from `camera` at `1 / coarsest` of its size and then at twice the size each time, up to the whole: something
    /// to look at while the rest is computed, for a third more work. Each picture is rendered when the iterator is asked
    /// for it.
    ///
    /// # Panics
    /// If `coarsest` is not a power of two.
    pub fn progressive<'a>(
        &'a self,
        camera: &'a Camera,
        background: [f32; 3],
        coarsest: usize,
    ) -> impl Iterator<Item = Picture> + 'a {
        assert!(coarsest.is_power_of_two(), "{coarsest} is not a power of two");
        let halvings = (0..=coarsest.trailing_zeros()).rev();
        halvings.map(move |halvings| {
            let [width, height] = [camera.width, camera.height].map(|side| side.div_ceil(1 << halvings));
            self.view(&camera.resized(width, height), background)
        })
    }

    fn view_rays(&self, viewer: &mut Viewer, rays: &Rays<f32>, limits: &Limits, out: &mut [RayValues]) -> Evaluations {
        match &self.sampler {
            Sampler::Hierarchical(sampler) => {
                let tape = Tape::with_pool(viewer.pool.clone());
                let params = self.params.bind_constant(&tape);
                let rendered = sampler.render(&*self.field, &params, rays, &mut Jitter::Middle, true, &tape).fine;
                for (out, values) in out.iter_mut().zip(rendered.value().as_slice().chunks_exact(5)) {
                    out.copy_from_slice(values);
                }
                let each = (rays.len() * sampler.config.evaluations()) as u64;
                Evaluations { density: each, color: each, unskipped: each }
            }
            Sampler::Marching(sampler) => viewer.march(self, sampler, rays, limits, out),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Extent;
    use crate::model::config::{Config, Preset};
    use glam::DVec3;

    #[test]
    fn a_progressive_view_ends_with_the_view_itself() {
        let extent = Extent { bounds: [DVec3::NEG_ONE, DVec3::ONE], span: [0.0, 10.0] };
        let model = Model::new(Config::preset(Preset::Small), extent, 0).unwrap();
        let pose = Camera::look_at(DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO, DVec3::Y);
        let camera = Camera::from_angle(13, 9, 0.6, pose);
        let pictures: Vec<Picture> = model.progressive(&camera, [1.0; 3], 4).collect();
        let sizes: Vec<_> = pictures.iter().map(|p| [p.color.width, p.color.height]).collect();
        assert_eq!(sizes, [[4, 3], [7, 5], [13, 9]]);
        assert_eq!(pictures[2].color, model.view(&camera, [1.0; 3]).color);
    }
}
