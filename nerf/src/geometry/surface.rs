//! The surface that a model's pictures show.

use super::colored_mesh::ColoredMesh;
use super::isosurface::{Lattice, MOST_CELLS, isosurface};
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

/// Cells of a lattice along each cell of an occupancy grid, unless it is said otherwise.
const FINER: usize = 2;
/// Where a sampler has no grid, one is made of cells that hold at least this share of the level.
const FAINT: f64 = 0.1;
/// Pixels along the longer side of the pictures that say what is seen, at most.
const PIXELS: f64 = 128.0;

/// Which surface of a model is made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceConfig {
    /// Cells of the lattice along the longest side of the box, 1 to 4096; without it two for each of the model's occupancy
    /// grid, or of a grid of 128 cells.
    pub resolution: Option<usize>,
    /// The density on the surface, in 1 / scene unit, above 0; without it the one at which cameras see it.
    pub iso_value: Option<f64>,
    /// Parts of less than this share of the largest one's area, 0 to 1, are left out.
    pub min_component: f64,
    /// How many triangles there may be, at least 4, if not as many as it takes.
    pub triangles: Option<usize>,
    /// Whether what no camera sees is taken to be dense, further than a cell of the occupancy grid behind what is seen: there the
    /// field was never judged, and holds sponges and voids. What pictures leave out stays empty.
    pub fill_unseen: bool,
    /// Whether the surface is closed where it meets the box. Otherwise it ends there.
    pub closed: bool,
}

impl Default for SurfaceConfig {
    fn default() -> Self {
        SurfaceConfig {
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
            return Err(Error::setting("level", format!("is {level}; use a density above 0")));
        }
        self.triangles.map_or(Ok(()), |count| check_range("triangles", count, 4, u32::MAX as usize))
    }
}

/// What is being done.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Looking for the places that cameras see.
    Seeing,
    /// Looking for the surface.
    Meshing,
    /// Making triangles fewer.
    Simplifying,
    /// Finding normals and colours.
    Coloring,
}

/// A surface, and how it was made.
#[derive(Debug, Clone)]
pub struct Surface {
    /// The surface, in scene units.
    pub colored_mesh: ColoredMesh,
    /// The density on it, in 1 / scene unit.
    pub iso_value: f64,
    /// Cells of the lattice along the longest side of the box.
    pub resolution: usize,
    /// How many small parts were left out.
    pub dropped: usize,
    /// How often the model was asked.
    pub evaluations: Evaluations,
}

impl Model<f32> {
    /// The surface within the model's box (of a scene that goes on, the part of it where the cameras look), with normals
    /// against the slope of the density (over an edge of the occupancy grid's cells, as finer slopes are noise) and the colours that are seen along these.
    ///
    /// It is where the density has one [level](SurfaceConfig::iso_value). If none is given, it is the lower quartile of the
    /// densities at the places where half of a ray's light is blocked, over rays of the `cameras` that end in something solid: so
    /// the surface lies where pictures show it, and has few holes. What pictures leave out, cells that are not occupied, counts as empty.
    ///
    /// `progress` is told what is being done, and what share of that is, 0 to 1.
    ///
    /// # Errors
    /// If a number of the configuration is out of range, there is no surface, or it is too large.
    pub fn surface(
        &self,
        cameras: &[Camera],
        config: &SurfaceConfig,
        progress: &mut dyn FnMut(Stage, f64),
    ) -> Result<Surface> {
        config.check()?;
        let (probe, bounds) = (Probe::new(self), self.scene_box.bounds);
        let views = if config.fill_unseen || config.iso_value.is_none() {
            let scale = |camera: &Camera| (PIXELS / camera.width.max(camera.height) as f64).min(1.0);
            views(self, cameras, scale, &mut |done| progress(Stage::Seeing, done))
        } else {
            vec![]
        };
        let level = config.iso_value.map_or_else(|| self.level(&views), Ok)?;
        let grid = match self.cells() {
            Some(grid) => Cow::Borrowed(grid),
            None => {
                let mut grid = OccupancyGrid::new(bounds, &OccupancyConfig::default())?;
                grid.rebuild((FAINT * level) as f32, true, &|points, out| probe.densities(points, out));
                Cow::Owned(grid)
            }
        };
        let judged = self.judged(Some(&grid));
        let hidden = config.fill_unseen.then(|| Hidden::new(&views, judged));
        let resolution = config.resolution.unwrap_or(FINER * grid.resolution());
        let lattice = Lattice::over(if config.closed { bounds } else { within(bounds) }, resolution, config.closed)?;
        // What is hidden is dense whatever the level.
        let is_met = AtomicBool::new(false);
        let shown = |points: &[[f32; 3]], out: &mut [f32]| {
            if probe.shown(Some(&grid), hidden.as_ref(), points, out) > level as f32 {
                is_met.store(true, Ordering::Relaxed);
            }
        };
        let mut mesh = isosurface(&lattice, level as f32, &shown, &mut |done| progress(Stage::Meshing, done))?;
        if mesh.triangles.is_empty() || !is_met.into_inner() {
            return Err(Error::setting(
                "level",
                format!("is {level}, and there is no such density: use a smaller one"),
            ));
        }
        let dropped = mesh.drop_small_components(config.min_component);
        if let Some(count) = config.triangles {
            mesh.decimate(count, &mut |done| progress(Stage::Simplifying, done));
        }
        progress(Stage::Coloring, 0.0);
        let (normals, colors) = probe.look(Some(&grid), judged, &mesh.positions);
        let evaluations = views.iter().fold(probe.evaluations(), |sum, (_, seen)| sum + seen.evaluations);
        Ok(Surface {
            colored_mesh: ColoredMesh { mesh, normals, colors },
            iso_value: level,
            resolution,
            dropped,
            evaluations,
        })
    }

    /// The cells that views look at, if they leave out any.
    pub(super) fn cells(&self) -> Option<&OccupancyGrid> {
        self.marching().map(Marching::view_grid).or_else(|| self.sampler.grid())
    }

    /// The length, in scene units, below which photographs hardly judged the field: an edge of a cell of the grid.
    pub(super) fn judged(&self, grid: Option<&OccupancyGrid>) -> f64 {
        let cells = grid.map_or_else(|| OccupancyConfig::default().resolution, OccupancyGrid::resolution);
        self.scene_box.space().side() / cells as f64
    }

    /// The lower quartile of the density of the places within the box that cameras see. Where the density is less the surface has
    /// holes, and where it is more it lies but a little too far out.
    fn level(&self, views: &[(Camera, Seen)]) -> Result<f64> {
        let sights = views.iter().flat_map(|(_, seen)| seen.sights.iter().flatten());
        let mut sigmas: Vec<f64> =
            sights.filter(|sight| self.scene_box.contains(sight.place)).map(|sight| sight.sigma).collect();
        let quarter = sigmas.len() / 4;
        if sigmas.is_empty() {
            return Err(Error::setting("level", "is not known: no camera sees anything solid. Give one"));
        }
        Ok(*sigmas.select_nth_unstable_by(quarter, f64::total_cmp).1)
    }
}

/// The largest box within this one whose corners are numbers in f32: places on its faces are in the box when they are asked for.
fn within([low, high]: [DVec3; 2]) -> [DVec3; 2] {
    let above = |x: f64| {
        let near = x as f32;
        f64::from(if f64::from(near) < x { near.next_up() } else { near })
    };
    [low.to_array().map(above).into(), high.to_array().map(|x| -above(-x)).into()]
}

#[cfg(test)]
mod tests;
