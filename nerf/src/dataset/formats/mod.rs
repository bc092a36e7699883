//! Readers and writers of capture formats: [`blender`], [`transforms`], [`colmap`] and [`llff`].
//!
//! [`Capture::read`](super::Capture::read) recognises the format. Each module's `read` parses cameras without decoding
//! images; its `write` writes everything but the images.

pub mod blender;
pub mod colmap;
mod description;
mod encodings;
mod exports;
mod frames;
mod intrinsics;
mod json;
mod layers;
mod lens;
mod limits;
pub mod llff;
mod locate;
mod masks;
mod matrix;
mod models;
pub(super) mod npy;
mod other_names;
mod paths;
mod ply;
mod points;
pub mod rigid;
pub mod transforms;
mod unsupported;

pub use locate::is_layer;

pub(super) use description::{is_described, read, read_file};
pub(super) use locate::{DEEPEST, factor_of, fitting};

#[cfg(test)]
mod kit;

/// The number of damaged files that a test tries: `PROPTEST_CASES` if it is set, otherwise `short`.
#[cfg(test)]
fn cases(short: u32) -> proptest::prelude::ProptestConfig {
    let cases = std::env::var("PROPTEST_CASES").ok().and_then(|cases| cases.parse().ok()).unwrap_or(short);
    proptest::prelude::ProptestConfig { cases, ..Default::default() }
}
