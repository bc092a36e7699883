//! Triangle meshes and their components.

use glam::DVec3;
use std::collections::HashMap;

/// A triangle mesh with shared vertices.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Mesh {
    /// Positions of the vertices.
    pub positions: Vec<DVec3>,
    /// Indices of three vertices each, anticlockwise as seen from outside. A mesh without triangles is a point cloud.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Returns the positions of a triangle's vertices.
    ///
    /// # Panics
    /// If `triangle` is out of range.
    pub fn corners(&self, triangle: usize) -> [DVec3; 3] {
        self.triangles[triangle].map(|vertex| self.positions[vertex as usize])
    }

    /// Returns the bounding box of the vertices (lower and upper corner), or `None` if there are none.
    pub fn bounds(&self) -> Option<[DVec3; 2]> {
        bounds(&self.positions)
    }

    /// Returns the area of all triangles, in square units.
    pub fn area(&self) -> f64 {
        (0..self.triangles.len()).map(|i| area(self.corners(i))).sum()
    }

    /// Returns the volume within a closed mesh, in cubic units, by the divergence theorem. It is negative if triangles
    /// face inwards.
    pub fn volume(&self) -> f64 {
        // Relative to a vertex: far from the origin, products lose their differing digits.
        let from = self.positions.first().copied().unwrap_or_default();
        (0..self.triangles.len()).map(|i| volume(self.corners(i).map(|corner| corner - from))).sum()
    }

    /// Computes a unit normal per vertex: the mean of its triangles' normals, weighted by area. Vertices without
    /// triangles get +z.
    pub fn normals(&self) -> Vec<DVec3> {
        let mut normals = vec![DVec3::ZERO; self.positions.len()];
        for (i, triangle) in self.triangles.iter().enumerate() {
            let [a, b, c] = self.corners(i);
            let normal = (b - a).cross(c - a);
            triangle.iter().for_each(|&vertex| normals[vertex as usize] += normal);
        }
        normals.into_iter().map(|normal| normal.try_normalize().unwrap_or(DVec3::Z)).collect()
    }

    /// Returns whether the mesh is closed (watertight and consistently oriented): each side of a triangle belongs to
    /// exactly one other triangle, in the opposite direction.
    pub fn is_closed(&self) -> bool {
        let mut passed: Vec<[u32; 2]> = self.triangles.iter().flat_map(sides).collect();
        passed.sort_unstable();
        let is_once = passed.windows(2).all(|pair| pair[0] != pair[1]);
        is_once && passed.iter().all(|&[from, to]| passed.binary_search(&[to, from]).is_ok())
    }

    /// Finds connected components: returns the component of each triangle, and the number of components.
    ///
    /// Triangles that share a vertex are connected. Components are numbered in the order of their first triangles.
    pub fn components(&self) -> (Vec<usize>, usize) {
        let mut leader: Vec<u32> = (0..self.positions.len() as u32).collect();
        for &[a, b, c] in &self.triangles {
            for other in [b, c] {
                let (a, b) = (find(&mut leader, a), find(&mut leader, other));
                leader[a.max(b) as usize] = a.min(b);
            }
        }
        let mut numbers = HashMap::new();
        let part = |&[first, ..]: &[u32; 3]| {
            let next = numbers.len();
            *numbers.entry(find(&mut leader, first)).or_insert(next)
        };
        let parts = self.triangles.iter().map(part).collect();
        (parts, numbers.len())
    }

    /// Removes components whose area is below this share, 0 to 1, of the largest one's, and returns their number. 0
    /// removes none.
    pub fn drop_small_components(&mut self, share: f64) -> usize {
        let (parts, count) = self.components();
        let mut areas = vec![0.0; count];
        parts.iter().enumerate().for_each(|(i, &part)| areas[part] += area(self.corners(i)));
        let least = share * areas.iter().copied().fold(0.0, f64::max);
        let stays: Vec<bool> = areas.iter().map(|area| *area >= least).collect();
        let mut parts = parts.into_iter();
        self.triangles.retain(|_| parts.next().is_some_and(|part| stays[part]));
        self.drop_unreferenced_vertices();
        stays.iter().filter(|stays| !**stays).count()
    }

    /// Removes vertices without triangles; the others keep their order.
    pub fn drop_unreferenced_vertices(&mut self) {
        const UNUSED: u32 = u32::MAX;
        let mut number = vec![UNUSED; self.positions.len()];
        self.triangles.as_flattened().iter().for_each(|&vertex| number[vertex as usize] = 0);
        let used = number.iter_mut().filter(|number| **number != UNUSED);
        used.zip(0..).for_each(|(number, new)| *number = new);
        let mut numbers = number.iter();
        self.positions.retain(|_| numbers.next() != Some(&UNUSED));
        self.triangles.as_flattened_mut().iter_mut().for_each(|vertex| *vertex = number[*vertex as usize]);
    }
}

/// The lower and upper corner of the smallest box around points; `None` without any.
pub(super) fn bounds(places: &[DVec3]) -> Option<[DVec3; 2]> {
    let first = *places.first()?;
    Some(places.iter().fold([first; 2], |[low, high], &x| [low.min(x), high.max(x)]))
}

/// The directed edges of a triangle.
pub(super) fn sides(&[a, b, c]: &[u32; 3]) -> [[u32; 2]; 3] {
    [[a, b], [b, c], [c, a]]
}

fn area([a, b, c]: [DVec3; 3]) -> f64 {
    0.5 * (b - a).cross(c - a).length()
}

fn volume([a, b, c]: [DVec3; 3]) -> f64 {
    a.dot(b.cross(c)) / 6.0
}

/// The representative of a vertex's component (union-find with path halving).
fn find(leader: &mut [u32], mut vertex: u32) -> u32 {
    while leader[vertex as usize] != vertex {
        leader[vertex as usize] = leader[leader[vertex as usize] as usize];
        vertex = leader[vertex as usize];
    }
    vertex
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    #[test]
    fn mesh_far_from_origin_has_volume_and_normals() {
        let far = tetrahedron(DVec3::new(320_000.3, 5_800_000.7, 43.1), 2.0);
        assert!((far.volume() / (8.0 / 6.0) - 1.0).abs() < 1e-6, "{}", far.volume());
        let corner = tetrahedron(DVec3::ONE, 3.0);
        // At the corner of the right angles, the normal is the mean of three equal sides; elsewhere of two and the
        // slanted one.
        let normals = corner.normals();
        let at = |place: DVec3| normals[corner.positions.iter().position(|x| *x == place).unwrap()];
        assert!(at(DVec3::ONE).distance(-DVec3::ONE.normalize()) < 1e-12);
        let beside = (DVec3::ONE - DVec3::Y - DVec3::Z).normalize();
        assert!(at(DVec3::new(4.0, 1.0, 1.0)).distance(beside) < 1e-12, "{normals:?}");
        let lone = Mesh { positions: vec![DVec3::ZERO], triangles: vec![] };
        assert_eq!(lone.normals(), [DVec3::Z]);
    }

    /// A tetrahedron with the corner of a right angle here.
    pub fn tetrahedron(at: DVec3, size: f64) -> Mesh {
        let positions = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z].map(|x| at + size * x).to_vec();
        Mesh { positions, triangles: vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] }
    }

    fn both(mut a: Mesh, b: &Mesh) -> Mesh {
        let first = a.positions.len() as u32;
        a.positions.extend(&b.positions);
        a.triangles.extend(b.triangles.iter().map(|triangle| triangle.map(|vertex| vertex + first)));
        a
    }

    #[test]
    fn tetrahedron_has_known_volume_and_area() {
        let at = DVec3::new(1.0, -2.0, 3.0);
        let mesh = tetrahedron(at, 2.0);
        assert!((mesh.volume() - 8.0 / 6.0).abs() < 1e-12);
        // Three right triangles, and one with edges of length 2 sqrt 2.
        assert!((mesh.area() - (3.0 * 2.0 + 2.0 * 3.0_f64.sqrt())).abs() < 1e-12);
        assert_eq!(mesh.bounds(), Some([at, at + 2.0]));
        assert_eq!(Mesh::default().bounds(), None);
        let turned = Mesh { triangles: mesh.triangles.iter().map(|&[a, b, c]| [a, c, b]).collect(), ..mesh.clone() };
        assert!(mesh.is_closed() && turned.is_closed() && (turned.volume() + mesh.volume()).abs() < 1e-12);
    }

    #[test]
    fn is_closed_needs_two_triangles_per_edge() {
        let mesh = tetrahedron(DVec3::ZERO, 1.0);
        let with = |change: &dyn Fn(&mut Vec<[u32; 3]>)| {
            let mut mesh = mesh.clone();
            change(&mut mesh.triangles);
            mesh.is_closed()
        };
        assert!(with(&|_| ()));
        assert!(!with(&|triangles| triangles.truncate(3)), "a hole");
        assert!(!with(&|triangles| triangles[2].swap(0, 1)), "a triangle faces inwards");
        assert!(!with(&|triangles| triangles.push([1, 2, 3])), "a triangle is there twice");
        assert!(!with(&|triangles| triangles.extend([[1, 2, 3], [1, 3, 2]])), "two more at a side");
        assert!(both(mesh.clone(), &mesh).is_closed());
        assert!(Mesh::default().is_closed());
    }

    #[test]
    fn small_components_are_dropped() {
        let sizes = [1.0, 0.5, 3.0, 0.2];
        let all = sizes.iter().enumerate().map(|(i, &size)| tetrahedron(DVec3::splat(5.0 * i as f64), size));
        let all = all.reduce(|a, b| both(a, &b)).unwrap();
        let (parts, count) = all.components();
        assert_eq!((&parts[..], count), (&[0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3][..], 4));
        // Areas scale with squared sizes: 1/9, 1/36, 1 and 1/225 of the largest.
        for (share, left) in [(0.0, 4), (0.004, 4), (0.01, 3), (0.05, 2), (0.2, 1), (1.0, 1)] {
            let mut mesh = all.clone();
            assert_eq!(mesh.drop_small_components(share), 4 - left, "{share}");
            assert_eq!((mesh.positions.len(), mesh.triangles.len(), mesh.components().1), (4 * left, 4 * left, left));
            assert!(mesh.is_closed() && mesh.bounds().unwrap()[1].x > 12.0, "the largest stays");
        }
        let mut mesh = all;
        mesh.drop_small_components(0.05);
        let expected = both(tetrahedron(DVec3::ZERO, 1.0), &tetrahedron(DVec3::splat(10.0), 3.0));
        assert_eq!(mesh, expected, "the others as they were");
    }
}
