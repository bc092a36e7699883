//! Parallel loops on rayon's threads, with the same bits for any number of threads. Start with [`each`] and [`chunks`].
//!
//! The sizes alone determine how an operation on a large tensor is split, and so the order of sums. The threads of the
//! caller's rayon pool work on the parts. A caller that already runs in parallel should wrap its operations in
//! [`serial`], since waiting for other threads would delay it.

use rayon::prelude::*;
use std::cell::Cell;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Number of operations below which other threads are not worth their start: some 50 microseconds of work.
const WORTHWHILE: usize = 1 << 20;

/// Operations of a task, if its chunks allow.
const TASK: usize = 1 << 16;

/// Elements of a part of a loop: two or three such arrays of f32 fit a core's second-level cache.
pub const PIECE: usize = 1 << 15;

/// Operations for an element that is read, computed with a few operations and written.
pub(crate) const ELEMENT: usize = 8;

thread_local! {
    static SERIAL: Cell<bool> = const { Cell::new(false) };
}

/// Runs `f` with every operation on this thread alone. For the tasks of a loop that is itself parallel, such as tiles
/// with a tape each.
///
/// A task that holds a lock needs it. A thread that waits for its helpers may start another task meanwhile, which would
/// wait for the lock.
///
/// ```
/// use raygrad_tensor::{Tensor, parallel, sum};
/// use rayon::prelude::*;
/// let parts: Vec<f32> = (0..8).into_par_iter().map(|i| parallel::serial(|| sum(&vec![i as f32; 1 << 20]))).collect();
/// assert_eq!(parts[3], 3.0 * (1 << 20) as f32);
/// ```
pub fn serial<R>(f: impl FnOnce() -> R) -> R {
    struct Restore(bool);
    impl Drop for Restore {
        fn drop(&mut self) {
            SERIAL.set(self.0);
        }
    }
    let _restore = Restore(SERIAL.replace(true));
    f()
}

/// Whether `work` operations are worth several threads, and the caller has not split the work already.
pub(crate) fn is_worthwhile(work: usize) -> bool {
    work >= WORTHWHILE && !SERIAL.get() && rayon::current_num_threads() > 1
}

/// Calls `f(i)` for every `i` below `count`, on all threads of the caller's rayon pool, or within [`serial`] on this
/// thread.
///
/// Operations inside `f` stay on their thread; a single call may use all threads itself. Loops call `f` through a
/// pointer, so that rayon is compiled once and not for each loop.
#[inline(never)]
pub fn each(count: usize, f: &(dyn Fn(usize) + Sync)) {
    match count {
        0 => (),
        1 => f(0),
        _ if SERIAL.get() => (0..count).for_each(f),
        _ => (0..count).into_par_iter().for_each(|i| serial(|| f(i))),
    }
}

/// As [`each`], with one item for each call, such as mutable chunks of a slice: calls `f(i, item i)`.
pub fn each_of<P: Send>(parts: impl IntoIterator<Item = P>, f: impl Fn(usize, P) + Sync) {
    let parts: Vec<Mutex<Option<P>>> = parts.into_iter().map(|part| Mutex::new(Some(part))).collect();
    each(parts.len(), &|i| {
        let part = locked(&parts[i]).take();
        part.into_iter().for_each(|part| f(i, part));
    });
}

/// Calls both, at the same time if another thread is free, or within [`serial`] one after the other on this thread.
///
/// ```
/// assert_eq!(raygrad_tensor::parallel::join(|| 1, || "two"), (1, "two"));
/// ```
pub fn join<A: Send, B: Send>(a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
    if SERIAL.get() { (a(), b()) } else { rayon::join(a, b) }
}

/// As [`each`], and collects the results in order.
///
/// ```
/// assert_eq!(raygrad_tensor::parallel::collect(4, |i| i * i), [0, 1, 4, 9]);
/// ```
pub fn collect<R: Send>(count: usize, f: impl Fn(usize) -> R + Sync) -> Vec<R> {
    let mut results: Vec<Option<R>> = (0..count).map(|_| None).collect();
    each_of(&mut results, |i, result| *result = Some(f(i)));
    results.into_iter().flatten().collect()
}

/// As [`collect`], but calls run at the same time only if the sum of their `costs` is at most `limit`. A call that costs
/// more runs alone.
///
/// ```
/// use raygrad_tensor::parallel::collect_within;
/// let bytes = [400, 700, 300, 2000];
/// // 400; then 700 and 300; then 2000.
/// assert_eq!(collect_within(&bytes, 1000, |i| 10 * i), [0, 10, 20, 30]);
/// ```
pub fn collect_within<R: Send>(costs: &[u64], limit: u64, f: impl Fn(usize) -> R + Sync) -> Vec<R> {
    let mut results = Vec::with_capacity(costs.len());
    while results.len() < costs.len() {
        let start = results.len();
        let mut sum = 0_u64;
        let more = costs[start..].iter().skip(1).take_while(|cost| {
            sum = sum.saturating_add(**cost);
            sum.saturating_add(costs[start]) <= limit
        });
        let count = 1 + more.count();
        results.extend(collect(count, |i| f(start + i)));
    }
    results
}

/// Scratch space for the tasks of [`each`]. As many exist as tasks run at once, and later tasks reuse them.
#[derive(Debug, Default)]
pub struct Scratch<S>(Mutex<Vec<S>>);

impl<S: Default> Scratch<S> {
    /// Calls `f` with scratch space that no other task uses.
    pub fn with<R>(&self, f: impl FnOnce(&mut S) -> R) -> R {
        self.with_new(S::default, f)
    }
}

impl<S> Scratch<S> {
    fn with_new<R>(&self, new: impl FnOnce() -> S, f: impl FnOnce(&mut S) -> R) -> R {
        // Not in one line: the lock is given back before `new` and `f` are called.
        let free = locked(&self.0).pop();
        let mut own = free.unwrap_or_else(new);
        let result = f(&mut own);
        locked(&self.0).push(own);
        result
    }
}

/// Locks a mutex, even if a thread panicked while it held the lock.
pub fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Calls `f(scratch, i, chunk i)` for every chunk of `len` elements of `out`; the last one may be shorter. Each thread
/// has its own scratch space. It uses all threads if `work` is large enough; `work` is the number of processor
/// operations of all chunks.
///
/// # Panics
/// If `len` is 0 and `out` is not empty.
pub fn chunks<T: Send, S: Send>(
    out: &mut [T],
    len: usize,
    work: usize,
    scratch: impl Fn() -> S + Sync,
    f: &(dyn Fn(&mut S, usize, &mut [T]) + Sync),
) {
    if out.is_empty() {
        return;
    }
    if out.len() <= len || !is_worthwhile(work) {
        let mut scratch = scratch();
        out.chunks_mut(len).enumerate().for_each(|(i, chunk)| f(&mut scratch, i, chunk));
    } else {
        // Small chunks share a task, so that it is worth its start.
        let count = out.len().div_ceil(len);
        let many = (TASK / work.div_ceil(count)).clamp(1, count);
        let free = Scratch(Mutex::default());
        each_of(out.chunks_mut(many * len), |task, out| {
            free.with_new(&scratch, |scratch| {
                out.chunks_mut(len).enumerate().for_each(|(k, chunk)| f(scratch, task * many + k, chunk));
            });
        });
    }
}

#[cfg(test)]
mod tests {
    use super::{collect, is_worthwhile, serial};
    use crate::extremum::extremum;
    use crate::matmul::{Matrix, gemm};
    use crate::{Layout, Mask, Pool, Real, Scalar, Tensor, map_real, rows, sum, sum_axes};

    /// Of many magnitudes, so that the order of additions shows.
    fn values<T: Scalar>(shape: &[usize], seed: usize) -> Tensor<T> {
        let value = |i: usize| (i % 1013) as f64 * 0.007 - 3.5;
        let magnitude = |i: usize| 10.0_f64.powi(i as i32 % 17 - 8);
        Tensor::from_fn(shape, |i| T::from_f64(value(i * 7919 + seed) * magnitude(i * 31 + seed)))
    }

    /// Results of all kernels that can be split, on large tensors with extents that do not divide.
    fn everything<T: Scalar>() -> Vec<Vec<T>> {
        let pool = Pool::new();
        let x = values::<T>(&[1031, 517], 1);
        let (row, column) = (values(&[517], 2), values(&[1031, 1], 3));
        let mut out = vec![
            map_real!([&x, &row, &column], &pool, |[x, a, b]| (x * a).sin() + b.tanh()),
            row.broadcast_to(&[1031, 517]),
            column.broadcast_to(&[1, 1031, 517]),
            Tensor::scalar(T::from_f64(2.5)).broadcast_to(&[1031, 517]),
            sum_axes(&x, &[0], &pool),
            sum_axes(&x.reshape(&[517 * 1031 / 11, 11]), &[0], &pool),
            sum_axes(&x, &[1], &pool),
            sum_axes(&x.reshape(&[1031, 11, 47]), &[1], &pool),
            sum_axes(&x.reshape(&[1, 1031, 517]), &[1], &pool),
            Tensor::from_fn(&[20], |i| sum(&x.as_slice()[i..])),
        ];
        let mut sum = x.clone();
        sum += &values(&[1031, 517], 4);
        sum += &row;
        out.push(sum);
        let mask = Mask::new(&[517], (0..517).map(|i| i % 3 == 0).collect::<Vec<_>>());
        out.push(x.where_(&mask, &column));
        out.push(x.where_(&x.lt(T::from_f64(0.25)), &row));
        let mut write = |shape: &[usize], f: &dyn Fn(&mut [T])| {
            let mut y = Tensor::full(shape, T::from_f64(f64::NAN));
            f(y.as_mut_slice());
            out.push(y);
        };
        let (wide, tall) = (x.as_slice(), [1031, 517]);
        write(&tall, &|y| {
            Layout::contiguous(&[517, 1031]).permuted(&[1, 0]).sliced(1, 516, 517, -1).read(wide, y);
        });
        for middle @ [outer, _, inner] in [[1031, 517, 1], [1031, 47, 11], [1, 1031, 517]] {
            write(&[outer * inner], &|y| extremum(wide, middle, true, y));
        }
        write(&tall, &|y| rows::softmax_rows(wide, 517, y, &pool));
        write(&tall, &|y| rows::softmax_rows_grad(wide, wide, wide, 517, y));
        write(&tall, &|y| rows::log_softmax_rows(wide, 517, y, &pool));
        write(&tall, &|y| rows::log_softmax_rows_grad(wide, wide, 517, y, &pool));
        write(&[1031], &|y| rows::logsumexp_rows(wide, 517, y, &pool));
        let classes: Vec<u32> = (0..1031).map(|i| i * 7 % 517).collect();
        write(&[1031], &|y| rows::cross_entropy_rows(wide, 517, &classes, y, &pool));
        write(&tall, &|y| rows::cross_entropy_rows_grad(wide, 517, &classes, column.as_slice(), y, &pool));
        write(&[1031], &|y| rows::variance_rows(wide, 517, T::ONE, false, y));
        write(&tall, &|y| rows::layer_norm_rows(wide, row.as_slice(), row.as_slice(), 1e-5, y));
        write(&[1033, 517], &|y| {
            let (dx, sums) = y.split_at_mut(wide.len());
            let (dgain, dbias) = sums.split_at_mut(517);
            let sums = Some([dgain, dbias]);
            rows::layer_norm_rows_grad(wide, row.as_slice(), wide, 1e-5, dx, sums, &pool);
        });
        for (m, k, n) in
            [(1031, 517, 64), (517, 1031, 64), (96, 1533, 64), (300, 517, 1031), (1024, 8192, 1), (256, 16384, 2)]
                .into_iter()
                // Cut by columns, by depth, by neither.
                .chain([
                    (256, 8192, 64),
                    (700, 9001, 100),
                    (24, 517, 2111),
                    (3, 64, 100_003),
                    (7, 60_001, 11),
                    (64, 9001, 200),
                    (1, 500_001, 1),
                    (2, 9, 70_001),
                ])
        {
            let [a, b] = [values::<T>(&[m, k], 4), values(&[k, n], 5)];
            let [a_t, b_t] = [values::<T>(&[k, m], 4), values(&[n, k], 5)];
            let [a, b, a_t, b_t] = [&a, &b, &a_t, &b_t].map(Matrix::rows_of);
            write(&[m, n], &|y| gemm(a, b, y, false));
            write(&[m, n], &|y| gemm(a_t.t(), b, y, false));
            write(&[m, n], &|y| gemm(a, b_t.t(), y, false));
            write(&[m, n], &|y| {
                y.fill(T::ONE);
                gemm(a, b_t.t(), y, true);
            });
        }
        out.iter().map(|y| y.as_slice().to_vec()).collect()
    }

    #[test]
    fn collect_within_keeps_the_limit() {
        use std::sync::atomic::{AtomicU64, Ordering::SeqCst};
        let costs: Vec<u64> = (0..60).map(|i| [5, 90, 30, 200, 1][i % 5]).collect();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(8).build().unwrap();
        for limit in [0, 100, 130, u64::MAX] {
            let (now, most, alone) = (AtomicU64::new(0), AtomicU64::new(0), AtomicU64::new(0));
            let results = pool.install(|| {
                super::collect_within(&costs, limit, |i| {
                    let sum = now.fetch_add(costs[i], SeqCst) + costs[i];
                    // A call that costs more than the limit runs alone.
                    let which = if costs[i] > limit { &alone } else { &most };
                    which.fetch_max(if costs[i] > limit { sum - costs[i] } else { sum }, SeqCst);
                    std::thread::sleep(std::time::Duration::from_millis(1));
                    now.fetch_sub(costs[i], SeqCst);
                    i
                })
            });
            assert_eq!(results, (0..60).collect::<Vec<_>>());
            let [most, alone] = [most, alone].map(AtomicU64::into_inner);
            assert!(most <= limit && alone == 0, "{limit}: {most} {alone}");
            assert!(limit < 130 || most > 91, "{limit}: calls run at the same time: {most}");
        }
        assert_eq!(super::collect_within(&[], 1, |i| i), Vec::<usize>::new());
    }

    #[test]
    fn pieces_are_put_where_they_belong() {
        let (pool, x) = (Pool::new(), values::<f32>(&[1031, 517], 1));
        let at = |i: usize, j: usize| x.as_slice()[i * 517 + j];
        let mut flipped = vec![0.0; x.len()];
        Layout::contiguous(&[1031, 517]).permuted(&[1, 0]).sliced(0, 516, 517, -1).read(x.as_slice(), &mut flipped);
        let doubled = map_real!([&x], &pool, |[x]| x + x);
        let rows = sum_axes(&x, &[1], &pool);
        let columns = sum_axes(&x.reshape(&[1031, 47, 11]), &[1], &pool);
        let ([row, column], tall) = ([values::<f32>(&[517], 2), values(&[1031, 1], 3)], [1031, 517]);
        let [wide, high] = [&row, &column].map(|part| part.broadcast_to(&tall));
        for i in 0..1031 {
            for j in 0..517 {
                assert_eq!(flipped[(516 - j) * 1031 + i], at(i, j));
                assert_eq!(doubled.as_slice()[i * 517 + j], 2.0 * at(i, j));
                assert_eq!(wide.as_slice()[i * 517 + j], row.as_slice()[j]);
                assert_eq!(high.as_slice()[i * 517 + j], column.as_slice()[i]);
            }
            assert_eq!(rows.as_slice()[i], sum(&x.as_slice()[i * 517..][..517]));
            for j in 0..11 {
                let (mut exact, mut size) = (0.0, 0.0);
                (0..47).map(|k| f64::from(at(i, 11 * k + j))).for_each(|x| (exact, size) = (exact + x, size + x.abs()));
                assert!((f64::from(columns.as_slice()[i * 11 + j]) - exact).abs() <= 1e-6 * size);
            }
        }
    }

    fn check<T: Scalar>() {
        let alone = serial(everything::<T>);
        for threads in [1, 2, 3, 8] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let together = pool.install(everything::<T>);
            assert_eq!(alone.len(), together.len());
            for (i, (a, b)) in alone.iter().zip(&together).enumerate() {
                assert!(a.iter().all(|a| a.is_finite()), "{i}");
                assert!(a == b, "{i} on {threads} threads");
            }
        }
    }

    #[test]
    fn own_pool_helps_unless_caller_is_one_of_many() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let inside =
            pool.install(|| [is_worthwhile(1 << 30), serial(|| is_worthwhile(1 << 30)), is_worthwhile(1 << 30)]);
        assert_eq!(inside, [true, false, true]);
        let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        assert!(!alone.install(|| is_worthwhile(1 << 30)));
    }

    #[test]
    fn serial_keeps_loops_on_their_thread() {
        // Each call waits for a moment, so that idle threads would take part.
        let threads = || {
            collect(64, |_| {
                std::thread::sleep(std::time::Duration::from_millis(1));
                rayon::current_thread_index()
            })
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        let (own, alone, together) = pool.install(|| (rayon::current_thread_index(), serial(threads), threads()));
        assert_eq!(alone, [own; 64]);
        assert!(together.iter().any(|thread| *thread != own));
    }

    #[test]
    fn join_uses_an_idle_thread_unless_it_is_serial() {
        use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};
        use std::time::{Duration, Instant};
        let (came, start) = (AtomicUsize::new(0), Instant::now());
        // Each waits until the other one has begun.
        let meet = || {
            came.fetch_add(1, SeqCst);
            while came.load(SeqCst) < 2 && start.elapsed() < Duration::from_secs(60) {
                std::thread::yield_now();
            }
            start.elapsed() < Duration::from_secs(60)
        };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        assert_eq!(pool.install(|| super::join(meet, meet)), (true, true));
        let thread = || {
            std::thread::sleep(Duration::from_millis(1));
            rayon::current_thread_index()
        };
        let alone: Vec<_> = pool.install(|| serial(|| (0..20).map(|_| super::join(thread, thread)).collect()));
        assert!(alone.iter().all(|(a, b)| a == b), "{alone:?}");
    }

    #[test]
    fn the_bits_do_not_depend_on_the_threads() {
        check::<f32>();
        check::<f64>();
    }
}
