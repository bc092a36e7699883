//! What an examination says: facts about a capture, and what is wrong with it.

use crate::dataset::{Scope, Split};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::PathBuf;

/// How much a finding matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Severity {
    /// Worth knowing; nothing needs to be done.
    Note,
    /// Views will probably be worse for it.
    Warning,
    /// Training will fail, or learn something else than the scene.
    Error,
}

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Severity::Note => "note",
            Severity::Warning => "warning",
            Severity::Error => "error",
        })
    }
}

macro_rules! kinds {
    ($($(#[$doc:meta])* $kind:ident = $name:literal,)*) => {
        /// What can be wrong with a capture. The names stay the same from version to version.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        pub enum FindingKind {
            $($(#[$doc])* #[serde(rename = $name)] $kind,)*
        }

        impl FindingKind {
            /// All kinds.
            pub const ALL: &[FindingKind] = &[$(FindingKind::$kind),*];

            /// The name that is written to files and printed, such as `images-absent`.
            pub fn name(self) -> &'static str {
                match self {
                    $(FindingKind::$kind => $name,)*
                }
            }
        }
    };
}

kinds! {
    /// Images that the capture lists do not exist.
    ImagesAbsent = "images-absent",
    /// Images cannot be decoded.
    ImagesUndecodable = "images-undecodable",
    /// Images are of another shape than their camera.
    ShapeMismatch = "shape-mismatch",
    /// Photographs have several resolutions.
    MixedResolutions = "mixed-resolutions",
    /// A field of view is implausible.
    FieldOfView = "field-of-view",
    /// Horizontal and vertical focal length differ.
    PixelAspect = "pixel-aspect",
    /// The principal point is far from the middle of the image.
    PrincipalPoint = "principal-point",
    /// The lens folds the image back, or leaves part of it dark.
    LensFolds = "lens-folds",
    /// The lens bends light strongly.
    StrongDistortion = "strong-distortion",
    /// Cameras look away from each other.
    LooksAway = "looks-away",
    /// Camera axes are those of OpenCV and not of OpenGL.
    OpenCvAxes = "opencv-axes",
    /// Matrices lead from the world to the camera and not back.
    WorldToCamera = "world-to-camera",
    /// The world is seen in a mirror.
    Mirrored = "mirrored",
    /// Photographs agree with their cameras under no convention.
    NoAgreement = "no-agreement",
    /// Cameras and points, or cameras and the format's convention, have different scales.
    Scale = "scale",
    /// Coordinates are so large that digits are lost.
    FarFromOrigin = "far-from-origin",
    /// Photographs were taken with the camera turned about its optical axis.
    Roll = "roll",
    /// Different photographs have one pose.
    DuplicatePoses = "duplicate-poses",
    /// One image has several poses.
    DuplicateImages = "duplicate-images",
    /// Photographs are blurred.
    Blurred = "blurred",
    /// Photographs are brighter or darker than those beside them.
    ExposureJump = "exposure-jump",
    /// Photographs have other colours than those beside them.
    WhiteBalanceJump = "white-balance-jump",
    /// A camera is far from all others.
    FarCamera = "far-camera",
    /// No camera looks from a wide range of directions.
    CoverageGap = "coverage-gap",
    /// There are few photographs.
    FewPhotographs = "few-photographs",
    /// Photographs show nothing of the scene's box.
    MissesBox = "misses-box",
    /// Cameras stand in the box of a scene that ends there.
    CameraInBox = "camera-in-box",
    /// A photograph that is tested on is trained on too.
    Leak = "leak",
    /// Masks hide whole photographs.
    MaskHidesAll = "mask-hides-all",
    /// Masks hide nothing.
    MaskHidesNothing = "mask-hides-nothing",
    /// Photographs have an alpha channel that is opaque throughout.
    OpaqueAlpha = "opaque-alpha",
    /// Single photographs disagree with their cameras.
    WrongPose = "wrong-pose",
    /// There is nothing to measure a model by.
    NothingHeldOut = "nothing-held-out",
    /// All cameras stand in one place.
    OnePlace = "one-place",
    /// All cameras stand on a line.
    OnALine = "on-a-line",
}

impl fmt::Display for FindingKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

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
pub struct Part {
    /// The split.
    pub split: Split,
    /// How many of its images exist.
    pub present: usize,
    /// How many do not.
    pub absent: usize,
}

/// Where the scene was found to be. Lengths and places are in the scene's units, `up` and `middle` in the capture's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Lie {
    /// How far it goes.
    pub scope: Scope,
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
    pub parts: Vec<Part>,
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
    pub lie: Option<Lie>,
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
    /// Adds a finding.
    pub fn add(
        &mut self,
        kind: FindingKind,
        severity: Severity,
        what: impl ToString,
        advice: &str,
        views: Vec<String>,
    ) {
        let (what, advice) = (what.to_string(), advice.to_owned());
        self.0.push(Finding { kind, severity, what, advice, views });
    }

    /// Adds a finding about some photographs, if there are some: `what` is told how many.
    pub fn about(
        &mut self,
        kind: FindingKind,
        severity: Severity,
        views: Vec<String>,
        what: impl Fn(&str) -> String,
        advice: &str,
    ) {
        if !views.is_empty() {
            self.add(kind, severity, what(&counted(views.len())), advice, views);
        }
    }

    /// Adds a finding about photographs that are like another one each, if there are some: the first pair is named.
    pub fn alike(
        &mut self,
        kind: FindingKind,
        severity: Severity,
        pairs: Vec<[String; 2]>,
        what: impl Fn(&str) -> String,
        advice: &str,
    ) {
        let Some([first, other]) = pairs.first() else { return };
        let named = format!(": `{first}` and `{other}`{}", if pairs.len() > 1 { ", and others" } else { "" });
        let views = pairs.iter().map(|[name, _]| name.clone()).collect();
        self.about(kind, severity, views, |count| what(count) + &named, advice);
    }

    /// All of them, the gravest first, those of one severity in the order of their kinds.
    pub fn sorted(mut self) -> Vec<Finding> {
        self.0.sort_by_key(|finding| (std::cmp::Reverse(finding.severity), finding.kind));
        self.0
    }
}

/// `1 photograph` or `3 photographs`.
pub(super) fn counted(count: usize) -> String {
    if count == 1 { "1 photograph".to_owned() } else { format!("{count} photographs") }
}
