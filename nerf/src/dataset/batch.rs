//! Training rays and what they should show.

use super::Dataset;
use super::background::{Background, over};
use crate::camera::rays::Rays;
use glam::DVec3;
use rand::{Rng, RngExt};

/// Rays with what photographs show along them.
#[derive(Debug, Clone, Default)]
pub struct Batch {
    /// The rays.
    pub rays: Rays<f32>,
    /// For each ray the number of its photograph in the dataset.
    pub frames: Vec<u32>,
    /// For each ray the column and the row of its pixel.
    pub pixels: Vec<[u32; 2]>,
    /// For each ray how far its pixel lies [off the axis](crate::camera::Camera::off_axis).
    pub off_axis: Vec<f32>,
    /// For each ray the [distance](super::Frame::distances) that was measured along it; 0 where none was.
    pub distances: Vec<f32>,
    /// The photographs' colours, over the background where they have alpha.
    pub target: Vec<[f32; 3]>,
    /// The background that each ray is composited over.
    pub background: Vec<[f32; 3]>,
}

impl Batch {
    /// Random pixels of random photographs, with rays that are sampled within the box `bounds`.
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
