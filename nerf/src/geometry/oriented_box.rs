//! Boxes along any axes.

use crate::dataset::SceneTransform;
use glam::{DMat3, DVec3};

/// A box whose axes may differ from those of the scene.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OrientedBox {
    /// Rotation from the axes of the box to those of the scene, about the origin of the scene.
    pub rotation: DMat3,
    /// Lower and upper corner along the axes of the box, in scene units.
    pub bounds: [DVec3; 2],
}

impl From<[DVec3; 2]> for OrientedBox {
    /// The box along the axes of the scene.
    fn from(bounds: [DVec3; 2]) -> Self {
        OrientedBox { rotation: DMat3::IDENTITY, bounds }
    }
}

impl OrientedBox {
    /// Creates the box along the axes of a capture, from its corners in the capture's coordinates.
    pub fn in_capture(transform: &SceneTransform, corners: [DVec3; 2]) -> Self {
        let bounds = corners.map(|corner| transform.scale * (corner - transform.origin));
        OrientedBox { rotation: transform.rotation, bounds }
    }

    /// Returns the corners in scene coordinates.
    pub fn corners(&self) -> [DVec3; 8] {
        let end = |corner: usize, axis: usize| self.bounds[corner >> axis & 1][axis];
        std::array::from_fn(|corner| self.rotation * DVec3::from([0, 1, 2].map(|axis| end(corner, axis))))
    }

    /// Maps a point or direction of the scene to the axes of the box.
    pub(super) fn local(&self, place: DVec3) -> DVec3 {
        self.rotation.transpose() * place
    }

    /// Returns whether a point, along the axes of the box, is inside, faces included.
    pub(super) fn contains_local(&self, place: DVec3) -> bool {
        place.cmpge(self.bounds[0]).all() && place.cmple(self.bounds[1]).all()
    }
}
