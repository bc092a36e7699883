//! Rotations for poses that are optimised: from and to rotation vectors, with gradients at every angle.

use crate::camera::angles::{angle_over, sinc_and_cos_of_root};
#[cfg(any(test, feature = "check"))]
use raygrad_autograd::check::Entry;
use raygrad_autograd::{Mask, Real, Scalar, Shape, Tensor, Var, record};

/// The matrix, row by row, of the rotation by `|w|` radians about `w` (Rodrigues): `1 + a K + b K^2` with the matrix K of
/// `w x`, `a = sin|w| / |w|` and `b = (1 - cos|w|) / |w|^2`. Both come from half the angle, as for a quaternion: `b` as
/// `2 sin^2(|w|/2) / |w|^2` has all its digits, and rounding leaves the matrix a rotation, also near half a turn.
#[inline(always)]
pub(crate) fn exp<E: Real>([x, y, z]: [E; 3]) -> [E; 9] {
    let [xx, yy, zz] = [x * x, y * y, z * z];
    let s = xx + yy + zz;
    let [half, cos] = sinc_and_cos_of_root(s.like(0.25) * s);
    // The quaternion's length is 1 but for rounding, which would leave the matrix no rotation.
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

/// Four times the squares of a quaternion's w, x, y, z, from the diagonal of its matrix. They add up to 4, so one is at
/// least 1.
fn squares<E: Real>(m: &[E; 9]) -> [E; 4] {
    let one = m[0].like(1.0);
    let [a, b, c] = [m[0], m[4], m[8]];
    [one + a + b + c, one + a - b - c, one - a + b - c, one - a - b + c]
}

/// The rotation vector, of length 0 to pi, of a matrix given row by row whose quaternion has its largest element at
/// `largest`. By way of that quaternion (Shepperd 1978), whose sine and cosine `atan2` takes together: nothing is lost
/// near 0 and near pi, as it is with `acos` of the trace.
pub(crate) fn log_from<E: Real>(m: &[E; 9], largest: usize) -> [E; 3] {
    let four = squares(m);
    let pivot = four[largest].sqrt();
    let inverse = m[0].like(1.0) / pivot;
    let sum = |i: usize, j: usize| (m[i] + m[j]) * inverse;
    let difference = |i: usize, j: usize| (m[i] - m[j]) * inverse;
    // Twice the quaternion; its length does not matter.
    let [w, x, y, z] = match largest {
        0 => [pivot, difference(7, 5), difference(2, 6), difference(3, 1)],
        1 => [difference(7, 5), pivot, sum(1, 3), sum(2, 6)],
        2 => [difference(2, 6), sum(1, 3), pivot, sum(5, 7)],
        _ => [difference(3, 1), sum(2, 6), sum(5, 7), pivot],
    };
    // Of the two quaternions of a rotation the one with w >= 0, so that the angle is at most pi.
    let flip = |q: E| (-w).if_positive(-q, q);
    let [w, x, y, z] = [w, x, y, z].map(flip);
    // 2 atan2(v, w) / v with v = |(x, y, z)|.
    let factor = w.like(2.0) * angle_over(x * x + y * y + z * z, w);
    [x, y, z].map(|q| factor * q)
}

/// Which element of a rotation matrix's quaternion is the largest.
pub(crate) fn largest<T: Scalar>(m: &[T; 9]) -> usize {
    let four = squares(m);
    (1..4).fold(0, |best, i| if four[i] > four[best] { i } else { best })
}

/// Rotation matrices `[.., 3, 3]` for rotation vectors `[.., 3]`: axes whose lengths are angles in radians. The gradient
/// is finite at every angle, 0 and pi included.
///
/// ```
/// use raygrad_autograd::{Mask, Tape, Tensor};
/// use raygrad_nerf::{rotation_exp, rotation_log};
/// let tape = Tape::<f64>::new();
/// let vector = tape.leaf(Tensor::from_vec(&[2, 3], vec![0.0, 0.0, 0.0, 1e-8, 0.3, -2.0]));
/// let matrices = rotation_exp(&vector);
/// assert_eq!(matrices.shape(), [2, 3, 3]);
/// let again = rotation_log(&matrices);
/// assert!(again.value().as_slice().iter().zip(vector.value().as_slice()).all(|(a, b)| (a - b).abs() < 1e-15));
/// ```
///
/// # Panics
/// If the last extent is not 3.
#[track_caller]
pub fn rotation_exp<'t, T: Scalar>(vectors: &Var<'t, T>) -> Var<'t, T> {
    assert_eq!(vectors.shape().last(), Some(&3), "rotation vectors of three elements");
    let [x, y, z] = [0, 1, 2].map(|i| vectors.slice_axis(-1, i..i + 1));
    let parts = record([&x, &y, &z], |vector| exp(vector));
    let shape: Shape = vectors.shape().iter().copied().chain([3]).collect();
    Var::concat(&parts.iter().collect::<Vec<_>>(), -1).reshape(&shape)
}

/// Rotation vectors `[.., 3]`, of length 0 to pi, for rotation matrices `[.., 3, 3]`: the inverse of [`rotation_exp`].
///
/// At an angle of pi, where both directions of the axis are right, one of them. The gradient is finite at every angle; it
/// is the one of a formula that gives the logarithm on rotations, and says nothing of matrices that are none.
///
/// # Panics
/// If the last extents are not 3 and 3.
#[track_caller]
pub fn rotation_log<'t, T: Scalar>(matrices: &Var<'t, T>) -> Var<'t, T> {
    let Some((rows, [3, 3])) = matrices.shape().split_last_chunk::<2>() else {
        panic!("rotation matrices are [.., 3, 3], not {:?}", matrices.shape());
    };
    let count: usize = rows.iter().product();
    let shape: Shape = rows.iter().copied().chain([3]).collect();
    let flat = matrices.reshape(&[count, 9]);
    let (all, _) = matrices.value().as_slice().as_chunks::<9>();
    let pivots: Vec<usize> = all.iter().map(largest).collect();
    // Each formula sees the rotations that it is good for, and in place of the others one that it is good for too.
    let mut out: Option<Var<'t, T>> = None;
    for pivot in 0..4 {
        let seen = pivots.contains(&pivot) || pivot == 0 && pivots.is_empty();
        if !seen {
            continue;
        }
        let turn = |k: usize| {
            if !k.is_multiple_of(4) {
                0.0
            } else if pivot == 0 || k == 4 * (pivot - 1) {
                1.0
            } else {
                -1.0
            }
        };
        let stand_in = Tensor::from_fn(&[1, 9], |k| T::from_f64(turn(k)));
        let mask = Mask::new(&[count, 1], pivots.iter().map(|&other| other == pivot).collect::<Vec<_>>());
        let seen = flat.where_(&mask, &stand_in);
        let elements: [_; 9] = std::array::from_fn(|k| seen.slice_axis(1, k..k + 1));
        let vector = record(elements.each_ref(), |matrix| log_from(&matrix, pivot));
        let vector = Var::concat(&vector.iter().collect::<Vec<_>>(), 1);
        out = Some(match out {
            Some(others) => vector.where_(&mask, &others),
            None => vector,
        });
    }
    out.unwrap_or_else(|| flat.slice_axis(1, ..3)).reshape(&shape)
}

/// The catalogue entries of this file.
#[cfg(any(test, feature = "check"))]
pub(crate) fn entries() -> Vec<Entry> {
    let angles = |scale: f64| Tensor::from_fn(&[6, 3], |i| scale * (((i * 7) % 13) as f64 / 6.0 - 1.0));
    let matrices = |scale: f64| {
        let (vectors, _) = (angles(scale), ());
        let (rows, _) = vectors.as_slice().as_chunks::<3>();
        Tensor::from_vec(&[rows.len(), 3, 3], rows.iter().flat_map(|&row| exp(row)).collect())
    };
    vec![
        Entry::function("rotation_exp", |x| rotation_exp(&x[0]), |x| rotation_exp(&x[0]))
            .sample_of(vec![angles(1e-3)])
            .sample_of(vec![angles(0.5)])
            .sample_of(vec![angles(1.5)])
            .sample(&[&[0, 3]]),
        Entry::function("rotation_log", |x| rotation_log(&x[0]), |x| rotation_log(&x[0]))
            .sample_of(vec![matrices(1e-3)])
            .sample_of(vec![matrices(0.5)])
            .sample_of(vec![matrices(1.5)])
            .sample(&[&[0, 3, 3]]),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_pivot_is_met() {
        let turns = [[0.1, 0.2, 0.0], [3.0, 0.1, 0.2], [0.1, 3.0, 0.2], [0.1, 0.2, -3.0_f64]];
        for (expected, vector) in turns.into_iter().enumerate() {
            let matrix = exp(vector);
            assert_eq!(largest(&matrix), expected);
            let again = log_from(&matrix, expected);
            assert!((0..3).all(|i| (again[i] - vector[i]).abs() < 1e-14), "{again:?}");
        }
    }
}
