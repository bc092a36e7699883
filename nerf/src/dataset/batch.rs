//! Batches of training rays with target colours.

use super::Dataset;
use super::background::{Background, over};
use crate::camera::rays::Rays;
use glam::DVec3;
use rand::{Rng, RngExt};

/// A batch of training rays with target colours.
#[derive(Debug, Clone, Default)]
pub struct Batch {
    /// The rays.
    pub rays: Rays<f32>,
    /// Image index of each ray, `[rays]`.
    pub frames: Vec<u32>,
    /// Pixel (column, row) of each ray, `[rays]`.
    pub pixels: Vec<[u32; 2]>,
    /// [Distance from the optical axis](crate::camera::Camera::off_axis) of each pixel, `[rays]`.
    pub off_axis: Vec<f32>,
    /// Measured [distance](super::Frame::distances) along each ray, `[rays]`; 0 where there is none.
    pub distances: Vec<f32>,
    /// Colours of the images, `[rays, 3]`, over the background where they have alpha.
    pub target: Vec<[f32; 3]>,
    /// Background of each ray, `[rays, 3]`.
    pub background: Vec<[f32; 3]>,
}

impl Batch {
    /// Draws `count` random pixels of random images, with rays clipped to the box `bounds`.
    ///
    /// # Panics
    /// If the dataset has no frames.
    pub fn draw(
        data: &Dataset,
        count: usize,
        bounds: [DVec3; 2],
        background: Background,
        rng: &mut (impl Rng + ?Sized),
    ) -> Self {
        let mut batch = Batch::default();
        for _ in 0..count {
            let number = rng.random_range(0..data.frames.len());
            let frame = &data.frames[number];
            let pixel = match &frame.mask {
                Some(mask) => mask.draw(rng),
                None => [rng.random_range(0..frame.image.width), rng.random_range(0..frame.image.height)],
            };
            let color = background.draw(rng);
            batch.rays.push_pixel(&frame.camera, pixel, bounds, [data.near, data.far]);
            batch.frames.push(number as u32);
            batch.pixels.push(pixel.map(|x| x as u32));
            batch.off_axis.push(frame.camera.off_axis(pixel) as f32);
            let distance = frame.distances.as_ref().map_or(0.0, |image| image.pixel(pixel[0], pixel[1])[0]);
            batch.distances.push(distance);
            batch.target.push(over(&frame.image.pixel(pixel[0], pixel[1]), color));
            batch.background.push(color);
        }
        batch
    }
}
