//! Renderer settings on one trained model: cost and savings of each.

mod setting;

use std::any::Any;
use std::path::Path;
use std::sync::Arc;

use raygrad::Real;
use raygrad::nerf::dataset::{Dataset, Split, evenly_spaced};
use raygrad::nerf::imaging::metrics::{mse, psnr, psnr_from_mse};
use raygrad::nerf::sampling::marching::Marching;
use raygrad::nerf::volume::quadrature::Quadrature;
use raygrad::nerf::{Config, Error, Evaluations, Image, Instant, Model, Preset, Result, Trainer, Voxel};
use raygrad_scenes::embedded;

use super::Results;
use super::figure::{Axis, Figure, Panel, Series};
use super::stopwatch::{Timed, compare};
use super::table::{Table, digits};
use crate::output::note;
use crate::run::Run;
use setting::{Setting, WHITE, settings};

/// The reference divides the default step by this factor.
const FINER: usize = 8;
/// The rule of the reference, and a second rule. Their difference limits the precision of all comparisons.
const RULES: [Quadrature; 2] = [Quadrature::Gauss2, Quadrature::Midpoint];
/// Displayed PSNR of a render that equals the reference exactly.
const PERFECT: f64 = 140.0;

/// Parameters of the suite.
struct Scale {
    steps: u64,
    size: usize,
    views: usize,
    rounds: usize,
}

/// Result of a setting.
struct Outcome {
    setting: Setting,
    evaluations: Evaluations,
    psnr: f64,
    largest: f64,
    truth: f64,
    timed: Timed,
    dominated: bool,
}

/// Benchmarks all settings.
pub fn run(quick: bool, folder: Option<&Path>) -> Result<Results> {
    let scale = if quick {
        Scale { steps: 600, size: 64, views: 1, rounds: 2 }
    } else {
        Scale { steps: 3000, size: 200, views: 4, rounds: 3 }
    };
    let (model, views) = match folder {
        Some(folder) => stored(folder, &scale)?,
        None => trained(Config::preset(Preset::Instant), &scale)?,
    };
    let Some(sampler) = model.marching() else {
        return Err(Error::setting(
            "run",
            "samples hierarchically: choose a run with the sampler `marching`, such as preset instant",
        ));
    };
    let step = sampler.config.view_step;
    note("render: reference in f64");
    let Reference { images: reference, apart } = references(&model, &views)?;
    let mut outcomes = vec![];
    let base = Setting::base(step);
    let baseline = base.model(&model);
    let settings = settings(step);
    for (i, setting) in settings.iter().enumerate() {
        note(&format!("render: {} of {}: {} {}", i + 1, settings.len(), setting.group, setting.name));
        outcomes.push(measure(&model, setting, (&base, &baseline), &views, &reference, scale.rounds)?);
    }
    mark_dominated(&mut outcomes);
    let pixels = (reference[0].width * reference[0].height * reference.len()) as f64;
    Ok(Results {
        tables: vec![table(&outcomes, &model, pixels)],
        figures: vec![figure(&outcomes, pixels, false), figure(&outcomes, pixels, true)],
        findings: findings(&outcomes, pixels, apart),
    })
}

/// A model of the built-in scene after a few training steps, with the occupancy grid of training.
fn trained(config: Config, scale: &Scale) -> Result<(Model<f32>, Dataset)> {
    note(&format!("render: training for {} steps", scale.steps));
    let data = Arc::new(embedded(Split::Train, scale.size));
    let mut trainer = Trainer::new(config, data)?;
    for step in 0..scale.steps {
        trainer.step(step as f64 / scale.steps as f64);
    }
    let mut test = embedded(Split::Test, scale.size);
    test.frames = evenly_spaced(test.frames, scale.views);
    Ok((trainer.model, test))
}

fn stored(folder: &Path, scale: &Scale) -> Result<(Model<f32>, Dataset)> {
    let run = Run::open(folder)?;
    let data = run.open_scene(None)?.load(Split::Test, run.config.downscale, scale.views)?;
    if data.frames.is_empty() {
        return Err(Error::file(folder, "its scene has no test images to compare with"));
    }
    let mut model = run.model()?;
    // Each setting sets its own ray tolerance, so that of the model is dropped.
    if let Some(Marching { config, grid, .. }) = model.marching().cloned() {
        model.sampler = Box::new(Marching::new(config, grid));
    }
    Ok((model, data))
}

/// Reference renders of the test views.
struct Reference {
    images: Vec<Image>,
    /// PSNR of one of the [`RULES`] against the other, in dB.
    apart: f64,
}

fn references(model: &Model<f32>, views: &Dataset) -> Result<Reference> {
    let mut double = model.cast::<f64>()?;
    let mut by = |rule: Quadrature| -> Vec<Image> {
        if let Some(sampler) = double.marching_mut() {
            sampler.config.quadrature = rule;
        }
        views.frames.iter().map(|frame| double.render_reference(&frame.camera, WHITE, FINER).picture().color).collect()
    };
    let [images, others] = RULES.map(&mut by);
    let errors = images.iter().zip(&others).map(|(a, b)| mse(a, b));
    let apart = psnr_from_mse(errors.sum::<f64>() / images.len().max(1) as f64).min(PERFECT);
    Ok(Reference { images, apart })
}

fn measure(
    model: &Model<f32>,
    setting: &Setting,
    (base, baseline): (&Setting, &Model<f32>),
    views: &Dataset,
    reference: &[Image],
    rounds: usize,
) -> Result<Outcome> {
    let own = setting.model(model);
    let (mut error, mut largest, mut truth, mut evaluations) = (0.0, 0.0_f64, 0.0, Evaluations::default());
    for (frame, reference) in views.frames.iter().zip(reference) {
        let (image, count) = setting.render(&own, &frame.camera)?;
        evaluations = evaluations + count;
        error += mse(&image, reference);
        let differences = image.data.iter().zip(&reference.data).map(|(a, b)| f64::from((a - b).abs()));
        largest = differences.fold(largest, Real::maximum);
        truth += psnr(&image, &frame.image.over([1.0; 3]));
    }
    let count = reference.len() as f64;
    let run = |setting: &Setting, model: &Model<f32>| {
        for frame in &views.frames {
            // The same call has succeeded above.
            let _ = std::hint::black_box(setting.render(model, &frame.camera));
        }
    };
    let mut timed = compare(rounds, || run(base, baseline), || run(setting, &own));
    timed.seconds /= count;
    timed.baseline /= count;
    let psnr = psnr_from_mse(error / count).min(PERFECT);
    let truth = truth / count;
    Ok(Outcome { setting: setting.clone(), evaluations, psnr, largest, truth, timed, dominated: false })
}

/// Density queries plus colour queries.
fn work(evaluations: &Evaluations) -> u64 {
    evaluations.density + evaluations.color
}

/// Marks dominated settings. Another setting is at least as good in work and in PSNR, and better in one of them.
fn mark_dominated(outcomes: &mut [Outcome]) {
    let places: Vec<(u64, f64)> = outcomes.iter().map(|o| (work(&o.evaluations), o.psnr)).collect();
    for (outcome, own) in outcomes.iter_mut().zip(&places) {
        outcome.dominated =
            places.iter().any(|other| other.0 <= own.0 && other.1 >= own.1 && (other.0 < own.0 || other.1 > own.1));
    }
}

/// Cost of one density query and of one colour query: table look-ups, their bytes, and FLOP of matrix products.
fn cost(model: &Model<f32>) -> [[u64; 3]; 2] {
    let field: &dyn Any = &*model.field;
    let grid = field.downcast_ref::<Instant>().map(Instant::grid).or(field.downcast_ref::<Voxel>().map(Voxel::grid));
    let (lookups, features) =
        grid.map_or((0, 0), |grid| (8 * grid.grid().levels().len() as u64, grid.grid().features() as u64));
    let flops = |of_color: bool| -> u64 {
        let matrices = model.params.iter().filter(|(name, x)| {
            let is_color = name.contains(".color") || name.contains(".view");
            x.ndim() == 2 && name.starts_with("field.") && !name.ends_with(".table") && is_color == of_color
        });
        matrices.map(|(_, x)| 2 * x.len() as u64).sum()
    };
    [[lookups, lookups * features * 4, flops(false)], [0, 0, flops(true)]]
}

fn table(outcomes: &[Outcome], model: &Model<f32>, pixels: f64) -> Table {
    let columns = [
        "group",
        "setting",
        "density queries per ray",
        "colour queries per ray",
        "look-ups per ray",
        "table bytes per ray",
        "FLOP per ray",
        "ms",
        "ratio to default",
        "control",
        "control spread",
        "PSNR against the reference, dB",
        "largest error",
        "PSNR against the images, dB",
        "dominated",
    ];
    let mut table = Table::new("render", &columns);
    let [density, color] = cost(model);
    for outcome in outcomes {
        let Outcome { setting, evaluations, timed, .. } = outcome;
        let each = |count: u64| digits(count as f64 / pixels);
        let total = |i: usize| each(evaluations.density * density[i] + evaluations.color * color[i]);
        table.push(vec![
            setting.group.to_owned(),
            setting.name.clone(),
            each(evaluations.density),
            each(evaluations.color),
            total(0),
            total(1),
            total(2),
            digits(1e3 * timed.seconds),
            digits(timed.ratio),
            digits(timed.control),
            digits(timed.spread),
            digits(outcome.psnr),
            digits(outcome.largest),
            digits(outcome.truth),
            if outcome.dominated { "yes" } else { "no" }.to_owned(),
        ]);
    }
    table
}

/// Title, axis label, and the value of an outcome.
type Quantity = (&'static str, &'static str, fn(&Outcome) -> f64);

fn figure(outcomes: &[Outcome], pixels: f64, by_time: bool) -> Figure {
    let x = |outcome: &Outcome| {
        if by_time { 1e3 * outcome.timed.seconds } else { work(&outcome.evaluations) as f64 / pixels }
    };
    let (name, label, title) = if by_time {
        ("render-time", "milliseconds per image", "Error against time")
    } else {
        ("render-evaluations", "density and colour queries per ray", "Error against evaluations")
    };
    let kinds: [Quantity; 3] = [
        ("against the f64 reference", "PSNR, dB", |o| o.psnr),
        ("largest error against the reference", "largest error of a channel", |o| o.largest),
        ("against the images", "PSNR, dB", |o| o.truth),
    ];
    let panel = |(title, y_label, value): Quantity| {
        let at = |outcome: &Outcome| [x(outcome), value(outcome)];
        let mut series: Vec<Series> = vec![];
        let mut groups: Vec<&str> = outcomes.iter().map(|outcome| outcome.setting.group).collect();
        groups.dedup();
        for (style, group) in groups.into_iter().enumerate() {
            for hollow in [false, true] {
                let own = outcomes.iter().filter(|o| o.setting.group == group && o.dominated == hollow);
                let points: Vec<[f64; 2]> = own.map(at).collect();
                if !points.is_empty() {
                    series.push(Series { hollow, ..Series::marks(group, style, points) });
                }
            }
        }
        if title.contains("f64") && !by_time {
            let mut front: Vec<[f64; 2]> = outcomes.iter().filter(|o| !o.dominated).map(at).collect();
            front.sort_by(|a, b| a[0].total_cmp(&b[0]));
            series.insert(0, Series::line("Pareto front", 4, front));
        }
        let named = outcomes.iter().filter(|o| matches!(o.setting.group, "skip" | "instant-ngp"));
        let name = |o: &Outcome| if o.setting.group == "skip" { o.setting.name.clone() } else { "ngp".to_owned() };
        let labels = named.map(|o| (at(o), name(o))).collect();
        let y = if title.starts_with("largest") { Axis::log(y_label) } else { Axis::linear(y_label) };
        Panel { title: title.to_owned(), x: Axis::log(label), y, series, labels }
    };
    Figure {
        name: name.to_owned(),
        title: format!("Rendering: {}", title.to_lowercase()),
        caption: format!(
            "One model, rendered with many settings. Each group changes one setting of the default (`fast`). The \
             reference is in f64, with Gauss's rule and steps {FINER} times smaller; it skips only the cells that \
             training skipped. Hollow points are dominated: another setting has no more evaluations and no lower \
             PSNR against the reference, and beats it in one of them. `ngp` follows instant-ngp: one random sample \
             per cell, threshold .01, rays stop at a transmittance of .01."
        ),
        columns: 3,
        panel: [430, 360],
        panels: kinds.into_iter().map(panel).collect(),
    }
}

fn findings(outcomes: &[Outcome], pixels: f64, apart: f64) -> Vec<String> {
    let named = |group: &str, name: &str| outcomes.iter().find(|o| o.setting.group == group && o.setting.name == name);
    let line = |what: &str, outcome: &Outcome| {
        format!(
            "{what}: {:.1} evaluations per ray, {:.1} dB against the reference, largest error {:.1e}, {:.2} dB \
             against the images, {:.1} ms",
            work(&outcome.evaluations) as f64 / pixels,
            outcome.psnr,
            outcome.largest,
            outcome.truth,
            1e3 * outcome.timed.seconds
        )
    };
    let wanted = [("skip", "off"), ("skip", "near-lossless"), ("skip", "fast"), ("instant-ngp", "its rules")];
    let [rule, other] = RULES;
    let reference =
        format!("reference: {rule}; it agrees with {other} to {apart:.1} dB, so larger PSNRs are not meaningful");
    let lines =
        wanted.into_iter().filter_map(|(group, name)| Some(line(&format!("{group} {name}"), named(group, name)?)));
    [reference].into_iter().chain(lines).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad::nerf::sampling::marching::MarchingConfig;
    use raygrad::nerf::space::occupancy::Skip;
    use raygrad::nerf::{InstantConfig, RayTolerance};

    #[test]
    fn mark_dominated_on_work_and_psnr() {
        let outcome = |evaluations: u64, psnr: f64| Outcome {
            setting: Setting::base(0.01),
            evaluations: Evaluations { density: evaluations, ..Evaluations::default() },
            psnr,
            largest: 0.0,
            truth: 0.0,
            timed: Timed { seconds: 1.0, baseline: 1.0, ratio: 1.0, control: 1.0, spread: 0.0 },
            dominated: false,
        };
        let mut outcomes = [(10, 40.0), (20, 60.0), (20, 50.0), (30, 60.0), (5, 30.0)].map(|(e, p)| outcome(e, p));
        mark_dominated(&mut outcomes);
        assert_eq!(outcomes.each_ref().map(|o| o.dominated), [false, false, true, true, false]);
        // Dominated settings are a hollow series. A line joins the others in the first panel, and only by evaluations.
        let lines = |by_time: bool| {
            let figure = figure(&outcomes, 10.0, by_time);
            let shown = figure.panels.iter().map(|panel| {
                let series = panel.series.iter().map(|series| (series.line, series.hollow, series.points.len()));
                series.collect::<Vec<_>>()
            });
            shown.collect::<Vec<_>>()
        };
        let marks = vec![(false, false, 3), (false, true, 2)];
        let front = [vec![(true, false, 3)], marks.clone()].concat();
        assert_eq!(lines(false), [front, marks.clone(), marks.clone()]);
        assert_eq!(lines(true), [marks.clone(), marks.clone(), marks]);
        let front = &figure(&outcomes, 10.0, false).panels[0].series[0];
        assert_eq!(front.points, [[0.5, 30.0], [1.0, 40.0], [2.0, 60.0]], "from few to many");
    }

    /// Limits counts and errors. Times are too noisy for limits.
    #[test]
    fn sweep_small_is_within_limits() {
        let scale = Scale { steps: 60, size: 16, views: 1, rounds: 1 };
        let mut config = Config::preset(Preset::Instant);
        config.field.get_mut::<InstantConfig>().unwrap().grid.log2_table = 14;
        let sampler = config.sampler.get_mut::<MarchingConfig>().unwrap();
        (sampler.samples, sampler.occupancy.resolution) = (16384, 32);
        let (model, views) = trained(config, &scale).unwrap();
        let Reference { images: reference, apart } = references(&model, &views).unwrap();
        assert!(apart > 60.0 && apart < PERFECT, "the rules agree where steps are short: {apart} dB");
        let step = 1.0 / 600.0;
        let base = Setting::base(step);
        let baseline = base.model(&model);
        let all = settings(step);
        let find = |group: &str, name: &str| {
            let setting = all.iter().find(|s| s.group == group && s.name == name).unwrap();
            measure(&model, setting, (&base, &baseline), &views, &reference, 1).unwrap()
        };
        let [off, lossless, fast] = ["off", "near-lossless", "fast"].map(|name| find("skip", name));
        assert!(work(&fast.evaluations) <= work(&lossless.evaluations));
        assert!(work(&lossless.evaluations) <= work(&off.evaluations));
        assert!(off.psnr >= lossless.psnr - 0.01 && lossless.psnr >= 40.0, "{} {}", off.psnr, lossless.psnr);
        // The error bound of skipping, plus those of early termination and of the colour budget.
        let bound = |skip: Skip| {
            let limits = RayTolerance::of(&skip.into());
            skip.error_bound() + f64::from(limits.early_stop_eps + limits.color_budget)
        };
        assert!(lossless.largest <= off.largest + bound(Skip::NearLossless), "{}", lossless.largest);
        assert!(fast.largest <= off.largest + bound(Skip::Fast), "{}", fast.largest);
        let double = find("precision", "f64");
        assert_eq!(double.evaluations.density, off.evaluations.density);
        assert!((double.psnr - off.psnr).abs() < 0.5, "f32 has digits enough: {} {}", double.psnr, off.psnr);
        let gauss = find("quadrature", "gauss2 x 1");
        assert!(gauss.psnr > 30.0 && gauss.evaluations.density > fast.evaluations.density);
        assert!(find("step", "x 4").psnr < off.psnr);
        let [density, color] = cost(&model);
        assert!(density[0] > 0 && density[2] > 0 && color[2] > 0);
    }
}
