//! A bounding volume hierarchy for ray and distance queries of many shapes.

use glam::DVec3;

use super::shape::{Shape, Surface};
use raygrad_nerf::Ray;

/// The hit of a ray with a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Distance from the ray's origin, in scene units.
    pub distance: f64,
    /// The outward unit normal.
    pub normal: DVec3,
    /// The index of the solid.
    pub solid: usize,
}

/// The depth limit, so that a traversal fits a stack of fixed size.
const MAX_DEPTH: usize = 32;
/// The most shapes of a leaf.
const LEAF: usize = 2;
/// Padding of boxes. A ray within the face of a padded box (0 times infinity: NaN) then hits no shape there, so either
/// result is right.
const PADDING: f64 = 1e-9;

/// A binary tree of boxes over shapes, split by the surface area heuristic.
#[derive(Debug, Clone)]
pub struct Bvh<S = Shape> {
    nodes: Vec<Node>,
    /// Shapes with their original indices, in the order of the leaves.
    shapes: Vec<(usize, S)>,
}

#[derive(Debug, Clone, Copy)]
struct Node {
    min: DVec3,
    max: DVec3,
    /// The first of two adjacent children, or of the shapes of a leaf.
    first: u32,
    /// Number of shapes; 0 for an inner node.
    count: u32,
}

impl<S: Surface> Bvh<S> {
    /// A hierarchy over `shapes`.
    ///
    /// # Panics
    /// If there are none.
    pub fn new(shapes: Vec<S>) -> Self {
        assert!(!shapes.is_empty(), "a scene must have at least one solid");
        let shapes: Vec<_> = shapes.into_iter().enumerate().collect();
        let nodes = vec![Node { min: DVec3::ZERO, max: DVec3::ZERO, first: 0, count: 0 }];
        let mut bvh = Bvh { nodes, shapes };
        bvh.build(0, 0, bvh.shapes.len(), MAX_DEPTH);
        bvh
    }

    /// The corners of a box around all shapes.
    pub fn bounds(&self) -> [DVec3; 2] {
        [self.nodes[0].min, self.nodes[0].max]
    }

    /// Fills `nodes[node]` with the subtree of `shapes[start..end]`.
    fn build(&mut self, node: usize, start: usize, end: usize, depth: usize) {
        let shapes = &mut self.shapes[start..end];
        let [min, max] = shapes.iter().map(|(_, shape)| shape.bounds()).fold(EMPTY, union);
        let leaf = Node { min: min - PADDING, max: max + PADDING, first: start as u32, count: (end - start) as u32 };
        self.nodes[node] = leaf;
        if shapes.len() <= LEAF || depth == 0 {
            return;
        }
        let split = best_split(shapes);
        let left = self.nodes.len();
        self.nodes[node] = Node { first: left as u32, count: 0, ..leaf };
        self.nodes.extend([leaf; 2]);
        self.build(left, start, start + split, depth - 1);
        self.build(left + 1, start + split, end, depth - 1);
    }

    /// The nearest surface along a ray.
    pub fn trace(&self, ray: &Ray) -> Option<Hit> {
        self.trace_before(ray, f64::INFINITY)
    }

    /// The nearest surface along a ray, if it is nearer than `limit`.
    pub fn trace_before(&self, ray: &Ray, limit: f64) -> Option<Hit> {
        let mut nearest: Option<Hit> = None;
        self.walk(ray, limit, |solid, shape, limit| {
            if let Some((distance, normal)) = shape.intersect(ray)
                && distance < *limit
            {
                nearest = Some(Hit { distance, normal, solid });
                *limit = distance;
            }
        });
        nearest
    }

    /// Returns true if a ray hits any surface.
    pub fn occluded(&self, ray: &Ray) -> bool {
        let mut hit = false;
        self.walk(ray, f64::INFINITY, |_, shape, limit| {
            if shape.intersect(ray).is_some() {
                hit = true;
                *limit = f64::NEG_INFINITY;
            }
        });
        hit
    }

    /// Visits the shapes whose boxes a ray enters before `limit`, nearer boxes first; `visit` may lower the limit.
    #[inline]
    fn walk(&self, ray: &Ray, mut limit: f64, mut visit: impl FnMut(usize, &S, &mut f64)) {
        let inverse = ray.direction.recip();
        let mut stack = [(0u32, 0.0f64); MAX_DEPTH + 1];
        stack[0] = (0, self.nodes[0].entry(ray.origin, inverse));
        let mut top = 1;
        while top > 0 {
            top -= 1;
            let (index, entry) = stack[top];
            if entry >= limit {
                continue;
            }
            let node = &self.nodes[index as usize];
            let first = node.first as usize;
            if node.count > 0 {
                for (solid, shape) in &self.shapes[first..first + node.count as usize] {
                    visit(*solid, shape, &mut limit);
                }
                continue;
            }
            let mut near = (node.first, self.nodes[first].entry(ray.origin, inverse));
            let mut far = (node.first + 1, self.nodes[first + 1].entry(ray.origin, inverse));
            if near.1 > far.1 {
                std::mem::swap(&mut near, &mut far);
            }
            for child in [far, near] {
                if child.1 < limit {
                    stack[top] = child;
                    top += 1;
                }
            }
        }
    }
}

impl Bvh {
    /// The signed distance from a point to the nearest shape, or `limit` if that is less.
    pub fn distance(&self, point: DVec3, limit: f64) -> f64 {
        let mut nearest = limit;
        let mut stack = [0u32; MAX_DEPTH + 1];
        let mut top = 1;
        while top > 0 {
            top -= 1;
            let node = &self.nodes[stack[top] as usize];
            let first = node.first as usize;
            if node.count > 0 {
                for (_, shape) in &self.shapes[first..first + node.count as usize] {
                    nearest = nearest.min(shape.distance(point));
                }
                continue;
            }
            for child in [first, first + 1] {
                let bound = self.nodes[child].distance_squared(point);
                // Inside a box the distance may be negative, so only boxes away from the point can be skipped.
                if bound == 0.0 || (nearest > 0.0 && bound < nearest * nearest) {
                    stack[top] = child as u32;
                    top += 1;
                }
            }
        }
        nearest
    }
}

impl Node {
    /// The distance at which a ray with the inverse direction `inverse` enters the box: 0 if it starts inside, infinity
    /// if it misses.
    #[inline]
    fn entry(&self, origin: DVec3, inverse: DVec3) -> f64 {
        let (a, b) = ((self.min - origin) * inverse, (self.max - origin) * inverse);
        let (near, far) = (a.min(b), a.max(b));
        let (enter, leave) = (near.max_element().max(0.0), far.min_element());
        if enter <= leave { enter } else { f64::INFINITY }
    }

    /// The squared distance from a point to the box, 0 inside.
    #[inline]
    fn distance_squared(&self, point: DVec3) -> f64 {
        (self.min - point).max(point - self.max).max(DVec3::ZERO).length_squared()
    }
}

/// The empty box.
const EMPTY: [DVec3; 2] = [DVec3::INFINITY, DVec3::NEG_INFINITY];

/// The box around two boxes.
fn union(a: [DVec3; 2], b: [DVec3; 2]) -> [DVec3; 2] {
    [a[0].min(b[0]), a[1].max(b[1])]
}

/// Sorts the shapes along the best axis for a split and returns the size of the first part.
///
/// The surface area heuristic: a random ray hits a convex box with a probability proportional to its surface. So a
/// split costs the sum of surface times number of shapes over the two parts.
fn best_split<S: Surface>(shapes: &mut [(usize, S)]) -> usize {
    let area = |[min, max]: [DVec3; 2]| {
        let size = max - min;
        size.x * size.y + size.y * size.z + size.z * size.x
    };
    let sort = |shapes: &mut [(usize, S)], axis: usize| {
        let key = |shape: &S| shape.bounds()[0][axis] + shape.bounds()[1][axis];
        shapes.sort_by(|a, b| key(&a.1).total_cmp(&key(&b.1)).then(a.0.cmp(&b.0)));
    };
    let (mut best, mut best_axis, mut best_cost) = (shapes.len() / 2, 0, f64::INFINITY);
    for axis in 0..3 {
        sort(shapes, axis);
        let mut costs = vec![0.0; shapes.len()];
        let mut left = EMPTY;
        for (i, (_, shape)) in shapes.iter().enumerate().take(shapes.len() - 1) {
            left = union(left, shape.bounds());
            costs[i + 1] += area(left) * (i + 1) as f64;
        }
        let mut right = EMPTY;
        for (i, (_, shape)) in shapes.iter().enumerate().skip(1).rev() {
            right = union(right, shape.bounds());
            costs[i] += area(right) * (shapes.len() - i) as f64;
        }
        for (split, &cost) in costs.iter().enumerate().skip(1) {
            if cost < best_cost {
                (best, best_axis, best_cost) = (split, axis, cost);
            }
        }
    }
    sort(shapes, best_axis);
    best
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use proptest::prelude::*;

    use super::super::{bulldozer, shape::tests::ray};
    use super::*;

    fn shapes() -> Vec<Shape> {
        bulldozer::solids().into_iter().map(|(shape, _)| shape).collect()
    }

    #[test]
    fn bvh_equals_brute_force() {
        let (shapes, bvh) = (shapes(), Bvh::new(shapes()));
        let hits = Cell::new(0);
        proptest!(ProptestConfig::with_cases(20_000), |(ray in ray())| {
            // Half the size of the rays' range, so that many of them hit something.
            let ray = Ray { origin: ray.origin / 2.0, ..ray };
            let all = shapes.iter().filter_map(|shape| shape.intersect(&ray)).map(|(t, _)| t);
            let nearest = all.min_by(f64::total_cmp);
            let hit = bvh.trace(&ray);
            prop_assert_eq!(hit.map(|hit| hit.distance), nearest);
            prop_assert_eq!(bvh.occluded(&ray), nearest.is_some());
            if let Some(hit) = hit {
                prop_assert_eq!(shapes[hit.solid].intersect(&ray), Some((hit.distance, hit.normal)));
                hits.set(hits.get() + 1);
            }
            for limit in [0.1, f64::INFINITY] {
                let distance = shapes.iter().map(|shape| shape.distance(ray.origin)).fold(limit, f64::min);
                prop_assert_eq!(bvh.distance(ray.origin, limit), distance);
            }
        });
        assert!(hits.get() > 1000, "{} hits", hits.get());
    }

    #[test]
    fn bvh_hits_rays_within_faces() {
        let bvh = Bvh::new(vec![Shape::cuboid(DVec3::NEG_ONE, DVec3::ONE)]);
        for zero in [0.0, -0.0] {
            let direction = DVec3::new(zero, 0.0, 1.0);
            for (x, hit) in [(-1.0, true), (1.0, true), (bvh.bounds()[0].x, false), (bvh.bounds()[1].x, false)] {
                let ray = Ray { origin: DVec3::new(x, 0.0, -3.0), direction };
                assert_eq!(bvh.trace(&ray).is_some(), hit, "x = {x}");
            }
        }
    }

    #[test]
    fn bvh_of_coinciding_shapes_is_built() {
        let bvh = Bvh::new(vec![Shape::cuboid(DVec3::NEG_ONE, DVec3::ONE); 100]);
        assert_eq!(bvh.distance(DVec3::new(3.0, 0.0, 0.0), 9.0), 2.0);
    }
}
