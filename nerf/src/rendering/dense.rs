//! Reference renders: every sample, in any precision.

use super::picture::{Render, RenderOptions};
use super::pixel::Pixel;
use crate::camera::pinhole::Camera;
use crate::camera::rays::Rays;
use crate::model::Model;
use crate::volume::early_termination::VisibleSamples;
use crate::volume::render::Evaluations;
use raygrad_autograd::{Pool, Scalar, Var};

/// A reference render, with pixels in double precision.
#[derive(Debug, Clone)]
pub struct ReferenceRender {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Pixels over the background, row by row.
    pub pixels: Vec<Pixel>,
    /// Number of field evaluations.
    pub evaluations: Evaluations,
}

/// Rays per tile.
const TILE: usize = 64;

impl<T: Scalar> Model<T> {
    /// Renders every sample with arithmetic in `T`, at steps `finer` times smaller than configured.
    ///
    /// It skips only the cells that the occupancy grid marks empty. In f64 with several times the steps it is a
    /// reference for faster renders: `model.cast::<f64>()?.render_reference(..)`. Samplers without steps ignore
    /// `finer`.
    ///
    /// # Panics
    /// If `finer` is 0.
    #[inline(never)]
    pub fn render_reference(&self, camera: &Camera, background: [f64; 3], finer: usize) -> ReferenceRender {
        assert!(finer > 0, "`finer` must be at least 1, is 0");
        let see = |pool: &Pool<T>, rays: &Rays<T>, out: &mut [Pixel]| self.dense_rays(rays, finer, pool, out);
        let mut pixels = vec![Pixel::default(); camera.width * camera.height];
        let keep = |seen: &[Pixel], out: &mut [Pixel]| {
            out.iter_mut().zip(seen).for_each(|(out, pixel)| *out = pixel.over(background));
        };
        let all = RenderOptions::over([0.0; 3]);
        let evaluations = self.pixels(camera, &all, TILE, see, pixels.chunks_mut(TILE), keep);
        let evaluations = evaluations.expect("never cancelled");
        ReferenceRender { width: camera.width, height: camera.height, pixels, evaluations }
    }

    fn dense_rays(&self, rays: &Rays<T>, finer: usize, pool: &Pool<T>, out: &mut [Pixel]) -> Evaluations {
        self.along(rays, finer, pool, |query, sampled| {
            let VisibleSamples { rendered, density_queries: asked, .. } =
                self.sampler.quadrature().render(query, &sampled.samples, 0.0);
            let [color, depth, left] = [&rendered.color, &rendered.depth(), &rendered.transmittance()].map(numbers);
            for (i, out) in out.iter_mut().enumerate() {
                *out = Pixel {
                    color: [color[3 * i], color[3 * i + 1], color[3 * i + 2]],
                    depth: depth[i],
                    transmittance: left[i],
                };
            }
            sampled.evaluations + Evaluations { density: asked as u64, color: asked as u64, unskipped: 0 }
        })
    }
}

fn numbers<T: Scalar>(values: &Var<'_, T>) -> Vec<f64> {
    values.value().as_slice().iter().map(|x| x.to_f64()).collect()
}

impl ReferenceRender {
    /// Returns the render rounded to single precision.
    pub fn picture(&self) -> Render {
        let mut picture = Render::new([self.width, self.height]);
        picture.parts(self.pixels.len().max(1)).for_each(|part| part.fill(self.pixels.iter().copied()));
        picture.evaluations = self.evaluations;
        picture
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::sample::cameras_around;
    use crate::field::{FieldConfig, VoxelConfig};
    use crate::model::SceneBox;
    use crate::model::{Config, Preset};
    use crate::space::occupancy::Skip;
    use glam::DVec3;
    use raygrad_autograd::Real;

    /// A voxel model with a ball in one corner.
    fn ball() -> Model<f32> {
        let mut config = Config::preset(Preset::Voxel).with_skip(Skip::Off);
        config.field = FieldConfig::new(VoxelConfig { resolution: 20, direction_degree: 2 });
        let mut model = Model::new(config, SceneBox::new([DVec3::NEG_ONE, DVec3::ONE], [2.0, 6.0]), 3).unwrap();
        let table = model.params.find("field.table").unwrap();
        let rows = model.params.get_mut(table).as_mut_slice().chunks_exact_mut(16).enumerate();
        rows.for_each(|(i, row)| row[0] = if i % 21 < 9 && i / 441 < 9 { 0.3 } else { -2.0 });
        model
    }

    #[test]
    fn single_precision_render_equals_double() {
        let model = ball();
        let double = model.cast::<f64>().unwrap();
        let camera = &cameras_around(4, 20)[1];
        let [background, black] = [[0.2, 0.5, 1.0], [0.0; 3]];
        let [exact, single] =
            [double.render_reference(camera, background, 1), model.render_reference(camera, background, 1)];
        assert_eq!(exact.evaluations, single.evaluations);
        let values = |pixel: &Pixel| {
            let [r, g, b] = pixel.color;
            [r, g, b, pixel.depth, pixel.transmittance]
        };
        let worst = |one: &ReferenceRender, which: std::ops::Range<usize>| {
            let pairs = exact.pixels.iter().map(values).zip(one.pixels.iter().map(values));
            let errors = pairs.flat_map(|(a, b)| which.clone().map(move |i| (a[i] - b[i]).abs()));
            errors.fold(0.0_f64, Real::maximum)
        };
        // Densities are up to e^2, and distances around 4.
        let (colour, all) = (worst(&single, 0..3), worst(&single, 0..5));
        println!("f32 against f64 at the same samples: colours {colour:.1e}, with distances {all:.1e}");
        assert!(colour > 0.0 && colour <= 1e-6 && all <= 1e-5, "{colour:e}, {all:e}");
        let view = model.render(camera, background.map(|x| x as f32));
        let picture = exact.picture();
        let differences = view.color.data.iter().zip(&picture.color.data).map(|(a, b)| (a - b).abs());
        assert!(differences.fold(0.0, Real::maximum) <= 1e-5, "the view that leaves out nothing is the same");
        let depths = |one: &Render, other: &Render| {
            let pairs = one.depth.data.iter().zip(&other.depth.data).map(|(a, b)| (a - b).abs());
            pairs.fold(0.0, Real::maximum)
        };
        assert!(depths(&view, &picture) <= 1e-4 && picture.depth.data.iter().any(|&t| t > 3.0), "and so are distances");
        assert!(
            picture.opacity.data.iter().any(|&x| x > 0.5)
                && exact.pixels != double.render_reference(camera, black, 1).pixels
        );
        let finer = double.render_reference(camera, background, 3);
        assert!((1e-9..0.2).contains(&worst(&finer, 0..5)), "{}", worst(&finer, 0..5));
        assert!(finer.evaluations.density > 2 * exact.evaluations.density);
    }

    #[test]
    fn quadratures_render_the_same_image() {
        let mut model = ball();
        let camera = &cameras_around(4, 20)[1];
        let reference = model.cast::<f64>().unwrap().render_reference(camera, [1.0; 3], 4).picture();
        use crate::volume::quadrature::Quadrature::*;
        // The voxels' edges are steep at the scale of a step.
        for rule in [Left, Midpoint, PiecewiseLinear, Gauss2, Adaptive { tolerance: 1e-4 }] {
            let Some(sampler) = model.marching_mut() else { panic!() };
            sampler.config.quadrature = rule;
            let seen = model.render(camera, [1.0; 3]);
            let differences = seen.color.data.iter().zip(&reference.color.data).map(|(a, b)| (a - b).abs());
            let worst = differences.fold(0.0, Real::maximum);
            println!("{rule:16} {worst:.1e} {:?}", seen.evaluations);
            assert!(worst <= 1e-2 && seen.evaluations.density > 0, "{rule}: {worst}");
            // Distances are compared only where the render is nearly opaque.
            let solid = (0..seen.depth.data.len()).filter(|&i| reference.opacity.data[i] > 0.5);
            let far = solid.map(|i| (seen.depth.data[i] - reference.depth.data[i]).abs());
            let (count, worst) = far.fold((0, 0.0), |(n, worst), x| (n + 1, Real::maximum(worst, x)));
            assert!(count > 20 && worst <= 0.05, "{rule}: distances of {count} pixels are {worst} off");
        }
    }
}
