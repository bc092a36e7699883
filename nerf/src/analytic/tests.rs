//! The closed forms, compared with numerical integrals of 25 digits and with renders.

use super::*;
use crate::camera::rays::stratified;
use crate::camera::rays::{Rays, Samples};
use crate::random::Jitter;
use crate::volume::quadrature::Quadrature;
use crate::volume::query::Query;
use raygrad_autograd::{Pool, Tape};
use raygrad_nn::Params;

/// The lines of `tests/reference/analytic.py`: colour, depth, transmittance, and the derivatives of these by each
/// amplitude in turn.
fn reference() -> Vec<(&'static str, Vec<f64>)> {
    let number = |text: &str| text.parse().unwrap();
    let lines = include_str!("../../tests/reference/analytic.tsv").lines();
    let lines = lines.map(|line| line.split_once('\t').unwrap());
    lines.map(|(name, values)| (name, values.split('\t').map(number).collect())).collect()
}

#[test]
fn closed_forms_equal_numerical_integrals() {
    let (scenes, reference) = (scenes(), reference());
    assert_eq!(scenes.len(), reference.len());
    for (scene, (name, expected)) in scenes.iter().zip(reference) {
        assert_eq!(scene.name, name);
        let exact = &scene.exact;
        let amplitudes = scene.medium.amplitudes().len();
        let d = |k: usize| [exact.d_color[k], exact.d_depth[k], exact.d_transmittance[k]];
        let values = [exact.color, exact.depth, exact.transmittance];
        let got: Vec<f64> = values.into_iter().chain((0..amplitudes).flat_map(d)).collect();
        assert_eq!(got.len(), expected.len(), "{name}");
        for (i, (got, expected)) in got.iter().zip(&expected).enumerate() {
            // The Gaussian is integrated numerically.
            let tolerance = if name.ends_with("gaussian") { 1e-12 } else { 4e-15 };
            let error = (got - expected).abs() / expected.abs().max(0.25);
            assert!(error <= tolerance, "{name}, {i}: {got:e} {expected:e}");
        }
    }
}

#[test]
fn closed_forms_equal_known_constants() {
    let scenes = scenes();
    let find = |name: &str| scenes.iter().find(|scene| scene.name == name).unwrap();
    let near = |a: f64, b: f64| assert!((a - b).abs() <= 1e-14, "{a} {b}");
    near(find("constant").exact.color, 0.801_103_312_884_152_1);
    near(find("constant").exact.d_color[0], -4.413_251_536_608_618e-3);
    near(find("constant").exact.depth, 0.742_921_000_454_833_2);
    near(find("linear colour").exact.color, 0.315_851_401_604_833_6);
    near(find("exponential").exact.color, 0.591_683_322_180_671);
    near(find("exponential").exact.d_color[0], 0.013_230_428_899_296_11);
    near(find("gaussian").exact.color, 0.274_998_883_815_041_5);
    near(find("slabs").exact.color, 0.544_404_452_968_719_9);
    near(find("slabs").exact.d_color[0], 0.213_357_328_218_768_1);
    near(1.0 - find("sphere").exact.transmittance, 0.909_282_046_710_587_5);
}

#[test]
fn ball_covers_the_expected_image_share() {
    let ball = Ball { centre: DVec3::ZERO, radius: 0.5, sigma: 3.0, color: 1.0 };
    // pi R^2 - pi (1 - e^(-2 sigma R) (1 + 2 sigma R)) / (2 sigma^2)
    let expected = 0.645_623_168_915_405_2;
    // By rings whose half chord is h: p dp = -h dh, and everything is smooth in h.
    let n = 1000;
    let ring = |i: usize| {
        let half_chord = 0.5 * (i as f64 + 0.5) / n as f64;
        let p = (0.25 - half_chord * half_chord).sqrt();
        let ray = Ray { origin: DVec3::new(0.0, p, -2.0), direction: DVec3::Z };
        let opacity = 1.0 - ball.along(&ray).exact(4.0, 0.0).transmittance;
        std::f64::consts::TAU * half_chord * opacity * 0.5 / n as f64
    };
    let sum: f64 = (0..n).map(ring).sum();
    assert!((sum - expected).abs() < 2e-6, "{sum}");
    let beside = Ray { origin: DVec3::new(0.0, 0.5, -2.0), direction: DVec3::Z };
    assert_eq!(ball.along(&beside).exact(4.0, 0.25).color, 0.25, "a ray that touches it sees the background");
}

#[test]
fn layer_beyond_the_ray_is_invisible() {
    let layer = |from, to| Layer { from, to, sigma: 2.0, color: [0.5, 0.0] };
    let cut = Layers::new(&[layer(-2.0, -1.0), layer(1.0, 3.0), layer(5.0, 6.0)]).exact(2.0, 1.0);
    let whole = Layers::new(&[layer(1.0, 2.0)]).exact(2.0, 1.0);
    assert_eq!([cut.color, cut.depth, cut.transmittance], [whole.color, whole.depth, whole.transmittance]);
    assert_eq!(cut.d_color, [0.0, whole.d_color[0], 0.0]);
}

#[test]
fn analytic_fields_render_with_gradients() {
    for scene in scenes() {
        let mut params = Params::<f64>::new();
        let field = AnalyticField::new(scene.medium.clone(), &mut params);
        let mut rays = Rays::new();
        rays.push(&scene.ray, [0.0, scene.length]);
        let samples: Samples<f64> = stratified(&rays, 1 << 15, &mut Jitter::Middle, &Pool::new());
        let tape = Tape::new();
        let bound = params.bind(&tape);
        let seen = Quadrature::Midpoint.render_nodes(&Query::new(&field, &bound), samples);
        let (left, depth) = (seen.transmittance().sum(), seen.depth().sum());
        let color = seen.color.slice_axis(1, 1..2).sum() + &left * scene.background;
        let opacity = seen.opacity().item();
        assert!((opacity + left.item() - 1.0).abs() < 1e-14 && (seen.weights.sum().item() - opacity).abs() < 1e-12);
        let near = |what: &str, got: f64, expected: f64| {
            assert!(
                (got - expected).abs() <= 4e-4 * expected.abs().max(0.1),
                "{} {what}: {got} {expected}",
                scene.name
            );
        };
        near("colour", color.item(), scene.exact.color);
        near("depth", depth.item(), scene.exact.depth);
        near("transmittance", left.item(), scene.exact.transmittance);
        for (value, d, what) in [
            (&color, &scene.exact.d_color, "d colour"),
            (&depth, &scene.exact.d_depth, "d depth"),
            (&left, &scene.exact.d_transmittance, "d transmittance"),
        ] {
            let got = &value.grad(&bound.vars())[0];
            got.as_slice().iter().zip(d).for_each(|(got, d)| near(what, *got, *d));
        }
        let [low, high] = scene.bounds();
        assert!(scene.ray.at(1.0).cmpgt(low).all() && scene.ray.at(1.0).cmplt(high).all());
        assert!(scene.at(2.15)[0] > 0.0 || scene.name == "slabs");
    }
}
