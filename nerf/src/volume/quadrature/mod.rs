//! How the integral along a ray is approximated.
//!
//! The integral is that of [`analytic`](crate::analytic). A [`Quadrature`] says where in each interval of a ray the field
//! is asked, and how the answers are summed up. With n intervals of length h, density and colour smooth, the error falls
//! as h, or as h^2, or as h^4 ([`Quadrature::order`]); where the density jumps, it falls as h for all of them but
//! [`Quadrature::Adaptive`]. In 128 evaluations of the scenes of [`analytic::scenes`](crate::analytic::scenes), colour:
//!
//! | | exponential | gaussian | narrow gaussian | slabs |
//! |---|---|---|---|---|
//! | left | 5.1e-3 | 4.8e-5 | 1.0e-2 | 2.0e-3 |
//! | midpoint | 8.9e-5 | 4.8e-5 | 1.2e-2 | 9.0e-3 |
//! | piecewise-linear | 5.8e-5 | 4.9e-5 | 8.5e-3 | 1.5e-3 |
//! | gauss2 | 2.4e-8 | 1.2e-7 | 8.2e-3 | 9.0e-3 |
//!
//! (a test prints and asserts the table). In training the midpoint rule's samples lie at random places of their intervals, and
//! the intervals of the other rules are shifted at random: errors change from step to step.

mod adaptive;
mod nodes;
mod rule;
mod share;
#[cfg(test)]
mod tests;

pub use rule::Quadrature;
pub use share::gauss_share;

pub(crate) use adaptive::refine;
