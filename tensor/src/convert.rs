//! Conversions between tensors and ndarray.

use crate::{Layout, Scalar, Shape, Tensor};
use ndarray::{Array, ArrayView, Axis, Dimension, IxDyn, ShapeBuilder};
use std::fmt;

impl<T: Scalar> Tensor<T> {
    /// The elements as an ndarray view with the same strides.
    pub fn view(&self) -> ArrayView<'_, T, IxDyn> {
        let layout = self.layout();
        let (mut strides, mut start) = (Shape::with_capacity(self.ndim()), layout.offset());
        // ndarray makes views with strides that rise only; the others are turned afterwards.
        for (&extent, &stride) in layout.shape().iter().zip(layout.strides()) {
            let one = extent <= 1 || self.is_empty();
            strides.push(if one { 0 } else { stride.unsigned_abs() });
            if stride < 0 && !one {
                start -= (extent - 1) * stride.unsigned_abs();
            }
        }
        let buffer = if self.is_empty() { &[] } else { &self.buffer()[start..] };
        let mut view = match ArrayView::from_shape(IxDyn(self.shape()).strides(IxDyn(&strides)), buffer) {
            Ok(view) => view,
            Err(error) => unreachable!("a layout stays in its buffer: {error}"),
        };
        for (axis, &stride) in layout.strides().iter().enumerate() {
            if stride < 0 && strides[axis] > 0 {
                view.invert_axis(Axis(axis));
            }
        }
        view
    }

    /// The elements as an ndarray array in row-major order. It copies only if another tensor shares them, or if a view
    /// has another order.
    pub fn into_array(self) -> Array<T, IxDyn> {
        let shape = IxDyn(self.shape());
        match Array::from_shape_vec(shape, self.into_vec()) {
            Ok(array) => array,
            Err(error) => unreachable!("as many values as the shape holds: {error}"),
        }
    }
}

impl<T: Scalar, D: Dimension> From<Array<T, D>> for Tensor<T> {
    /// Converts an array without a copy: the tensor has its strides.
    fn from(array: Array<T, D>) -> Self {
        let (shape, strides) = (Shape::from_slice(array.shape()), array.strides().to_vec());
        if array.is_empty() {
            return Tensor::from_vec(&shape, vec![]);
        }
        let (values, offset) = array.into_raw_vec_and_offset();
        match Layout::strided(&shape, &strides, offset.unwrap_or(0) as isize, values.len()) {
            Some(layout) => Tensor::strided(values, layout),
            None => unreachable!("an array stays in its vector"),
        }
    }
}

impl<T: Scalar, D: Dimension> From<ArrayView<'_, T, D>> for Tensor<T> {
    /// Copies the elements of a view of any strides.
    fn from(view: ArrayView<'_, T, D>) -> Self {
        Tensor::from(view.to_owned())
    }
}

impl<T: Scalar> From<T> for Tensor<T> {
    /// A scalar tensor.
    fn from(value: T) -> Self {
        Tensor::scalar(value)
    }
}

impl<T: Scalar> fmt::Display for Tensor<T> {
    /// Formats the elements in nested brackets, as ndarray does. A precision applies to each element. Long axes are
    /// abbreviated.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(&self.view(), f)
    }
}

impl<T: Scalar> fmt::Debug for Tensor<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Tensor<{}>{:?} {self}", T::NAME, self.shape())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::s;

    #[test]
    fn arrays_of_any_layout_come_and_go_without_a_copy() {
        let array = Array::from_shape_fn((2, 3, 4), |(i, j, k)| (12 * i + 4 * j + k) as f32);
        let first = array.as_ptr();
        let tensor = Tensor::from(array.clone());
        assert!(tensor.is_packed());
        let moved = Tensor::from(array);
        assert!(std::ptr::eq(moved.as_slice().as_ptr(), first));
        assert!(std::ptr::eq(moved.into_array().as_ptr(), first));

        for turned in [
            tensor.view().to_owned().slice_move(s![..;-1, 1.., ..;2]).into_dyn(),
            tensor.view().to_owned().permuted_axes(vec![2, 0, 1]).into_dyn(),
            tensor.view().to_owned().slice_move(s![1.., .., 2..2]).into_dyn(),
            tensor.view().to_owned().slice_move(s![1..;-1, 2, ..;-3]).into_dyn(),
        ] {
            let (shown, strides) = (turned.clone(), turned.strides().to_vec());
            let tensor = Tensor::from(turned);
            assert_eq!(tensor.view(), shown.view());
            assert_eq!(tensor.as_slice(), shown.iter().copied().collect::<Vec<_>>());
            if !tensor.is_empty() {
                let stays = |(&a, (&b, &extent)): (&isize, (&isize, &usize))| a == b || extent == 1;
                assert!(strides.iter().zip(tensor.layout().strides().iter().zip(tensor.shape())).all(stays));
            }
            assert_eq!(tensor.into_array(), shown);
        }
    }

    #[test]
    fn a_part_of_a_vector_is_shown_alone() {
        let part = Array::from_shape_fn((2, 3), |(i, j)| (3 * i + j) as f32).slice_move(s![1.., ..]);
        let mut part = Tensor::from(part);
        assert_eq!(part.as_slice(), [3.0, 4.0, 5.0]);
        part.as_mut_slice()[0] = 9.0;
        assert_eq!(part.into_array().into_raw_vec_and_offset().0, [9.0, 4.0, 5.0]);
    }

    #[test]
    fn numbers_are_shown_in_their_axes() {
        let x = Tensor::from_vec(&[2, 2], vec![1.0, -2.5, 0.125, 4.0_f64]);
        assert_eq!(format!("{x:.1}"), "[[1.0, -2.5],\n [0.1, 4.0]]");
        assert_eq!(format!("{:?}", x.t().slice(crate::s![0])), "Tensor<f64>[2] [1, 0.125]");
    }
}
