//! Large loops on all of rayon's threads, with the same bits at any number of them.
//!
//! An operation on a large tensor is cut into pieces that depend on the sizes alone. The pieces are worked on by all
//! threads, unless the caller is one of rayon's threads already: whoever runs there has cut the work further outside,
//! and an operation that waited for others would only delay it.

use crate::Scalar;
use rayon::prelude::*;

/// Operations below which waking other threads costs more than it saves: some 50 microseconds of work.
const WORTHWHILE: usize = 1 << 20;

/// Elements of a piece: what two or three arrays of f32 may have in a core's second cache.
pub(crate) const PIECE: usize = 1 << 15;

/// What an element costs that is read, computed with a few operations and written.
pub(crate) const ELEMENT: usize = 8;

/// Whether `work` operations are worth more threads, and the caller is on none of rayon's.
pub(crate) fn is_worthwhile(work: usize) -> bool {
    work >= WORTHWHILE && rayon::current_thread_index().is_none() && rayon::current_num_threads() > 1
}

/// Calls `f(scratch, i, chunk i)` for every chunk of `len` elements of `out` (the last may be shorter), each thread with
/// scratch space of its own: on all threads if the `work` of all together, in operations of a processor, is worth it.
///
/// # Panics
/// If `len` is 0 and `out` is not empty.
pub fn chunks<T: Send, S>(
    out: &mut [T],
    len: usize,
    work: usize,
    scratch: impl Fn() -> S + Send + Sync,
    f: &(dyn Fn(&mut S, usize, &mut [T]) + Sync),
) {
    if out.is_empty() {
        return;
    }
    if out.len() <= len || !is_worthwhile(work) {
        let mut scratch = scratch();
        out.chunks_mut(len).enumerate().for_each(|(i, chunk)| f(&mut scratch, i, chunk));
    } else {
        let each = |scratch: &mut S, (i, chunk): (usize, &mut [T])| f(scratch, i, chunk);
        out.par_chunks_mut(len).enumerate().for_each_init(scratch, each);
    }
}

/// Calls `f(start, piece)` for pieces of `out` that begin at element `start`, of a whole number of `rows` elements each:
/// on all threads if `work` for each element is worth it.
pub fn pieces<T: Scalar>(out: &mut [T], row: usize, work: usize, f: &(dyn Fn(usize, &mut [T]) + Sync)) {
    if out.len() <= PIECE {
        return f(0, out);
    }
    let len = row * (PIECE / row).max(1);
    let work = work * out.len();
    chunks(out, len, work, || (), &|_, i, piece| f(i * len, piece));
}

#[cfg(test)]
mod tests {
    use crate::matmul::{Matrix, gemm};
    use crate::{Layout, Pool, Real, Tensor, broadcast_to, map_real, rows, sum, sum_axes};

    fn values(shape: &[usize], seed: usize) -> Tensor<f32> {
        Tensor::from_fn(shape, |i| ((i * 7919 + seed) % 1013) as f32 * 0.007 - 3.5)
    }

    /// What every kernel that can be cut makes of tensors that are large enough, with extents that do not divide.
    fn everything() -> Vec<Vec<f32>> {
        let pool = Pool::new();
        let x = values(&[1031, 517], 1);
        let (row, column) = (values(&[517], 2), values(&[1031, 1], 3));
        let mut out = vec![
            map_real!([&x, &row, &column], &pool, |[x, a, b]| (x * a).sin() + b.tanh()),
            broadcast_to(&row, &[1031, 517], &pool),
            broadcast_to(&column, &[1, 1031, 517], &pool),
            broadcast_to(&Tensor::scalar(2.5), &[1031, 517], &pool),
            sum_axes(&x, &[0], &pool),
            sum_axes(&x, &[1], &pool),
            sum_axes(&x.reshape(&[1031, 11, 47]), &[1], &pool),
            sum_axes(&x.reshape(&[1, 1031, 517]), &[1], &pool),
            Tensor::scalar(sum(x.as_slice())),
        ];
        let mut write = |shape: &[usize], f: &dyn Fn(&mut [f32])| {
            let mut y = Tensor::full(shape, f32::NAN);
            f(y.as_mut_slice());
            out.push(y);
        };
        let (wide, tall) = (x.as_slice(), [1031, 517]);
        write(&tall, &|y| {
            Layout::contiguous(&[517, 1031]).permuted(&[1, 0]).sliced(1, 516, 517, -1).read(wide, y);
        });
        write(&tall, &|y| rows::softmax_rows(wide, 517, y, &pool));
        write(&tall, &|y| rows::softmax_rows_grad(wide, wide, 517, y));
        write(&tall, &|y| rows::log_softmax_rows(wide, 517, y, &pool));
        write(&tall, &|y| rows::log_softmax_rows_grad(wide, wide, 517, y));
        write(&[1031], &|y| rows::logsumexp_rows(wide, 517, y, &pool));
        let classes: Vec<u32> = (0..1031).map(|i| i * 7 % 517).collect();
        write(&[1031], &|y| rows::cross_entropy_rows(wide, 517, &classes, y, &pool));
        write(&tall, &|y| rows::cross_entropy_rows_grad(wide, 517, &classes, column.as_slice(), y, &pool));
        write(&[1031], &|y| rows::variance_rows(wide, 517, y));
        write(&tall, &|y| rows::layer_norm_rows(wide, row.as_slice(), row.as_slice(), 1e-5, y));
        write(&[1033, 517], &|y| {
            let (dx, sums) = y.split_at_mut(wide.len());
            let (dgain, dbias) = sums.split_at_mut(517);
            let sums = Some([dgain, dbias]);
            rows::layer_norm_rows_grad(wide, row.as_slice(), wide, 1e-5, dx, sums, &pool);
        });
        for (m, k, n) in [(1031, 517, 64), (517, 1031, 64), (261, 1533, 17), (300, 517, 1031)] {
            let [a, b] = [values(&[m, k], 4), values(&[k, n], 5)];
            let [a_t, b_t] = [values(&[k, m], 4), values(&[n, k], 5)];
            let [a, b, a_t, b_t] = [&a, &b, &a_t, &b_t].map(Matrix::rows_of);
            write(&[m, n], &|y| gemm(a, b, y, false));
            write(&[m, n], &|y| gemm(a_t.t(), b, y, false));
            write(&[m, n], &|y| {
                y.fill(1.0);
                gemm(a, b_t.t(), y, true);
            });
        }
        out.iter().map(|y| y.as_slice().to_vec()).collect()
    }

    #[test]
    fn the_bits_do_not_depend_on_the_threads() {
        // On one of rayon's threads nothing is cut.
        let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(everything);
        let together = everything();
        assert_eq!(alone.len(), together.len());
        for (i, (a, b)) in alone.iter().zip(&together).enumerate() {
            assert!(a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits()), "{i}");
            assert!(a.iter().all(|a| a.is_finite()), "{i}");
        }
    }
}
