//! Meshes and points with normals and colours, as files hold them.

use super::mesh::Mesh;
use crate::dataset::SceneTransform;
use glam::{DMat3, DVec3};

/// A mesh whose vertices have normals and colours; without triangles, a point cloud.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ColoredMesh {
    /// Vertices and triangles.
    pub mesh: Mesh,
    /// Outward unit normal of each vertex.
    pub normals: Vec<DVec3>,
    /// sRGB colour of each vertex.
    pub colors: Vec<[u8; 3]>,
}

impl From<Mesh> for ColoredMesh {
    /// Adds the [normals](Mesh::normals) of the triangles and white colours.
    fn from(mesh: Mesh) -> Self {
        ColoredMesh { normals: mesh.normals(), colors: vec![[255; 3]; mesh.positions.len()], mesh }
    }
}

impl ColoredMesh {
    /// Rotates positions and normals.
    pub(super) fn rotate(&mut self, rotation: DMat3) {
        let vectors = self.mesh.positions.iter_mut().chain(&mut self.normals);
        vectors.for_each(|vector| *vector = rotation * *vector);
    }

    /// Maps scene coordinates to those of the capture.
    pub fn into_capture(mut self, transform: &SceneTransform) -> Self {
        self.mesh.positions.iter_mut().for_each(|place| *place = transform.point_back(*place));
        let back = transform.rotation.transpose();
        self.normals.iter_mut().for_each(|normal| *normal = back * *normal);
        self
    }
}
