//! Neural radiance fields on the [`raygrad_autograd`] tape. This crate knows no command line.
//!
//! Data flows one way, with a named type at each arrow:
//! [`Dataset`](dataset::Dataset) → [`Rays`] → a [`sampler`] → [`Samples`] → a [`Field`] → [`Composite`] → pixels → loss
//! → gradients → ordered reduction → optimiser. Each stage can be used alone.

pub mod analytic;
pub mod background;
mod batch;
mod bounds;
mod camera;
#[cfg(feature = "check")]
mod catalogue;
mod color_space;
pub mod colormap;
#[doc(hidden)]
pub mod compiled;
mod composite;
mod config;
mod contraction;
pub mod dataset;
mod dense;
mod distortion;
mod encoding;
mod error;
mod field;
pub mod hash_grid;
pub mod hierarchical;
mod image;
mod lens;
mod loss;
pub mod marching;
pub mod metrics;
mod model;
mod ndc;
pub mod occupancy;
mod output;
pub mod pass;
mod pose;
pub mod quadrature;
mod rays;
mod render;
mod rotation;
pub mod sampler;
pub mod scene;
mod silhouette;
mod slot;
mod spherical;
mod startup;
mod store;
mod train;
mod view;
pub mod visible;

pub use self::image::Image;
pub use background::Background;
pub use bounds::{clip_span, intersect_box};
pub use camera::{Camera, Ray};
#[cfg(feature = "check")]
pub use catalogue::catalogue;
pub use color_space::{SrgbDecode, SrgbEncode, srgb_decode, srgb_encode};
pub use composite::Composite;
pub use config::{Config, Preset, SamplerConfig};
pub use contraction::{Contraction, contract};
pub use dense::DenseView;
pub use distortion::Distortion;
pub use encoding::PositionalEncoding;
pub use error::{Error, Result};
pub use field::{Classic, ClassicConfig, Density, DensityActivation, Field, FieldConfig, Instant, InstantConfig};
pub use field::{Voxel, VoxelConfig};
pub use glam;
pub use lens::RadialLens;
pub use loss::Loss;
pub use model::{Extent, Model, Sampler};
pub use ndc::{Ndc, NdcRay};
pub use output::{quantise, write_atomic};
pub use pose::Pose;
pub use rays::{Rays, Samples};
pub use render::{Evaluations, Picture};
pub use rotation::{rotation_exp, rotation_log};
pub use spherical::SphericalHarmonics;
pub use train::{Budget, StepStats, Trainer};
pub use view::Limits;
