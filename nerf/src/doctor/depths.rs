//! The unit of measured depths, against the points of the capture.

use super::kinds::FindingKind as Kind;
use super::report::Findings;
use crate::dataset::{Capture, Depths, View, evenly_spaced};

/// Depth files that are read.
const READ: usize = 8;
/// The fewest points on measured pixels.
const FEWEST: usize = 50;
/// The quantile of the ratios of depth to distance that is compared. Points behind a surface have smaller ones.
const QUANTILE: f64 = 0.8;
/// The largest factor between units that can come from noise.
const MOST: f64 = 1.5;

pub(super) fn examine(capture: &Capture, findings: &mut Findings) {
    if let Some(factor) = unit_factor(capture) {
        findings.add(Kind::DepthUnit, &[&format_args!("{factor:.2e}")]);
    }
}

/// The depths as multiples of the distances of points, if that is not about 1.
fn unit_factor(capture: &Capture) -> Option<f64> {
    let measured = capture.present().filter(|view| view.depth.is_some()).collect();
    let mut ratios: Vec<f64> =
        evenly_spaced(measured, READ).into_iter().flat_map(|view| ratios(capture, view).unwrap_or_default()).collect();
    if ratios.len() < FEWEST {
        return None;
    }
    ratios.sort_by(f64::total_cmp);
    let factor = ratios[(QUANTILE * ratios.len() as f64) as usize];
    (!(1.0 / MOST..=MOST).contains(&factor)).then_some(factor)
}

/// For each point that falls on a measured pixel, the measured depth divided by that of the point.
fn ratios(capture: &Capture, view: &View) -> Option<Vec<f64>> {
    let (path, unit) = view.depth.as_ref()?;
    let depths = Depths::read(path).ok()?;
    let (pose, sides) = (view.camera.pose, [view.camera.width, view.camera.height].map(|side| side as f64));
    let ratio = |position| {
        let [x, y] = view.camera.pixel_of(position)?;
        let measured = unit * depths.at([x / sides[0], y / sides[1]])?;
        let depth = -pose.matrix3.z_axis.dot(position - pose.translation);
        (measured > 0.0 && depth > 0.0).then_some(measured / depth)
    };
    Some(capture.points.iter().filter_map(|point| ratio(point.position)).collect())
}
