//! Views of a tensor: other elements, or another order of them, without a copy.

use crate::layout::inferred;
use crate::{Layout, Scalar, Tensor};
use ndarray::{Slice, SliceInfoElem};

impl<T: Scalar> Tensor<T> {
    /// The elements that a layout of a row-major tensor of this shape names. Without a copy, unless the layout steps over
    /// the ends of rows that do not lie one behind the other.
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

    /// A view that a user asked for, or what is wrong with it as a panic.
    #[track_caller]
    fn seen_as(&self, name: &str, layout: Result<Layout, String>) -> Self {
        match layout {
            Ok(layout) => self.with_layout(layout),
            Err(what) => panic!("{name}: {what}"),
        }
    }

    /// The same elements under another shape, in which one extent may be [`INFER`](crate::INFER): it follows from the
    /// others. Copied only where strides cannot say that.
    ///
    /// # Panics
    /// If the shape holds another number of elements, or no extent follows.
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

    /// Slices, single entries and new axes, as ndarray's `s![]` names them: negative places count from the end, a negative
    /// step walks backwards from the last entry of its range, and axes that are not named stay whole.
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
    /// If more axes are named than there are, a place lies outside its axis, or a step is 0.
    #[track_caller]
    pub fn slice(&self, places: impl AsRef<[SliceInfoElem]>) -> Self {
        self.seen_as("slice", self.layout().sliced_by(places.as_ref()))
    }

    /// The entries of a range along one axis, whose number may be known only when the program runs: `1..3`, `..-1`, or
    /// with a step `Slice::from(..).step_by(-2)`.
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

    /// Axis `i` of the result is axis `axes[i]` of this tensor.
    ///
    /// # Panics
    /// If `axes` does not name every axis once.
    #[track_caller]
    pub fn permute(&self, axes: &[isize]) -> Self {
        self.seen_as("permute", self.layout().permuted_by(axes))
    }

    /// Two axes exchanged.
    ///
    /// # Panics
    /// If an axis does not exist.
    #[track_caller]
    pub fn transpose(&self, a: isize, b: isize) -> Self {
        self.seen_as("transpose", self.layout().transposed(a, b))
    }

    /// The last two axes exchanged: the transpose of a matrix, or of each matrix of a batch.
    ///
    /// # Panics
    /// If there are less than two axes.
    #[track_caller]
    pub fn t(&self) -> Self {
        self.seen_as("t", self.layout().transposed(-1, -2))
    }

    /// The entries along `axis` in reverse order.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn flip(&self, axis: isize) -> Self {
        self.seen_as("flip", self.layout().flipped(axis))
    }

    /// This tensor stretched to `shape`, as NumPy broadcasts: axes are aligned at the last one, and an axis of extent 1, or
    /// an absent one, repeats its elements.
    ///
    /// # Panics
    /// If the shape does not broadcast to `shape`.
    #[track_caller]
    pub fn broadcast_to(&self, shape: &[usize]) -> Self {
        if self.shape() == shape {
            return self.clone();
        }
        self.seen_as("broadcast_to", self.layout().broadcast_to(shape))
    }

    /// The diagonal through the last two axes, which becomes the last one. Number `diagonal` counts from the main one
    /// towards the upper right; it is empty beyond the corners.
    ///
    /// # Panics
    /// If there are less than two axes.
    #[track_caller]
    pub fn diagonal(&self, diagonal: isize) -> Self {
        self.seen_as("diagonal", self.layout().last_diagonal(diagonal))
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
        self.seen_as("windows", self.layout().windows(axis, size, step))
    }

    /// This tensor without `axis`, which has extent 1.
    ///
    /// # Panics
    /// If the axis does not exist or has another extent.
    #[track_caller]
    pub fn squeeze(&self, axis: isize) -> Self {
        self.seen_as("squeeze", self.layout().squeezed(axis))
    }

    /// This tensor with a new axis of extent 1 that stands at place `axis`, which may be counted from behind the last one.
    ///
    /// # Panics
    /// If there is no such place.
    #[track_caller]
    pub fn unsqueeze(&self, axis: isize) -> Self {
        self.seen_as("unsqueeze", self.layout().unsqueezed(axis))
    }
}
