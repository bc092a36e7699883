//! Geometry of the drawing: cameras, points and the scene box, in scene units with z up.

use std::collections::HashSet;

use glam::DVec3;
use raygrad::nerf::dataset::{Capture, SceneAnalysis, SceneTransform, SceneType, Split, evenly_spaced};
use raygrad::nerf::doctor::{Report, Severity};
use serde::Serialize;

/// Most points of a drawing.
const POINTS: usize = 6000;
/// Length of a drawn camera, as a fraction of the median distance of cameras from the centre.
const LENGTH: f64 = 0.1;

/// A camera as a pyramid.
#[derive(Serialize)]
pub struct Pyramid {
    /// Name of its image.
    pub name: String,
    /// `train`, `test` (held out), or `absent`, also for images in no split.
    pub kind: &'static str,
    /// True if a warning or an error names it.
    pub flagged: bool,
    /// Camera centre.
    pub eye: DVec3,
    /// The corners of its image: upper left, upper right, lower right, lower left.
    pub corners: [DVec3; 4],
}

/// All objects of a drawing.
#[derive(Serialize)]
pub struct Stage {
    pub cameras: Vec<Pyramid>,
    /// Positions of the points.
    pub points: Vec<DVec3>,
    /// Colours of the points.
    pub colors: Vec<[u8; 3]>,
    /// Lower and upper corner of the scene box.
    pub bounds: [DVec3; 2],
    /// True for a bounded scene.
    pub bounded: bool,
    /// Centre and half width of the drawing.
    pub centre: DVec3,
    pub reach: f64,
}

impl Stage {
    /// The stage of a capture. Without an analysis, it uses the capture's coordinates.
    pub fn new(capture: &Capture, analysis: Option<&SceneAnalysis>, report: &Report) -> Self {
        let transform = analysis.map_or_else(SceneTransform::default, |analysis| analysis.transform);
        let flagged: HashSet<&String> = report
            .findings
            .iter()
            .filter(|finding| finding.severity > Severity::Note)
            .flat_map(|finding| &finding.views)
            .collect();
        let mut distances: Vec<f64> =
            capture.views.iter().map(|view| transform.point(view.camera.pose.translation).length()).collect();
        distances.sort_by(f64::total_cmp);
        let usual = distances.get(distances.len() / 2).copied().filter(|distance| *distance > 0.0).unwrap_or(1.0);
        let cameras = capture.views.iter().map(|view| {
            let camera = transform.camera(&view.camera);
            let eye = camera.pose.translation;
            let [width, height] = [camera.width.max(1) as f64, camera.height.max(1) as f64];
            let [x, y] = [0, 1].map(|axis| (0.5 * [width, height][axis] / camera.focal[axis]).clamp(0.05, 1.5));
            let corner = |x: f64, y: f64| eye + LENGTH * usual * (camera.pose.matrix3 * DVec3::new(x, y, -1.0));
            Pyramid {
                name: view.name.clone(),
                kind: match (&view.image, view.split) {
                    (None, _) | (_, None) => "absent",
                    (_, Some(Split::Train)) => "train",
                    _ => "test",
                },
                flagged: flagged.contains(&view.name) && view.image.is_some(),
                eye,
                corners: [corner(-x, y), corner(x, y), corner(x, -y), corner(-x, -y)],
            }
        });
        let mut cameras: Vec<Pyramid> = cameras.collect();
        cameras.retain(|camera| camera.eye.is_finite());
        let bounds =
            analysis.map_or([DVec3::splat(-0.5 * usual), DVec3::splat(0.5 * usual)], |analysis| analysis.bounds);
        let [mut low, mut high] = bounds;
        for camera in &cameras {
            // Distant cameras are clamped, so that one outlier does not shrink all others.
            let eye = camera.eye.clamp(DVec3::splat(-5.0 * usual), DVec3::splat(5.0 * usual));
            (low, high) = (low.min(eye), high.max(eye));
        }
        let centre = 0.5 * (low + high);
        let reach = 1.1 * (0.5 * (high - low).max_element() + LENGTH * usual);
        let inside = capture.points.iter().map(|point| (transform.point(point.position), point.color));
        let inside = inside.filter(|(place, _)| (*place - centre).abs().max_element() < 1.5 * reach).collect();
        let (points, colors) = evenly_spaced(inside, POINTS).into_iter().unzip();
        let bounded = analysis.is_none_or(|analysis| analysis.scene_type == SceneType::Bounded);
        Stage { cameras, points, colors, bounds, bounded, centre, reach }
    }
}
