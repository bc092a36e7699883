//! Compositing along a ray.

use super::support::*;
use raygrad::nerf::Jitter;
use raygrad::nerf::camera::stratified;
use raygrad::nerf::sampling::steps::importance_sampling;
use raygrad::nerf::volume::{OpticalDepth, Weights};
use raygrad::{Op, Pool, Real, Scalar, Segments, Tape, Tensor, Var};

/// Colour and remaining light of one ray of optical depths `x`, and the gradients of the colour by densities and colours.
fn ray<T: Scalar>(x: &[f64], colour: &[f64]) -> ([f64; 2], Vec<f64>, Vec<f64>) {
    let n = x.len();
    let tape = Tape::new();
    let (density, features) = (tape.leaf(vector::<T>(x)), tape.leaf(tensor::<T>(&[n, 1], colour)));
    let (op, segments) = (OpticalDepth::new(Tensor::ones(&[n])), Segments::uniform(1, n));
    let out = composite(op, &segments, [&density, &features]);
    let grads = out.slice_axis(1, ..1).sum().grad(&[&density, &features]);
    let both = [0, 1].map(|i| out.value().as_slice()[i].to_f64());
    (both, numbers(&grads[0]), numbers(&grads[1]))
}

/// `dC/dx_i = e^-x_i T_i (c_i - B)`, with the light B from behind sample i summed sample by sample.
fn expected_slopes(x: &[f64], colour: &[f64]) -> Vec<f64> {
    let slope = |i: usize| {
        let before: f64 = x[..i].iter().sum();
        let (mut behind, mut left) = (0.0, 1.0);
        for j in i + 1..x.len() {
            behind += left * -(-x[j]).exp_m1() * colour[j];
            left *= (-x[j]).exp();
        }
        (-x[i] - before).exp() * (colour[i] - behind)
    };
    (0..x.len()).map(slope).collect()
}

/// Matrix: composite of N = 0, N = 1, nothing, everything.
fn composite_of_extreme_rays_is_exact<T: Scalar>() {
    assert_eq!(ray::<T>(&[], &[]).0, [0.0, 1.0], "no samples: the background");
    let (out, d_density, d_colour) = ray::<T>(&[0.75], &[0.5]);
    let tolerance = by_type::<T>(2e-7, 5e-16);
    near::<T>("colour", out[0], -0.5 * (-0.75_f64).exp_m1(), tolerance);
    near::<T>("light", out[1], (-0.75_f64).exp(), tolerance);
    near::<T>("density", d_density[0], 0.5 * (-0.75_f64).exp(), tolerance);
    near::<T>("colour", d_colour[0], -(-0.75_f64).exp_m1(), tolerance);
    assert_eq!(ray::<T>(&[0.0; 5], &[0.9; 5]).0, [0.0, 1.0], "empty space: the background");
    let (out, d_density, d_colour) = ray::<T>(&[1e30; 3], &[0.25, 0.5, 0.75]);
    assert_eq!(out, [0.25, 0.0], "opaque: the first colour");
    assert_eq!((d_density, d_colour), (vec![0.0; 3], vec![1.0, 0.0, 0.0]));
}

/// Matrix: gradient with alpha = 1 first, in the middle, last, twice. Catalogue: gradient of cumprod with exact zeros.
fn gradient_behind_opaque_samples<T: Scalar>() {
    let colour = [0.2, 0.9, 0.4, 0.7, 0.1].map(round::<T>);
    let soft = [0.3, 1.5, 0.7, 0.2, 2.0].map(round::<T>);
    for opaque in [&[0][..], &[2], &[4], &[1, 3], &[0, 4], &[0, 1, 2, 3, 4], &[]] {
        let mut x = soft;
        opaque.iter().for_each(|&i| x[i] = 1e30);
        let (_, got, _) = ray::<T>(&x, &colour);
        for (i, (got, expected)) in got.iter().zip(expected_slopes(&x, &colour)).enumerate() {
            within(&format!("opaque {opaque:?}, sample {i}"), *got, expected, by_type::<T>(2e-7, 5e-16));
        }
    }
    // The product itself: alpha = (0.3, 1, 0.5), whose gradient a division by 1 - alpha would make NaN.
    let tape = Tape::new();
    let alpha = tape.leaf(vector::<T>(&[0.3, 1.0, 0.5]));
    let left = (1.0 - &alpha).cumprod(0);
    let before = Var::concat(&[&tape.constant(Tensor::ones(&[1])), &left.slice_axis(0, ..2)], 0);
    let colour = tape.constant(vector(&[0.2, 0.9, 0.4]));
    let slopes = (before * &alpha * colour).sum().grad(&[&alpha]).remove(0);
    for (i, slope) in numbers(&slopes).into_iter().enumerate() {
        within("cumprod", slope, constant(&format!("d colour / d alpha[{i}]")), by_type::<T>(1e-7, 3e-16));
    }
}

/// Matrix: optical depths (.1, 20, .5, .5, 30, .2). Catalogue: T = prod(1 - alpha + 1e-10).
fn transmittance_far_behind<T: Scalar>() {
    let (op, x) = (Weights::new(Segments::uniform(1, 6)), vector::<T>(&[0.1, 20.0, 0.5, 0.5, 30.0, 0.2]));
    let transmittance = op.transmittance(&x, &Pool::new());
    let weights = op.forward(&[&x], &Pool::new());
    // The depth 0.1 is rounded, and T carries the error of the sum: half an ULP of 20.6 in f32.
    for i in 2..6 {
        let expected = constant(&format!("T[{i}]"));
        near::<T>("transmittance", transmittance.as_slice()[i].to_f64(), expected, by_type::<T>(2e-6, 2e-14));
    }
    let total: f64 = numbers(&weights).iter().sum();
    within("weights", total + constant("T[5]") * (-0.2_f64).exp(), 1.0, by_type::<T>(1e-6, 1e-15));
    // 192 steps to a depth of 40.
    let n = 192;
    let (op, segments) = (OpticalDepth::new(vector::<T>(&vec![4.0 / n as f64; n])), Segments::uniform(1, n));
    let tape = Tape::new();
    let out = composite(
        op,
        &segments,
        [&tape.constant(Tensor::full(&[n], T::from_f64(10.0))), &tape.constant(Tensor::ones(&[n, 1]))],
    );
    let left = out.value().as_slice()[1].to_f64();
    near::<T>("192 steps", left, constant("transmittance(40)"), by_type::<T>(7e-6, 1e-13));
}

/// Gate: the weights and the remaining light sum to 1.
fn weights_and_what_is_left_are_everything<T: Scalar>() {
    let (mut random, mut worst) = (noise(5), 0.0_f64);
    for scale in [1e-6, 0.01, 1.0, 100.0] {
        let x: Vec<f64> = (0..500).map(|_| scale * random()).collect();
        let ([total, left], ..) = ray::<T>(&x, &[1.0; 500]);
        within(&format!("scale {scale}"), total + left, 1.0, by_type::<T>(1e-6, 1e-14));
        worst = Real::maximum(worst, (total + left - 1.0).abs());
    }
    println!("weights and what is left, {}: {worst:.1e} from 1", T::NAME);
}

/// Catalogue: dC/dsigma with suffix = C - prefix is 16 % off where T = 1e-6.
fn gradient_keeps_its_digits_where_little_light_is_left<T: Scalar>() {
    let n = 200;
    let mut random = noise(9);
    let x: Vec<f64> = (0..n).map(|_| round::<T>(0.14 * random())).collect();
    let colour: Vec<f64> = (0..n).map(|_| round::<T>(random())).collect();
    let (_, got, _) = ray::<T>(&x, &colour);
    let expected = expected_slopes(&x, &colour);
    let (mut depth, mut worst) = (0.0, 0.0_f64);
    for i in 0..n {
        let light = f64::exp(-depth);
        within(&format!("sample {i}, T = {light:e}"), got[i], expected[i], by_type::<T>(1e-5, 1e-13) * light);
        worst = Real::maximum(worst, (got[i] - expected[i]).abs() / light);
        depth += x[i];
    }
    println!("gradient of densities down to T = 1e-6, {}: {worst:.1e} T", T::NAME);
    assert!(depth > 13.0, "the light must fall to about 1e-6, is at {:e}", (-depth).exp());
    // The light behind a thick sample: 1 - alpha has lost its digits there, e^-x has not.
    let (x, colour) = ([16.0, 0.5], [1.0, 0.25]);
    let (_, got, _) = ray::<T>(&x, &colour);
    near::<T>("depth 16", got[0], expected_slopes(&x, &colour)[0], by_type::<T>(1e-6, 1e-13));
}

/// Catalogue: a last interval of 1e10 makes a wall of a density of 1e-10.
fn no_interval_is_longer_than_the_ray<T: Scalar>() {
    let rays = ray_along_z::<T>(0.0, [2.0, 6.0]);
    let pool = Pool::new();
    let coarse = stratified(&rays, 16, &mut Jitter::Middle, &pool);
    let weights = vec![T::ONE; 16];
    let fine = importance_sampling(&rays, &coarse, &weights, 32, 0.01, &mut Jitter::Middle, &pool);
    for samples in [coarse, fine] {
        let n = samples.len();
        within("intervals", numbers(&samples.delta).iter().sum(), 4.0, 1e-5);
        let tape = Tape::new();
        let density = tape.leaf(Tensor::full(&[n], T::from_f64(1e-10)));
        let (op, segments) = (OpticalDepth::new(samples.delta), samples.segments);
        let alpha =
            composite(op, &segments, [&density, &tape.constant(Tensor::ones(&[n, 1]))]).slice_axis(1, ..1).sum();
        near::<T>("alpha", alpha.item().to_f64(), 4e-10, 1e-6);
        assert!(numbers(&alpha.grad(&[&density])[0]).iter().all(|&slope| (0.0..=4.0).contains(&slope)));
    }
}

/// Matrix: exp density at z = -200, -20, 0, 15, 16, 88, 89, 200. Catalogue: sigma = exp(z).
fn exponential_density<T: Scalar>() {
    for z in [-200.0, -20.0, 0.0, 15.0, 16.0, 88.0, 89.0, 200.0_f64] {
        for delta in [1e-6, 1e-3, 1.0] {
            let tape = Tape::new();
            let density = tape.leaf(vector::<T>(&[z]));
            let (op, segments) = (OpticalDepth::of_log_density(vector(&[delta])), Segments::uniform(1, 1));
            let out =
                composite(op, &segments, [&density, &tape.constant(Tensor::ones(&[1, 1]))]).slice_axis(1, ..1).sum();
            let u = z.exp() * round::<T>(delta);
            let tolerance = by_type::<T>(2e-7, 1e-15);
            near::<T>(&format!("alpha, z {z}, interval {delta}"), out.item().to_f64(), -(-u).exp_m1(), tolerance);
            let slope = out.grad(&[&density])[0].item().to_f64();
            let expected = if u > 1e4 { 0.0 } else { u * (-u).exp() };
            near::<T>(&format!("slope, z {z}, interval {delta}"), slope, expected, (1.0 + u) * tolerance);
        }
    }
    let slope = |z: f64| {
        let tape = Tape::new();
        let density = tape.leaf(vector::<T>(&[z]));
        let (op, segments) = (OpticalDepth::of_log_density(vector(&[1e-6])), Segments::uniform(1, 1));
        let out = composite(op, &segments, [&density, &tape.constant(Tensor::ones(&[1, 1]))]).slice_axis(1, ..1).sum();
        out.grad(&[&density])[0].item().to_f64()
    };
    // A gradient clamped at 15 or at -15 would differ.
    let tolerance = by_type::<T>(2e-6, 1e-14);
    near::<T>("at 16", slope(16.0), constant("exponential density at 16: gradient of alpha"), tolerance);
    near::<T>(
        "at -20",
        slope(-20.0),
        constant("exponential density at -20: gradient of alpha, interval 1e-6"),
        tolerance,
    );
}

/// Long run: a ray of 1e5 samples is as accurate in f32 as a short one.
fn a_ray_of_a_hundred_thousand_samples<T: Scalar>() {
    let n = 100_000;
    let x: Vec<f64> = (0..n).map(|i| round::<T>(1e-4 * (1.0 + (i as f64 * 0.01).sin()))).collect();
    let colour: Vec<f64> = (0..n).map(|i| round::<T>(0.5 + 0.5 * (i as f64 * 1e-3).cos())).collect();
    let (out, slopes, _) = ray::<T>(&x, &colour);
    // From the back, as light travels.
    let (mut behind, mut expected) = (0.0, vec![0.0; n]);
    let mut before = x.iter().sum::<f64>();
    for i in (0..n).rev() {
        expected[i] = (-before).exp() * (colour[i] - behind);
        before -= x[i];
        behind = -(-x[i]).exp_m1() * colour[i] + (-x[i]).exp() * behind;
    }
    within("colour", out[0], behind, by_type::<T>(1e-6, 1e-12));
    near::<T>("light", out[1], (-x.iter().sum::<f64>()).exp(), by_type::<T>(2e-6, 1e-11));
    for i in (0..n).step_by(997) {
        within(&format!("sample {i}"), slopes[i], expected[i], by_type::<T>(2e-6, 1e-11));
    }
}

both!(
    composite_of_extreme_rays_is_exact,
    gradient_behind_opaque_samples,
    transmittance_far_behind,
    weights_and_what_is_left_are_everything,
    gradient_keeps_its_digits_where_little_light_is_left,
    no_interval_is_longer_than_the_ray,
    exponential_density,
    a_ray_of_a_hundred_thousand_samples,
);
