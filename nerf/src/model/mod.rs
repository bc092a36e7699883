//! A model: a field, where it is sampled, and its parameters.

mod camera_optimizer;
pub(crate) mod config;
mod exposure;
mod registry;
mod scene_box;
mod store;

pub use camera_optimizer::{CameraOptimizer, CameraOptimizerConfig, RefinedParam};
pub(crate) use camera_optimizer::{FOCAL, LENS, POSES};
pub use config::{Config, GroupConfig, Preset};
pub(crate) use exposure::{EXPOSURE, VIGNETTING};
pub use exposure::{ExposureConfig, ExposureModel};
pub use scene_box::SceneBox;

use crate::Result;
use crate::camera::pinhole::Camera;
use crate::camera::rays::{Rays, Samples};
use crate::component::BuildContext;
use crate::field::Field;
use crate::losses::{LossTerm, LossTermConfig};
use crate::random::Jitter;
use crate::range::check_range;
use crate::sampling::marching::Marching;
use crate::sampling::{Purpose, Sampler};
use crate::space::cube::Space;
use crate::space::occupancy::Skipping;
use crate::volume::query::Query;
use glam::DVec3;
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use raygrad_autograd::{Pool, Scalar, Tape, Tensor, Var};
use raygrad_nn::{Bound, Params};
use std::any::Any;
use std::sync::Arc;

/// Photographs that a model is fitted to, at most: it may have numbers of its own for each.
const MOST_FRAMES: usize = 1 << 20;
/// What is nearer to a camera than this share of the scene's side is not looked at.
const NEAREST: f64 = 1e-2;

/// A field with its sampler and parameters.
#[derive(Clone)]
pub struct Model<T: Scalar> {
    /// How it was made.
    pub config: Config,
    /// What it covers.
    pub scene_box: SceneBox,
    /// Its parameters.
    pub params: Params<T>,
    /// What is rendered.
    pub field: Arc<dyn Field<T>>,
    /// Where it is sampled.
    pub sampler: Box<dyn Sampler<T>>,
    /// What is minimised beside the loss of colours.
    pub terms: Vec<Arc<dyn LossTerm<T>>>,
    /// Corrections of the photographs' cameras, if some are learned.
    pub camera_optimizer: Option<CameraOptimizer>,
    /// What photographs make of the scene's colours, if that is learned.
    pub exposure: Option<ExposureModel>,
    /// The number of the photograph that views look like, where a field knows how photographs differ; without one they
    /// look like none in particular. Of a photograph that there is not, views panic.
    pub appearance_image: Option<u32>,
    /// Whether views have the photographs' darker corners, if a [`ExposureModel`] knows of them. They have not, at first.
    pub vignetted: bool,
    /// How much of their detail fields have: see [`set_detail`](Self::set_detail).
    detail: f64,
}

fn space(config: &Config, extent: &SceneBox) -> Space {
    Space { unbounded: config.unbounded, ..extent.space() }
}

impl<T: Scalar> Model<T> {
    /// A model with random parameters; the same seed gives the same parameters.
    ///
    /// # Errors
    /// If the configuration is out of range.
    pub fn new(config: Config, extent: SceneBox, seed: u64) -> Result<Self> {
        Model::with_cameras(config, extent, &[], seed)
    }

    /// As [`new`](Self::new), of a model that knows the cameras that its photographs were taken by, in their order: what
    /// one needs that learns [focal lengths or lenses](CameraOptimizerConfig). One that learns nothing of them forgets them.
    ///
    /// # Errors
    /// If the configuration is out of range, or there is not one camera for each photograph.
    #[inline(never)]
    pub fn with_cameras(config: Config, extent: SceneBox, cameras: &[Camera], seed: u64) -> Result<Self> {
        config.check()?;
        let space = space(&config, &extent);
        space.check()?;
        let (mut params, frames) = (Params::new(), extent.frames);
        check_range("scene_box.frames", frames, 0, MOST_FRAMES)?;
        let rng = &mut Pcg64Mcg::seed_from_u64(seed);
        let sampler =
            config.sampler.build(BuildContext { space, frames, params: &mut params, name: "sampler", rng })?;
        let field = config.field.build(BuildContext { space, frames, params: &mut params, name: "field", rng })?;
        let term =
            |term: &LossTermConfig| term.build(BuildContext { space, frames, params: &mut params, name: "terms", rng });
        let terms = config.loss_terms.iter().map(term).collect::<Result<_>>()?;
        let refine = CameraOptimizer::new(
            config.poses.is_some(),
            &config.camera_optimizer,
            (&extent, config.unbounded),
            cameras,
            &mut params,
        )?;
        let tone = ExposureModel::new(&config.exposure_model, frames, &mut params)?;
        let (look, vignetted, detail) = (None, false, 1.0);
        Ok(Model {
            config,
            scene_box: extent,
            params,
            field,
            sampler,
            terms,
            camera_optimizer: refine,
            exposure: tone,
            appearance_image: look,
            vignetted,
            detail,
        })
    }

    /// The map from the scene to the unit cube that fields and sampler are given.
    pub fn space(&self) -> Space {
        space(&self.config, &self.scene_box)
    }

    /// The box within which rays are sampled, lower and upper corner in scene units: infinite where neither the scene nor a
    /// grid ends.
    pub fn reach(&self) -> [DVec3; 2] {
        match self.sampler.grid() {
            Some(grid) => grid.outer_bounds(),
            None if self.config.unbounded => [DVec3::NEG_INFINITY, DVec3::INFINITY],
            None => self.scene_box.bounds,
        }
    }

    /// The nearest and the farthest distance from a camera at which views look, in scene units: in a scene that ends, at all of
    /// it from wherever one stands; in one that goes on, as in training, which has not judged what is nearer to cameras.
    pub fn view_near_far(&self) -> [f64; 2] {
        let [near, far] = self.scene_box.near_far;
        match self.space() {
            Space { unbounded: true, .. } => [near, far],
            bounded => [near.min(NEAREST * bounded.side()), f64::INFINITY],
        }
    }

    /// All fields: those of the sampler, if it has any, and the one that is rendered.
    pub fn fields(&self) -> Vec<&dyn Field<T>> {
        self.sampler.fields().into_iter().chain([&*self.field]).collect()
    }

    /// The camera of the photograph of this number as the model has found it to be: as it was, unless something of it is
    /// [learned](CameraOptimizer).
    ///
    /// # Panics
    /// If there is no such photograph.
    pub fn learned_camera(&self, number: usize, camera: &Camera) -> Camera {
        self.camera_optimizer
            .as_ref()
            .map_or_else(|| camera.clone(), |refine| refine.camera(&self.params, number, camera))
    }

    /// A camera that took none of the photographs and is given beside theirs, where the model would have it: see
    /// [`CameraOptimizer::other_cameras`].
    pub fn other_camera(&self, camera: &Camera) -> Camera {
        self.other_cameras(std::slice::from_ref(camera)).remove(0)
    }

    /// The same of many, which finds once how the images' cameras have moved as a whole.
    pub fn other_cameras(&self, cameras: &[Camera]) -> Vec<Camera> {
        self.camera_optimizer
            .as_ref()
            .map_or_else(|| cameras.to_vec(), |refine| refine.other_cameras(&self.params, cameras))
    }

    /// The cameras that the model was given, if it learns something of them and was told.
    pub fn cameras(&self) -> &[Camera] {
        self.camera_optimizer.as_ref().map_or(&[], CameraOptimizer::cameras)
    }

    /// The share of their detail that fields have, 0 to 1.
    pub(crate) fn detail(&self) -> f64 {
        self.detail
    }

    /// Gives all fields that share of their detail, 0 to 1: see [`Field::with_detail`]. All parameters stay.
    pub fn set_detail(&mut self, detail: f64) {
        self.detail = detail;
        if let Some(field) = self.field.with_detail(detail) {
            self.field = field;
        }
        self.sampler.set_detail(detail);
    }

    /// The sampler, if it marches through an occupancy grid.
    pub fn marching(&self) -> Option<&Marching> {
        (&*self.sampler as &dyn Any).downcast_ref()
    }

    /// What red, green and blue of views are multiplied by in a picture's middle, each above 0, and cut off at 1 after: 1, unless a
    /// [`ExposureModel`] knows how photographs differ. Then it is that of [`appearance_image`](Self::appearance_image), or of none in particular.
    ///
    /// # Panics
    /// If `appearance_image` is no photograph.
    pub fn gain(&self) -> [f64; 3] {
        self.exposure.as_ref().map_or([1.0; 3], |tone| tone.gain(&self.params, self.appearance_image, false).at(0.0))
    }

    /// The sampler, to be changed, if it marches through an occupancy grid.
    pub fn marching_mut(&mut self) -> Option<&mut Marching> {
        (&mut *self.sampler as &mut dyn Any).downcast_mut()
    }

    /// Where fields are sampled along `rays` by the sampler as it is in training, with the parameters as they are now:
    /// first what each [coarse](crate::sampling::Sampled::coarse) picture is made of, and last the steps of the field.
    pub fn samples(&self, rays: &Rays<T>, jitter: &mut Jitter<'_>) -> Vec<Samples<T>> {
        let tape = Tape::new();
        let params = self.params.bind_constant(&tape);
        let sampled = self.sampler.sample(&Query::new(&*self.field, &params), rays, Purpose::Training, jitter);
        sampled.coarse.into_iter().map(|seen| seen.samples).chain([sampled.samples]).collect()
    }

    /// The photometric loss at given samples, a differentiable function of the parameters alone: the sum over fields, rays
    /// and channels of the configured loss against `target` `[rays, 3]` over `background` `[rays, 3]`. Rays are those of no
    /// photograph in particular, and stay where they are.
    ///
    /// # Panics
    /// If there are more sets of samples than [`fields`](Self::fields).
    pub fn loss_at<'t>(
        &self,
        params: &Bound<'t, T>,
        samples: &[Samples<T>],
        target: &Tensor<T>,
        background: &Tensor<T>,
    ) -> Var<'t, T> {
        let fields = self.fields();
        assert!(samples.len() <= fields.len(), "one set of samples for each field");
        let error = |(field, samples): (&dyn Field<T>, &Samples<T>)| {
            let seen = self.sampler.quadrature().render(&Query::new(field, params), samples, 0.0);
            self.config.loss.sum(&seen.rendered.over(background), target)
        };
        let errors = fields[fields.len() - samples.len()..].iter().copied().zip(samples).map(error);
        errors.reduce(|sum, error| sum + error).unwrap_or_else(|| params.tape().constant(Tensor::scalar(T::ZERO)))
    }

    /// The same model in another precision: the same samples, occupied cells and parameters, the latter rounded if need
    /// be.
    ///
    /// # Errors
    /// If the configuration is out of range, which that of a model in use is not.
    #[inline(never)]
    pub fn cast<U: Scalar>(&self) -> Result<Model<U>> {
        let mut model = Model::with_cameras(self.config.clone(), self.scene_box, self.cameras(), 0)?;
        model.params.assign(&self.params);
        (model.appearance_image, model.vignetted) = (self.appearance_image, self.vignetted);
        model.set_detail(self.detail);
        let state = self.sampler.state().into_iter().map(|(name, bytes)| (name.to_owned(), bytes)).collect();
        model.sampler.load_state(&state)?;
        if let (Some(old), Some(new)) = (self.marching(), model.marching_mut()) {
            *new = old.clone();
        }
        Ok(model)
    }
}

impl Model<f32> {
    /// The field's density at each of these positions (scene units), in 1 / scene unit, into the slot of the same number:
    /// what an [`OccupancyGrid`](crate::space::occupancy::OccupancyGrid) asks for.
    ///
    /// # Panics
    /// If there are not as many slots as positions.
    pub fn densities(&self, points: &[[f32; 3]], out: &mut [f32]) {
        densities(&*self.field, &self.params, &Pool::new(), points, out);
    }

    /// Chooses what views leave out from now on; what training has left out stays so. A model without an occupancy grid
    /// leaves out what it has to.
    pub fn set_skip(&mut self, skip: impl Into<Skipping>) {
        if let Some(marching) = self.marching_mut() {
            // What training left out cannot be put back.
            let Skipping { grid, carving, .. } = marching.config.occupancy.skip;
            marching.config.occupancy.skip = Skipping { grid, carving, ..skip.into() };
            self.finish();
        }
    }

    /// Looks closely at everything that the sampler may look at: for rendering within the error bound of the
    /// configuration. [`Trainer::run`](crate::Trainer::run) and [`load`](Self::load) end with it.
    pub fn finish(&mut self) {
        let Model { sampler, field, params, .. } = self;
        let pool = Pool::new();
        sampler.finish(&|points, out| densities(&**field, params, &pool, points, out));
    }
}

/// A field's densities, for samplers.
pub(crate) fn densities(
    field: &dyn Field<f32>,
    params: &Params<f32>,
    pool: &Pool<f32>,
    points: &[[f32; 3]],
    out: &mut [f32],
) {
    let tape = Tape::with_pool(pool.clone());
    let params = params.bind_constant(&tape);
    let positions = tape.constant(pool.copy_of(&[points.len(), 3], points.as_flattened()));
    out.copy_from_slice(field.density(&params, &positions).sigma().value().as_slice());
}
