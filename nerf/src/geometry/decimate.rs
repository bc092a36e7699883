//! Mesh simplification by edge collapse (Garland and Heckbert 1997, "Surface simplification using quadric error
//! metrics").

use super::mesh::{Mesh, sides};
use glam::{DMat3, DVec3};
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// The weight of a border relative to a triangle.
const BORDER: f64 = 100.0;
/// The least cosine of the angle between a triangle's normals before and after a collapse.
const LEAST_COSINE: f64 = 0.2;
/// The least ratio of twice a triangle's area to its squared longest side, unless the triangle was thinner before.
const THINNEST: f64 = 0.02;
/// A quadric has no unique minimum if its determinant is below this share of the largest possible value.
const FLAT: f64 = 1e-6;
/// The weight of a vertex's old position relative to its triangles'. In a plane it determines the minimum.
const STAY: f64 = 1e-6;
/// Triangles between two reports of progress.
const OFTEN: usize = 10_000;

/// A weighted sum of squared distances to planes: `x' a x - 2 b' x + c`.
#[derive(Debug, Clone, Copy)]
struct Quadric {
    a: DMat3,
    b: DVec3,
    c: f64,
}

impl Quadric {
    /// No planes.
    const NONE: Quadric = Quadric { a: DMat3::ZERO, b: DVec3::ZERO, c: 0.0 };

    /// The plane through a point with this unit normal.
    fn plane(normal: DVec3, point: DVec3, weight: f64) -> Self {
        let offset = normal.dot(point);
        let scaled = weight * normal;
        Quadric {
            a: DMat3::from_cols(normal.x * scaled, normal.y * scaled, normal.z * scaled),
            b: offset * scaled,
            c: weight * offset * offset,
        }
    }

    /// A point.
    fn point(point: DVec3, weight: f64) -> Self {
        Quadric { a: weight * DMat3::IDENTITY, b: weight * point, c: weight * point.length_squared() }
    }

    fn plus(&self, other: &Self) -> Self {
        Quadric { a: self.a + other.a, b: self.b + other.b, c: self.c + other.c }
    }

    fn at(&self, x: DVec3) -> f64 {
        (x.dot(self.a * x - 2.0 * self.b) + self.c).max(0.0)
    }

    /// The minimum, if it is unique.
    fn lowest(&self) -> Option<DVec3> {
        let size = (self.a.x_axis.x + self.a.y_axis.y + self.a.z_axis.z) / 3.0;
        (self.a.determinant() > FLAT * size.powi(3)).then(|| self.a.inverse() * self.b)
    }
}

/// A candidate for an edge collapse: the bits of its cost, its vertices, and the number of moves of each when the cost
/// was computed. The bits have the order of the costs, since costs are at least 0. The cheapest is the greatest.
type Candidate = Reverse<(u64, [u32; 2], [u32; 2])>;

/// A mesh during decimation.
struct Work<'a> {
    mesh: &'a mut Mesh,
    quadrics: Vec<Quadric>,
    /// The triangles at each vertex.
    around: Vec<Vec<u32>>,
    /// The number of moves of each vertex.
    moved: Vec<u32>,
    heap: BinaryHeap<Candidate>,
}

impl Mesh {
    /// Simplifies the mesh to at most `count` triangles, or until no edge can be collapsed.
    ///
    /// A closed mesh stays closed, no side gets more triangles than before, no triangle flips, and borders are kept as
    /// well as possible. It minimises quadric errors (Garland and Heckbert 1997). `progress` receives the share of the
    /// work, 0 to 1.
    pub fn decimate(&mut self, count: usize, progress: &mut dyn FnMut(f64)) {
        let all = self.triangles.len();
        if all <= count {
            return;
        }
        let mut work = Work::new(self);
        let mut left = all;
        while left > count
            && let Some(Reverse((_, edge, moved))) = work.heap.pop()
        {
            let gone = work.collapse(edge, moved);
            if gone > 0 && left / OFTEN != (left - gone) / OFTEN {
                progress((all - left) as f64 / (all - count) as f64);
            }
            left -= gone;
        }
        self.triangles.retain(|triangle| *triangle != GONE);
        self.drop_unreferenced_vertices();
    }
}

/// A removed triangle.
const GONE: [u32; 3] = [u32::MAX; 3];

impl<'a> Work<'a> {
    fn new(mesh: &'a mut Mesh) -> Self {
        let vertices = mesh.positions.len();
        let (mut quadrics, mut around) = (vec![Quadric::NONE; vertices], vec![vec![]; vertices]);
        for (i, triangle) in mesh.triangles.iter().enumerate() {
            let [a, b, c] = mesh.corners(i);
            let cross = (b - a).cross(c - a);
            let plane = Quadric::plane(cross.normalize_or_zero(), a, 0.5 * cross.length());
            for &vertex in triangle {
                let stay = Quadric::point(mesh.positions[vertex as usize], STAY * 0.5 * cross.length());
                let quadric = &mut quadrics[vertex as usize];
                *quadric = quadric.plus(&plane).plus(&stay);
                around[vertex as usize].push(i as u32);
            }
        }
        let (moved, heap) = (vec![0; vertices], BinaryHeap::new());
        let mut work = Work { mesh, quadrics, around, moved, heap };
        for i in 0..work.mesh.triangles.len() {
            for [from, to] in sides(&work.mesh.triangles[i]) {
                if work.common(from, to).count() == 1 {
                    work.keep_border(i, [from, to]);
                }
            }
        }
        for i in 0..work.mesh.triangles.len() {
            for [from, to] in sides(&work.mesh.triangles[i]) {
                // Each inner edge occurs once in rising order. A border edge occurs once in either order.
                if from < to || work.common(from, to).count() == 1 {
                    work.consider(from, to);
                }
            }
        }
        work
    }

    /// Adds a plane through a border edge, perpendicular to its triangle, which keeps the edge in place.
    fn keep_border(&mut self, triangle: usize, side: [u32; 2]) {
        let [a, b, c] = self.mesh.corners(triangle);
        let [from, to] = side.map(|vertex| self.mesh.positions[vertex as usize]);
        let normal = (to - from).cross((b - a).cross(c - a)).normalize_or_zero();
        let border = Quadric::plane(normal, from, BORDER * from.distance_squared(to));
        for vertex in side {
            let quadric = &mut self.quadrics[vertex as usize];
            *quadric = quadric.plus(&border);
        }
    }

    /// The triangles that contain both vertices.
    fn common(&self, a: u32, b: u32) -> impl Iterator<Item = usize> + '_ {
        let around = self.around[a as usize].iter().map(|&triangle| triangle as usize);
        around.filter(move |&triangle| self.mesh.triangles[triangle].contains(&b))
    }

    /// The neighbours of a vertex, in rising order.
    fn neighbours(&self, vertex: u32) -> Vec<u32> {
        let triangles = self.around[vertex as usize].iter().flat_map(|&i| self.mesh.triangles[i as usize]);
        let mut neighbours: Vec<u32> = triangles.filter(|&other| other != vertex).collect();
        neighbours.sort_unstable();
        neighbours.dedup();
        neighbours
    }

    /// The cost of an edge collapse, and the new position of both vertices.
    fn cheapest(&self, edge: [u32; 2]) -> (f64, DVec3) {
        let quadric = self.quadrics[edge[0] as usize].plus(&self.quadrics[edge[1] as usize]);
        let [from, to] = edge.map(|vertex| self.mesh.positions[vertex as usize]);
        let middle = 0.5 * (from + to);
        // The minimum of a nearly flat quadric may be far away.
        let lowest = quadric.lowest().filter(|place| place.distance(middle) < 2.0 * from.distance(to));
        let places = [lowest.unwrap_or(middle), from, to];
        let place = places.into_iter().min_by(|a, b| quadric.at(*a).total_cmp(&quadric.at(*b))).unwrap_or(middle);
        (quadric.at(place), place)
    }

    /// Adds an edge to the candidates.
    fn consider(&mut self, a: u32, b: u32) {
        let edge = [a.min(b), a.max(b)];
        let moved = edge.map(|vertex| self.moved[vertex as usize]);
        self.heap.push(Reverse((self.cheapest(edge).0.to_bits(), edge, moved)));
    }

    /// Collapses an edge if its vertices have not moved since `moved` and the checks pass. Returns the number of
    /// removed triangles.
    fn collapse(&mut self, edge: [u32; 2], moved: [u32; 2]) -> usize {
        if edge.map(|vertex| self.moved[vertex as usize]) != moved {
            return 0;
        }
        let ([a, b], place) = (edge, self.cheapest(edge).1);
        if !self.may_collapse(edge, place) {
            return 0;
        }
        let gone: Vec<usize> = self.common(a, b).collect();
        for &triangle in &gone {
            for vertex in self.mesh.triangles[triangle] {
                self.around[vertex as usize].retain(|&other| other as usize != triangle);
            }
            self.mesh.triangles[triangle] = GONE;
        }
        for triangle in std::mem::take(&mut self.around[b as usize]) {
            let vertices = self.mesh.triangles[triangle as usize].iter_mut();
            vertices.filter(|vertex| **vertex == b).for_each(|vertex| *vertex = a);
            self.around[a as usize].push(triangle);
        }
        self.mesh.positions[a as usize] = place;
        self.quadrics[a as usize] = self.quadrics[a as usize].plus(&self.quadrics[b as usize]);
        edge.iter().for_each(|&vertex| self.moved[vertex as usize] += 1);
        for neighbour in self.neighbours(a) {
            self.consider(a, neighbour);
        }
        gone.len()
    }

    /// Returns true if a collapse keeps the surface a manifold, and no triangle flips or becomes a needle.
    fn may_collapse(&self, [a, b]: [u32; 2], place: DVec3) -> bool {
        let gone: Vec<usize> = self.common(a, b).collect();
        let (around_a, around_b) = (self.neighbours(a), self.neighbours(b));
        let shared = around_a.iter().filter(|vertex| around_b.binary_search(vertex).is_ok()).count();
        // Other common neighbours would become an edge of four triangles (the link condition, Dey et al. 1999).
        if gone.is_empty() || gone.len() > 2 || shared != gone.len() {
            return false;
        }
        let is_border = |vertex: u32, neighbours: &[u32]| neighbours.len() != self.around[vertex as usize].len();
        // An inner edge between two border vertices would become a vertex with two borders.
        if gone.len() == 2 && is_border(a, &around_a) && is_border(b, &around_b) {
            return false;
        }
        // A vertex of three triangles would keep two that coincide; a border vertex of one triangle would keep none.
        let opposite = gone.iter().flat_map(|&i| self.mesh.triangles[i]).filter(|vertex| *vertex != a && *vertex != b);
        for vertex in opposite {
            let triangles = self.around[vertex as usize].len();
            let least = if is_border(vertex, &self.neighbours(vertex)) { 1 } else { 3 };
            if triangles <= least {
                return false;
            }
        }
        let stays = edge_triangles(self, a, b).chain(edge_triangles(self, b, a));
        stays.into_iter().all(|(before, at)| {
            let mut after = before;
            after[at] = place;
            let [old, new] = [before, after].map(|[a, b, c]| (b - a).cross(c - a));
            let thinness = |[a, b, c]: [DVec3; 3], cross: DVec3| {
                let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
                cross.length() / longest
            };
            let least = THINNEST.min(thinness(before, old));
            old.dot(new) > LEAST_COSINE * old.length() * new.length() && thinness(after, new) >= least
        })
    }
}

/// The triangles at `vertex` without `other`, and the corner that `vertex` is in each.
fn edge_triangles<'a>(work: &'a Work<'_>, vertex: u32, other: u32) -> impl Iterator<Item = ([DVec3; 3], usize)> + 'a {
    work.around[vertex as usize].iter().filter_map(move |&i| {
        let triangle = work.mesh.triangles[i as usize];
        let at = triangle.iter().position(|corner| *corner == vertex)?;
        (!triangle.contains(&other)).then(|| (work.mesh.corners(i as usize), at))
    })
}

#[cfg(test)]
mod tests;
