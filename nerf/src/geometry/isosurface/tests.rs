//! Isosurfaces of functions with a known surface, and of random and extreme values.

use super::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use std::f64::consts::PI;

/// Turns a function of positions into a density function.
fn of(f: impl Fn(DVec3) -> f64 + Sync) -> impl Fn(&[[f32; 3]], &mut [f32]) + Sync {
    move |points, out| {
        for (point, out) in points.iter().zip(out) {
            *out = f(DVec3::from(point.map(f64::from))) as f32;
        }
    }
}

/// The closed or open surface where `f` exceeds `level` within the box.
fn within(bounds: [DVec3; 2], resolution: usize, level: f32, closed: bool, f: impl Fn(DVec3) -> f64 + Sync) -> Mesh {
    let [low, high] = bounds;
    let inside = |x: DVec3| x.cmpge(low).all() && x.cmple(high).all();
    let cut = of(|x| if inside(x) { f(x) } else { 0.0 });
    isosurface(&Lattice::over(bounds, resolution, closed).unwrap(), level, &cut, &mut |_| ()).unwrap()
}

/// The Euler characteristic of a closed mesh: vertices minus edges plus triangles.
fn euler(mesh: &Mesh) -> i64 {
    assert_eq!(mesh.triangles.len() % 2, 0);
    mesh.positions.len() as i64 - mesh.triangles.len() as i64 / 2
}

const BOX: [DVec3; 2] = [DVec3::new(-1.0, -2.0, 0.0), DVec3::new(2.0, 0.5, 1.5)];

#[test]
fn isosurface_of_ball_is_accurate() {
    let (centre, radius) = (DVec3::new(0.7, -0.9, 0.8), 0.5);
    for (name, density) in [
        ("soft", Box::new(move |x: DVec3| 3.0 + radius - x.distance(centre)) as Box<dyn Fn(DVec3) -> f64 + Sync>),
        ("steep", Box::new(move |x: DVec3| 3.0 * (40.0 * (radius - x.distance(centre))).exp())),
        ("hard", Box::new(move |x: DVec3| if x.distance(centre) < radius { 100.0 } else { 0.0 })),
    ] {
        let mesh = within(BOX, 60, 3.0, true, density);
        // Cells are 0.05 wide and bisected to a 32nd. Smooth values leave an error of a hundredth of that, the
        // vertices' margin; a jump leaves all of it.
        let bound = match name {
            "soft" => 0.011 * 0.05 / 32.0,
            "steep" => 5e-5,
            _ => 0.05 / 32.0,
        };
        let off =
            mesh.positions.iter().map(|x| (x.distance(centre) - radius).abs()).fold(0.0, raygrad_tensor::Real::maximum);
        assert!(off < bound, "{name}: {off}");
        assert!(mesh.is_closed() && euler(&mesh) == 2 && mesh.components().1 == 1, "{name}");
        // Triangles lie inside the ball by about a squared cell over eight radii.
        let (volume, area) = (4.0 / 3.0 * PI * radius.powi(3), 4.0 * PI * radius.powi(2));
        assert!((0.985..1.002).contains(&(mesh.volume() / volume)), "{name}: {}", mesh.volume() / volume);
        assert!((0.985..1.01).contains(&(mesh.area() / area)), "{name}: {}", mesh.area() / area);
        for i in 0..mesh.triangles.len() {
            let [a, b, c] = mesh.corners(i);
            let normal = (b - a).cross(c - a);
            assert!(normal.length() > 0.0, "{name}: {a} {b} {c} has no area");
            // Needles of the discontinuous function may have any normal.
            let out = normal.normalize().dot((a + b + c) / 3.0 - centre);
            assert!(name == "hard" || out > 0.4 * radius, "{name}: {a} {b} {c} faces elsewhere");
        }
    }
}

#[test]
fn isosurface_of_torus_has_a_hole() {
    let torus = |x: DVec3| {
        let x = x - DVec3::new(0.5, -0.75, 0.7);
        let around = (x.y.hypot(x.z) - 0.45).hypot(x.x);
        2.0 - around
    };
    let mesh = within(BOX, 90, 1.8, true, torus);
    assert!(mesh.is_closed() && mesh.components().1 == 1);
    assert_eq!(euler(&mesh), 0);
    let volume = 2.0 * PI * PI * 0.45 * 0.2_f64.powi(2);
    assert!((0.98..1.002).contains(&(mesh.volume() / volume)), "{}", mesh.volume() / volume);
    let [low, high] = mesh.bounds().unwrap();
    let size = DVec3::new(0.4, 1.3, 1.3);
    assert!((high - low).abs_diff_eq(size, 0.01), "it lies across x: {}", high - low);
}

#[test]
fn surface_is_closed_at_the_box_if_wanted() {
    // A slab across the box: y from -1.2 to -0.2, the whole range in x and z.
    let slab = |x: DVec3| 5.0 * (0.5 - (x.y + 0.7).abs());
    let mesh = within(BOX, 50, 1.0, true, slab);
    // The density is 1 at a distance of 0.3 from the middle.
    let volume = 3.0 * 0.6 * 1.5;
    assert!(mesh.is_closed() && euler(&mesh) == 2);
    assert!((mesh.volume() / volume - 1.0).abs() < 0.01, "{} {volume}", mesh.volume());
    let [low, high] = mesh.bounds().unwrap();
    let slack = 3.0 / 50.0 / 32.0;
    assert!(low.abs_diff_eq(DVec3::new(-1.0, -1.0, 0.0), slack), "{low}");
    assert!(high.abs_diff_eq(DVec3::new(2.0, -0.4, 1.5), slack), "{high}");
    let open = within(BOX, 50, 1.0, false, slab);
    assert!(!open.is_closed() && open.components().1 == 2, "the two sides of the slab");
    assert!((open.area() - 2.0 * 3.0 * 1.5).abs() < 1e-3, "{}", open.area());
    let [low, high] = open.bounds().unwrap();
    assert!(low.abs_diff_eq(DVec3::new(-1.0, -1.0, 0.0), 1e-5) && high.abs_diff_eq(DVec3::new(2.0, -0.4, 1.5), 1e-5));
}

#[test]
fn isosurface_of_random_cells_has_no_holes() {
    for seed in 0..20 {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let share = [0.5, 0.1, 0.9][seed as usize % 3];
        // Nodes are at -0.5, 0.5 .. 9.5 along x, and fewer along y and z; the outermost ones are outside of the box.
        let dense: Vec<bool> = (0..9 * 8 * 7).map(|_| rng.random::<f64>() < share).collect();
        let value = |x: DVec3| {
            let [i, j, k] = x.to_array().map(|x| x.floor() as usize);
            let dense = dense[i.min(8) + 9 * (j.min(7) + 8 * k.min(6))];
            if dense { 1.0 } else { 0.0 }
        };
        let bounds = [DVec3::ZERO, DVec3::new(9.0, 8.0, 7.0)];
        let mesh = within(bounds, 9, 0.5, true, value);
        assert!(mesh.is_closed(), "seed {seed}");
        // No two vertices coincide, and no triangle is degenerate.
        let mut places: Vec<[u64; 3]> = mesh.positions.iter().map(|x| x.to_array().map(f64::to_bits)).collect();
        places.sort_unstable();
        places.dedup();
        assert_eq!(places.len(), mesh.positions.len());
        assert!((0..mesh.triangles.len()).all(|i| {
            let [a, b, c] = mesh.corners(i);
            (b - a).cross(c - a).length() > 1e-6
        }));
        // Each dense node contributes about a cell, minus its corners, if few nodes touch.
        let count = dense.iter().filter(|dense| **dense).count() as f64;
        assert!(mesh.volume() > 0.1 * count && mesh.volume() < 1.3 * count, "seed {seed}: {} {count}", mesh.volume());
    }
}

#[test]
fn vertices_stay_apart_at_nodes_on_the_level() {
    // An octahedron with nodes on its surface: up to three lattice edges end in each.
    let octahedron = of(|x| 2.0 - x.abs().element_sum());
    let lattice = Lattice::over([DVec3::splat(-3.0), DVec3::splat(3.0)], 6, false).unwrap();
    let mesh = isosurface(&lattice, 0.0, &octahedron, &mut |_| ()).unwrap();
    assert!(mesh.is_closed() && mesh.positions.len() > 20);
    for (i, a) in mesh.positions.iter().enumerate() {
        assert!(mesh.positions[..i].iter().all(|b| a.distance(*b) > 1e-4), "{a}");
    }
}

#[test]
fn isosurface_of_extreme_values_is_closed() {
    let strange = |x: DVec3| match x.floor().element_sum() as i64 % 5 {
        0 => f64::INFINITY,
        1 => f64::NAN,
        2 => f64::from(f32::MAX),
        3 => 0.7,
        _ => 0.0,
    };
    let mesh = within([DVec3::ZERO, DVec3::new(9.0, 8.0, 7.0)], 9, 0.5, true, strange);
    assert!(mesh.is_closed() && !mesh.triangles.is_empty());
    assert!(mesh.positions.iter().all(|place| place.is_finite()));
    // A function that nowhere exceeds the level has no surface; one that does everywhere gives the box.
    assert_eq!(within(BOX, 20, 0.5, true, |_| 0.5).triangles.len(), 0);
    let full = within(BOX, 20, 0.5, true, |_| 0.6);
    assert!((full.volume() / (3.0 * 2.5 * 1.5) - 1.0).abs() < 0.01, "{}", full.volume());
}

#[test]
fn lattice_cells_are_nearly_cubes() {
    let lattice = Lattice::over(BOX, 30, false).unwrap();
    assert_eq!((lattice.nodes, lattice.low, lattice.cell()), ([31, 26, 16], BOX[0], 0.1));
    assert!(lattice.node([30, 25, 15]).abs_diff_eq(BOX[1], 1e-12));
    let closed = Lattice::over(BOX, 30, true).unwrap();
    assert_eq!(closed.nodes, [32, 27, 17]);
    assert!(closed.node([0, 0, 0]).abs_diff_eq(BOX[0] - 0.05, 1e-12));
    assert!(closed.node([31, 26, 16]).abs_diff_eq(BOX[1] + 0.05, 1e-12));
    assert_eq!(Lattice::over([DVec3::ZERO, DVec3::new(1.0, 1e-9, 1.0)], 2, false).unwrap().nodes, [3, 2, 3]);
    for (bounds, resolution, what) in [
        (BOX, 0, "`resolution`: is 0"),
        (BOX, 4097, "`resolution`: is 4097"),
        ([DVec3::ZERO, DVec3::X], 5, "use finite corners, the lower below the upper"),
        ([DVec3::ZERO, DVec3::NAN], 5, "use finite corners, the lower below the upper"),
        ([BOX[1], BOX[0]], 5, "use finite corners, the lower below the upper"),
    ] {
        let message = Lattice::over(bounds, resolution, true).unwrap_err().to_string();
        assert!(message.contains(what), "{message}");
    }
}

#[test]
fn isosurface_of_infinite_density_is_symmetric() {
    // Unseen space has infinite density: at the lower end of edges in one case, at the upper end in the other.
    let border = |above: bool| {
        let hidden = of(move |x: DVec3| if (x.x > 0.31) == above { f64::INFINITY } else { 0.0 });
        isosurface(&Lattice::over(BOX, 30, false).unwrap(), 3.0, &hidden, &mut |_| ()).unwrap()
    };
    let [above, below] = [true, false].map(border);
    assert!(!above.positions.is_empty() && above.positions == below.positions);
    assert!(above.positions.iter().all(|place| (place.x - 0.31).abs() <= 0.5 * 0.1 / 32.0 + 1e-6));
}

#[test]
fn too_many_vertices_are_an_error() {
    // A checkerboard crosses every edge of the lattice: 3 x 9 x 10 x 10.
    let sponge = of(|x: DVec3| x.round().element_sum().rem_euclid(2.0));
    let lattice = Lattice { low: DVec3::ZERO, cell: DVec3::ONE, nodes: [10; 3] };
    let of_at_most = |most: usize| limited(&lattice, 0.5, &sponge, &mut |_| (), most);
    assert_eq!(of_at_most(2700).unwrap().positions.len(), 2700);
    let error = of_at_most(2699).unwrap_err().to_string();
    assert!(error.contains("`resolution`: is too fine: the surface has more than 2699 vertices"), "{error}");
}
