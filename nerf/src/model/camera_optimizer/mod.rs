//! Pose refinement: cameras optimised together with the scene.

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
use crate::numbers::median;
use crate::volume::query::RayVars;
use crate::{Error, Result};
use balance::{Matrix, POSE, balance, plain};
use glam::{DAffine3, DVec3};
use newton::{CORRECTIONS, with_corrections};
use raygrad_autograd::{Scalar, Tensor, Var};
use raygrad_nn::{Bound, ParamId, Params};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Relative tolerance for equal focal lengths and principal points.
const SAME: f64 = 1e-9;

/// Learned corrections of the training cameras; parameters of 0 leave them unchanged.
///
/// - `poses` `[images, 6]`: preconditioned pose corrections (Park et al. 2023, "CamP"). A constant matrix per image
///   maps them to a rotation vector (radians, scene axes) about the camera's centre and a translation. A unit of each
///   moves the image of the scene box by about a radian, independently of the others. Without known cameras, they are
///   the rotation vector and the translation in units of [`SceneBox::unit`](crate::SceneBox::unit). The gradient comes
///   through the [rays](RayVars) of the samples (Lin et al. 2021, "BARF", equation 5); the part along a ray is dropped.
/// - `focal` `[cameras, 2]`: the logarithm of a factor of the focal length, along columns and rows. Images of equal
///   focal length, principal point and lens (at one size) share a camera. If poses are learned too, the camera moves
///   away from the scene's centre by the same factor: the scene keeps its size, and only the perspective changes.
/// - `lens` `[cameras, 4]`: added to the distortion coefficients `k1, k2, p1, p2` (fisheye: `k1, k2`; FOV model:
///   omega). A pinhole becomes a [`Lens::Brown`].
///
/// Visual hull carving is off while cameras are refined, unless the [check](CameraOptimizerConfig::check_at) finds that the
/// given poses are right.
///
/// Images fix only the cameras relative to each other: scene and cameras can turn, move and grow together.
/// [`transform`](Self::transform) returns that common similarity.
#[derive(Debug, Clone)]
pub struct CameraOptimizer {
    poses: Option<ParamId>,
    focal: Option<ParamId>,
    lens: Option<ParamId>,
    extent: SceneBox,
    /// The preconditioning matrix of each image.
    balance: Arc<[Matrix]>,
    /// The given cameras; empty if only poses are learned and cameras are unknown.
    cameras: Arc<[Camera]>,
    /// The index of the shared camera of each image.
    groups: Arc<[u32]>,
}

/// Returns true if two cameras differ at most in their poses and image sizes.
fn is_same(a: &Camera, b: &Camera) -> bool {
    let shape = |camera: &Camera| {
        let [width, height] = [camera.width as f64, camera.height as f64];
        let ([fx, fy], [cx, cy]) = (camera.focal, camera.centre);
        [fx / width, fy / height, cx / width, cy / height]
    };
    let near = |(a, b): (f64, f64)| (a - b).abs() <= SAME * a.abs().max(b.abs());
    a.lens == b.lens && shape(a).into_iter().zip(shape(b)).all(near)
}

/// The index of the shared camera of each image, and the number of cameras.
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

/// Removes the gradient of the origins along their rays.
///
/// A ray that begins farther back is the same line and shows the same. Its samples keep their distances, so they move
/// along it, which changes the quadrature's error. That gradient would pull cameras towards thin parts of the scene.
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

/// How far pose refinement has moved the images, in degrees. The motion of an image is the root mean square over its
/// points.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PoseMotion {
    /// The median of all images.
    pub median: f64,
    /// The largest of all images.
    pub largest: f64,
}

impl CameraOptimizer {
    /// Creates corrections of 0; returns `None` if nothing is learned.
    ///
    /// `cameras` are those of the images, or empty if only poses are learned; the `bool` says whether the scene is
    /// unbounded.
    ///
    /// # Errors
    /// If `extent.frames` is 0, if there is not one camera per image, or if focal lengths or lenses are learned and all
    /// cameras are equirectangular or missing.
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
            return Err(Error::setting(name, "needs the number of images; set `SceneBox::frames`"));
        }
        if cameras.len() != frames && (focal || lens || !cameras.is_empty()) {
            let what = format!("needs {frames} cameras, one per image, not {}", cameras.len());
            return Err(Error::setting(if focal || lens { wanted[usize::from(!focal) + 1].1 } else { name }, what));
        }
        let panoramas = cameras.iter().all(|camera| camera.lens == Lens::Equirectangular);
        if panoramas && (focal || lens) {
            let what = "cannot be refined: equirectangular images have no focal length and no distortion";
            return Err(Error::setting(wanted[usize::from(!focal) + 1].1, what));
        }
        let cameras: Arc<[Camera]> =
            cameras.iter().map(|camera| if lens { with_glass(camera) } else { camera.clone() }).collect();
        let (groups, count) = grouped(&cameras);
        let poses = poses.then(|| params.add(POSES, Tensor::zeros(&[frames, 6])));
        let focal = focal.then(|| params.add(FOCAL, Tensor::zeros(&[count, 2])));
        let lens = lens.then(|| params.add(LENS, Tensor::zeros(&[count, CORRECTIONS])));
        // Sparse updates, since a step uses few of the images.
        params.set_lazy(|name| name == POSES, true);
        let SceneBox { bounds, near_far: span, unit, .. } = *extent;
        let balance = match cameras.is_empty() {
            true => vec![plain(unit); frames].into(),
            false => cameras.iter().map(|camera| balance(camera, bounds, span, unit, unbounded)).collect(),
        };
        Ok(Some(CameraOptimizer { poses, focal, lens, extent: *extent, balance, cameras, groups: groups.into() }))
    }

    /// Returns the given cameras of the images; empty if they are not known.
    pub fn cameras(&self) -> &[Camera] {
        &self.cameras
    }

    /// Returns whether poses are learned.
    pub fn has_poses(&self) -> bool {
        self.poses.is_some()
    }

    /// Corrects rays through pixel centres: returns them as variables, and as numbers clipped to `span` and `bounds`.
    ///
    /// `rays` are those of the given cameras; `frames` (image indices) and `pixels` (column, row) have one entry per
    /// ray.
    ///
    /// # Panics
    /// If `frames` or `pixels` has another length than `rays`, or an index is out of range.
    #[track_caller]
    pub fn rays<'t, T: Scalar>(
        &self,
        params: &Bound<'t, T>,
        rays: &Rays<T>,
        (frames, pixels): (&[u32], &[[u32; 2]]),
        bounds: [DVec3; 2],
        span: [f64; 2],
    ) -> (RayVars<'t, T>, Rays<T>) {
        assert_eq!([frames.len(), pixels.len()], [rays.len(); 2], "`frames` and `pixels` must have one entry per ray");
        let (tape, count) = (params.tape(), rays.len());
        let rows = |values: &[[T; 3]]| tape.constant(Tensor::from_vec(&[count, 3], values.as_flattened().to_vec()));
        let groups = || frames.iter().map(|&frame| self.groups[frame as usize]).collect::<Vec<u32>>();
        let mut directions = match (self.focal, self.lens) {
            (None, None) => rows(&rays.directions),
            (focal, lens) => {
                let [focal, lens] = [focal, lens].map(|id| id.map(|id| &params[id]));
                let value = |var: Option<&Var<'t, T>>| var.map(|var| var.value().clone());
                let (grown, added) = (value(focal), value(lens));
                // One camera per image, not per ray.
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

    /// Returns how far the pose corrections move the images. `None` if poses are not learned.
    pub fn pose_motion<T: Scalar>(&self, params: &Params<T>) -> Option<PoseMotion> {
        // In preconditioned parameters, the squared length of a row is an image's mean squared motion.
        let motion = |row: &[T]| row.iter().map(|x| x.to_f64().powi(2)).sum::<f64>().sqrt().to_degrees();
        let each: Vec<f64> = params.get(self.poses?).as_slice().chunks_exact(POSE).map(motion).collect();
        // NaN is the largest, so that no check passes it.
        let largest = each.iter().copied().max_by(f64::total_cmp).unwrap_or(0.0);
        Some(PoseMotion { median: median(each), largest })
    }

    /// Restores the given poses.
    pub(crate) fn reset_poses<T: Scalar>(&self, params: &mut Params<T>) {
        if let Some(poses) = self.poses {
            let value = params.get_mut(poses);
            *value = Tensor::zeros(value.shape());
        }
    }

    /// The centre of the scene box.
    fn middle(&self) -> DVec3 {
        0.5 * (self.extent.bounds[0] + self.extent.bounds[1])
    }

    /// The camera with the refined focal length and lens of its group.
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

    /// Returns the corrected camera of the image with index `number`; `camera` may have another size.
    ///
    /// # Panics
    /// If `number` is out of range.
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

    /// The factor of a camera's distance from the scene's centre, from the focal length of its group or the mean of
    /// all; 1 unless poses and focal lengths are learned.
    fn growth<T: Scalar>(&self, params: &Params<T>, group: Option<u32>) -> f64 {
        let (Some(focal), Some(_)) = (self.focal, self.poses) else { return 1.0 };
        let all = params.get(focal).as_slice();
        let own = group.map_or(all, |group| &all[2 * group as usize..2 * group as usize + 2]);
        (own.iter().map(|x| x.to_f64()).sum::<f64>() / own.len() as f64).exp()
    }

    /// The camera at `growth` times its distance from the scene's centre.
    fn stepped(&self, camera: &Camera, growth: f64) -> Camera {
        let mut stepped = camera.clone();
        stepped.pose.translation = self.middle() + growth * (camera.pose.translation - self.middle());
        stepped
    }

    /// The similarity from the given cameras, each moved by its growth, to the refined ones, by least squares.
    /// Orientations count as much as positions, so that cameras on a line suffice. `None` if poses are not learned or
    /// cameras are not known.
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

    /// Returns the similarity that maps the given cameras closest to the refined ones, by least squares. `None` if
    /// poses are not learned or cameras are not known.
    pub fn transform<T: Scalar>(&self, params: &Params<T>) -> Option<SceneTransform> {
        let growth = self.growth(params, None);
        let rest = self.similarity(params, &vec![growth; self.cameras.len()])?;
        // First the growth from the centre, then the similarity.
        let origin = self.middle() - (self.middle() - rest.origin) / growth;
        Some(SceneTransform { scale: rest.scale * growth, origin, ..rest })
    }

    /// Maps other cameras of the capture, such as held-out ones, by [`transform`](Self::transform). A camera with the
    /// intrinsics of a training camera also gets its refined focal length and lens.
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
