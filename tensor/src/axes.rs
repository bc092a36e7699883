//! The axes of a reduction.

use crate::Shape;
use smallvec::SmallVec;
use std::ops::RangeFull;

/// The axes of a reduction: one (`-1`), several (`[0, -1]`), or all (`..`). Negative axes count from the last one.
///
/// Reduced axes are removed from the shape. With [`keepdims`](Self::keepdims) they stay with extent 1, so that the
/// result broadcasts against the input.
///
/// ```
/// use raygrad_tensor::{Axes, Tensor};
/// let x = Tensor::<f32>::ones(&[2, 3, 4]);
/// assert_eq!(x.sum_over(-1).shape(), [2, 3]);
/// assert_eq!(x.sum_over([0, -1]).shape(), [3]);
/// assert!(x.max_over(..).shape().is_empty());
/// assert_eq!(x.var_over(Axes::from(1).keepdims(), 1).shape(), [2, 1, 4]);
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Axes {
    /// None for all.
    axes: Option<SmallVec<[isize; 4]>>,
    keepdims: bool,
}

impl Axes {
    /// The same axes, kept in the shape of the result with extent 1.
    pub fn keepdims(self) -> Self {
        Axes { keepdims: true, ..self }
    }

    /// Resolves the axes for a tensor of this shape.
    ///
    /// # Errors
    /// If an axis does not exist or is listed twice.
    pub fn find(&self, shape: &[usize]) -> Result<Reduction, String> {
        let mut reduced: SmallVec<[bool; 4]> = SmallVec::from_elem(self.axes.is_none(), shape.len());
        for &axis in self.axes.iter().flatten() {
            let i = find_axis(axis, shape)?;
            if reduced[i] {
                return Err(format!("axis {axis} of a tensor of shape {shape:?} is named twice"));
            }
            reduced[i] = true;
        }
        Ok(Reduction { shape: Shape::from_slice(shape), reduced, keepdims: self.keepdims })
    }

    /// As [`find`](Self::find), with a panic instead of an error.
    ///
    /// # Panics
    /// If an axis does not exist or is listed twice.
    #[track_caller]
    pub fn resolve(&self, shape: &[usize]) -> Reduction {
        match self.find(shape) {
            Ok(reduction) => reduction,
            Err(what) => panic!("{what}"),
        }
    }
}

/// The index of an axis; negative numbers count from the last one, which is -1.
///
/// # Errors
/// If the axis does not exist.
pub fn find_axis(axis: isize, shape: &[usize]) -> Result<usize, String> {
    let from_start = if axis < 0 { axis.wrapping_add(shape.len() as isize) } else { axis };
    if (0..shape.len() as isize).contains(&from_start) {
        return Ok(from_start as usize);
    }
    Err(format!("there is no axis {axis} in a tensor of shape {shape:?}"))
}

/// As [`find_axis`], with a panic instead of an error.
///
/// # Panics
/// If the axis does not exist.
#[track_caller]
pub fn axis_of(axis: isize, shape: &[usize]) -> usize {
    match find_axis(axis, shape) {
        Ok(axis) => axis,
        Err(what) => panic!("{what}"),
    }
}

impl From<isize> for Axes {
    fn from(axis: isize) -> Self {
        Axes::from([axis])
    }
}

// A number in the code is one of these.
impl From<i32> for Axes {
    fn from(axis: i32) -> Self {
        Axes::from([axis as isize])
    }
}

impl From<usize> for Axes {
    fn from(axis: usize) -> Self {
        // No tensor has the largest axis.
        Axes::from([isize::try_from(axis).unwrap_or(isize::MAX)])
    }
}

impl<const N: usize> From<&[isize; N]> for Axes {
    fn from(axes: &[isize; N]) -> Self {
        Axes::from(&axes[..])
    }
}

impl<const N: usize> From<[isize; N]> for Axes {
    fn from(axes: [isize; N]) -> Self {
        Axes::from(&axes[..])
    }
}

impl From<&[isize]> for Axes {
    fn from(axes: &[isize]) -> Self {
        Axes { axes: Some(SmallVec::from_slice(axes)), keepdims: false }
    }
}

impl From<RangeFull> for Axes {
    fn from(_: RangeFull) -> Self {
        Axes { axes: None, keepdims: false }
    }
}

/// The axes of a reduction of a tensor of known shape.
#[derive(Debug, Clone)]
pub struct Reduction {
    shape: Shape,
    reduced: SmallVec<[bool; 4]>,
    keepdims: bool,
}

impl Reduction {
    /// The shape of the result if all reduced axes stay with extent 1.
    pub fn kept(&self) -> Shape {
        self.shape.iter().zip(&self.reduced).map(|(&extent, &reduced)| if reduced { 1 } else { extent }).collect()
    }

    /// The shape of the result.
    pub fn result(&self) -> Shape {
        if self.keepdims {
            return self.kept();
        }
        self.shape.iter().zip(&self.reduced).filter(|(_, reduced)| !**reduced).map(|(&extent, _)| extent).collect()
    }

    /// Number of elements that are reduced to one.
    pub fn count(&self) -> usize {
        self.shape.iter().zip(&self.reduced).filter(|(_, reduced)| **reduced).map(|(&extent, _)| extent).product()
    }

    /// The range `(first, end)` of axes that holds all reduced ones, if the axes between are all reduced or have extent
    /// 1. `None` if they are not adjacent.
    pub fn run(&self) -> Option<(usize, usize)> {
        let Some(first) = self.reduced.iter().position(|&reduced| reduced) else { return Some((0, 0)) };
        let behind = self.reduced.iter().rposition(|&reduced| reduced)? + 1;
        let dense = (first..behind).all(|axis| self.reduced[axis] || self.shape[axis] == 1);
        dense.then_some((first, behind))
    }

    /// The order of axes with the reduced ones last.
    pub fn reduced_last(&self) -> SmallVec<[usize; 4]> {
        let of = |wanted: bool| (0..self.shape.len()).filter(move |&axis| self.reduced[axis] == wanted);
        of(false).chain(of(true)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_beyond_the_largest_number_do_not_exist() {
        assert!(Axes::from(usize::MAX).find(&[2, 3]).is_err());
    }

    #[test]
    fn axes_count_from_either_end() {
        let shape = [2, 3, 4];
        let resolved = Axes::from([-1, 0]).resolve(&shape);
        assert_eq!((resolved.result().as_slice(), resolved.count()), (&[3][..], 8));
        assert_eq!(resolved.kept().as_slice(), [1, 3, 1]);
        assert_eq!((resolved.run(), resolved.reduced_last().as_slice()), (None, &[1, 0, 2][..]));
        assert_eq!(Axes::from([1, 2]).resolve(&shape).run(), Some((1, 3)));
        assert_eq!(Axes::from([0, 2]).resolve(&[2, 1, 4]).run(), Some((0, 3)));
        assert_eq!(Axes::from(..).keepdims().resolve(&shape).result().as_slice(), [1, 1, 1]);
        assert_eq!(Axes::from([]).resolve(&shape).count(), 1);
        assert_eq!(Axes::from(..).resolve(&[]).count(), 1);
    }

    #[test]
    #[should_panic(expected = "no axis 3 in a tensor of shape [2, 3, 4]")]
    fn an_axis_that_does_not_exist_panics() {
        Axes::from(3).resolve(&[2, 3, 4]);
    }

    #[test]
    #[should_panic(expected = "named twice")]
    fn an_axis_named_twice_panics() {
        Axes::from([0, -3]).resolve(&[2, 3, 4]);
    }
}
