//! Noise with detail at every scale, filtered to a pixel's footprint.

use glam::{DMat2, DVec2, DVec3, Vec3Swizzles};

/// Gradient noise (Perlin 2002): smooth, with mean 0, magnitude 1 and features of about the length 1. The plane z = 0
/// has the same quality at half the time.
fn gradient_noise(point: DVec3, seed: u32) -> f64 {
    let cell = point.floor();
    let within = point - cell;
    let fade = within * within * within * (within * (within * 6.0 - 15.0) + 10.0);
    let corner = cell.to_array().map(|at| at as i64);
    let slope = |x: i64, y: i64, z: i64| {
        let hash = hash([corner[0] + x, corner[1] + y, corner[2] + z].map(|i| i as u32), seed);
        let from = within - DVec3::new(x as f64, y as f64, z as f64);
        // One of twelve gradients towards the middles of a cube's edges.
        let (u, v) = match hash % 3 {
            0 => (from.x, from.y),
            1 => (from.y, from.z),
            _ => (from.z, from.x),
        };
        (if hash & 64 == 0 { u } else { -u }) + (if hash & 128 == 0 { v } else { -v })
    };
    let mix = |a: f64, b: f64, t: f64| a + t * (b - a);
    let layer = |z: i64| {
        let row = |y: i64| mix(slope(0, y, z), slope(1, y, z), fade.x);
        mix(row(0), row(1), fade.y)
    };
    if within.z == 0.0 { layer(0) } else { mix(layer(0), layer(1), fade.z) }
}

/// Hashes a lattice point, so that neighbours get unrelated numbers.
fn hash(point: [u32; 3], seed: u32) -> u32 {
    let [x, y, z] = point;
    let mut h = x.wrapping_mul(0x9e37_79b1) ^ y.wrapping_mul(0x85eb_ca77) ^ z.wrapping_mul(0xc2b2_ae3d) ^ seed;
    for factor in [0x2c1b_3c6d, 0x297a_2d39] {
        h = (h ^ (h >> 15)).wrapping_mul(factor);
    }
    h ^ (h >> 15)
}

/// The share of features of the size `length` that a pixel of the diameter `footprint` shows. It is 1 from twice the
/// footprint on, and 0 below half of it, where features average out. In between it approximates the pixel's mean.
fn visible(length: f64, footprint: f64) -> f64 {
    let t = ((length / footprint - 0.5) / 1.5).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// A sum of noise octaves with mean 0. The features have the length `longest`, then half of it, and so on in `octaves`
/// steps. Each octave is `gain` times as strong as the one before.
///
/// Features finer than a pixel of the diameter `footprint` fade to their mean, so that the sum approximates the mean
/// over the pixel at any distance.
pub fn fractal(point: DVec3, longest: f64, octaves: usize, gain: f64, footprint: f64, seed: u32) -> f64 {
    // Every octave is rotated, so that lattices do not align, and shifted, since all are 0 at the origin.
    let turn = DMat2::from_cols(DVec2::new(0.8, 0.6), DVec2::new(-0.6, 0.8));
    let (mut point, mut length, mut strength, mut sum) = (point / longest, longest, 1.0, 0.0);
    for octave in 0..octaves {
        let share = visible(length, footprint);
        if share == 0.0 {
            break;
        }
        sum += share * strength * gradient_noise(point, seed.wrapping_add(octave as u32));
        let plane = 2.0 * (turn * point.xy()) + DVec2::new(0.37, 0.71);
        point = plane.extend(2.0 * point.z);
        length *= 0.5;
        strength *= gain;
    }
    sum
}

/// The share of the interval of length `width` around `at` that is below 0: a step, filtered to a pixel.
pub fn below(at: f64, width: f64) -> f64 {
    (0.5 - at / width).clamp(0.0, 1.0)
}

/// The share of the interval of length `width` around `at` in the first half of each period of length 1: stripes,
/// filtered to a pixel.
pub fn stripes(at: f64, width: f64) -> f64 {
    // The integral of the stripes from 0.
    let integral = |x: f64| 0.5 * x.floor() + (x - x.floor()).min(0.5);
    (integral(at + 0.5 * width) - integral(at - 0.5 * width)) / width
}

/// A pseudo-random number in 0..1 for each pair of numbers.
pub fn random(index: usize, purpose: u32) -> f64 {
    f64::from(hash([index as u32, 0, 0], purpose.wrapping_mul(0x27d4_eb2f))) / 4_294_967_296.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Random points, far from each other and without the lattice's regularity.
    fn point(i: usize) -> DVec3 {
        DVec3::from([1, 2, 3].map(|k| 500.0 * random(i, k) - 250.0))
    }

    #[test]
    fn landscape_noise_has_mean_zero_and_unit_size() {
        for flat in [false, true] {
            let value = |i| gradient_noise(point(i) * if flat { DVec3::new(1.0, 1.0, 0.0) } else { DVec3::ONE }, 5);
            let values: Vec<f64> = (0..20_000).map(value).collect();
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            let deviation = (values.iter().map(|v| v * v).sum::<f64>() / values.len() as f64).sqrt();
            assert!(mean.abs() < 0.01 && (0.2..0.4).contains(&deviation), "{mean} {deviation}");
            assert!(values.iter().all(|v| v.abs() < 1.1));
        }
    }

    /// The plane z = 0 takes a shortcut, which must continue the noise beside it.
    #[test]
    fn landscape_noise_is_continuous() {
        for i in 0..2000 {
            let at = point(i).with_z((i % 3) as f64);
            for step in [DVec3::X, DVec3::Y, DVec3::Z] {
                let [a, b] = [-1e-7, 1e-7].map(|s| gradient_noise(at + s * step, 9));
                let here = gradient_noise(at, 9);
                assert!((a - here).abs() < 1e-6 && (b - here).abs() < 1e-6, "{a} {here} {b}");
            }
        }
    }

    /// A filtered sample must be close to the mean over a pixel of that footprint.
    #[test]
    fn noise_of_footprint_is_its_mean() {
        for footprint in [0.1, 0.5, 2.0, 8.0] {
            let (mut squares, mut rough) = (0.0, 0.0);
            for i in 0..200 {
                let at = point(i).with_z(0.0);
                let offset = |k: usize| DVec3::new(random(k, 8) - 0.5, random(k, 9) - 0.5, 0.0) * footprint;
                let of = |point, footprint| fractal(point, 4.0, 9, 1.0, footprint, 1);
                let mean = (0..400).map(|k| of(at + offset(k), 1e-9)).sum::<f64>() / 400.0;
                squares += (of(at, footprint) - mean).powi(2) / 200.0;
                rough += (of(at, 1e-9) - mean).powi(2) / 200.0;
            }
            println!("{footprint}: {squares:.4} of {rough:.4}");
            assert!(squares.sqrt() < 0.25 && squares < 0.3 * rough, "{footprint}: {squares} of {rough}");
        }
    }

    #[test]
    fn edges_and_stripes_are_footprint_means() {
        for width in [0.01, 0.3, 1.7, 5.0] {
            for at in [-3.2, -0.4, 0.0, 0.1, 0.45, 2.3] {
                let n = 20_000;
                let mean = |f: &dyn Fn(f64) -> bool| {
                    let place = |i: usize| at + width * ((i as f64 + 0.5) / n as f64 - 0.5);
                    (0..n).filter(|&i| f(place(i))).count() as f64 / n as f64
                };
                assert!((below(at, width) - mean(&|x| x < 0.0)).abs() < 1e-3);
                assert!((stripes(at, width) - mean(&|x| x.rem_euclid(1.0) < 0.5)).abs() < 1e-3);
            }
        }
        assert_eq!([below(-1.0, 0.0), below(1.0, 0.0)], [1.0, 0.0]);
    }
}
