//! Instantiations for f32 and f64 that are compiled in this crate, so that no caller compiles them again.
//!
//! A generic function is compiled in every crate that uses it, unless it is marked `#[inline(never)]` and a crate below
//! has used it for the same types. So marked are the entries that stand for much code (of this crate and of those
//! below).

use crate::analytic::{Integral, integrate};
use crate::volume::quadrature::Quadrature;
use crate::{Model, ReferenceRender, Result, analytic};

/// The entries in f64; those in f32 are used by training and views.
#[allow(clippy::type_complexity)] // the types of the entries
#[doc(hidden)]
#[inline(never)]
pub fn in_double() -> (
    fn(&Model<f32>) -> Result<Model<f64>>,
    fn(&Model<f64>, &crate::Camera, [f64; 3], usize) -> ReferenceRender,
    fn(&analytic::AnalyticScene, Quadrature, usize) -> Integral,
) {
    (Model::cast, Model::render_reference, integrate::<f64>)
}
