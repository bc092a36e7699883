//! The point closest to the optical axes of poses.

use crate::numbers::outer;
use glam::{DAffine3, DMat3, DVec3};

/// What is left of a vector without its part along the axis that a pose looks along.
pub(crate) fn across(pose: &DAffine3) -> DMat3 {
    DMat3::IDENTITY - outer(pose.matrix3.z_axis)
}

/// The matrix `A` and the vector `b` of which `A^-1 b`, from `origin`, is the place nearest to the optical axes of
/// poses in the sense of least squares, each with its weight. An origin among the poses keeps the digits of those far
/// from 0.
pub(crate) fn axes<'a>(poses: impl Iterator<Item = (&'a DAffine3, f64)>, origin: DVec3) -> (DMat3, DVec3) {
    poses.fold((DMat3::ZERO, DVec3::ZERO), |(matrix, sum), (pose, weight)| {
        let across = across(pose) * weight;
        (matrix + across, sum + across * (pose.translation - origin))
    })
}
