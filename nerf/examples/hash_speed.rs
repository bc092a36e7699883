//! How fast the hash grid is on one thread: nanoseconds a sample for encoding, for adding gradients to a level's table
//! and for the optimizer (also a row that it moves, with adding its gradient to none), at random positions and in order along
//! rays.
//!
//! ```text
//! cargo run --release -p raygrad-nerf --example hash_speed [levels features log2_table]
//! ```

use raygrad_autograd::{Gradient, Op, Pool, RowGrad, RowSums, Tensor};
use raygrad_nerf::encoding::hash_grid::{HashEncoding, HashGrid, HashGridConfig};
use raygrad_nn::{Adam, AdamConfig, Optimizer, Params};
use std::sync::Arc;
use std::time::Instant;

/// Samples of a tile, and tiles of a step.
const TILE: usize = 4096;
const TILES: usize = 32;
/// Samples along a ray, and the distance between them.
const RAY: usize = 64;
const SPACING: f64 = 1.0 / 512.0;

/// Reproducible numbers in 0..1 without a pattern.
fn unit(i: usize) -> f64 {
    let mut x = (i as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    x = (x ^ (x >> 32)).wrapping_mul(0xd6e8_feb8_6659_fd93);
    (x >> 11) as f64 / (1_u64 << 53) as f64
}

fn random(i: usize, axis: usize) -> f64 {
    unit(3 * i + axis)
}

/// Short runs through the cube, as samples are when empty space is skipped.
fn along_rays(i: usize, axis: usize) -> f64 {
    let (ray, step) = (i / RAY, (i % RAY) as f64);
    let direction = [0.5, 0.6, 0.62][axis];
    0.05 + 0.8 * unit(3 * ray + axis) + SPACING * direction * step
}

/// Runs of each measurement.
const RUNS: usize = 15;

/// The time of `work` for all tiles in nanoseconds a sample, each tile counted at the least time of several runs.
fn each_tile(mut work: impl FnMut(usize)) -> f64 {
    let mut least = [f64::INFINITY; TILES];
    for _ in 0..RUNS {
        for (t, least) in least.iter_mut().enumerate() {
            let start = Instant::now();
            work(t);
            *least = least.min(start.elapsed().as_secs_f64());
        }
    }
    least.iter().sum::<f64>() * 1e9 / (TILE * TILES) as f64
}

fn measure(config: &HashGridConfig, name: &str, position: fn(usize, usize) -> f64) -> raygrad_nerf::Result<()> {
    let grid = HashGrid::new(config)?;
    let pool = Pool::new();
    let table = grid.init::<f32>(1);
    // Positions, and gradients of their features.
    let tile = |t: usize| {
        let positions = Tensor::from_fn(&[TILE, 3], |i| position(t * TILE + i / 3, i % 3) as f32);
        (positions, Tensor::from_fn(&[TILE, grid.width()], |i| unit(t * TILE + i) as f32 - 0.5))
    };
    let tiles: Vec<_> = (0..TILES).map(tile).collect();
    let encoding = HashEncoding::new(grid.clone());
    let encode = each_tile(|t| {
        std::hint::black_box(encoding.forward(&[&tiles[t].0, &table], &pool));
    });
    let constants = AdamConfig { beta2: 0.99, eps: 1e-15, ..AdamConfig::default() };
    let (mut scatter, mut adam, mut moved) = (0.0, 0.0, 0);
    for (l, level) in grid.levels().iter().enumerate() {
        let shape = [level.rows.len(), grid.features()];
        let mut sums = RowSums::new(shape[0], shape[1]);
        let mut optimizer = Adam::<f32>::new(constants);
        let mut params = Params::new();
        params.add("level", table.slice_axis(0, level.rows.clone()));
        params.set_lazy(|_| true, true);
        let mut least = [f64::INFINITY; 2];
        for run in 0..RUNS {
            let start = Instant::now();
            for (positions, d_out) in &tiles {
                grid.scatter_level(l, positions.as_slice(), d_out.as_slice(), 0.0, &mut sums);
            }
            let scattered = start.elapsed();
            let rows = Tensor::from_vec(&[sums.rows().len(), shape[1]], sums.sums().to_vec());
            let mut gradient = Gradient::zero(&shape);
            gradient.add_sparse(Arc::new(RowGrad::new(&shape, sums.rows().into(), rows)));
            sums.clear();
            let start = Instant::now();
            let report = optimizer.update(&mut params, &[gradient], 1e-2);
            let times = [scattered, start.elapsed()];
            for (least, time) in least.iter_mut().zip(times) {
                *least = least.min(time.as_secs_f64());
            }
            moved += if run == 0 { report.updated / shape[1] } else { 0 };
        }
        scatter += least[0] * 1e9 / (TILE * TILES) as f64;
        adam += least[1] * 1e9;
    }
    println!(
        "{:>2} x {} 2^{} {name:<10} {encode:>8.1} {scatter:>8.1} {:>8.1} {:>8.1} {:>10.1} %",
        config.levels,
        config.features,
        config.log2_table,
        adam / (TILE * TILES) as f64,
        adam / moved as f64,
        100.0 * moved as f64 / grid.rows() as f64
    );
    Ok(())
}

fn main() -> raygrad_nerf::Result<()> {
    let arguments: Vec<usize> = std::env::args().skip(1).filter_map(|argument| argument.parse().ok()).collect();
    let configs = match arguments[..] {
        [levels, features, log2_table] => {
            vec![HashGridConfig { levels, features, log2_table: log2_table as u32, ..HashGridConfig::paper() }]
        }
        _ => vec![HashGridConfig::cpu(0.0, f64::INFINITY), HashGridConfig::paper()],
    };
    println!("ns a sample on one thread, steps of {} samples", TILE * TILES);
    println!("{:<21} {:>8} {:>8} {:>8} {:>8} {:>12}", "", "encode", "scatter", "adam", "(a row)", "rows moved");
    for config in &configs {
        measure(config, "random", random)?;
        measure(config, "along rays", along_rays)?;
    }
    Ok(())
}
