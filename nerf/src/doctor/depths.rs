//! Depth files: that they can be read, and their unit against the points of the capture.

use super::kinds::FindingKind as Kind;
use super::report::Findings;
use crate::camera::Camera;
use crate::dataset::{Capture, Depths, View, evenly_spaced};
use crate::error::Error;
use crate::memory::available_memory;
use raygrad_tensor::parallel;

/// Images whose depths are compared with points.
const COMPARED: usize = 8;
/// The fewest points on measured pixels.
const FEWEST: usize = 50;
/// The quantile of the ratios of depth to distance that is compared. Points behind a surface have smaller ones.
const QUANTILE: f64 = 0.8;
/// The cells along each side of an image, of whose points only the nearest counts: others may be behind it.
const CELLS: usize = 24;
/// The largest factor between units that can come from noise.
const MOST: f64 = 1.5;

/// Reads all depth files, in parallel. Adds findings about those that training refuses, and about their unit.
pub(super) fn examine(capture: &Capture, findings: &mut Findings) {
    let measured: Vec<&View> = capture.present().filter(|view| view.depth.is_some()).collect();
    let costs: Vec<u64> = measured.iter().map(|view| view.decoding_memory()).collect();
    let compared = if capture.points.is_empty() { 0 } else { COMPARED };
    let compared = evenly_spaced((0..measured.len()).collect(), compared);
    let all = parallel::collect_within(&costs, available_memory().map_or(u64::MAX, |free| free / 2), |i| {
        let view = measured[i];
        let Some((path, unit)) = &view.depth else { return Ok(vec![]) };
        let depths = Depths::read(path, &view.camera)?;
        Ok(if compared.contains(&i) { ratios(capture, &view.camera, (&depths, *unit)) } else { vec![] })
    });
    let errors: Vec<(&View, &Error)> =
        measured.iter().zip(&all).filter_map(|(view, ratios)| Some((*view, ratios.as_ref().err()?))).collect();
    if let Some((_, first)) = errors.first() {
        findings.about(Kind::DepthsUndecodable, errors.iter().map(|(view, _)| *view), &[first]);
    }
    if let Some(factor) = unit_factor(all.into_iter().flatten().flatten().collect()) {
        findings.add(Kind::DepthUnit, &[&format_args!("{factor:.2e}")]);
    }
}

/// The depths as multiples of the distances of points, if that is not about 1.
fn unit_factor(mut ratios: Vec<f64>) -> Option<f64> {
    if ratios.len() < FEWEST {
        return None;
    }
    ratios.sort_by(f64::total_cmp);
    let factor = ratios[(QUANTILE * ratios.len() as f64) as usize];
    (!(1.0 / MOST..=MOST).contains(&factor)).then_some(factor)
}

/// The measured depth divided by that of the point, for the nearest point in each cell of the image with measured ones.
fn ratios(capture: &Capture, camera: &Camera, (depths, unit): (&Depths, f64)) -> Vec<f64> {
    let (pose, sides) = (camera.pose, [camera.width, camera.height].map(|side| side as f64));
    let ratio = |position| {
        let [x, y] = camera.pixel_of(position)?;
        let place = [x / sides[0], y / sides[1]];
        let measured = unit * depths.at(place)?;
        let depth = -pose.matrix3.z_axis.dot(position - pose.translation);
        let cell = place.map(|share| (share * CELLS as f64) as usize);
        (measured > 0.0 && depth > 0.0).then_some((cell[1] * CELLS + cell[0], depth, measured / depth))
    };
    let mut nearest = vec![(f64::INFINITY, f64::NAN); CELLS * CELLS];
    for (cell, depth, ratio) in capture.points.iter().filter_map(|point| ratio(point.position)) {
        if depth < nearest[cell].0 {
            nearest[cell] = (depth, ratio);
        }
    }
    nearest.into_iter().filter(|(depth, _)| depth.is_finite()).map(|(_, ratio)| ratio).collect()
}
