//! The hash grid: comparison with a plain oracle, borders, and the adjoint.

use super::*;
use proptest::prelude::*;
use raygrad_autograd::{Gradient, Op, Pool, RowSums, Scalar, Tape, Tensor};
use raygrad_nn::{Adam, AdamConfig, Optimizer, Params};
use std::sync::Arc;

fn grid(levels: usize, features: usize, log2_table: u32, coarsest: usize, finest: usize) -> HashGrid {
    HashGrid::new(&HashGridConfig { levels, features, log2_table, coarsest, finest }).unwrap()
}

fn encode<T: Scalar>(grid: &HashGrid, positions: &[f64], table: &Tensor<T>) -> Vec<f64> {
    let positions = Tensor::from_vec(&[positions.len() / 3, 3], positions.iter().map(|&x| T::from_f64(x)).collect());
    let out = HashEncoding::new(grid.clone()).forward(&[&positions, table], &Pool::none());
    out.as_slice().iter().map(|x| x.to_f64()).collect()
}

/// Reproducible numbers in 0..1.
fn units(count: usize, salt: u64) -> Vec<f64> {
    let table = grid(1, 1, 4, 1, 1);
    (0..count as u64).map(|i| 0.5 + 5e3 * table.init::<f64>(salt + 1000 * i).as_slice()[0]).collect()
}

/// The features at one position by the paper's formulas, in f64.
fn oracle(grid: &HashGrid, x: &[f64], table: &Tensor<f64>) -> Vec<f64> {
    let features = grid.features();
    let mut out = vec![];
    for level in grid.levels() {
        let n = f64::from(level.resolution);
        let cell: Vec<f64> = x.iter().map(|x| (x.clamp(0.0, 1.0) * n).floor().min(n - 1.0)).collect();
        let mut sum = vec![0.0; features];
        for corner in 0..8 {
            let (mut weight, mut at) = (1.0, [0_u64; 3]);
            for axis in 0..3 {
                let (high, place) = (corner >> axis & 1, x[axis].clamp(0.0, 1.0) * n - cell[axis]);
                weight *= if high == 1 { place } else { 1.0 - place };
                at[axis] = cell[axis] as u64 + high;
            }
            let side = n as u64 + 1;
            let row = if level.hashed {
                (at[0] ^ (at[1] * 2_654_435_761) ^ (at[2] * 805_459_861)) % level.rows.len() as u64
            } else {
                at[0] + side * (at[1] + side * at[2])
            };
            let first = (level.rows.start + row as usize) * features;
            for (sum, value) in sum.iter_mut().zip(&table.as_slice()[first..]) {
                *sum += weight * value;
            }
        }
        out.extend(sum);
    }
    out
}

#[test]
fn catalogue_grids_are_valid() {
    assert_eq!(entries().len(), 4);
}

#[test]
fn paper_grid_has_the_papers_levels() {
    let paper = HashGrid::new(&HashGridConfig::paper()).unwrap();
    let resolutions: Vec<_> = paper.levels().iter().map(|level| level.resolution).collect();
    assert_eq!(resolutions, [16, 22, 30, 42, 58, 80, 111, 153, 212, 294, 406, 561, 776, 1072, 1482, 2048]);
    assert_eq!(paper.levels()[0].rows, 0..4928, "17^3 = 4913 corners, in whole lines");
    assert!(!paper.levels()[4].hashed && paper.levels()[5].hashed && paper.width() == 32);
    assert!(paper.levels().iter().skip(5).all(|level| level.rows.len() == 1 << 19));
    assert!(paper.levels().windows(2).all(|pair| pair[0].rows.end == pair[1].rows.start));
}

#[test]
fn hash_grid_size_follows_budget_and_resolution() {
    let size = |samples: f64, pixels_per_side: f64| {
        let config = HashGridConfig::cpu(samples, pixels_per_side);
        let grid = HashGrid::new(&config).unwrap();
        assert_eq!(grid.levels()[7].resolution as usize, config.finest);
        (config.log2_table, config.finest)
    };
    assert_eq!(
        [2e8, 2.1e8, 6e8, 6.1e8].map(|samples| size(samples, 1e4)),
        [(17, 512), (18, 512), (18, 512), (19, 768)]
    );
    assert_eq!([0.0, 100.3, 256.0, 300.0].map(|pixels| size(1e8, pixels).1), [32, 201, 512, 512]);
    assert_eq!(size(1e9, 300.0), (19, 600));
}

#[test]
fn hash_grid_settings_out_of_range_are_named() {
    let wrong = [
        (HashGridConfig { finest: 65537, ..HashGridConfig::paper() }, "`finest`"),
        (HashGridConfig { coarsest: 0, ..HashGridConfig::paper() }, "`coarsest`"),
        (HashGridConfig { features: 3, ..HashGridConfig::paper() }, "`features`"),
        (HashGridConfig { levels: 0, ..HashGridConfig::paper() }, "`levels`"),
        (HashGridConfig { log2_table: 29, ..HashGridConfig::paper() }, "`log2_table`"),
    ];
    for (config, name) in wrong {
        let error = HashGrid::new(&config).unwrap_err().to_string();
        assert!(error.starts_with(name), "{error}");
    }
}

#[test]
fn hash_encoding_agrees_with_formula_at_any_width() {
    for features in [1, 2, 4, 8, 16, 32] {
        let grid = grid(5, features, 9, 3, 40);
        assert!(!grid.levels()[0].hashed && grid.levels()[4].hashed);
        let table = grid.init::<f64>(7);
        for samples in [1, 63, 64, 65, 200] {
            let positions = units(3 * samples, 1);
            let got = encode(&grid, &positions, &table);
            let single = encode(&grid, &positions, &table.cast::<f32>());
            for (i, x) in positions.chunks(3).enumerate() {
                for (j, expected) in oracle(&grid, x, &table).into_iter().enumerate() {
                    let k = i * grid.width() + j;
                    assert!((got[k] - expected).abs() <= 1e-18 + 1e-12 * expected.abs(), "{x:?}");
                    // Rounding of the position changes the position in the cell by at most 2^-24 * 40.
                    assert!((single[k] - expected).abs() <= 2e-9, "{x:?}");
                }
            }
        }
    }
}

/// Coordinates at which naive formulas leave the cube or the cell.
fn extremes(n: u32) -> Vec<f64> {
    let border = (n / 2) as f32 / n as f32;
    let near = [border.next_down(), border, border.next_up(), f32::MIN_POSITIVE, 1.0 - f32::EPSILON / 2.0];
    let outside = [0.0, -0.0, 1.0, -1e-9, 1.0 + 1e-6, -3.0, 7e30, f32::INFINITY, f32::NEG_INFINITY];
    near.into_iter().chain(outside).map(f64::from).collect()
}

#[test]
fn rows_stay_in_bounds() {
    // The kernels do not check bounds, so the test does. With a table of ones, every read must return 1.
    for n in [16, 17, 1000, 2048, 65535, 65536] {
        for (log2_table, levels) in [(4, 1), (15, 1), (15, 2)] {
            let grid = grid(levels, 2, log2_table, n as usize, n as usize);
            let table = Tensor::<f32>::ones(&[grid.rows(), 2]);
            let mut x = extremes(n);
            x.push(f64::NAN);
            let positions: Vec<f64> = (0..x.len().pow(3))
                .flat_map(|i| [x[i % x.len()], x[i / x.len() % x.len()], x[i / x.len().pow(2)]])
                .collect();
            let out = encode(&grid, &positions, &table);
            for (x, out) in positions.chunks(3).zip(out.chunks(grid.width())) {
                if x.iter().any(|x| x.is_nan()) {
                    assert!(out.iter().all(|y| y.is_nan()), "{x:?}: {out:?}");
                } else {
                    // The weights sum to 1.
                    assert!(out.iter().all(|y| (y - 1.0).abs() <= 2e-7), "{x:?}: {out:?}");
                }
            }
            let ones = vec![1.0_f32; positions.len() / 3 * grid.width()];
            let positions: Vec<f32> = positions.iter().map(|&x| x as f32).collect();
            for (l, level) in grid.levels().iter().enumerate() {
                grid.scatter_level(l, &positions, &ones, 0.0, &mut RowSums::new(level.rows.len(), 2));
            }
        }
    }
}

#[test]
fn hash_encoding_is_continuous_across_cell_borders() {
    for n in [16_u32, 100, 2048, 65536] {
        let grid = grid(1, 2, 12, n as usize, n as usize);
        let table = grid.init::<f32>(3);
        for cell in [1, n / 3, n / 2, n - 1] {
            let border = cell as f32 / n as f32;
            let at = |x: f32| encode(&grid, &[x.into(), 0.3, 0.7], &table);
            let (below, above) = (at(border.next_down()), at(border.next_up()));
            // Features vary by at most 2e-4 across a cell, and two f32 steps are this share of a cell.
            let share = f64::from(border.next_up() - border.next_down()) * f64::from(n);
            for (a, b) in below.iter().zip(above) {
                assert!((a - b).abs() <= 2e-4 * share + 1e-10, "{a} {b} at {border} of {n}");
            }
        }
    }
}

#[test]
fn hash_encoding_outside_the_cube_has_no_gradient() {
    let grid = grid(3, 2, 7, 2, 9);
    let table = grid.init::<f64>(1);
    assert_eq!(encode(&grid, &[-1e-9, 0.3, 1.5], &table), encode(&grid, &[0.0, 0.3, 1.0], &table));
    let tape = Tape::new();
    let x = tape.leaf(Tensor::from_vec(&[1, 3], vec![-1e-9, 0.3, 1.5]));
    let table = tape.leaf(table);
    let [dx, _] = tape.apply(HashEncoding::new(grid), &[&x, &table]).sum().grad(&[&x, &table]).try_into().unwrap();
    assert!(dx.as_slice()[0] == 0.0 && dx.as_slice()[2] == 0.0 && dx.as_slice()[1] != 0.0);
}

proptest! {
    #[test]
    fn hash_scatter_is_the_adjoint_of_encode(seed in 0_u64..1000, samples in 1_usize..150) {
        let grid = grid(4, 2, 8, 3, 33);
        let (table, positions) = (grid.init::<f64>(seed), units(3 * samples, seed));
        let d_out = units(samples * grid.width(), seed + 1);
        let out = encode(&grid, &positions, &table);
        let forward: f64 = out.iter().zip(&d_out).map(|(a, b)| a * b).sum();
        let mut backward = 0.0;
        for (l, level) in grid.levels().iter().enumerate() {
            let mut sums = RowSums::new(level.rows.len(), 2);
            grid.scatter_level(l, &positions, &d_out, 0.0, &mut sums);
            for (&row, sum) in sums.rows().iter().zip(sums.sums().chunks(2)) {
                let values = &table.as_slice()[(level.rows.start + row as usize) * 2..];
                backward += sum[0] * values[0] + sum[1] * values[1];
            }
        }
        prop_assert!((forward - backward).abs() <= 1e-14, "{forward:e} {backward:e}");
    }
}

#[test]
fn zero_gradient_updates_no_row() {
    let grid = grid(2, 4, 9, 5, 50);
    let positions = units(3 * 20, 5);
    let mut d_out = units(20 * grid.width(), 6);
    let mut sums = RowSums::new(grid.levels()[1].rows.len(), 4);
    grid.scatter_level(1, &positions, &d_out, 0.0, &mut sums);
    assert!((8..=160).contains(&sums.rows().len()) && sums.sums().iter().all(|&sum| sum != 0.0));
    sums.clear();
    d_out.fill(0.0);
    grid.scatter_level(1, &positions, &d_out, 0.0, &mut sums);
    assert!(sums.rows().is_empty());
}

/// The gradient of the table with this gradient cut, while positions have a gradient too, as with refined cameras.
fn table_gradient(grid: &HashGrid, positions: &[f64], d_out: &[f32], cut: f64) -> Vec<f32> {
    let (tape, positions) = (Tape::new(), positions.iter().map(|&x| x as f32).collect());
    let (table, samples) = (tape.leaf(grid.init::<f32>(1)), d_out.len() / grid.width());
    let x = tape.leaf(Tensor::from_vec(&[samples, 3], positions));
    let out = tape.apply(HashEncoding::new(grid.clone()).with_gradient_cut(cut), &[&x, &table]);
    let weights = tape.constant(Tensor::from_vec(&[samples, grid.width()], d_out.to_vec()));
    let [table, _] = (out * weights).sum().grad(&[&table, &x]).try_into().unwrap();
    table.as_slice().to_vec()
}

#[test]
fn gradient_cut_drops_small_gradients_of_each_level() {
    let (grid, samples) = (grid(3, 2, 7, 4, 16), 100);
    let (positions, width) = (units(3 * samples, 1), grid.width());
    let (random, sizes) = (units(samples * width, 2), units(samples, 3));
    // The second level has much smaller gradients, and half of the samples a thousandth of the others'. In a square they
    // would leave the range.
    let size = |i: usize| if sizes[i / width] < 0.5 { 1e-3 } else { 1.0 };
    let level = |i: usize| if i % width / 2 == 1 { 1e-30 } else { 1.0 };
    let d_out: Vec<f32> = random.iter().enumerate().map(|(i, x)| ((x + 0.1) * size(i) * level(i)) as f32).collect();
    let large: Vec<f32> = d_out.iter().enumerate().map(|(i, x)| if size(i) < 1.0 { 0.0 } else { *x }).collect();
    let gradient = |d_out: &[f32], cut: f64| table_gradient(&grid, &positions, d_out, cut);
    assert_eq!(gradient(&d_out, 0.03), gradient(&large, 0.0));
    assert_ne!(gradient(&d_out, 0.0), gradient(&large, 0.0));
    assert_eq!(gradient(&d_out, 1e-5), gradient(&d_out, 0.0));
    // One feature that is large keeps the sample on that level alone.
    let mut one = d_out.clone();
    let small = sizes.iter().position(|size| *size < 0.5).unwrap();
    one[width * small + 5] = 1.0;
    let mut kept = large.clone();
    kept[width * small + 4..width * small + 6].copy_from_slice(&[one[width * small + 4], 1.0]);
    assert_eq!(gradient(&one, 0.03), gradient(&kept, 0.0));
}

#[test]
fn gradient_cut_drops_small_gradients_of_any_number_of_features() {
    for features in [1, 2, 4, 8] {
        let grid = grid(2, features, 7, 4, 16);
        let (positions, width) = (units(30, 1), grid.width());
        let d_out: Vec<f32> = (0..10 * width).map(|i| if i / width < 5 { 1.0 } else { 1e-3 }).collect();
        let large: Vec<f32> = d_out.iter().map(|x| if *x < 1.0 { 0.0 } else { *x }).collect();
        assert_eq!(table_gradient(&grid, &positions, &d_out, 0.1), table_gradient(&grid, &positions, &large, 0.0));
    }
}

#[test]
fn gradient_cut_is_relative_to_the_root_mean_square() {
    let (grid, samples) = (grid(2, 4, 7, 4, 16), 500);
    let width = grid.width();
    for (seed, power) in [(1, 1), (2, 3), (3, 9)] {
        let d_out: Vec<f32> = units(samples * width, seed).iter().map(|x| (2.0 * x - 1.0).powi(power) as f32).collect();
        for share in [0.01, 0.1, 1.0] {
            let encoding = HashEncoding::new(grid.clone()).with_gradient_cut(share);
            for (level, cut) in encoding.cuts(&d_out).into_iter().enumerate() {
                let values = d_out.chunks(width).flat_map(|row| &row[4 * level..][..4]);
                let squares: f64 = values.map(|x| f64::from(*x).powi(2)).sum();
                let expected = share * (squares / (4 * samples) as f64).sqrt();
                assert!((f64::from(cut) - expected).abs() <= 1e-6 * expected, "{cut} for {expected}");
            }
        }
    }
}

#[test]
fn gradient_cut_never_hides_what_is_not_finite() {
    let grid = grid(2, 2, 7, 4, 16);
    let (positions, mut d_out) = (units(30, 1), vec![1.0_f32; 10 * grid.width()]);
    for wrong in [f32::NAN, f32::INFINITY] {
        d_out[..2].copy_from_slice(&[wrong, 0.0]);
        let gradient = table_gradient(&grid, &positions, &d_out, 0.5);
        assert_eq!(format!("{gradient:?}"), format!("{:?}", table_gradient(&grid, &positions, &d_out, 0.0)));
        assert!(gradient.iter().any(|x| !x.is_finite()) && gradient.iter().filter(|x| **x != 0.0).count() > 32);
    }
    assert_eq!(HashEncoding::new(grid).with_gradient_cut(0.5).cuts::<f32>(&[]), [0.0; 2]);
}

#[test]
#[should_panic(expected = "a gradient cut of -0.1; use 0 to 1")]
fn gradient_cut_out_of_range_is_refused() {
    drop(HashEncoding::new(grid(1, 2, 7, 4, 4)).with_gradient_cut(-0.1));
}

fn tiles(grid: &HashGrid, count: usize) -> Vec<Arc<HashGrad<f32>>> {
    let tensor = |shape: &[usize], salt| {
        let values = units(shape.iter().product(), salt);
        Tensor::from_fn(shape, |i| values[i] as f32)
    };
    (0..count as u64)
        .map(|t| {
            Arc::new(HashGrad {
                grid: grid.clone(),
                positions: tensor(&[90, 3], t),
                d_out: tensor(&[90, grid.width()], 100 + t),
                cuts: vec![0.0; grid.levels().len()],
            })
        })
        .collect()
}

/// A store with a grid's initial table, and its gradient from these tiles.
fn store(grid: &HashGrid, tiles: &[Arc<HashGrad<f32>>]) -> (Params<f32>, Gradient<f32>) {
    let mut params = Params::new();
    params.add("table", grid.init::<f32>(1));
    params.set_lazy(|_| true, true);
    let mut gradient = Gradient::zero(grid.shape());
    tiles.iter().for_each(|tile| gradient.add_sparse(tile.clone()));
    (params, gradient)
}

#[test]
fn hash_table_any_threads_give_same_bits() {
    let grid = grid(5, 2, 10, 4, 64);
    let tiles = tiles(&grid, 3);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let (mut params, gradient) = store(&grid, &tiles);
        let mut adam = Adam::new(AdamConfig::default());
        let step = |_| pool.install(|| adam.update(&mut params, std::slice::from_ref(&gradient), 1e-2));
        let reports: Vec<_> = (0..5).map(step).collect();
        (params.values()[0].clone(), reports)
    };
    let one = run(1);
    assert!(one.1.iter().all(|report| report.updated > 2000 && report.skipped == 0));
    assert!(one == run(2) && one == run(4));
}

#[test]
fn sparse_hash_update_equals_dense_update() {
    let grid = grid(3, 2, 6, 4, 16);
    let tiles = tiles(&grid, 2);
    let start = grid.init::<f32>(1);
    let mut dense = vec![0.0_f32; start.len()];
    for tile in &tiles {
        let tape = Tape::new();
        let table = tape.leaf(start.clone());
        let out = tape.apply(HashEncoding::new(grid.clone()), &[&tape.constant(tile.positions.clone()), &table]);
        let grad = (out * tape.constant(tile.d_out.clone())).sum().grad(&[&table]).remove(0);
        raygrad_tensor::add_assign(&mut dense, grad.as_slice());
    }
    let (mut params, gradient) = store(&grid, &tiles);
    let report = Adam::new(AdamConfig::default()).update(&mut params, &[gradient], 1e-2);
    assert_eq!(report.updated, 2 * dense.chunks(2).filter(|row| *row != [0.0; 2]).count());
    // Adam's first step is the learning rate against the gradient's sign.
    for ((after, before), g) in params.values()[0].as_slice().iter().zip(start.as_slice()).zip(&dense) {
        let expected = if *g == 0.0 { 0.0 } else { -1e-2 * g.signum() };
        assert!((after - before - expected).abs() <= 1e-5, "{before} to {after}, gradient {g}");
    }
    // The row sums and the dense gradient of one tile have the same order of additions, so the updates must be equal.
    let (mut params, gradient) = store(&grid, &tiles[..1]);
    let report = Adam::new(AdamConfig::default()).update(&mut params, &[gradient], 1e-2);
    let mut sums = RowSums::new(grid.rows(), 2);
    let (mut other, gradient) = store(&grid, &tiles[..1]);
    assert!(gradient.scatter(&mut sums));
    let mut scattered = vec![0.0; start.len()];
    sums.add_to(&mut scattered);
    assert_eq!(scattered, gradient.clone().into_dense(&Pool::none()).as_slice());
    let dense = Gradient::from(gradient.into_dense(&Pool::none()));
    let again = Adam::new(AdamConfig::default()).update(&mut other, &[dense], 1e-2);
    assert_eq!((again.updated, other.values()), (report.updated, params.values()));
}

#[test]
fn nan_gradient_is_skipped_and_forgotten() {
    let grid = grid(2, 2, 6, 4, 16);
    let mut tiles = tiles(&grid, 1);
    let (mut params, _) = store(&grid, &tiles);
    let mut adam = Adam::new(AdamConfig::default());
    let mut step = |value: f32| {
        Arc::get_mut(&mut tiles[0]).unwrap().d_out.as_mut_slice()[0] = value;
        let (_, gradient) = store(&grid, &tiles);
        let report = adam.update(&mut params, &[gradient], 1e-2);
        assert!(params.values()[0].is_finite());
        report.skipped
    };
    assert!((2..=16).contains(&step(f32::NAN)));
    assert_eq!(step(1.0), 0);
}
