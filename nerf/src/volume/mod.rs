//! Volume rendering: what arrives at the eye from samples along rays.

pub(crate) mod composite;
pub(crate) mod distortion;
pub(crate) mod loss;
pub mod pass;
pub mod quadrature;
pub mod visible;

pub use composite::Composite;
pub use distortion::Distortion;
pub use loss::Loss;
