//! Quadrature of the volume rendering integral, which [`analytic`](crate::analytic) defines.
//!
//! A [`Quadrature`] chooses the nodes in each interval of a ray and their weights. For smooth density and colour the
//! error falls with the interval length h as h, h^2 or h^4 ([`Quadrature::order`]). Where the density jumps, it falls
//! as h, except for [`Quadrature::Adaptive`]. Colour errors with 128 evaluations of
//! [`analytic::scenes`](crate::analytic::scenes):
//!
//! | | exponential | gaussian | narrow gaussian | slabs |
//! |---|---|---|---|---|
//! | left | 5.1e-3 | 4.8e-5 | 1.0e-2 | 2.0e-3 |
//! | midpoint | 8.9e-5 | 4.8e-5 | 1.2e-2 | 9.0e-3 |
//! | piecewise-linear | 5.8e-5 | 4.9e-5 | 8.5e-3 | 1.5e-3 |
//! | gauss2 | 2.4e-8 | 1.2e-7 | 8.2e-3 | 9.0e-3 |
//!
//! A test prints and checks this table. Training jitters the midpoint rule's samples within their intervals, and shifts
//! the intervals of the other rules at random.

mod adaptive;
mod nodes;
mod rule;
mod share;
#[cfg(test)]
mod tests;

pub use rule::Quadrature;
pub use share::gauss_share;

pub(crate) use adaptive::refine;
