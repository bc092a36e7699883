//! The formulas of lenses, generic over the number type, so that the same code gives values and derivatives.
//!
//! A distortion maps places of the image plane to places. [`rational`] begins at `(x / z, y / z)`. [`thin_prism`]
//! begins at the direction's angle to the axis, as a length towards `(x, y)`.

use crate::camera::angles::{angle_over, sinc_and_cos_of_root};
use raygrad_autograd::Real;

/// `1 + k[0] s + k[1] s^2 + ..`
#[inline(always)]
fn series<E: Real, const N: usize>(k: [E; N], s: E) -> E {
    let sum = (0..N - 1).rev().fold(k[N - 1], |sum, i| sum * s + k[i]);
    s.like(1.0) + s * sum
}

/// The radial factor of [`rational`] at the square `s` of the distance from the axis.
#[inline(always)]
pub(crate) fn rational_factor<E: Real>([k1, k2, k3, k4, k5, k6, ..]: [E; 8], s: E) -> E {
    series([k1, k2, k3], s) / series([k4, k5, k6], s)
}

/// The radial factor of [`thin_prism`] at the square `s` of the angle.
#[inline(always)]
pub(crate) fn fisheye_factor<E: Real>([k1, k2, k3, k4, ..]: [E; 8], s: E) -> E {
    series([k1, k2, k3, k4], s)
}

/// A point times the radial factor, plus the tangential terms.
#[inline(always)]
fn decentred<E: Real>(factor: E, [p1, p2]: [E; 2], [x, y]: [E; 2]) -> [E; 2] {
    let two = x.like(2.0);
    let (xx, yy, xy) = (x * x, y * y, two * x * y);
    let s = xx + yy;
    [x * factor + p1 * xy + p2 * (s + two * xx), y * factor + p1 * (s + two * yy) + p2 * xy]
}

/// OpenCV's distortion of points, with the coefficients `k1 .. k6, p1, p2`.
#[inline(always)]
pub(crate) fn rational<E: Real>(c: [E; 8], [x, y]: [E; 2]) -> [E; 2] {
    decentred(rational_factor(c, x * x + y * y), [c[6], c[7]], [x, y])
}

/// COLMAP's distortion of points for THIN_PRISM_FISHEYE, with the coefficients `k1 .. k4, p1, p2, sx1, sy1`. With zeros
/// for the last four it is the other fisheyes of OpenCV and COLMAP.
#[inline(always)]
pub(crate) fn thin_prism<E: Real>(c: [E; 8], [x, y]: [E; 2]) -> [E; 2] {
    let s = x * x + y * y;
    let [u, v] = decentred(fisheye_factor(c, s), [c[4], c[5]], [x, y]);
    [u + c[6] * s, v + c[7] * s]
}

/// The point, on the plane at distance 1, of a direction in front of the camera.
#[inline(always)]
pub(crate) fn perspective<E: Real>([x, y, z]: [E; 3]) -> [E; 2] {
    [x / z, y / z]
}

/// The point at the angle between a direction and the axis from the origin, towards `(x, y)`.
#[inline(always)]
pub(crate) fn equidistant<E: Real>([x, y, z]: [E; 3]) -> [E; 2] {
    let factor = angle_over(x * x + y * y, z);
    [x * factor, y * factor]
}

/// `2 tan(omega / 2) / omega`, smooth through 0.
#[inline(always)]
pub(crate) fn twice_tangent_of_half_over<E: Real>(omega: E) -> E {
    let [sinc, cos] = sinc_and_cos_of_root(omega.like(0.25) * omega * omega);
    sinc / cos
}

/// The point at `atan(2 r tan(omega / 2)) / omega` from the axis, for a direction at `r` on the plane at distance 1.
#[inline(always)]
pub(crate) fn field_of_view<E: Real>(omega: E, [x, y, z]: [E; 3]) -> [E; 2] {
    let stretch = twice_tangent_of_half_over(omega);
    let twice_tangent = omega * stretch;
    let factor = stretch * angle_over(twice_tangent * twice_tangent * (x * x + y * y), z);
    [x * factor, y * factor]
}

/// Longitude and latitude.
#[inline(always)]
pub(crate) fn longitude_and_latitude<E: Real>([x, y, z]: [E; 3]) -> [E; 2] {
    [x.atan2(z), y.atan2((x * x + z * z).sqrt())]
}
