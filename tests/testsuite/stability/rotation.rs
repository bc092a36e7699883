//! Rotations and poses.

use super::support::*;
use raygrad::nerf::{Pose, rotation_exp, rotation_log};
use raygrad::{Scalar, Tape};
use std::f64::consts::PI;

const ANGLES: [f64; 12] = [0.0, 1e-30, 1e-8, 1e-4, 1e-2, 0.5, 1.0, 2.0, 3.0, PI - 1e-6, PI, PI - 1e-3];
const AXES: [[f64; 3]; 6] = [
    [1.0, 0.0, 0.0],
    [0.0, -1.0, 0.0],
    [0.0, 0.0, 1.0],
    [0.6, -0.8, 0.0],
    [0.0, 0.28, 0.96],
    [2.0 / 3.0, -1.0 / 3.0, 2.0 / 3.0],
];

/// The rotation matrix of an axis and an angle, row by row, by the textbook formula in f64.
fn textbook([x, y, z]: [f64; 3], angle: f64) -> [f64; 9] {
    let (s, c) = angle.sin_cos();
    // 1 - cos, with its digits.
    let v = 2.0 * (0.5 * angle).sin().powi(2);
    [
        c + x * x * v,
        x * y * v - z * s,
        x * z * v + y * s,
        x * y * v + z * s,
        c + y * y * v,
        y * z * v - x * s,
        x * z * v - y * s,
        y * z * v + x * s,
        c + z * z * v,
    ]
}

/// Matrix: pose exp and log at angles 0, 1e-8, 1e-4, 1e-2, pi - 1e-6, pi: orthonormal, right, with finite gradients.
fn exponential_and_logarithm_at_every_angle<T: Scalar>() {
    for angle in ANGLES {
        for axis in AXES {
            let vector = axis.map(|x| x * angle);
            let tape = Tape::new();
            let leaf = tape.leaf(tensor::<T>(&[1, 3], &vector));
            let matrix = rotation_exp(&leaf);
            let values = numbers(matrix.value());
            let what = format!("{angle} about {axis:?}");
            for (k, (got, expected)) in values.iter().zip(textbook(axis, angle)).enumerate() {
                within(&format!("{what}, element {k}"), *got, expected, by_type::<T>(6e-7, 2e-15));
            }
            let pose = Pose::from_vector(vector.map(T::from_f64), [T::ZERO; 3]);
            assert_eq!(pose.rotation.map(|x| x.to_f64())[..], values, "both routes are one formula");
            assert!(pose.skewness() <= by_type::<T>(1e-6, 2e-15), "{what}: {:e}", pose.skewness());
            let first = (0..9).map(|k| {
                matrix.slice_axis(1, k / 3..k / 3 + 1).slice_axis(2, k % 3..k % 3 + 1).sum().grad(&[&leaf]).remove(0)
            });
            first.for_each(|slope| finite(&what, &slope));
            let again = rotation_log(&matrix);
            // At pi both directions of the axis are right.
            let got = numbers(again.value());
            let inner: f64 = got.iter().zip(&vector).map(|(a, b)| a * b).sum();
            let sign = if angle > 3.1 && inner < 0.0 { -1.0 } else { 1.0 };
            for (got, expected) in got.iter().zip(vector) {
                within(&what, sign * got, expected, by_type::<T>(2e-6, 1e-14) * angle + smallest::<T>());
            }
            let whole = numbers(&again.slice_axis(1, ..1).sum().grad(&[&leaf])[0]);
            assert!(whole.iter().all(|slope| slope.is_finite()), "{what}: {whole:?}");
            if angle < 3.1 {
                // The logarithm undoes the exponential, and so do the derivatives.
                for (k, slope) in whole.iter().enumerate() {
                    within(
                        &format!("{what}, slope {k}"),
                        *slope,
                        f64::from(u8::from(k == 0)),
                        by_type::<T>(1e-5, 1e-12),
                    );
                }
            }
        }
    }
}

/// Catalogue: (1 - cos t) / t^2 at 1e-4 is .5, and not 0: seen in how a small rotation moves a point.
fn small_angles_keep_their_second_order<T: Scalar>() {
    let angle = 1e-4;
    let tape = Tape::new();
    let leaf = tape.leaf(tensor::<T>(&[1, 3], &[angle, angle, 0.0]));
    // The element [0][1] of exp(w) is b w_x w_y for w_z = 0, with b = (1 - cos |w|) / |w|^2.
    let element = rotation_exp(&leaf).value().as_slice()[1].to_f64();
    let b = element / round::<T>(angle).powi(2);
    within("b", b, constant("(1 - cos t) / t^2 at 1e-4"), by_type::<T>(1e-6, 1e-8));
}

/// Long run: 1e6 poses composed. Catalogue: 1e5 f32 products are off by 1e-3.
fn a_million_compositions_stay_a_rotation<T: Scalar>() {
    let step = Pose::from_vector([1e-3, 2e-3, -5e-4].map(T::from_f64), [T::from_f64(1e-6); 3]);
    let mut pose = Pose::identity();
    let mut worst = 0.0_f64;
    for i in 0..1_000_000 {
        pose = step.after(&pose);
        if i % 4096 == 0 {
            worst = raygrad::Real::maximum(worst, pose.skewness());
        }
    }
    worst = raygrad::Real::maximum(worst, pose.skewness());
    assert!(worst <= by_type::<T>(1e-6, 2e-15), "{worst:e}");
    assert!(pose.translation.iter().all(|x| x.to_f64().abs() < 2.0));
    // There and back.
    let back = pose.after(&pose.inverse());
    let off = Pose { translation: [T::ZERO; 3], ..back }.vector().map(|x| x.to_f64());
    assert!(off.iter().all(|x| x.abs() < by_type::<T>(2e-6, 1e-14)), "{off:?}");
}

/// Catalogue: acos(1 + ulp) is NaN. A matrix that rounding has made a little longer than a rotation has a logarithm.
fn matrices_with_rounding_have_a_logarithm<T: Scalar>() {
    for excess in [-8.0, -1.0, 1.0, 8.0] {
        let mut rotation = Pose::<T>::identity().rotation;
        (0..3).for_each(|k| rotation[4 * k] = T::from_f64(1.0 + excess * T::EPSILON));
        let vector = Pose { rotation, translation: [T::ZERO; 3] }.vector();
        assert_eq!(vector.map(|x| x.to_f64().abs()), [0.0; 3]);
        let tape = Tape::new();
        let leaf = tape.leaf(tensor::<T>(&[1, 3, 3], &rotation.map(|x| x.to_f64())));
        let log = rotation_log(&leaf);
        finite("gradient", &log.sum().grad(&[&leaf])[0]);
        // Half a turn, whose trace is -1 - excess.
        let turn = [1.0, -1.0 - excess * T::EPSILON, -1.0 - excess * T::EPSILON];
        (0..3).for_each(|k| rotation[4 * k] = T::from_f64(turn[k]));
        let vector = Pose { rotation, translation: [T::ZERO; 3] }.vector();
        within("half a turn", vector[0].to_f64().abs(), PI, 1e-5);
    }
}

both!(
    exponential_and_logarithm_at_every_angle,
    small_angles_keep_their_second_order,
    a_million_compositions_stay_a_rotation,
    matrices_with_rounding_have_a_logarithm,
);
