//! Convergence on scenes with exact solutions, and gradients.

use super::*;
use crate::analytic::{AnalyticField, AnalyticScene, Integral, Layer, Layers, integrate, scenes};
use crate::camera::pinhole::Ray;
use crate::camera::rays::Rays;
use crate::camera::rays::stratified;
use crate::dataset::{Split, sample::ball};
use crate::field::{FieldConfig, VoxelConfig};
use crate::imaging::metrics::psnr;
use crate::model::{Config, Preset};
use crate::random::Jitter;
use crate::sampling::marching::MarchingConfig;
use crate::training::trainer::Trainer;
use crate::volume::early_termination::VisibleSamples;
use crate::volume::query::Query;
use glam::DVec3;
use raygrad_autograd::{Tape, Tensor};
use raygrad_nn::Params;
use std::sync::Arc;

fn find(name: &str) -> AnalyticScene {
    scenes().into_iter().find(|scene| scene.name == name).unwrap()
}

const RULES: [Quadrature; 4] =
    [Quadrature::Left, Quadrature::Midpoint, Quadrature::PiecewiseLinear, Quadrature::Gauss2];

#[test]
fn errors_at_128_evaluations_equal_the_table() {
    let table = [
        ("exponential", [5.1e-3, 8.9e-5, 5.8e-5, 2.4e-8]),
        ("gaussian", [4.8e-5, 4.8e-5, 4.9e-5, 1.2e-7]),
        ("narrow gaussian", [1.0e-2, 1.2e-2, 8.5e-3, 8.2e-3]),
        ("slabs", [2.0e-3, 9.0e-3, 1.5e-3, 9.0e-3]),
    ];
    for (name, expected) in table {
        let scene = find(name);
        for (rule, expected) in RULES.into_iter().zip(expected) {
            let seen = integrate::<f64>(&scene, rule, 128);
            let error = (seen.color - scene.exact.color).abs();
            println!("{name:16} {rule:16} {error:.2e}");
            assert!(seen.evaluations <= 128, "{name}, {rule}: {} evaluations", seen.evaluations);
            assert!((error / expected - 1.0).abs() <= 0.06, "{name}, {rule}: {error:e} for {expected:e}");
        }
    }
}

/// The slope of errors over evaluations in a log-log plot, by least squares.
fn slope(points: &[(f64, f64)]) -> f64 {
    let n = points.len() as f64;
    let logs = || points.iter().map(|(x, y)| (x.ln(), y.ln()));
    let (mx, my) = (logs().map(|p| p.0).sum::<f64>() / n, logs().map(|p| p.1).sum::<f64>() / n);
    logs().map(|(x, y)| (x - mx) * (y - my)).sum::<f64>() / logs().map(|(x, _)| (x - mx).powi(2)).sum::<f64>()
}

/// A name, the exact value, and the computed one.
type Quantity = (&'static str, f64, fn(&Integral) -> f64);

#[test]
fn rules_converge_with_their_order() {
    // A smooth scene with an abrupt end, so that errors do not cancel.
    let scene = find("exponential");
    for rule in RULES {
        let order = f64::from(rule.order().unwrap());
        let sizes = [64, 96, 128, 192, 256];
        let seen: Vec<(f64, Integral)> = sizes.map(|n| (n as f64, integrate::<f64>(&scene, rule, n))).into();
        let exact = &scene.exact;
        let quantities: [Quantity; 5] = [
            ("colour", exact.color, |seen| seen.color),
            ("depth", exact.depth, |seen| seen.depth),
            ("transmittance", exact.transmittance, |seen| seen.transmittance),
            ("d colour", exact.d_color[0], |seen| seen.d_color[0]),
            ("d depth", exact.d_depth[0], |seen| seen.d_depth[0]),
        ];
        for (what, exact, value) in quantities {
            // Gauss's rule has half as many intervals, with the same slope.
            let points: Vec<_> = seen.iter().map(|(n, seen)| (*n, (value(seen) - exact).abs())).collect();
            let found = -slope(&points);
            println!("{rule:16} {what:14} order {found:.3}");
            assert!((found - order).abs() <= 0.2, "{rule}, {what}: order {found} for {order}, {points:?}");
        }
    }
}

#[test]
fn rules_are_exact_for_constant_media() {
    for rule in RULES {
        let scene = find("constant");
        let seen = integrate::<f64>(&scene, rule, 16);
        assert!((seen.color - scene.exact.color).abs() < 1e-14, "{rule}: {}", seen.color);
        assert!((seen.d_color[0] - scene.exact.d_color[0]).abs() < 1e-14, "{rule}");
    }
}

#[test]
fn gauss_rule_integrates_linear_colour_exactly() {
    let scene = find("linear colour");
    for intervals in [8, 16, 33] {
        let seen = integrate::<f64>(&scene, Quadrature::Gauss2, 2 * intervals);
        let exact = &scene.exact;
        assert!((seen.color - exact.color).abs() < 1e-14 && (seen.depth - exact.depth).abs() < 1e-14);
        assert!((seen.d_depth[0] - exact.d_depth[0]).abs() < 1e-13, "{} {}", seen.d_depth[0], exact.d_depth[0]);
    }
}

/// The Gauss share of one interval.
fn share(a: f64, b: f64, x: f64) -> f64 {
    let tape = Tape::new();
    let [a, b, x] = [a, b, x].map(|value| tape.constant(Tensor::full(&[1], value)));
    gauss_share(&a, &b, &x).item()
}

#[test]
fn gauss_share_is_smooth_and_never_extrapolates() {
    for x in [1e-12, 1e-3, 0.499_999_999, 0.5, 0.500_000_001, 3.0] {
        let [below, at, above] = [x * (1.0 - 1e-9), x, x * (1.0 + 1e-9)].map(|x| share(1.0, 1.0, x));
        assert!((above - below).abs() < 1e-8 && at <= 0.5, "{x}");
    }
    assert_eq!(share(0.0, 0.0, 0.0), 0.5);
    assert!((share(2.0, 1.0, 1e-9) - 1.0 / 3.0).abs() < 1e-9);
    for (a, b) in [(1.0, 0.0), (0.0, 1.0), (3.0, 5.0), (1e-30, 1e30), (1e30, 1e30)] {
        for x in [0.0, 1e-6, 0.7, 5.0, 100.0, 1e30, f64::INFINITY] {
            assert!((0.0..=1.0).contains(&share(a, b, x)), "{a} {b} {x}");
        }
    }
    assert_eq!(share(1.0, 1.0, 50.0), 0.0, "behind the first node of an opaque interval nothing shows");
}

#[test]
fn adaptive_quadrature_stays_near_its_tolerance() {
    for (name, tolerance, most, at_most) in [
        ("slabs", 1e-6, 180, 3e-7),
        ("narrow gaussian", 1e-7, 870, 1.3e-6),
        ("gaussian", 1e-6, 410, 3e-6),
        ("linear colour", 1e-6, 145, 1e-5),
        ("sphere", 1e-6, 130, 5e-7),
    ] {
        let scene = find(name);
        let seen = integrate::<f64>(&scene, Quadrature::Adaptive { tolerance }, 32);
        let error = (seen.color - scene.exact.color).abs();
        let d_error = (seen.d_color[0] - scene.exact.d_color[0]).abs();
        println!("{name:16} {tolerance:e}: {error:.1e}, gradient {d_error:.1e} with {} evaluations", seen.evaluations);
        assert!(error <= at_most && seen.evaluations <= most, "{name}: {error:e}, {}", seen.evaluations);
        let even = integrate::<f64>(&scene, Quadrature::PiecewiseLinear, seen.evaluations);
        let factor = (even.color - scene.exact.color).abs() / error;
        assert!(factor > 1.0, "{name}: even intervals are better by {}", 1.0 / factor);
    }
}

#[test]
fn single_precision_error_is_rounding() {
    for scene in scenes() {
        for rule in RULES.into_iter().chain([Quadrature::Adaptive { tolerance: 1e-4 }]) {
            let [single, double] = [integrate::<f32>(&scene, rule, 64), integrate::<f64>(&scene, rule, 64)];
            // A node within an ULP of a layer's edge may fall on the other side.
            let edges = scene.exact.d_color.len() > 1 || scene.name == "sphere";
            let bound = if edges { 3e-2 } else { 2e-6 };
            let values = |seen: &Integral| [seen.color, seen.depth, seen.transmittance];
            for (a, b) in values(&single).into_iter().zip(values(&double)) {
                assert!((a - b).abs() <= bound, "{}, {rule}: {a} {b}", scene.name);
            }
        }
    }
}

/// A small voxel model of the embedded scene.
fn small(rule: Quadrature) -> Config {
    let mut config = Config::preset(Preset::Voxel);
    config.field = FieldConfig::new(VoxelConfig { resolution: 20, direction_degree: 1 });
    let Some(sampler) = config.sampler.get_mut::<MarchingConfig>() else { panic!() };
    (sampler.step, sampler.samples, sampler.occupancy.resolution) = (0.02, 2048, 32);
    sampler.quadrature = rule;
    config
}

#[test]
fn rules_train_and_are_configurable() {
    let data = Arc::new(ball(Split::Train, 20));
    for rule in RULES.into_iter().chain([Quadrature::Adaptive { tolerance: 1e-2 }]) {
        let config = small(rule);
        let text = serde_json::to_string(&config).unwrap();
        assert_eq!(serde_json::from_str::<Config>(&text).unwrap(), config, "{text}");
        let mut trainer = Trainer::new(config, data.clone()).unwrap();
        let first = trainer.step(0.0);
        let last = (1..60).map(|step| trainer.step(f64::from(step) / 60.0).loss).last().unwrap();
        println!("{rule:16} loss {:.4} to {last:.4}, {} samples", first.loss, trainer.stats().density_queries);
        assert!(last < 0.6 * first.loss, "{rule}: {} to {last}", first.loss);
        let frame = &data.frames[0];
        let seen = psnr(&trainer.model.render(&frame.camera, [1.0; 3]).color, &frame.image.over([1.0; 3]));
        assert!(seen > 14.0, "{rule}: {seen} dB");
    }
    let bad = small(Quadrature::Adaptive { tolerance: 0.0 }).check().unwrap_err().to_string();
    assert!(
        bad.contains("quadrature.adaptive.tolerance") && bad.contains("1e-9") || bad.contains("0.000000001"),
        "{bad}"
    );
}

#[test]
fn config_without_quadrature_choice_is_read() {
    let mut value = serde_json::to_value(small(Quadrature::Midpoint)).unwrap();
    value["sampler"].as_object_mut().unwrap().remove("quadrature").unwrap();
    assert_eq!(serde_json::from_value::<Config>(value).unwrap(), small(Quadrature::Midpoint));
}

#[test]
fn early_termination_error_is_within_its_bound() {
    // A wall in front of everything else.
    let layer = |from, to, color| Layer { from, to, sigma: 40.0, color: [color, 0.0] };
    let medium = Arc::new(Layers::new(&[layer(1.0, 1.5, 0.8), layer(2.0, 3.0, 0.1)]));
    let mut params = Params::<f64>::new();
    let field = AnalyticField::new(medium, &mut params);
    let mut rays = Rays::new();
    rays.push(&Ray { origin: DVec3::ZERO, direction: DVec3::Z }, [0.0, 4.0]);
    rays.push(&Ray { origin: DVec3::ZERO, direction: DVec3::Z }, [0.0, 0.5]);
    let tape = Tape::new();
    let bound = params.bind(&tape);
    let steps = stratified(&rays, 64, &mut Jitter::Middle, tape.pool());
    for rule in RULES.into_iter().chain([Quadrature::Adaptive { tolerance: 1e-3 }]) {
        let [all, lit] = [0.0, 1e-4].map(|least| rule.render(&Query::new(&field, &bound), &steps, least));
        // The second ray meets no density and keeps all of its samples.
        assert!(
            4 * lit.visible < 3 * all.visible && lit.density_queries <= all.density_queries,
            "{rule}: {} of {}",
            lit.visible,
            all.visible
        );
        let values = |seen: &VisibleSamples<'_, f64>| {
            let seen = &seen.rendered;
            [seen.color.clone(), seen.depth(), seen.transmittance()]
                .map(|value| value.value().as_slice().to_vec())
                .concat()
        };
        for (a, b) in values(&all).into_iter().zip(values(&lit)) {
            assert!((a - b).abs() <= 4.0 * 1e-4, "{rule}: {a} {b}");
        }
        let gradient =
            |seen: &VisibleSamples<'_, f64>| seen.rendered.color.slice_axis(1, ..1).sum().grad(&bound.vars()).remove(0);
        for (a, b) in gradient(&all).as_slice().iter().zip(gradient(&lit).as_slice()) {
            assert!((a - b).abs() <= 1e-3, "{rule}: {a} {b}");
        }
    }
}
