//! Checks a capture for problems and gives advice, before time is spent on training.
//!
//! Start with [`examine`], which reads all images: sharpness, exposure, and agreement with neighbours along epipolar
//! lines. [`examine_cameras`] checks only poses, lenses and image headers.

mod agreement;
mod consistency;
mod depths;
mod kinds;
mod layout;
mod look;
mod nearby;
mod order;
mod picture;
mod pixels;
mod poses;
mod report;
mod single;

pub use kinds::{FindingKind, Severity};
pub use report::{CaptureSubset, Facts, Finding, Range, Report, Resolution, SceneLayout};

use crate::dataset::{Capture, SceneAnalysis, Split, View};
use crate::error::Error;
use crate::numbers::median;
use glam::DVec3;
use pixels::Seen;
use report::Findings;

/// Options of [`examine`].
#[derive(Clone, Copy)]
pub struct DoctorOptions<'a> {
    /// Maximum number of images, evenly spaced, whose agreement with their neighbours is measured. All images are read
    /// regardless.
    pub compared: usize,
    /// Progress callback `(read, total)`, in images; called from several threads.
    pub progress: &'a (dyn Fn(usize, usize) + Sync),
}

impl Default for DoctorOptions<'_> {
    fn default() -> Self {
        DoctorOptions { compared: 120, progress: &|_, _| {} }
    }
}

/// Examines poses, lenses and image headers, without reading pixels.
///
/// `analysis` is the result of [`Capture::analyze_scene`]. An error becomes a finding, and checks of the up direction
/// and the scene box are left out.
pub fn examine_cameras(capture: &Capture, analysis: Result<&SceneAnalysis, &Error>) -> Report {
    let mut findings = Findings::default();
    let facts = without_pixels(capture, analysis.ok(), &mut findings);
    if analysis.is_ok_and(|analysis| analysis.hollow) {
        findings.add(FindingKind::HollowAlpha, &[&"most images"]);
    }
    Report { facts, findings: findings.sorted(refusal(capture, analysis)) }
}

/// Examines everything that [`examine_cameras`] does and reads all images, in parallel.
pub fn examine(capture: &Capture, analysis: Result<&SceneAnalysis, &Error>, options: &DoctorOptions<'_>) -> Report {
    let mut findings = Findings::default();
    let mut facts = without_pixels(capture, analysis.ok(), &mut findings);
    let looks = look::look_at_all(capture, options.progress);
    pixels::unreadable(&looks, &mut findings);
    depths::examine(capture, &mut findings);
    let seen: Vec<Seen<'_>> =
        looks.iter().filter_map(|(view, look)| Some(Seen { view, look: look.as_ref().ok()? })).collect();
    pixels::examine(&seen, analysis.ok(), &mut findings);
    let pictures = seen.iter().filter_map(|one| Some((one.view, one.look.picture.as_ref()?))).collect::<Vec<_>>();
    (facts.agreement, facts.compared) = consistency::examine(&pictures, options.compared, &mut findings);
    Report { facts, findings: findings.sorted(refusal(capture, analysis)) }
}

/// Why training refuses a capture. That it has no images is a finding of its own.
fn refusal<'a>(capture: &Capture, analysis: Result<&SceneAnalysis, &'a Error>) -> Option<&'a Error> {
    analysis.err().filter(|_| capture.present().next().is_some())
}

fn without_pixels(capture: &Capture, analysis: Option<&SceneAnalysis>, findings: &mut Findings) -> Facts {
    let absent: Vec<&View> = capture.views.iter().filter(|view| view.image.is_none()).collect();
    let all = absent.len() == capture.views.len();
    for assumption in &capture.assumptions {
        findings.add(FindingKind::Assumption, &[assumption]);
    }
    if let Some(finding) = findings.about(FindingKind::ImagesAbsent, absent, &[&capture.views.len()])
        && all
    {
        finding.severity = Severity::Error;
    }
    single::examine(capture, findings);
    single::of_exif(capture, findings);
    layout::examine(capture, analysis, findings);
    pixels::without_alpha(capture, analysis, findings);
    let resolutions = pixels::sizes(capture, findings)
        .into_iter()
        .map(|([width, height], images)| Resolution { width, height, images })
        .collect();
    let parts = Split::ALL.into_iter().map(|split| {
        let count = |exists: bool| {
            let views = capture.views.iter().filter(|view| view.split == Some(split));
            views.filter(|view| view.image.is_some() == exists).count()
        };
        CaptureSubset { split, present: count(true), absent: count(false) }
    });
    let sized = || capture.views.iter().map(|view| &view.camera).filter(|camera| camera.width > 0);
    let mut lenses: Vec<String> = capture.views.iter().map(|view| single::described(&view.camera.lens)).collect();
    lenses.sort();
    lenses.dedup();
    Facts {
        folder: capture.folder.clone(),
        format: capture.format.to_string(),
        subsets: parts.filter(|part| part.present + part.absent > 0).collect(),
        resolutions,
        focal: range(sized().map(|camera| camera.focal[0]).collect()),
        field_of_view: range(sized().map(|camera| single::field_of_view(camera, 0)).collect()),
        lenses,
        points: capture.points.len(),
        layout: analysis.map(|analysis| SceneLayout {
            scene_type: analysis.scene_type,
            reason: analysis.reason.clone(),
            near: analysis.near,
            far: analysis.far,
            bounds: analysis.bounds,
            scale: analysis.transform.scale,
            up: analysis.transform.rotation.transpose() * DVec3::Z,
            middle: analysis.transform.origin,
        }),
        agreement: None,
        compared: 0,
    }
}

fn range(values: Vec<f64>) -> Option<Range> {
    let least = values.iter().copied().fold(f64::INFINITY, f64::min);
    let most = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    (!values.is_empty()).then(|| Range { least, median: median(values), most })
}
