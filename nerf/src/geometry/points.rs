//! Point clouds of the visible surface.

use super::colored_mesh::ColoredMesh;
use super::mesh::{Mesh, bounds};
use super::oriented_box::OrientedBox;
use super::probe::Probe;
use super::sight::views;
use super::surface::Stage;
use crate::camera::Camera;
use crate::model::Model;
use crate::volume::render::Evaluations;
use crate::{Error, Result};
use glam::DVec3;
use std::collections::HashMap;

/// Rays per requested point: some rays hit nothing, and several hits may become one point.
const RAYS: f64 = 12.0;
/// Bisections of the logarithm of the voxel size. Its range is about 14, so they give the size to a thousandth.
const HALVINGS: usize = 14;

/// An extracted point cloud.
#[derive(Debug, Clone)]
pub struct PointCloud {
    /// The points, in scene units.
    pub colored_mesh: ColoredMesh,
    /// Number of visible points before thinning.
    pub sights: usize,
    /// Number of field evaluations.
    pub evaluations: Evaluations,
}

impl Model<f32> {
    /// Extracts visible points within `region`, the scene box by default, with normals and colours as in
    /// [`surface`](Self::surface).
    ///
    /// A point lies where half of a ray's light is blocked, for opaque rays of the `cameras`. Points are thinned to at
    /// most `count`, one per voxel of a grid, so that they are about evenly spaced. `progress` receives the stage and
    /// its progress, 0 to 1.
    ///
    /// # Errors
    /// If no camera sees a surface.
    pub fn point_cloud(
        &self,
        cameras: &[Camera],
        count: usize,
        region: Option<OrientedBox>,
        progress: &mut dyn FnMut(Stage, f64),
    ) -> Result<PointCloud> {
        // Each camera gets the same number of rays, for any image size.
        let rays = RAYS * count as f64 / cameras.len().max(1) as f64;
        let scale = |camera: &Camera| (rays / (camera.width * camera.height) as f64).sqrt();
        let probe = Probe::new(self, region);
        let region = probe.region();
        let (mut places, mut seeing) = (Vec::<DVec3>::new(), Evaluations::default());
        for (_, seen) in views(self, cameras, scale, &mut |done| progress(Stage::Seeing, done)) {
            let local = seen.sights.iter().flatten().map(|sight| region.local(sight.place));
            places.extend(local.filter(|place| region.contains_local(*place)));
            seeing = seeing + seen.evaluations;
        }
        if places.is_empty() {
            return Err(Error::setting(
                "points",
                "cannot be found: no camera sees a surface in the box; train longer or check the cameras and the box",
            ));
        }
        let sights = places.len();
        let positions = thinned(&places, count);
        progress(Stage::Coloring, 0.0);
        let (normals, colors) = probe.look(self.cells(), self.judged(self.cells()), &positions);
        let mut colored_mesh = ColoredMesh { mesh: Mesh { positions, triangles: vec![] }, normals, colors };
        colored_mesh.rotate(region.rotation);
        let evaluations = seeing + probe.evaluations();
        Ok(PointCloud { colored_mesh, sights, evaluations })
    }
}

/// Thins points to at most `count`: the one nearest to the centre of each occupied voxel, in the smallest voxels that
/// allow it.
fn thinned(places: &[DVec3], count: usize) -> Vec<DVec3> {
    let bounds = bounds(places).unwrap_or_default();
    let size = (bounds[1] - bounds[0]).max_element();
    if places.len() <= count || size == 0.0 {
        return places[..count.min(places.len())].to_vec();
    }
    // The search only asks if there are more than `count` voxels, so counting stops there.
    let in_voxels = |edge: f64| {
        let mut nearest: HashMap<[i64; 3], usize> = HashMap::new();
        for (i, &place) in places.iter().enumerate() {
            if nearest.len() > count {
                break;
            }
            let voxel = ((place - bounds[0]) / edge).floor();
            let middle = bounds[0] + edge * (voxel + 0.5);
            let kept = nearest.entry(voxel.to_array().map(|x| x as i64)).or_insert(i);
            if place.distance_squared(middle) < places[*kept].distance_squared(middle) {
                *kept = i;
            }
        }
        nearest
    };
    // One voxel larger than all points is enough for any count. Smaller voxels than the lower bound are never needed.
    let [mut small, mut large] = [(1e-6 * size).ln(), (1.001 * size).ln()];
    for _ in 0..HALVINGS {
        let middle = 0.5 * (small + large);
        *if in_voxels(middle.exp()).len() > count { &mut small } else { &mut large } = middle;
    }
    let mut kept: Vec<usize> = in_voxels(large.exp()).into_values().collect();
    kept.sort_unstable();
    kept.into_iter().map(|i| places[i]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_are_thinned_to_even_distances() {
        // Points on a plane, four times as dense on its left half.
        let place = |i: usize| {
            let (u, v) = ((i as f64 * 0.754877666).fract(), (i as f64 * 0.569840291).fract());
            DVec3::new(if i.is_multiple_of(5) { 1.0 + u } else { u }, 2.0 * v, 0.3)
        };
        let places: Vec<DVec3> = (0..20_000).map(place).collect();
        let kept = thinned(&places, 900);
        assert!((700..=900).contains(&kept.len()), "{}", kept.len());
        let left = kept.iter().filter(|place| place.x < 1.0).count();
        assert!((0.45..0.55).contains(&(left as f64 / kept.len() as f64)), "{left} of {}", kept.len());
        assert!(kept.iter().all(|place| places.contains(place)), "they are some of those that were seen");
        // The voxels have edges of about sqrt(4 / 900), and points are near their centres: few are closer than half an
        // edge.
        let near = |a: &DVec3| kept.iter().any(|b| b != a && a.distance(*b) < 0.5 * (4.0_f64 / 900.0).sqrt());
        let crowded = kept.iter().filter(|place| near(place)).count();
        assert!(crowded * 20 < kept.len(), "{crowded}");
        assert_eq!(thinned(&places, 20_000), places);
        assert_eq!(thinned(&places, 1).len(), 1);
        assert_eq!(thinned(&[DVec3::ONE; 3], 2), [DVec3::ONE; 2], "all in one place");
    }
}
