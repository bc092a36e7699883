//! Benchmark of training: quality against time and against work.

use std::ops::ControlFlow;
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

use raygrad::nerf::dataset::{Dataset, Split, evenly_spaced};
use raygrad::nerf::imaging::metrics::psnr;
use raygrad::nerf::space::occupancy::Skip;
use raygrad::nerf::{Budget, Config, Preset, Result, StepStats, Trainer};
use raygrad_scenes::embedded;
use serde_json::Value;

use super::Results;
use super::figure::{Axis, Figure, Panel, Series};
use super::table::{Table, digits};
use crate::output::note;

/// The script that trains the classic model in PyTorch and JAX.
const PEERS: &str = "benches/peers/classic_nerf.py";

/// One way to train.
struct Course {
    preset: Preset,
    skip: Skip,
    seed: u64,
    seconds: u64,
}

impl Course {
    fn name(&self) -> String {
        match (self.preset, self.skip) {
            (Preset::Instant | Preset::Voxel, Skip::Off) => format!("{}, no skipping", self.preset),
            (Preset::Classic | Preset::Small, Skip::Fast) => format!("{}, skipping", self.preset),
            (preset, _) => preset.to_string(),
        }
    }
}

/// Quality of a model at one time of training.
struct Point {
    stats: StepStats,
    psnr: f64,
}

/// Trains all courses. With `peers`, also adds curves at the speeds of PyTorch and JAX.
pub fn run(quick: bool, peers: bool) -> Result<Results> {
    let size = if quick { 64 } else { 200 };
    let data = Arc::new(embedded(Split::Train, size));
    // Half size, since the classic model takes a minute to render a view of full size.
    let mut test = embedded(Split::Test, size / 2);
    test.frames = evenly_spaced(test.frames, if quick { 1 } else { 3 });
    let courses = courses(quick);
    let mut curves = vec![];
    for (i, course) in courses.iter().enumerate() {
        let Course { seed, seconds, .. } = course;
        note(&format!("train: {} of {}: {}, seed {seed}, {seconds} s", i + 1, courses.len(), course.name()));
        curves.push(train(course, &data, &test)?);
    }
    let mut results = Results { tables: vec![table(&courses, &curves)], ..Results::default() };
    let mut series = [by(&courses, &curves, |stats| stats.train_seconds), by(&courses, &curves, evaluations)];
    if peers {
        add_peers(quick, &courses, &curves, &mut series[0], &mut results.findings);
    }
    let [by_time, by_work] = series;
    let panel = |title: &str, x: &str, series| Panel {
        title: title.to_owned(),
        x: Axis::log(x),
        y: Axis::linear("PSNR on test images, dB"),
        series,
        labels: vec![],
    };
    results.figures.push(Figure {
        name: "train".to_owned(),
        title: "Training on the built-in scene".to_owned(),
        caption:
            "One line per seed. Time is training time alone. Evaluations are density queries and colour queries with \
             gradients. Each schedule stretches to the whole time."
                .to_owned(),
        columns: 2,
        panel: [600, 420],
        panels: vec![
            panel("against time", "training seconds", by_time),
            panel("against work", "evaluations of the field", by_work),
        ],
    });
    for (course, curve) in courses.iter().zip(&curves) {
        if let Some(last) = curve.last() {
            let (name, seed, seconds) = (course.name(), course.seed, course.seconds);
            results.findings.push(format!("{name}, seed {seed}: {:.2} dB after {seconds} s", last.psnr));
        }
    }
    Ok(results)
}

fn courses(quick: bool) -> Vec<Course> {
    use {Preset::*, Skip::*};
    let plan: &[(Preset, Skip, u64, u64)] = if quick {
        &[(Instant, Fast, 2, 5), (Instant, Off, 1, 5), (Voxel, Fast, 1, 5), (Small, Off, 1, 8)]
    } else {
        &[
            (Instant, Fast, 3, 30),
            (Instant, Off, 1, 30),
            (Voxel, Fast, 2, 30),
            (Voxel, Off, 1, 30),
            (Small, Off, 1, 60),
            (Small, Fast, 2, 60),
            (Classic, Off, 1, 90),
            (Classic, Fast, 1, 90),
        ]
    };
    let seeds = |&(preset, skip, seeds, seconds): &(Preset, Skip, u64, u64)| {
        (0..seeds).map(move |seed| Course { preset, skip, seed, seconds })
    };
    plan.iter().flat_map(seeds).collect()
}

/// Density queries plus colour queries, which have gradients.
fn evaluations(stats: &StepStats) -> f64 {
    (stats.density_queries + stats.color_queries) as f64
}

/// Evaluates the model after 1, 1.5, 2.25 ... seconds, and at the end.
fn train(course: &Course, data: &Arc<Dataset>, test: &Dataset) -> Result<Vec<Point>> {
    let config = Config { seed: course.seed, ..Config::preset(course.preset) };
    let budget = Budget::Time(Duration::from_secs(course.seconds));
    let config = config.for_budget(budget.samples(), data.pixels_per_side()).with_skip(course.skip);
    let config = config.with_transparency(data.has_alpha());
    let mut trainer = Trainer::new(config, data.clone())?;
    let measure = |trainer: &Trainer| {
        let background = trainer.model.config.background.shown();
        let one = |frame: &raygrad::nerf::dataset::Frame| {
            let seen = trainer.model.render(&frame.camera, background).color;
            psnr(&seen, &frame.image.over(background))
        };
        let psnr = test.frames.iter().map(one).sum::<f64>() / test.frames.len() as f64;
        Point { stats: trainer.stats(), psnr }
    };
    let mut points = vec![];
    let mut next = 1.0;
    trainer.run(budget, |trainer| {
        let seconds = trainer.stats().train_seconds;
        if seconds >= next {
            next = 2.0 * next.max(0.5 * seconds);
            points.push(measure(trainer));
        }
        ControlFlow::Continue(())
    });
    points.push(measure(&trainer));
    Ok(points)
}

fn table(courses: &[Course], curves: &[Vec<Point>]) -> Table {
    let columns = [
        "preset",
        "skip",
        "seed",
        "training seconds",
        "steps",
        "rays",
        "density queries",
        "colour queries",
        "queries without skipping",
        "parameters updated",
        "PSNR, dB",
    ];
    let mut table = Table::new("train", &columns);
    for (course, curve) in courses.iter().zip(curves) {
        for Point { stats, psnr } in curve {
            let counts =
                [stats.step, stats.rays, stats.density_queries, stats.color_queries, stats.unskipped, stats.moved];
            let names = [course.preset.to_string(), course.skip.to_string(), course.seed.to_string()];
            let row = names.into_iter().chain([digits(stats.train_seconds)]);
            table.push(row.chain(counts.map(|n| n.to_string())).chain([digits(*psnr)]).collect());
        }
    }
    table
}

/// The curves over a quantity of the steps, one colour per kind of course.
fn by(courses: &[Course], curves: &[Vec<Point>], x: impl Fn(&StepStats) -> f64) -> Vec<Series> {
    let mut names: Vec<String> = courses.iter().map(Course::name).collect();
    names.dedup();
    let style = |name: &str| names.iter().position(|other| other == name).unwrap_or(0);
    let line = |(course, curve): (&Course, &Vec<Point>)| {
        let name = course.name();
        Series::line(&name, style(&name), curve.iter().map(|point| [x(&point.stats), point.psnr]).collect())
    };
    courses.iter().zip(curves).map(line).collect()
}

/// Adds the classic course at the speeds of PyTorch and JAX. Equal steps give the same model, so that only the time of
/// a step differs. The scripts measure it on this machine.
fn add_peers(
    quick: bool,
    courses: &[Course],
    curves: &[Vec<Point>],
    series: &mut Vec<Series>,
    findings: &mut Vec<String>,
) {
    let classic = courses.iter().zip(curves).find(|(course, _)| course.preset == Preset::Classic);
    for (style, framework) in ["torch", "jax"].into_iter().enumerate() {
        let seconds = match seconds_a_step(framework, quick) {
            Ok(seconds) => seconds,
            Err(what) => {
                findings.push(format!("{framework} was not measured: {what}"));
                continue;
            }
        };
        findings.push(format!("{framework}: {seconds:.3} s per step of the classic model"));
        if let Some((_, curve)) = classic {
            let points = curve.iter().map(|point| [point.stats.step as f64 * seconds, point.psnr]).collect();
            series.push(Series {
                hollow: true,
                ..Series::line(&format!("classic at the speed of {framework}"), 5 + style, points)
            });
        }
    }
}

/// The command that measures a training step of another framework, with as many threads as raygrad.
fn peer_command(framework: &str, quick: bool, threads: usize) -> Command {
    let steps = if quick { "1" } else { "5" };
    let mut command = Command::new("python3");
    command.args([PEERS, "--framework", framework, "--steps", steps, "--threads", &threads.to_string()]);
    command
}

/// What `benches/peers/classic_nerf.py` reports for a training step.
fn seconds_a_step(framework: &str, quick: bool) -> std::result::Result<f64, String> {
    if !std::path::Path::new(PEERS).is_file() {
        return Err(format!("{PEERS} is not here: run in a checkout of the repository"));
    }
    let output = peer_command(framework, quick, rayon::current_num_threads()).output();
    let output = output.map_err(|e| format!("python3 cannot be run: {e}"))?;
    if !output.status.success() {
        let message = String::from_utf8_lossy(&output.stderr);
        let last = message.lines().last().unwrap_or("no message");
        return Err(format!("{last} (benches/peers/README.md explains how to install it)"));
    }
    let text = String::from_utf8_lossy(&output.stdout);
    let line: Option<Value> = text.lines().last().and_then(|line| serde_json::from_str(line).ok());
    let seconds = line.and_then(|line| line["seconds_per_step"].as_f64());
    seconds.ok_or_else(|| format!("{PEERS} printed no seconds_per_step"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn course_name_lists_non_default_settings() {
        let name = |preset, skip| Course { preset, skip, seed: 0, seconds: 1 }.name();
        assert_eq!(name(Preset::Instant, Skip::NearLossless), "instant");
        assert_eq!(name(Preset::Voxel, Skip::Off), "voxel, no skipping");
        assert_eq!(name(Preset::Small, Skip::Fast), "small, skipping");
        assert_eq!(name(Preset::Small, Skip::Off), "small");
    }

    #[test]
    fn peer_command_has_the_threads_and_steps() {
        let words = |framework, quick, threads| {
            let command = peer_command(framework, quick, threads);
            let words = std::iter::once(command.get_program()).chain(command.get_args());
            words.map(|word| word.to_str().unwrap().to_owned()).collect::<Vec<_>>().join(" ")
        };
        let script = "python3 benches/peers/classic_nerf.py";
        assert_eq!(words("torch", true, 3), format!("{script} --framework torch --steps 1 --threads 3"));
        assert_eq!(words("jax", false, 12), format!("{script} --framework jax --steps 5 --threads 12"));
        assert!(std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(PEERS).is_file());
    }
}
