//! Results and conditions of an evaluation.

use std::collections::BTreeSet;
use std::fmt;

use raygrad::nerf::dataset::{Split, evenly_spaced};
use raygrad::nerf::imaging::lpips::Backbone;
use raygrad::nerf::space::occupancy::Skipping;
use raygrad::nerf::{Background, Budget, Model, StepStats};
use serde::{Serialize, Serializer};

use super::alignment::{Alignment, Appearance};
use crate::precision::Precision;
use crate::run::{Run, RunConfig};
use crate::scene::Scene;

/// Number of evenly spaced views that are drawn, in addition to the worst ones.
const PICTURES: usize = 10;
/// Number of worst views that are drawn.
const WORST: usize = 3;

/// The result: `eval-SPLIT-SKIP.json`, with measured values and all conditions.
#[derive(Serialize)]
pub struct Report {
    /// Version of raygrad for the evaluation.
    pub raygrad: &'static str,
    pub scene: Scene,
    pub split: Split,
    /// The rule that selects the held-out images.
    pub hold_out: &'static str,
    /// Number of views.
    pub views: usize,
    pub width: usize,
    pub height: usize,
    pub downscale: usize,
    /// True if masks are the alpha of the images.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
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
    pub quantisation: &'static str,
    pub model: Identity,
    pub threads: usize,
    pub processor: String,
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

/// LPIPS and its conditions, if enabled.
#[derive(Serialize)]
pub struct Perceived {
    /// Mean LPIPS; null if an image is masked.
    #[serde(serialize_with = "some")]
    pub lpips_mean: Option<f64>,
    /// Network of the features.
    pub lpips_backbone: Backbone,
    /// CRC-32 of the weights file.
    pub lpips_crc32: String,
}

/// Identifies the model and its training.
#[derive(Serialize)]
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
    /// Training steps and seconds, from the last line of `metrics.jsonl`.
    pub steps: Option<u64>,
    pub train_seconds: Option<f64>,
}

impl Identity {
    /// The identity of the model in a run's file with this checksum.
    pub fn of(run: &Run, model: &Model<f32>, crc32: String) -> Self {
        let metrics = std::fs::read_to_string(run.file("metrics.jsonl")).unwrap_or_default();
        let last = metrics.lines().rev().find_map(|line| serde_json::from_str::<StepStats>(line).ok());
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
            steps: last.map(|stats| stats.step),
            train_seconds: last.map(|stats| stats.train_seconds),
        }
    }
}

/// The indices of evenly spaced views.
pub fn regular(views: usize) -> BTreeSet<usize> {
    evenly_spaced((0..views).collect(), PICTURES).into_iter().collect()
}

impl Report {
    /// The indices of the drawn views: evenly spaced ones, and the worst.
    pub fn drawn(&self) -> BTreeSet<usize> {
        regular(self.views).into_iter().chain(self.worst()).collect()
    }

    /// The indices of the worst views, worst first.
    pub fn worst(&self) -> Vec<usize> {
        let mut order = self.by_psnr();
        order.truncate(WORST);
        order
    }

    /// The indices of all views, sorted by PSNR. NaN comes first.
    pub fn by_psnr(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.per_view.len()).collect();
        let psnr = |i: &usize| self.per_view[*i].psnr;
        order.sort_by(|a, b| psnr(b).is_nan().cmp(&psnr(a).is_nan()).then(psnr(a).total_cmp(&psnr(b))));
        order
    }
}

/// Scores of one view.
#[derive(Serialize)]
pub struct Score {
    pub name: String,
    #[serde(serialize_with = "number")]
    pub psnr: f64,
    #[serde(serialize_with = "some")]
    pub ssim: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none", serialize_with = "some")]
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
    let mean_of = format!("mean of {}", report.views);
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
    let Report { split, hold_out, background, seconds_per_view, .. } = report;
    let size = format!("{}x{}", report.width, report.height);
    text += &format!(
        "{split} images ({hold_out}), {size}, {background} background, {seconds_per_view:.2} s to render each\n"
    );
    let worst: Vec<String> = report.worst().iter().map(|&i| report.per_view[i].to_string()).collect();
    text += &format!("worst: {}\n", worst.join(", "));
    if let Some(Perceived { lpips_backbone, lpips_crc32, .. }) = &report.lpips {
        text += &format!("LPIPS: {lpips_backbone}, weights CRC-32 {lpips_crc32}\n");
    }
    text += match report.appearance {
        Appearance::None => "",
        Appearance::Own => "exposure and appearance embeddings: each image's own\n",
        Appearance::Mean => "exposure and appearance embeddings: mean of the training images\n",
        Appearance::Half => "compared: right halves, with exposure fitted to the left halves\n",
    };
    text + match report.cameras {
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

    #[test]
    fn non_finite_numbers_serialise_as_strings() {
        let of =
            |psnr: f64, ssim, lpips| serde_json::to_string(&Score { name: "a".into(), psnr, ssim, lpips }).unwrap();
        for (psnr, expected) in [(31.5, "31.5"), (f64::INFINITY, "\"inf\""), (f64::NAN, "\"NaN\"")] {
            assert_eq!(of(psnr, None, None), format!("{{\"name\":\"a\",\"psnr\":{expected},\"ssim\":null}}"));
            let all = format!("{{\"name\":\"a\",\"psnr\":1.0,\"ssim\":{expected},\"lpips\":{expected}}}");
            assert_eq!(of(1.0, Some(psnr), Some(psnr)), all);
        }
    }
}
