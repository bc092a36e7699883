//! Views of a tensor: other elements, or another order of them, without a copy.

use crate::{Layout, Scalar, Shape, Tensor};
use ndarray::SliceInfoElem;
use std::ops::Range;

/// The number of an axis that may be counted from the last one: -1 is the last.
///
/// # Panics
/// If the axis does not exist.
#[track_caller]
pub fn axis_of(axis: isize, shape: &[usize]) -> usize {
    let from_start = if axis < 0 { axis + shape.len() as isize } else { axis };
    assert!((0..shape.len() as isize).contains(&from_start), "axis {axis} of a tensor of shape {shape:?}");
    from_start as usize
}

impl<T: Scalar> Tensor<T> {
    /// The elements that a layout of a row-major tensor of this shape names. Without a copy, unless the layout steps over
    /// the ends of rows that do not lie one behind the other.
    ///
    /// # Panics
    /// If the layout was made for another number of elements.
    #[track_caller]
    pub fn select(&self, layout: &Layout) -> Self {
        match layout.of(&self.layout()) {
            Some(layout) => self.with_layout(layout),
            None => self.packed().with_layout(layout.clone()),
        }
    }

    /// The same elements under another shape; copied only where strides cannot say that.
    ///
    /// # Panics
    /// If the shapes hold different numbers of elements.
    #[track_caller]
    pub fn reshape(&self, shape: &[usize]) -> Self {
        match self.layout().reshaped(shape) {
            Some(layout) => self.with_layout(layout),
            None => self.packed().reshape(shape),
        }
    }

    /// Slices, single entries and new axes, as ndarray's `s![]` names them: negative places count from the end, a negative
    /// step walks backwards from the last entry of its range, and axes that are not named stay whole.
    ///
    /// ```
    /// use raygrad_tensor::{Tensor, s};
    /// let x = Tensor::from_fn(&[2, 3, 4], |i| i as f32);
    /// assert_eq!(x.slice(s![.., -1, 1..3]).as_slice(), [9.0, 10.0, 21.0, 22.0]);
    /// assert_eq!(x.slice(s![0, 0, ..;-2]).as_slice(), [3.0, 1.0]);
    /// assert_eq!(x.slice(s![1]).shape(), [3, 4]);
    /// ```
    ///
    /// # Panics
    /// If more axes are named than there are, a place lies outside its axis, or a step is 0.
    #[track_caller]
    pub fn slice(&self, places: impl AsRef<[SliceInfoElem]>) -> Self {
        match self.layout().sliced_by(places.as_ref()) {
            Ok(layout) => self.with_layout(layout),
            Err(what) => panic!("slice: {what}"),
        }
    }

    /// The entries `range` along one axis, every `step`-th of them; a negative step starts at the last one and walks
    /// backwards. For an axis whose number is known only when the program runs.
    ///
    /// # Panics
    /// If the axis does not exist, the range leaves it or is reversed, or the step is 0.
    #[track_caller]
    pub fn slice_axis(&self, axis: isize, range: Range<usize>, step: isize) -> Self {
        let (shape, axis) = (self.shape(), axis_of(axis, self.shape()));
        let fits = range.start <= range.end && range.end <= shape[axis] && step != 0;
        assert!(fits, "slice {range:?} by {step} along axis {axis} of a tensor of shape {shape:?}");
        let start = if step > 0 { range.start } else { range.end.saturating_sub(1) };
        let len = range.len().div_ceil(step.unsigned_abs());
        self.with_layout(self.layout().sliced(axis, start, len, step))
    }

    /// Axis `i` of the result is axis `axes[i]` of this tensor.
    ///
    /// # Panics
    /// If `axes` does not name every axis once.
    #[track_caller]
    pub fn permute(&self, axes: &[isize]) -> Self {
        let axes: Shape = axes.iter().map(|&axis| axis_of(axis, self.shape())).collect();
        self.with_layout(self.layout().permuted(&axes))
    }

    /// Two axes exchanged.
    ///
    /// # Panics
    /// If an axis does not exist.
    #[track_caller]
    pub fn transpose(&self, a: isize, b: isize) -> Self {
        let mut axes: Shape = (0..self.ndim()).collect();
        axes.swap(axis_of(a, self.shape()), axis_of(b, self.shape()));
        self.with_layout(self.layout().permuted(&axes))
    }

    /// The last two axes exchanged: the transpose of a matrix, or of each matrix of a batch.
    ///
    /// # Panics
    /// If there are less than two axes.
    #[track_caller]
    pub fn t(&self) -> Self {
        self.transpose(-1, -2)
    }

    /// The entries along `axis` in reverse order.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn flip(&self, axis: isize) -> Self {
        let axis = axis_of(axis, self.shape());
        let len = self.shape()[axis];
        self.with_layout(self.layout().sliced(axis, len.saturating_sub(1), len, -1))
    }

    /// This tensor stretched to `shape`, as NumPy broadcasts: axes are aligned at the last one, and an axis of extent 1, or
    /// an absent one, repeats its elements.
    ///
    /// # Panics
    /// If the shape does not broadcast to `shape`.
    #[track_caller]
    pub fn broadcast_to(&self, shape: &[usize]) -> Self {
        if self.shape() == shape { self.clone() } else { self.with_layout(self.layout().stretched(shape)) }
    }

    /// The diagonal through the last two axes, which becomes the last one. Number `diagonal` counts from the main one
    /// towards the upper right; it is empty beyond the corners.
    ///
    /// # Panics
    /// If there are less than two axes.
    #[track_caller]
    pub fn diagonal(&self, diagonal: isize) -> Self {
        let (row, column) = (axis_of(-2, self.shape()), axis_of(-1, self.shape()));
        self.with_layout(self.layout().diagonal(row, column, diagonal))
    }

    /// Windows of `size` entries along `axis`, every `step`-th of them: the axis counts windows, and a new last axis the
    /// entries in one.
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// let x = Tensor::from_fn(&[6], |i| i as f32);
    /// let windows = x.windows(0, 3, 2);
    /// assert_eq!((windows.shape(), windows.as_slice()), (&[2, 3][..], &[0.0, 1.0, 2.0, 2.0, 3.0, 4.0][..]));
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist or is shorter than a window, or `size` or `step` is 0.
    #[track_caller]
    pub fn windows(&self, axis: isize, size: usize, step: usize) -> Self {
        self.with_layout(self.layout().windows(axis_of(axis, self.shape()), size, step))
    }

    /// This tensor without `axis`, which has extent 1.
    ///
    /// # Panics
    /// If the axis does not exist or has another extent.
    #[track_caller]
    pub fn squeeze(&self, axis: isize) -> Self {
        let axis = axis_of(axis, self.shape());
        assert!(self.shape()[axis] == 1, "squeeze of axis {axis} of a tensor of shape {:?}", self.shape());
        let mut shape = Shape::from_slice(self.shape());
        shape.remove(axis);
        self.reshape(&shape)
    }

    /// This tensor with a new axis of extent 1 that stands at place `axis`, which may be counted from behind the last one.
    ///
    /// # Panics
    /// If there is no such place.
    #[track_caller]
    pub fn unsqueeze(&self, axis: isize) -> Self {
        let mut shape = Shape::from_slice(self.shape());
        shape.push(1);
        let axis = axis_of(axis, &shape);
        shape.pop();
        shape.insert(axis, 1);
        self.reshape(&shape)
    }
}
