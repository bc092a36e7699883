//! Views in which nothing is left out, in any precision: what others are measured against.

use crate::camera::bounds::clip_span;
use crate::camera::pinhole::Camera;
use crate::camera::rays::{Rays, Samples};
use crate::dataset::image::Image;
use crate::model::{Model, Sampler};
use crate::random::Jitter;
use crate::rendering::picture::{Evaluations, Picture, VISIBLE};
use crate::sampling::marching::Marching;
use crate::space::occupancy::{MarchBuffer, Step};
use raygrad_autograd::{Scalar, Segments, Tape, Tensor};
use raygrad_tensor::parallel;
use rayon::prelude::*;

/// A view in double precision.
#[derive(Debug, Clone)]
pub struct DenseView {
    /// Pixels in a row.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// For each pixel the colour over the background, the distance times the weight, and the transmittance.
    pub pixels: Vec<[f64; 5]>,
    /// How often fields were asked.
    pub evaluations: Evaluations,
}

/// Rays that are evaluated together.
const TILE: usize = 64;

impl<T: Scalar> Model<T> {
    /// The view from `camera` with all arithmetic in `T`, every sample in its middle, at steps `finer` times smaller than
    /// the configured ones. Nothing is left out but the cells that the occupancy grid holds to be empty.
    ///
    /// In f64 at several times the steps it is a reference for faster ways: `model.cast::<f64>()?.dense_view(..)`. A
    /// hierarchical sampler has as many samples whatever `finer` is.
    ///
    /// # Panics
    /// If `finer` is 0.
    #[inline(never)]
    pub fn dense_view(&self, camera: &Camera, background: [f64; 3], finer: usize) -> DenseView {
        assert!(finer > 0, "steps that are 0 times smaller");
        let mut pixels = vec![[0.0; 5]; camera.width * camera.height];
        let tiles = pixels.par_chunks_mut(TILE).enumerate();
        let evaluations = tiles.map(|(tile, out)| {
            let mut rays = Rays::<T>::new();
            for pixel in tile * TILE..tile * TILE + out.len() {
                let ray = camera.pixel_ray(pixel % camera.width, pixel / camera.width);
                rays.push(&ray, clip_span(&ray, self.extent.bounds, self.extent.span));
            }
            parallel::serial(|| self.dense_rays(&rays, finer, out))
        });
        let evaluations = evaluations.reduce(Evaluations::default, |a, b| a + b);
        for pixel in &mut pixels {
            let left = pixel[4];
            pixel.iter_mut().zip(background).for_each(|(value, background)| *value += left * background);
        }
        DenseView { width: camera.width, height: camera.height, pixels, evaluations }
    }

    fn dense_rays(&self, rays: &Rays<T>, finer: usize, out: &mut [[f64; 5]]) -> Evaluations {
        let tape = Tape::new();
        let params = self.params.bind_constant(&tape);
        let (rendered, evaluations) = match &self.sampler {
            Sampler::Hierarchical(sampler) => {
                let rendered = sampler.render(&*self.field, &params, rays, &mut Jitter::Middle, true, &tape).fine;
                let each = (rays.len() * sampler.config.evaluations()) as u64;
                (rendered, Evaluations { density: each, color: each, unskipped: each })
            }
            Sampler::Marching(sampler) => {
                let (steps, unskipped) = even_steps(sampler, rays, finer, &tape);
                let rule = sampler.config.quadrature;
                let seen = rule.plan_for(&*self.field, &params, &steps, 0.0, &tape);
                let rendered = seen.plan.render(&*self.field, &params, true, &tape);
                let asked = seen.evaluations as u64;
                (rendered, Evaluations { density: asked, color: asked, unskipped })
            }
        };
        for (out, values) in out.iter_mut().zip(rendered.value().as_slice().chunks_exact(5)) {
            out.iter_mut().zip(values).for_each(|(out, value)| *out = value.to_f64());
        }
        evaluations
    }
}

/// Samples in occupied cells, and how many there would be if all were. Where they lie is worked out in f32, so they are the
/// same in every precision.
fn even_steps<T: Scalar>(sampler: &Marching, rays: &Rays<T>, finer: usize, tape: &Tape<T>) -> (Samples<T>, u64) {
    let mut buffer = MarchBuffer::default();
    let step = Step::uniform(sampler.view_step() / finer as f32);
    sampler.grid.march(&rays.cast(), &step, &mut Jitter::Middle, &mut buffer);
    let tensor =
        |values: &[f32]| Tensor::from_vec(&[values.len()], values.iter().map(|&x| T::from_f64(x.into())).collect());
    let segments = Segments::new(&buffer.offsets[..]);
    (Samples::new(rays, segments, tensor(&buffer.t), tensor(&buffer.delta), tape.pool()), buffer.steps)
}

impl DenseView {
    /// The view rounded to single precision.
    pub fn picture(&self) -> Picture {
        let image = |channels: usize, value: &dyn Fn(&[f64; 5], usize) -> f64| {
            let data = self.pixels.iter().flat_map(|pixel| (0..channels).map(move |c| value(pixel, c) as f32));
            Image { width: self.width, height: self.height, channels, data: data.collect() }
        };
        let depth = |pixel: &[f64; 5]| {
            let opacity = 1.0 - pixel[4];
            if opacity > f64::from(VISIBLE) { pixel[3] / opacity } else { 0.0 }
        };
        Picture {
            color: image(3, &|pixel, c| pixel[c]),
            depth: image(1, &|pixel, _| depth(pixel)),
            opacity: image(1, &|pixel, _| 1.0 - pixel[4]),
            evaluations: self.evaluations,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::scene::train_cameras;
    use crate::field::{FieldConfig, VoxelConfig};
    use crate::model::Extent;
    use crate::model::config::{Config, Preset};
    use crate::space::occupancy::Skip;
    use glam::DVec3;
    use raygrad_autograd::Real;

    /// A voxel model with a ball in one corner.
    fn ball() -> Model<f32> {
        let mut config = Config::preset(Preset::Voxel).with_skip(Skip::Off);
        config.field = FieldConfig::Voxel(VoxelConfig { resolution: 20, direction_degree: 2 });
        let mut model =
            Model::new(config, Extent { bounds: [DVec3::NEG_ONE, DVec3::ONE], span: [2.0, 6.0] }, 3).unwrap();
        let (table, _) = model.field.table().unwrap();
        let rows = model.params.get_mut(table).as_mut_slice().chunks_exact_mut(16).enumerate();
        rows.for_each(|(i, row)| row[0] = if i % 21 < 9 && i / 441 < 9 { 0.3 } else { -2.0 });
        model
    }

    #[test]
    fn single_precision_shows_what_double_shows() {
        let model = ball();
        let double = model.cast::<f64>().unwrap();
        let camera = &train_cameras(4, 20)[1];
        let [background, black] = [[0.2, 0.5, 1.0], [0.0; 3]];
        let [exact, single] = [double.dense_view(camera, background, 1), model.dense_view(camera, background, 1)];
        assert_eq!(exact.evaluations, single.evaluations);
        let worst = |values: std::ops::Range<usize>| {
            let pairs = exact.pixels.iter().zip(&single.pixels);
            let errors = pairs.flat_map(|(a, b)| values.clone().map(|i| (a[i] - b[i]).abs()));
            errors.fold(0.0_f64, Real::maximum)
        };
        // Densities are up to e^2, distances around 4.
        let (colour, all) = (worst(0..3), worst(0..exact.pixels[0].len()));
        println!("f32 against f64 at the same samples: colours {colour:.1e}, with distances {all:.1e}");
        assert!(colour > 0.0 && colour <= 1e-6 && all <= 1e-5, "{colour:e}, {all:e}");
        let view = model.view(camera, background.map(|x| x as f32));
        let picture = exact.picture();
        let differences = view.color.data.iter().zip(&picture.color.data).map(|(a, b)| (a - b).abs());
        assert!(differences.fold(0.0, Real::maximum) <= 1e-5, "the view that leaves out nothing is the same");
        assert!(
            picture.opacity.data.iter().any(|&x| x > 0.5) && exact.pixels != double.dense_view(camera, black, 1).pixels
        );
        let finer = double.dense_view(camera, background, 3);
        let difference = |view: &DenseView| {
            let pairs = view.pixels.iter().flatten().zip(exact.pixels.iter().flatten());
            pairs.map(|(a, b)| (a - b).abs()).fold(0.0, Real::maximum)
        };
        assert!((1e-9..0.2).contains(&difference(&finer)), "{}", difference(&finer));
        assert!(finer.evaluations.density > 2 * exact.evaluations.density);
    }

    #[test]
    fn every_quadrature_shows_the_same_scene() {
        let mut model = ball();
        let camera = &train_cameras(4, 20)[1];
        let reference = model.cast::<f64>().unwrap().dense_view(camera, [1.0; 3], 4).picture();
        use crate::volume::quadrature::Quadrature::*;
        // The voxels' edges are steep at the scale of a step.
        for rule in [Left, Midpoint, PiecewiseLinear, Gauss2, Adaptive { tolerance: 1e-4 }] {
            let Sampler::Marching(sampler) = &mut model.sampler else { panic!() };
            sampler.config.quadrature = rule;
            let seen = model.view(camera, [1.0; 3]);
            let differences = seen.color.data.iter().zip(&reference.color.data).map(|(a, b)| (a - b).abs());
            let worst = differences.fold(0.0, Real::maximum);
            println!("{rule:16} {worst:.1e} {:?}", seen.evaluations);
            assert!(worst <= 1e-2 && seen.evaluations.density > 0, "{rule}: {worst}");
        }
    }
}
