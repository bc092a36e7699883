//! Views of a tensor, without a copy: reshape, slice, permute, broadcast, windows.

use crate::layout::inferred;
use crate::{Layout, Scalar, Tensor};
use ndarray::{Slice, SliceInfoElem};

impl<T: Scalar> Tensor<T> {
    /// The elements that a layout of a row-major tensor of this shape selects. It copies only if the layout crosses the
    /// ends of rows that are not contiguous in this tensor.
    ///
    /// # Panics
    /// If the layout was made for another number of elements.
    #[track_caller]
    pub fn seen_through(&self, layout: &Layout) -> Self {
        match layout.of(&self.layout()) {
            Some(layout) => self.with_layout(layout),
            None => self.packed().with_layout(layout.clone()),
        }
    }

    /// A view from user input, or a panic that names the mistake.
    #[track_caller]
    fn seen_as(&self, name: &str, layout: Result<Layout, String>) -> Self {
        match layout {
            Ok(layout) => self.with_layout(layout),
            Err(what) => panic!("{name}: {what}"),
        }
    }

    /// The same elements with another shape. One extent may be [`INFER`](crate::INFER): it follows from the others. It
    /// copies only if strides cannot express the result.
    ///
    /// # Panics
    /// If the shape has another number of elements, or an extent cannot be inferred.
    #[track_caller]
    pub fn reshape(&self, shape: &[usize]) -> Self {
        let shape = match inferred(shape, self.len()) {
            Ok(shape) => shape,
            Err(what) => panic!("reshape of {:?}: {what}", self.shape()),
        };
        match self.layout().reshaped(&shape) {
            Some(layout) => self.with_layout(layout),
            None => self.packed().reshape(&shape),
        }
    }

    /// Slices, single entries and new axes, in the notation of ndarray's `s![]`. Negative positions count from the end.
    /// A negative step walks backwards from the last entry of its range. Axes that are not listed stay whole.
    ///
    /// ```
    /// use raygrad_tensor::{Tensor, s};
    /// let x = Tensor::from_fn(&[2, 3, 4], |i| i as f32);
    /// assert_eq!(x.slice(s![.., -1, 1..3]), [[9.0, 10.0], [21.0, 22.0]]);
    /// assert_eq!(x.slice(s![0, 0, ..;-2]), [3.0, 1.0]);
    /// assert_eq!(x.slice(s![1]).shape(), [3, 4]);
    /// ```
    ///
    /// # Panics
    /// If more axes are listed than the tensor has, a position is outside its axis, or a step is 0.
    #[track_caller]
    pub fn slice(&self, places: impl AsRef<[SliceInfoElem]>) -> Self {
        self.seen_as("slice", self.layout().sliced_by(places.as_ref()))
    }

    /// The entries of a range along one axis. The range may be known only at run time: `1..3`, `..-1`, or with a step
    /// `Slice::from(..).step_by(-2)`.
    ///
    /// ```
    /// use raygrad_tensor::{Slice, Tensor};
    /// let x = Tensor::from_fn(&[6], |i| i as f32);
    /// assert_eq!(x.slice_axis(-1, 1..3), [1.0, 2.0]);
    /// assert_eq!(x.slice_axis(0, Slice::from(..-1).step_by(-3)), [4.0, 1.0]);
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist, the range leaves it, or the step is 0.
    #[track_caller]
    pub fn slice_axis(&self, axis: isize, range: impl Into<Slice>) -> Self {
        self.seen_as("slice_axis", self.layout().sliced_axis(axis, range))
    }

    /// Reorders the axes: axis `i` of the result is axis `axes[i]` of this tensor.
    ///
    /// # Panics
    /// If `axes` does not list every axis once.
    #[track_caller]
    pub fn permute(&self, axes: &[isize]) -> Self {
        self.seen_as("permute", self.layout().permuted_by(axes))
    }

    /// Swaps two axes. Negative axes count from the last one.
    ///
    /// # Panics
    /// If an axis does not exist.
    #[track_caller]
    pub fn transpose(&self, a: isize, b: isize) -> Self {
        self.seen_as("transpose", self.layout().transposed(a, b))
    }

    /// Transposes the last two axes, of a matrix or of each matrix of a batch.
    ///
    /// # Panics
    /// If there are fewer than two axes.
    #[track_caller]
    pub fn t(&self) -> Self {
        self.seen_as("t", self.layout().transposed(-1, -2))
    }

    /// Reverses the entries along `axis`.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn flip(&self, axis: isize) -> Self {
        self.seen_as("flip", self.layout().flipped(axis))
    }

    /// Broadcasts this tensor to `shape`, with NumPy's rules. Axes are aligned at the last one. An axis of extent 1, or
    /// a missing one, repeats its elements.
    ///
    /// # Panics
    /// If this tensor does not broadcast to `shape`.
    #[track_caller]
    pub fn broadcast_to(&self, shape: &[usize]) -> Self {
        if self.shape() == shape {
            return self.clone();
        }
        self.seen_as("broadcast_to", self.layout().broadcast_to(shape))
    }

    /// The diagonal of the last two axes, which becomes the last axis. Diagonal 0 is the main one; `diagonal` counts
    /// towards the upper right. Beyond the corners it is empty.
    ///
    /// # Panics
    /// If there are fewer than two axes.
    #[track_caller]
    pub fn diagonal(&self, diagonal: isize) -> Self {
        self.seen_as("diagonal", self.layout().last_diagonal(diagonal))
    }

    /// Sliding windows of `size` entries along `axis`, every `step`-th of them. The axis counts windows, and a new last
    /// axis the entries of a window.
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// let x = Tensor::from_fn(&[6], |i| i as f32);
    /// let windows = x.windows(0, 3, 2);
    /// assert_eq!((windows.shape(), windows.as_slice()), (&[2, 3][..], &[0.0, 1.0, 2.0, 2.0, 3.0, 4.0][..]));
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist or is shorter than a window, `size` or `step` is 0, or the windows have too many
    /// elements.
    #[track_caller]
    pub fn windows(&self, axis: isize, size: usize, step: usize) -> Self {
        self.seen_as("windows", self.layout().windows(axis, size, step))
    }

    /// Removes `axis`, whose extent is 1.
    ///
    /// # Panics
    /// If the axis does not exist or has another extent.
    #[track_caller]
    pub fn squeeze(&self, axis: isize) -> Self {
        self.seen_as("squeeze", self.layout().squeezed(axis))
    }

    /// Adds a new axis of extent 1 at position `axis`. A negative position counts from behind the last axis.
    ///
    /// # Panics
    /// If there is no such position.
    #[track_caller]
    pub fn unsqueeze(&self, axis: isize) -> Self {
        self.seen_as("unsqueeze", self.layout().unsqueezed(axis))
    }
}
