//! Rendering whole images, tile by tile on all cores.

use crate::bounds::clip_span;
use crate::camera::Camera;
use crate::image::Image;
use crate::model::{Model, Sampler};
use crate::rays::Rays;
use crate::sampler::Jitter;
use crate::view::Viewer;
use raygrad_autograd::Tape;
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
}

impl Add for Evaluations {
    type Output = Evaluations;
    fn add(self, other: Evaluations) -> Evaluations {
        Evaluations { density: self.density + other.density, color: self.color + other.color }
    }
}

/// Colour `[3]`, distance and transmittance of a ray, each times the light that the samples block.
pub(crate) type RayValues = [f32; 5];

/// Rays that are evaluated together: hierarchical, and marching.
const TILE: [usize; 2] = [32, 512];
/// Below this opacity a pixel has no depth.
const VISIBLE: f32 = 1e-3;

impl Model<f32> {
    /// The view from `camera` over a background colour, samples in the middle of their bins or steps: the same bits each
    /// time, on any number of threads.
    pub fn view(&self, camera: &Camera, background: [f32; 3]) -> Picture {
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
                let evaluations = self.view_rays(viewer, &rays, &mut values);
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

    fn view_rays(&self, viewer: &mut Viewer, rays: &Rays<f32>, out: &mut [RayValues]) -> Evaluations {
        match &self.sampler {
            Sampler::Hierarchical(sampler) => {
                let tape = Tape::with_pool(viewer.pool.clone());
                let params = self.params.bind_constant(&tape);
                let rendered = sampler.render(&*self.field, &params, rays, &mut Jitter::Middle, true, &tape).fine;
                for (out, values) in out.iter_mut().zip(rendered.value().as_slice().chunks_exact(5)) {
                    out.copy_from_slice(values);
                }
                let each = (rays.len() * sampler.config.evaluations()) as u64;
                Evaluations { density: each, color: each }
            }
            Sampler::Marching(sampler) => viewer.march(self, sampler, rays, out),
        }
    }
}
