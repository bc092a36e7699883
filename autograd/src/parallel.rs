//! Work on many images at once, with the same bits at any number of threads.

use rayon::prelude::*;

/// Operations below which waking other threads costs more than it saves: some 50 microseconds of work.
const WORTHWHILE: usize = 1 << 20;

/// Calls `f(scratch, i, chunk i)` for every chunk of `len` elements of `out`: on rayon's threads if the `work` of all
/// together is worth it, each with scratch space of its own.
pub(crate) fn chunks<T: Send, S>(
    out: &mut [T],
    len: usize,
    work: usize,
    scratch: impl Fn() -> S + Send + Sync,
    f: impl Fn(&mut S, usize, &mut [T]) + Send + Sync,
) {
    if out.is_empty() {
        return;
    }
    if work < WORTHWHILE || out.len() <= len || rayon::current_num_threads() == 1 {
        let mut scratch = scratch();
        out.chunks_mut(len).enumerate().for_each(|(i, chunk)| f(&mut scratch, i, chunk));
    } else {
        let each = |scratch: &mut S, (i, chunk): (usize, &mut [T])| f(scratch, i, chunk);
        out.par_chunks_mut(len).enumerate().for_each_init(scratch, each);
    }
}
