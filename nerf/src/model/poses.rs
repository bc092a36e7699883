//! Poses that are learned with the scene.

use crate::camera::bounds::clip_span;
use crate::camera::pinhole::{Camera, Ray};
use crate::camera::pose::Pose;
use crate::camera::rays::Rays;
use crate::camera::rotation_exp;
use crate::volume::query::RayVars;
use crate::{Error, Result};
use glam::{DAffine3, DVec3};
use raygrad_autograd::{Scalar, Tensor};
use raygrad_nn::{Bound, ParamId, Params};

/// The name of the parameter.
pub(crate) const POSES: &str = "poses";

/// Corrections of the poses of photographs, a parameter `poses` `[photographs, 6]`: for each a rotation vector (radians, in
/// the axes of the scene) that it is turned by about its own centre, and a translation in units of the
/// [extent](crate::Extent::unit); 0 everywhere leaves the pose as it was given. The gradient comes through the
/// [rays](RayVars) of the samples (Lin et al. 2021, "BARF", equation 5, with the two parts apart and without its
/// coarse-to-fine mask). What photographs show to be empty is not carved away while their poses are not known.
///
/// A scene and its cameras can turn and move together without any photograph changing: only what cameras are to one another
/// is found.
#[derive(Debug, Clone, Copy)]
pub struct Poses {
    id: ParamId,
    unit: f64,
}

impl Poses {
    /// Corrections of `frames` photographs that correct nothing so far.
    ///
    /// # Errors
    /// If there is no photograph.
    pub fn new<T: Scalar>(frames: usize, unit: f64, params: &mut Params<T>) -> Result<Self> {
        if frames == 0 {
            return Err(Error::setting("poses", "are those of photographs, and it is not known how many there are"));
        }
        let id = params.add(POSES, Tensor::zeros(&[frames, 6]));
        // A step sees few photographs of many.
        params.set_lazy(|name| name == POSES, true);
        Ok(Poses { id, unit })
    }

    /// The rays of photographs `frames` `[rays]` as variables, corrected, and the same rays as numbers with the part of `span`
    /// that lies in the box `bounds`.
    ///
    /// # Panics
    /// If there is not one number for each ray, or no photograph of a number.
    #[track_caller]
    pub fn rays<'t, T: Scalar>(
        &self,
        params: &Bound<'t, T>,
        rays: &Rays<T>,
        frames: &[u32],
        bounds: [DVec3; 2],
        span: [f64; 2],
    ) -> (RayVars<'t, T>, Rays<T>) {
        assert_eq!(frames.len(), rays.len(), "one photograph for each ray");
        let (tape, count) = (params.tape(), rays.len());
        let rows = |values: &[[T; 3]]| tape.constant(Tensor::from_vec(&[count, 3], values.as_flattened().to_vec()));
        let corrections = params[self.id].gather_rows(frames);
        let turns = rotation_exp(&corrections.slice_axis(1, ..3));
        let directions = (turns * rows(&rays.directions).reshape(&[count, 1, 3])).sum_over(-1);
        let origins = rows(&rays.origins) + corrections.slice_axis(1, 3..) * self.unit;
        let mut moved = Rays::new();
        let lines = origins.value().as_slice().chunks_exact(3).zip(directions.value().as_slice().chunks_exact(3));
        for (origin, direction) in lines {
            let [origin, direction] =
                [origin, direction].map(|x| DVec3::new(x[0].to_f64(), x[1].to_f64(), x[2].to_f64()));
            let ray = Ray { origin, direction };
            moved.push(&ray, clip_span(&ray, bounds, span));
        }
        (RayVars { origins, directions }, moved)
    }

    /// The camera of a photograph, corrected.
    ///
    /// # Panics
    /// If there is no photograph of this number.
    pub fn camera<T: Scalar>(&self, params: &Params<T>, number: usize, camera: &Camera) -> Camera {
        let row = &params.get(self.id).as_slice()[6 * number..6 * number + 6];
        let [x, y, z, a, b, c] = std::array::from_fn(|i| row[i].to_f64());
        let turn = DAffine3::from(Pose::from_vector([x, y, z], [0.0; 3])).matrix3;
        let pose = DAffine3 {
            matrix3: turn * camera.pose.matrix3,
            translation: camera.pose.translation + self.unit * DVec3::new(a, b, c),
        };
        Camera { pose, ..camera.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_autograd::Tape;
    use raygrad_autograd::check::{Check, check_function};

    fn camera() -> Camera {
        let pose = Camera::look_at(DVec3::new(1.0, -3.0, 2.0), DVec3::ZERO, DVec3::Z);
        Camera { centre: [3.0, 5.5], ..Camera::from_angle(9, 7, 0.8, pose) }
    }

    const BOX: [DVec3; 2] = [DVec3::splat(-1.0), DVec3::splat(1.0)];
    const SPAN: [f64; 2] = [0.5, 9.0];

    #[test]
    fn rays_are_those_of_the_camera_that_is_corrected() {
        let mut params = Params::<f64>::new();
        let poses = Poses::new(2, 1.5, &mut params).unwrap();
        let (mut rays, mut expected) = (Rays::new(), Rays::new());
        let pixels = [[0, 0], [8, 1], [4, 6]];
        params.get_mut(poses.id).as_mut_slice().copy_from_slice(&[
            0.0, 0.0, 0.0, 0.0, 0.0, 0.0, //
            0.1, -0.2, 0.3, 0.02, -0.04, 0.06,
        ]);
        for pixel in pixels {
            rays.push_pixel(&camera(), pixel, BOX, SPAN);
            expected.push_pixel(&poses.camera(&params, 1, &camera()), pixel, BOX, SPAN);
        }
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let (vars, moved) = poses.rays(&bound, &rays, &[1; 3], BOX, SPAN);
        for i in 0..3 {
            let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-14);
            assert!(
                near(&moved.origins[i], &expected.origins[i]) && near(&moved.directions[i], &expected.directions[i])
            );
            assert!((0..2).all(|k| (moved.spans[i][k] - expected.spans[i][k]).abs() < 1e-13));
            assert!(near(&vars.directions.value().as_slice()[3 * i..3 * i + 3], &moved.directions[i]));
        }
        assert!(moved.origins[0] != rays.origins[0] && (moved.origins[0][0] - rays.origins[0][0] - 0.03).abs() < 1e-14);
        // The first photograph stays where it is.
        let (_, same) = poses.rays(&bound, &rays, &[0; 3], BOX, SPAN);
        assert_eq!((same.origins, same.directions, same.spans), (rays.origins, rays.directions, rays.spans));
        assert!(Poses::new(0, 1.0, &mut Params::<f64>::new()).is_err());
    }

    #[test]
    fn corrections_have_the_gradients_that_differences_show() {
        let mut layout = Params::<f64>::new();
        let poses = Poses::new(2, 1.5, &mut layout).unwrap();
        let mut rays = Rays::new();
        [[0, 0], [8, 1]].into_iter().for_each(|pixel| rays.push_pixel(&camera(), pixel, BOX, SPAN));
        for at in [0.0, 0.3] {
            let start = Tensor::from_fn(&[2, 6], |i| at * (i as f64 - 5.0));
            let report = check_function(&Check::default(), &[start], |x| {
                let bound = layout.layout().bind(x.to_vec());
                let (vars, _) = poses.rays(&bound, &rays, &[1, 0], BOX, SPAN);
                (vars.origins.sin() * vars.directions.exp()).sum()
            });
            assert!(report.unwrap().comparisons > 20);
        }
    }
}
