//! The scene transform.

use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use crate::numbers::{eigen, mean};
use glam::{DAffine3, DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};

/// The scene transform `scale * rotation * (x - origin)`, from a capture's coordinates to those of the scene.
///
/// Models are trained in scene coordinates. nerfstudio calls it the dataparser transform.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneTransform {
    /// Rotation from the axes of the capture to those of the scene, column by column.
    pub rotation: DMat3,
    /// Length of a capture unit. Unit: scene units. Range: more than 0.
    pub scale: f64,
    /// The point of the capture that becomes the origin of the scene. Unit: capture units.
    pub origin: DVec3,
}

impl Default for SceneTransform {
    /// The identity.
    fn default() -> Self {
        SceneTransform { rotation: DMat3::IDENTITY, scale: 1.0, origin: DVec3::ZERO }
    }
}

impl SceneTransform {
    /// Finds the similarity from `from` to `to` with the least sum of squared distances (Umeyama 1991; the rotation as
    /// a quaternion, Horn 1987).
    ///
    /// Returns `None` if there are fewer than three points, their numbers differ, or all lie on a line.
    pub fn between(from: &[DVec3], to: &[DVec3]) -> Option<Self> {
        if from.len() < 3 || from.len() != to.len() {
            return None;
        }
        let [origin, middle] = [from, to].map(|points| mean(points.iter().copied()));
        let pairs = || from.iter().zip(to).map(|(a, b)| (*a - origin, *b - middle));
        // Row i, column j: the sum of products of coordinate i of `from` and j of `to`.
        let s: [[f64; 3]; 3] =
            std::array::from_fn(|i| std::array::from_fn(|j| pairs().map(|(a, b)| a[i] * b[j]).sum()));
        let [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = s;
        let ([most, second, ..], [w, x, y, z]) = eigen([
            [xx + yy + zz, yz - zy, zx - xz, xy - yx],
            [yz - zy, xx - yy - zz, xy + yx, zx + xz],
            [zx - xz, xy + yx, yy - xx - zz, yz + zy],
            [xy - yx, zx + xz, yz + zy, zz - xx - yy],
        ]);
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let size: f64 = pairs().map(|(a, _)| a.length_squared()).sum();
        let scale = pairs().map(|(a, b)| b.dot(rotation * a)).sum::<f64>() / size;
        let found = SceneTransform { rotation, scale, origin: origin - rotation.transpose() * middle / scale };
        (most - second > 1e-6 * most && found.check().is_ok()).then_some(found)
    }

    /// Checks that it is a similarity.
    ///
    /// # Errors
    /// If `rotation` is not a rotation to 1e-6, the scale is not above 0, or a number is not finite.
    pub fn check(&self) -> Result<()> {
        let excess = self.rotation.transpose() * self.rotation - DMat3::IDENTITY;
        let rotates = excess.to_cols_array().iter().all(|x| x.abs() < 1e-6) && self.rotation.determinant() > 0.0;
        if rotates && self.scale > 0.0 && self.scale.is_finite() && self.origin.is_finite() {
            return Ok(());
        }
        Err(Error::setting("scene_box.transform", "needs a rotation matrix, a scale above 0 and a finite origin"))
    }

    /// Maps a point from the capture to the scene.
    pub fn point(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * (point - self.origin))
    }

    /// Maps a point from the scene to the capture: the inverse of [`point`](Self::point).
    pub fn point_back(&self, point: DVec3) -> DVec3 {
        self.rotation.transpose() * point / self.scale + self.origin
    }

    /// Maps a camera from the capture to the scene; its pixels show the same points.
    pub fn camera(&self, camera: &Camera) -> Camera {
        let DAffine3 { matrix3, translation } = camera.pose;
        let pose = DAffine3 { matrix3: self.rotation * matrix3, translation: self.point(translation) };
        Camera { pose, ..camera.clone() }
    }

    /// Maps a camera from the scene to the capture: the inverse of [`camera`](Self::camera).
    pub fn camera_back(&self, camera: &Camera) -> Camera {
        let DAffine3 { matrix3, translation } = camera.pose;
        let pose = DAffine3 { matrix3: self.rotation.transpose() * matrix3, translation: self.point_back(translation) };
        Camera { pose, ..camera.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn similarity_is_found_from_noncollinear_points() {
        let rotation = DMat3::from_quat(DQuat::from_rotation_y(2.9) * DQuat::from_rotation_z(-1.0));
        let truth = SceneTransform { rotation, scale: 0.3, origin: DVec3::new(1.0, 2.0, -30.0) };
        // In a plane, like cameras around an object, and in space.
        for height in [0.0, 1.0] {
            let point = |i: usize| {
                let angle = i as f64;
                truth.origin + 3.0 * DVec3::new(angle.cos(), angle.sin(), height * (3.0 * angle).sin())
            };
            let from: Vec<DVec3> = (0..9).map(point).collect();
            let mut to: Vec<DVec3> = from.iter().map(|&point| truth.point(point)).collect();
            let found = SceneTransform::between(&from, &to).unwrap();
            assert!(from.iter().zip(&to).all(|(a, b)| found.point(*a).distance(*b) < 1e-12), "{found:?}");
            assert!((found.scale - 0.3).abs() < 1e-12 && found.rotation.abs_diff_eq(rotation, 1e-12));
            // For points that no similarity fits, a least-squares solution: no small change improves it.
            to.iter_mut().enumerate().for_each(|(i, point)| point.x += 0.1 * (5.0 * i as f64).cos());
            let error = |transform: &SceneTransform| -> f64 {
                from.iter().zip(&to).map(|(a, b)| transform.point(*a).distance_squared(*b)).sum()
            };
            let found = SceneTransform::between(&from, &to).unwrap();
            for sign in [-1e-4, 1e-4] {
                let turn = |axis| DMat3::from_axis_angle(axis, sign);
                let turned = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| found.rotation * turn(axis));
                let others = turned.map(|rotation| {
                    let middle = from.iter().sum::<DVec3>() / 9.0;
                    let origin = middle - rotation.transpose() * found.point(middle) / found.scale;
                    SceneTransform { rotation, origin, ..found }
                });
                assert!(others.iter().all(|other| error(other) > error(&found)), "turned");
                assert!(error(&SceneTransform { scale: found.scale * (1.0 + sign), ..found }) > error(&found), "grown");
                let origin = found.origin + DVec3::splat(sign);
                assert!(error(&SceneTransform { origin, ..found }) > error(&found), "moved");
            }
            assert!(SceneTransform::between(&from[..2], &to[..2]).is_none());
            assert!(SceneTransform::between(&from, &to[1..]).is_none());
        }
        let line: Vec<DVec3> = (0..5).map(|i| DVec3::new(1.0, 2.0, 0.5) * f64::from(i)).collect();
        assert!(SceneTransform::between(&line, &line).is_none());
    }

    #[test]
    fn transformed_cameras_see_the_same() {
        let rotation = DMat3::from_quat(DQuat::from_rotation_x(0.3) * DQuat::from_rotation_z(2.0));
        let transform = SceneTransform { rotation, scale: 0.2, origin: DVec3::new(500_000.0, -3.0, 7.0) };
        transform.check().unwrap();
        let pose = Camera::look_at(DVec3::new(500_001.0, 2.0, 3.0), transform.origin, DVec3::Z);
        let camera = Camera::from_angle(40, 30, 0.8, pose);
        let placed = transform.camera(&camera);
        let point = transform.origin + DVec3::new(0.1, -0.3, 0.2);
        let (before, after) = (camera.pixel_of(point).unwrap(), placed.pixel_of(transform.point(point)).unwrap());
        assert!((0..2).all(|i| (before[i] - after[i]).abs() < 1e-7), "{before:?} {after:?}");
        assert!(transform.point_back(transform.point(point)).distance(point) < 1e-9);
        assert!(transform.camera_back(&placed).pose.abs_diff_eq(camera.pose, 1e-9));
        assert!(
            (placed.pose.translation.length() - 0.2 * camera.pose.translation.distance(transform.origin)).abs() < 1e-9
        );
        for wrong in [
            SceneTransform { scale: 0.0, ..transform },
            SceneTransform { scale: f64::NAN, ..transform },
            SceneTransform { rotation: 1.1 * rotation, ..transform },
            SceneTransform { rotation: -rotation, ..transform },
            SceneTransform { origin: DVec3::INFINITY, ..transform },
        ] {
            assert!(wrong.check().unwrap_err().to_string().starts_with("`scene_box.transform`"));
        }
    }
}
