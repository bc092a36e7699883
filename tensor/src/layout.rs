//! Strided layouts: one walk that serves broadcast, permute, slice and flip, and their adjoints.

use crate::parallel::{ELEMENT, PIECE, chunks};
use crate::{Scalar, Shape};
use smallvec::SmallVec;

/// Which element of a buffer stands at each index of a shape: `offset + sum(index[i] * strides[i])`.
///
/// Stride 0 repeats an element (broadcast), a negative stride walks backwards (flip).
#[derive(Debug, Clone, PartialEq)]
pub struct Layout {
    shape: Shape,
    strides: SmallVec<[isize; 4]>,
    offset: isize,
    /// Number of elements of the buffer that the layout points into.
    source: usize,
}

impl Layout {
    /// The row-major layout of a whole buffer of this shape.
    pub fn contiguous(shape: &[usize]) -> Self {
        let mut strides = SmallVec::from_elem(1, shape.len());
        for i in (1..shape.len()).rev() {
            strides[i - 1] = strides[i] * shape[i] as isize;
        }
        Layout { shape: Shape::from_slice(shape), strides, offset: 0, source: shape.iter().product() }
    }

    /// The shape that the layout covers.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// A buffer of shape `from` stretched to shape `to`, as NumPy broadcasts.
    ///
    /// # Panics
    /// If `from` does not broadcast to `to`.
    #[track_caller]
    pub fn broadcast(from: &[usize], to: &[usize]) -> Self {
        let inner = Layout::contiguous(from);
        assert!(from.len() <= to.len(), "cannot broadcast {from:?} to {to:?}");
        let lead = to.len() - from.len();
        let mut strides = SmallVec::from_elem(0, to.len());
        for (i, &extent) in from.iter().enumerate() {
            assert!(extent == to[lead + i] || extent == 1, "cannot broadcast {from:?} to {to:?}");
            if extent == to[lead + i] {
                strides[lead + i] = inner.strides[i];
            }
        }
        Layout { shape: Shape::from_slice(to), strides, ..inner }
    }

    /// Axis `i` of the result is axis `axes[i]` of this layout.
    ///
    /// # Panics
    /// If `axes` is not a permutation of the axes.
    #[track_caller]
    pub fn permuted(&self, axes: &[usize]) -> Self {
        let mut seen = SmallVec::<[bool; 8]>::from_elem(false, self.shape.len());
        assert_eq!(axes.len(), self.shape.len(), "{axes:?} does not name every axis of {:?} once", self.shape);
        for &axis in axes {
            assert!(axis < seen.len() && !seen[axis], "{axes:?} does not name every axis of {:?} once", self.shape);
            seen[axis] = true;
        }
        Layout {
            shape: axes.iter().map(|&axis| self.shape[axis]).collect(),
            strides: axes.iter().map(|&axis| self.strides[axis]).collect(),
            ..*self
        }
    }

    /// `len` elements along `axis`, from `start` on, every `step`-th; a negative step walks backwards.
    ///
    /// # Panics
    /// If an element lies outside the axis.
    #[track_caller]
    pub fn sliced(&self, axis: usize, start: usize, len: usize, step: isize) -> Self {
        let extent = self.shape[axis];
        let last = start as isize + step * (len as isize - 1);
        let inside = |i: isize| (0..extent as isize).contains(&i);
        assert!(
            len == 0 || (inside(start as isize) && inside(last)),
            "slice of {len} from {start} by {step} leaves the extent {extent} of axis {axis}"
        );
        let mut out = self.clone();
        out.shape[axis] = len;
        out.strides[axis] *= step;
        if len > 0 {
            out.offset += start as isize * self.strides[axis];
        }
        out
    }

    /// The diagonal through axes `a` and `b`, which becomes the last axis: the elements whose index along `b` is that
    /// along `a` plus `offset`. It is empty if the offset leaves the matrix.
    ///
    /// # Panics
    /// If an axis does not exist or both are the same.
    #[track_caller]
    pub fn diagonal(&self, a: usize, b: usize, offset: isize) -> Self {
        let ndim = self.shape.len();
        assert!(a < ndim && b < ndim && a != b, "the diagonal through axes {a} and {b} of {:?}", self.shape);
        let (row, column) = (offset.min(0).unsigned_abs(), offset.max(0).unsigned_abs());
        let len = self.shape[a].saturating_sub(row).min(self.shape[b].saturating_sub(column));
        let others = (0..ndim).filter(|&axis| axis != a && axis != b);
        let mut shape: Shape = others.clone().map(|axis| self.shape[axis]).collect();
        let mut strides: SmallVec<[isize; 4]> = others.map(|axis| self.strides[axis]).collect();
        shape.push(len);
        strides.push(self.strides[a] + self.strides[b]);
        let start = if len == 0 { 0 } else { row as isize * self.strides[a] + column as isize * self.strides[b] };
        Layout { shape, strides, offset: self.offset + start, ..*self }
    }

    /// Axes of extent 1 dropped and neighbours that form one run merged: fewer, longer inner loops.
    fn collapsed(&self) -> SmallVec<[(usize, isize); 4]> {
        let mut axes = SmallVec::<[(usize, isize); 4]>::new();
        for (&extent, &stride) in self.shape.iter().zip(&self.strides) {
            match axes.last_mut() {
                _ if extent == 1 => {}
                Some((outer, outer_stride)) if *outer_stride == stride * extent as isize => {
                    *outer *= extent;
                    *outer_stride = stride;
                }
                _ => axes.push((extent, stride)),
            }
        }
        axes
    }

    /// Calls `f(first position in the buffer, stride, first position in row-major order, count)` for every run along
    /// the innermost axis.
    #[inline(always)]
    fn runs(&self, mut f: impl FnMut(usize, isize, usize, usize)) {
        if self.shape.contains(&0) {
            return;
        }
        let mut axes = self.collapsed();
        let (count, stride) = axes.pop().unwrap_or((1, 1));
        let mut index = SmallVec::<[usize; 4]>::from_elem(0, axes.len());
        let (mut position, mut out) = (self.offset, 0);
        loop {
            f(position as usize, stride, out, count);
            out += count;
            let mut axis = axes.len();
            loop {
                if axis == 0 {
                    return;
                }
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

    /// Copies the elements that the layout names from `source`, in row-major order, to `out`.
    ///
    /// # Panics
    /// If a slice has another length than the layout says.
    pub fn read<T: Scalar>(&self, source: &[T], out: &mut [T]) {
        assert_eq!(source.len(), self.source, "source of a layout of {:?}", self.shape);
        assert_eq!(out.len(), self.shape.iter().product::<usize>(), "output of a layout of {:?}", self.shape);
        // Cut along the first axis that can be.
        let axis = self.shape.iter().position(|&extent| extent > 1).unwrap_or(self.shape.len());
        let inner: usize = self.shape.iter().skip(axis + 1).product();
        if out.len() <= PIECE || inner == 0 {
            return self.read_piece(source, out);
        }
        let at_once = (PIECE / inner).max(1);
        let work = ELEMENT * out.len();
        chunks(out, at_once * inner, work, || (), &|_, i, out| {
            self.sliced(axis, i * at_once, out.len() / inner, 1).read_piece(source, out);
        });
    }

    fn read_piece<T: Scalar>(&self, source: &[T], out: &mut [T]) {
        self.runs(|position, stride, start, count| {
            let out = &mut out[start..start + count];
            match stride {
                0 => out.fill(source[position]),
                1 => out.copy_from_slice(&source[position..position + count]),
                _ => {
                    for (i, out) in out.iter_mut().enumerate() {
                        *out = source[(position as isize + i as isize * stride) as usize];
                    }
                }
            }
        });
    }

    /// The inverse of [`read`](Self::read): copies `values` to the elements of `target` that the layout names; the
    /// others stay.
    ///
    /// # Panics
    /// If a slice has another length than the layout says.
    pub fn write<T: Scalar>(&self, values: &[T], target: &mut [T]) {
        assert_eq!(target.len(), self.source, "target of a layout of {:?}", self.shape);
        assert_eq!(values.len(), self.shape.iter().product::<usize>(), "values of a layout of {:?}", self.shape);
        self.runs(|position, stride, start, count| {
            let values = &values[start..start + count];
            if stride == 1 {
                target[position..position + count].copy_from_slice(values);
            } else {
                for (i, &value) in values.iter().enumerate() {
                    target[(position as isize + i as isize * stride) as usize] = value;
                }
            }
        });
    }

    /// The adjoint of [`read`](Self::read): adds `values` to the elements of `target` that the layout names. Elements
    /// that it names more than once receive a pairwise-accurate sum only along the innermost axis.
    ///
    /// # Panics
    /// If a slice has another length than the layout says.
    pub fn add<T: Scalar>(&self, values: &[T], target: &mut [T]) {
        assert_eq!(target.len(), self.source, "target of a layout of {:?}", self.shape);
        assert_eq!(values.len(), self.shape.iter().product::<usize>(), "values of a layout of {:?}", self.shape);
        self.runs(|position, stride, start, count| {
            let values = &values[start..start + count];
            match stride {
                0 => target[position] += crate::reduce::sum(values),
                1 => crate::elementwise::add_assign(&mut target[position..position + count], values),
                _ => {
                    for (i, &value) in values.iter().enumerate() {
                        target[(position as isize + i as isize * stride) as usize] += value;
                    }
                }
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn diagonals_lie_where_numpy_has_them() {
        let x: Vec<f64> = (0..12).map(f64::from).collect();
        for (offset, expected) in
            [(0, vec![0.0, 5.0, 10.0]), (2, vec![2.0, 7.0]), (-1, vec![4.0, 9.0]), (4, vec![]), (-9, vec![])]
        {
            let layout = Layout::contiguous(&[3, 4]).diagonal(0, 1, offset);
            let mut out = vec![f64::NAN; expected.len()];
            layout.read(&x, &mut out);
            assert_eq!(out, expected);
        }
    }

    fn naive(layout: &Layout, source: &[f64]) -> Vec<f64> {
        let total: usize = layout.shape.iter().product();
        let at = |mut i: usize| {
            let mut position = layout.offset;
            for axis in (0..layout.shape.len()).rev() {
                position += (i % layout.shape[axis]) as isize * layout.strides[axis];
                i /= layout.shape[axis];
            }
            source[position as usize]
        };
        (0..total).map(at).collect()
    }

    proptest! {
        #[test]
        fn every_walk_agrees_with_the_definition(
            shape in prop::collection::vec(0usize..5, 0..4), turn in 0usize..4, flip: bool, lead in 0usize..3
        ) {
            let source: Vec<f64> = (0..shape.iter().product()).map(|i| i as f64).collect();
            let mut axes: Vec<usize> = (0..shape.len()).collect();
            axes.rotate_left(if shape.is_empty() { 0 } else { turn % shape.len() });
            let mut layouts = vec![Layout::contiguous(&shape), Layout::contiguous(&shape).permuted(&axes)];
            if let Some(&extent) = shape.first()
                && flip && extent > 0 {
                layouts.push(Layout::contiguous(&shape).sliced(0, extent - 1, extent, -1));
                layouts.push(Layout::contiguous(&shape).sliced(0, 0, extent.div_ceil(2), 2).permuted(&axes));
            }
            if shape.len() > 1 {
                layouts.push(Layout::contiguous(&shape).diagonal(0, 1, lead as isize - 1));
                layouts.push(Layout::contiguous(&shape).diagonal(shape.len() - 1, 0, 1));
            }
            // All but the broadcast name each element at most once, so that writing undoes reading.
            for layout in &layouts {
                let values = naive(layout, &source);
                let mut copy = vec![f64::NAN; source.len()];
                layout.write(&values, &mut copy);
                prop_assert_eq!(naive(layout, &copy), values);
                let untouched = copy.iter().filter(|x| x.is_nan()).count();
                prop_assert_eq!(untouched, source.len() - layout.shape.iter().product::<usize>());
            }
            let mut wide = vec![2; lead];
            wide.extend(shape.iter().map(|&extent| if extent == 1 { 3 } else { extent }));
            layouts.push(Layout::broadcast(&shape, &wide));
            for layout in layouts {
                let expected = naive(&layout, &source);
                let mut out = vec![f64::NAN; expected.len()];
                layout.read(&source, &mut out);
                prop_assert_eq!(&out, &expected);
                // <read x, v> = <x, add v>
                let v: Vec<f64> = (0..out.len()).map(|i| (i % 7) as f64 - 3.0).collect();
                let mut back = vec![0.0; source.len()];
                layout.add(&v, &mut back);
                let forward: f64 = out.iter().zip(&v).map(|(a, b)| a * b).sum();
                let adjoint: f64 = source.iter().zip(&back).map(|(a, b)| a * b).sum();
                prop_assert!((forward - adjoint).abs() < 1e-9);
            }
        }
    }
}
