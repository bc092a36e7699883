//! Walks along layouts: reading the elements that a layout names, writing them, and adding to them.

use crate::parallel::{ELEMENT, PIECE, chunks};
use crate::{Layout, Scalar};
use smallvec::SmallVec;
use std::array::from_fn;
use std::ops::Range;

/// Rows and columns of a tile of a transpose: a cache line of f32 each way.
const TILE: usize = 16;

/// Rows and columns of a block of tiles.
const BLOCK: usize = 64;

/// The parts of a range, `len` long but for the last.
fn starts(range: Range<usize>, len: usize) -> impl Iterator<Item = Range<usize>> {
    range.clone().step_by(len).map(move |start| start..range.end.min(start + len))
}

/// `out[i * row_step + j] = source[start + j * step + i]` for a tile of `height x width`.
fn transpose<T: Scalar>(
    source: &[T],
    start: usize,
    step: isize,
    out: &mut [T],
    row_step: usize,
    [height, width]: [usize; 2],
) {
    let line = |j: usize| &source[(start as isize + j as isize * step) as usize..];
    if [height, width] == [TILE; 2] {
        let tile: [[T; TILE]; TILE] = from_fn(|j| from_fn(|i| line(j)[..TILE][i]));
        for i in 0..TILE {
            let row: [T; TILE] = from_fn(|j| tile[j][i]);
            out[i * row_step..][..TILE].copy_from_slice(&row);
        }
        return;
    }
    for j in 0..width {
        for (i, &x) in line(j)[..height].iter().enumerate() {
            out[i * row_step + j] = x;
        }
    }
}

/// A run of a walk: elements at equal steps in the buffer.
struct Run {
    /// Where the first stands in the buffer.
    position: usize,
    stride: isize,
    /// Where the first stands in row-major order, and how many there are.
    start: usize,
    count: usize,
}

impl Run {
    /// Where the elements stand, if they are neighbours in rising order.
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

    /// Copies the elements that the layout names from `source`, in row-major order, to `out`. Large transposes go tile by
    /// tile, so that each cache line is read and written once.
    ///
    /// # Panics
    /// If a slice has another length than the layout says.
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
        chunks(out, at_once * inner, work, || (), &|_, i, out| {
            let part = self.sliced(axis, i * at_once, out.len() / inner, 1);
            match part.rows_in_memory() {
                Some(axis) => part.read_transposed(&part.collapsed(), axis, source, out),
                None => part.read_range(source, 0, out),
            }
        });
    }

    /// For a layout that turns matrices: the collapsed axis along which neighbours lie in memory, which is not the last.
    fn rows_in_memory(&self) -> Option<usize> {
        let axes = self.collapsed();
        let &(columns, step) = axes.last()?;
        let turned = step.unsigned_abs() > 1 && columns >= TILE && !self.is_empty();
        turned.then(|| axes.iter().rposition(|&(extent, stride)| stride == 1 && extent >= TILE)).flatten()
    }

    /// Copies a range of the elements, counted in row-major order, to `out`.
    pub(crate) fn read_range<T: Scalar>(&self, source: &[T], start: usize, out: &mut [T]) {
        self.runs(start..start + out.len(), |run| {
            let out = &mut out[run.start - start..][..run.count];
            match run.neighbours() {
                Some(range) => out.copy_from_slice(&source[range]),
                None if run.stride == 0 => out.fill(source[run.position]),
                None => out.iter_mut().zip(run.positions()).for_each(|(out, position)| *out = source[position]),
            }
        });
    }

    /// As [`read`](Self::read), where neighbours in memory lie along `axis` of the collapsed `axes` and not along the last.
    fn read_transposed<T: Scalar>(&self, axes: &[(usize, isize)], axis: usize, source: &[T], out: &mut [T]) {
        let (rows, (columns, step)) = (axes[axis].0, axes[axes.len() - 1]);
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
            // Blocks of tiles, so that few pages of memory are in use at a time.
            for rows in starts(0..rows, BLOCK) {
                for columns in starts(0..columns, BLOCK) {
                    for row in starts(rows.clone(), TILE) {
                        for column in starts(columns.clone(), TILE) {
                            let start = (from + column.start as isize * step) as usize + row.start;
                            let out = &mut out[row.start * row_step + column.start..];
                            transpose(source, start, step, out, row_step, [row.len(), column.len()]);
                        }
                    }
                }
            }
        }
    }

    /// The inverse of [`read`](Self::read): copies `values` to the elements of `target` that the layout names; the
    /// others stay.
    ///
    /// # Panics
    /// If a slice has another length than the layout says.
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

    /// The adjoint of [`read`](Self::read): adds `values` to the elements of `target` that the layout names. Elements
    /// that it names more than once receive a pairwise-accurate sum only along the innermost axis.
    ///
    /// # Panics
    /// If a slice has another length than the layout says.
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
