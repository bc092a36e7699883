//! Evaluation of a model along the rays of a camera, tile by tile on all cores.

use super::picture::RenderOptions;
use super::pixel::Pixel;
use crate::camera::pinhole::Camera;
use crate::camera::rays::Rays;
use crate::model::Model;
use crate::random::Jitter;
use crate::sampling::{Purpose, Sampled};
use crate::volume::query::Query;
use crate::volume::render::Evaluations;
use raygrad_autograd::{Pool, Scalar, Tape};
use raygrad_tensor::parallel::{self, Scratch, locked};
use std::sync::{Mutex, PoisonError};

impl<T: Scalar> Model<T> {
    /// Samples `rays` as renders do, at steps `finer` times smaller than configured, and passes the samples to `see`
    /// with the field and the model's appearance.
    pub(crate) fn along<R>(
        &self,
        rays: &Rays<T>,
        finer: usize,
        pool: &Pool<T>,
        see: impl for<'t> FnOnce(&Query<'_, 't, T>, Sampled<'t, T>) -> R,
    ) -> R {
        let tape = Tape::with_pool(pool.clone());
        let params = self.params.bind_constant(&tape);
        let frames = self.appearance_image.map(|look| vec![look; rays.len()]);
        let query = Query { frames: frames.as_deref(), ..Query::new(&*self.field, &params) };
        see(&query, self.sampler.sample(&query, rays, Purpose::View { finer }, &mut Jitter::Middle))
    }

    /// Calls `see` for tiles of `tile` pixels, row-major, on all cores, with the index of the tile's first pixel, its
    /// rays and its part of `out`. `None` if it was cancelled.
    pub(crate) fn tiles<P: Send>(
        &self,
        camera: &Camera,
        viewing: &RenderOptions<'_>,
        tile: usize,
        out: impl Iterator<Item = P>,
        see: impl Fn(&Pool<T>, usize, &Rays<T>, P) -> Evaluations + Sync,
    ) -> Option<Evaluations> {
        let ([lower, upper], [from, to]) = (self.reach(), viewing.crop);
        let (bounds, count) = ([lower.max(from), upper.min(to)], camera.width * camera.height);
        let [near, far] = self.view_near_far();
        // Rays would accept swapped corners, so an empty box gets an empty span.
        let span = [near, if bounds[0].cmplt(bounds[1]).all() { far } else { near }];
        let (pools, seen) = (Scratch::<Pool<T>>::default(), Mutex::new(Some(Evaluations::default())));
        parallel::each_of(out, |which, out| {
            let continues = locked(&seen).is_some() && (viewing.keep_going)();
            let evaluations = continues.then(|| {
                let mut rays = Rays::new();
                for pixel in which * tile..count.min((which + 1) * tile) {
                    rays.push_pixel(camera, camera.place_of(pixel), bounds, span);
                }
                pools.with(|pool| parallel::serial(|| see(pool, which * tile, &rays, out)))
            });
            let mut seen = locked(&seen);
            *seen = seen.zip(evaluations).map(|(a, b)| a + b);
        });
        seen.into_inner().unwrap_or_else(PoisonError::into_inner)
    }

    /// Renders a camera's pixels, row-major, in tiles of `tile`; `keep` stores a tile's pixels in its part of `out`.
    /// `None` if it was cancelled.
    pub(crate) fn pixels<P: Send>(
        &self,
        camera: &Camera,
        viewing: &RenderOptions<'_>,
        tile: usize,
        see: impl Fn(&Pool<T>, &Rays<T>, &mut [Pixel]) -> Evaluations + Sync,
        out: impl Iterator<Item = P>,
        keep: impl Fn(&[Pixel], P) + Sync,
    ) -> Option<Evaluations> {
        let gain = self.exposure.as_ref().map(|tone| tone.gain(&self.params, self.appearance_image, self.vignetted));
        self.tiles(camera, viewing, tile, out, |pool, first, rays, out| {
            let mut pixels = vec![Pixel::default(); rays.len()];
            let evaluations = see(pool, rays, &mut pixels);
            if let Some(gain) = &gain {
                for (seen, pixel) in pixels.iter_mut().zip(first..) {
                    let gains = gain.at(camera.off_axis(camera.place_of(pixel)));
                    // White is the brightest colour behind this opacity. NaN stays.
                    let most = 1.0 - seen.transmittance;
                    for (color, gain) in seen.color.iter_mut().zip(gains) {
                        *color *= gain;
                        if *color > most {
                            *color = most;
                        }
                    }
                }
            }
            keep(&pixels, out);
            evaluations
        })
    }
}
