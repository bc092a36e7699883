//! What is drawn of a capture: cameras, points and the box, in scene units with z up.

use std::collections::HashSet;

use glam::DVec3;
use raygrad::nerf::dataset::{Capture, SceneAnalysis, SceneTransform, SceneType, Split, evenly_spaced};
use raygrad::nerf::doctor::{Report, Severity};
use serde::Serialize;

/// Points that are drawn at most.
const POINTS: usize = 6000;
/// The length of a drawn camera, as a share of the median distance of cameras from the middle.
const LENGTH: f64 = 0.1;

/// A camera as a pyramid.
#[derive(Serialize)]
pub struct Pyramid {
    /// The name of its photograph.
    pub name: String,
    /// `train`, `test` (held out), or `absent`.
    pub kind: &'static str,
    /// Whether a finding above a note names it.
    pub flagged: bool,
    /// Where it stands.
    pub eye: DVec3,
    /// The corners of its image: upper left, upper right, lower right, lower left.
    pub corners: [DVec3; 4],
}

/// Everything that is drawn.
#[derive(Serialize)]
pub struct Stage {
    pub cameras: Vec<Pyramid>,
    /// Places of points of the scene.
    pub points: Vec<DVec3>,
    /// Their colours.
    pub colors: Vec<[u8; 3]>,
    /// Lower and upper corner of the box.
    pub bounds: [DVec3; 2],
    /// Whether the scene ends there.
    pub bounded: bool,
    /// The middle of what is drawn, and half of its width.
    pub centre: DVec3,
    pub reach: f64,
}

impl Stage {
    /// Of a capture; one that has no survey is drawn in its own coordinates.
    pub fn new(capture: &Capture, survey: Option<&SceneAnalysis>, report: &Report) -> Self {
        let placement = survey.map_or_else(SceneTransform::default, |survey| survey.transform);
        let flagged: HashSet<&String> = report
            .findings
            .iter()
            .filter(|finding| finding.severity > Severity::Note)
            .flat_map(|finding| &finding.views)
            .collect();
        let mut distances: Vec<f64> =
            capture.views.iter().map(|view| placement.point(view.camera.pose.translation).length()).collect();
        distances.sort_by(f64::total_cmp);
        let usual = distances.get(distances.len() / 2).copied().filter(|distance| *distance > 0.0).unwrap_or(1.0);
        let cameras = capture.views.iter().map(|view| {
            let camera = placement.camera(&view.camera);
            let eye = camera.pose.translation;
            let [width, height] = [camera.width.max(1) as f64, camera.height.max(1) as f64];
            let [x, y] = [0, 1].map(|axis| (0.5 * [width, height][axis] / camera.focal[axis]).clamp(0.05, 1.5));
            let corner = |x: f64, y: f64| eye + LENGTH * usual * (camera.pose.matrix3 * DVec3::new(x, y, -1.0));
            Pyramid {
                name: view.name.clone(),
                kind: match (&view.image, view.split) {
                    (None, _) => "absent",
                    (_, Some(Split::Train) | None) => "train",
                    _ => "test",
                },
                flagged: flagged.contains(&view.name) && view.image.is_some(),
                eye,
                corners: [corner(-x, y), corner(x, y), corner(x, -y), corner(-x, -y)],
            }
        });
        let mut cameras: Vec<Pyramid> = cameras.collect();
        cameras.retain(|camera| camera.eye.is_finite());
        let bounds = survey.map_or([DVec3::splat(-0.5 * usual), DVec3::splat(0.5 * usual)], |survey| survey.bounds);
        let [mut low, mut high] = bounds;
        for camera in &cameras {
            // One camera that is far away must not hide all others.
            let eye = camera.eye.clamp(DVec3::splat(-5.0 * usual), DVec3::splat(5.0 * usual));
            (low, high) = (low.min(eye), high.max(eye));
        }
        let centre = 0.5 * (low + high);
        let reach = 1.1 * (0.5 * (high - low).max_element() + LENGTH * usual);
        let inside = capture.points.iter().map(|point| (placement.point(point.position), point.color));
        let inside = inside.filter(|(place, _)| (*place - centre).abs().max_element() < 1.5 * reach).collect();
        let (points, colors) = evenly_spaced(inside, POINTS).into_iter().unzip();
        let bounded = survey.is_none_or(|survey| survey.scene_type == SceneType::Bounded);
        Stage { cameras, points, colors, bounds, bounded, centre, reach }
    }
}
