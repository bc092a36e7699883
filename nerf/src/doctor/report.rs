//! The report of an examination: facts about a capture, and findings.

use super::kinds::{FindingKind, Severity, Text};
use crate::dataset::{SceneType, Split, View};
use crate::error::Error;
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::fmt::Display;
use std::path::PathBuf;

/// A problem of a capture, or a note about it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Finding {
    /// The kind.
    pub kind: FindingKind,
    /// The severity.
    pub severity: Severity,
    /// The finding in one sentence.
    pub what: String,
    /// How to fix it.
    pub advice: String,
    /// The names of the affected images; empty if it concerns the whole capture.
    pub views: Vec<String>,
}

/// The range of a number over all cameras.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Range {
    /// The minimum.
    pub least: f64,
    /// The median.
    pub median: f64,
    /// The maximum.
    pub most: f64,
}

/// An image size with the number of images that have it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Resolution {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Number of images.
    pub images: usize,
}

/// The images of one split.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct CaptureSubset {
    /// The split.
    pub split: Split,
    /// Number of images that exist.
    pub present: usize,
    /// Number of listed images that do not exist.
    pub absent: usize,
}

/// The scene as [`SceneAnalysis`](crate::dataset::SceneAnalysis) found it. Lengths are in scene units; `up` and
/// `middle` are in the capture's coordinates.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneLayout {
    /// Bounded, unbounded or forward-facing.
    pub scene_type: SceneType,
    /// The reason for this type.
    pub reason: String,
    /// Near plane, in scene units.
    pub near: f64,
    /// Far plane, in scene units.
    pub far: f64,
    /// Lower and upper corner of the scene box.
    pub bounds: [DVec3; 2],
    /// Scene units per unit of the capture.
    pub scale: f64,
    /// The up direction, a unit vector in the capture's coordinates.
    pub up: DVec3,
    /// The centre of the scene, in the capture's coordinates.
    pub middle: DVec3,
}

/// Facts about a capture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Facts {
    /// The capture's folder.
    pub folder: PathBuf,
    /// The file format, such as `COLMAP`.
    pub format: String,
    /// The splits that have images.
    pub subsets: Vec<CaptureSubset>,
    /// The image sizes, the most frequent first.
    pub resolutions: Vec<Resolution>,
    /// Horizontal focal length in pixels, if cameras have a size.
    pub focal: Option<Range>,
    /// Horizontal field of view in degrees, if cameras have a size.
    pub field_of_view: Option<Range>,
    /// The distinct lenses, with their coefficients.
    pub lenses: Vec<String>,
    /// Number of the capture's sparse points.
    pub points: usize,
    /// The scene layout, if it can be found.
    pub layout: Option<SceneLayout>,
    /// Agreement of images with their cameras along epipolar lines: 0 is chance, 1 is perfect, 0.3 is usual in a good
    /// capture. `None` if it was not measured or too few patches match.
    pub agreement: Option<f64>,
    /// Number of images that were compared with their neighbours for it; 0 if pixels were not read. Panoramas are not
    /// compared.
    #[serde(default)]
    pub compared: usize,
}

/// The result of an examination.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Facts about the capture.
    pub facts: Facts,
    /// The findings, the most severe first.
    pub findings: Vec<Finding>,
}

impl Report {
    /// Returns the highest severity, or `None` without findings.
    pub fn severity(&self) -> Option<Severity> {
        self.findings.iter().map(|finding| finding.severity).max()
    }

    /// Returns the first finding of a kind, if there is one.
    pub fn finds(&self, kind: FindingKind) -> Option<&Finding> {
        self.findings.iter().find(|finding| finding.kind == kind)
    }
}

/// Collects findings.
#[derive(Debug, Default)]
pub(super) struct Findings(pub Vec<Finding>);

impl Findings {
    /// Adds a finding; `parts` take the places of `{}` in the message of its kind.
    pub fn add(&mut self, kind: FindingKind, parts: &[&dyn Display]) -> &mut Finding {
        let Text { severity, what: template, advice, .. } = kind.text();
        debug_assert_eq!(template.matches("{}").count(), parts.len(), "{template}");
        let mut pieces = template.split("{}");
        let mut what = pieces.next().unwrap_or_default().to_owned();
        pieces.zip(parts).for_each(|(piece, part)| what += &format!("{part}{piece}"));
        let number = self.0.len();
        self.0.push(Finding { kind, severity, what, advice: advice.to_owned(), views: vec![] });
        &mut self.0[number]
    }

    /// Adds a finding about images, if there are any; their count is the first part of the message.
    pub fn about<'a>(
        &mut self,
        kind: FindingKind,
        views: impl IntoIterator<Item = &'a View>,
        parts: &[&dyn Display],
    ) -> Option<&mut Finding> {
        let names: Vec<String> = views.into_iter().map(|view| view.name.clone()).collect();
        let count = counted(names.len());
        if names.is_empty() {
            return None;
        }
        let finding = self.add(kind, &[&[&count as &dyn Display], parts].concat());
        finding.views = names;
        Some(finding)
    }

    /// Adds a finding about images that equal another, if there are any; names the first pair.
    pub fn alike(&mut self, kind: FindingKind, pairs: &[[&View; 2]]) {
        if let Some(finding) = self.about(kind, pairs.iter().map(|[view, _]| *view), &[]) {
            let [first, other] = pairs[0];
            let others = if pairs.len() > 1 { ", and others" } else { "" };
            finding.what += &format!(": `{}` and `{}`{others}", first.name, other.name);
        }
    }

    /// Sorts them: the most severe first, then in the order of their kinds. Adds why training refuses the capture,
    /// unless it is that all cameras stand in one place.
    pub fn sorted(mut self, refusal: Option<&Error>) -> Vec<Finding> {
        if let Some(error) = refusal
            && !self.0.iter().any(|finding| finding.kind == FindingKind::OnePlace)
        {
            self.add(FindingKind::Refused, &[error]);
        }
        self.0.sort_by_key(|finding| (std::cmp::Reverse(finding.severity), finding.kind));
        self.0
    }
}

/// `1 image` or `3 images`.
fn counted(count: usize) -> String {
    if count == 1 { "1 image".to_owned() } else { format!("{count} images") }
}
