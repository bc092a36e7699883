//! Evaluation of a model at points of a box, as renders see it.

use super::oriented_box::OrientedBox;
use super::unseen::Hidden;
use crate::camera::pinhole::Ray;
use crate::camera::rays::{Rays, Samples};
use crate::imaging::quantise;
use crate::model::{Model, densities};
use crate::space::occupancy::{OccupancyGrid, POINTS};
use crate::volume::query::Query;
use crate::volume::render::Evaluations;
use glam::DVec3;
use raygrad_autograd::{Pool, Segments, Tape, Tensor};
use raygrad_tensor::parallel;
use std::sync::atomic::{AtomicU64, Ordering};

/// Evaluates a model at points and counts the evaluations.
pub(super) struct Probe<'a> {
    model: &'a Model<f32>,
    /// The box of the extraction.
    region: OrientedBox,
    /// The box in which the model has densities, in scene units.
    reach: [DVec3; 2],
    pool: Pool<f32>,
    densities: AtomicU64,
    colors: AtomicU64,
}

impl<'a> Probe<'a> {
    /// Probes a model within `region`; `None` for the scene box.
    pub fn new(model: &'a Model<f32>, region: Option<OrientedBox>) -> Self {
        let [low, high] = model.scene_box.bounds;
        let reach = model.reach();
        Probe {
            model,
            region: region.unwrap_or_else(|| model.scene_box.bounds.into()),
            reach: [reach[0].min(low), reach[1].max(high)],
            pool: Pool::new(),
            densities: AtomicU64::new(0),
            colors: AtomicU64::new(0),
        }
    }

    /// The box of the extraction.
    pub fn region(&self) -> OrientedBox {
        self.region
    }

    /// The smallest box along the axes of the scene that holds all densities of the region.
    pub fn bounds(&self) -> [DVec3; 2] {
        let corners = self.region.corners();
        let [low, high] = corners.iter().fold([corners[0]; 2], |[low, high], &x| [low.min(x), high.max(x)]);
        [low.max(self.reach[0]), high.min(self.reach[1])]
    }

    /// The number of evaluations of the model so far.
    pub fn evaluations(&self) -> Evaluations {
        let [density, color] = [&self.densities, &self.colors].map(|count| count.load(Ordering::Relaxed));
        Evaluations { density, color, unskipped: 0 }
    }

    /// The densities at positions, in 1 / scene unit.
    pub fn densities(&self, points: &[[f32; 3]], out: &mut [f32]) {
        self.densities.fetch_add(points.len() as u64, Ordering::Relaxed);
        densities(&*self.model.field, &self.model.params, &self.pool, points, out);
    }

    /// The densities of renders at points along the axes of the region: 0 outside of it and in empty cells of the grid,
    /// if there is one. Hidden points get an infinite density. Returns the largest density of the others.
    pub fn shown(
        &self,
        grid: Option<&OccupancyGrid>,
        hidden: Option<&Hidden>,
        points: &[[f32; 3]],
        out: &mut [f32],
    ) -> f32 {
        let local = |row: usize| DVec3::from(points[row].map(f64::from));
        let place = |row: usize| self.region.rotation * local(row);
        let is_occupied = |place: DVec3| grid.is_none_or(|grid| grid.is_occupied(place));
        let is_reached = |place: DVec3| place.cmpge(self.reach[0]).all() && place.cmple(self.reach[1]).all();
        let is_shown = |row: &usize| {
            let place = place(*row);
            self.region.contains_local(local(*row)) && is_reached(place) && is_occupied(place)
        };
        let rows: Vec<usize> = (0..points.len()).filter(is_shown).collect();
        out.fill(0.0);
        let is_hidden = |row: usize| hidden.is_some_and(|hidden| hidden.holds(place(row)));
        let (dense, rows): (Vec<usize>, Vec<usize>) = rows.into_iter().partition(|&row| is_hidden(row));
        dense.into_iter().for_each(|row| out[row] = f32::INFINITY);
        if rows.is_empty() {
            return 0.0;
        }
        let asked: Vec<[f32; 3]> = rows.iter().map(|&row| place(row).as_vec3().to_array()).collect();
        let mut found = vec![0.0; rows.len()];
        self.densities(&asked, &mut found);
        rows.iter().zip(&found).for_each(|(&row, &sigma)| out[row] = sigma);
        found.into_iter().fold(0.0, f32::max)
    }

    /// For each place the unit normal, both along the axes of the region, and the colour that is seen when one looks
    /// along it from outside, in sRGB.
    ///
    /// The normal is against the slope of `ln(1 + reach density)` from `reach` before a place to `reach` behind it,
    /// along each axis. The field's own gradient would show noise finer than a pixel. Where there is no slope, the
    /// normal is up.
    pub fn look(&self, grid: Option<&OccupancyGrid>, reach: f64, places: &[DVec3]) -> (Vec<DVec3>, Vec<[u8; 3]>) {
        let gains = self.model.gain();
        let chunks: Vec<&[DVec3]> = places.chunks(POINTS).collect();
        let look = |chunk: usize| {
            let normals = self.normals(grid, reach, chunks[chunk]);
            let colors = self.colors(chunks[chunk], &normals, gains);
            normals.into_iter().zip(colors)
        };
        parallel::collect(chunks.len(), look).into_iter().flatten().unzip()
    }

    fn normals(&self, grid: Option<&OccupancyGrid>, reach: f64, places: &[DVec3]) -> Vec<DVec3> {
        let mut around = vec![[0.0; 6]; places.len()];
        let mut found = vec![0.0; places.len()];
        for (k, step) in [DVec3::X, DVec3::Y, DVec3::Z].into_iter().flat_map(|axis| [axis, -axis]).enumerate() {
            let points: Vec<[f32; 3]> =
                places.iter().map(|place| (place + reach * step).as_vec3().to_array()).collect();
            self.shown(grid, None, &points, &mut found);
            around.iter_mut().zip(&found).for_each(|(out, &sigma)| out[k] = (reach * f64::from(sigma)).ln_1p());
        }
        let normal = |[right, left, back, front, up, down]: &[f64; 6]| {
            DVec3::new(left - right, front - back, down - up).try_normalize().unwrap_or(DVec3::Z)
        };
        around.iter().map(normal).collect()
    }

    fn colors(&self, places: &[DVec3], normals: &[DVec3], gains: [f64; 3]) -> Vec<[u8; 3]> {
        self.colors.fetch_add(places.len() as u64, Ordering::Relaxed);
        let tape = Tape::with_pool(self.pool.clone());
        let params = self.model.params.bind_constant(&tape);
        let mut rays = Rays::new();
        for (place, normal) in places.iter().zip(normals) {
            let [origin, direction] = [*place, -normal].map(|vector| self.region.rotation * vector);
            rays.push(&Ray { origin, direction }, [0.0, 1.0]);
        }
        let count = rays.len();
        let (here, one) = (Tensor::zeros(&[count]), Tensor::ones(&[count]));
        let samples = Samples::new(&rays, Segments::uniform(count, 1), here, one, &self.pool);
        let frames = self.model.appearance_image.map(|look| vec![look; count]);
        let query = Query { frames: frames.as_deref(), ..Query::new(&*self.model.field, &params) };
        let color = query.color(&query.density(&samples).features, &samples);
        let stored = |color: &[f32; 3]| std::array::from_fn(|k| quantise((f64::from(color[k]) * gains[k]) as f32));
        color.value().as_slice().as_chunks::<3>().0.iter().map(stored).collect()
    }
}
