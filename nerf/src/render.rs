//! Rendering whole images, tile by tile on all cores.

use crate::bounds::clip_span;
use crate::camera::Camera;
use crate::image::Image;
use crate::model::Model;
use crate::rays::Rays;
use crate::sampler::Jitter;
use raygrad_autograd::Tape;
use rayon::prelude::*;

/// What a model sees from a camera.
#[derive(Debug, Clone)]
pub struct Picture {
    /// Colour over the background, RGB in 0..=1.
    pub color: Image,
    /// Expected distance along the ray, in scene units, of what is visible; 0 where nothing is.
    pub depth: Image,
    /// Share of the ray's light that is blocked, 0..=1.
    pub opacity: Image,
}

/// Rays that are evaluated together.
const TILE: usize = 32;
/// Below this opacity a pixel has no depth.
const VISIBLE: f32 = 1e-3;

impl Model<f32> {
    /// The view from `camera` over a background colour, samples in the middle of their bins: the same bits each time,
    /// on any number of threads.
    pub fn view(&self, camera: &Camera, background: [f32; 3]) -> Picture {
        let (width, pixels) = (camera.width, camera.width * camera.height);
        let image = |channels| Image::new(camera.width, camera.height, channels);
        let mut picture = Picture { color: image(3), depth: image(1), opacity: image(1) };
        let color = picture.color.data.par_chunks_mut(3 * TILE);
        let depth = picture.depth.data.par_chunks_mut(TILE);
        let opacity = picture.opacity.data.par_chunks_mut(TILE);
        color.zip(depth).zip(opacity).enumerate().for_each_init(
            Tape::new,
            |tape, (tile, ((color, depth), opacity))| {
                let mut rays = Rays::new();
                for pixel in tile * TILE..((tile + 1) * TILE).min(pixels) {
                    let ray = camera.pixel_ray(pixel % width, pixel / width);
                    rays.push(&ray, clip_span(&ray, self.extent.bounds, self.extent.span));
                }
                self.view_rays(tape, &rays, background, color, depth, opacity);
                tape.clear();
            },
        );
        picture
    }

    fn view_rays(
        &self,
        tape: &Tape<f32>,
        rays: &Rays<f32>,
        background: [f32; 3],
        color: &mut [f32],
        depth: &mut [f32],
        opacity: &mut [f32],
    ) {
        let params = self.params.bind_constant(tape);
        let rendered = self.render(tape, &params, rays, &mut Jitter::Middle, true).fine;
        for (ray, values) in rendered.value().as_slice().chunks_exact(5).enumerate() {
            let (distance, left) = (values[3], values[4]);
            for channel in 0..3 {
                color[3 * ray + channel] = values[channel] + left * background[channel];
            }
            opacity[ray] = 1.0 - left;
            depth[ray] = if opacity[ray] > VISIBLE { distance / opacity[ray] } else { 0.0 };
        }
    }
}
