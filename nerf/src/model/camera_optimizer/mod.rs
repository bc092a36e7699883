//! Cameras that are learned with the scene.

mod balance;
mod newton;
mod settings;

pub use settings::{CameraOptimizerConfig, RefinedParam};
pub(crate) use settings::{FOCAL, LENS, POSES};

use crate::camera::bounds::clip_near_far;
use crate::camera::lens::Lens;
use crate::camera::pinhole::{Camera, Ray};
use crate::camera::rays::Rays;
use crate::camera::{rotation_exp, rotation_matrix};
use crate::dataset::SceneTransform;
use crate::model::scene_box::SceneBox;
use crate::volume::query::RayVars;
use crate::{Error, Result};
use balance::{Matrix, POSE, balance, plain};
use glam::{DAffine3, DVec3};
use newton::{CORRECTIONS, with_corrections};
use raygrad_autograd::{Scalar, Tensor, Var};
use raygrad_nn::{Bound, ParamId, Params};
use std::sync::Arc;

/// By how much, as a part, focal lengths and principal points may differ that are the same.
const SAME: f64 = 1e-9;

/// Corrections of the cameras of photographs, as parameters; 0 everywhere leaves them as they were given.
///
/// - `poses` `[photographs, 6]`: for each six numbers from which follow, by a matrix of its own, a rotation vector (radians,
///   in the axes of the scene) that it is turned by about its own centre, and a translation. 1 of any of them moves what the
///   photograph shows of the scene's box by about a radian, and no two of them alike (Park et al. 2023, "CamP"), but
///   where the cameras as they were given are not known: there they are the rotation vector, and the translation in units of
///   the [extent](crate::SceneBox::unit). The gradient comes through the [rays](RayVars) of the samples (Lin et al. 2021,
///   "BARF", equation 5), as far as these move to other lines.
/// - `focal` `[cameras, 2]`: the logarithm of a factor of the focal length, along columns and along rows. Photographs of
///   equal focal length, principal point and lens (at the same size) share a camera. If poses are learned too, it steps
///   back from the scene's middle by the same factor: the scene stays as large as it was, and only the perspective changes.
/// - `lens` `[cameras, 4]`: what is added to the lens's coefficients `k1, k2, p1, p2` (of a fisheye `k1, k2`; of a field of
///   view that alone); a pinhole becomes a [`Lens::Brown`].
///
/// What photographs show to be empty is not carved away while their cameras are not known.
///
/// A scene and its cameras can turn, move and grow together without any photograph changing: only what cameras are to one
/// another is found. [`placement`](Self::transform) says how they have moved as a whole.
#[derive(Debug, Clone)]
pub struct CameraOptimizer {
    poses: Option<ParamId>,
    focal: Option<ParamId>,
    lens: Option<ParamId>,
    extent: SceneBox,
    /// For each photograph what its six numbers mean.
    balance: Arc<[Matrix]>,
    /// The photographs' cameras as they were given; none, if only poses are learned and nobody said.
    cameras: Arc<[Camera]>,
    /// For each photograph which camera of those that differ took it.
    groups: Arc<[u32]>,
}

/// Whether two cameras differ at most in their poses and in the size of their pictures.
fn is_same(a: &Camera, b: &Camera) -> bool {
    let shape = |camera: &Camera| {
        let [width, height] = [camera.width as f64, camera.height as f64];
        let ([fx, fy], [cx, cy]) = (camera.focal, camera.centre);
        [fx / width, fy / height, cx / width, cy / height]
    };
    let near = |(a, b): (f64, f64)| (a - b).abs() <= SAME * a.abs().max(b.abs());
    a.lens == b.lens && shape(a).into_iter().zip(shape(b)).all(near)
}

/// The number of its camera for each photograph, and how many there are.
fn grouped(cameras: &[Camera]) -> (Vec<u32>, usize) {
    let mut kinds: Vec<&Camera> = vec![];
    let number = |camera| {
        let known = kinds.iter().position(|kind| is_same(kind, camera));
        known.unwrap_or_else(|| {
            kinds.push(camera);
            kinds.len() - 1
        }) as u32
    };
    (cameras.iter().map(number).collect(), kinds.len())
}

/// The same origins, with the gradient of what moves them across their rays alone.
///
/// A ray that begins further back is the same line, and shows the same; but samples stay at their distances, and slide along
/// it. What that does to their densities is the quadrature's error, which the next step's samples do not have. It says that
/// cameras should come nearer wherever the scene is too thin, and they would.
fn across<'t, T: Scalar>(origins: &Var<'t, T>, directions: &Var<'t, T>) -> Var<'t, T> {
    let (start, along) = (origins.detach(), directions.detach());
    let moved = origins - &start;
    let slid = (&moved * &along).sum_over(-1).unsqueeze(1);
    start + (moved - slid * along)
}

/// The camera with a lens that can be corrected.
fn with_glass(camera: &Camera) -> Camera {
    let lens = match camera.lens {
        Lens::Pinhole => Lens::Brown { k: [0.0; 6], p: [0.0; 2] },
        lens => lens,
    };
    Camera { lens, ..camera.clone() }
}

impl CameraOptimizer {
    /// Corrections of the photographs of a scene that correct nothing so far; `cameras` are theirs, or none, and with the
    /// scene's extent stands whether it goes on beyond its box. `None` if nothing is to be learned.
    ///
    /// # Errors
    /// If there is no photograph, there is not one camera for each, or focal lengths or lenses are to be learned and there
    /// are no cameras, or none that has any.
    pub fn new<T: Scalar>(
        poses: bool,
        config: &CameraOptimizerConfig,
        (extent, unbounded): (&SceneBox, bool),
        cameras: &[Camera],
        params: &mut Params<T>,
    ) -> Result<Option<Self>> {
        let [focal, lens] = [config.focal.is_some(), config.lens.is_some()];
        let wanted = [(poses, POSES), (focal, "camera_optimizer.focal"), (lens, "camera_optimizer.lens")];
        let Some((_, name)) = wanted.into_iter().find(|(wanted, _)| *wanted) else { return Ok(None) };
        let frames = extent.frames;
        if frames == 0 {
            return Err(Error::setting(name, "are those of photographs, and it is not known how many there are"));
        }
        if cameras.len() != frames && (focal || lens || !cameras.is_empty()) {
            let what = format!("corrects the cameras of {frames} photographs, and {} are known", cameras.len());
            return Err(Error::setting(if focal || lens { wanted[usize::from(!focal) + 1].1 } else { name }, what));
        }
        let panoramas = cameras.iter().all(|camera| camera.lens == Lens::Equirectangular);
        if panoramas && (focal || lens) {
            let what = "equirectangular images have no focal length and no lens that could be wrong";
            return Err(Error::setting(wanted[usize::from(!focal) + 1].1, what));
        }
        let cameras: Arc<[Camera]> =
            cameras.iter().map(|camera| if lens { with_glass(camera) } else { camera.clone() }).collect();
        let (groups, count) = grouped(&cameras);
        let poses = poses.then(|| params.add(POSES, Tensor::zeros(&[frames, 6])));
        let focal = focal.then(|| params.add(FOCAL, Tensor::zeros(&[count, 2])));
        let lens = lens.then(|| params.add(LENS, Tensor::zeros(&[count, CORRECTIONS])));
        // A step sees few photographs of many.
        params.set_lazy(|name| name == POSES, true);
        let SceneBox { bounds, near_far: span, unit, .. } = *extent;
        let balance = match cameras.is_empty() {
            true => vec![plain(unit); frames].into(),
            false => cameras.iter().map(|camera| balance(camera, bounds, span, unit, unbounded)).collect(),
        };
        Ok(Some(CameraOptimizer { poses, focal, lens, extent: *extent, balance, cameras, groups: groups.into() }))
    }

    /// The photographs' cameras as they were given; none, if they are not known.
    pub fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    /// Whether poses are learned.
    pub fn has_poses(&self) -> bool {
        self.poses.is_some()
    }

    /// The rays through the centres of `pixels` (column, row) of photographs `frames`, each of `[rays]`, as variables,
    /// corrected, and the same rays as numbers with the part of `span` that lies in the box `bounds`. `rays` are those of
    /// the cameras as they were given.
    ///
    /// # Panics
    /// If there is not one number and one pixel for each ray, or no photograph of a number.
    #[track_caller]
    pub fn rays<'t, T: Scalar>(
        &self,
        params: &Bound<'t, T>,
        rays: &Rays<T>,
        (frames, pixels): (&[u32], &[[u32; 2]]),
        bounds: [DVec3; 2],
        span: [f64; 2],
    ) -> (RayVars<'t, T>, Rays<T>) {
        assert_eq!([frames.len(), pixels.len()], [rays.len(); 2], "one photograph and one pixel for each ray");
        let (tape, count) = (params.tape(), rays.len());
        let rows = |values: &[[T; 3]]| tape.constant(Tensor::from_vec(&[count, 3], values.as_flattened().to_vec()));
        let groups = || frames.iter().map(|&frame| self.groups[frame as usize]).collect::<Vec<u32>>();
        let mut directions = match (self.focal, self.lens) {
            (None, None) => rows(&rays.directions),
            (focal, lens) => {
                let [focal, lens] = [focal, lens].map(|id| id.map(|id| &params[id]));
                let value = |var: Option<&Var<'t, T>>| var.map(|var| var.value().clone());
                let (grown, added) = (value(focal), value(lens));
                // As many cameras as photographs, however many rays.
                let now: Vec<Camera> = (0..self.cameras.len())
                    .map(|i| self.glass(grown.as_ref(), added.as_ref(), Some(self.groups[i]), &self.cameras[i]))
                    .collect();
                let pixels: Vec<_> = frames
                    .iter()
                    .zip(pixels)
                    .map(|(&i, pixel)| (&self.cameras[i as usize], &now[i as usize], pixel.map(|x| f64::from(x) + 0.5)))
                    .collect();
                let [focal, lens] = [focal, lens].map(|var| var.map(|var| var.gather_rows(groups())));
                newton::directions(tape, &pixels, focal.as_ref(), lens.as_ref())
            }
        };
        let mut origins = rows(&rays.origins);
        if let Some(poses) = self.poses {
            let turned = |matrices: &Var<'t, T>, rows: &Var<'t, T>| (matrices * rows.unsqueeze(1)).sum_over(-1);
            let entry = |i: usize| {
                let (ray, at) = (i / (POSE * POSE), i % (POSE * POSE));
                T::from_f64(self.balance[frames[ray] as usize].as_flattened()[at])
            };
            let balance = tape.constant(Tensor::from_fn(&[count, POSE, POSE], entry));
            let corrections = turned(&balance, &params[poses].gather_rows(frames));
            directions = turned(&rotation_exp(&corrections.slice_axis(1, ..3)), &directions);
            let middle = tape.constant(Tensor::from_vec(&[3], self.middle().to_array().map(T::from_f64).to_vec()));
            let mut arms = origins - &middle;
            if let Some(focal) = self.focal {
                arms *= params[focal].mean_over(1).exp().unsqueeze(1).gather_rows(groups());
            }
            origins = arms + middle + corrections.slice_axis(1, 3..);
        }
        let origins = across(&origins, &directions);
        let mut moved = Rays::new();
        let lines = origins.value().as_slice().chunks_exact(3).zip(directions.value().as_slice().chunks_exact(3));
        for (origin, direction) in lines {
            let [origin, direction] =
                [origin, direction].map(|x| DVec3::new(x[0].to_f64(), x[1].to_f64(), x[2].to_f64()));
            let ray = Ray { origin, direction };
            moved.push(&ray, clip_near_far(&ray, bounds, span));
        }
        (RayVars { origins, directions }, moved)
    }

    /// The middle of the scene.
    fn middle(&self) -> DVec3 {
        0.5 * (self.extent.bounds[0] + self.extent.bounds[1])
    }

    /// The camera with the focal length and the lens of that group, corrected by these parameters.
    fn glass<T: Scalar>(
        &self,
        focal: Option<&Tensor<T>>,
        lens: Option<&Tensor<T>>,
        group: Option<u32>,
        camera: &Camera,
    ) -> Camera {
        let Some(group) = group.map(|group| group as usize) else { return camera.clone() };
        let mut found = if lens.is_some() { with_glass(camera) } else { camera.clone() };
        if let Some(focal) = focal {
            (0..2).for_each(|k| found.focal[k] *= focal.as_slice()[2 * group + k].to_f64().exp());
        }
        if let Some(lens) = lens {
            let added = std::array::from_fn(|k| lens.as_slice()[CORRECTIONS * group + k].to_f64());
            found.lens = with_corrections(&found.lens, added);
        }
        found
    }

    /// The camera of a photograph, corrected; that of its picture at another size, too.
    ///
    /// # Panics
    /// If there is no photograph of this number.
    pub fn camera<T: Scalar>(&self, params: &Params<T>, number: usize, camera: &Camera) -> Camera {
        let [focal, lens] = [self.focal, self.lens].map(|id| id.map(|id| params.get(id)));
        let camera = self.glass(focal, lens, self.groups.get(number).copied(), camera);
        let Some(poses) = self.poses else { return camera };
        let row = &params.get(poses).as_slice()[POSE * number..POSE * (number + 1)];
        let [x, y, z, a, b, c] =
            self.balance[number].map(|numbers| numbers.iter().zip(row).map(|(a, b)| a * b.to_f64()).sum::<f64>());
        let turn = rotation_matrix(DVec3::new(x, y, z));
        let grown = self.groups.get(number).map_or(1.0, |group| self.growth(params, Some(*group)));
        let pose = DAffine3 {
            matrix3: turn * camera.pose.matrix3,
            translation: self.stepped(&camera, grown).pose.translation + DVec3::new(a, b, c),
        };
        Camera { pose, ..camera }
    }

    /// By how much a camera steps back from the scene's middle, with the focal length of its group, or, if that is not
    /// known, with all on average; 1 if poses or focal lengths are not learned.
    fn growth<T: Scalar>(&self, params: &Params<T>, group: Option<u32>) -> f64 {
        let (Some(focal), Some(_)) = (self.focal, self.poses) else { return 1.0 };
        let all = params.get(focal).as_slice();
        let own = group.map_or(all, |group| &all[2 * group as usize..2 * group as usize + 2]);
        (own.iter().map(|x| x.to_f64()).sum::<f64>() / own.len() as f64).exp()
    }

    /// The camera, that many times as far from the scene's middle.
    fn stepped(&self, camera: &Camera, growth: f64) -> Camera {
        let mut stepped = camera.clone();
        stepped.pose.translation = self.middle() + growth * (camera.pose.translation - self.middle());
        stepped
    }

    /// The similarity that takes the cameras, each stepped back by its growth, nearest to where they were found; how they
    /// are held counts as much as where they stand, so that it is known of many in a line, too. `None` if poses are not
    /// learned, or cameras are not known.
    fn similarity<T: Scalar>(&self, params: &Params<T>, growths: &[f64]) -> Option<SceneTransform> {
        self.poses?;
        let count = self.cameras.len() as f64;
        let mean = self.cameras.iter().map(|camera| camera.pose.translation).sum::<DVec3>() / count;
        let spread = self.cameras.iter().map(|camera| camera.pose.translation.distance(mean)).sum::<f64>() / count;
        let arm = spread.max(0.1 * self.extent.unit);
        let places = |camera: &Camera| {
            let DAffine3 { matrix3, translation } = camera.pose;
            [DVec3::ZERO, matrix3.x_axis, matrix3.y_axis, matrix3.z_axis].map(|axis| translation + arm * axis)
        };
        let given =
            self.cameras.iter().zip(growths).flat_map(|(camera, growth)| places(&self.stepped(camera, *growth)));
        let found = self.cameras.iter().enumerate().flat_map(|(i, camera)| places(&self.camera(params, i, camera)));
        SceneTransform::between(&given.collect::<Vec<_>>(), &found.collect::<Vec<_>>())
    }

    /// How the cameras have moved as a whole: the similarity that takes them as they were given nearest to how they were
    /// found. `None` if poses are not learned, or cameras are not known.
    pub fn transform<T: Scalar>(&self, params: &Params<T>) -> Option<SceneTransform> {
        let growth = self.growth(params, None);
        let rest = self.similarity(params, &vec![growth; self.cameras.len()])?;
        // The step from the middle, and then the rest.
        let origin = self.middle() - (self.middle() - rest.origin) / growth;
        Some(SceneTransform { scale: rest.scale * growth, origin, ..rest })
    }

    /// Cameras that took none of the photographs, given beside theirs: moved as they have as a whole and, if one of them is
    /// the same but for its pose, with what was found of its focal length and lens.
    pub fn other_cameras<T: Scalar>(&self, params: &Params<T>, cameras: &[Camera]) -> Vec<Camera> {
        let growths: Vec<f64> = self.groups.iter().map(|group| self.growth(params, Some(*group))).collect();
        let similarity = self.similarity(params, &growths);
        let [focal, lens] = [self.focal, self.lens].map(|id| id.map(|id| params.get(id)));
        let other = |camera: &Camera| {
            let glass = if lens.is_some() { with_glass(camera) } else { camera.clone() };
            let same = self.cameras.iter().position(|other| is_same(other, &glass)).map(|i| self.groups[i]);
            let camera = self.glass(focal, lens, same, camera);
            match &similarity {
                Some(similarity) => similarity.camera(&self.stepped(&camera, self.growth(params, same))),
                None => camera,
            }
        };
        cameras.iter().map(other).collect()
    }
}

#[cfg(test)]
mod tests;
