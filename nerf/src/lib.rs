//! Neural radiance fields on the [`raygrad_autograd`] tape. This crate knows no command line.
//!
//! There is a room for each stage that data passes, and each knows only those before it:
//! [`camera`] → [`dataset`] → [`encoding`] → [`space`] → [`field`] → [`volume`] → [`sampling`] → [`losses`] →
//! [`model`] → [`rendering`] → [`geometry`] and [`training`]; [`doctor`], [`imaging`] and [`analytic`] stand beside them, and [`component`] is how a field, a
//! sampler or a term of the loss of one's own comes in. Each stage can be used alone.

pub mod analytic;
pub mod camera;
#[cfg(any(test, feature = "check"))]
mod catalogue;
#[doc(hidden)]
pub mod compiled;
pub mod component;
pub mod dataset;
pub mod doctor;
pub mod encoding;
mod error;
pub mod field;
pub(crate) mod files;
pub mod geometry;
pub mod imaging;
pub mod losses;
pub mod model;
pub(crate) mod numbers;
pub(crate) mod random;
pub(crate) mod range;
pub mod rendering;
pub mod sampling;
pub mod space;
pub mod training;
pub mod volume;

pub use camera::{Camera, Lens, Ndc, Ray, Rays, Samples, clip_near_far, intersect_box};
pub use camera::{lens_places, rotation_exp, rotation_matrix};
#[cfg(any(test, feature = "check"))]
pub use catalogue::catalogue;
pub use component::{AnyConfig, BuildContext, ComponentConfig, ComponentType, register};
pub use dataset::{Background, Image, SrgbDecode, SrgbEncode, srgb_decode, srgb_encode};
pub use encoding::{PositionalEncoding, SphericalHarmonics};
pub use error::{Error, Result};
pub use field::{
    Classic, ClassicConfig, Density, DensityActivation, Field, FieldConfig, Fields, Instant, InstantConfig,
};
pub use field::{ViewInputs, Voxel, VoxelConfig};
pub use files::write_atomic;
pub use glam;
pub use imaging::quantise;
pub use losses::{Loss, LossTerm, LossTermConfig, LossTerms};
pub use model::{Config, GroupConfig, Model, Preset, SceneBox};
pub use random::Jitter;
pub use rendering::{ReferenceRender, Render, RenderOptions};
pub use sampling::{BatchSize, Progress, Purpose, RayTolerance, Sampled, Sampler, SamplerConfig, Samplers};
pub use space::{Contraction, Space, contract};
pub use training::{Budget, StepStats, Trainer, fitted_cameras};
pub use volume::{Distortion, Evaluations, Query, Rendered};
