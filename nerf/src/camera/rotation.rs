//! Rotations from rotation vectors, with gradients at every angle.

use crate::camera::angles::sinc_and_cos_of_root;
use glam::{DMat3, DVec3};
use raygrad_autograd::{Real, Scalar, Shape, Var, record};
#[cfg(any(test, feature = "check"))]
use raygrad_autograd::{Tensor, check::Entry};

/// The row-major matrix of the rotation by `|w|` radians about `w` (Rodrigues).
///
/// It is `1 + a K + b K^2` with the matrix K of `w x`, `a = sin|w| / |w|` and `b = (1 - cos|w|) / |w|^2`. Both come
/// from half the angle, as for a quaternion. `b` as `2 sin^2(|w|/2) / |w|^2` is accurate, and the matrix stays a
/// rotation up to half a turn.
#[inline(always)]
pub(crate) fn exp<E: Real>([x, y, z]: [E; 3]) -> [E; 9] {
    let [xx, yy, zz] = [x * x, y * y, z * z];
    let s = xx + yy + zz;
    let [half, cos] = sinc_and_cos_of_root(s.like(0.25) * s);
    // The quaternion's length is 1 up to rounding; dividing by it keeps the matrix a rotation.
    let length = cos * cos + s.like(0.25) * s * half * half;
    let b = s.like(0.5) * half * half / length;
    let a = half * cos / length;
    let one = s.like(1.0);
    let across = |p: E, q: E| b * (p * q);
    let [ax, ay, az] = [a * x, a * y, a * z];
    let diagonal = |p: E, q: E| one - b * (p + q);
    [
        diagonal(yy, zz),
        across(x, y) - az,
        across(x, z) + ay,
        across(x, y) + az,
        diagonal(xx, zz),
        across(y, z) - ax,
        across(x, z) - ay,
        across(y, z) + ax,
        diagonal(xx, yy),
    ]
}

/// Returns the rotation matrix of a rotation vector, whose length is the angle in radians; equals [`rotation_exp`] bit
/// for bit.
pub fn rotation_matrix(vector: DVec3) -> DMat3 {
    DMat3::from_cols_array(&exp(vector.to_array())).transpose()
}

/// Computes rotation matrices `[.., 3, 3]` from rotation vectors `[.., 3]`, whose lengths are angles in radians.
///
/// It is Rodrigues' formula. The gradient is finite at every angle, 0 and pi included.
///
/// ```
/// use raygrad_autograd::{Tape, Tensor};
/// use raygrad_nerf::rotation_exp;
/// let tape = Tape::<f64>::new();
/// let vector = tape.leaf(Tensor::from_vec(&[2, 3], vec![0.0, 0.0, 0.0, 1e-8, 0.3, -2.0]));
/// let matrices = rotation_exp(&vector);
/// assert_eq!(matrices.shape(), [2, 3, 3]);
/// assert_eq!(matrices.value().as_slice()[..9], [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
/// ```
///
/// # Panics
/// If the last axis is not 3.
#[track_caller]
pub fn rotation_exp<'t, T: Scalar>(vectors: &Var<'t, T>) -> Var<'t, T> {
    assert_eq!(vectors.shape().last(), Some(&3), "the last axis of rotation vectors must be 3");
    let [x, y, z] = [0, 1, 2].map(|i| vectors.slice_axis(-1, i..i + 1));
    let parts = record([&x, &y, &z], |vector| exp(vector));
    let shape: Shape = vectors.shape().iter().copied().chain([3]).collect();
    Var::concat(&parts.iter().collect::<Vec<_>>(), -1).reshape(&shape)
}

/// The catalogue entries of this file.
#[cfg(any(test, feature = "check"))]
pub(crate) fn entries() -> Vec<Entry> {
    let angles = |scale: f64| Tensor::from_fn(&[6, 3], |i| scale * (((i * 7) % 13) as f64 / 6.0 - 1.0));
    vec![
        Entry::function("rotation_exp", |x| rotation_exp(&x[0]), |x| rotation_exp(&x[0]))
            .sample_of(vec![angles(1e-3)])
            .sample_of(vec![angles(0.5)])
            .sample_of(vec![angles(1.5)])
            .sample(&[&[0, 3]]),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exp_is_the_rotation_about_an_axis() {
        let turned = DMat3::from_axis_angle(DVec3::Y, 0.25);
        assert!(rotation_matrix(DVec3::new(0.0, 0.25, 0.0)).abs_diff_eq(turned, 1e-15));
    }
}
