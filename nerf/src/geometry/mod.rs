//! Meshes and point clouds from models.
//!
//! Start with [`Model::surface`](crate::Model::surface) or [`Model::point_cloud`](crate::Model::point_cloud); [`files`]
//! writes their [`ColoredMesh`]. [`isosurface`] meshes any function of positions:
//!
//! ```
//! use glam::DVec3;
//! use raygrad_nerf::geometry::{Lattice, isosurface};
//!
//! // A ball of radius 0.5.
//! let ball = |points: &[[f32; 3]], out: &mut [f32]| {
//!     for (point, out) in points.iter().zip(out) {
//!         *out = 1.0 - point.iter().map(|x| x * x).sum::<f32>().sqrt();
//!     }
//! };
//! let lattice = Lattice::over([DVec3::NEG_ONE, DVec3::ONE], 40, true)?;
//! let mesh = isosurface(&lattice, 0.5, &ball, &mut |_| ())?;
//! assert!(mesh.is_closed());
//! assert!((mesh.volume() / (4.0 / 3.0 * std::f64::consts::PI * 0.125) - 1.0).abs() < 0.01);
//! # Ok::<(), raygrad_nerf::Error>(())
//! ```

mod colored_mesh;
mod decimate;
pub mod files;
mod isosurface;
mod marching_cubes_table;
mod mesh;
mod oriented_box;
mod points;
mod probe;
mod sight;
mod surface;
mod unseen;

pub use colored_mesh::ColoredMesh;
pub use isosurface::{Lattice, isosurface};
pub use mesh::Mesh;
pub use oriented_box::OrientedBox;
pub use points::PointCloud;
pub use surface::{Stage, Surface, SurfaceConfig};
