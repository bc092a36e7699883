//! Near and far depth of images, for LLFF.

use raygrad::nerf::Result;
use raygrad::nerf::dataset::{Capture, Point, SceneAnalysis, View};
use raygrad::nerf::glam::DVec3;

use crate::output::complain;

/// Fewest points of an image for an estimate of its depths.
const FEWEST: usize = 20;
/// The fraction of points that are cut as outliers at either end, as in LLFF.
const WRONG: f64 = 0.001;
/// The least near depth that the scene box gives, as a share of the far depth.
const LEAST: f64 = 0.01;

/// The depths of each view: from the file, else from its points, else from the scene box. Also returns the number of
/// views that use the box.
pub fn of(capture: &Capture) -> Result<(Vec<[f64; 2]>, usize)> {
    let found: Vec<_> = capture.views.iter().map(|view| view.bounds.or_else(|| shown(view, &capture.points))).collect();
    let guessed = found.iter().filter(|bounds| bounds.is_none()).count();
    if guessed == 0 {
        return Ok((found.into_iter().flatten().collect(), 0));
    }
    let analysis = match capture.analyze_scene(None) {
        Ok(analysis) => analysis,
        // Training refuses the images, but the cameras have a scene box.
        Err(error) => {
            let analysis = SceneAnalysis::new(capture, None, None)?;
            complain(&format!(
                "warning: near and far come from the cameras alone, because training refuses these images: {error}"
            ));
            analysis
        }
    };
    let transform = analysis.transform;
    let reach = analysis.bounds[0].distance(analysis.bounds[1]) * 0.5 / transform.scale;
    let middle = transform.point_back(0.5 * (analysis.bounds[0] + analysis.bounds[1]));
    let near = analysis.near / transform.scale;
    let guess = |view: &View| {
        let far = view.camera.pose.translation.distance(middle) + reach;
        in_box(near, far)
    };
    let all = found.iter().zip(&capture.views).map(|(bounds, view)| bounds.unwrap_or_else(|| guess(view)));
    Ok((all.collect(), guessed))
}

/// The depths of a box that begins at `near` for one camera, and ends at `far` for this one.
fn in_box(near: f64, far: f64) -> [f64; 2] {
    // Programs divide by the near depth, and the box begins at 0 for a camera inside.
    [near.clamp(LEAST * far, 0.5 * far), far]
}

/// The near and far depth of the points that an image shows.
fn shown(view: &View, points: &[Point]) -> Option<[f64; 2]> {
    let camera = &view.camera;
    let depth = |point: DVec3| {
        let [x, y] = camera.pixel_of(point)?;
        let inside = (0.0..camera.width as f64).contains(&x) && (0.0..camera.height as f64).contains(&y);
        let depth = -(point - camera.pose.translation).dot(camera.pose.matrix3.z_axis);
        (inside && depth > 0.0).then_some(depth)
    };
    let mut depths: Vec<f64> = points.iter().filter_map(|point| depth(point.position)).collect();
    if depths.len() < FEWEST {
        return None;
    }
    depths.sort_by(f64::total_cmp);
    let last = depths.len() - 1;
    let at = |share: f64| depths[(share * last as f64).round() as usize];
    let [near, far] = [at(WRONG), at(1.0 - WRONG)];
    (near < far).then_some([near, far])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_depth_is_above_zero_and_before_far() {
        assert_eq!([0.0, 3.0, 9.0].map(|near| in_box(near, 10.0)), [[0.1, 10.0], [3.0, 10.0], [5.0, 10.0]]);
    }
}
