//! Strided layouts: a map from indices to elements of a buffer.

use crate::Shape;
use smallvec::SmallVec;

mod views;

/// The distance in a buffer from an element to its neighbour along each axis.
pub(crate) type Strides = SmallVec<[isize; 4]>;

/// A map from each index of a shape to an element of a buffer: `offset + sum(index[i] * strides[i])`.
///
/// Stride 0 repeats an element (broadcast), and a negative stride walks backwards (flip). Every layout stays within its
/// buffer.
#[derive(Debug, Clone, PartialEq)]
pub struct Layout {
    shape: Shape,
    strides: Strides,
    offset: isize,
    /// Number of elements of the buffer.
    source: usize,
}

/// The number of elements of a shape. `None` if it is beyond `isize::MAX`, which no buffer can hold. An extent of 0
/// makes it 0, as long as the product of the other extents is in range.
pub fn checked_len(shape: &[usize]) -> Option<usize> {
    let all = shape.iter().filter(|&&extent| extent > 0).try_fold(1_usize, |all, &extent| all.checked_mul(extent))?;
    (all <= isize::MAX as usize).then(|| if shape.contains(&0) { 0 } else { all })
}

/// Marks the extent that follows from the others in a reshape (-1 in NumPy and PyTorch).
pub const INFER: usize = usize::MAX;

/// A shape for `len` elements in which one extent may be [`INFER`].
///
/// # Errors
/// If the shape has another number of elements, or more than one extent is [`INFER`]. If an inferred extent does not
/// follow from the others, because they do not divide the number of elements or one of them is 0.
pub fn inferred(shape: &[usize], len: usize) -> Result<Shape, String> {
    let mut known = Shape::from_slice(shape);
    if let Some(axis) = shape.iter().position(|&extent| extent == INFER) {
        known[axis] = 1;
        if known.contains(&INFER) {
            return Err("only one extent can be inferred".into());
        }
        match checked_len(&known) {
            Some(others) if others > 0 && len.is_multiple_of(others) => known[axis] = len / others,
            _ => return Err(format!("no extent of {len} elements follows from {known:?}")),
        }
    }
    if checked_len(&known) != Some(len) {
        return Err(format!("{known:?} holds another number of elements than {len}"));
    }
    Ok(known)
}

/// The number of elements of a shape.
///
/// # Panics
/// If it is more than a buffer can hold.
#[track_caller]
pub(crate) fn len_of(shape: &[usize]) -> usize {
    checked_len(shape).unwrap_or_else(|| panic!("a tensor of shape {shape:?} has too many elements"))
}

/// The inverse of a permutation.
pub(crate) fn inverse(order: &[usize]) -> Shape {
    let mut back = Shape::from_elem(0, order.len());
    order.iter().enumerate().for_each(|(i, &axis)| back[axis] = i);
    back
}

impl Layout {
    /// The row-major layout of a whole buffer of this shape.
    ///
    /// # Panics
    /// If it has more elements than a buffer can hold.
    #[track_caller]
    pub fn contiguous(shape: &[usize]) -> Self {
        let source = len_of(shape);
        let mut strides = Strides::from_elem(1, shape.len());
        for i in (1..shape.len()).rev() {
            strides[i - 1] = strides[i].wrapping_mul(shape[i] as isize);
        }
        Layout { shape: Shape::from_slice(shape), strides, offset: 0, source }
    }

    /// A layout with any strides; `None` if it leaves a buffer of `source` elements.
    pub(crate) fn strided(shape: &[usize], strides: &[isize], offset: isize, source: usize) -> Option<Self> {
        let layout = Layout { shape: Shape::from_slice(shape), strides: Strides::from_slice(strides), offset, source };
        layout.is_inside().then_some(layout)
    }

    /// Whether every index maps to an element of the buffer.
    fn is_inside(&self) -> bool {
        if checked_len(&self.shape).is_none() || self.shape.len() != self.strides.len() {
            return false;
        }
        if self.shape.contains(&0) {
            return true;
        }
        let (mut low, mut high) = (self.offset as i128, self.offset as i128);
        for (&extent, &stride) in self.shape.iter().zip(&self.strides) {
            let way = (extent as i128 - 1) * stride as i128;
            if way < 0 { low += way } else { high += way }
        }
        low >= 0 && high < self.source as i128
    }

    /// The extent of each axis.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The distance in the buffer from an element to its neighbour along each axis.
    pub fn strides(&self) -> &[isize] {
        &self.strides
    }

    /// The position in the buffer of the element whose indices are all 0.
    pub fn offset(&self) -> usize {
        self.offset as usize
    }

    /// Number of elements of the buffer.
    pub fn source(&self) -> usize {
        self.source
    }

    /// Number of elements of the layout.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether an axis has extent 0.
    pub fn is_empty(&self) -> bool {
        self.shape.contains(&0)
    }

    /// Whether the elements are contiguous in row-major order, from [`offset`](Self::offset) on.
    pub fn is_packed(&self) -> bool {
        let mut step = 1;
        for (&extent, &stride) in self.shape.iter().zip(&self.strides).rev() {
            if extent != 1 && stride != step {
                return self.is_empty();
            }
            step *= extent as isize;
        }
        true
    }

    /// The same elements in the same order with another shape; `None` if strides cannot express it.
    ///
    /// # Panics
    /// If the shapes have different numbers of elements.
    #[track_caller]
    pub fn reshaped(&self, shape: &[usize]) -> Option<Self> {
        assert_eq!(checked_len(shape), Some(self.len()), "cannot reshape {:?} to {shape:?}", self.shape);
        if self.is_empty() {
            return Some(Layout {
                shape: Shape::from_slice(shape),
                strides: Strides::from_elem(0, shape.len()),
                ..*self
            });
        }
        // Runs of axes that are one axis to memory, from the last one on, are cut into new axes.
        let runs = self.collapsed();
        let mut runs = runs.iter().rev();
        let mut strides = Strides::from_elem(0, shape.len());
        let (mut left, mut step) = (1, 0);
        for (&extent, new) in shape.iter().zip(&mut strides).rev() {
            if extent == 1 {
                continue;
            }
            if left == 1 {
                (left, step) = *runs.next()?;
            }
            if left % extent != 0 {
                return None;
            }
            *new = step;
            left /= extent;
            step *= extent as isize;
        }
        Some(Layout { shape: Shape::from_slice(shape), strides, ..*self })
    }

    /// Composes two views: this layout of a row-major buffer of `base`'s shape, applied to the elements of `base`.
    /// `None` if strides cannot express it.
    ///
    /// # Panics
    /// If this layout was made for another number of elements.
    #[track_caller]
    pub fn of(&self, base: &Layout) -> Option<Layout> {
        assert_eq!(self.source, base.len(), "a layout of {} elements, of a view of {:?}", self.source, base.shape);
        if self.is_empty() {
            return Some(Layout { offset: base.offset, source: base.source, ..self.clone() });
        }
        if base.is_packed() {
            return Some(Layout { offset: self.offset + base.offset, source: base.source, ..self.clone() });
        }
        // Along each axis of this layout the index of `base` moves by a constant: that between the first two elements.
        let first = base.index_of(self.offset as usize);
        let (mut low, mut high) = (first.clone(), first.clone());
        let mut strides = Strides::with_capacity(self.shape.len());
        for (&extent, &stride) in self.shape.iter().zip(&self.strides) {
            if extent == 1 {
                strides.push(0);
                continue;
            }
            let second = base.index_of((self.offset + stride) as usize);
            let mut position = 0;
            for i in 0..first.len() {
                let way = second[i] - first[i];
                position += way * base.strides[i];
                let whole = way * (extent as isize - 1);
                if whole < 0 { low[i] += whole } else { high[i] += whole }
            }
            strides.push(position);
        }
        // Where it would leave an axis, it wraps into the next row instead.
        let inside = (0..first.len()).all(|i| low[i] >= 0 && high[i] < base.shape[i] as isize);
        let position: isize = first.iter().zip(&base.strides).map(|(&i, &stride)| i * stride).sum();
        let offset = base.offset + position;
        inside.then(|| Layout { shape: self.shape.clone(), strides, offset, source: base.source })
    }

    /// The index of the element at `position` in row-major order.
    fn index_of(&self, mut position: usize) -> SmallVec<[isize; 4]> {
        let mut index = SmallVec::from_elem(0, self.shape.len());
        for (i, &extent) in index.iter_mut().zip(&self.shape).rev() {
            *i = (position % extent) as isize;
            position /= extent;
        }
        index
    }

    /// The inverse of a layout that selects every element of a row-major buffer once, such as a permutation or a flip.
    /// It selects the elements in the order of that buffer. `None` if the layout has no such inverse.
    pub fn inverted(&self) -> Option<Layout> {
        let mut order: Shape = (0..self.shape.len()).collect();
        order.sort_by_key(|&axis| std::cmp::Reverse(self.strides[axis].unsigned_abs()));
        let (mut forward, mut back) = (self.permuted(&order), Layout::contiguous(&self.shape).permuted(&order));
        for axis in 0..order.len() {
            if forward.strides[axis] < 0 && forward.shape[axis] > 1 {
                let extent = forward.shape[axis];
                forward = forward.sliced(axis, extent - 1, extent, -1);
                back = back.sliced(axis, extent - 1, extent, -1);
            }
        }
        let whole = forward.len() == self.source && forward.offset == 0 && forward.is_packed();
        (whole && !self.is_empty()).then_some(back)
    }

    /// The buffer positions of the sub-arrays behind the first `lead` axes, for every index of these, in row-major
    /// order.
    pub(crate) fn offsets(&self, lead: usize) -> Vec<usize> {
        let mut offsets = vec![self.offset as usize];
        for (&extent, &stride) in self.shape[..lead].iter().zip(&self.strides) {
            let next = |&start: &usize| (0..extent as isize).map(move |i| (start as isize + i * stride) as usize);
            offsets = offsets.iter().flat_map(next).collect();
        }
        offsets
    }

    /// The order of axes that walks memory from start to end, if the elements are contiguous in that order.
    pub(crate) fn memory_order(&self) -> Option<Shape> {
        let mut axes: Shape = (0..self.shape.len()).collect();
        axes.sort_by_key(|&axis| std::cmp::Reverse(self.strides[axis]));
        self.permuted(&axes).is_packed().then_some(axes)
    }

    /// Drops axes of extent 1 and merges neighbours that form one run, for fewer and longer inner loops.
    pub(crate) fn collapsed(&self) -> SmallVec<[(usize, isize); 4]> {
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
            layouts.push(Layout::contiguous(&shape).stretched(&wide));
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
