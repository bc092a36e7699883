//! Results and conditions of an evaluation.

use std::collections::BTreeSet;
use std::fmt;

use raygrad::nerf::dataset::{Split, evenly_spaced};
use raygrad::nerf::imaging::lpips::Backbone;
use raygrad::nerf::space::occupancy::Skipping;
use raygrad::nerf::{Background, Budget, Evaluations, Model, StepStats};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::alignment::{Alignment, Appearance};
use crate::precision::Precision;
use crate::run::{Run, RunConfig};
use crate::scene::Scene;
use crate::summary;

/// Number of evenly spaced views that are drawn, in addition to the worst ones.
const PICTURES: usize = 10;
/// Number of worst views that are drawn.
const WORST: usize = 3;

/// The conditions of an evaluation, known before the first render. They are equal for all its shards.
#[derive(Serialize, Deserialize)]
pub struct Conditions {
    /// Version of raygrad for the evaluation.
    pub raygrad: String,
    pub scene: Scene,
    pub split: Split,
    /// The rule that selects the held-out images.
    pub hold_out: String,
    /// Number of views.
    pub views: usize,
    pub width: usize,
    pub height: usize,
    pub downscale: usize,
    /// True if masks are the alpha of the images.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub mask_as_alpha: bool,
    /// Background of transparent images.
    pub background: Background,
    /// Skipping; null without an occupancy grid.
    pub skip: Option<Skipping>,
    /// `f32`, or `f64` that skips empty cells only.
    pub precision: Precision,
    /// Cameras of the views.
    pub cameras: Alignment,
    /// Appearance of the views: exposure and appearance embedding.
    pub appearance: Appearance,
    /// Position of the ray in a pixel: 0.5 is the centre.
    pub pixel_offset: f64,
    /// `none`: floating-point renders, clamped to 0..=1, are compared.
    pub quantisation: String,
    pub model: Identity,
}

/// The machine of an evaluation.
#[derive(Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Machine {
    pub threads: usize,
    pub processor: String,
}

/// The result: `eval-SPLIT-SKIP.json`, with measured values and all conditions.
#[derive(Serialize)]
pub struct Report {
    #[serde(flatten)]
    pub conditions: Conditions,
    /// Shards may be from several machines.
    #[serde(serialize_with = "one_or_list")]
    pub threads: BTreeSet<usize>,
    #[serde(serialize_with = "one_or_list")]
    pub processor: BTreeSet<String>,
    /// Mean PSNR in dB; `inf` and `NaN` as strings.
    #[serde(serialize_with = "number")]
    pub psnr_mean: f64,
    /// Mean SSIM; null if the images are smaller than its window.
    #[serde(serialize_with = "some")]
    pub ssim_mean: Option<f64>,
    #[serde(flatten)]
    pub lpips: Option<Perceived>,
    /// Mean render time of a view, in seconds.
    pub seconds_per_view: f64,
    /// Density and colour evaluations per pixel, and the number of each without skipping within the box.
    pub density_per_pixel: f64,
    pub color_per_pixel: f64,
    pub unskipped_per_pixel: f64,
    pub per_view: Vec<Score>,
}

/// Serialises the only element, or else a list.
fn one_or_list<T: Serialize + Ord, S: Serializer>(all: &BTreeSet<T>, serializer: S) -> Result<S::Ok, S::Error> {
    match all.first().filter(|_| all.len() == 1) {
        Some(one) => one.serialize(serializer),
        None => all.serialize(serializer),
    }
}

/// The network of LPIPS.
#[derive(Serialize, Deserialize)]
pub struct Weights {
    /// Network of the features.
    pub lpips_backbone: Backbone,
    /// CRC-32 of the weights file.
    pub lpips_crc32: String,
}

/// One compared view.
#[derive(Serialize, Deserialize)]
pub struct Compared {
    pub score: Score,
    /// Seconds to render it.
    pub seconds: f64,
    pub evaluations: Evaluations,
    pub pixels: usize,
}

/// LPIPS and its conditions, if enabled.
#[derive(Serialize)]
pub struct Perceived {
    /// Mean LPIPS; null if an image is masked.
    #[serde(serialize_with = "some")]
    pub lpips_mean: Option<f64>,
    #[serde(flatten)]
    pub weights: Weights,
}

/// Identifies the model and its training.
#[derive(Serialize, Deserialize)]
pub struct Identity {
    /// CRC-32 of the model file.
    pub crc32: String,
    pub parameters: usize,
    /// Kinds of the field and of the sampler.
    pub field: String,
    pub sampler: String,
    /// Version of raygrad for the training.
    pub raygrad: String,
    /// Number of training images.
    pub images: usize,
    pub seed: u64,
    /// Training budget.
    pub budget: Option<Budget>,
    /// Training steps and seconds at the checkpoint of the model, from `summary.json`; without it, from the last line of
    /// `metrics.jsonl`.
    pub steps: Option<u64>,
    pub train_seconds: Option<f64>,
}

impl Identity {
    /// The identity of the model in a run's file with this checksum.
    pub fn of(run: &Run, model: &Model<f32>, crc32: String) -> Self {
        let metrics = std::fs::read_to_string(run.file("metrics.jsonl")).unwrap_or_default();
        let logged = || metrics.lines().rev().find_map(|line| serde_json::from_str::<StepStats>(line).ok());
        let trained = summary::trained(run).or_else(|| logged().map(|stats| (stats.step, stats.train_seconds)));
        let RunConfig { raygrad, images, budget, config, .. } = &run.config;
        Identity {
            crc32,
            parameters: model.params.elements(),
            field: config.field.kind().to_owned(),
            sampler: config.sampler.kind().to_owned(),
            raygrad: raygrad.clone(),
            images: images.len(),
            seed: config.seed,
            budget: *budget,
            steps: trained.map(|(steps, _)| steps),
            train_seconds: trained.map(|(_, seconds)| seconds),
        }
    }
}

/// The indices of evenly spaced views.
pub fn regular(views: usize) -> BTreeSet<usize> {
    evenly_spaced((0..views).collect(), PICTURES).into_iter().collect()
}

impl Report {
    /// The report of all views.
    pub fn new(conditions: Conditions, weights: Option<Weights>, machines: Vec<Machine>, views: Vec<Compared>) -> Self {
        let count = views.len() as f64;
        let seconds: f64 = views.iter().map(|view| view.seconds).sum();
        let pixels: usize = views.iter().map(|view| view.pixels).sum();
        let evaluations = views.iter().fold(Evaluations::default(), |sum, view| sum + view.evaluations);
        let per_pixel = |count: u64| count as f64 / pixels as f64;
        let per_view: Vec<Score> = views.into_iter().map(|view| view.score).collect();
        Report {
            threads: machines.iter().map(|machine| machine.threads).collect(),
            processor: machines.into_iter().map(|machine| machine.processor).collect(),
            psnr_mean: mean(per_view.iter().map(|score| Some(score.psnr))).unwrap_or(f64::NAN),
            ssim_mean: mean(per_view.iter().map(|score| score.ssim)),
            lpips: weights
                .map(|weights| Perceived { lpips_mean: mean(per_view.iter().map(|score| score.lpips)), weights }),
            seconds_per_view: seconds / count,
            density_per_pixel: per_pixel(evaluations.density),
            color_per_pixel: per_pixel(evaluations.color),
            unskipped_per_pixel: per_pixel(evaluations.unskipped),
            conditions,
            per_view,
        }
    }

    /// The indices of the drawn views: evenly spaced ones, and the worst.
    pub fn drawn(&self) -> BTreeSet<usize> {
        regular(self.per_view.len()).into_iter().chain(self.worst()).collect()
    }

    /// The indices of the worst views, worst first.
    pub fn worst(&self) -> Vec<usize> {
        worst(&self.per_view.iter().map(|score| score.psnr).collect::<Vec<_>>())
    }

    /// The indices of all views, sorted by PSNR. NaN comes first.
    pub fn by_psnr(&self) -> Vec<usize> {
        by_psnr(&self.per_view.iter().map(|score| score.psnr).collect::<Vec<_>>())
    }
}

/// The indices of the worst PSNRs, worst first.
pub fn worst(psnr: &[f64]) -> Vec<usize> {
    let mut order = by_psnr(psnr);
    order.truncate(WORST);
    order
}

fn by_psnr(all: &[f64]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..all.len()).collect();
    let psnr = |i: &usize| all[*i];
    order.sort_by(|a, b| psnr(b).is_nan().cmp(&psnr(a).is_nan()).then(psnr(a).total_cmp(&psnr(b))));
    order
}

/// The mean; `None` if there are no values or one is missing.
fn mean(values: impl ExactSizeIterator<Item = Option<f64>>) -> Option<f64> {
    let count = values.len();
    let sum: Option<f64> = values.sum();
    sum.filter(|_| count > 0).map(|sum| sum / count as f64)
}

/// Scores of one view.
#[derive(Serialize, Deserialize)]
pub struct Score {
    pub name: String,
    #[serde(serialize_with = "number", deserialize_with = "read_number")]
    pub psnr: f64,
    #[serde(serialize_with = "some", deserialize_with = "read_some")]
    pub ssim: Option<f64>,
    #[serde(default, skip_serializing_if = "Option::is_none", serialize_with = "some", deserialize_with = "read_some")]
    pub lpips: Option<f64>,
}

/// Serialises an optional number as [`number`] does.
fn some<S: Serializer>(value: &Option<f64>, serializer: S) -> Result<S::Ok, S::Error> {
    match value {
        Some(value) => number(value, serializer),
        None => serializer.serialize_none(),
    }
}

/// Serialises a number. Values that JSON lacks become strings.
fn number<S: Serializer>(value: &f64, serializer: S) -> Result<S::Ok, S::Error> {
    if value.is_finite() { serializer.serialize_f64(*value) } else { serializer.collect_str(value) }
}

/// A number as [`number`] serialises it.
#[derive(Deserialize)]
#[serde(untagged)]
enum Stored {
    Finite(f64),
    Other(String),
}

impl Stored {
    fn value<E: serde::de::Error>(self) -> Result<f64, E> {
        match self {
            Stored::Finite(value) => Ok(value),
            Stored::Other(text) => text.parse().map_err(E::custom),
        }
    }
}

fn read_number<'de, D: Deserializer<'de>>(from: D) -> Result<f64, D::Error> {
    Stored::deserialize(from)?.value()
}

fn read_some<'de, D: Deserializer<'de>>(from: D) -> Result<Option<f64>, D::Error> {
    Option::<Stored>::deserialize(from)?.map(Stored::value).transpose()
}

impl fmt::Display for Score {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({:.2} dB)", self.name, self.psnr)
    }
}

/// SSIM or LPIPS with four digits, if available.
pub fn four_digits(value: Option<f64>) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.4}"))
}

/// The report as a table for a terminal.
pub fn table(report: &Report) -> String {
    let mean_of = format!("mean of {}", report.per_view.len());
    let names = report.per_view.iter().map(|score| score.name.len());
    let width = names.chain([mean_of.len()]).max().unwrap_or(0);
    let row = |[name, psnr, ssim, lpips]: [&str; 4]| match report.lpips {
        Some(_) => format!("{name:width$}  {psnr:>7}  {ssim:>7}  {lpips:>7}\n"),
        None => format!("{name:width$}  {psnr:>7}  {ssim:>7}\n"),
    };
    let figures = |name: &str, psnr: f64, ssim: Option<f64>, lpips: Option<f64>| {
        row([name, &format!("{psnr:.2}"), &four_digits(ssim), &four_digits(lpips)])
    };
    let mut text = row(["image", "PSNR", "SSIM", "LPIPS"]);
    for Score { name, psnr, ssim, lpips } in &report.per_view {
        text += &figures(name, *psnr, *ssim, *lpips);
    }
    let lpips_mean = report.lpips.as_ref().and_then(|lpips| lpips.lpips_mean);
    text += &figures(&mean_of, report.psnr_mean, report.ssim_mean, lpips_mean);
    let Report { conditions, seconds_per_view, .. } = report;
    let Conditions { split, hold_out, background, width: columns, height, .. } = conditions;
    let size = format!("{columns}x{height}");
    text += &format!(
        "{split} images ({hold_out}), {size}, {background} background, {seconds_per_view:.2} s to render each\n"
    );
    let worst: Vec<String> = report.worst().iter().map(|&i| report.per_view[i].to_string()).collect();
    text += &format!("worst: {}\n", worst.join(", "));
    if let Some(Perceived { weights: Weights { lpips_backbone, lpips_crc32 }, .. }) = &report.lpips {
        text += &format!("LPIPS: {lpips_backbone}, weights CRC-32 {lpips_crc32}\n");
    }
    text += match conditions.appearance {
        Appearance::None => "",
        Appearance::Own => "exposure and appearance embeddings: each image's own\n",
        Appearance::Mean => "exposure and appearance embeddings: mean of the training images\n",
        Appearance::Half => "compared: right halves, with exposure fitted to the left halves\n",
    };
    text + match conditions.cameras {
        Alignment::None => "",
        Alignment::Learned => "cameras: as learned\n",
        Alignment::Fitted => "cameras: each aligned to its own image\n",
        Alignment::Glass => "cameras: focal length and lens as learned\n",
        Alignment::Similarity => "cameras: moved by the similarity transform of the training cameras\n",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::cmp::Ordering;

    #[test]
    fn non_finite_numbers_serialise_as_strings() {
        let of =
            |psnr: f64, ssim, lpips| serde_json::to_string(&Score { name: "a".into(), psnr, ssim, lpips }).unwrap();
        for (psnr, expected) in [(31.5, "31.5"), (f64::INFINITY, "\"inf\""), (f64::NAN, "\"NaN\"")] {
            let alone = format!("{{\"name\":\"a\",\"psnr\":{expected},\"ssim\":null}}");
            assert_eq!(of(psnr, None, None), alone);
            let read: Score = serde_json::from_str(&alone).unwrap();
            assert!(read.psnr.total_cmp(&psnr) == Ordering::Equal && read.ssim.is_none());
            let all = format!("{{\"name\":\"a\",\"psnr\":1.0,\"ssim\":{expected},\"lpips\":{expected}}}");
            assert_eq!(of(1.0, Some(psnr), Some(psnr)), all);
            let read: Score = serde_json::from_str(&all).unwrap();
            assert_eq!(read.ssim.unwrap().total_cmp(&psnr), Ordering::Equal);
            assert!(read.psnr == 1.0 && read.lpips.unwrap().total_cmp(&psnr) == Ordering::Equal);
        }
    }
}
