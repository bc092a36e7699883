//! Rigid motions that stay rigid however many of them are composed.

use crate::camera::rotation::{exp, largest, log_from};
use glam::{DAffine3, DMat3, DVec3};
use raygrad_autograd::Scalar;

/// A rotation followed by a translation, such as a camera's pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose<T> {
    /// The rotation matrix, row by row.
    pub rotation: [T; 9],
    /// The translation.
    pub translation: [T; 3],
}

impl<T: Scalar> Pose<T> {
    /// The motion that leaves everything where it is.
    pub fn identity() -> Self {
        let rotation = std::array::from_fn(|k| if k % 4 == 0 { T::ONE } else { T::ZERO });
        Pose { rotation, translation: [T::ZERO; 3] }
    }

    /// The rotation by the length of `vector`, in radians, about its direction; then the translation.
    pub fn from_vector(vector: [T; 3], translation: [T; 3]) -> Self {
        Pose { rotation: exp(vector), translation }
    }

    /// The rotation as a vector of length 0 to pi: the inverse of [`from_vector`](Self::from_vector). At pi one of the two
    /// axes that are right.
    pub fn vector(&self) -> [T; 3] {
        log_from(&self.rotation, largest(&self.rotation))
    }

    /// `self` after `first`. The product of the rotations is made orthonormal again (one step of Newton's method for the
    /// nearest rotation, `R (3 - R'R) / 2`), so that rounding does not add up: after any number of compositions
    /// `|R'R - 1|` is a few units in the last place, where bare f32 products reach 1e-3 after 1e5.
    pub fn after(&self, first: &Self) -> Self {
        let (a, b) = (&self.rotation, &first.rotation);
        let product = product(a, b, false);
        let gram = self::product(&product, &product, true);
        let half = T::from_f64(0.5);
        let correction =
            std::array::from_fn(|k| half * (if k % 4 == 0 { T::from_f64(3.0) - gram[k] } else { -gram[k] }));
        Pose { rotation: self::product(&product, &correction, false), translation: self.apply(first.translation) }
    }

    /// The motion that undoes this one.
    pub fn inverse(&self) -> Self {
        let r = &self.rotation;
        let back = Pose { rotation: [r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]], translation: [T::ZERO; 3] };
        Pose { translation: back.apply(self.translation.map(|x| -x)), ..back }
    }

    /// Where a point goes.
    pub fn apply(&self, point: [T; 3]) -> [T; 3] {
        std::array::from_fn(|i| {
            let row = &self.rotation[3 * i..3 * i + 3];
            row[0] * point[0] + row[1] * point[1] + row[2] * point[2] + self.translation[i]
        })
    }

    /// How far the rotation is from one: the Frobenius norm of `R'R - 1`, in f64.
    pub fn skewness(&self) -> f64 {
        let r = self.rotation.map(Scalar::to_f64);
        let gram = product(&r, &r, true);
        (0..9).map(|k| (gram[k] - f64::from(u8::from(k % 4 == 0))).powi(2)).sum::<f64>().sqrt()
    }
}

impl From<Pose<f64>> for DAffine3 {
    fn from(pose: Pose<f64>) -> DAffine3 {
        let matrix3 = DMat3::from_cols_array(&pose.rotation).transpose();
        DAffine3 { matrix3, translation: DVec3::from(pose.translation) }
    }
}

/// `a b`, or `a' b`.
fn product<T: Scalar>(a: &[T; 9], b: &[T; 9], transposed: bool) -> [T; 9] {
    std::array::from_fn(|k| {
        let (i, j) = (k / 3, k % 3);
        let at = |l: usize| if transposed { a[3 * l + i] } else { a[3 * i + l] };
        at(0) * b[j] + at(1) * b[3 + j] + at(2) * b[6 + j]
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agrees_with_matrices() {
        let a = Pose::from_vector([0.3, -1.1, 0.4], [1.0, 2.0, 3.0]);
        let b = Pose::from_vector([-0.7, 0.2, 2.0], [0.5, -1.0, 0.0]);
        let both = DAffine3::from(a) * DAffine3::from(b);
        assert!(DAffine3::from(a.after(&b)).abs_diff_eq(both, 1e-14));
        assert!(DAffine3::from(a.after(&a.inverse())).abs_diff_eq(DAffine3::IDENTITY, 1e-14));
        let turned = DMat3::from_axis_angle(DVec3::Y, 0.25);
        assert!(DAffine3::from(Pose::from_vector([0.0, 0.25, 0.0], [0.0; 3])).matrix3.abs_diff_eq(turned, 1e-15));
    }
}
