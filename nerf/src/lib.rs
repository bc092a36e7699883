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
mod catalogue;
pub mod colormap;
mod composite;
mod config;
pub mod dataset;
mod dense;
mod encoding;
mod error;
mod field;
pub mod hash_grid;
pub mod hierarchical;
mod image;
mod loss;
pub mod marching;
pub mod metrics;
mod model;
pub mod occupancy;
mod output;
pub mod pass;
pub mod quadrature;
mod rays;
mod render;
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
pub use catalogue::catalogue;
pub use composite::Composite;
pub use config::{Config, Preset, SamplerConfig};
pub use dense::DenseView;
pub use encoding::PositionalEncoding;
pub use error::{Error, Result};
pub use field::{Classic, ClassicConfig, Density, DensityActivation, Field, FieldConfig, Instant, InstantConfig};
pub use field::{Voxel, VoxelConfig};
pub use glam;
pub use loss::Loss;
pub use model::{Extent, Model, Sampler};
pub use output::{quantise, write_atomic};
pub use rays::{Rays, Samples};
pub use render::{Evaluations, Picture};
pub use spherical::SphericalHarmonics;
pub use train::{Budget, StepStats, Trainer};
pub use view::Limits;
