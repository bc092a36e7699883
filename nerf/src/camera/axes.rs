//! The point closest to the optical axes of poses.

use crate::numbers::outer;
use glam::{DAffine3, DMat3, DVec3};

/// Projects vectors onto the plane across a pose's optical axis.
pub(crate) fn across(pose: &DAffine3) -> DMat3 {
    DMat3::IDENTITY - outer(pose.matrix3.z_axis)
}

/// The normal equations of the point nearest to the optical axes of weighted poses, by least squares.
///
/// Returns the matrix `A` and the vector `b`; the point is `origin + A^-1 b`. An origin among the poses keeps precision
/// for poses far from 0.
pub(crate) fn axes<'a>(poses: impl Iterator<Item = (&'a DAffine3, f64)>, origin: DVec3) -> (DMat3, DVec3) {
    poses.fold((DMat3::ZERO, DVec3::ZERO), |(matrix, sum), (pose, weight)| {
        let across = across(pose) * weight;
        (matrix + across, sum + across * (pose.translation - origin))
    })
}
