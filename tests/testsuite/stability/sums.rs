//! Long sums, and sums over many threads or into few positions.

use super::support::*;
use raygrad::{Axes, RowSums, Scalar, Segments, Tape, Tensor};
use std::sync::Arc;

/// Matrix: reduce 2^24 x 1e-4, and alternating +-1e8 + 1. Catalogue: long f32 sums.
fn long_sums<T: Scalar>() {
    let n = 1 << 24;
    let tape = Tape::new();
    let x = tape.constant(Tensor::full(&[n], T::from_f64(1e-4)));
    let expected = n as f64 * round::<T>(1e-4);
    near::<T>("2^24 x 1e-4", x.sum().item().to_f64(), expected, by_type::<T>(1e-6, 1e-14));
    near::<T>("their mean", x.mean().item().to_f64(), round::<T>(1e-4), by_type::<T>(1e-6, 1e-14));
    let rows = x.reshape(&[n / 16, 16]).sum_over(Axes::from(0).keepdims());
    numbers(rows.value()).iter().for_each(|sum| near::<T>("columns", *sum, expected / 16.0, by_type::<T>(1e-6, 1e-14)));
    drop((x, rows));
    let n = 1 << 20;
    let value = |i: usize| {
        if i.is_multiple_of(2) {
            1.0
        } else if i % 4 == 1 {
            1e8
        } else {
            -1e8
        }
    };
    let x = tape.constant(Tensor::from_fn(&[n], |i| T::from_f64(value(i))));
    let (expected, size) = ((n / 2) as f64, 1e8 * (n / 2) as f64);
    within("alternating", x.sum().item().to_f64(), expected, by_type::<T>(1e-6, 1e-15) * size);
    // That of f32 is carried in f64, and holds every 1.
    let carried = x.cumsum(0).value().as_slice()[n - 1].to_f64();
    within("cumulative", carried, expected, 1e-15 * size);
    let one = x.segment_sum(&Segments::uniform(1, n)).value().as_slice()[0].to_f64();
    within("segment", one, expected, by_type::<T>(1e-6, 1e-15) * size);
}

/// A sum of rows by index in three ways: the operation, the gradient of gathering, and a sum along an axis.
fn scattered<T: Scalar>(rows: &Tensor<T>, index: &Arc<[u32]>, places: usize) -> [Vec<f64>; 3] {
    let tape = Tape::new();
    let x = tape.leaf(rows.clone());
    let scatter = x.scatter_rows(index, places);
    let table = tape.leaf(Tensor::zeros(&[places, rows.shape()[1]]));
    let gathered = (table.gather_rows(index) * tape.constant(rows.clone())).sum().grad(&[&table]).remove(0);
    let along = table.index_add(0, index, &x);
    [numbers(scatter.value()), numbers(&gathered), numbers(along.value())]
}

/// Matrix: scatter-add all to one entry, 1/2/N threads, shuffled: same bits, error <= 1e-6 sum |x|.
fn many_rows_to_few_places<T: Scalar>() {
    let n = 200_000;
    let mut random = noise(11);
    let alike: Vec<f64> = (0..2 * n).map(|_| round::<T>(0.1)).collect();
    let signed: Vec<f64> = (0..2 * n).map(|_| round::<T>(random() - 0.5)).collect();
    let positive: Vec<f64> = (0..2 * n).map(|_| round::<T>(random())).collect();
    for (name, values) in [("alike", alike), ("signed", signed), ("positive", positive)] {
        for places in [1, 3] {
            let rows = tensor::<T>(&[n, 2], &values);
            let index: Arc<[u32]> = (0..n).map(|i| (i * 7 % places) as u32).collect();
            let (mut expected, mut size) = (vec![0.0; 2 * places], vec![0.0; 2 * places]);
            for (k, value) in values.iter().enumerate() {
                let at = 2 * index[k / 2] as usize + k % 2;
                expected[at] += value;
                size[at] += value.abs();
            }
            let got = scattered(&rows, &index, places);
            for (way, got) in ["scatter_rows", "gather_rows", "index_add"].iter().zip(&got) {
                for at in 0..2 * places {
                    let what = format!("{way}, {name}, {places} places in {}", T::NAME);
                    within(&what, got[at], expected[at], by_type::<T>(1e-6, 1e-12) * size[at]);
                }
            }
            for threads in [1, 2, 5] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                assert_eq!(pool.install(|| scattered(&rows, &index, places)), got, "{threads} threads");
            }
            // Shuffled: the same sum, perhaps with other bits.
            let order = |i: usize| (i * 7919) % n;
            let shuffled = Tensor::from_fn(&[n, 2], |k| rows.as_slice()[2 * order(k / 2) + k % 2]);
            let index: Arc<[u32]> = (0..n).map(|i| index[order(i)]).collect();
            for got in scattered(&shuffled, &index, places) {
                (0..2 * places)
                    .for_each(|at| within("shuffled", got[at], expected[at], by_type::<T>(1e-6, 1e-12) * size[at]));
            }
        }
    }
}

/// As many shares as a tile of a training step has samples, about, all for one row of a table. Such sums have the table's
/// precision.
fn shares_of_one_row_of_a_table<T: Scalar>() {
    let n = 2048;
    let mut random = noise(23);
    for signed in [false, true] {
        let shares: Vec<f64> = (0..n).map(|_| round::<T>(if signed { random() - 0.5 } else { random() })).collect();
        let mut sums = RowSums::<T>::new(10, 1);
        shares.iter().for_each(|&share| sums.add(7, &[T::from_f64(share)]));
        let size: f64 = shares.iter().map(|share| share.abs()).sum();
        within("row sums", sums.sums()[0].to_f64(), shares.iter().sum(), by_type::<T>(1e-6, 1e-14) * size);
    }
}

both!(long_sums, many_rows_to_few_places, shares_of_one_row_of_a_table);
