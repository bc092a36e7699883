//! Cameras with lenses and poses, camera paths, and the rays through pixels.
//!
//! Start with [`Camera`] and [`Camera::look_at`]; [`CameraPath`] and [`Spiral`] make videos. [`Rays`] and [`Samples`]
//! are the packed batches that fields and samplers take.

pub(crate) mod angles;
pub(crate) mod axes;
pub(crate) mod bounds;
pub(crate) mod lens;
pub(crate) mod ndc;
pub(crate) mod path;
pub(crate) mod pinhole;
pub(crate) mod rays;
pub(crate) mod rotation;
pub(crate) mod spiral;

pub use bounds::{clip_near_far, intersect_box};
pub use lens::{Lens, recorded::lens_places};
pub use ndc::Ndc;
pub use path::{CameraPath, Curve, Keyframe};
pub use pinhole::{Camera, Ray};
pub use rays::{Rays, Samples, stratified};
pub use rotation::{rotation_exp, rotation_matrix};
pub use spiral::Spiral;
