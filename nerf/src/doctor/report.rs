//! What an examination says: facts about a capture, and what is wrong with it.

use super::kinds::{FindingKind, Severity, Text};
use crate::dataset::{SceneType, Split, View};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::fmt::Display;
use std::path::PathBuf;

/// One thing that is wrong, or worth knowing.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Finding {
    /// What it is.
    pub kind: FindingKind,
    /// How much it matters.
    pub severity: Severity,
    /// What was found, in a sentence.
    pub what: String,
    /// What to do about it.
    pub advice: String,
    /// The names of the photographs that it is about; none where it is about all of them.
    pub views: Vec<String>,
}

/// A number over all cameras.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Range {
    /// The least.
    pub least: f64,
    /// That in the middle.
    pub median: f64,
    /// The greatest.
    pub most: f64,
}

/// An image size, and how many photographs have it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Resolution {
    /// Pixels in a row.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// Number of photographs.
    pub photographs: usize,
}

/// The photographs of a split.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct CaptureSubset {
    /// The split.
    pub split: Split,
    /// How many of its images exist.
    pub present: usize,
    /// How many do not.
    pub absent: usize,
}

/// Where the scene was found to be. Lengths and places are in the scene's units, `up` and `middle` in the capture's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SceneLayout {
    /// How far it goes.
    pub scope: SceneType,
    /// Why that is thought.
    pub reason: String,
    /// Distance along a ray before which there is nothing.
    pub near: f64,
    /// Distance along a ray beyond which there is nothing.
    pub far: f64,
    /// Lower and upper corner of its box.
    pub bounds: [DVec3; 2],
    /// The length of a unit of the capture in scene units.
    pub scale: f64,
    /// The direction in the capture that is up.
    pub up: DVec3,
    /// The place in the capture that is the middle of the scene.
    pub middle: DVec3,
}

/// What a capture is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Facts {
    /// The folder.
    pub folder: PathBuf,
    /// How it is written.
    pub format: String,
    /// The photographs of each split that has some.
    pub subsets: Vec<CaptureSubset>,
    /// The sizes of the images, the most frequent first.
    pub resolutions: Vec<Resolution>,
    /// Horizontal focal length in pixels, if cameras have a size.
    pub focal: Option<Range>,
    /// Horizontal field of view in degrees, if cameras have a size.
    pub field_of_view: Option<Range>,
    /// The lenses, with their coefficients.
    pub lenses: Vec<String>,
    /// Number of points of the scene that the capture has.
    pub points: usize,
    /// Where the scene lies, if that can be found out.
    pub layout: Option<SceneLayout>,
    /// How well photographs agree with their cameras, if that was looked at and they have enough to compare: 0 as by chance,
    /// 1 perfectly; 0.3 is usual in a good capture.
    pub agreement: Option<f64>,
}

/// The result of an examination.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// What the capture is.
    pub facts: Facts,
    /// What is wrong with it, the gravest first.
    pub findings: Vec<Finding>,
}

impl Report {
    /// How much the gravest finding matters; `None` if there is none.
    pub fn severity(&self) -> Option<Severity> {
        self.findings.iter().map(|finding| finding.severity).max()
    }

    /// Whether something of a kind was found.
    pub fn finds(&self, kind: FindingKind) -> Option<&Finding> {
        self.findings.iter().find(|finding| finding.kind == kind)
    }
}

/// Findings while they are made.
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

    /// Adds a finding about some photographs, if there are some: how many is the first part of the message.
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

    /// Adds a finding about photographs that are like another one each, if there are some: the first pair is named.
    pub fn alike(&mut self, kind: FindingKind, pairs: &[[&View; 2]]) {
        if let Some(finding) = self.about(kind, pairs.iter().map(|[view, _]| *view), &[]) {
            let [first, other] = pairs[0];
            let others = if pairs.len() > 1 { ", and others" } else { "" };
            finding.what += &format!(": `{}` and `{}`{others}", first.name, other.name);
        }
    }

    /// All of them, the gravest first, those of one severity in the order of their kinds.
    pub fn sorted(mut self) -> Vec<Finding> {
        self.0.sort_by_key(|finding| (std::cmp::Reverse(finding.severity), finding.kind));
        self.0
    }
}

/// `1 photograph` or `3 photographs`.
fn counted(count: usize) -> String {
    if count == 1 { "1 photograph".to_owned() } else { format!("{count} photographs") }
}
