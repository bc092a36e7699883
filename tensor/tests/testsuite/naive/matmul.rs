//! Products of matrices: tall, wide, deep and flat, with either factor transposed.

use super::support::{in_both, summed, values, wide};
use raygrad_tensor::Scalar;
use raygrad_tensor::matmul::{Matrix, gemm};

fn transposed<T: Scalar>(x: &[T], rows: usize, columns: usize) -> Vec<T> {
    (0..rows * columns).map(|i| x[i % rows * columns + i / rows]).collect()
}

/// The product and the product of sizes.
fn naive(a: &[f64], b: &[f64], [m, k, n]: [usize; 3]) -> Vec<[f64; 2]> {
    let mut out = vec![[0.0; 2]; m * n];
    for i in 0..m {
        for l in 0..k {
            let a = a[i * k + l];
            for (out, b) in out[i * n..][..n].iter_mut().zip(&b[l * n..][..n]) {
                *out = [out[0] + a * b, out[1] + (a * b).abs()];
            }
        }
    }
    out
}

fn products<T: Scalar>() {
    let sizes = [
        // Nothing, single numbers, inner and outer products.
        [0, 3, 2],
        [3, 0, 2],
        [3, 2, 0],
        [1, 1, 1],
        [1, 4097, 1],
        [129, 1, 257],
        // A matrix times a vector and the other way, long and short.
        [1, 70, 1025],
        [1025, 70, 1],
        [4097, 33, 1],
        [2, 4099, 3],
        [3, 5, 4097],
        [4097, 5, 3],
        [33, 1023, 2],
        // Around registers, small products of other kernels, and blocks.
        [7, 8, 9],
        [15, 16, 17],
        [31, 33, 32],
        [48, 64, 49],
        [63, 64, 65],
        [64, 64, 64],
        [65, 66, 67],
        [255, 256, 257],
        // Deep, and pieces for all threads: 256 rows and more.
        [9, 16_385, 11],
        [255, 1031, 37],
        [256, 1031, 37],
        [300, 517, 64],
        [517, 130, 131],
        [1031, 96, 95],
        [4109, 48, 48],
    ];
    for [m, k, n] in sizes {
        let (a, b) = (values::<T>(m * k, 1), values::<T>(k * n, 2));
        let exact = naive(&wide(&a), &wide(&b), [m, k, n]);
        let (a_t, b_t) = (transposed(&a, m, k), transposed(&b, k, n));
        // Sums run in the order of the product's kernel: one after another at worst, in as many chains as it has lanes.
        let units = 4.0 + (k as f64).sqrt();
        for (turned, left, right) in [
            ("a b", Matrix::new(&a, m, k), Matrix::new(&b, k, n)),
            ("a' b", Matrix::new(&a_t, k, m).t(), Matrix::new(&b, k, n)),
            ("a b'", Matrix::new(&a, m, k), Matrix::new(&b_t, n, k).t()),
            ("a' b'", Matrix::new(&a_t, k, m).t(), Matrix::new(&b_t, n, k).t()),
        ] {
            let what = format!("{turned} of {m}x{k}x{n}");
            let mut c = vec![T::from_f64(f64::NAN); m * n];
            gemm(left, right, &mut c, false);
            summed(&what, &c, units, exact.iter().copied());
            let mut c = values::<T>(m * n, 3);
            let before = wide(&c);
            gemm(left, right, &mut c, true);
            let more = exact.iter().zip(&before).map(|([sum, size], c)| [sum + c, size + c.abs()]);
            summed(&format!("c + {what}"), &c, units, more);
        }
    }
}

#[test]
fn products_of_matrices() {
    in_both!(products);
}
