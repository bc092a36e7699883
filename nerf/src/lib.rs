//! Neural radiance fields on the [`raygrad_autograd`] tape, on a CPU.
//!
//! The crate reads images with cameras, trains a model, and renders images, meshes and point clouds. Start with
//! [`dataset::load`] and [`Trainer`]:
//!
//! ```no_run
//! use raygrad_nerf::dataset::{Split, load};
//! use raygrad_nerf::imaging::metrics::psnr;
//! use raygrad_nerf::{Background, Budget, Config, Preset, Trainer};
//! use std::{ops::ControlFlow, sync::Arc, time::Duration};
//!
//! // Images and cameras of a folder, at half of their size.
//! let train = Arc::new(load("lego", Split::Train, 2)?);
//! let config = Config::preset(Preset::Instant).with_scene_type(train.scene_type);
//!
//! // Train for a minute, and print the PSNR of the training rays.
//! let mut trainer = Trainer::new(config, train)?;
//! trainer.run(Budget::Time(Duration::from_secs(60)), |trainer| {
//!     let stats = trainer.stats();
//!     if stats.step % 100 == 0 {
//!         println!("step {}: {:.2} dB", stats.step, stats.psnr);
//!     }
//!     ControlFlow::Continue(())
//! });
//! trainer.model.save("model.safetensors")?;
//!
//! // Render a held-out image and compare.
//! let test = load("lego", Split::Test, 2)?;
//! let (frame, white) = (&test.frames[0], Background::White.shown());
//! let render = trainer.model.render(&frame.camera, white);
//! println!("{}: {:.2} dB", frame.name, psnr(&render.color, &frame.image.over(white)));
//! render.color.save_png("render.png")?;
//! # Ok::<(), raygrad_nerf::Error>(())
//! ```
//!
//! # Modules
//!
//! Data flows from top to bottom; a module uses only those above it.
//!
//! | module | content |
//! |---|---|
//! | [`camera`] | cameras, lenses, camera paths, rays and samples |
//! | [`dataset`] | images, captures and their formats, scene transform, type of scene |
//! | [`encoding`] | hash grid, positional encoding, spherical harmonics |
//! | [`space`] | map to the unit cube, scene contraction, occupancy grids |
//! | [`field`] | radiance fields |
//! | [`volume`] | volume rendering: notation, weights, quadrature, early termination |
//! | [`sampling`] | samplers along rays |
//! | [`losses`] | photometric loss and loss terms |
//! | [`model`] | configuration, model, camera optimizer, exposure model |
//! | [`rendering`] | images, depth, normals |
//! | [`geometry`] | meshes, point clouds and their files |
//! | [`training`] | trainer, budget, statistics |
//!
//! | module beside these | content |
//! |---|---|
//! | [`component`] | custom fields, samplers and loss terms |
//! | [`imaging`] | PSNR, SSIM, LPIPS, colour maps, PNG and JPEG |
//! | [`doctor`] | checks of captures, with advice |
//! | [`analytic`] | scenes with exact integrals, for tests |

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
pub(crate) mod memory;
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
pub use files::{create_folder, rename_durable, write_atomic};
pub use glam;
pub use imaging::quantise;
pub use losses::{Loss, LossTerm, LossTermConfig, LossTerms};
pub use memory::available_memory;
pub use model::{Config, GroupConfig, Model, Preset, SceneBox};
pub use random::Jitter;
pub use rendering::{ReferenceRender, Render, RenderOptions};
pub use sampling::{BatchSize, Progress, Purpose, RayTolerance, Sampled, Sampler, SamplerConfig, Samplers};
pub use space::{Contraction, Space, contract};
pub use training::{Budget, StepStats, Trainer, fitted_cameras};
pub use volume::{Distortion, Evaluations, Query, Rendered};
