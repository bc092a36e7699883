//! Batches of training rays with target colours.

use super::Dataset;
use super::background::{Background, over};
use crate::camera::lens::Lens;
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
    /// Alpha of each pixel, `[rays]`; 1 in images without.
    pub alpha: Vec<f32>,
}

impl Batch {
    /// Draws `count` random pixels of all images, with rays clipped to the box `bounds`.
    ///
    /// The probability of a pixel is proportional to its [weight](super::Frame::weight): all used pixels of all images
    /// have the same, except that panoramas are drawn evenly in solid angle.
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
        let pixels = Pixels::new(data);
        // Pixels lie at random places of memory, so all are asked for before the first is read.
        let drawn: Vec<_> = (0..count)
            .map(|_| {
                let (number, pixel) = pixels.draw(data, rng);
                data.frames[number].image.prefetch(pixel[0], pixel[1]);
                (number, pixel, background.draw(rng))
            })
            .collect();
        for (number, pixel, color) in drawn {
            let frame = &data.frames[number];
            batch.rays.push_pixel(&frame.camera, pixel, bounds, [data.near, data.far]);
            batch.frames.push(number as u32);
            batch.pixels.push(pixel.map(|x| x as u32));
            batch.off_axis.push(frame.camera.off_axis(pixel) as f32);
            let distance = frame.distances.as_ref().map_or(0.0, |image| image.pixel(pixel[0], pixel[1])[0]);
            batch.distances.push(distance);
            let shown = frame.image.pixel(pixel[0], pixel[1]);
            batch.target.push(over(&shown, color));
            batch.background.push(color);
            batch.alpha.push(shown[3]);
        }
        batch
    }
}

/// The number of used pixels of all images.
struct Pixels {
    /// For each image, the number of used pixels up to its end.
    ends: Vec<usize>,
    /// Whether all images have the same number.
    is_even: bool,
}

impl Pixels {
    fn new(data: &Dataset) -> Self {
        let ends = data.frames.iter().scan(0, |end, frame| {
            *end += frame.used();
            Some(*end)
        });
        let ends: Vec<usize> = ends.collect();
        let is_even = ends.iter().zip(1..).all(|(end, number)| *end == number * ends[0]);
        Pixels { ends, is_even }
    }

    /// Draws an image and a pixel of it.
    fn draw(&self, data: &Dataset, rng: &mut (impl Rng + ?Sized)) -> (usize, [usize; 2]) {
        loop {
            let number = match self.ends.last() {
                Some(all) if !self.is_even => {
                    let pixel = rng.random_range(0..*all);
                    self.ends.partition_point(|end| *end <= pixel)
                }
                _ => rng.random_range(0..data.frames.len()),
            };
            let frame = &data.frames[number];
            let pixel = match &frame.mask {
                Some(mask) => mask.draw(rng),
                None => [rng.random_range(0..frame.image.width), rng.random_range(0..frame.image.height)],
            };
            // A pixel that is rejected by its weight, between 0 and 1, leaves the draw to all images.
            if frame.camera.lens != Lens::Equirectangular || rng.random::<f64>() < frame.camera.row_weight(pixel[1]) {
                return (number, pixel);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::pinhole::Camera;
    use crate::dataset::image::Image;
    use crate::dataset::mask::Mask;
    use crate::dataset::sample::ball;
    use crate::dataset::{Frame, Split};
    use rand::SeedableRng;
    use rand::rngs::StdRng;
    use std::f64::consts::PI;
    use std::sync::Arc;

    /// Images of these sizes.
    fn images(sizes: &[[usize; 2]]) -> Dataset {
        let data = ball(Split::Val, 4);
        let frame = |(frame, [width, height]): (&Frame, &[usize; 2])| Frame {
            camera: frame.camera.resized(*width, *height),
            image: Image::new(*width, *height, 3).into(),
            ..frame.clone()
        };
        Dataset { frames: data.frames.iter().zip(sizes).map(frame).collect(), ..data }
    }

    fn drawn(data: &Dataset, count: usize) -> Batch {
        Batch::draw(data, count, data.bounds, Background::White, &mut StdRng::seed_from_u64(3))
    }

    /// How often each pixel of an image was drawn, row by row.
    fn counts(data: &Dataset, batch: &Batch, number: usize) -> Vec<usize> {
        let Camera { width, height, .. } = data.frames[number].camera;
        let mut counts = vec![0; width * height];
        let drawn = batch.frames.iter().zip(&batch.pixels).filter(|(frame, _)| **frame as usize == number);
        drawn.for_each(|(_, [x, y])| counts[*x as usize + width * *y as usize] += 1);
        counts
    }

    #[test]
    fn used_pixels_of_all_images_are_drawn_equally_often() {
        // 32 pixels, 3 of 12, and 5 more in one column.
        let mut data = images(&[[8, 4], [3, 4], [1, 5]]);
        data.frames[1].mask = Some(Arc::new(Mask::new(3, 4, |x, y| x == 1 && y > 0)));
        let batch = drawn(&data, 40_000);
        let counts: Vec<usize> = (0..3).flat_map(|number| counts(&data, &batch, number)).collect();
        let used: Vec<usize> = counts.into_iter().filter(|count| *count > 0).collect();
        assert!(used.len() == 40 && used.iter().all(|count| (880..1120).contains(count)), "{used:?}");
    }

    #[test]
    fn targets_and_alpha_are_those_of_the_pixel() {
        let mut data = ball(Split::Val, 4);
        let [width, height] = [5, 3];
        let texel = |i: usize| (i % 17) as f32 / 17.0;
        for (frame, channels) in data.frames.iter_mut().zip([3, 4, 4]) {
            let values = (0..channels * width * height).map(texel).collect();
            frame.camera = frame.camera.resized(width, height);
            frame.image = Image { width, height, channels, data: values }.into();
        }
        data.frames.truncate(3);
        let grey = Batch::draw(&data, 60, data.bounds, Background::Expected, &mut StdRng::seed_from_u64(3));
        for (i, (frame, [x, y])) in grey.frames.iter().zip(&grey.pixels).enumerate() {
            let pixel = data.frames[*frame as usize].image.pixel(*x as usize, *y as usize);
            let alpha = texel(4 * (*x + 5 * *y) as usize + 3);
            assert_eq!(grey.alpha[i], if *frame == 0 { 1.0 } else { alpha });
            assert_eq!((grey.background[i], grey.target[i]), ([0.5; 3], over(&pixel, [0.5; 3])));
        }
        assert!(grey.alpha.iter().any(|alpha| *alpha < 1.0) && grey.alpha.contains(&1.0));
    }

    #[test]
    fn images_of_one_size_are_drawn_as_before() {
        let mut data = images(&[[8, 4], [4, 8], [8, 4]]);
        for masked in [false, true] {
            if masked {
                data.frames[0].mask = Some(Arc::new(Mask::new(8, 4, |x, _| x != 2)));
                data.frames[1].mask = Some(Arc::new(Mask::new(4, 8, |_, y| y != 6)));
                data.frames[2].mask = Some(Arc::new(Mask::new(8, 4, |x, _| x != 7)));
            }
            // For less than 2^32 pixels their numbers would choose the same images.
            assert!(Pixels::new(&data).is_even);
            let (batch, rng) = (drawn(&data, 500), &mut StdRng::seed_from_u64(3));
            for (number, pixel) in batch.frames.iter().zip(&batch.pixels) {
                let expected = rng.random_range(0..3);
                let Frame { image, mask, .. } = &data.frames[expected];
                let place = match mask {
                    Some(mask) => mask.draw(rng),
                    None => [rng.random_range(0..image.width), rng.random_range(0..image.height)],
                };
                assert_eq!((*number as usize, *pixel), (expected, place.map(|x| x as u32)));
            }
        }
    }

    #[test]
    fn panoramas_are_drawn_evenly_in_solid_angle() {
        let mut data = images(&[[16, 8], [4, 4]]);
        let camera = &mut data.frames[0].camera;
        *camera = Camera { lens: Lens::Equirectangular, focal: [8.0 / PI; 2], centre: [8.0, 4.0], ..camera.clone() };
        let batch = drawn(&data, 60_000);
        let [panorama, other] = [0, 1].map(|number| counts(&data, &batch, number));
        // A pixel of the other image counts as much as one on the horizon.
        let weights: Vec<f64> = (0..8).map(|row| ((f64::from(row) - 3.5) * PI / 8.0).cos()).collect();
        let all = 16.0 * weights.iter().sum::<f64>() + 16.0;
        let near = |found: usize, expected: f64| (found as f64 - expected).abs() < 5.0 * expected.sqrt();
        for (row, weight) in weights.iter().enumerate() {
            let found = panorama[16 * row..][..16].iter().sum();
            assert!(near(found, 60_000.0 * 16.0 * weight / all), "{row}: {found}");
        }
        assert!(near(other.iter().sum(), 60_000.0 * 16.0 / all), "{other:?}");
    }
}
