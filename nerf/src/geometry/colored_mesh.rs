//! What files hold: a mesh or points, and how they look.

use super::mesh::Mesh;
use crate::dataset::SceneTransform;
use glam::DVec3;

/// A mesh whose vertices have normals and colours; without triangles, a point cloud.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ColoredMesh {
    /// Vertices and triangles.
    pub mesh: Mesh,
    /// For each vertex the unit normal, outwards.
    pub normals: Vec<DVec3>,
    /// For each vertex its colour in sRGB, as photographs store it.
    pub colors: Vec<[u8; 3]>,
}

impl From<Mesh> for ColoredMesh {
    /// The mesh with the [normals](Mesh::normals) of its triangles, white.
    fn from(mesh: Mesh) -> Self {
        ColoredMesh { normals: mesh.normals(), colors: vec![[255; 3]; mesh.positions.len()], mesh }
    }
}

impl ColoredMesh {
    /// The same in the coordinates of the capture, from those of the scene.
    pub fn placed_back(mut self, placement: &SceneTransform) -> Self {
        self.mesh.positions.iter_mut().for_each(|place| *place = placement.point_back(*place));
        let back = placement.rotation.transpose();
        self.normals.iter_mut().for_each(|normal| *normal = back * *normal);
        self
    }
}
