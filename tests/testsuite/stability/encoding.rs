//! Positional encoding.

use super::support::*;
use raygrad::nerf::PositionalEncoding;
use raygrad::{Scalar, Tape};
use std::f64::consts::PI;

/// Matrix: positional encoding of 0, +-1, +-4, +-1e3, +-1e6 with L = 10, 12, 16. Catalogue: pi rounded to f32.
fn exact_at_every_level_and_size<T: Scalar>() {
    let mut x = vec![0.0, -0.0, 0.3, 3.999, 1e-30];
    x.extend([1.0, 4.0, 1e3, 1e6, 1e3 + 0.37, 123.456].iter().flat_map(|&x| [x, -x]));
    // A property test found these: twice the last overflows f32.
    let x: Vec<f64> = x.into_iter().chain([1e30, -3.158_787_907e38]).map(round::<T>).collect();
    let tolerance = by_type::<T>(3e-7, 2e-15);
    for levels in [10, 12, 16] {
        let tape = Tape::new();
        let input = tape.leaf(tensor::<T>(&[x.len(), 1], &x));
        let y = tape.apply(PositionalEncoding { levels, input: false }, &[&input]);
        let values = numbers(y.value());
        for level in 0..levels {
            let slopes =
                [0, 1].map(|k| numbers(&y.slice_axis(1, 2 * level + k..2 * level + k + 1).sum().grad(&[&input])[0]));
            for (i, &x) in x.iter().enumerate() {
                // 2^k x is exact, and so is its remainder by 2.
                let frequency = (level as f64).exp2();
                let (sine, cosine) = (PI * ((x * frequency) % 2.0)).sin_cos();
                let what = format!("level {level}, x {x}");
                within(&what, values[2 * (i * levels + level)], sine, tolerance);
                within(&what, values[2 * (i * levels + level) + 1], cosine, tolerance);
                within(&what, slopes[0][i], frequency * PI * cosine, frequency * PI * tolerance);
                within(&what, slopes[1][i], -frequency * PI * sine, frequency * PI * tolerance);
            }
        }
    }
}

/// Non-finite coordinates affect only their own row.
fn bad_coordinates_stay_in_their_row<T: Scalar>() {
    let tape = Tape::new();
    let input = tape.leaf(tensor::<T>(&[3, 1], &[f64::INFINITY, 0.25, f64::NAN]));
    let y = numbers(tape.apply(PositionalEncoding { levels: 3, input: false }, &[&input]).value());
    assert!(y[..6].iter().chain(&y[12..]).all(|y| y.is_nan()) && y[6..12].iter().all(|y| y.is_finite()), "{y:?}");
}

both!(exact_at_every_level_and_size, bad_coordinates_stay_in_their_row);
