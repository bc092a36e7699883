//! The cells of a hash grid.

use super::support::*;
use raygrad::nerf::encoding::hash_grid::{HashEncoding, HashGrid, HashGridConfig};
use raygrad::{Scalar, Tape, Tensor};

const SIZES: [usize; 5] = [16, 255, 2048, 30_000, 65_536];

fn grid(size: usize) -> HashGrid {
    HashGrid::new(&HashGridConfig { levels: 1, features: 2, log2_table: 14, coarsest: size, finest: size }).unwrap()
}

/// The first feature at points along one axis, and its slope along that axis.
fn along<T: Scalar>(grid: &HashGrid, table: &Tensor<T>, axis: usize, x: &[f64]) -> [Vec<f64>; 2] {
    let tape = Tape::new();
    let points: Vec<f64> = x
        .iter()
        .flat_map(|&x| std::array::from_fn::<_, 3, _>(|k| if k == axis { x } else { 0.3 + 0.1 * k as f64 }))
        .collect();
    let points = tape.leaf(tensor::<T>(&[x.len(), 3], &points));
    let y = tape.apply(HashEncoding::new(grid.clone()), &[&points, &tape.constant(table.clone())]).slice_axis(1, ..1);
    let slopes = y.sum().grad(&[&points]).remove(0);
    [numbers(y.value()), numbers(&slopes).chunks_exact(3).map(|row| row[axis]).collect()]
}

/// Matrix: weights sum to 1 within 2e-7 at x = 0, 1, 1 - 2^-24, border +- ulp, -1e-9, for N = 16 to 65536.
fn weights_sum_to_one_everywhere<T: Scalar>() {
    for size in SIZES {
        let grid = grid(size);
        let ones = Tensor::ones(grid.shape());
        let border = round::<T>((size / 3) as f64 / size as f64);
        let mut x = vec![0.0, -0.0, 1.0, 1.0 - 2.0_f64.powi(-24), -1e-9, 1.0 + 1e-6, -5.0, 7.0, 1e30, -1e30, 0.123];
        x.extend([border, beside::<T>(border, true), beside::<T>(border, false), smallest::<T>()]);
        x.extend([f64::INFINITY, f64::NEG_INFINITY]);
        for axis in 0..3 {
            let [sums, _] = along::<T>(&grid, &ones, axis, &x);
            for (sum, x) in sums.iter().zip(&x) {
                within(&format!("N {size}, x {x:e}"), *sum, 1.0, by_type::<T>(2e-7, 4e-16));
            }
        }
    }
}

/// Matrix: continuous values and one-sided gradients at the borders of cells.
fn values_are_continuous_and_slopes_one_sided<T: Scalar>() {
    for size in SIZES {
        let grid = grid(size);
        let tiny = grid.init::<T>(3);
        let table = Tensor::from_fn(tiny.shape(), |i| T::from_f64(1e4 * tiny.as_slice()[i].to_f64()));
        for cell in [1, size / 3, size - 1] {
            let border = round::<T>(cell as f64 / size as f64);
            let step = 2.0 * ulp::<T>(border);
            let quarter = 0.25 / size as f64;
            let x = [border - step, border, border + step, border - quarter, border + quarter];
            for axis in 0..3 {
                let [y, slopes] = along::<T>(&grid, &table, axis, &x.map(round::<T>));
                // Features differ by at most 2 between corners, so slopes are at most 2 N.
                let most = 2.0 * size as f64;
                for k in [0, 2] {
                    within(&format!("N {size}, cell {cell}"), y[k], y[1], most * 2.0 * step + 4.0 * T::EPSILON);
                }
                // A quarter of a cell from the border, the interpolation is linear. The position within a cell has an
                // error of half an ULP of x N.
                let error = 4.0 * most * size as f64 * ulp::<T>(1.0) + 8.0 * T::EPSILON * size as f64;
                for (side, sign) in [(3, -1.0), (4, 1.0)] {
                    let difference = (y[side] - y[1]) / (sign * quarter);
                    within(&format!("N {size}, cell {cell}, side {sign}"), slopes[side], difference, error);
                }
                let upper = (slopes[1] - slopes[4]).abs() <= error;
                let lower = (slopes[1] - slopes[3]).abs() <= error;
                assert!(upper || lower, "N {size}: at the border {} of {} and {}", slopes[1], slopes[3], slopes[4]);
            }
        }
    }
}

/// Matrix: NaN stays in its sample and never reads out of bounds; outside of the cube slopes are 0.
fn outside_and_nan<T: Scalar>() {
    for size in SIZES {
        let grid = grid(size);
        let table = grid.init::<T>(7);
        for axis in 0..3 {
            let x = [f64::NAN, 0.5, -1e-9, 1.5, f64::INFINITY];
            let [y, slopes] = along::<T>(&grid, &table, axis, &x);
            assert!(y[0].is_nan() && y[1..].iter().all(|y| y.is_finite()), "{y:?}");
            assert_eq!(slopes[2..], [0.0; 3]);
            let [edge, _] = along::<T>(&grid, &table, axis, &[0.0, 1.0, 1.0]);
            assert_eq!([y[2], y[3], y[4]], [edge[0], edge[1], edge[2]], "outside is the nearest point of the cube");
        }
    }
}

both!(weights_sum_to_one_everywhere, values_are_continuous_and_slopes_one_sided, outside_and_nan);

/// Catalogue: the position in a cell is off by 3.9e-3 at N = 65536 in f32, so that is the maximum.
#[test]
fn finer_grids_are_errors() {
    let config = HashGridConfig { levels: 1, features: 2, log2_table: 14, coarsest: 65_537, finest: 65_537 };
    assert!(HashGrid::new(&config).unwrap_err().to_string().starts_with("`finest`"));
}
