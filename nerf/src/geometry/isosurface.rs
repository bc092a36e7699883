//! Isosurfaces of functions by marching cubes.

use super::marching_cubes_table::cases;
use super::mesh::Mesh;
use crate::space::occupancy::{DensityFn, POINTS};
use crate::{Error, Result};
use glam::DVec3;
use raygrad_tensor::parallel;

/// Bisections of each edge that the surface crosses.
const HALVINGS: usize = 5;
/// The least distance of vertices from the ends of the last interval, as a share of it, so that vertices never
/// coincide.
const MARGIN: f64 = 0.01;
/// The most cells along an axis.
pub(super) const MOST_CELLS: usize = 4096;
/// The most vertices; with the data of each they take some gigabytes.
const MOST_VERTICES: usize = 1 << 26;

/// A lattice of evenly spaced nodes, on which [`isosurface`] evaluates a function.
#[derive(Debug, Clone, PartialEq)]
pub struct Lattice {
    /// The first node.
    low: DVec3,
    /// The distance between nodes along each axis.
    cell: DVec3,
    /// The number of nodes along each axis.
    nodes: [usize; 3],
}

impl Lattice {
    /// Creates a lattice over a box (lower and upper corner), with `resolution` cells along its longest side, 1 to
    /// 4096.
    ///
    /// Cells are nearly cubes. A `closed` lattice extends half a cell beyond the box, so that surfaces of functions
    /// that are 0 there have no border.
    ///
    /// # Errors
    /// If the box is flat or not finite, or `resolution` is out of range.
    pub fn over([low, high]: [DVec3; 2], resolution: usize, closed: bool) -> Result<Self> {
        let size = high - low;
        if !(size.is_finite() && size.cmpgt(DVec3::ZERO).all()) {
            return Err(Error::setting(
                "bounds",
                format!("is {low} to {high}; use finite corners, the lower below the upper"),
            ));
        }
        if !(1..=MOST_CELLS).contains(&resolution) {
            return Err(Error::setting("resolution", format!("is {resolution}; use 1 to {MOST_CELLS}")));
        }
        let cells = (size / size.max_element() * resolution as f64).round().max(DVec3::ONE);
        let (cell, more) = (size / cells, if closed { 2 } else { 1 });
        let low = if closed { low - 0.5 * cell } else { low };
        Ok(Lattice { low, cell, nodes: cells.to_array().map(|cells| cells as usize + more) })
    }

    /// Returns the longest edge of a cell.
    pub fn cell(&self) -> f64 {
        self.cell.max_element()
    }

    fn node(&self, node: [usize; 3]) -> DVec3 {
        self.low + self.cell * DVec3::from(node.map(|i| i as f64))
    }
}

/// An edge of the lattice that the surface crosses.
struct Crossing {
    /// The lower node and the axis.
    node: [u32; 3],
    axis: u8,
    /// The values at the lower and the upper end.
    values: [f32; 2],
}

/// The nodes of one layer, and the vertices on the edges that start there.
struct Layer {
    values: Vec<f32>,
    /// Vertex numbers by axis and node. Edges along z lead to the next layer. The number is meaningless without a
    /// crossing.
    vertices: [Vec<u32>; 3],
}

/// Extracts the surface around all points where `density` exceeds `level`, facing outwards.
///
/// It is marching cubes (Lorensen and Cline 1987) with a consistent table. The surface has no holes, and two triangles
/// meet at each edge, except at the lattice's border. Vertices on lattice edges are found by bisection.
/// Positions are f32. Memory is proportional to a layer of the lattice and to the surface. `progress` receives the
/// share of the lattice, 0 to 1.
///
/// # Errors
/// If there are more than 2^26 vertices.
pub fn isosurface(
    lattice: &Lattice,
    level: f32,
    density: &DensityFn<'_>,
    progress: &mut dyn FnMut(f64),
) -> Result<Mesh> {
    limited(lattice, level, density, progress, MOST_VERTICES)
}

/// [`isosurface`] with at most `most` vertices.
fn limited(
    lattice: &Lattice,
    level: f32,
    density: &DensityFn<'_>,
    progress: &mut dyn FnMut(f64),
    most: usize,
) -> Result<Mesh> {
    let (cases, [width, height, layers]) = (cases(), lattice.nodes);
    let (mut crossings, mut triangles) = (vec![], vec![]);
    let is_dense = |value: f32| value > level;
    let mut below: Option<Layer> = None;
    for z in 0..layers {
        let values = layer(lattice, z, density);
        let unset = || vec![0; values.len()];
        let mut above = Layer { vertices: [unset(), unset(), unset()], values };
        let mut cross = |vertex: &mut u32, node: [usize; 3], axis: usize, values: [f32; 2]| {
            if is_dense(values[0]) != is_dense(values[1]) {
                *vertex = crossings.len() as u32;
                crossings.push(Crossing { node: node.map(|i| i as u32), axis: axis as u8, values });
            }
        };
        for (i, &value) in above.values.iter().enumerate() {
            let node = [i % width, i / width, z];
            if node[0] + 1 < width {
                cross(&mut above.vertices[0][i], node, 0, [value, above.values[i + 1]]);
            }
            if node[1] + 1 < height {
                cross(&mut above.vertices[1][i], node, 1, [value, above.values[i + width]]);
            }
            if let Some(below) = &mut below {
                cross(&mut below.vertices[2][i], [node[0], node[1], z - 1], 2, [below.values[i], value]);
            }
        }
        if crossings.len() > most {
            let what = format!(
                "is too fine: the surface has more than {most} vertices; use fewer cells, or another iso-value for fog"
            );
            return Err(Error::setting("resolution", what));
        }
        if let Some(below) = &below {
            let between = [below, &above];
            for (x, y) in (0..height - 1).flat_map(|y| (0..width - 1).map(move |x| (x, y))) {
                // The index in its layer of a corner, or of an edge that starts there.
                let place = |corner: usize| x + (corner & 1) + width * (y + (corner >> 1 & 1));
                let bit = |corner: usize| usize::from(is_dense(between[corner >> 2].values[place(corner)])) << corner;
                let dense: usize = (0..8).map(bit).sum();
                let vertex = |edge: super::marching_cubes_table::Edge| {
                    between[edge.corner >> 2].vertices[edge.axis][place(edge.corner)]
                };
                triangles.extend(cases[dense].iter().map(|edges| edges.map(vertex)));
            }
        }
        below = Some(above);
        progress((z + 1) as f64 / layers as f64);
    }
    Ok(Mesh { positions: places(lattice, level, density, &crossings), triangles })
}

/// The values at the nodes of a layer.
fn layer(lattice: &Lattice, z: usize, density: &DensityFn<'_>) -> Vec<f32> {
    let [width, height, _] = lattice.nodes;
    let mut values = vec![0.0; width * height];
    parallel::each_of(values.chunks_mut(POINTS), |chunk, out| {
        let nodes = (chunk * POINTS..).take(out.len()).map(|i| lattice.node([i % width, i / width, z]));
        let points: Vec<[f32; 3]> = nodes.map(|place| place.as_vec3().to_array()).collect();
        parallel::serial(|| density(&points, out));
    });
    values
}

/// The positions at which these edges cross the level.
fn places(lattice: &Lattice, level: f32, density: &DensityFn<'_>, crossings: &[Crossing]) -> Vec<DVec3> {
    let mut places = vec![DVec3::ZERO; crossings.len()];
    let parts = places.chunks_mut(POINTS).zip(crossings.chunks(POINTS));
    parallel::each_of(parts, |_, (places, crossings)| {
        // For each edge, the interval with the crossing, as shares of the edge, and the values at its ends.
        let mut parts: Vec<[(f64, f32); 2]> =
            crossings.iter().map(|c| [(0.0, c.values[0]), (1.0, c.values[1])]).collect();
        let at = |crossing: &Crossing, share: f64| {
            let mut place = lattice.node(crossing.node.map(|i| i as usize));
            place[crossing.axis as usize] += share * lattice.cell[crossing.axis as usize];
            place
        };
        let mut found = vec![0.0; parts.len()];
        for _ in 0..HALVINGS {
            let middle = |[from, to]: &[(f64, f32); 2]| 0.5 * (from.0 + to.0);
            let points = crossings.iter().zip(&parts).map(|(crossing, part)| at(crossing, middle(part)));
            let points: Vec<[f32; 3]> = points.map(|place| place.as_vec3().to_array()).collect();
            parallel::serial(|| density(&points, &mut found));
            for (part, &value) in parts.iter_mut().zip(&found) {
                let second = (value > level) != (part[0].1 > level);
                part[usize::from(second)] = (middle(part), value);
            }
        }
        for ((place, crossing), [from, to]) in places.iter_mut().zip(crossings).zip(&parts) {
            // Values are nearly linear by now. Infinite values give no ratio.
            let share = f64::from((level - from.1) / (to.1 - from.1));
            let known = from.1.is_finite() && to.1.is_finite() && !share.is_nan();
            let share = if known { share.clamp(MARGIN, 1.0 - MARGIN) } else { 0.5 };
            *place = at(crossing, from.0 + share * (to.0 - from.0));
        }
    });
    places
}

#[cfg(test)]
mod tests;
