//! Models: a field with its sampler, loss terms and parameters.
//!
//! Start with [`Config::preset`] and [`Model`]; a [`Trainer`](crate::Trainer) makes the model for a dataset.
//! [`CameraOptimizer`] refines poses and [`ExposureModel`] fits exposure per image.

mod adapt;
mod camera_optimizer;
pub(crate) mod config;
mod exposure;
mod preset;
mod registry;
mod scene_box;
mod store;

pub use camera_optimizer::{CameraOptimizer, CameraOptimizerConfig, PoseMotion, RefinedParam};
pub(crate) use camera_optimizer::{FOCAL, LENS, POSES};
pub use config::{Config, GroupConfig};
pub(crate) use exposure::{EXPOSURE, VIGNETTING};
pub use exposure::{ExposureConfig, ExposureModel};
pub use preset::Preset;
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

/// The most training images: a model may have parameters per image.
const MOST_FRAMES: usize = 1 << 20;
/// The near plane of renders, as a share of the scene box's side.
const NEAREST: f64 = 1e-2;

/// A field with its sampler, loss terms and parameters.
#[derive(Clone)]
pub struct Model<T: Scalar> {
    /// The configuration that it was built from.
    pub config: Config,
    /// The scene box.
    pub scene_box: SceneBox,
    /// All parameters, by name.
    pub params: Params<T>,
    /// The field that is rendered.
    pub field: Arc<dyn Field<T>>,
    /// The sampler, which places samples along rays.
    pub sampler: Box<dyn Sampler<T>>,
    /// Loss terms that are added to the photometric loss.
    pub loss_terms: Vec<Arc<dyn LossTerm<T>>>,
    /// Corrections of the training cameras, if any are learned.
    pub camera_optimizer: Option<CameraOptimizer>,
    /// The exposure model, if it is learned.
    pub exposure: Option<ExposureModel>,
    /// The index of the training image whose appearance embedding and exposure renders use; `None` uses the mean of
    /// all. Rendering panics if it is out of range.
    pub appearance_image: Option<u32>,
    /// Whether renders have the [`ExposureModel`]'s vignetting; initially `false`.
    pub vignetted: bool,
    /// The share of detail of the fields: see [`set_detail`](Self::set_detail).
    detail: f64,
}

fn space(config: &Config, extent: &SceneBox) -> Space {
    Space { unbounded: config.unbounded, ..extent.space() }
}

impl<T: Scalar> Model<T> {
    /// Creates a model with random parameters, determined by `seed`.
    ///
    /// # Errors
    /// If the configuration is out of range.
    pub fn new(config: Config, extent: SceneBox, seed: u64) -> Result<Self> {
        Model::with_cameras(config, extent, &[], seed)
    }

    /// Creates a model as [`new`](Self::new) with the cameras of its training images, in their order.
    ///
    /// Refining [focal lengths or lenses](CameraOptimizerConfig) needs them. Without refinement they are not kept.
    ///
    /// # Errors
    /// If the configuration is out of range, or there is not one camera per image.
    #[inline(never)]
    pub fn with_cameras(config: Config, extent: SceneBox, cameras: &[Camera], seed: u64) -> Result<Self> {
        config.check()?;
        extent.check()?;
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
            loss_terms: terms,
            camera_optimizer: refine,
            exposure: tone,
            appearance_image: look,
            vignetted,
            detail,
        })
    }

    /// Returns the map from the scene to the unit cube that the fields and the sampler use.
    pub fn space(&self) -> Space {
        space(&self.config, &self.scene_box)
    }

    /// Returns the box within which rays are sampled, lower and upper corner in scene units. It is infinite for an
    /// unbounded scene without an occupancy grid.
    pub fn reach(&self) -> [DVec3; 2] {
        match self.sampler.grid() {
            Some(grid) => grid.outer_bounds(),
            None if self.config.unbounded => [DVec3::NEG_INFINITY, DVec3::INFINITY],
            None => self.scene_box.bounds,
        }
    }

    /// Returns the near and far plane of renders, in scene units.
    ///
    /// For a bounded scene they enclose the whole box from any camera. For an unbounded scene they are those of
    /// training, which has not learned what is nearer to cameras.
    pub fn view_near_far(&self) -> [f64; 2] {
        let [near, far] = self.scene_box.near_far;
        match self.space() {
            Space { unbounded: true, .. } => [near, far],
            bounded => [near.min(NEAREST * bounded.side()), f64::INFINITY],
        }
    }

    /// Returns all fields: the sampler's own, such as proposals, then the one that is rendered.
    pub fn fields(&self) -> Vec<&dyn Field<T>> {
        self.sampler.fields().into_iter().chain([&*self.field]).collect()
    }

    /// Returns the camera of the training image `number`, corrected by the [`CameraOptimizer`] if there is one.
    ///
    /// # Panics
    /// If `number` is out of range.
    pub fn learned_camera(&self, number: usize, camera: &Camera) -> Camera {
        self.camera_optimizer
            .as_ref()
            .map_or_else(|| camera.clone(), |refine| refine.camera(&self.params, number, camera))
    }

    /// Returns a camera of the capture that took no training image, such as a held-out one, in the refined coordinates:
    /// see [`CameraOptimizer::other_cameras`].
    pub fn other_camera(&self, camera: &Camera) -> Camera {
        self.other_cameras(std::slice::from_ref(camera)).remove(0)
    }

    /// Returns [`other_camera`](Self::other_camera) of many, and finds the common similarity once.
    pub fn other_cameras(&self, cameras: &[Camera]) -> Vec<Camera> {
        self.camera_optimizer
            .as_ref()
            .map_or_else(|| cameras.to_vec(), |refine| refine.other_cameras(&self.params, cameras))
    }

    /// Returns the given training cameras, if the model refines cameras and knows them; otherwise an empty slice.
    pub fn cameras(&self) -> &[Camera] {
        self.camera_optimizer.as_ref().map_or(&[], CameraOptimizer::cameras)
    }

    /// The share of detail of the fields, 0 to 1.
    pub(crate) fn detail(&self) -> f64 {
        self.detail
    }

    /// Sets the share of detail of all fields, 0 to 1: see [`Field::with_detail`]. Parameters do not change.
    pub fn set_detail(&mut self, detail: f64) {
        self.detail = detail;
        if let Some(field) = self.field.with_detail(detail) {
            self.field = field;
        }
        self.sampler.set_detail(detail);
    }

    /// Returns the sampler if it marches through an occupancy grid.
    pub fn marching(&self) -> Option<&Marching> {
        (&*self.sampler as &dyn Any).downcast_ref()
    }

    /// Returns the [`ExposureModel`]'s gain of red, green and blue at the image centre, each above 0; 1 without such a
    /// model.
    ///
    /// It is that of [`appearance_image`](Self::appearance_image), or the mean of all. Renders clip colours at 1 after
    /// it.
    ///
    /// # Panics
    /// If `appearance_image` is out of range.
    pub fn gain(&self) -> [f64; 3] {
        self.exposure.as_ref().map_or([1.0; 3], |tone| tone.gain(&self.params, self.appearance_image, false).at(0.0))
    }

    /// Returns the sampler mutably if it marches through an occupancy grid.
    pub fn marching_mut(&mut self) -> Option<&mut Marching> {
        (&mut *self.sampler as &mut dyn Any).downcast_mut()
    }

    /// Places samples along `rays` as in training, with the current parameters.
    ///
    /// Returns one set for each [coarse](crate::sampling::Sampled::coarse) render, and last the samples of the field.
    pub fn samples(&self, rays: &Rays<T>, jitter: &mut Jitter<'_>) -> Vec<Samples<T>> {
        let tape = Tape::new();
        let params = self.params.bind_constant(&tape);
        let sampled = self.sampler.sample(&Query::new(&*self.field, &params), rays, Purpose::Training, jitter);
        sampled.coarse.into_iter().map(|seen| seen.samples).chain([sampled.samples]).collect()
    }

    /// Returns the photometric loss at fixed samples, differentiable with respect to the parameters.
    ///
    /// It is the sum over fields, rays and channels of the configured loss against `target` `[rays, 3]`, over
    /// `background` `[rays, 3]`. Rays use the mean appearance, and cameras are not refined.
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
        assert!(samples.len() <= fields.len(), "more sets of samples than fields");
        let error = |(field, samples): (&dyn Field<T>, &Samples<T>)| {
            let seen = self.sampler.quadrature().render(&Query::new(field, params), samples, 0.0);
            self.config.loss.sum(&seen.rendered.over(background), target)
        };
        let errors = fields[fields.len() - samples.len()..].iter().copied().zip(samples).map(error);
        errors.reduce(|sum, error| sum + error).unwrap_or_else(|| params.tape().constant(Tensor::scalar(T::ZERO)))
    }

    /// Copies the state of the sampler of a model with the same configuration.
    pub(crate) fn copy_sampler_state<U: Scalar>(&mut self, other: &Model<U>) -> Result<()> {
        let state = other.sampler.state().into_iter().map(|(name, bytes)| (name.to_owned(), bytes)).collect();
        self.sampler.load_state(&state)
    }

    /// Converts the model to another precision, with the same samples, occupied cells and (rounded) parameters.
    ///
    /// # Errors
    /// If the configuration is out of range, which cannot happen for a model in use.
    #[inline(never)]
    pub fn cast<U: Scalar>(&self) -> Result<Model<U>> {
        let mut model = Model::with_cameras(self.config.clone(), self.scene_box, self.cameras(), 0)?;
        model.params.assign(&self.params);
        (model.appearance_image, model.vignetted) = (self.appearance_image, self.vignetted);
        model.set_detail(self.detail);
        model.copy_sampler_state(self)?;
        if let (Some(old), Some(new)) = (self.marching(), model.marching_mut()) {
            *new = old.clone();
        }
        Ok(model)
    }
}

impl Model<f32> {
    /// Evaluates the field's density at each of `points` (scene units) into `out`, in 1 / scene unit.
    ///
    /// An [`OccupancyGrid`](crate::space::occupancy::OccupancyGrid) takes such a function.
    ///
    /// # Panics
    /// If `out` has another length than `points`.
    pub fn densities(&self, points: &[[f32; 3]], out: &mut [f32]) {
        densities(&*self.field, &self.params, &Pool::new(), points, out);
    }

    /// Sets how renders skip empty space and weak samples. It does not undo skipping in training, and has no effect
    /// without an occupancy grid.
    pub fn set_skip(&mut self, skip: impl Into<Skipping>) {
        if let Some(marching) = self.marching_mut() {
            // Cells that training skipped stay empty, so these settings stay.
            let Skipping { grid, carving, .. } = marching.config.occupancy.skip;
            marching.config.occupancy.skip = Skipping { grid, carving, ..skip.into() };
            self.finish();
        }
    }

    /// Updates the whole occupancy grid at full sampling, so that renders keep the configured error bound.
    ///
    /// [`Trainer::run`](crate::Trainer::run) and [`load`](Self::load) end with it.
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
