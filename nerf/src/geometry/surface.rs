//! Surface extraction from a model.

use super::colored_mesh::ColoredMesh;
use super::isosurface::{Lattice, MOST_CELLS, isosurface};
use super::oriented_box::OrientedBox;
use super::probe::Probe;
use super::sight::{Seen, views};
use super::unseen::Hidden;
use crate::camera::Camera;
use crate::model::Model;
use crate::range::check_range;
use crate::sampling::marching::Marching;
use crate::space::occupancy::{OccupancyConfig, OccupancyGrid};
use crate::volume::render::Evaluations;
use crate::{Error, Result};
use glam::DVec3;
use std::borrow::Cow;
use std::sync::atomic::{AtomicBool, Ordering};

/// The default number of lattice cells along each cell of an occupancy grid.
const FINER: usize = 2;
/// Samplers without a grid get one, of cells with at least this share of the iso-value.
const FAINT: f64 = 0.1;
/// The most pixels along the longer side of the images that find visible surfaces.
const PIXELS: f64 = 128.0;

/// Configuration of [`Model::surface`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceConfig {
    /// The box of the surface; `None` takes the scene box. There is no surface where the model has no densities: beyond
    /// the scene box of a bounded scene, and beyond the [reach](Model::reach) of others.
    pub region: Option<OrientedBox>,
    /// Lattice cells along the longest side of the box, 1 to 4096. `None` takes two per cell that the model's
    /// occupancy grid has along the scene box, or 256 without a grid; for a region of another size, set it.
    pub resolution: Option<usize>,
    /// Iso-value: the density on the surface, in 1 / scene unit, above 0. `None` estimates it from `cameras`.
    pub iso_value: Option<f64>,
    /// Components below this share of the largest one's area are removed, 0 to 1.
    pub min_component: f64,
    /// Maximum number of triangles, at least 4; `None` does not simplify.
    pub triangles: Option<usize>,
    /// Whether space that no camera sees counts as solid, from one occupancy cell behind the visible surface. The field
    /// was never trained there and has holes. Skipped cells stay empty.
    pub fill_unseen: bool,
    /// Whether the surface is closed at the box; otherwise it has an open boundary there.
    pub closed: bool,
}

impl Default for SurfaceConfig {
    fn default() -> Self {
        SurfaceConfig {
            region: None,
            resolution: None,
            iso_value: None,
            min_component: 0.01,
            triangles: None,
            fill_unseen: true,
            closed: true,
        }
    }
}

impl SurfaceConfig {
    fn check(&self) -> Result<()> {
        check_range("min_component", self.min_component, 0.0, 1.0)?;
        self.resolution.map_or(Ok(()), |cells| check_range("resolution", cells, 1, MOST_CELLS))?;
        if let Some(level) = self.iso_value.filter(|level| !(*level > 0.0 && level.is_finite())) {
            return Err(Error::setting("iso_value", format!("is {level}; use a density above 0")));
        }
        self.triangles.map_or(Ok(()), |count| check_range("triangles", count, 4, u32::MAX as usize))
    }
}

/// The stage of an extraction, for progress callbacks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Finding visible points.
    Seeing,
    /// Extracting the surface.
    Meshing,
    /// Simplifying the mesh.
    Simplifying,
    /// Computing normals and colours.
    Coloring,
}

/// An extracted surface.
#[derive(Debug, Clone)]
pub struct Surface {
    /// The surface, in scene units.
    pub colored_mesh: ColoredMesh,
    /// The iso-value, in 1 / scene unit.
    pub iso_value: f64,
    /// Lattice cells along the longest side of the box.
    pub resolution: usize,
    /// Number of removed components.
    pub dropped: usize,
    /// Number of field evaluations.
    pub evaluations: Evaluations,
}

impl Model<f32> {
    /// Extracts the surface within a [box](SurfaceConfig::region). The scene box of an unbounded scene is the part that
    /// cameras look at.
    ///
    /// It is the isosurface of the density at the [iso-value](SurfaceConfig::iso_value). The default iso-value is the
    /// lower quartile of the densities where half of a ray's light is blocked, over opaque rays of the `cameras`. So
    /// the surface lies where renders show it, with few holes. Unoccupied cells are empty. Normals are density
    /// gradients over the edge of an occupancy cell; colours are those seen along the normals.
    ///
    /// `progress` receives the stage and its progress, 0 to 1.
    ///
    /// # Errors
    /// If the configuration is out of range, there is no surface, or it is too large.
    pub fn surface(
        &self,
        cameras: &[Camera],
        config: &SurfaceConfig,
        progress: &mut dyn FnMut(Stage, f64),
    ) -> Result<Surface> {
        config.check()?;
        let probe = Probe::new(self, config.region);
        let region = probe.region();
        let views: Vec<_> = if config.fill_unseen || config.iso_value.is_none() {
            let scale = |camera: &Camera| (PIXELS / camera.width.max(camera.height) as f64).min(1.0);
            views(self, cameras, scale, &mut |done| progress(Stage::Seeing, done)).collect()
        } else {
            vec![]
        };
        let level = config.iso_value.map_or_else(|| level(&views, &region), Ok)?;
        let grid = match self.cells() {
            Some(grid) => Cow::Borrowed(grid),
            None => {
                let mut grid = OccupancyGrid::new(probe.bounds(), &OccupancyConfig::default())?;
                grid.rebuild((FAINT * level) as f32, true, &|points, out| probe.densities(points, out));
                Cow::Owned(grid)
            }
        };
        let judged = self.judged(Some(&grid));
        let hidden = config.fill_unseen.then(|| Hidden::new(&views, judged));
        let resolution = config.resolution.unwrap_or(FINER * grid.resolution());
        let bounds = if config.closed { region.bounds } else { within(region.bounds) };
        let lattice = Lattice::over(bounds, resolution, config.closed)?;
        // Unseen points have infinite density, above any iso-value.
        let is_met = AtomicBool::new(false);
        let shown = |points: &[[f32; 3]], out: &mut [f32]| {
            if probe.shown(Some(&grid), hidden.as_ref(), points, out) > level as f32 {
                is_met.store(true, Ordering::Relaxed);
            }
        };
        let mut mesh = isosurface(&lattice, level as f32, &shown, &mut |done| progress(Stage::Meshing, done))?;
        if mesh.triangles.is_empty() || !is_met.into_inner() {
            return Err(Error::setting(
                "iso_value",
                format!("is {level}, above all densities in the box; use a smaller one, or another box"),
            ));
        }
        let dropped = mesh.drop_small_components(config.min_component);
        if let Some(count) = config.triangles {
            mesh.decimate(count, &mut |done| progress(Stage::Simplifying, done));
        }
        progress(Stage::Coloring, 0.0);
        let (normals, colors) = probe.look(Some(&grid), judged, &mesh.positions);
        let evaluations = views.iter().fold(probe.evaluations(), |sum, (_, seen)| sum + seen.evaluations);
        let mut colored_mesh = ColoredMesh { mesh, normals, colors };
        colored_mesh.rotate(region.rotation);
        Ok(Surface { colored_mesh, iso_value: level, resolution, dropped, evaluations })
    }

    /// The occupancy grid of renders, if they skip cells.
    pub(super) fn cells(&self) -> Option<&OccupancyGrid> {
        self.marching().map(Marching::view_grid).or_else(|| self.sampler.grid())
    }

    /// The length, in scene units, below which images hardly determine the field: the edge of a grid cell.
    pub(super) fn judged(&self, grid: Option<&OccupancyGrid>) -> f64 {
        let cells = grid.map_or_else(|| OccupancyConfig::default().resolution, OccupancyGrid::resolution);
        self.scene_box.space().side() / cells as f64
    }
}

/// The lower quartile of the densities at the visible points in the box. A higher iso-value would make holes in the
/// surface. A lower one moves it outwards only a little.
fn level(views: &[(Camera, Seen)], region: &OrientedBox) -> Result<f64> {
    let sights = views.iter().flat_map(|(_, seen)| seen.sights.iter().flatten());
    let inside = sights.filter(|sight| region.contains_local(region.local(sight.place)));
    let mut sigmas: Vec<f64> = inside.map(|sight| sight.sigma).collect();
    let quarter = sigmas.len() / 4;
    if sigmas.is_empty() {
        let what = "is missing, and no camera sees a surface in the box to estimate it; set it";
        return Err(Error::setting("iso_value", what));
    }
    Ok(*sigmas.select_nth_unstable_by(quarter, f64::total_cmp).1)
}

/// The largest box with f32 corners inside this one, so that points on its faces stay in the box.
fn within([low, high]: [DVec3; 2]) -> [DVec3; 2] {
    let above = |x: f64| {
        let near = x as f32;
        f64::from(if f64::from(near) < x { near.next_up() } else { near })
    };
    [low.to_array().map(above).into(), high.to_array().map(|x| -above(-x)).into()]
}

#[cfg(test)]
mod tests;
