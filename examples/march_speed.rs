//! How fast rays are marched through an occupancy grid, on one thread: the embedded bulldozer's surface at 128^3.
//!
//! ```sh
//! cargo run --release --example march_speed
//! ```
//!
//! Cells are occupied where rays of 60 training cameras hit a surface, and around those. The rays that are timed are
//! those of ten other cameras in random order, as in training, and in order of pixels, as in rendering.

use glam::DVec3;
use rand::rngs::StdRng;
use rand::{SeedableRng, seq::SliceRandom};
use raygrad::nerf::Jitter;
use raygrad::nerf::space::occupancy::{MarchBuffer, OccupancyConfig, OccupancyGrid, Step, Threshold, Update};
use raygrad::nerf::{Ray, Rays, Result, clip_near_far};
use raygrad_scenes::{Scene, test_cameras, train_cameras};
use std::time::Instant;

const RESOLUTION: usize = 128;
/// Rays in a call.
const BATCH: usize = 1024;
const BOUNDS: [DVec3; 2] = [DVec3::splat(-1.5), DVec3::splat(1.5)];

/// The cell, x fastest, that holds a point of the box.
fn cell(point: DVec3) -> usize {
    let [low, high] = BOUNDS;
    let cell = (point - low) / (high - low) * RESOLUTION as f64;
    let [x, y, z] = cell.to_array().map(|x| (x as usize).min(RESOLUTION - 1));
    x + RESOLUTION * (y + RESOLUTION * z)
}

/// A grid whose occupied cells hold surfaces of the scene.
fn surfaces(scene: &Scene) -> Result<OccupancyGrid> {
    let mut hit = vec![false; RESOLUTION.pow(3)];
    for camera in train_cameras(60, 300) {
        for ray in (0..300 * 300).map(|i| camera.pixel_ray(i % 300, i / 300)) {
            if let Some(found) = scene.trace(&ray) {
                hit[cell(ray.at(found.distance))] = true;
            }
        }
    }
    let config = OccupancyConfig { resolution: RESOLUTION, ..OccupancyConfig::default() };
    let mut grid = OccupancyGrid::new(BOUNDS, &config)?;
    let start = Instant::now();
    let density = |points: &[[f32; 3]], out: &mut [f32]| {
        for (point, out) in points.iter().zip(out) {
            *out = if hit[cell(DVec3::from(point.map(f64::from)))] { 1.0 } else { 0.0 };
        }
    };
    grid.update(&Update::ALL, 0, 0, &density);
    println!("update of all cells, next to no density: {:.1} ms", start.elapsed().as_secs_f64() * 1e3);
    let start = Instant::now();
    grid.threshold(&Threshold { min_sigma: 0.5, or_mean: false, dilate: true });
    println!("threshold: {:.1} ms", start.elapsed().as_secs_f64() * 1e3);
    Ok(grid)
}

/// Marches the rays in batches and prints the fastest of `repeats` times, taken for each batch.
fn time(what: &str, grid: &OccupancyGrid, rays: &Rays<f32>, step: &Step, repeats: usize) {
    let mut out = MarchBuffer::default();
    let (mut seconds, mut samples, mut steps, mut hitting) = (0.0, 0, 0, 0);
    for start in (0..rays.len()).step_by(BATCH) {
        let batch = rays.slice(start..rays.len().min(start + BATCH));
        let mut best = f64::INFINITY;
        for _ in 0..repeats {
            let start = Instant::now();
            grid.march(&batch, step, &mut Jitter::Middle, &mut out);
            best = best.min(start.elapsed().as_secs_f64());
        }
        seconds += best;
        samples += out.t.len();
        steps += out.steps;
        hitting += out.offsets.windows(2).filter(|pair| pair[0] < pair[1]).count();
    }
    let (count, found) = (rays.len() as f64, samples as f64);
    println!(
        "{what:>22}: {:7.1} ns a ray, {:6.2} ns a sample; {:5.1} % hit, {:5.1} samples on each; 1 of {:.1} taken",
        1e9 * seconds / count,
        1e9 * seconds / found,
        100.0 * hitting as f64 / count,
        found / hitting as f64,
        steps as f64 / found,
    );
}

fn main() -> Result<()> {
    let scene = Scene::bulldozer();
    let grid = surfaces(&scene)?;
    println!("{:.1} % of cells are occupied", 100.0 * grid.occupied_share());
    let mut all: Vec<Ray> = Vec::new();
    for camera in test_cameras(10, 100) {
        all.extend((0..100 * 100).map(|i| camera.pixel_ray(i % 100, i / 100)));
    }
    let pack = |all: &[Ray]| {
        let mut rays = Rays::new();
        all.iter().for_each(|ray| rays.push(ray, clip_near_far(ray, BOUNDS, [2.0, 6.0])));
        rays
    };
    let ordered = pack(&all);
    let hitting: Vec<Ray> = all.iter().filter(|ray| scene.trace(ray).is_some()).copied().collect();
    all.shuffle(&mut StdRng::seed_from_u64(1));
    let shuffled = pack(&all);
    let hitting = pack(&hitting);
    let everything = OccupancyGrid::new(BOUNDS, &OccupancyConfig::default())?;
    for length in [3.0 * 3.0_f32.sqrt() / 1024.0, 0.01] {
        println!("steps of {length:.4}:");
        let step = Step::uniform(length);
        time("all rays, shuffled", &grid, &shuffled, &step, 40);
        time("all rays, in order", &grid, &ordered, &step, 40);
        time("hitting rays, in order", &grid, &hitting, &step, 40);
        time("everything occupied", &everything, &shuffled.slice(0..10_000), &step, 40);
        time("a slow cone", &grid, &shuffled.slice(0..20_000), &Step { cone: 1e-3, ..step }, 20);
    }
    Ok(())
}
