//! Rendering of whole images.

use super::pixel::Pixel;
use crate::camera::pinhole::Camera;
use crate::camera::rays::Rays;
use crate::dataset::image::Image;
use crate::model::Model;
use crate::sampling::RayTolerance;
use crate::volume::render::Evaluations;
use glam::DVec3;
use raygrad_autograd::Pool;

/// A rendered image with depth and opacity.
#[derive(Debug, Clone)]
pub struct Render {
    /// Colour over the background: RGB, 0 to 1.
    pub color: Image,
    /// Expected distance along the ray, one channel in scene units; 0 where opacity is below 1e-3.
    pub depth: Image,
    /// Opacity: the share of the ray's light that is blocked, one channel, 0 to 1.
    pub opacity: Image,
    /// Number of field evaluations.
    pub evaluations: Evaluations,
}

/// The opacity below which a pixel has no depth.
const VISIBLE: f64 = 1e-3;

impl Render {
    /// An empty render.
    pub(crate) fn new([width, height]: [usize; 2]) -> Self {
        let image = |channels| Image::new(width, height, channels);
        Render { color: image(3), depth: image(1), opacity: image(1), evaluations: Evaluations::default() }
    }

    /// Removes the background that was rendered over: returns RGBA with the opacity as straight alpha; 0 where nothing
    /// is visible.
    ///
    /// ```
    /// use raygrad_nerf::{Evaluations, Image, Render};
    /// let image = |channels, values: &[f32]| Image { width: 1, height: 1, channels, data: values.to_vec() };
    /// // A quarter of orange before blue.
    /// let render = Render {
    ///     color: image(3, &[0.25, 0.125, 0.75]),
    ///     depth: image(1, &[3.0]),
    ///     opacity: image(1, &[0.25]),
    ///     evaluations: Evaluations::default(),
    /// };
    /// assert_eq!(render.rgba([0.0, 0.0, 1.0]).data, [1.0, 0.5, 0.0, 0.25]);
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

    /// Parts of `tile` pixels, row-major.
    pub(crate) fn parts(&mut self, tile: usize) -> impl Iterator<Item = Part<'_>> {
        let [color, depth, opacity] = [&mut self.color, &mut self.depth, &mut self.opacity];
        let rest = depth.data.chunks_mut(tile).zip(opacity.data.chunks_mut(tile));
        let parts = color.data.chunks_mut(3 * tile).zip(rest);
        parts.map(|(color, (depth, opacity))| Part { color, depth, opacity })
    }
}

/// A part of a render.
pub(crate) struct Part<'a> {
    color: &'a mut [f32],
    depth: &'a mut [f32],
    opacity: &'a mut [f32],
}

impl Part<'_> {
    /// Stores these pixels in single precision.
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

/// Options of [`Model::render_cancellable`](crate::Model::render_cancellable).
#[derive(Clone, Copy)]
pub struct RenderOptions<'a> {
    /// Background colour, RGB, 0 to 1; normals have no background.
    pub background: [f32; 3],
    /// Tolerances of early termination and skipped colours; `None` uses the configured ones.
    pub tolerance: Option<RayTolerance>,
    /// Crop box, lower and upper corner in scene units; infinite shows everything.
    pub crop: [DVec3; 2],
    /// Called before each tile, on any thread; rendering stops once it returns `false`.
    pub keep_going: &'a (dyn Fn() -> bool + Sync),
}

impl RenderOptions<'_> {
    /// Renders the whole scene over a background, without cancellation.
    pub fn over(background: [f32; 3]) -> Self {
        RenderOptions { background, tolerance: None, crop: EVERYWHERE, keep_going: &|| true }
    }
}

/// The infinite box.
const EVERYWHERE: [DVec3; 2] = [DVec3::NEG_INFINITY, DVec3::INFINITY];

impl Model<f32> {
    /// Renders the image of `camera` over a background colour (RGB, 0 to 1).
    ///
    /// Samples lie at the centres of their bins, so the result has the same bits each time and on any number of
    /// threads.
    pub fn render(&self, camera: &Camera, background: [f32; 3]) -> Render {
        self.whole_view(camera, &RenderOptions::over(background))
    }

    /// Renders as [`render`](Self::render), with `limits` instead of the configured tolerances.
    pub fn render_within(&self, camera: &Camera, background: [f32; 3], limits: &RayTolerance) -> Render {
        self.whole_view(camera, &RenderOptions { tolerance: Some(*limits), ..RenderOptions::over(background) })
    }

    /// Renders as [`render`](Self::render), with a crop box and cancellation; returns `None` if
    /// [`keep_going`](RenderOptions::keep_going) returned `false`.
    ///
    /// ```
    /// use raygrad_nerf::glam::{DAffine3, DVec3};
    /// use raygrad_nerf::{Camera, Config, Model, Preset, RenderOptions, SceneBox};
    /// let scene_box = SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [0.0, 10.0]);
    /// let model = Model::new(Config::preset(Preset::Voxel), scene_box, 0)?;
    /// let camera = Camera::from_angle(8, 6, 0.7, DAffine3::from_translation(3.0 * DVec3::Z));
    /// let crop = [DVec3::NEG_ONE, DVec3::new(1.0, 0.0, 1.0)];
    /// let lower_half = RenderOptions { crop, ..RenderOptions::over([1.0; 3]) };
    /// let render = model.render_cancellable(&camera, &lower_half).expect("not cancelled");
    /// assert_eq!(render.color.pixel(4, 0), [1.0; 3]);
    /// let cancelled = RenderOptions { keep_going: &|| false, ..lower_half };
    /// assert!(model.render_cancellable(&camera, &cancelled).is_none());
    /// # Ok::<_, raygrad_nerf::Error>(())
    /// ```
    pub fn render_cancellable(&self, camera: &Camera, viewing: &RenderOptions<'_>) -> Option<Render> {
        let limits = viewing.tolerance.unwrap_or_else(|| self.sampler.tolerance());
        let see = |pool: &Pool<f32>, rays: &Rays<f32>, out: &mut [Pixel]| self.see(rays, &limits, pool, out);
        let (mut picture, tile) = (Render::new([camera.width, camera.height]), self.sampler.view_tile());
        let background = viewing.background.map(f64::from);
        let keep = |pixels: &[Pixel], out: Part<'_>| out.fill(pixels.iter().map(|pixel| pixel.over(background)));
        picture.evaluations = self.pixels(camera, viewing, tile, see, picture.parts(tile), keep)?;
        Some(picture)
    }

    /// A render that is never cancelled.
    fn whole_view(&self, camera: &Camera, viewing: &RenderOptions<'_>) -> Render {
        self.render_cancellable(camera, viewing).expect("never cancelled")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::SceneBox;
    use crate::model::{Config, Preset};
    use raygrad_tensor::Real;

    fn model() -> Model<f32> {
        let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [0.0, 10.0]);
        Model::new(Config::preset(Preset::Small), extent, 0).unwrap()
    }

    fn camera(width: usize, height: usize) -> Camera {
        Camera::from_angle(width, height, 0.6, Camera::look_at(DVec3::new(0.0, 0.0, 4.0), DVec3::ZERO, DVec3::Y))
    }

    #[test]
    fn crop_hides_all_outside_of_the_box() {
        let (model, camera) = (model(), camera(17, 13));
        let whole = model.render(&camera, [1.0; 3]);
        let within = |lower: [f64; 3], upper: [f64; 3]| {
            let viewing = RenderOptions { crop: [lower.into(), upper.into()], ..RenderOptions::over([1.0; 3]) };
            (
                model.render_cancellable(&camera, &viewing).unwrap(),
                model.normals_cancellable(&camera, &viewing).unwrap(),
            )
        };
        // A crop larger than the scene changes nothing; one beside it shows nothing.
        let (all, normals) = within([-9.0, -1.0, f64::NEG_INFINITY], [1.0, 9.0, f64::INFINITY]);
        assert!(all.color == whole.color && normals == model.normals(&camera));
        for upper in [[-1.5, 2.0, 2.0], [-3.0, 2.0, 2.0], [0.0, -2.0, 2.0]] {
            let (none, normals) = within([-2.0; 3], upper);
            // One with its corners the wrong way round too.
            let most = |image: &Image| image.data.iter().fold(0.0_f32, |most, x| Real::maximum(most, x.abs()));
            assert_eq!([most(&none.opacity), most(&normals)], [0.0; 2]);
        }
        // The left half of the image.
        let (left, normals) = within([-2.0; 3], [0.0, 2.0, 2.0]);
        let columns = |image: &Image, x: std::ops::Range<usize>| {
            x.flat_map(|x| (0..13).map(move |y| [x, y])).map(|[x, y]| image.pixel(x, y).to_vec()).collect::<Vec<_>>()
        };
        assert_eq!(columns(&left.color, 0..5), columns(&whole.color, 0..5));
        assert!(columns(&left.opacity, 0..5).concat().iter().any(|x| *x > 0.0));
        assert!(columns(&left.opacity, 12..17).concat().iter().all(|x| *x == 0.0));
        assert!(columns(&normals, 12..17).concat().iter().all(|x| *x == 0.0));
    }

    #[test]
    fn bounded_scene_is_seen_beyond_training_distances() {
        let seen = |span: [f64; 2], unbounded: bool, distance: f64| {
            let extent = SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], span);
            let model: Model<f32> =
                Model::new(Config { unbounded, ..Config::preset(Preset::Small) }, extent, 0).unwrap();
            let eye = Camera::look_at(DVec3::new(0.0, 0.0, distance), DVec3::ZERO, DVec3::Y);
            (model.render(&Camera::from_angle(3, 3, 0.1, eye), [1.0; 3]).opacity, model.view_near_far())
        };
        for distance in [0.5, 4.0, 30.0] {
            let (opacity, span) = seen([2.0, 6.0], false, distance);
            // As if images had been taken at all distances.
            assert_eq!(opacity, seen([0.02, 100.0], false, distance).0, "{distance}");
            assert!(opacity.data[4] > 0.1 && span == [0.02, f64::INFINITY], "{opacity:?} {span:?}");
        }
        assert_eq!(seen([0.0, 6.0], false, 4.0).1, [0.0, f64::INFINITY]);
        // An unbounded scene is unknown near the cameras.
        assert_eq!(seen([2.0, 600.0], true, 4.0).1, [2.0, 600.0]);
    }

    #[test]
    fn tiles_cover_every_pixel_once_in_order() {
        let (model, camera) = (model(), camera(17, 13));
        let viewing = RenderOptions::over([1.0; 3]);
        let mut tiles = vec![(0, Rays::new()); 221_usize.div_ceil(50)];
        let keep = |_: &Pool<f32>, first, rays: &Rays<f32>, tile: &mut _| {
            *tile = (first, rays.clone());
            Evaluations::default()
        };
        model.tiles(&camera, &viewing, 50, tiles.iter_mut(), keep).unwrap();
        assert_eq!(
            tiles.iter().map(|(first, rays)| [*first, rays.len()]).collect::<Vec<_>>(),
            [[0, 50], [50, 50], [100, 50], [150, 50], [200, 21]]
        );
        let mut all = Rays::<f32>::new();
        for pixel in 0..221 {
            all.push_pixel(&camera, [pixel % 17, pixel / 17], model.reach(), model.view_near_far());
        }
        assert_eq!(tiles.iter().flat_map(|(_, rays)| rays.directions.clone()).collect::<Vec<_>>(), all.directions);
        assert_eq!(tiles.iter().flat_map(|(_, rays)| rays.spans.clone()).collect::<Vec<_>>(), all.spans);
    }

    #[test]
    fn cancelled_render_stops_early() {
        use std::sync::atomic::{AtomicUsize, Ordering};
        let (model, camera) = (model(), camera(64, 64));
        let asked = AtomicUsize::new(0);
        let keep_going = || asked.fetch_add(1, Ordering::Relaxed) < 3;
        let viewing = RenderOptions { keep_going: &keep_going, ..RenderOptions::over([1.0; 3]) };
        assert!(model.render_cancellable(&camera, &viewing).is_none());
        let tiles = (64 * 64_usize).div_ceil(model.sampler.view_tile());
        assert!((4..tiles).contains(&asked.load(Ordering::Relaxed)), "{asked:?} of {tiles}");
        assert!(model.normals_cancellable(&camera, &viewing).is_none());
        let whole = model.render_cancellable(&camera, &RenderOptions { keep_going: &|| true, ..viewing }).unwrap();
        assert_eq!(whole.color, model.render(&camera, [1.0; 3]).color);
    }
}
