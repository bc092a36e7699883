//! Alpha of one interval: `1 - e^(-sigma delta)`.

use super::support::*;
use raygrad::nerf::volume::{OpticalDepth, weights};
use raygrad::{Scalar, Segments, Tape, Tensor};

/// Alpha, the remaining light, and the gradient of alpha by the density, for one sample of colour 1.
fn one_sample<T: Scalar>(sigma: f64, delta: f64) -> [f64; 3] {
    let tape = Tape::new();
    let density = tape.leaf(vector::<T>(&[sigma]));
    let (op, segments) = (OpticalDepth::new(vector::<T>(&[delta])), Segments::uniform(1, 1));
    let out = composite(op, &segments, [&density, &tape.constant(Tensor::ones(&[1, 1]))]);
    let slope = out.slice_axis(1, ..1).sum().grad(&[&density]).remove(0).item().to_f64();
    let [alpha, left] = [0, 1].map(|i| out.value().as_slice()[i].to_f64());
    [alpha, left, slope]
}

/// Matrix: alpha at x = 0, 1e-45, 1e-8, 1e-4, 18, 104, inf. Catalogue: `alpha = 1 - e^-x`.
fn alpha_keeps_its_digits<T: Scalar>() {
    let tolerance = by_type::<T>(2e-7, 5e-16);
    for (x, name) in [(1e-45, "alpha(1e-45)"), (1e-8, "alpha(1e-8)"), (1e-7, "alpha(1e-7)"), (1e-4, "alpha(1e-4)")] {
        let [alpha, _, slope] = one_sample::<T>(x, 1.0);
        // The expected value is for the rounded density, while the constant is for the decimal number.
        near::<T>(name, alpha, -(-round::<T>(x)).exp_m1(), tolerance);
        near::<T>(name, alpha, constant(name), tolerance.max(by_type::<T>(6e-8, 2e-16)) + tolerance);
        near::<T>("slope", slope, (-round::<T>(x)).exp(), tolerance);
    }
    for (x, name) in [(16.0, "alpha(16)"), (18.0, "alpha(18)"), (104.0, "alpha(104)")] {
        let [alpha, left, slope] = one_sample::<T>(x, 1.0);
        near::<T>(name, alpha, constant(name), tolerance);
        near::<T>("light left", left, (-x).exp(), tolerance);
        near::<T>("slope", slope, (-x).exp(), tolerance);
    }
    near::<T>("transmittance(18)", one_sample::<T>(18.0, 1.0)[1], constant("transmittance(18)"), tolerance);
    assert_eq!(one_sample::<T>(0.0, 1.0), [0.0, 1.0, 1.0]);
    assert_eq!(one_sample::<T>(f64::INFINITY, 1.0), [1.0, 0.0, 0.0]);
}

/// Catalogue: 1024 steps of a total depth of 1e-3 accumulate 1 - e^-0.001.
fn many_small_steps_add_up<T: Scalar>() {
    let n = 1024;
    let tape = Tape::new();
    let delta = vector::<T>(&vec![1.0 / n as f64; n]);
    let density = tape.leaf(vector::<T>(&vec![1e-3; n]));
    let out = composite(
        OpticalDepth::new(delta),
        &Segments::uniform(1, n),
        [&density, &tape.constant(Tensor::ones(&[n, 1]))],
    );
    let expected = constant("alpha of 1024 steps of depth 1e-3 in all");
    near::<T>("accumulated alpha", out.value().as_slice()[0].to_f64(), expected, by_type::<T>(2e-7, 1e-14));
}

/// Matrix: no density in an infinite or huge interval is nothing; an interval of 0 is nothing.
fn no_density_or_no_length_is_nothing<T: Scalar>() {
    for delta in [f64::INFINITY, 1e10, 1.0] {
        let [alpha, left, slope] = one_sample::<T>(0.0, delta);
        assert_eq!([alpha, left], [0.0, 1.0], "interval {delta}");
        let expected = if delta.is_finite() { round::<T>(delta) } else { 0.0 };
        near::<T>("slope", slope, expected, 1e-6);
    }
    for sigma in [0.0, 1.0, 1e30] {
        assert_eq!(one_sample::<T>(sigma, 0.0), [0.0, 1.0, 0.0], "density {sigma}");
    }
    // Any density fills an infinite interval.
    assert_eq!(one_sample::<T>(1e-30, f64::INFINITY), [1.0, 0.0, 0.0]);
    // Plain operations, as second derivatives use them, give the same.
    let tape = Tape::new();
    let density = tape.leaf(vector::<T>(&[0.5, 0.0, 0.25]));
    let (op, segments) = (OpticalDepth::new(vector::<T>(&[1.0, f64::INFINITY, 1.0])), Segments::uniform(1, 3));
    let first = weights(&tape.apply(op, &[&density]), &segments).sum().grad_graph(&[&density]).remove(0);
    finite("first derivative", first.value());
    finite("second derivative", &first.sum().grad(&[&density])[0]);
}

/// Matrix: a negative density and a negative interval are errors.
fn negative_densities_and_intervals_are_errors<T: Scalar>() {
    for bad in [-1e-30, -1.0, f64::NEG_INFINITY, f64::NAN] {
        let error = OpticalDepth::try_new(vector::<T>(&[1.0, bad])).unwrap_err().to_string();
        assert!(error.starts_with("`delta[1]`: is "), "{error}");
    }
    let op = || OpticalDepth::new(Tensor::<T>::ones(&[2]));
    let error = op().check(&vector(&[1.0, -0.5])).unwrap_err().to_string();
    assert!(error.starts_with("`density[1]`: is -0.5"), "{error}");
    assert!(op().check(&vector(&[0.0, -0.0])).is_ok() && op().check(&vector(&[f64::NAN, 1.0])).is_ok());
    let text = panic_of(|| {
        let tape = Tape::new();
        tape.apply(op(), &[&tape.leaf(vector(&[1.0, -0.5]))]).into_value()
    });
    assert!(text.contains("density[1]"), "{text}");
    // A log density may have any value.
    let log = OpticalDepth::of_log_density(Tensor::<T>::ones(&[2]));
    assert!(log.check(&vector(&[-5.0, -0.5])).is_ok());
}

both!(
    alpha_keeps_its_digits,
    many_small_steps_add_up,
    no_density_or_no_length_is_nothing,
    negative_densities_and_intervals_are_errors,
);
