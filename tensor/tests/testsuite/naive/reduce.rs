//! Sums of slices, of rows and over any axes.

use super::support::{around, in_both, summed, values, wide};
use raygrad_tensor::{Pool, Scalar, Tensor, sum, sum_axes, sum_rows, sum_to};

/// What `sum` states: `(16 + log2(n / 512))` units of the sum of sizes.
fn units(n: usize) -> f64 {
    16.0 + (n.max(512) as f64 / 512.0).log2()
}

fn slices<T: Scalar>() {
    let sizes = [0, 1, 2].into_iter().chain([32, 512, 1024, 4096, 32_768].into_iter().flat_map(around));
    // Enough for all threads; and pieces by the power of two and one more.
    for n in sizes.chain([270_001, 8 * 32_768, 9 * 32_768 + 1]) {
        let x = values::<T>(n, n);
        let wide = wide(&x);
        let exact = [wide.iter().sum(), wide.iter().map(|x| x.abs()).sum()];
        summed(&format!("the sum of {n}"), &[sum(&x)], units(n), [exact]);
    }
}

#[test]
fn sums_of_slices() {
    in_both!(slices);
}

/// Column sums of `rows` rows of `stride`, with the sums of sizes.
fn columns(x: &[f64], stride: usize) -> Vec<[f64; 2]> {
    let mut out = vec![[0.0; 2]; stride];
    for row in x.chunks_exact(stride) {
        row.iter().zip(&mut out).for_each(|(x, [sum, size])| (*sum, *size) = (*sum + x, *size + x.abs()));
    }
    out
}

fn rows<T: Scalar>() {
    // Strips of 64 and of 512 columns, 16 rows added before pairs are formed, more than a megabyte, enough for threads.
    let few = [1, 2, 15, 16, 17, 33, 53]
        .into_iter()
        .flat_map(|rows| [1, 2, 7].into_iter().chain(around(64)).chain(around(512)).map(move |stride| (rows, stride)));
    let many = [(4097, 1), (9001, 31), (4097, 64), (4099, 65), (1031, 517), (700, 1541), (270_001, 1), (5, 70_001)];
    for (rows, stride) in few.chain(many) {
        let x = values::<T>(rows * stride, rows);
        let mut out = vec![T::from_f64(f64::NAN); stride];
        sum_rows(&x, &mut out);
        summed(&format!("{rows} rows of {stride}"), &out, units(rows), columns(&wide(&x), stride));
    }
}

#[test]
fn sums_of_rows() {
    in_both!(rows);
}

fn axes<T: Scalar>() {
    let pool = Pool::new();
    let shapes: [&[usize]; 9] = [
        &[4097],
        &[65, 67],
        &[33, 1, 130],
        &[3, 1025, 2],
        &[2, 3, 5, 7],
        &[1031, 517],
        &[1, 40_000, 9],
        &[11, 47, 1031],
        &[3, 0, 5],
    ];
    for shape in shapes {
        let x = Tensor::from_vec(shape, values::<T>(shape.iter().product(), 5));
        for mask in 0..1_usize << shape.len() {
            let axes: Vec<usize> = (0..shape.len()).filter(|axis| mask >> axis & 1 == 1).collect();
            let mut to = shape.to_vec();
            axes.iter().for_each(|&axis| to[axis] = 1);
            let mut exact = vec![[0.0; 2]; to.iter().product()];
            for (i, x) in x.as_slice().iter().enumerate() {
                let (mut rest, mut at, mut stride) = (i, 0, 1);
                for axis in (0..shape.len()).rev() {
                    at += if axes.contains(&axis) { 0 } else { rest % shape[axis] * stride };
                    stride *= to[axis];
                    rest /= shape[axis];
                }
                let [sum, size] = exact[at];
                exact[at] = [sum + x.to_f64(), size + x.to_f64().abs()];
            }
            let what = format!("{shape:?} over {axes:?}");
            let y = sum_axes(&x, &axes, &pool);
            assert_eq!(y.shape(), &to[..]);
            // Several axes are summed one after another.
            let units = 2.0 * units(x.len());
            summed(&what, y.as_slice(), units, exact.iter().copied());
            let lead = to.iter().take_while(|&&extent| extent == 1).count();
            let y = sum_to(&x, &to[lead..], &pool);
            assert_eq!(y.shape(), &to[lead..]);
            summed(&what, y.as_slice(), units, exact);
        }
    }
}

#[test]
fn sums_over_any_axes() {
    in_both!(axes);
}
