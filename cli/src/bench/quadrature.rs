//! Quadrature rules for the integral along a ray: error against evaluations and time, on scenes with exact solutions.

use std::hint::black_box;

use raygrad::nerf::analytic::{AnalyticScene, scenes};
use raygrad::nerf::analytic::{Integral, integrate};
use raygrad::nerf::camera::stratified;
use raygrad::nerf::volume::accumulate;
use raygrad::nerf::volume::quadrature::Quadrature;
use raygrad::nerf::{Density, Jitter, Rays, Samples};
use raygrad::{Pool, Real, Tape, Tensor, Var};

use super::Results;
use super::figure::{Axis, Figure, Panel, Series};
use super::stopwatch::{Timed, compare};
use super::table::{Table, digits};

const RULES: [Quadrature; 4] =
    [Quadrature::Left, Quadrature::Midpoint, Quadrature::PiecewiseLinear, Quadrature::Gauss2];
/// Initial intervals of the adaptive rule.
const FIRST: usize = 32;
/// Rays per call of compositing.
const RAYS: usize = 64;

/// Quantities that are compared.
const QUANTITIES: [&str; 3] = ["colour", "depth", "gradient"];

/// Result of one rule on one scene.
struct Point {
    scene: &'static str,
    rule: String,
    style: usize,
    /// Requested evaluations, the key of the times.
    size: usize,
    evaluations: usize,
    errors: [f64; 3],
}

/// Benchmarks all rules on all scenes.
pub fn run(quick: bool) -> Results {
    let sizes: &[usize] = if quick { &[8, 16, 32, 64, 128, 256] } else { &[8, 16, 32, 64, 128, 256, 512, 1024] };
    let scenes = scenes();
    let points = points(&scenes, sizes, quick);
    let times = times(sizes, quick);
    let mut errors = Table::new(
        "quadrature",
        &["scene", "rule", "evaluations", "colour error", "depth error", "gradient error", "ns per ray"],
    );
    let time_of = |point: &Point| {
        let same = times.iter().find(|time| time.rule == point.rule && time.size == point.size);
        same.map_or(f64::NAN, |time| 1e9 * time.both.seconds / RAYS as f64)
    };
    for point in &points {
        let errors_of = point.errors.map(digits);
        let row = [point.scene.to_owned(), point.rule.clone(), point.evaluations.to_string()];
        errors.push(row.into_iter().chain(errors_of).chain([digits(time_of(point))]).collect());
    }
    let figures = vec![
        error_figure(&scenes, &points, 0),
        error_figure(&scenes, &points, 1),
        error_figure(&scenes, &points, 2),
        time_figure(&scenes, &points, &time_of),
    ];
    Results { findings: findings(&points), figures, tables: vec![at_128(&scenes, &points), errors, time_table(&times)] }
}

fn points(scenes: &[AnalyticScene], sizes: &[usize], quick: bool) -> Vec<Point> {
    let tolerances: &[f64] = if quick { &[1e-3, 1e-5] } else { &[1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7] };
    let mut out = vec![];
    for scene in scenes {
        let mut add = |rule: Quadrature, name: String, style: usize, size: usize| {
            let seen = integrate::<f64>(scene, rule, size);
            let (evaluations, errors) = (seen.evaluations, errors_of(scene, &seen));
            out.push(Point { scene: scene.name, rule: name, style, size, evaluations, errors });
        };
        for (style, rule) in RULES.into_iter().enumerate() {
            sizes.iter().for_each(|&size| add(rule, rule.to_string(), style, size));
        }
        for &tolerance in tolerances {
            add(Quadrature::Adaptive { tolerance }, "adaptive".to_owned(), RULES.len(), FIRST);
        }
    }
    out
}

/// Errors of colour and depth, and the largest error of the colour's gradient.
fn errors_of(scene: &AnalyticScene, seen: &Integral) -> [f64; 3] {
    let exact = &scene.exact;
    let pairs = seen.d_color.iter().zip(&exact.d_color);
    // NaN propagates through the maximum.
    let largest = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, Real::maximum);
    [(seen.color - exact.color).abs(), (seen.depth - exact.depth).abs(), largest]
}

/// Times of compositing. They are independent of the scene, since densities and colours are inputs.
struct Cost {
    rule: String,
    size: usize,
    forward: Timed,
    both: Timed,
}

/// Inputs of compositing for a rule: densities, colours and the rule itself.
struct Work {
    rule: Quadrature,
    nodes: Samples<f32>,
    density: Tensor<f32>,
    color: Tensor<f32>,
}

impl Work {
    fn new(scene: &AnalyticScene, rule: Quadrature, size: usize) -> Self {
        let mut rays = Rays::<f32>::new();
        (0..RAYS).for_each(|_| rays.push(&scene.ray, [0.0, scene.length]));
        let nodes = rule.nodes(&stratified(&rays, rule.intervals(size), &mut Jitter::Middle, &Pool::new()));
        let at: Vec<[f64; 2]> = nodes.t.as_slice().iter().map(|&t| scene.at(t.into())).collect();
        let density = Tensor::from_fn(&[at.len()], |i| at[i][0] as f32);
        let color = Tensor::from_fn(&[at.len(), 3], |i| at[i / 3][1] as f32);
        Work { rule, nodes, density, color }
    }

    fn color<'t>(&self, value: Var<'t, f32>, features: &Var<'t, f32>) -> Var<'t, f32> {
        let density = Density { value, log: false, features: features.clone() };
        accumulate(&self.rule.weighted(&density, &self.nodes).weights, features, &self.nodes.segments)
    }

    fn forward(&self, tape: &Tape<f32>) {
        let [value, features] = [&self.density, &self.color].map(|x| tape.constant(x.clone()));
        black_box(self.color(value, &features));
    }

    fn both(&self, tape: &mut Tape<f32>) {
        let [value, features] = [&self.density, &self.color].map(|x| tape.leaf(x.clone()));
        let color = self.color(value.clone(), &features);
        black_box(color.sum().grad(&[&value, &features]));
        drop((value, features, color));
        tape.clear();
    }
}

fn times(sizes: &[usize], quick: bool) -> Vec<Cost> {
    let scenes = scenes();
    let Some(scene) = scenes.iter().find(|scene| scene.name == "exponential") else { return vec![] };
    let rounds = if quick { 5 } else { 25 };
    let mut out = vec![];
    for &size in sizes {
        let baseline = Work::new(scene, Quadrature::Midpoint, size);
        for rule in RULES {
            let work = Work::new(scene, rule, size);
            let [tape, other] = [Tape::new(), Tape::new()];
            // About a millisecond of repetitions.
            let repeats = (1 << 15) / (size * RAYS).max(1) + 1;
            let forward = |work: &Work, tape: &Tape<f32>| (0..repeats).for_each(|_| work.forward(tape));
            let each = |timed: Timed| Timed { seconds: timed.seconds / repeats as f64, ..timed };
            let forward = each(compare(rounds, || forward(&baseline, &tape), || forward(&work, &other)));
            let (mut tape, mut other) = (tape, other);
            let both = |work: &Work, tape: &mut Tape<f32>| (0..repeats).for_each(|_| work.both(tape));
            let both = each(compare(rounds, || both(&baseline, &mut tape), || both(&work, &mut other)));
            out.push(Cost { rule: rule.to_string(), size, forward, both });
        }
    }
    out
}

fn time_table(times: &[Cost]) -> Table {
    let mut table = Table::new(
        "quadrature-times",
        &[
            "rule",
            "evaluations",
            "forward, ns per ray",
            "forward and backward, ns per ray",
            "ratio to midpoint",
            "control",
            "control spread",
        ],
    );
    for Cost { rule, size, forward, both } in times {
        let each = |timed: &Timed| digits(1e9 * timed.seconds / RAYS as f64);
        let [ratio, control, spread] = [both.ratio, both.control, both.spread].map(digits);
        table.push(vec![rule.clone(), size.to_string(), each(forward), each(both), ratio, control, spread]);
    }
    table
}

/// Errors of the colour at 128 evaluations, one row per rule.
fn at_128(scenes: &[AnalyticScene], points: &[Point]) -> Table {
    let columns: Vec<&'static str> = std::iter::once("rule").chain(scenes.iter().map(|scene| scene.name)).collect();
    let mut table = Table::new("quadrature-128", &columns);
    for rule in RULES.map(|rule| rule.to_string()) {
        let of =
            |scene: &AnalyticScene| points.iter().find(|p| p.size == 128 && p.rule == rule && p.scene == scene.name);
        let errors = scenes.iter().map(|scene| of(scene).map_or(String::new(), |p| format!("{:.1e}", p.errors[0])));
        table.push(std::iter::once(rule.clone()).chain(errors).collect());
    }
    table
}

/// Points of each rule, sorted by evaluations.
fn series(scene: &AnalyticScene, points: &[Point], at: impl Fn(&Point) -> [f64; 2]) -> Vec<Series> {
    let own: Vec<&Point> = points.iter().filter(|point| point.scene == scene.name).collect();
    let mut out: Vec<Series> = vec![];
    for point in own {
        match out.iter_mut().find(|series| series.name == point.rule) {
            Some(series) => series.points.push(at(point)),
            None => out.push(Series::line(&point.rule, point.style, vec![at(point)])),
        }
    }
    out
}

fn panels(scenes: &[AnalyticScene], x: &str, y: &str, all: impl Fn(&AnalyticScene) -> Vec<Series>) -> Vec<Panel> {
    let panel = |scene: &AnalyticScene| Panel {
        title: scene.name.to_owned(),
        x: Axis::log(x),
        y: Axis::log(y),
        series: all(scene),
        labels: vec![],
    };
    scenes.iter().map(panel).collect()
}

/// Smallest error on the axis.
const FLOOR: f64 = 1e-16;

fn error_figure(scenes: &[AnalyticScene], points: &[Point], which: usize) -> Figure {
    let at = |point: &Point| [point.evaluations as f64, point.errors[which].max(FLOOR)];
    let what = QUANTITIES[which];
    Figure {
        name: format!("quadrature-{what}"),
        title: format!("Error of the {what} against evaluations per ray"),
        caption: format!(
            "Absolute error of the {what} in f64, on scenes with exact solutions. On smooth scenes the slope is the \
             order of the rule. At a jump in density all fixed-step rules have slope 1; only bisection finds the \
             jump. With constant colour every rule is exact."
        ),
        columns: 3,
        panel: [400, 290],
        panels: panels(scenes, "evaluations per ray", "absolute error", |scene| series(scene, points, at)),
    }
}

fn time_figure(scenes: &[AnalyticScene], points: &[Point], time_of: &dyn Fn(&Point) -> f64) -> Figure {
    let at = |point: &Point| [time_of(point), point.errors[0].max(FLOOR)];
    let fixed = |scene: &AnalyticScene| {
        let all = series(scene, points, at);
        all.into_iter().filter(|series| series.points.iter().all(|point| point[0].is_finite())).collect()
    };
    Figure {
        name: "quadrature-time".to_owned(),
        title: "Colour error against the time to composite a ray".to_owned(),
        caption:
            "Time to composite a ray and its gradient from given densities and colours, in f32 on one thread. Field \
             evaluations cost extra."
                .to_owned(),
        columns: 3,
        panel: [400, 290],
        panels: panels(scenes, "ns per ray, forward and backward", "absolute error", fixed),
    }
}

/// The best rule on each scene at 128 evaluations.
fn findings(points: &[Point]) -> Vec<String> {
    let at: Vec<&Point> = points.iter().filter(|point| point.size == 128).collect();
    let mut out = vec![];
    for first in at.iter().filter(|point| point.style == 0) {
        let own = at.iter().filter(|point| point.scene == first.scene);
        if let Some(best) = own.min_by(|a, b| a.errors[0].total_cmp(&b.errors[0])) {
            out.push(format!("{}: {} is best at 128 evaluations, error {:.1e}", best.scene, best.rule, best.errors[0]));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Limits errors and counts. Times are too noisy for limits.
    #[test]
    fn errors_quick_suite_are_within_limits() {
        let scenes = scenes();
        let points = points(&scenes, &[64, 128], true);
        assert_eq!(points.len(), scenes.len() * (2 * RULES.len() + 2));
        for point in &points {
            let fixed = point.rule != "adaptive";
            assert!(!fixed || point.evaluations <= point.size, "{}: {}", point.rule, point.evaluations);
            assert!(fixed || point.evaluations <= 500, "{}: {}", point.scene, point.evaluations);
            assert!(
                point.errors.iter().all(|error| *error <= 0.2),
                "{} {}: {:?}",
                point.scene,
                point.rule,
                point.errors
            );
        }
        let error = |scene: &str, rule: &str, size: usize| {
            points.iter().find(|p| p.scene == scene && p.rule == rule && p.size == size).map(|p| p.errors[0]).unwrap()
        };
        assert!(error("exponential", "gauss2", 128) < 3e-8 && error("gaussian", "gauss2", 128) < 1.5e-7);
        assert!(error("exponential", "left", 64) > 1.9 * error("exponential", "left", 128));
        let table = at_128(&scenes, &points);
        assert_eq!(table.rows[1][3], "8.9e-5", "midpoint on the exponential scene: {:?}", table.rows[1]);
    }
}
