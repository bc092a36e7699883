//! A march returns exactly the samples of the uniform march in occupied cells.

use super::*;
use crate::camera::pinhole::Ray;
use crate::space::occupancy::OccupancyConfig;
use glam::DVec3;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

const BOX: [DVec3; 2] = [DVec3::new(-1.5, -1.0, -1.25), DVec3::new(1.5, 1.0, 1.75)];

/// A grid in which about `share` of the blocks have occupied cells, about half of their cells each.
fn random_grid(bounds: [DVec3; 2], resolution: usize, cascades: usize, share: f64, seed: u64) -> OccupancyGrid {
    let config = OccupancyConfig { resolution, cascades, ..OccupancyConfig::default() };
    let mut grid = OccupancyGrid::new(bounds, &config).unwrap();
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let words = (0..grid.lattice.words()).map(|i| {
        let word = if rng.random::<f64>() < share { rng.random() } else { 0 };
        if grid.lattice.is_used(i) { word } else { 0 }
    });
    let words = words.collect();
    grid.occupy(words, false);
    grid
}

fn one(origin: DVec3, direction: DVec3, span: [f64; 2]) -> Rays<f32> {
    let mut rays = Rays::new();
    rays.push(&Ray { origin, direction }, span);
    rays
}

fn march(grid: &OccupancyGrid, rays: &Rays<f32>, step: &Step) -> MarchBuffer {
    let mut out = MarchBuffer::default();
    grid.march(rays, step, &mut Jitter::Middle, &mut out);
    assert_eq!(out.offsets.len(), rays.len() + 1);
    assert_eq!([out.t.len(), out.delta.len()], [out.offsets[rays.len()] as usize; 2]);
    out
}

/// Returns true if the cell of a point, in units of the smallest cells, is occupied by definition.
fn is_occupied(grid: &OccupancyGrid, point: [f64; 3]) -> bool {
    let (resolution, cascades) = (grid.resolution(), grid.cascades());
    let cells = (resolution << (cascades - 1)) as f64;
    let cell = point.map(|x| x.floor() + 0.5 - 0.5 * cells);
    let radius = cell.iter().fold(0.0, |a: f64, x| a.max(x.abs()));
    let cascade = (0..cascades).find(|c| radius < 0.5 * (resolution << c) as f64).unwrap();
    let place = cell.map(|x| (x / (1 << cascade) as f64 + 0.5 * resolution as f64).floor() as usize);
    let (block, inner, side) = (place.map(|x| x / 4), place.map(|x| x % 4), resolution / 4);
    let word = cascade * grid.lattice.blocks() + block[0] + side * (block[1] + side * block[2]);
    grid.words[word] >> (inner[0] + 4 * inner[1] + 16 * inner[2]) & 1 == 1
}

#[test]
fn is_occupied_equals_the_cell_of_the_point() {
    for cascades in [1, 3] {
        let mut grid = random_grid(BOX, 32, cascades, 0.7, 7);
        let [low, high] = grid.outer_bounds();
        let cells = (grid.resolution() << (cascades - 1)) as f64;
        let mut occupied = 0;
        for i in 0..3000 {
            let share =
                DVec3::from([0.754_877_67, 0.569_840_29, 0.437_159_86].map(|x| (0.1 + x * f64::from(i)).fract()));
            let expected = is_occupied(&grid, (share * cells).to_array());
            assert_eq!(grid.is_occupied(low + share * (high - low)), expected, "{share}");
            occupied += u32::from(expected);
        }
        assert!((100..2900).contains(&occupied), "{occupied}");
        for outside in [low - 1e-9 * (high - low), high + DVec3::Y * 1e-6, DVec3::NAN] {
            assert!(!grid.is_occupied(outside), "{outside}");
        }
        grid.words.fill(u64::MAX);
        assert!(grid.is_occupied(low) && grid.is_occupied(high), "faces belong to the box");
    }
}

/// The samples of one ray, each tested separately, with the march's rounding of positions but without its skipping.
fn brute(grid: &OccupancyGrid, rays: &Rays<f32>, step: &Step) -> Vec<f32> {
    let everything = OccupancyGrid { words: vec![u64::MAX; grid.words.len()], ..grid.clone() };
    let everything = OccupancyGrid { leaps: super::super::Leaps::new(&everything.words, &grid.lattice), ..everything };
    let frame = Frame::new(&grid.lattice);
    let Some(ray) = LatticeRay::new(rays.origins[0], rays.directions[0], rays.spans[0], &frame) else { return vec![] };
    let all = march(&everything, rays, step).t.into_iter();
    let mut found: Vec<f32> = all
        .filter(|&t| {
            let mirrored = ray.at(t).map(|x| f64::from(x).floor() + 0.5);
            let flip = |axis: usize| ray.octant >> axis & 1 == 1;
            is_occupied(
                grid,
                [0, 1, 2].map(|a| if flip(a) { f64::from(frame.cells) - mirrored[a] } else { mirrored[a] }),
            )
        })
        .collect();
    found.truncate(step.max_samples);
    found
}

/// All samples in the box, by formulas in f64.
fn exact_places(grid: &OccupancyGrid, ray: &Ray, span: [f64; 2], length: f64) -> Vec<f64> {
    let [near, far] = crate::clip_near_far(ray, grid.outer_bounds(), span);
    (0..).map(|i| near + (i as f64 + 0.5) * length).take_while(|t| *t < far).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn march_equals_brute_force(
        origin in prop::array::uniform3(-3.0..3.0f64),
        direction in prop::array::uniform3(-1.0..1.0f64),
        zeroed in prop::array::uniform3(0..5u8),
        on_face in 0..6usize,
        density in 0..4usize,
        cascades in 1..4usize,
        cone in prop::sample::select(vec![0.0, 0.0, 1e-6, 1.0 / 256.0, 1.0]),
        length in 0.003..0.1f32,
        seed in 0..1000u64,
    ) {
        let share = [0.0, 0.03, 0.3, 1.0][density];
        let bounds = BOX;
        let grid = random_grid(bounds, 32, cascades, share, seed);
        let (mut origin, mut direction) = (origin, direction);
        for axis in 0..3 {
            match zeroed[axis] {
                0 => direction[axis] = 0.0,
                1 => direction[axis] = -0.0,
                _ => {}
            }
        }
        if on_face < 3 {
            origin[on_face] = bounds[seed as usize % 2][on_face];
        }
        let direction = DVec3::from(direction);
        prop_assume!(direction.length() > 1e-3);
        let rays = one(DVec3::from(origin), direction.normalize(), [0.0, 30.0]);
        let step = Step { length, cone, max_samples: usize::MAX };
        let found = march(&grid, &rays, &step);
        prop_assert_eq!(&found.t, &brute(&grid, &rays, &step));
        prop_assert!(found.t.windows(2).all(|pair| pair[0] < pair[1]));
        // A limit truncates the result.
        let few = Step { max_samples: 5, ..step };
        prop_assert_eq!(&march(&grid, &rays, &few).t[..], &found.t[..found.t.len().min(5)]);
    }

    #[test]
    fn march_equals_double_precision_away_from_faces(
        origin in prop::array::uniform3(-4.0..4.0f64),
        target in prop::array::uniform3(-1.0..1.0f64),
        cascades in 1..4usize,
        seed in 0..1000u64,
    ) {
        let grid = random_grid(BOX, 32, cascades, 0.2, seed);
        let round = |x: f64| f64::from(x as f32);
        let origin = DVec3::from(origin.map(round));
        let direction = DVec3::from((DVec3::from(target) - origin).normalize().to_array().map(round));
        let rays = one(origin, direction, [0.0, 100.0]);
        let found = march(&grid, &rays, &Step::uniform(0.02));
        let [low, high] = grid.outer_bounds();
        let cells = (grid.resolution() << (cascades - 1)) as f64;
        let mut found = found.t.iter().peekable();
        for t in exact_places(&grid, &Ray { origin, direction }, [0.0, 100.0], f64::from(0.02_f32)) {
            let place = ((origin + t * direction - low) / (high - low) * cells).to_array();
            let returned = found.next_if(|x| (f64::from(**x) - t).abs() < 1e-4).is_some();
            let doubtful = place.iter().any(|x| (x - x.round()).abs() < 1e-3);
            prop_assert!(doubtful || returned == is_occupied(&grid, place), "t = {t}, returned: {returned}");
        }
        prop_assert_eq!(found.next(), None);
    }
}

#[test]
fn march_along_axes_faces_and_edges_is_symmetric() {
    let config = OccupancyConfig { resolution: 8, ..OccupancyConfig::default() };
    let grid = OccupancyGrid::new([DVec3::NEG_ONE, DVec3::ONE], &config).unwrap();
    let step = Step::uniform(0.25);
    for axis in 0..3 {
        for sign in [1.0, -1.0] {
            for zero in [0.0, -0.0] {
                for other in [-1.0, 0.0, 0.5, 1.0] {
                    let (mut origin, mut direction) = (DVec3::splat(other), DVec3::splat(zero));
                    (origin[axis], direction[axis]) = (-3.0 * sign, sign);
                    let found = march(&grid, &one(origin, direction, [0.0, 9.0]), &step);
                    let expected: Vec<f32> = (0..8).map(|i| 2.125 + 0.25 * i as f32).collect();
                    assert_eq!((found.t, found.delta), (expected, vec![0.25; 8]), "axis {axis}, {sign}, {other}");
                    origin[(axis + 1) % 3] = 1.0001;
                    assert_eq!(march(&grid, &one(origin, direction, [0.0, 9.0]), &step).steps, 0, "beside the box");
                }
            }
        }
    }
    // From inside, from a corner inwards and outwards, and from behind.
    let count = |origin: DVec3, direction: DVec3| march(&grid, &one(origin, direction, [0.0, 9.0]), &step).t.len();
    assert_eq!(count(DVec3::ZERO, DVec3::X), 4);
    let diagonal = DVec3::ONE.normalize();
    assert_eq!((count(DVec3::NEG_ONE, diagonal), count(DVec3::ONE, -diagonal)), (14, 14));
    assert_eq!((count(DVec3::ONE, diagonal), count(2.0 * DVec3::X, DVec3::X)), (0, 0));
    assert_eq!(count(DVec3::new(0.1, 0.1, -3.0), DVec3::new(1e-40, 0.0, 1.0)), 8);
}

#[test]
fn march_of_non_finite_rays_is_empty() {
    let grid = random_grid(BOX, 16, 2, 1.0, 1);
    let step = Step { length: 0.1, cone: 0.01, max_samples: 100 };
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for axis in 0..3 {
            let mut place = DVec3::new(0.1, 0.2, 0.3);
            place[axis] = bad;
            for rays in [one(place, DVec3::X, [0.0, 1.0]), one(DVec3::ZERO, place, [0.0, 1.0])] {
                assert_eq!(march(&grid, &rays, &step).t, [0.0; 0]);
            }
        }
    }
    for span in [[f64::NAN, 1.0], [0.0, f64::NAN], [2.0, 1.0], [1.0, 1.0]] {
        assert_eq!(march(&grid, &one(DVec3::ZERO, DVec3::X, span), &step).t, [0.0; 0], "{span:?}");
    }
    assert!(!march(&grid, &one(DVec3::ZERO, DVec3::X, [0.0, f64::INFINITY]), &step).t.is_empty());
    assert!(march(&grid, &one(DVec3::ZERO, DVec3::ZERO, [0.0, f64::INFINITY]), &step).t.len() <= 100);
}

/// docs/library/numerics.md, "Sampling", march: the entry at 0, 2, 1e3, 32768 and 1e6, and steps below an ULP.
#[test]
fn march_far_from_origin_does_not_drift() {
    let length = 3.0_f32.sqrt() / 1024.0;
    for start in [0.0, 2.0, 1e3, 32768.0, 1e6] {
        let bounds = BOX.map(|corner| corner + DVec3::X * (start + 1.5));
        let grid = random_grid(bounds, 32, 1, 1.0, 3);
        let rays = one(DVec3::new(0.0, 0.1, 0.2), DVec3::X, [0.0, 2e6]);
        let found = march(&grid, &rays, &Step::uniform(length));
        assert_eq!(found.t, brute(&grid, &rays, &Step::uniform(length)));
        assert!(found.t.len() > 500 && found.steps < 2000, "{start}: {} of {}", found.t.len(), found.steps);
        let everything = random_grid(bounds, 32, 1, 0.0, 3);
        assert_eq!(march(&everything, &rays, &Step::uniform(length)).t, [0.0; 0]);
    }
    for (start, count) in [(0.0_f32, 1024), (2.0, 1024), (1e3, 1024), (32768.0, 1024), (1e6, 1024)] {
        let spacing = Uniform::new(&Step::uniform(length), [start, f32::INFINITY], 0.0);
        for i in 0..count {
            let exact = f64::from(start) + i as f64 * f64::from(length);
            let t = spacing.at(i);
            assert!((f64::from(t) - exact).abs() <= f64::from(t.next_up() - t), "{start}, step {i}");
        }
    }
    // Steps far below an ULP of the distance: the limit of steps ends the march.
    let grid = random_grid([DVec3::splat(-1e6), DVec3::splat(1e6)], 8, 1, 0.0, 5);
    let found = march(&grid, &one(DVec3::X * -3e6, DVec3::X, [0.0, 1e7]), &Step::uniform(1e-6));
    assert!(found.steps <= MAX_STEPS as u64 && found.t.is_empty());
}

/// docs/library/numerics.md, "Sampling", cone stepping.
#[test]
fn cone_steps_follow_recurrence_and_tend_to_uniform() {
    let config = OccupancyConfig { resolution: 16, cascades: 6, ..OccupancyConfig::default() };
    let grid = OccupancyGrid::new(BOX, &config).unwrap();
    let rays = one(DVec3::new(0.1, 0.1, 0.1), DVec3::new(0.6, 0.0, 0.8), [0.25, 40.0]);
    let uniform = march(&grid, &rays, &Step::uniform(0.02));
    for cone in [0.0, 1e-6, 1.0 / 256.0, 1.0] {
        let step = Step { length: 0.02, cone, max_samples: usize::MAX };
        let found = march(&grid, &rays, &step);
        assert!(found.t.windows(2).all(|pair| pair[0] < pair[1]));
        let (length, cone) = (f64::from(step.length), f64::from(cone));
        // Interval by interval, in f64.
        let mut edge = 0.25;
        for (&t, &delta) in found.t.iter().zip(&found.delta) {
            let width = length + cone * edge;
            assert!((f64::from(delta) / width - 1.0).abs() < 1e-5, "cone {cone}: {delta} against {width}");
            assert!((f64::from(t) / (edge + 0.5 * width) - 1.0).abs() < 1e-5, "cone {cone}: {t} from {edge}");
            edge += width;
        }
        assert!((edge - 40.0).abs() <= length + cone * edge, "cone {cone}: up to {edge}");
        if cone == 1e-6 {
            assert!(found.t.len().abs_diff(uniform.t.len()) <= 1);
            let close = |(a, b): (&f32, &f32)| (a - b).abs() <= 1e-6 * (40.0 * 40.0 / 0.04);
            assert!(found.t.iter().zip(&uniform.t).all(close));
        }
    }
}

#[test]
fn march_samples_have_positions_and_segments() {
    let grid = random_grid(BOX, 16, 1, 0.4, 9);
    let mut rays = Rays::new();
    for x in [0.3, 7.0, -0.4] {
        rays.push(&Ray { origin: DVec3::new(x, 0.1, -3.0), direction: DVec3::Z }, [0.0, 9.0]);
    }
    let found = march(&grid, &rays, &Step::uniform(0.05));
    assert_eq!(found.offsets[1], found.offsets[2], "the ray beside the box");
    let samples = found.samples(&rays, &Pool::new());
    assert_eq!(samples.segments.offsets(), found.offsets);
    let positions = samples.positions(&Pool::new());
    for (ray, rows) in samples.segments.ranges().enumerate() {
        for row in rows {
            let position = &positions.as_slice()[3 * row..][..3];
            assert_eq!(position, [rays.origins[ray][0], 0.1, -3.0 + found.t[row]]);
        }
    }
}

#[test]
fn march_buffer_is_reusable() {
    let (grid, other) = (random_grid(BOX, 32, 1, 0.2, 1), random_grid(BOX, 32, 2, 0.2, 2));
    let rays = one(DVec3::new(-3.0, 0.2, 0.3), DVec3::new(1.0, 0.05, -0.02).normalize(), [0.0, 9.0]);
    let mut out = MarchBuffer::default();
    for (grid, cone) in [(&grid, 0.0), (&other, 0.01), (&grid, 0.02), (&grid, 0.0), (&other, 0.01)] {
        let step = Step { length: 0.02, cone, max_samples: usize::MAX };
        grid.march(&rays, &step, &mut Jitter::Middle, &mut out);
        let fresh = march(grid, &rays, &step);
        assert_eq!((&out.t, &out.delta, &out.offsets), (&fresh.t, &fresh.delta, &fresh.offsets));
    }
}

#[test]
#[should_panic(expected = "`step.length`: is 0; use a finite length above 0")]
fn step_of_length_zero_panics() {
    march(&random_grid(BOX, 8, 1, 1.0, 0), &one(DVec3::ZERO, DVec3::X, [0.0, 1.0]), &Step::uniform(0.0));
}
