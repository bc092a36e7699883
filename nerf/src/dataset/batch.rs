//! Training rays and what they should show.

use crate::camera::bounds::clip_span;
use crate::camera::rays::Rays;
use crate::dataset::Dataset;
use crate::dataset::background::{Background, over};
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

/// Rays with the colours that photographs show along them.
pub struct Batch {
    /// The rays.
    pub rays: Rays<f32>,
    /// The photographs' colours, over the background where they have alpha.
    pub target: Vec<[f32; 3]>,
    /// The background that each ray is composited over.
    pub background: Vec<[f32; 3]>,
}

/// Random pixels of random photographs.
pub fn draw(data: &Dataset, count: usize, background: Background, rng: &mut Pcg64Mcg) -> Batch {
    let mut batch =
        Batch { rays: Rays::new(), target: Vec::with_capacity(count), background: Vec::with_capacity(count) };
    for _ in 0..count {
        let frame = &data.frames[rng.random_range(0..data.frames.len())];
        let (x, y) = (rng.random_range(0..frame.image.width), rng.random_range(0..frame.image.height));
        let ray = frame.camera.pixel_ray(x, y);
        let color = background.draw(rng);
        batch.rays.push(&ray, clip_span(&ray, data.bounds, [data.near, data.far]));
        batch.target.push(over(frame.image.pixel(x, y), color));
        batch.background.push(color);
    }
    batch
}
