//! Decimated meshes keep their shape and topology.

use super::super::isosurface::{Lattice, isosurface};
use super::super::mesh::tests::tetrahedron;
use super::*;

const BOX: [DVec3; 2] = [DVec3::NEG_ONE, DVec3::new(1.0, 1.5, 0.8)];

fn of(f: impl Fn(DVec3) -> f64 + Sync, closed: bool) -> Mesh {
    let density = |points: &[[f32; 3]], out: &mut [f32]| {
        points.iter().zip(out).for_each(|(x, out)| *out = f(DVec3::from(x.map(f64::from))) as f32);
    };
    isosurface(&Lattice::over(BOX, 60, closed).unwrap(), 1.0, &density, &mut |_| ()).unwrap()
}

fn ball(x: DVec3) -> f64 {
    1.6 - x.distance(DVec3::new(0.1, 0.3, -0.05))
}

fn torus(x: DVec3) -> f64 {
    1.2 - (x.x.hypot(x.y) - 0.5).hypot(x.z)
}

fn cuboid(x: DVec3) -> f64 {
    1.0 + (DVec3::new(0.5, 0.7, 0.3) - x.abs()).min_element()
}

#[test]
fn decimation_keeps_shape_and_topology() {
    for (name, f) in [("ball", ball as fn(DVec3) -> f64), ("torus", torus), ("cuboid", cuboid)] {
        let fine = of(f, true);
        let mut coarse = fine.clone();
        let mut reports = vec![0.0];
        coarse.decimate(1000, &mut |done| reports.push(done));
        assert!(reports.is_sorted() && *reports.last().unwrap() <= 1.0, "{reports:?}");
        // One report per ten thousand triangles.
        assert_eq!(reports.len() - 1, fine.triangles.len() / OFTEN, "{name}");
        assert!(fine.triangles.len() > 3000, "{name}");
        assert!((999..=1000).contains(&coarse.triangles.len()), "{name}: {}", coarse.triangles.len());
        assert!(coarse.is_closed() && coarse.components().1 == 1, "{name}");
        let euler = |mesh: &Mesh| mesh.positions.len() as i64 - mesh.triangles.len() as i64 / 2;
        assert_eq!(euler(&coarse), euler(&fine), "{name}");
        assert!((coarse.volume() / fine.volume() - 1.0).abs() < 0.01, "{name}: {} {}", coarse.volume(), fine.volume());
        assert!((coarse.area() / fine.area() - 1.0).abs() < 0.01, "{name}: {} {}", coarse.area(), fine.area());
        // Vertices stay near the surface, compared with an edge length of about 0.1.
        let off = coarse.positions.iter().map(|x| (f(*x) - 1.0).abs()).fold(0.0, raygrad_tensor::Real::maximum);
        assert!(off < 0.012, "{name}: {off}");
        // No triangle flips: on the ball all face away from the centre, and most do so precisely.
        if name == "ball" {
            let faces_out = |i: usize| {
                let [a, b, c] = coarse.corners(i);
                let out = (a + b + c) / 3.0 - DVec3::new(0.1, 0.3, -0.05);
                (b - a).cross(c - a).normalize().dot(out.normalize())
            };
            let faces: Vec<f64> = (0..coarse.triangles.len()).map(faces_out).collect();
            assert!(faces.iter().all(|cosine| *cosine > 0.0), "{faces:?}");
            assert!(faces.iter().sum::<f64>() / faces.len() as f64 > 0.98);
        }
        let mut same = fine.clone();
        same.decimate(fine.triangles.len(), &mut |_| ());
        assert_eq!(same, fine, "{name}");
    }
}

#[test]
fn decimation_keeps_edges_of_flat_sides() {
    // The lattice cuts the cuboid's edges off by a part of a cell.
    let mut mesh = of(cuboid, true);
    let before = mesh.volume();
    mesh.decimate(150, &mut |_| ());
    assert!(mesh.triangles.len() <= 150 && mesh.is_closed());
    assert!((mesh.volume() / before - 1.0).abs() < 0.005, "{} {before}", mesh.volume());
    let [low, high] = mesh.bounds().unwrap();
    let half = DVec3::new(0.5, 0.7, 0.3);
    assert!(low.abs_diff_eq(-half, 0.01) && high.abs_diff_eq(half, 0.01), "{low} {high}");
}

#[test]
fn decimation_to_the_limit_stays_closed() {
    for f in [ball as fn(DVec3) -> f64, torus] {
        let mut mesh = of(f, true);
        let euler = mesh.positions.len() as i64 - mesh.triangles.len() as i64 / 2;
        mesh.decimate(4, &mut |_| ());
        assert!(mesh.is_closed() && (4..300).contains(&mesh.triangles.len()), "{}", mesh.triangles.len());
        assert_eq!(mesh.positions.len() as i64 - mesh.triangles.len() as i64 / 2, euler);
    }
    let mut least = tetrahedron(DVec3::ONE, 2.0);
    least.decimate(1, &mut |_| ());
    assert_eq!(least, tetrahedron(DVec3::ONE, 2.0));
}

#[test]
fn decimation_keeps_borders() {
    // A wave that reaches the sides of the box: a single sheet with a rectangular border.
    let mut mesh = of(|x| 1.0 + 0.1 * (4.0 * x.x).sin() - x.z, false);
    let before = mesh.clone();
    mesh.decimate(400, &mut |_| ());
    assert!(mesh.triangles.len() <= 400 && !mesh.is_closed() && mesh.components().1 == 1);
    assert!((mesh.area() / before.area() - 1.0).abs() < 0.01, "{} {}", mesh.area(), before.area());
    let ([low, high], [old_low, old_high]) = (mesh.bounds().unwrap(), before.bounds().unwrap());
    assert!(low.abs_diff_eq(old_low, 0.01) && high.abs_diff_eq(old_high, 0.01), "{low} {high}");
    // The projection along z still covers the whole rectangle.
    let seen: f64 = (0..mesh.triangles.len())
        .map(|i| {
            let [a, b, c] = mesh.corners(i);
            0.5 * (b - a).cross(c - a).z
        })
        .sum();
    assert!((seen / (2.0 * 2.5) - 1.0).abs() < 0.005, "{seen}");
}

#[test]
fn decimation_does_not_pinch_a_ribbon() {
    // A row of squares of two triangles each: all edges across it connect the borders.
    let squares = 30;
    let positions = (0..2 * (squares + 1)).map(|i| DVec3::new(f64::from(i / 2), f64::from(i % 2), 0.0)).collect();
    let square = |i: u32| [[2 * i, 2 * i + 2, 2 * i + 1], [2 * i + 1, 2 * i + 2, 2 * i + 3]];
    let mut mesh = Mesh { positions, triangles: (0..squares as u32).flat_map(square).collect() };
    let (mut same, middle) = (mesh.clone(), DVec3::new(10.0, 0.5, 0.0));
    let work = Work::new(&mut same);
    assert!(!work.may_collapse([20, 21], middle), "across");
    assert!(work.may_collapse([20, 22], DVec3::new(10.5, 0.0, 0.0)), "along");
    mesh.decimate(6, &mut |_| ());
    assert!((mesh.area() - f64::from(squares)).abs() < 0.5, "{}", mesh.area());
    let all: Vec<[u32; 2]> = mesh.triangles.iter().flat_map(sides).collect();
    let border = all.iter().filter(|[a, b]| !all.contains(&[*b, *a]));
    let mut starts: Vec<u32> = border.map(|[from, _]| *from).collect();
    starts.sort_unstable();
    assert_eq!(starts, (0..mesh.positions.len() as u32).collect::<Vec<_>>(), "the border passes each vertex once");
}

#[test]
fn quadrics_are_sums_of_squared_distances() {
    let (normal, point) = (DVec3::new(2.0, -1.0, 2.0) / 3.0, DVec3::new(1.0, 2.0, 3.0));
    let quadric = Quadric::plane(normal, point, 0.5).plus(&Quadric::point(point, 0.25));
    for x in [DVec3::new(4.0, -1.0, 0.5), point, DVec3::ZERO] {
        let expected = 0.5 * (x - point).dot(normal).powi(2) + 0.25 * x.distance_squared(point);
        assert!((quadric.at(x) - expected).abs() < 1e-12, "{x}: {} {expected}", quadric.at(x));
    }
    let planes = [DVec3::X, DVec3::Y, DVec3::new(0.0, 0.6, 0.8)].map(|normal| Quadric::plane(normal, point, 2.0));
    let corner = planes.iter().fold(Quadric::NONE, |sum, plane| sum.plus(plane));
    assert!(corner.lowest().unwrap().abs_diff_eq(point, 1e-12));
    assert_eq!(planes[0].plus(&planes[1]).lowest(), None, "a line");
}
