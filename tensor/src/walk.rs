//! Reads, writes and adds to the elements of a buffer that a layout selects.

use crate::parallel::{ELEMENT, PIECE, chunks};
use crate::simd::prefetch;
use crate::{Layout, Scalar};
use smallvec::SmallVec;
use std::array::from_fn;
use std::ops::Range;

/// Rows and columns of a tile of a transpose: a cache line of f32 each way.
const TILE: usize = 16;

/// Rows and columns of a block of tiles.
const BLOCK: usize = 64;
const COLUMNS: usize = 32;

/// Least number of elements of a transpose that is written past the caches: no code finds them there again.
const LARGE: usize = 1 << 20;
/// Bytes of a cache line.
const LINE: usize = 64;

/// The parts of a range, each `len` long but for the last.
fn starts(range: Range<usize>, len: usize) -> impl Iterator<Item = Range<usize>> {
    range.clone().step_by(len).map(move |start| start..range.end.min(start + len))
}

/// Copies a row of a tile to memory without reading the cache line that it fills.
///
/// # Panics
/// If `out` is shorter or not aligned to 16 bytes.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
fn stream<T: Scalar>(row: &[T; TILE], out: &mut [T]) {
    use std::arch::x86_64::{__m128i, _mm_loadu_si128, _mm_stream_si128};
    let out = out[..TILE].as_mut_ptr().cast::<__m128i>();
    assert!(out.addr().is_multiple_of(16), "a row that is not aligned");
    for k in 0..size_of::<[T; TILE]>() / 16 {
        // SAFETY: the processor has SSE2, `row` and `out` are as long, `out` is aligned, and a fence follows before the slice
        // that `out` is of is given back ([`Streams`]). Run by `streamed_rows_arrive`.
        unsafe { _mm_stream_si128(out.add(k), _mm_loadu_si128(row.as_ptr().cast::<__m128i>().add(k))) };
    }
}

/// A plain copy, where there is no such instruction.
#[cfg(not(target_arch = "x86_64"))]
fn stream<T: Scalar>(row: &[T; TILE], out: &mut [T]) {
    out[..TILE].copy_from_slice(row);
}

/// Rows may be [`stream`]ed while it exists. When it is dropped, they are written before any later write.
struct Streams;

impl Drop for Streams {
    fn drop(&mut self) {
        // SAFETY: the processor has SSE. Run by `streamed_rows_arrive`.
        #[cfg(target_arch = "x86_64")]
        unsafe {
            std::arch::x86_64::_mm_sfence();
        }
    }
}

/// The transpose of a square, in registers. The compiler alone would load element by element.
#[inline(always)]
fn turn<T: Scalar>(square: [[T; 4]; 4]) -> [[T; 4]; 4] {
    #[cfg(target_arch = "x86_64")]
    if size_of::<T>() == size_of::<f32>() {
        use std::arch::x86_64::{_mm_loadu_ps, _mm_movehl_ps, _mm_movelh_ps, _mm_unpackhi_ps, _mm_unpacklo_ps};
        // SAFETY: the processor has SSE, and a line is as long as what is made of it. Run by `streamed_rows_arrive`.
        return unsafe {
            let [a, b, c, d] = square.each_ref().map(|line| _mm_loadu_ps(line.as_ptr().cast()));
            let (low, high) =
                ([_mm_unpacklo_ps(a, b), _mm_unpacklo_ps(c, d)], [_mm_unpackhi_ps(a, b), _mm_unpackhi_ps(c, d)]);
            let pairs = |[x, y]: [_; 2]| [_mm_movelh_ps(x, y), _mm_movehl_ps(y, x)];
            std::mem::transmute_copy(&[pairs(low), pairs(high)])
        };
    }
    from_fn(|l| square.map(|line| line[l]))
}

/// `out[i * row_step + j] = source[start + j * step + i]` for a tile of `height x width`.
fn transpose<T: Scalar>(
    source: &[T],
    start: usize,
    step: isize,
    out: &mut [T],
    row_step: usize,
    [height, width]: [usize; 2],
    streamed: bool,
) {
    let line = |j: usize| &source[(start as isize + j as isize * step) as usize..];
    if [height, width] == [TILE; 2] {
        // Lines at a step of a power of two would evict each other before they are used up.
        let mut lines = [[T::ZERO; TILE]; TILE];
        for (j, copy) in lines.iter_mut().enumerate() {
            copy.copy_from_slice(&line(j)[..TILE]);
        }
        for i in (0..TILE).step_by(4) {
            let mut rows = [[T::ZERO; TILE]; 4];
            for j in (0..TILE).step_by(4) {
                let square = turn(from_fn(|k| from_fn(|l| lines[j + k][i + l])));
                rows.iter_mut().zip(&square).for_each(|(row, part)| row[j..j + 4].copy_from_slice(part));
            }
            for (l, row) in rows.iter().enumerate() {
                let out = &mut out[(i + l) * row_step..][..TILE];
                if streamed {
                    stream(row, out);
                } else {
                    out.copy_from_slice(row);
                }
            }
        }
        return;
    }
    for j in 0..width {
        for (i, &x) in line(j)[..height].iter().enumerate() {
            out[i * row_step + j] = x;
        }
    }
}

/// A run of a walk: elements at equal distances in the buffer.
struct Run {
    /// The buffer position of the first element.
    position: usize,
    stride: isize,
    /// The row-major position of the first element, and the number of elements.
    start: usize,
    count: usize,
}

impl Run {
    /// The buffer range of the elements, if they are contiguous in rising order.
    #[inline(always)]
    fn neighbours(&self) -> Option<Range<usize>> {
        (self.stride == 1 || self.count == 1).then(|| self.position..self.position + self.count)
    }

    #[inline(always)]
    fn positions(&self) -> impl Iterator<Item = usize> {
        let (position, stride) = (self.position as isize, self.stride);
        (0..self.count as isize).map(move |i| (position + i * stride) as usize)
    }
}

impl Layout {
    /// Calls `f` for the runs along the innermost axis that cover `range`, in row-major order.
    #[inline(always)]
    fn runs(&self, range: Range<usize>, mut f: impl FnMut(Run)) {
        if range.is_empty() {
            return;
        }
        let mut axes = self.collapsed();
        let (count, stride) = axes.pop().unwrap_or((1, 1));
        // The index of the first element, and its place.
        let mut index = SmallVec::<[usize; 4]>::from_elem(0, axes.len());
        let (mut row, mut along) = (range.start / count, range.start % count);
        let mut position = self.offset() as isize;
        for (i, &(extent, stride)) in index.iter_mut().zip(&axes).rev() {
            *i = row % extent;
            row /= extent;
            position += *i as isize * stride;
        }
        let mut start = range.start;
        loop {
            let count = (count - along).min(range.end - start);
            f(Run { position: (position + along as isize * stride) as usize, stride, start, count });
            start += count;
            if start == range.end {
                return;
            }
            along = 0;
            let mut axis = axes.len();
            while axis > 0 {
                axis -= 1;
                index[axis] += 1;
                position += axes[axis].1;
                if index[axis] < axes[axis].0 {
                    break;
                }
                position -= axes[axis].1 * axes[axis].0 as isize;
                index[axis] = 0;
            }
        }
    }

    /// Copies the elements that the layout selects from `source`, in row-major order, to `out`. Large transposes run
    /// tile by tile, so that each cache line is read and written once.
    ///
    /// # Panics
    /// If `source` does not have the length of the buffer, or `out` that of the layout.
    pub fn read<T: Scalar>(&self, source: &[T], out: &mut [T]) {
        assert_eq!(source.len(), self.source(), "source of a layout of {:?}", self.shape());
        assert_eq!(out.len(), self.len(), "output of a layout of {:?}", self.shape());
        let work = ELEMENT * out.len();
        if out.len() <= PIECE || self.rows_in_memory().is_none() {
            return chunks(out, PIECE, work, || (), &|_, i, out| self.read_range(source, i * PIECE, out));
        }
        // Cut along the first axis that can be: at whole blocks, or between matrices.
        let axis = self.shape().iter().position(|&extent| extent > 1).unwrap_or(0);
        let inner: usize = self.shape()[axis + 1..].iter().product();
        let whole = if self.strides()[axis] == 1 { BLOCK } else { 1 };
        let at_once = (PIECE / inner).next_multiple_of(whole).max(whole);
        let large = out.len() >= LARGE;
        chunks(out, at_once * inner, work, || (), &|_, i, out| {
            let part = self.sliced(axis, i * at_once, out.len() / inner, 1);
            match part.rows_in_memory() {
                Some(axis) => part.read_transposed(&part.collapsed(), axis, source, out, large),
                None => part.read_range(source, 0, out),
            }
        });
    }

    /// For a layout that transposes matrices: the collapsed axis along which elements are contiguous in memory, if it
    /// is not the last.
    pub(crate) fn rows_in_memory(&self) -> Option<usize> {
        let axes = self.collapsed();
        let &(columns, step) = axes.last()?;
        let turned = step.unsigned_abs() > 1 && columns >= TILE && !self.is_empty();
        turned.then(|| axes.iter().rposition(|&(extent, stride)| stride == 1 && extent >= TILE)).flatten()
    }

    /// Copies a range of the elements, counted in row-major order, to `out`.
    pub(crate) fn read_range<T: Copy>(&self, source: &[T], start: usize, out: &mut [T]) {
        self.runs(start..start + out.len(), |run| {
            let out = &mut out[run.start - start..][..run.count];
            match run.neighbours() {
                Some(range) => out.copy_from_slice(&source[range]),
                None if run.stride == 0 => out.fill(source[run.position]),
                None => out.iter_mut().zip(run.positions()).for_each(|(out, position)| *out = source[position]),
            }
        });
    }

    /// As [`read`](Self::read), for elements that are contiguous in memory along `axis` of the collapsed `axes`, not
    /// along the last.
    fn read_transposed<T: Scalar>(
        &self,
        axes: &[(usize, isize)],
        axis: usize,
        source: &[T],
        out: &mut [T],
        large: bool,
    ) {
        let _streams = Streams;
        let (height, (width, step)) = (axes[axis].0, axes[axes.len() - 1]);
        // Steps of the output along the axes, and the matrices that the other axes count.
        let row_step: usize = axes[axis + 1..].iter().map(|&(extent, _)| extent).product();
        let others: SmallVec<[usize; 4]> = (0..axes.len() - 1).filter(|&other| other != axis).collect();
        let matrices: usize = others.iter().map(|&other| axes[other].0).product();
        for mut matrix in 0..matrices {
            let (mut from, mut to) = (self.offset() as isize, 0);
            for &other in others.iter().rev() {
                let index = matrix % axes[other].0;
                matrix /= axes[other].0;
                from += index as isize * axes[other].1;
                to += index * axes[other + 1..].iter().map(|&(extent, _)| extent).product::<usize>();
            }
            let out = &mut out[to..];
            // Rows are streamed if all begin at the same place of a cache line: from the first whole line on.
            let streamed = large && (row_step * size_of::<T>()).is_multiple_of(LINE);
            let lead = if streamed { out.as_ptr().align_offset(LINE).min(width) } else { 0 };
            // Blocks of tiles, so that few pages of memory are in use at a time.
            for rows in starts(0..height, BLOCK) {
                for columns in starts(0..lead, COLUMNS).chain(starts(lead..width, COLUMNS)) {
                    if large {
                        // Prefetch the next block while this one is written.
                        for column in columns.end..width.min(columns.end + COLUMNS) {
                            let line = (from + column as isize * step) as usize;
                            rows.clone().step_by(LINE / size_of::<T>()).for_each(|row| prefetch(&source[line + row]));
                        }
                    }
                    for row in starts(rows.clone(), TILE) {
                        for column in starts(columns.clone(), TILE) {
                            let start = (from + column.start as isize * step) as usize + row.start;
                            let out = &mut out[row.start * row_step + column.start..];
                            transpose(source, start, step, out, row_step, [row.len(), column.len()], streamed);
                        }
                    }
                }
            }
        }
    }

    /// Copies `values` to the elements of `target` that the layout selects: the inverse of [`read`](Self::read). Other
    /// elements stay unchanged.
    ///
    /// # Panics
    /// If `target` does not have the length of the buffer, or `values` that of the layout.
    pub fn write<T: Scalar>(&self, values: &[T], target: &mut [T]) {
        assert_eq!(target.len(), self.source(), "target of a layout of {:?}", self.shape());
        assert_eq!(values.len(), self.len(), "values of a layout of {:?}", self.shape());
        self.runs(0..values.len(), |run| {
            let values = &values[run.start..][..run.count];
            match run.neighbours() {
                Some(range) => target[range].copy_from_slice(values),
                None => run.positions().zip(values).for_each(|(position, &value)| target[position] = value),
            }
        });
    }

    /// Adds `values` to the elements of `target` that the layout selects: the adjoint of [`read`](Self::read). For
    /// elements that it selects more than once, the sum is pairwise only along the innermost axis.
    ///
    /// # Panics
    /// If `target` does not have the length of the buffer, or `values` that of the layout.
    pub fn add<T: Scalar>(&self, values: &[T], target: &mut [T]) {
        assert_eq!(target.len(), self.source(), "target of a layout of {:?}", self.shape());
        assert_eq!(values.len(), self.len(), "values of a layout of {:?}", self.shape());
        self.runs(0..values.len(), |run| {
            let values = &values[run.start..][..run.count];
            match run.neighbours() {
                Some(range) => crate::elementwise::add_assign(&mut target[range], values),
                None if run.stride == 0 => target[run.position] += crate::reduce::sum(values),
                None => run.positions().zip(values).for_each(|(position, &value)| target[position] += value),
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Transposes that are streamed: of whole matrices and of parts, to places at any distance from a cache line.
    fn large_transposes<T: Scalar>(per_line: usize) {
        // Rows of the result that all begin at one place of a line, and rows that do not; matrices that are small.
        for (matrices, rows, columns) in [(1, 1440, 1536), (2, 1057, 1072), (1, 1441, 1537), (70, 200, 160)] {
            let source = Vec::from_iter((0..matrices * rows * columns).map(|i| T::from_f64((i % 65_521) as f64)));
            let whole = Layout::contiguous(&[matrices, columns, rows]);
            let part = whole.sliced(2, 3, rows - 20, 1).sliced(1, 5, columns - 16, 1);
            let four = Layout::contiguous(&[2, matrices / 2, columns, rows]).permuted(&[1, 0, 3, 2]);
            let [turned, nested] = if matrices > 2 {
                [whole.permuted(&[2, 1, 0]), four]
            } else {
                [1, 2].map(|_| whole.permuted(&[0, 2, 1]))
            };
            for layout in [
                turned,
                nested,
                whole.sliced(1, columns - 1, columns, -1).permuted(&[0, 2, 1]),
                part.permuted(&[0, 2, 1]),
            ] {
                assert!(layout.len() >= LARGE && layout.rows_in_memory().is_some(), "{layout:?}");
                for lead in [0, 1, per_line - 1] {
                    let mut out = vec![T::from_f64(-1.0); layout.len() + lead];
                    layout.read(&source, &mut out[lead..]);
                    assert!(out[..lead].iter().all(|x| x.to_f64() == -1.0));
                    let mut expected = vec![T::ZERO; layout.len()];
                    layout.read_range(&source, 0, &mut expected);
                    assert!(out[lead..] == expected, "{matrices} of {rows}x{columns}, {lead} places into a line");
                }
            }
        }
    }

    #[test]
    fn streamed_rows_arrive() {
        large_transposes::<f32>(16);
        large_transposes::<f64>(8);
    }
}
