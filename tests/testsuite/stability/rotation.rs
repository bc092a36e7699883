//! Rotations.

use super::support::*;
use raygrad::nerf::rotation_exp;
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

/// The step of a vector for differences.
const STEP: f64 = 1e-5;

/// The row-major rotation matrix of an axis and an angle, by the textbook formula in f64.
fn textbook([x, y, z]: [f64; 3], angle: f64) -> [f64; 9] {
    let (s, c) = angle.sin_cos();
    // 1 - cos, without cancellation.
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

/// Matrix: rotations at angles 0, 1e-8, 1e-4, 1e-2, pi - 1e-6, pi: orthonormal, right, with the right gradients.
fn exponential_at_every_angle<T: Scalar>() {
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
            let skew = skewness(&values);
            assert!(skew <= by_type::<T>(1e-6, 2e-15), "{what}: {skew:e}");
            for k in 0..9 {
                let element = matrix.slice_axis(1, k / 3..k / 3 + 1).slice_axis(2, k % 3..k % 3 + 1);
                let slopes = numbers(&element.sum().grad(&[&leaf])[0]);
                for (i, slope) in slopes.iter().enumerate() {
                    // The same by differences.
                    let beside = [-STEP, STEP].map(|step| {
                        let mut moved = vector;
                        moved[i] += step;
                        let angle = moved.iter().map(|x| x * x).sum::<f64>().sqrt();
                        textbook(moved.map(|x| x / angle), angle)[k]
                    });
                    let expected = (beside[1] - beside[0]) / (2.0 * STEP);
                    within(&format!("{what}, slope {k} {i}"), *slope, expected, by_type::<T>(4e-6, 1e-9));
                }
            }
        }
    }
}

/// Catalogue: (1 - cos t) / t^2 at 1e-4 is 0.5, not 0: a small rotation moves a point by it.
fn small_angles_have_their_second_order_term<T: Scalar>() {
    let angle = 1e-4;
    let tape = Tape::new();
    let leaf = tape.leaf(tensor::<T>(&[1, 3], &[angle, angle, 0.0]));
    // The element [0][1] of exp(w) is b w_x w_y for w_z = 0, with b = (1 - cos |w|) / |w|^2.
    let element = rotation_exp(&leaf).value().as_slice()[1].to_f64();
    let b = element / round::<T>(angle).powi(2);
    within("b", b, constant("(1 - cos t) / t^2 at 1e-4"), by_type::<T>(1e-6, 1e-8));
}

both!(exponential_at_every_angle, small_angles_have_their_second_order_term);
