//! Rendering whole images, tile by tile on all cores.

use super::pixel::Pixel;
use super::view::Viewer;
use crate::camera::pinhole::Camera;
use crate::camera::rays::Rays;
use crate::dataset::image::Image;
use crate::model::Model;
use crate::sampling::Limits;
use crate::volume::render::Evaluations;
use raygrad_autograd::Scalar;
use raygrad_tensor::parallel;
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
    /// How often fields were asked.
    pub evaluations: Evaluations,
}

/// Below this opacity a pixel has no depth.
const VISIBLE: f64 = 1e-3;

impl Picture {
    /// A picture of nothing.
    pub(crate) fn new([width, height]: [usize; 2]) -> Self {
        let image = |channels| Image::new(width, height, channels);
        Picture { color: image(3), depth: image(1), opacity: image(1), evaluations: Evaluations::default() }
    }

    /// The colour without the background that the picture was rendered over: RGBA, with the opacity as alpha and
    /// colours that are not multiplied by it; where nothing is visible all 0.
    ///
    /// ```
    /// use raygrad_nerf::{Evaluations, Image, Picture};
    /// let image = |channels, values: &[f32]| Image { width: 1, height: 1, channels, data: values.to_vec() };
    /// // A quarter of orange before blue.
    /// let picture = Picture {
    ///     color: image(3, &[0.25, 0.125, 0.75]),
    ///     depth: image(1, &[3.0]),
    ///     opacity: image(1, &[0.25]),
    ///     evaluations: Evaluations::default(),
    /// };
    /// assert_eq!(picture.rgba([0.0, 0.0, 1.0]).data, [1.0, 0.5, 0.0, 0.25]);
    /// ```
    pub fn rgba(&self, background: [f32; 3]) -> Image {
        let mut out = Image::new(self.color.width, self.color.height, 4);
        let seen = self.color.data.chunks_exact(3).zip(&self.opacity.data);
        for (out, (color, &opacity)) in out.data.chunks_exact_mut(4).zip(seen) {
            if f64::from(opacity) > VISIBLE {
                let own = |value: f32, behind: f32| ((value - (1.0 - opacity) * behind) / opacity).clamp(0.0, 1.0);
                (0..3).for_each(|c| out[c] = own(color[c], background[c]));
                out[3] = opacity;
            }
        }
        out
    }

    /// Its parts of `tile` pixels each, row by row.
    pub(crate) fn parts(&mut self, tile: usize) -> impl IndexedParallelIterator<Item = Part<'_>> {
        let [color, depth, opacity] = [&mut self.color, &mut self.depth, &mut self.opacity];
        let rest = depth.data.par_chunks_mut(tile).zip(opacity.data.par_chunks_mut(tile));
        let parts = color.data.par_chunks_mut(3 * tile).zip(rest);
        parts.map(|(color, (depth, opacity))| Part { color, depth, opacity })
    }
}

/// A part of a picture.
pub(crate) struct Part<'a> {
    color: &'a mut [f32],
    depth: &'a mut [f32],
    opacity: &'a mut [f32],
}

impl Part<'_> {
    /// Takes these pixels, in single precision.
    pub fn fill(self, pixels: impl Iterator<Item = Pixel>) {
        let rest = self.depth.iter_mut().zip(self.opacity);
        for (pixel, (color, (depth, opacity))) in pixels.zip(self.color.chunks_exact_mut(3).zip(rest)) {
            color.iter_mut().zip(pixel.color).for_each(|(out, value)| *out = value as f32);
            let blocked = 1.0 - pixel.transmittance;
            *depth = if blocked > VISIBLE { pixel.depth / blocked } else { 0.0 } as f32;
            *opacity = blocked as f32;
        }
    }
}

impl<T: Scalar> Model<T> {
    /// The rays of a camera's pixels, row by row, in tiles of `tile`, on all cores: `see` is told the number of a
    /// tile's first pixel, its rays and its part of `out`.
    pub(crate) fn tiles<S: Default, P: Send>(
        &self,
        camera: &Camera,
        tile: usize,
        out: impl IndexedParallelIterator<Item = P>,
        see: impl Fn(&mut S, usize, &Rays<T>, P) -> Evaluations + Sync,
    ) -> Evaluations {
        let (bounds, count) = (self.reach(), camera.width * camera.height);
        let tiles = out.enumerate().map_init(S::default, |scratch, (which, out)| {
            let mut rays = Rays::new();
            for pixel in which * tile..count.min((which + 1) * tile) {
                rays.push_pixel(camera, camera.place_of(pixel), bounds, self.extent.span);
            }
            parallel::serial(|| see(scratch, which * tile, &rays, out))
        });
        tiles.reduce(Evaluations::default, |a, b| a + b)
    }

    /// What is seen along the rays of a camera's pixels, row by row, in tiles of `tile` rays; `keep` takes what a tile
    /// shows to its part of `out`.
    pub(crate) fn pixels<S: Default, P: Send>(
        &self,
        camera: &Camera,
        tile: usize,
        see: impl Fn(&mut S, &Rays<T>, &mut [Pixel]) -> Evaluations + Sync,
        out: impl IndexedParallelIterator<Item = P>,
        keep: impl Fn(&[Pixel], P) + Sync,
    ) -> Evaluations {
        let gain = self.tone.as_ref().map(|tone| tone.gain(&self.params, self.look, self.vignetted));
        self.tiles(camera, tile, out, |(scratch, pixels): &mut (S, Vec<Pixel>), first, rays, out| {
            pixels.resize(rays.len(), Pixel::default());
            let evaluations = see(scratch, rays, pixels);
            if let Some(gain) = &gain {
                for (seen, pixel) in pixels.iter_mut().zip(first..) {
                    let gains = gain.at(camera.off_axis(camera.place_of(pixel)));
                    let color = seen.color.iter_mut().zip(gains);
                    color.for_each(|(color, gain)| *color = (*color * gain).min(1.0));
                }
            }
            keep(pixels, out);
            evaluations
        })
    }
}

impl Model<f32> {
    /// The view from `camera` over a background colour, samples in the middle of their bins or steps: the same bits each
    /// time, on any number of threads.
    pub fn view(&self, camera: &Camera, background: [f32; 3]) -> Picture {
        self.view_within(camera, background, &self.sampler.limits())
    }

    /// As [`view`](Self::view), with these limits in place of those that go with the configuration.
    pub fn view_within(&self, camera: &Camera, background: [f32; 3], limits: &Limits) -> Picture {
        let see = |viewer: &mut Viewer, rays: &Rays<f32>, out: &mut [Pixel]| viewer.see(self, rays, limits, out);
        let (mut picture, tile) = (Picture::new([camera.width, camera.height]), self.sampler.view_tile());
        let background = background.map(f64::from);
        let keep = |pixels: &[Pixel], out: Part<'_>| out.fill(pixels.iter().map(|pixel| pixel.over(background)));
        picture.evaluations = self.pixels(camera, tile, see, picture.parts(tile), keep);
        picture
    }

    /// The view from `camera` at `1 / coarsest` of its size and then at twice the size each time, up to the whole:
    /// something to look at while the rest is computed, for a third more work. Each picture is rendered when the
    /// iterator is asked for it.
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Extent;
    use crate::model::config::{Config, Preset};
    use glam::DVec3;

    #[test]
    fn a_progressive_view_ends_with_the_view_itself() {
        let extent = Extent::new([DVec3::NEG_ONE, DVec3::ONE], [0.0, 10.0]);
        let model = Model::new(Config::preset(Preset::Small), extent, 0).unwrap();
        let pose = Camera::look_at(DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO, DVec3::Y);
        let camera = Camera::from_angle(13, 9, 0.6, pose);
        let pictures: Vec<Picture> = model.progressive(&camera, [1.0; 3], 4).collect();
        let sizes: Vec<_> = pictures.iter().map(|p| [p.color.width, p.color.height]).collect();
        assert_eq!(sizes, [[4, 3], [7, 5], [13, 9]]);
        assert_eq!(pictures[2].color, model.view(&camera, [1.0; 3]).color);
    }
}
