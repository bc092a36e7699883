//! The marching cubes table: triangles of a cell for each of the 256 sets of dense corners (Lorensen and Cline 1987).
//!
//! The table is computed. On each face of the cell, a segment cuts off each run of dense corners, so that diagonal
//! dense corners are separated. That depends on the face alone, so both cells at a face agree. The segments join to
//! loops, which are triangulated: the surface has no holes.

use std::collections::BTreeMap;

/// An edge of a cell, by its axis and its lower corner. Bit `a` of a corner is 1 at the upper end of axis `a`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Edge {
    pub axis: usize,
    pub corner: usize,
}

impl Edge {
    /// The edge between two neighbouring corners.
    fn between(a: usize, b: usize) -> Self {
        Edge { axis: (a ^ b).trailing_zeros() as usize, corner: a & b }
    }

    /// Returns true if both edges belong to one face.
    fn shares_face(self, other: Edge) -> bool {
        let same_side = |axis: &usize| (self.corner ^ other.corner) >> axis & 1 == 0;
        (0..3).filter(|axis| *axis != self.axis && *axis != other.axis).any(|axis| same_side(&axis))
    }
}

/// For each set of dense corners (bit `c` for corner `c`), the triangles by the edges of their vertices. They are
/// anticlockwise from the side that is not dense.
pub(super) fn cases() -> Vec<Vec<[Edge; 3]>> {
    (0..=255).map(|dense| loops(dense).iter().flat_map(|outline| fan(outline)).collect()).collect()
}

/// The corners of each face, anticlockwise from outside of the cell.
fn faces() -> [[usize; 4]; 6] {
    std::array::from_fn(|face| {
        let (axis, side) = (face / 2, face % 2);
        let [u, v] = [1, 2].map(|next| 1 << ((axis + next) % 3));
        let [a, b, c, d] = [0, u, u | v, v].map(|corner| corner | side << axis);
        if side == 1 { [a, b, c, d] } else { [d, c, b, a] }
    })
}

/// The outlines of the surface as loops of edges.
fn loops(dense: u8) -> Vec<Vec<Edge>> {
    let is_dense = |corner: usize| dense >> corner & 1 == 1;
    let mut next = BTreeMap::new();
    for face in faces() {
        for i in 0..4 {
            let corner = |k: usize| face[(i + k) % 4];
            if !is_dense(corner(0)) && is_dense(corner(1)) {
                // From the start of a run of dense corners to its end. The adjacent face runs along the common edge in
                // the other direction, so its run starts at this one's end.
                let run = (1..4).take_while(|&k| is_dense(corner(k))).count();
                next.insert(Edge::between(corner(0), corner(1)), Edge::between(corner(run), corner(run + 1)));
            }
        }
    }
    let mut loops = vec![];
    while let Some((first, mut edge)) = next.pop_first() {
        let mut outline = vec![first];
        while let Some(after) = next.remove(&edge) {
            outline.push(edge);
            edge = after;
        }
        loops.push(outline);
    }
    loops
}

/// Fills a loop with triangles that share one vertex. No edge of the fan lies in a face of the cell, where the
/// neighbour may have the same edge. Such a vertex always exists.
fn fan(outline: &[Edge]) -> impl Iterator<Item = [Edge; 3]> + '_ {
    let count = outline.len();
    let apex = (0..count).find(|&apex| is_inside(outline, apex)).unwrap_or(0);
    let at = move |k: usize| outline[(apex + k) % count];
    (1..count - 1).map(move |k| [at(0), at(k), at(k + 1)])
}

/// Returns true if the edges of a fan from this vertex pass through the inside of the cell.
fn is_inside(outline: &[Edge], apex: usize) -> bool {
    let count = outline.len();
    (2..count - 1).all(|k| !outline[apex].shares_face(outline[(apex + k) % count]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_face_equals_geometry() {
        let middle = |edge: Edge| [0, 1, 2].map(|axis| (axis != edge.axis).then_some(edge.corner >> axis & 1));
        let edges = (0..3).flat_map(|axis| (0..8).map(move |corner| Edge { axis, corner }));
        let edges: Vec<Edge> = edges.filter(|edge| edge.corner >> edge.axis & 1 == 0).collect();
        for (&a, &b) in edges.iter().flat_map(|a| edges.iter().map(move |b| (a, b))) {
            let expected = middle(a).iter().zip(middle(b)).any(|(a, b)| a.is_some() && *a == b);
            assert_eq!(a.shares_face(b), expected, "{a:?} {b:?}");
        }
    }

    #[test]
    fn loops_have_a_fan_inside_the_cell() {
        let mut longest = 0;
        for dense in 0..=255 {
            for outline in loops(dense) {
                assert!((0..outline.len()).any(|apex| is_inside(&outline, apex)), "{dense:#b}: {outline:?}");
                longest = longest.max(outline.len());
            }
        }
        assert_eq!(longest, 7);
    }

    #[test]
    fn isosurface_on_crossed_edges_faces_out() {
        let middle = |edge: Edge| {
            let place = |axis: usize| if axis == edge.axis { 0.5 } else { (edge.corner >> axis & 1) as f64 };
            glam::DVec3::new(place(0), place(1), place(2))
        };
        for (dense, triangles) in cases().iter().enumerate() {
            let is_dense = |corner: usize| dense >> corner & 1 == 1;
            let crossed = |edge: &Edge| is_dense(edge.corner) != is_dense(edge.corner | 1 << edge.axis);
            assert!(triangles.iter().flatten().all(crossed), "{dense:#b}");
            let mut all: Vec<Edge> = triangles.iter().flatten().copied().collect();
            all.sort();
            all.dedup();
            let edges = (0..3).flat_map(|axis| (0..8).map(move |corner| Edge { axis, corner }));
            let expected = edges.filter(|edge| edge.corner >> edge.axis & 1 == 0).filter(crossed).count();
            assert_eq!(all.len(), expected, "{dense:#b}: each crossed edge has a vertex");
            // A single dense corner gives a triangle that faces away from it; a single corner that is not dense gives
            // one that faces it.
            if [1, 7].contains(&dense.count_ones()) {
                let alone = if dense.count_ones() == 1 { dense } else { 255 - dense }.trailing_zeros() as usize;
                let corner = glam::DVec3::new((alone & 1) as f64, (alone >> 1 & 1) as f64, (alone >> 2) as f64);
                let [a, b, c] = triangles[0].map(middle);
                let faces_away = (b - a).cross(c - a).dot(a - corner) > 0.0;
                assert_eq!((triangles.len(), faces_away), (1, dense.count_ones() == 1), "{dense:#b}");
            }
        }
        // Two dense corners diagonal on a face are separate; four on a face give one square.
        assert_eq!(loops(0b0000_1001).len(), 2);
        assert_eq!(loops(0b0000_1111).iter().map(Vec::len).collect::<Vec<_>>(), [4]);
        // With two diagonal corners of a face not dense, one loop surrounds both, as dense corners separate.
        assert_eq!(loops(0b1111_0110).iter().map(Vec::len).collect::<Vec<_>>(), [6]);
    }
}
