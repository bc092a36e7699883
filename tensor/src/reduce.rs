//! Pairwise sums, whose error grows with the logarithm of the length.

use crate::layout::inverse;
use crate::parallel::{ELEMENT, PIECE, chunks, is_worthwhile};
use crate::scale::powers;
use crate::{Pool, Scalar, Shape, Tensor, map, simd};

/// Independent partial sums: fills two 512-bit registers of f32 and hides the latency of addition.
const LANES: usize = 32;
/// Rows that are added one after another before pairs are formed.
const BLOCK: usize = 16;
/// Columns that are summed together: four 512-bit registers of f32.
const STRIP: usize = 64;
/// The same for a matrix that does not fit a core's cache: memory favours longer runs, and registers do not matter.
const WIDE_STRIP: usize = 512;
/// Operations for an element that is only read.
const READ: usize = ELEMENT / 2;
/// Bytes from which a matrix does not fit the cache.
const CACHE: usize = 1 << 20;

/// The sum of a slice.
///
/// The sum is pairwise: the error is at most about `(16 + log2(n / 512)) * epsilon * sum(abs(x))`. The order of
/// additions depends on the length alone.
///
/// ```
/// let x = vec![1e-4_f32; 1 << 24];
/// let sum = raygrad_tensor::sum(&x);
/// assert!((sum / 1677.7216 - 1.0).abs() < 1e-6); // a plain loop is 14 % off
/// ```
#[inline(never)]
pub fn sum<T: Scalar>(x: &[T]) -> T {
    if x.len() <= LANES * BLOCK {
        return simd::dispatch(
            #[inline(always)]
            || chunk(x),
        );
    }
    if x.len() <= PIECE {
        return folded(pairwise(x));
    }
    let mut parts = vec![[T::ZERO; LANES]; x.len().div_ceil(PIECE)];
    chunks(&mut parts, 1, READ * x.len(), || (), &|_, i, part| {
        part[0] = pairwise(&x[i * PIECE..][..PIECE.min(x.len() - i * PIECE)]);
    });
    let mut pairs = Pairs::<T, LANES, 40>::new();
    parts.into_iter().for_each(|part| pairs.push(part));
    folded(pairs.finish())
}

/// The sums of the elements of a part in each lane.
fn pairwise<T: Scalar>(x: &[T]) -> [T; LANES] {
    const DEPTH: usize = (PIECE / (LANES * BLOCK)).ilog2() as usize + 1;
    simd::dispatch(
        #[inline(always)]
        || {
            let mut pairs = Pairs::<T, LANES, DEPTH>::new();
            for block in x.chunks(LANES * BLOCK) {
                pairs.push(lanes(block));
            }
            pairs.finish()
        },
    )
}

/// A pairwise sum of a stream of terms: pairs of terms, pairs of pairs, and so on.
pub(crate) struct Pairs<T, const WIDTH: usize, const DEPTH: usize> {
    /// Sums of runs of terms, as many as `count` has 1 bits, the longest first. `count` is below 2^DEPTH.
    open: [[T; WIDTH]; DEPTH],
    count: u64,
}

impl<T: Scalar, const WIDTH: usize, const DEPTH: usize> Pairs<T, WIDTH, DEPTH> {
    #[inline(always)]
    pub fn new() -> Self {
        Pairs { open: [[T::ZERO; WIDTH]; DEPTH], count: 0 }
    }

    #[inline(always)]
    pub fn push(&mut self, mut term: [T; WIDTH]) {
        let mut top = self.count.count_ones() as usize;
        for _ in 0..self.count.trailing_ones() {
            top -= 1;
            for i in 0..WIDTH {
                term[i] += self.open[top][i];
            }
        }
        self.open[top] = term;
        self.count += 1;
    }

    #[inline(always)]
    pub fn finish(self) -> [T; WIDTH] {
        let runs = self.count.count_ones() as usize;
        let mut total = self.open[runs.saturating_sub(1)];
        for run in self.open[..runs.saturating_sub(1)].iter().rev() {
            for i in 0..WIDTH {
                total[i] += run[i];
            }
        }
        total
    }
}

/// The sums of every `LANES`-th element.
#[inline(always)]
fn lanes<T: Scalar>(x: &[T]) -> [T; LANES] {
    let mut lanes = [T::ZERO; LANES];
    let mut rows = x.chunks_exact(LANES);
    for row in &mut rows {
        for i in 0..LANES {
            lanes[i] += row[i];
        }
    }
    for (lane, &value) in lanes.iter_mut().zip(rows.remainder()) {
        *lane += value;
    }
    lanes
}

/// The sum of all lanes.
#[inline(always)]
fn folded<T: Scalar>(mut lanes: [T; LANES]) -> T {
    let mut width = LANES / 2;
    while width > 0 {
        for i in 0..width {
            lanes[i] += lanes[i + width];
        }
        width /= 2;
    }
    lanes[0]
}

/// The sum of a short slice.
#[inline(always)]
pub(crate) fn chunk<T: Scalar>(x: &[T]) -> T {
    folded(lanes(x))
}

/// `out[j] = sum over i of x[i * out.len() + j]`: the sum of the rows of a matrix, pairwise over the rows.
///
/// # Panics
/// If `x` is not a whole number of rows.
pub fn sum_rows<T: Scalar>(x: &[T], out: &mut [T]) {
    if out.is_empty() {
        return;
    }
    assert_eq!(x.len() % out.len(), 0, "{} values are no whole rows of {}", x.len(), out.len());
    if size_of_val(x) < CACHE {
        sum_strips::<T, STRIP>(x, out);
    } else {
        sum_strips::<T, WIDE_STRIP>(x, out);
    }
}

fn sum_strips<T: Scalar, const STRIP: usize>(x: &[T], out: &mut [T]) {
    let (stride, work) = (out.len(), READ * x.len());
    // One of the two is cut: a wide matrix by strips, a narrow one by rows.
    let threads = if stride <= STRIP && is_worthwhile(work) { rayon::current_num_threads() } else { 1 };
    chunks(out, STRIP, work, || (), &|_, strip, out| {
        let sums = pairwise_rows::<T, STRIP>(x, stride, strip * STRIP, out.len(), threads);
        out.copy_from_slice(&sums[..out.len()]);
    });
}

/// The sums of columns `first..first + width` of the rows of length `stride`; `width` is at most `STRIP`.
fn pairwise_rows<T: Scalar, const STRIP: usize>(
    x: &[T],
    stride: usize,
    first: usize,
    width: usize,
    threads: usize,
) -> [T; STRIP] {
    let rows = x.len() / stride;
    if rows > BLOCK {
        let half = (rows / 2).next_multiple_of(BLOCK) * stride;
        let part = |x: &[T]| pairwise_rows::<T, STRIP>(x, stride, first, width, threads / 2);
        let (mut sums, rest) = if threads > 1 {
            rayon::join(|| part(&x[..half]), || part(&x[half..]))
        } else {
            (part(&x[..half]), part(&x[half..]))
        };
        sums.iter_mut().zip(rest).for_each(|(sum, rest)| *sum += rest);
        return sums;
    }
    simd::dispatch(
        #[inline(always)]
        || {
            let mut sums = [T::ZERO; STRIP];
            for row in x.chunks_exact(stride) {
                for (sum, &x) in sums.iter_mut().zip(&row[first..first + width]) {
                    *sum += x;
                }
            }
            sums
        },
    )
}

/// The sum over `axes`, which stay with extent 1.
///
/// # Panics
/// If an axis does not exist.
#[track_caller]
pub fn sum_axes<T: Scalar>(x: &Tensor<T>, axes: &[usize], pool: &Pool<T>) -> Tensor<T> {
    let mut shape = Shape::from_slice(x.shape());
    for &axis in axes {
        assert!(axis < shape.len(), "axis {axis} of a tensor of shape {shape:?}");
        shape[axis] = 1;
    }
    sum_to(x, &shape, pool)
}

/// Sums over the axes along which `shape` broadcasts to the shape of `x`: the adjoint of [`Tensor::broadcast_to`]. A
/// permuted or broadcast view is summed without a copy; of other views, such as slices, the copy is dropped. Along
/// broadcast axes the sum is a product, and permuted axes take no extra time.
///
/// # Panics
/// If `shape` does not broadcast to the shape of `x`.
#[track_caller]
pub fn sum_to<T: Scalar>(x: &Tensor<T>, shape: &[usize], pool: &Pool<T>) -> Tensor<T> {
    let fits = |lead: &usize| shape.iter().zip(&x.shape()[*lead..]).all(|(&to, &from)| to == from || to == 1);
    let Some(lead) = x.ndim().checked_sub(shape.len()).filter(fits) else {
        panic!("cannot sum {:?} to {shape:?}", x.shape())
    };
    let kept: Shape = std::iter::repeat_n(1, lead).chain(shape.iter().copied()).collect();
    let sum = sum_kept(x, &kept, pool).reshape(shape);
    if sum.len() == x.len() || sum.is_finite() { sum } else { far_sum(x, sum, &kept, pool) }
}

/// `sum`, and the sums of smaller numbers where it is not finite: partial sums may be out of range where the whole is not.
#[cold]
#[inline(never)]
fn far_sum<T: Scalar>(x: &Tensor<T>, sum: Tensor<T>, kept: &[usize], pool: &Pool<T>) -> Tensor<T> {
    // Half the reciprocal of the count, rounded down to a power of two: no sum of such products overflows.
    let [down, up] = powers(T::from_f64(2.0 * x.len() as f64 / sum.len().max(1) as f64));
    let small = map(
        [x],
        pool,
        #[inline(always)]
        |[x]| x * down,
    );
    let small = sum_kept(&small, kept, pool).reshape(sum.shape());
    // Other sums have their digits, which small elements lose.
    map(
        [&sum, &small],
        pool,
        #[inline(always)]
        |[sum, small]| if sum.is_finite() { sum } else { small * up },
    )
}

/// The mean over the axes along which `shape` broadcasts to the shape of `x`; NaN for no elements. It overflows only if
/// the mean itself is too large.
///
/// # Panics
/// If `shape` does not broadcast to the shape of `x`.
#[track_caller]
pub fn mean_to<T: Scalar>(x: &Tensor<T>, shape: &[usize], pool: &Pool<T>) -> Tensor<T> {
    let mean_of = |x: &Tensor<T>, divisor: T| {
        map(
            [&sum_to(x, shape, pool)],
            pool,
            #[inline(always)]
            |[sum]| sum / divisor,
        )
    };
    let count = x.len() as f64 / shape.iter().product::<usize>() as f64;
    let mean = mean_of(x, T::from_f64(count));
    if mean.is_finite() || count.is_nan() {
        return mean;
    }
    // Half the reciprocal of the count, rounded down to a power of two: exact, and no sum of such products overflows.
    let [down, _] = powers(T::from_f64(2.0 * count));
    let small = map(
        [x],
        pool,
        #[inline(always)]
        |[x]| x * down,
    );
    let small = mean_of(&small, T::from_f64(count) * down);
    // Other means have their digits, which small elements lose.
    map(
        [&mean, &small],
        pool,
        #[inline(always)]
        |[mean, small]| if mean.is_finite() { mean } else { small },
    )
}

/// The sum over the axes whose extent is 1 in `kept`.
#[inline(never)]
fn sum_kept<T: Scalar>(x: &Tensor<T>, kept: &[usize], pool: &Pool<T>) -> Tensor<T> {
    if x.is_packed() {
        return sum_packed(x, kept, pool);
    }
    let layout = x.layout();
    let is_repeated = |&axis: &usize| layout.strides()[axis] == 0 && x.shape()[axis] > 1;
    let repeated: Shape = (0..x.ndim()).filter(is_repeated).collect();
    if !repeated.is_empty() {
        let once = repeated.iter().fold(layout.clone(), |layout, &axis| layout.sliced(axis, 0, 1, 1));
        let times: usize = repeated.iter().filter(|&&axis| kept[axis] == 1).map(|&axis| x.shape()[axis]).product();
        let mut inner = Shape::from_slice(kept);
        repeated.iter().for_each(|&axis| inner[axis] = 1);
        let sum = sum_kept(&x.with_layout(once), &inner, pool);
        let times = T::from_f64(times as f64);
        return map([&sum], pool, |[sum]| sum * times).broadcast_to(kept);
    }
    // Another view, whose packed copy is dropped with it.
    let Some(order) = layout.memory_order() else { return sum_packed(&x.with_layout(layout), kept, pool) };
    let turned: Shape = order.iter().map(|&axis| kept[axis]).collect();
    let sum = sum_packed(&x.with_layout(layout.permuted(&order)), &turned, pool);
    sum.with_layout(sum.layout().permuted(&inverse(&order)))
}

fn sum_packed<T: Scalar>(x: &Tensor<T>, kept: &[usize], pool: &Pool<T>) -> Tensor<T> {
    let mut current = x.clone();
    let mut axis = x.ndim();
    while axis > 0 {
        let end = axis;
        // A run of neighbouring axes that are all summed is one axis to the kernel.
        while axis > 0 && kept[axis - 1] == 1 && x.shape()[axis - 1] != 1 {
            axis -= 1;
        }
        if axis < end {
            current = sum_middle(&current, axis, end, pool);
        } else {
            axis -= 1;
        }
    }
    current
}

/// The sum over axes `from..to`, which stay with extent 1.
fn sum_middle<T: Scalar>(x: &Tensor<T>, from: usize, to: usize, pool: &Pool<T>) -> Tensor<T> {
    let mut shape = Shape::from_slice(x.shape());
    let count: usize = shape[from..to].iter().product();
    let inner: usize = shape[to..].iter().product();
    shape[from..to].fill(1);
    let mut out = pool.tensor(&shape);
    if out.is_empty() {
        return out;
    }
    if count == 0 {
        out.as_mut_slice().fill(T::ZERO);
        return out;
    }
    let x = x.as_slice();
    // One of the two cuts: sums are short and many, or few and long.
    let at_once = if inner == 1 { (PIECE / count).max(1) } else { 1 };
    chunks(out.as_mut_slice(), at_once * inner, READ * x.len(), || (), &|_, i, out| {
        let sums = out.chunks_exact_mut(inner).zip(x[i * at_once * inner * count..].chunks_exact(count * inner));
        if inner == 1 {
            sums.for_each(|(out, row)| out[0] = sum(row));
        } else {
            sums.for_each(|(out, rows)| sum_rows(rows, out));
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn cancelling_terms_stay_within_the_bound() {
        let x: Vec<f32> = (0..1 << 20).map(|i| if i % 2 == 0 { 1e8 } else { -1e8 } + 1.0).collect();
        let exact: f64 = x.iter().map(|&x| f64::from(x)).sum();
        let scale: f64 = x.iter().map(|&x| f64::from(x.abs())).sum();
        assert!((f64::from(sum(&x)) - exact).abs() <= 1e-6 * scale);
    }

    proptest! {
        #[test]
        fn sums_over_any_axes_agree_with_a_plain_loop(
            shape in prop::collection::vec(0usize..6, 0..4), mask in 0usize..16, drop_lead: bool
        ) {
            let x = Tensor::<f64>::from_fn(&shape, |i| ((i * 37) % 11) as f64 - 5.0);
            let axes: Vec<usize> = (0..shape.len()).filter(|axis| mask >> axis & 1 == 1).collect();
            let got = sum_axes(&x, &axes, &Pool::new());
            let mut small = shape.clone();
            axes.iter().for_each(|&axis| small[axis] = 1);
            let mut expected = vec![0.0; small.iter().product()];
            crate::Layout::contiguous(&small).stretched(&shape).add(x.as_slice(), &mut expected);
            prop_assert_eq!(got.shape(), &small[..]);
            prop_assert_eq!(got.as_slice(), &expected[..]);
            if drop_lead && small.first() == Some(&1) {
                let less = sum_to(&x, &small[1..], &Pool::new());
                prop_assert_eq!(less.as_slice(), &expected[..]);
            }
        }

        #[test]
        fn long_sums_of_any_length(n in 0usize..5000) {
            let x: Vec<f64> = (0..n).map(|i| (i % 13) as f64).collect();
            prop_assert_eq!(sum(&x), x.iter().sum::<f64>());
            let mut columns = [0.0; 7];
            sum_rows(&x[..n / 7 * 7], &mut columns);
            for j in 0..7 {
                prop_assert_eq!(columns[j], x[..n / 7 * 7].iter().skip(j).step_by(7).sum::<f64>());
            }
        }
    }
}
