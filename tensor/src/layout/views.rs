//! Layouts of views: slices, permutations, diagonals, windows, broadcasts.
//!
//! The methods that take user input, such as negative axes and `s![..]`, return an error as text.
//! [`Tensor`](crate::Tensor) turns it into a panic, and a graph into an error.

use super::{Layout, Strides, checked_len, len_of};
use crate::{Shape, find_axis};
use ndarray::{Slice, SliceInfoElem};
use smallvec::SmallVec;

impl Layout {
    /// Broadcasts this layout to shape `to`, with NumPy's rules. Axes are aligned at the last one. An axis of extent 1,
    /// or a missing one, gets stride 0.
    ///
    /// # Panics
    /// If the shape does not broadcast to `to`.
    #[track_caller]
    pub fn stretched(&self, to: &[usize]) -> Self {
        let from = &self.shape;
        assert!(from.len() <= to.len(), "cannot broadcast {from:?} to {to:?}");
        len_of(to);
        let lead = to.len() - from.len();
        let mut strides = Strides::from_elem(0, to.len());
        for (i, &extent) in from.iter().enumerate() {
            assert!(extent == to[lead + i] || extent == 1, "cannot broadcast {from:?} to {to:?}");
            if extent == to[lead + i] {
                strides[lead + i] = self.strides[i];
            }
        }
        Layout { shape: Shape::from_slice(to), strides, ..*self }
    }

    /// Reorders the axes: axis `i` of the result is axis `axes[i]` of this layout.
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

    /// The `len` elements along `axis` from `start` on, every `step`-th. A negative step walks backwards.
    ///
    /// # Panics
    /// If an element is outside the axis.
    #[track_caller]
    pub fn sliced(&self, axis: usize, start: usize, len: usize, step: isize) -> Self {
        let extent = self.shape[axis];
        let last = start as i128 + step as i128 * (len as i128 - 1);
        let inside = |i: i128| (0..extent as i128).contains(&i);
        assert!(
            len == 0 || (inside(start as i128) && inside(last)),
            "slice of {len} from {start} by {step} leaves the extent {extent} of axis {axis}"
        );
        let mut out = self.clone();
        out.shape[axis] = len;
        // One entry has no neighbour, however large the step.
        out.strides[axis] = if len > 1 { self.strides[axis] * step } else { 0 };
        if len > 0 {
            out.offset += start as isize * self.strides[axis];
        }
        out
    }

    /// The diagonal through axes `a` and `b`, which becomes the last axis. It has the elements whose index along `b` is
    /// that along `a` plus `offset`. It is empty if the offset leaves the matrix.
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

    /// The view of ndarray's `s![..]`: a slice, one entry or a new axis for each position. Axes that are not listed
    /// stay whole. Negative positions count from the end. A negative step walks backwards from the last entry of its
    /// range.
    ///
    /// # Errors
    /// If more axes are listed than the layout has, a position is outside its axis, or a step is 0.
    pub fn sliced_by(&self, places: &[SliceInfoElem]) -> Result<Layout, String> {
        let named = places.iter().filter(|place| !matches!(place, SliceInfoElem::NewAxis)).count();
        if named > self.shape.len() {
            return Err(format!("{named} axes are named of a tensor of shape {:?}", self.shape));
        }
        let mut out = Layout { shape: Shape::new(), strides: Strides::new(), ..*self };
        let mut axis = 0;
        for place in places {
            if let SliceInfoElem::NewAxis = place {
                out.shape.push(1);
                out.strides.push(0);
                continue;
            }
            let (extent, stride) = (self.shape[axis] as isize, self.strides[axis]);
            let outside =
                |place: isize| format!("{place} lies outside axis {axis} of a tensor of shape {:?}", self.shape);
            let from_start = |place: isize| if place < 0 { place + extent } else { place };
            match *place {
                SliceInfoElem::Index(place) => {
                    let index = from_start(place);
                    if !(0..extent).contains(&index) {
                        return Err(outside(place));
                    }
                    out.offset += index * stride;
                }
                SliceInfoElem::Slice { start, end, step } => {
                    let (first, behind) = (from_start(start), end.map_or(extent, from_start));
                    if !(0..=extent).contains(&first) {
                        return Err(outside(start));
                    }
                    if !(0..=extent).contains(&behind) {
                        return Err(outside(end.unwrap_or(extent)));
                    }
                    if step == 0 {
                        return Err(format!("the step along axis {axis} is 0"));
                    }
                    let len = (behind - first).max(0).unsigned_abs().div_ceil(step.unsigned_abs());
                    if len > 0 {
                        out.offset += stride * if step > 0 { first } else { behind - 1 };
                    }
                    out.shape.push(len);
                    // An axis of one entry has no step, however large the one that was asked for.
                    out.strides.push(if len > 1 { stride * step } else { 0 });
                }
                SliceInfoElem::NewAxis => unreachable!("handled above"),
            }
            axis += 1;
        }
        out.shape.extend_from_slice(&self.shape[axis..]);
        out.strides.extend_from_slice(&self.strides[axis..]);
        Ok(out)
    }

    /// Sliding windows of `size` entries along `axis`, every `step`-th of them. The axis counts windows, and a new last
    /// axis the entries of a window.
    ///
    /// # Errors
    /// If the axis does not exist or is shorter than a window, `size` or `step` is 0, or the windows have too many
    /// elements.
    pub fn windows(&self, axis: isize, size: usize, step: usize) -> Result<Self, String> {
        let (shape, axis) = (&self.shape, find_axis(axis, &self.shape)?);
        if !(1..=shape[axis]).contains(&size) || step == 0 {
            let what = "a window has at least one entry and fits the axis, and a step is at least 1";
            return Err(format!("windows of {size} every {step} along axis {axis} of {shape:?}: {what}"));
        }
        let mut out = self.clone();
        out.shape[axis] = (shape[axis] - size) / step + 1;
        out.shape.push(size);
        out.strides.push(self.strides[axis]);
        // One window has no neighbour, however large the step.
        out.strides[axis] = if out.shape[axis] > 1 { self.strides[axis] * step as isize } else { 0 };
        if checked_len(&out.shape).is_none() {
            return Err(format!("windows of shape {:?} have too many elements", out.shape));
        }
        Ok(out)
    }

    /// The entries of a range along one axis, in the notation of `s![..]`.
    ///
    /// # Errors
    /// If the axis does not exist, the range leaves it, or the step is 0.
    pub fn sliced_axis(&self, axis: isize, range: impl Into<Slice>) -> Result<Self, String> {
        let (axis, Slice { start, end, step }) = (find_axis(axis, &self.shape)?, range.into());
        let mut places: SmallVec<[SliceInfoElem; 4]> =
            SmallVec::from_elem(SliceInfoElem::Slice { start: 0, end: None, step: 1 }, axis);
        places.push(SliceInfoElem::Slice { start, end, step });
        self.sliced_by(&places)
    }

    /// As [`permuted`](Self::permuted), with negative axes too.
    ///
    /// # Errors
    /// If `axes` does not list every axis once.
    pub fn permuted_by(&self, axes: &[isize]) -> Result<Self, String> {
        let order: Result<Shape, String> = axes.iter().map(|&axis| find_axis(axis, &self.shape)).collect();
        let order = order?;
        let once = |axis: usize| order.iter().filter(|&&other| other == axis).count() == 1;
        if !(0..self.shape.len()).all(once) {
            return Err(format!("{axes:?} does not name every axis of {:?} once", self.shape));
        }
        Ok(self.permuted(&order))
    }

    /// Swaps two axes.
    ///
    /// # Errors
    /// If an axis does not exist.
    pub fn transposed(&self, a: isize, b: isize) -> Result<Self, String> {
        let mut axes: Shape = (0..self.shape.len()).collect();
        axes.swap(find_axis(a, &self.shape)?, find_axis(b, &self.shape)?);
        Ok(self.permuted(&axes))
    }

    /// Reverses the entries along an axis.
    ///
    /// # Errors
    /// If the axis does not exist.
    pub fn flipped(&self, axis: isize) -> Result<Self, String> {
        self.sliced_axis(axis, Slice::new(0, None, -1))
    }

    /// The diagonal through the last two axes; see [`diagonal`](Self::diagonal).
    ///
    /// # Errors
    /// If there are fewer than two axes.
    pub fn last_diagonal(&self, offset: isize) -> Result<Self, String> {
        Ok(self.diagonal(find_axis(-2, &self.shape)?, find_axis(-1, &self.shape)?, offset))
    }

    /// Broadcasts this layout to shape `to`, with NumPy's rules.
    ///
    /// # Errors
    /// If this layout does not broadcast to `to`.
    pub fn broadcast_to(&self, to: &[usize]) -> Result<Self, String> {
        let fits = crate::broadcast_shape(&[&self.shape, to]).is_some_and(|wide| wide.as_slice() == to);
        match checked_len(to) {
            _ if !fits => Err(format!("cannot broadcast {:?} to {to:?}", self.shape)),
            None => Err(format!("a tensor of shape {to:?} has too many elements")),
            Some(_) => Ok(self.stretched(to)),
        }
    }

    /// Removes an axis of extent 1.
    ///
    /// # Errors
    /// If the axis does not exist or has another extent.
    pub fn squeezed(&self, axis: isize) -> Result<Self, String> {
        let axis = find_axis(axis, &self.shape)?;
        if self.shape[axis] != 1 {
            return Err(format!("axis {axis} of {:?} has not extent 1", self.shape));
        }
        let mut out = self.clone();
        out.shape.remove(axis);
        out.strides.remove(axis);
        Ok(out)
    }

    /// Adds a new axis of extent 1 at position `axis`. A negative position counts from behind the last axis.
    ///
    /// # Errors
    /// If there is no such position.
    pub fn unsqueezed(&self, axis: isize) -> Result<Self, String> {
        let mut out = self.clone();
        out.shape.push(1);
        let axis =
            find_axis(axis, &out.shape).map_err(|_| format!("no place {axis} among the axes of {:?}", self.shape))?;
        out.shape.pop();
        out.shape.insert(axis, 1);
        out.strides.insert(axis, 0);
        Ok(out)
    }
}
