//! Elementwise loops with several results in one pass: a formula's value, or the gradients of all its operands.

use crate::layout::{inverse, len_of};
use crate::parallel::{ELEMENT, PIECE, each_of, is_worthwhile};
use crate::{Lane, Layout, Pool, Scalar, Shape, Tensor, broadcast_shape, simd};
use smallvec::SmallVec;
use std::array::from_fn;
use std::ops::Range;
use std::slice;

/// The computation for a block of elements: from slices of the operands to slices of the results, all of one length.
pub type Block<'a, T> = dyn Fn(&[&[T]], &mut [&mut [T]]) + Sync + 'a;

/// Elements of a block. Some arrays of this length fit a core's first or second cache, and the overhead of a block is
/// negligible.
pub(crate) const BLOCK: usize = 4096;

/// `M` results of one pass over tensors that broadcast together, each of the common shape. Results that are not
/// `wanted` are computed too, by the same loop, but take no memory.
///
/// Views are read without a copy. Axes that all operands broadcast are computed once, and the results broadcast them.
/// If no operand is in row-major order, the results have the order of an operand.
///
/// `block` is usually [`lanes_fused`]; only it is compiled for each formula.
///
/// # Panics
/// If `x` is empty, or the shapes do not broadcast.
#[track_caller]
#[inline(never)]
pub fn map_fused<T: Scalar, const M: usize>(
    x: &[&Tensor<T>],
    wanted: [bool; M],
    pool: &Pool<T>,
    block: &Block<'_, T>,
) -> [Option<Tensor<T>>; M] {
    let shape = x[0].shape();
    if x.iter().all(|x| x.shape() == shape && x.is_packed()) {
        let x: SmallVec<[&[T]; 6]> = x.iter().map(|x| x.as_slice()).collect();
        if let [_] = x[0] {
            let mut values = [T::ZERO; M];
            block(&x, &mut values.each_mut().map(slice::from_mut));
            return from_fn(|k| wanted[k].then(|| Tensor::one(Shape::from_slice(shape), values[k])));
        }
        let x: SmallVec<[Part<'_, T>; 6]> = x.into_iter().map(Part::Packed).collect();
        return map_parts(&x, shape, wanted, pool, block);
    }
    let shapes: SmallVec<[&[usize]; 6]> = x.iter().map(|x| x.shape()).collect();
    let Some(shape) = broadcast_shape(&shapes) else { panic!("shapes {shapes:?} do not broadcast") };
    map_views(x, &shape, wanted, pool, block)
}

/// [`map_fused`] for any strides.
fn map_views<T: Scalar, const M: usize>(
    x: &[&Tensor<T>],
    shape: &[usize],
    wanted: [bool; M],
    pool: &Pool<T>,
    block: &Block<'_, T>,
) -> [Option<Tensor<T>>; M] {
    let layouts: SmallVec<[Layout; 6]> = x.iter().map(|x| x.layout().stretched(shape)).collect();
    // The same for other views of the operands.
    let of = |turn: &dyn Fn(&Layout) -> Layout| {
        let x: SmallVec<[Tensor<T>; 6]> =
            x.iter().zip(&layouts).map(|(x, layout)| x.with_layout(turn(layout))).collect();
        map_fused(&x.iter().collect::<SmallVec<[_; 6]>>(), wanted, pool, block)
    };
    let is_repeated = |&axis: &usize| shape[axis] > 1 && layouts.iter().all(|layout| layout.strides()[axis] == 0);
    let repeated: Shape = (0..shape.len()).filter(is_repeated).collect();
    if !repeated.is_empty() {
        let once = |layout: &Layout| repeated.iter().fold(layout.clone(), |layout, &axis| layout.sliced(axis, 0, 1, 1));
        return of(&once).map(|result| result.map(|result| result.broadcast_to(shape)));
    }
    let is_whole =
        |layout: &&Layout| !layout.strides().iter().zip(shape).any(|(&stride, &extent)| stride == 0 && extent > 1);
    if !layouts.iter().any(Layout::is_packed)
        && let Some(order) = layouts.iter().filter(is_whole).find_map(Layout::memory_order)
    {
        let turned = of(&|layout| layout.permuted(&order));
        let back = |result: Tensor<T>| result.with_layout(result.layout().permuted(&inverse(&order)));
        return turned.map(|result| result.map(back));
    }
    let parts: SmallVec<[Part<'_, T>; 6]> =
        x.iter().zip(&layouts).map(|(x, layout)| Part::of(x.buffer(), layout)).collect();
    map_parts(&parts, shape, wanted, pool, block)
}

/// An operand of a loop over a common shape.
pub(crate) enum Part<'a, T: Scalar> {
    /// Its elements are in row-major order.
    Packed(&'a [T]),
    /// One number.
    One(T),
    /// Its elements have to be copied into row-major order.
    Strided(&'a [T], &'a Layout),
}

impl<'a, T: Scalar> Part<'a, T> {
    pub(crate) fn of(buffer: &'a [T], layout: &'a Layout) -> Self {
        match buffer {
            &[one] => Part::One(one),
            _ if layout.is_packed() => Part::Packed(&buffer[layout.offset()..]),
            _ => Part::Strided(buffer, layout),
        }
    }

    /// Scratch space for `width` elements if they are not in order. The caller returns it to the pool.
    pub(crate) fn scratch(&self, width: usize, pool: &Pool<T>) -> Vec<T> {
        match *self {
            Part::Packed(_) => vec![],
            Part::One(value) => {
                let mut values = pool.take(width);
                values.fill(value);
                values
            }
            Part::Strided(..) => pool.take(width),
        }
    }

    /// The `n` elements from `start` on.
    pub(crate) fn cut<'s>(&'s self, start: usize, n: usize, scratch: &'s mut [T]) -> &'s [T] {
        match self {
            Part::Packed(x) => &x[start..][..n],
            Part::One(_) => &scratch[..n],
            Part::Strided(buffer, layout) => {
                layout.read_range(buffer, start, &mut scratch[..n]);
                &scratch[..n]
            }
        }
    }
}

/// [`map_fused`] for operands of one shape.
fn map_parts<T: Scalar, const M: usize>(
    x: &[Part<'_, T>],
    shape: &[usize],
    wanted: [bool; M],
    pool: &Pool<T>,
    block: &Block<'_, T>,
) -> [Option<Tensor<T>>; M] {
    let len = len_of(shape);
    let mut results = wanted.map(|wanted| wanted.then(|| pool.buffer(len)));
    run(x, len, &mut results.each_mut().map(|result| result.as_deref_mut()), pool, block);
    results.map(|result| result.map(|values| pool.wrap(shape, values)))
}

/// The slices of the results; `None` for results that are not wanted.
type Results<'a, T> = [Option<&'a mut [T]>];

/// Runs all blocks, on all threads if that is worth it.
fn run<T: Scalar>(x: &[Part<'_, T>], len: usize, out: &mut Results<'_, T>, pool: &Pool<T>, block: &Block<'_, T>) {
    if len <= PIECE || !is_worthwhile(len * ELEMENT * out.len()) {
        return piece(x, 0..len, out, pool, block);
    }
    let mut rest: SmallVec<[Option<&mut [T]>; 4]> = out.iter_mut().map(|out| out.as_deref_mut()).collect();
    let pieces = (0..len).step_by(PIECE).map(|start| {
        let n = PIECE.min(len - start);
        let out = rest.iter_mut().map(|rest| rest.as_mut().and_then(|rest| rest.split_off_mut(..n)));
        (start..start + n, out.collect::<SmallVec<[_; 4]>>())
    });
    each_of(pieces, |_, (range, mut out)| piece(x, range, &mut out, pool, block));
}

/// Runs the blocks of one thread: `out` is for the elements in `range`.
fn piece<T: Scalar>(
    x: &[Part<'_, T>],
    range: Range<usize>,
    out: &mut Results<'_, T>,
    pool: &Pool<T>,
    block: &Block<'_, T>,
) {
    let (start, len) = (range.start, range.len());
    let width = len.min(BLOCK);
    let spare = out.iter().filter(|out| out.is_none()).count();
    let mut unwanted: SmallVec<[T; 16]> = SmallVec::from_elem(T::ZERO, spare * width);
    let mut scratch: SmallVec<[Vec<T>; 6]> = x.iter().map(|x| x.scratch(width, pool)).collect();
    for first in (0..len).step_by(BLOCK) {
        let n = BLOCK.min(len - first);
        let x: SmallVec<[&[T]; 6]> =
            x.iter().zip(&mut scratch).map(|(x, scratch)| x.cut(start + first, n, scratch)).collect();
        let mut spare = unwanted.chunks_mut(width.max(1));
        let mut blocks: SmallVec<[&mut [T]; 4]> = SmallVec::new();
        for out in out.iter_mut() {
            match out {
                Some(out) => blocks.push(&mut out[first..][..n]),
                None => blocks.extend(spare.next().map(|spare| &mut spare[..n])),
            }
        }
        block(&x, &mut blocks);
    }
    scratch.into_iter().filter(|scratch| scratch.capacity() > 0).for_each(|scratch| pool.give(scratch));
}

/// Elements of which [`lanes_fused`] buffers several results before it writes them. Writing to slices that might
/// overlap would prevent vectorisation.
const HELD: usize = 128;

/// `out[k][i] = f([x[0][i], .., x[K - 1][i]], [x[K][i], .., x[K + N - 1][i]])[k]` with the processor's best instruction
/// set.
///
/// Returns whether numbers of mode [`QUICK`](crate::QUICK) were too small or too large; the results are then invalid (see
/// [`Lane`]).
///
/// # Panics
/// If there are not `K + N` operands and `M` results, or their lengths differ.
pub fn lanes_fused<T: Scalar, const MODE: u8, const K: usize, const N: usize, const M: usize>(
    x: &[&[T]],
    out: &mut [&mut [T]],
    f: impl Fn([Lane<T, MODE>; K], [Lane<T, MODE>; N]) -> [Lane<T, MODE>; M],
) -> bool {
    assert!(x.len() == K + N && out.len() == M, "{} operands and {} results of a formula", x.len(), out.len());
    let n = out.first().map_or(0, |out| out.len());
    if M > 1 && n == 1 {
        // Single numbers do not need the buffer for the results of a stretch.
        let (first, second) = (cut::<T, K>(x, 0, 1), cut::<T, N>(x, K, 1));
        let results = f(gather(&first, 0), gather(&second, 0));
        let mut outside = T::Flags::default();
        for (out, result) in out.iter_mut().zip(results) {
            (out[0], outside) = (result.parts().0, outside | result.parts().1);
        }
        return T::is_set(outside);
    }
    simd::dispatch(
        #[inline(always)]
        || {
            // Cut to one length in here, where the compiler can still drop the bounds checks.
            let (first, second) = (cut::<T, K>(x, 0, n), cut::<T, N>(x, K, n));
            let mut outside = T::Flags::default();
            if M == 1 {
                let out = &mut out[0][..n];
                for i in 0..n {
                    let (value, flags) = f(gather(&first, i), gather(&second, i))[0].parts();
                    out[i] = value;
                    outside = outside | flags;
                }
            } else {
                let (mut held, mut start) = ([[T::ZERO; HELD]; M], 0);
                while start < n {
                    let width = HELD.min(n - start);
                    let first = cut_again(&first, start, width);
                    let second = cut_again(&second, start, width);
                    for i in 0..width {
                        let results = f(gather(&first, i), gather(&second, i));
                        let mut k = 0;
                        while k < M {
                            let (value, flags) = results[k].parts();
                            held[k][i] = value;
                            outside = outside | flags;
                            k += 1;
                        }
                    }
                    let mut k = 0;
                    while k < M {
                        out[k][start..][..width].copy_from_slice(&held[k][..width]);
                        k += 1;
                    }
                    start += width;
                }
            }
            T::is_set(outside)
        },
    )
}

/// `N` of the slices from the one numbered `first` on, each `n` long.
#[inline(always)]
pub(crate) fn cut<'a, T, const N: usize>(x: &[&'a [T]], first: usize, n: usize) -> [&'a [T]; N] {
    let mut slices = [&[][..]; N];
    let mut k = 0;
    while k < N {
        slices[k] = &x[first + k][..n];
        k += 1;
    }
    slices
}

/// The `n` elements of each slice from `start` on.
#[inline(always)]
fn cut_again<'a, T, const N: usize>(x: &[&'a [T]; N], start: usize, n: usize) -> [&'a [T]; N] {
    let mut slices = *x;
    let mut k = 0;
    while k < N {
        slices[k] = &x[k][start..][..n];
        k += 1;
    }
    slices
}

/// Element `i` of each slice.
#[inline(always)]
fn gather<T: Scalar, const N: usize, const MODE: u8>(x: &[&[T]; N], i: usize) -> [Lane<T, MODE>; N] {
    let mut values = [Lane::new(T::ZERO); N];
    let mut k = 0;
    while k < N {
        values[k] = Lane::new(x[k][i]);
        k += 1;
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sum and the product of two operands, and the first operand.
    fn block(x: &[&[f32]], out: &mut [&mut [f32]]) {
        lanes_fused::<f32, { crate::PLAIN }, 1, 1, 3>(x, out, |[a], [b]| [a + b, a * b, a]);
    }

    #[test]
    fn results_of_one_pass_are_put_where_they_belong() {
        // Small, cut into blocks with a rest, and cut into pieces for threads.
        for [rows, columns] in [[1, 3], [9, 1000], [517, 1031]] {
            let a = Tensor::from_fn(&[rows, columns], |i| (i % 1013) as f32);
            let b = Tensor::from_fn(&[columns], |i| (i % 7) as f32);
            let pool = Pool::new();
            let [sum, product, first] = map_fused(&[&a, &b], [true, false, true], &pool, &block);
            assert!(product.is_none());
            let [_, product, _] = map_fused(&[&a, &b], [false, true, false], &pool, &block);
            for (result, f) in
                [(sum, (|a, b| a + b) as fn(f32, f32) -> f32), (product, |a, b| a * b), (first, |a, _| a)]
            {
                let result = result.unwrap();
                assert_eq!(result.shape(), [rows, columns]);
                for (i, &y) in result.as_slice().iter().enumerate() {
                    assert_eq!(y, f(a.as_slice()[i], b.as_slice()[i % columns]), "{i}");
                }
            }
        }
    }

    #[test]
    fn quick_lane_reports_too_large_angles() {
        fn sine<const MODE: u8>(x: f64) -> (bool, f64) {
            let mut y = [0.0];
            let outside = lanes_fused::<f64, MODE, 0, 1, 1>(&[&[x]], &mut [&mut y], |[], [x]| {
                [crate::Real::sin(x) * crate::Real::like(&x, 1.0)]
            });
            (outside, y[0])
        }
        assert_eq!(sine::<{ crate::QUICK }>(2.0), (false, crate::Real::sin(2.0)));
        assert!(sine::<{ crate::QUICK }>(1e30).0);
        assert_eq!(sine::<{ crate::EXACT }>(1e30), (false, crate::Real::sin(1e30)));
    }

    #[test]
    #[should_panic(expected = "do not broadcast")]
    fn shapes_that_disagree_panic() {
        map_fused(&[&Tensor::zeros(&[2]), &Tensor::zeros(&[3])], [true; 3], &Pool::none(), &block);
    }
}
