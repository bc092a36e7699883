//! Where a capture lies in its scene.

use crate::camera::pinhole::Camera;
use crate::error::{Error, Result};
use glam::{DAffine3, DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// The map from a capture's own coordinates, which its files have, to those of the scene, which models are trained in:
/// `scale * rotation * (x - origin)`. It has an inverse, so that whatever was found can be said in the capture's coordinates.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Placement {
    /// What the axes of the capture become.
    pub rotation: DMat3,
    /// The length of a unit of the capture in scene units, above 0.
    pub scale: f64,
    /// The place in the capture that becomes the scene's origin.
    pub origin: DVec3,
}

impl Default for Placement {
    /// The capture's coordinates are those of the scene.
    fn default() -> Self {
        Placement { rotation: DMat3::IDENTITY, scale: 1.0, origin: DVec3::ZERO }
    }
}

impl Placement {
    /// Whether the numbers are usable.
    ///
    /// # Errors
    /// If the rotation is none to 1e-6, the scale not above 0 or a number not finite.
    pub fn check(&self) -> Result<()> {
        let excess = self.rotation.transpose() * self.rotation - DMat3::IDENTITY;
        let rotates = excess.to_cols_array().iter().all(|x| x.abs() < 1e-6) && self.rotation.determinant() > 0.0;
        if rotates && self.scale > 0.0 && self.scale.is_finite() && self.origin.is_finite() {
            return Ok(());
        }
        Err(Error::setting("placement", "must be a rotation, a scale above 0 and an origin"))
    }

    /// A place of the capture, in the scene.
    pub fn point(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * (point - self.origin))
    }

    /// A place of the scene, in the capture: the inverse of [`point`](Self::point).
    pub fn point_back(&self, point: DVec3) -> DVec3 {
        self.rotation.transpose() * point / self.scale + self.origin
    }

    /// A camera of the capture, in the scene: the same pixels see the same things.
    pub fn camera(&self, camera: &Camera) -> Camera {
        let DAffine3 { matrix3, translation } = camera.pose;
        let pose = DAffine3 { matrix3: self.rotation * matrix3, translation: self.point(translation) };
        Camera { pose, ..camera.clone() }
    }

    /// A camera of the scene, in the capture: the inverse of [`camera`](Self::camera).
    pub fn camera_back(&self, camera: &Camera) -> Camera {
        let DAffine3 { matrix3, translation } = camera.pose;
        let pose = DAffine3 { matrix3: self.rotation.transpose() * matrix3, translation: self.point_back(translation) };
        Camera { pose, ..camera.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DQuat;

    #[test]
    fn cameras_see_the_same_in_either_coordinates() {
        let rotation = DMat3::from_quat(DQuat::from_rotation_x(0.3) * DQuat::from_rotation_z(2.0));
        let placement = Placement { rotation, scale: 0.2, origin: DVec3::new(500_000.0, -3.0, 7.0) };
        placement.check().unwrap();
        let pose = Camera::look_at(DVec3::new(500_001.0, 2.0, 3.0), placement.origin, DVec3::Z);
        let camera = Camera::from_angle(40, 30, 0.8, pose);
        let placed = placement.camera(&camera);
        let point = placement.origin + DVec3::new(0.1, -0.3, 0.2);
        let (before, after) = (camera.pixel_of(point).unwrap(), placed.pixel_of(placement.point(point)).unwrap());
        assert!((0..2).all(|i| (before[i] - after[i]).abs() < 1e-7), "{before:?} {after:?}");
        assert!(placement.point_back(placement.point(point)).distance(point) < 1e-9);
        assert!(placement.camera_back(&placed).pose.abs_diff_eq(camera.pose, 1e-9));
        assert!(
            (placed.pose.translation.length() - 0.2 * camera.pose.translation.distance(placement.origin)).abs() < 1e-9
        );
        for wrong in [
            Placement { scale: 0.0, ..placement },
            Placement { scale: f64::NAN, ..placement },
            Placement { rotation: 1.1 * rotation, ..placement },
            Placement { rotation: -rotation, ..placement },
            Placement { origin: DVec3::INFINITY, ..placement },
        ] {
            assert!(wrong.check().unwrap_err().to_string().starts_with("`placement`"));
        }
    }
}
