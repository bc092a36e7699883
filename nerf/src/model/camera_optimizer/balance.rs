//! Preconditioning of pose corrections.
//!
//! A camera that turns left and one that moves left show nearly the same, so an optimizer makes slow progress along
//! that valley. Decorrelated parameters avoid it (Park et al. 2023, "CamP: Camera Preconditioning for Neural Radiance
//! Fields", section 4). Here the Cholesky factor replaces the matrix square root, and angles of directions replace
//! pixels, which serves every lens.

use crate::camera::bounds::clip_near_far;
use crate::camera::pinhole::Camera;
use glam::DVec3;

/// Numbers of a pose: a rotation vector and a translation.
pub(super) const POSE: usize = 6;

/// A row-major matrix.
pub(super) type Matrix = [[f64; POSE]; POSE];

/// Pixels along each side of an image, and points along each of their rays.
const PLACES: [usize; 2] = [6, 3];
/// The relative damping of the diagonal, which bounds how far weak directions are amplified.
const DAMPING: f64 = 0.1;
/// The least squared motion per parameter: a single ray along an axis does not show a rotation about that axis.
const LEAST: f64 = 1e-12;

/// The upper triangular matrix from six numbers to a rotation vector (radians, scene axes) about the camera's centre
/// and a translation (scene units). A unit of each moves the image of the box by about a radian, independently of the
/// others. In an unbounded scene, points infinitely far away count too.
pub(super) fn balance(camera: &Camera, bounds: [DVec3; 2], span: [f64; 2], unit: f64, unbounded: bool) -> Matrix {
    let [columns, depths] = PLACES;
    let mut sum = [[0.0; POSE]; POSE];
    let (mut count, mut inside) = (0.0, false);
    for i in 0..columns * columns {
        let place = |i: usize, size: usize| (i as f64 + 0.5) / columns as f64 * size as f64;
        let [x, y] = [place(i % columns, camera.width), place(i / columns, camera.height)];
        if !camera.sees(x, y) {
            continue;
        }
        let ray = camera.ray(x, y);
        let [from, to] = clip_near_far(&ray, bounds, span);
        let within = (0..depths).map(|k| from + (k as f64 + 0.5) / depths as f64 * (to - from));
        let within = within.filter(|t| to > from && t.is_finite());
        for t in within.chain(unbounded.then_some(f64::INFINITY)) {
            for row in slopes(ray.direction, t) {
                (0..POSE).for_each(|a| (0..POSE).for_each(|b| sum[a][b] += row[a] * row[b]));
            }
            count += 1.0;
            inside |= t.is_finite();
        }
    }
    if !inside {
        return plain(unit);
    }
    for (a, row) in sum.iter_mut().enumerate() {
        row.iter_mut().for_each(|x| *x /= count);
        row[a] = (row[a] * (1.0 + DAMPING)).max(LEAST);
    }
    inverse_transposed(&cholesky(&sum))
}

/// The matrix of a camera that does not see the box, or is unknown: as if the box were one unit away.
pub(super) fn plain(unit: f64) -> Matrix {
    let entry = |a: usize, b: usize| match (a == b, a < 3) {
        (true, true) => 1.0,
        (true, false) => unit,
        (false, _) => 0.0,
    };
    std::array::from_fn(|a| std::array::from_fn(|b| entry(a, b)))
}

/// The derivative of the direction to a point at the distance `t` along a unit direction, by the camera's rotation and
/// translation: three rows, six columns.
fn slopes(direction: DVec3, t: f64) -> [[f64; POSE]; 3] {
    let axes = [DVec3::X, DVec3::Y, DVec3::Z];
    let turned = axes.map(|axis| -axis.cross(direction));
    let moved = axes.map(|axis| -(axis - direction * direction.dot(axis)) / t);
    let columns = [turned[0], turned[1], turned[2], moved[0], moved[1], moved[2]];
    std::array::from_fn(|i| std::array::from_fn(|k| columns[k][i]))
}

/// The Cholesky factor L of a symmetric positive definite matrix `L L^T`.
fn cholesky(matrix: &Matrix) -> Matrix {
    let mut lower = [[0.0; POSE]; POSE];
    for i in 0..POSE {
        for j in 0..=i {
            let rest = matrix[i][j] - (0..j).map(|k| lower[i][k] * lower[j][k]).sum::<f64>();
            lower[i][j] = if i == j { rest.sqrt() } else { rest / lower[j][j] };
        }
    }
    lower
}

/// The inverse of the transpose of a lower triangular matrix.
fn inverse_transposed(lower: &Matrix) -> Matrix {
    let mut out = [[0.0; POSE]; POSE];
    for column in 0..POSE {
        // The result is upper triangular, so rows are solved from the last one up.
        for row in (0..=column).rev() {
            let own = if row == column { 1.0 } else { 0.0 };
            let rest = own - (row + 1..=column).map(|k| lower[k][row] * out[k][column]).sum::<f64>();
            out[row][column] = rest / lower[row][row];
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::lens::Lens;
    use raygrad_autograd::Real;

    const BOX: [DVec3; 2] = [DVec3::NEG_ONE, DVec3::ONE];

    fn camera() -> Camera {
        Camera::from_angle(40, 30, 0.8, Camera::look_at(DVec3::new(3.0, -1.0, 2.0), DVec3::ZERO, DVec3::Z))
    }

    #[test]
    fn balance_steps_move_the_image_equally() {
        for lens in [Lens::Pinhole, Lens::Fisheye { k: [0.0; 4], p: [0.0; 2], s: [0.0; 2] }] {
            let camera = Camera { lens, ..camera() };
            let matrix = balance(&camera, BOX, [0.1, 9.0], 1.0, false);
            let (mut seen, mut plain) = ([[0.0; POSE]; POSE], [[0.0; POSE]; POSE]);
            let mut count = 0.0;
            for i in 0..36 {
                let ray = camera.ray((i % 6) as f64 * 40.0 / 6.0 + 3.3, (i / 6) as f64 * 5.0 + 2.5);
                let [from, to] = clip_near_far(&ray, BOX, [0.1, 9.0]);
                for k in [1.0, 3.0, 5.0] {
                    if to > from {
                        let rows = slopes(ray.direction, from + k / 6.0 * (to - from));
                        for row in rows {
                            let by: [f64; POSE] =
                                std::array::from_fn(|b| (0..POSE).map(|a| row[a] * matrix[a][b]).sum());
                            for (a, b) in (0..POSE).flat_map(|a| (0..POSE).map(move |b| (a, b))) {
                                seen[a][b] += by[a] * by[b];
                                plain[a][b] += row[a] * row[b];
                            }
                        }
                        count += 1.0;
                    }
                }
            }
            let alike = |sums: &Matrix| {
                let pairs = (0..POSE).flat_map(|a| (0..a).map(move |b| (a, b)));
                pairs.map(|(a, b)| sums[a][b].abs() / (sums[a][a] * sums[b][b]).sqrt()).fold(0.0, Real::maximum)
            };
            assert!(seen.as_flattened().iter().all(|x| x.is_finite()), "{seen:?}");
            assert!(alike(&plain) > 0.9 && alike(&seen) < 0.7, "{} {}", alike(&plain), alike(&seen));
            for a in 0..POSE {
                // Damping reduces the smallest motions.
                assert!((0.1..1.0).contains(&(seen[a][a] / count)), "{seen:?}");
                assert!((0..a).all(|b| matrix[a][b] == 0.0));
            }
        }
    }

    #[test]
    fn balance_slopes_equal_differences() {
        let (direction, t, step) = (DVec3::new(0.3, -0.5, 0.8).normalize(), 2.5, 1e-6);
        let found = slopes(direction, t);
        for k in 0..POSE {
            let mut numbers = [0.0; POSE];
            numbers[k] = step;
            let [x, y, z, a, b, c] = numbers;
            // Points turn and move against the camera.
            let turn = crate::camera::rotation_matrix(DVec3::new(x, y, z));
            let moved = (turn.transpose() * (t * direction - DVec3::new(a, b, c))).normalize();
            for i in 0..3 {
                assert!(((moved[i] - direction[i]) / step - found[i][k]).abs() < 1e-5, "{i} {k}");
            }
        }
    }

    #[test]
    fn balance_counts_points_beyond_an_unbounded_scene() {
        // The box is small in the image, so that a rotation about the optical axis hardly shows in it.
        let narrow = camera();
        let small = BOX.map(|corner| 0.5 * corner);
        let turned = |unbounded| {
            let matrix = balance(&narrow, small, [0.1, 9.0], 1.0, unbounded);
            assert!(matrix.as_flattened().iter().all(|x| x.is_finite()), "{matrix:?}");
            // The largest rotation by one of the first three numbers.
            (0..3).map(|b| DVec3::new(matrix[0][b], matrix[1][b], matrix[2][b]).length()).fold(0.0, f64::max)
        };
        assert!(turned(true) < 0.85 * turned(false), "{} {}", turned(true), turned(false));
    }

    #[test]
    fn balance_does_not_depend_on_units() {
        let (near, mut far) = (camera(), camera());
        far.pose.translation *= 100.0;
        let a = balance(&near, BOX, [0.1, 9.0], 1.0, false);
        let b = balance(&far, BOX.map(|x| 100.0 * x), [10.0, 900.0], 100.0, false);
        for (i, j) in (0..POSE).flat_map(|i| (0..POSE).map(move |j| (i, j))) {
            let factor = if i < 3 { 1.0 } else { 100.0 };
            assert!((factor * a[i][j] - b[i][j]).abs() < 1e-9 * factor, "{i} {j}");
        }
    }

    #[test]
    fn balance_of_camera_without_view_is_plain() {
        let away = Camera::from_angle(4, 4, 0.5, Camera::look_at(DVec3::X * 5.0, DVec3::X * 9.0, DVec3::Z));
        let matrix = balance(&away, BOX, [0.1, 9.0], 1.5, true);
        assert!((0..POSE).all(|i| matrix[i][i] == if i < 3 { 1.0 } else { 1.5 }) && matrix[0][4] == 0.0);
    }
}
