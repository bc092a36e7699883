//! Properties over all magnitudes from 1e-38 to 1e38, subnormals, signed zeros, infinities and NaN.

use super::support::*;
use proptest::prelude::*;
use raygrad::nerf::Jitter;
use raygrad::nerf::encoding::hash_grid::{HashEncoding, HashGrid, HashGridConfig};
use raygrad::nerf::sampling::steps::{even_edges, invert_cdf};
use raygrad::nerf::space::occupancy::{MarchBuffer, OccupancyConfig, OccupancyGrid, Step};
use raygrad::nerf::volume::{self, OpticalDepth, Weights};
use raygrad::nerf::{
    Camera, Distortion, Lens, Ndc, PositionalEncoding, Ray, Rays, contract, glam::DVec3, intersect_box, rotation_exp,
    srgb_decode, srgb_encode,
};
use raygrad::{Adam, AdamConfig, Op, Optimizer, Params, Scalar, Segments, Tape, Tensor, Var};

/// A finite f32 number of any magnitude, uniform in the exponent, or a zero of either sign.
fn any_finite() -> impl Strategy<Value = f64> {
    let sign = prop::bool::ANY.prop_map(|negative| if negative { -1.0 } else { 1.0 });
    prop_oneof![
        6 => (-38.0..38.5_f64, sign.clone()).prop_map(|(exponent, sign)| sign * 10.0_f64.powf(exponent)),
        2 => (-3.0..3.0_f64, sign.clone()).prop_map(|(exponent, sign)| sign * 10.0_f64.powf(exponent)),
        // Subnormals of f32.
        1 => (1_u32..0x0080_0000, sign.clone()).prop_map(|(bits, sign)| sign * f64::from(f32::from_bits(bits))),
        1 => sign,
        1 => Just(0.0),
        1 => Just(-0.0),
    ]
}

/// Any number.
fn any_number() -> impl Strategy<Value = f64> {
    prop_oneof![8 => any_finite(), 1 => Just(f64::INFINITY), 1 => Just(f64::NEG_INFINITY), 1 => Just(f64::NAN)]
}

fn positive() -> impl Strategy<Value = f64> {
    any_finite().prop_map(f64::abs)
}

/// Runs a check in both precisions.
macro_rules! in_both {
    ($check:ident($($argument:expr),*)) => {{
        $check::<f32>($($argument),*)?;
        $check::<f64>($($argument),*)?;
    }};
}

type Outcome = Result<(), TestCaseError>;

/// Weights are in 0..=1 and sum up, and gradients are finite for finite inputs unless the exact value overflows.
fn compositing<T: Scalar>(sigma: &[f64], delta: &[f64], colour: &[f64], log: bool) -> Outcome {
    let n = sigma.len();
    let tape = Tape::new();
    let (density, features) = (tape.leaf(vector::<T>(sigma)), tape.leaf(tensor::<T>(&[n, 1], colour)));
    let (lengths, segments) = (vector::<T>(delta), Segments::uniform(1, n));
    let op = || if log { OpticalDepth::of_log_density(lengths.clone()) } else { OpticalDepth::new(lengths.clone()) };
    let scan = Weights::new(segments.clone());
    let x = op().forward(&[density.value()], tape.pool());
    let (transmittance, weights) = (scan.transmittance(&x, tape.pool()), scan.forward(&[&x], tape.pool()));
    let (transmittance, weights) = (numbers(&transmittance), numbers(&weights));
    prop_assert!(transmittance.iter().chain(&weights).all(|x| (0.0..=1.0).contains(x)));
    prop_assert!(transmittance.windows(2).all(|pair| pair[1] <= pair[0]));
    let out = composite(op(), &segments, [&density, &features]);
    let values = numbers(out.value());
    prop_assert!(
        (weights.iter().sum::<f64>() + values[1] - 1.0).abs() <= by_type::<T>(1e-6, 1e-14),
        "{weights:?} {values:?}"
    );
    prop_assert!((-1e-7..=1.0 + 1e-6).contains(&values[0]), "{values:?}");
    let grads = out.slice_axis(1, ..1).sum().grad(&[&density, &features]);
    prop_assert!(grads.iter().all(Tensor::is_finite), "{grads:?}");
    // And by plain operations, differentiated twice, where nothing overflows.
    if delta.iter().all(|&d| d < 1e3) && sigma.iter().all(|&s| s < 20.0) {
        let first = volume::weights(&tape.apply(op(), &[&density]), &segments).sum().grad_graph(&[&density]).remove(0);
        prop_assert!(first.value().is_finite());
        prop_assert!(first.sum().grad(&[&density])[0].is_finite());
    }
    Ok(())
}

/// Activations are monotone and bounded, with finite gradients.
fn activations<T: Scalar>(a: f64, b: f64) -> Outcome {
    let (low, high) = (round::<T>(a.min(b)), round::<T>(a.max(b)));
    let tape = Tape::new();
    let x = tape.leaf(vector::<T>(&[low, high, -low]));
    let (s, p) = (x.sigmoid(), x.softplus());
    let (s_values, p_values) = (numbers(s.value()), numbers(p.value()));
    // Two ULPs for the functions' own rounding.
    let (more, less) = (1.0 + 2.0 * T::EPSILON, 1.0 - 2.0 * T::EPSILON);
    prop_assert!(s_values[0] <= s_values[1] * more && s_values.iter().all(|s| (0.0..=1.0).contains(s)));
    prop_assert!((s_values[0] + s_values[2] - 1.0).abs() <= 2.0 * T::EPSILON);
    prop_assert!(p_values[0] <= p_values[1] * more);
    prop_assert!(p_values.iter().zip([low, high, -low]).all(|(p, x)| *p >= x.max(0.0) * less));
    for y in [s, p, x.log_sigmoid(), x.tanh(), x.silu(), x.gelu(), x.relu()] {
        finite("slope", &y.sum().grad(&[&x])[0]);
    }
    Ok(())
}

/// Directions have length 1, contracted points are in the ball of radius 2, and codes are finite; gradients are finite.
fn points<T: Scalar>(point: [f64; 3]) -> Outcome {
    let point = point.map(|x| round::<T>(x).clamp(-greatest::<T>(), greatest::<T>()));
    let tape = Tape::new();
    let x = tape.leaf(tensor::<T>(&[1, 3], &point));
    let length = |y: &Var<'_, T>| numbers(y.value()).iter().map(|y| y * y).sum::<f64>().sqrt();
    let unit = x.normalize();
    prop_assert!(point == [0.0; 3] || (length(&unit) - 1.0).abs() <= 4.0 * T::EPSILON, "{}", length(&unit));
    let inside = contract(&x);
    prop_assert!(length(&inside) < 2.0);
    let encoded = tape.apply(PositionalEncoding { levels: 12, input: false }, &[&x]);
    prop_assert!(numbers(encoded.value()).iter().all(|y| y.abs() <= 1.0));
    for y in [unit, inside] {
        prop_assert!(y.value().is_finite() && y.sum().grad(&[&x])[0].is_finite(), "{:?}", y);
    }
    let near = tape.leaf(tensor::<T>(&[1, 3], &point.map(|x| x.clamp(-1e10, 1e10))));
    for y in [srgb_encode(&near), srgb_decode(&near)] {
        prop_assert!(y.value().is_finite() && y.sum().grad(&[&near])[0].is_finite(), "{:?}", y);
    }
    Ok(())
}

/// A rotation vector of any direction, and of any angle that has digits, gives a rotation.
fn rotations<T: Scalar>(vector: [f64; 3]) -> Outcome {
    let vector = vector.map(|x| round::<T>(x).clamp(-100.0, 100.0));
    let tape = Tape::new();
    let x = tape.leaf(tensor::<T>(&[1, 3], &vector));
    let matrix = rotation_exp(&x);
    // The angle's error is that of its square times the angle.
    let angle = vector.iter().map(|x| x * x).sum::<f64>().sqrt();
    let skew = skewness(&numbers(matrix.value()));
    prop_assert!(skew <= by_type::<T>(1e-6, 3e-15) * (1.0 + angle), "{:e}", skew);
    let first = matrix.sum().grad_graph(&[&x]).remove(0);
    prop_assert!(first.value().is_finite() && first.sum().grad(&[&x])[0].is_finite());
    Ok(())
}

fn histogram<T: Scalar>(weights: &[f64], share: f64, u: &[f64]) -> Outcome {
    let weights: Vec<T> = weights.iter().map(|&w| T::from_f64(w)).collect();
    let good = weights.iter().all(|w| Scalar::is_finite(*w) && *w >= T::ZERO);
    let mut out = vec![0.5; u.len()];
    prop_assert_eq!(invert_cdf(&even_edges(weights.len()), &weights, share, u, &mut out).is_ok(), good);
    prop_assert!(out.is_sorted() && out.iter().all(|x| (0.0..=1.0).contains(x)), "{:?}", out);
    Ok(())
}

fn distorted<T: Scalar>(weights: &[f64], gaps: &[f64]) -> Outcome {
    let n = weights.len().min(gaps.len());
    let mut at = 0.0;
    let m: Vec<f64> = gaps[..n]
        .iter()
        .map(|gap| {
            at += gap;
            at
        })
        .collect();
    let tape = Tape::new();
    let w = tape.leaf(vector::<T>(&weights[..n]));
    let op = Distortion::new(vector::<T>(&m), vector::<T>(&gaps[..n]), Segments::uniform(1, n));
    let loss = tape.apply(op, &[&w]);
    let slopes = loss.sum().grad(&[&w]).remove(0);
    prop_assert!(loss.sum().item().to_f64() >= 0.0 && slopes.is_finite());
    prop_assert!(numbers(&slopes).iter().all(|s| *s >= 0.0));
    Ok(())
}

/// Positions in the grid's cube or outside of it never read out of bounds, and weights sum to 1.
fn grid_cells<T: Scalar>(points: &[[f64; 3]]) -> Outcome {
    let config = HashGridConfig { levels: 4, features: 1, log2_table: 8, coarsest: 2, finest: 65_536 };
    let grid = HashGrid::new(&config).unwrap();
    let tape = Tape::new();
    let x = tape.leaf(tensor::<T>(&[points.len(), 3], points.as_flattened()));
    let table = tape.leaf(Tensor::ones(grid.shape()));
    let y = tape.apply(HashEncoding::new(grid.clone()), &[&x, &table]);
    for (row, point) in numbers(y.value()).chunks_exact(4).zip(points) {
        let bad = point.iter().any(|x| x.is_nan());
        prop_assert!(
            row.iter().all(|y| if bad { y.is_nan() } else { (y - 1.0).abs() <= by_type::<T>(2e-7, 4e-16) }),
            "{:?} {:?}",
            point,
            row
        );
    }
    let grads = y.sum().grad(&[&x, &table]);
    prop_assert!(points.as_flattened().iter().any(|x| x.is_nan()) || grads.iter().all(Tensor::is_finite));
    Ok(())
}

fn adam_steps<T: Scalar>(gradients: &[f64], table: bool) -> Outcome {
    let config = AdamConfig::default();
    let config = if table { AdamConfig { beta2: 0.99, eps: 1e-15, ..config } } else { config };
    let bound = super::optimizer::bound(&config);
    let mut adam = Adam::<T>::new(config);
    let mut params = Params::new();
    let x = params.add("x", Tensor::zeros(&[1]));
    for &g in gradients {
        params.get_mut(x).as_mut_slice().fill(T::ZERO);
        let bad = !Scalar::is_finite(T::from_f64(g));
        let report = adam.update(&mut params, &[vector(&[g]).into()], 1.0);
        prop_assert_eq!((report.skipped, report.has_only_non_finite()), (usize::from(bad), bad));
        let way = params.get(x).item().to_f64().abs();
        prop_assert!(way <= bound * (1.0 + 1e-5) && !(bad && way != 0.0), "{:e} after a gradient of {:e}", way, g);
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, ..ProptestConfig::default() })]

    #[test]
    fn compositing_is_bounded_with_finite_gradients(
        rows in prop::collection::vec((positive(), positive(), 0.0..1.0_f64), 0..12),
        logs in prop::collection::vec((any_finite(), positive(), 0.0..1.0_f64), 0..12),
    ) {
        for (rows, log) in [(rows, false), (logs, true)] {
            let of = |f: fn(&(f64, f64, f64)) -> f64| rows.iter().map(f).collect::<Vec<_>>();
            let (sigma, delta, colour) = (of(|row| row.0), of(|row| row.1), of(|row| row.2));
            in_both!(compositing(&sigma, &delta, &colour, log));
        }
    }

    #[test]
    fn activations_are_monotone_with_finite_gradients(a in any_finite(), b in any_finite()) {
        in_both!(activations(a, b));
    }

    #[test]
    fn points_of_any_size(point in prop::array::uniform3(any_finite())) {
        in_both!(points(point));
    }

    #[test]
    fn rotations_of_any_size(vector in prop::array::uniform3(any_finite())) {
        in_both!(rotations(vector));
    }

    #[test]
    fn histograms_of_any_size(
        weights in prop::collection::vec(any_number(), 1..12), share in 0.0..=1.0_f64,
        mut u in prop::collection::vec(0.0..1.0_f64, 0..12),
    ) {
        u.sort_by(f64::total_cmp);
        in_both!(histogram(&weights, share, &u));
        let weights: Vec<f64> = weights.into_iter().map(|w| if w.is_finite() { w.abs() } else { 0.0 }).collect();
        in_both!(histogram(&weights, share, &u));
    }

    #[test]
    fn distortion_is_positive_with_finite_gradients(
        weights in prop::collection::vec(0.0..1.0_f64, 0..12), gaps in prop::collection::vec(positive(), 0..12),
    ) {
        let gaps: Vec<f64> = gaps.into_iter().map(|gap| gap.min(1e30)).collect();
        in_both!(distorted(&weights, &gaps));
    }

    #[test]
    fn grid_cells_of_any_place(points in prop::collection::vec(prop::array::uniform3(any_number()), 1..5)) {
        in_both!(grid_cells(&points));
    }

    #[test]
    fn adam_never_oversteps(gradients in prop::collection::vec(any_number(), 1..40), table in prop::bool::ANY) {
        in_both!(adam_steps(&gradients, table));
    }

    #[test]
    fn boxes_and_rays_of_any_size(
        o in prop::array::uniform3(any_number()), d in prop::array::uniform3(any_number()),
        a in prop::array::uniform3(any_finite()), b in prop::array::uniform3(any_finite()),
    ) {
        let (ray, a, b) = (Ray { origin: o.into(), direction: d.into() }, DVec3::from(a), DVec3::from(b));
        let bounds = [a.min(b), a.max(b)];
        if let Some([enter, leave]) = intersect_box(&ray, bounds) {
            prop_assert!(0.0 <= enter && enter <= leave, "{} {}", enter, leave);
        }
        let turned = |v: DVec3| DVec3::new(v.z, v.x, v.y);
        let other = Ray { origin: turned(ray.origin), direction: turned(ray.direction) };
        prop_assert_eq!(intersect_box(&ray, bounds), intersect_box(&other, bounds.map(turned)));
    }

    #[test]
    fn projections_and_lenses_of_any_size(
        o in prop::array::uniform3(any_number()), d in prop::array::uniform3(any_number()),
        k in prop::array::uniform2(any_number()), r in any_number(),
    ) {
        let camera = |eye: [f64; 3], d: [f64; 3]| {
            Camera::from_angle(40, 30, 0.8, Camera::look_at(eye.into(), DVec3::from(eye) + DVec3::from(d), DVec3::Z))
        };
        // Close to each other, relative to their size. Most are not forward-facing, and none panics.
        let beside = [o[0], o[1] * (1.0 + 1e-3), o[2]];
        if let Ok(ndc) = Ndc::around(&[camera(o, d), camera(beside, d)], r.abs()) {
            prop_assert!(ndc.slopes.iter().all(|slope| (0.1..10.0).contains(slope)), "{:?}", ndc);
        }
        let lens = Lens::Brown { k: [k[0], k[1], 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] };
        if lens.check().is_ok() && r.is_finite() {
            let nearest = lens.nearest([r, 0.0]);
            prop_assert!((nearest.length() - 1.0).abs() < 1e-9 && nearest.z >= 0.0, "{}", nearest);
            let undone = lens.direction([r, 0.0]).and_then(|direction| lens.place(direction));
            if let Some([again, _]) = undone {
                prop_assert!((again - r).abs() <= 1e-9 * r.abs() + f64::MIN_POSITIVE, "{} {}", again, r);
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 100, ..ProptestConfig::default() })]

    #[test]
    fn marches_of_any_ray_end(
        o in prop::array::uniform3(any_number()), d in prop::array::uniform3(any_number()),
        span in prop::array::uniform2(any_number()), length in positive(), cone in prop_oneof![Just(0.0), 0.0..1.0_f32],
    ) {
        let config = OccupancyConfig { resolution: 16, ..OccupancyConfig::default() };
        let grid = OccupancyGrid::new([DVec3::NEG_ONE, DVec3::ONE], &config).unwrap();
        let mut rays = Rays::<f32>::new();
        rays.push(&Ray { origin: o.into(), direction: d.into() }, span);
        let step = Step { length: length as f32, cone, max_samples: 10_000 };
        prop_assume!(step.check().is_ok());
        let mut out = MarchBuffer::default();
        grid.march(&rays, &step, &mut Jitter::Middle, &mut out);
        prop_assert!(out.t.len() <= 10_000 && out.t.is_sorted() && out.t.iter().all(|t| t.is_finite()));
    }
}

/// `.cargo/config.toml` sets the seed, so that a run that passes here passes elsewhere.
#[test]
fn random_cases_have_a_seed() {
    assert!(matches!(ProptestConfig::default().rng_seed, proptest::test_runner::RngSeed::Fixed(_)));
}
