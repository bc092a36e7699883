//! Rearrangements that copy elements, and assignment to slices: split, tile, repeat, roll, gather, assign.

use crate::layout::checked_len;
use crate::{Indices, Layout, Scalar, Shape, SliceInfoElem, Tensor, axis_of, concat, find_axis};
use std::ops::{IndexMut, Range};

/// The shapes of [`Tensor::tile`]: the shape to view the tensor in, the shape to broadcast that to, and the shape of
/// the result. Missing counts in front are 1, and more counts than axes add leading axes.
///
/// # Errors
/// If there would be more elements than memory can hold.
pub fn tiled(shape: &[usize], counts: &[usize]) -> Result<[Shape; 3], String> {
    let ndim = shape.len().max(counts.len());
    let padded =
        |list: &[usize]| std::iter::repeat_n(1, ndim - list.len()).chain(list.iter().copied()).collect::<Shape>();
    let (extents, counts) = (padded(shape), padded(counts));
    let of = |f: &dyn Fn(usize) -> [usize; 2]| (0..ndim).flat_map(f).collect::<Shape>();
    within_memory(of(&|i| [1, extents[i]]), of(&|i| [counts[i], extents[i]]), |wide| {
        wide.chunks_exact(2).map(|pair| pair[0] * pair[1]).collect()
    })
}

/// The shapes of [`Tensor::repeat`], as those of [`tiled`].
///
/// # Errors
/// If the axis does not exist, or there would be more elements than memory can hold.
pub fn repeated(shape: &[usize], axis: isize, count: usize) -> Result<[Shape; 3], String> {
    let axis = find_axis(axis, shape)?;
    let [mut narrow, mut wide] = [(); 2].map(|()| Shape::from_slice(shape));
    narrow.insert(axis + 1, 1);
    wide.insert(axis + 1, count);
    within_memory(narrow, wide, |wide| {
        let mut out = Shape::from_slice(shape);
        out[axis] *= wide[axis + 1];
        out
    })
}

fn within_memory(narrow: Shape, wide: Shape, out: impl FnOnce(&[usize]) -> Shape) -> Result<[Shape; 3], String> {
    if checked_len(&wide).is_none() {
        return Err(format!("{:?} times {:?} is more than memory holds", &wide[..], &narrow[..]));
    }
    let out = out(&wide);
    Ok([narrow, wide, out])
}

/// The ranges of consecutive parts of an axis.
///
/// # Errors
/// If the axis does not exist, or the sum of the extents is not its extent.
pub fn split_places(shape: &[usize], axis: isize, extents: &[usize]) -> Result<Vec<Range<usize>>, String> {
    let extent = shape[find_axis(axis, shape)?];
    if extents.iter().try_fold(0_usize, |total, &len| total.checked_add(len)) != Some(extent) {
        return Err(format!("{extents:?} are not {extent} together"));
    }
    let mut end = 0;
    let part = |&len: &usize| {
        end += len;
        end - len..end
    };
    Ok(extents.iter().map(part).collect())
}

impl<T: Scalar> Tensor<T> {
    /// Splits along `axis` into consecutive parts of these extents, as views (`torch.split`).
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// let [a, b] = Tensor::from([1.0, 2.0, 3.0]).split(0, &[2, 1]).try_into().unwrap();
    /// assert_eq!((a, b), (Tensor::from([1.0, 2.0]), Tensor::from([3.0])));
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist, or the sum of the extents is not its extent.
    #[track_caller]
    pub fn split(&self, axis: isize, extents: &[usize]) -> Vec<Self> {
        match split_places(self.shape(), axis, extents) {
            Ok(places) => places.into_iter().map(|place| self.slice_axis(axis, place)).collect(),
            Err(what) => panic!("split of a tensor of shape {:?}: {what}", self.shape()),
        }
    }

    /// Repeats the whole tensor `counts[i]` times along each axis `i` (`numpy.tile`, `torch.Tensor.repeat`). More
    /// counts than axes add leading axes; fewer leave the leading axes unchanged.
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// assert_eq!(Tensor::from([1.0, 2.0]).tile(&[2, 2]), Tensor::from([[1.0, 2.0, 1.0, 2.0], [1.0, 2.0, 1.0, 2.0]]));
    /// ```
    ///
    /// # Panics
    /// If there would be more elements than memory can hold.
    #[track_caller]
    pub fn tile(&self, counts: &[usize]) -> Self {
        self.spread("tile", tiled(self.shape(), counts))
    }

    /// Repeats each entry along `axis` `count` times (`numpy.repeat`, `torch.repeat_interleave`).
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// assert_eq!(Tensor::from([1.0, 2.0]).repeat(0, 2), Tensor::from([1.0, 1.0, 2.0, 2.0]));
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist, or there would be more elements than memory can hold.
    #[track_caller]
    pub fn repeat(&self, axis: isize, count: usize) -> Self {
        self.spread("repeat", repeated(self.shape(), axis, count))
    }

    #[track_caller]
    fn spread(&self, what: &str, shapes: Result<[Shape; 3], String>) -> Self {
        match shapes {
            Ok([narrow, wide, shape]) => self.reshape(&narrow).broadcast_to(&wide).reshape(&shape),
            Err(error) => panic!("{what} of a tensor of shape {:?}: {error}", self.shape()),
        }
    }

    /// Rotates the entries along `axis` by `shift` places towards the end. Entries that leave at the end enter at the
    /// start. (`numpy.roll` and `torch.roll` take the shift first.)
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// assert_eq!(Tensor::from([1.0, 2.0, 3.0]).roll(0, 1), Tensor::from([3.0, 1.0, 2.0]));
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn roll(&self, axis: isize, shift: isize) -> Self {
        let axis = axis_of(axis, self.shape());
        let extent = self.shape()[axis].max(1) as isize;
        let shift = shift.rem_euclid(extent);
        if shift == 0 {
            return self.clone();
        }
        let [head, tail] = [(0, extent - shift), (extent - shift, extent)];
        let part = |(start, end)| self.slice_axis(axis as isize, start..end);
        concat(&[&part(tail), &part(head)], axis, &self.pool())
    }

    /// Selects elements by index along `axis` (`numpy.take_along_axis`, `torch.gather`): `y[i][j] = x[index[i][j]][j]`
    /// for axis 0 of two. `index` has the extents of this tensor in all other axes.
    ///
    /// ```
    /// use raygrad_tensor::{Indices, Tensor};
    /// let x = Tensor::from([[3.0, 1.0, 2.0], [4.0, 6.0, 5.0]]);
    /// assert_eq!(x.gather(1, x.argsort(-1, false)), Tensor::from([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]));
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist, other extents differ, or an index is not below the extent of the axis.
    #[track_caller]
    pub fn gather(&self, axis: isize, index: impl Into<Indices>) -> Self {
        let (axis, index) = (axis_of(axis, self.shape()), index.into());
        let same = |i: usize| i == axis || index.shape()[i] == self.shape()[i];
        let fits = index.shape().len() == self.ndim() && (0..self.ndim()).all(same);
        assert!(fits, "gather along axis {axis} of {:?} by indices of {:?}", self.shape(), index.shape());
        let (extent, count) = (self.shape()[axis], index.shape()[axis]);
        let inner: usize = self.shape()[axis + 1..].iter().product();
        let x = self.as_slice();
        if let Some(place) = index.as_slice().iter().position(|&entry| entry as usize >= extent) {
            panic!("gather: index {place} is {}, but axis {axis} ends at {extent}", index.as_slice()[place])
        }
        let element = |(place, &entry): (usize, &u32)| {
            x[(place / (count * inner) * extent + entry as usize) * inner + place % inner]
        };
        Tensor::from_vec(index.shape(), index.as_slice().iter().enumerate().map(element).collect())
    }

    /// Assigns `values` to the elements of a slice, as `x[:, 1:3] = values` in NumPy. The values broadcast.
    ///
    /// ```
    /// use raygrad_tensor::{Tensor, s};
    /// let mut x = Tensor::zeros(&[2, 3]);
    /// x.assign(s![.., 1..], &Tensor::from([1.0, 2.0]));
    /// x.assign(s![1, ..;2], 9.0);
    /// assert_eq!(x, Tensor::from([[0.0, 1.0, 2.0], [9.0, 1.0, 9.0]]));
    /// ```
    ///
    /// # Panics
    /// If a position is outside the tensor, or the values do not broadcast to the shape of the slice.
    #[track_caller]
    pub fn assign(&mut self, places: impl AsRef<[SliceInfoElem]>, values: impl Into<Tensor<T>>) {
        let layout = match Layout::contiguous(self.shape()).sliced_by(places.as_ref()) {
            Ok(layout) => layout,
            Err(what) => panic!("assign to a tensor of shape {:?}: {what}", self.shape()),
        };
        let values = values.into().broadcast_to(layout.shape());
        layout.write(values.as_slice(), self.as_mut_slice());
    }
}

impl<T: Scalar, const N: usize> IndexMut<[usize; N]> for Tensor<T> {
    /// Borrows one element for writing: `x[[i, j]] = 1.0`. Shared elements are copied first.
    ///
    /// # Panics
    /// If the number of indices is not the number of axes, or an index is outside its axis.
    #[track_caller]
    fn index_mut(&mut self, index: [usize; N]) -> &mut T {
        let inside = N == self.ndim() && index.iter().zip(self.shape()).all(|(i, extent)| i < extent);
        assert!(inside, "no element {index:?} in a tensor of shape {:?}", self.shape());
        let place = index.iter().zip(self.shape()).fold(0, |place, (i, extent)| place * extent + i);
        &mut self.as_mut_slice()[place]
    }
}

impl<T: Scalar, const N: usize> PartialEq<[T; N]> for Tensor<T> {
    /// Whether this is a vector with these elements.
    fn eq(&self, other: &[T; N]) -> bool {
        self.shape() == [N] && self.as_slice() == other
    }
}

impl<T: Scalar, const N: usize> PartialEq<[T; N]> for &Tensor<T> {
    fn eq(&self, other: &[T; N]) -> bool {
        **self == *other
    }
}

impl<T: Scalar, const N: usize, const M: usize> PartialEq<[[T; M]; N]> for &Tensor<T> {
    fn eq(&self, other: &[[T; M]; N]) -> bool {
        **self == *other
    }
}

impl<T: Scalar, const N: usize, const M: usize> PartialEq<[[T; M]; N]> for Tensor<T> {
    /// Whether this is a matrix with these rows.
    fn eq(&self, other: &[[T; M]; N]) -> bool {
        self.shape() == [N, M] && self.as_slice() == other.as_flattened()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::s;
    use ndarray::{Array3, Axis};
    use std::panic::catch_unwind;

    fn counted(shape: &[usize]) -> Tensor<f64> {
        Tensor::from_fn(shape, |i| i as f64)
    }

    #[test]
    fn rearranged_elements_are_those_of_their_places() {
        let x = counted(&[3, 4, 2]).permute(&[2, 0, 1]);
        let tiled = x.tile(&[2, 1, 2, 3]);
        assert_eq!(tiled.shape(), [2, 2, 6, 12]);
        for (i, value) in tiled.iter().enumerate() {
            assert_eq!(value, x[[i / 72 % 2, i / 12 % 6 % 3, i % 12 % 4]]);
        }
        let repeated = x.repeat(-1, 3);
        assert_eq!(repeated.shape(), [2, 3, 12]);
        for (i, value) in repeated.iter().enumerate() {
            assert_eq!(value, x[[i / 36, i / 12 % 3, i % 12 / 3]]);
        }
        for shift in [-5, -1, 0, 1, 3, 7] {
            for (i, value) in x.roll(1, shift).iter().enumerate() {
                assert_eq!(value, x[[i / 12, (i as isize / 4 % 3 - shift).rem_euclid(3) as usize, i % 4]]);
            }
        }
        let parts = x.split(2, &[1, 0, 3]);
        assert_eq!(parts.iter().map(|part| part.shape()[2]).collect::<Vec<_>>(), [1, 0, 3]);
        assert_eq!(parts[2], x.slice(s![.., .., 1..]));
        assert_eq!(parts[2].buffer().as_ptr(), x.buffer().as_ptr());
        assert_eq!((x.tile(&[1, 0, 1]).shape(), x.repeat(0, 0).shape()), (&[2, 0, 4][..], &[0, 3, 4][..]));
        assert_eq!(counted(&[0]).roll(0, 3).shape(), [0]);
        assert_eq!(x.tile(&[3]), x.tile(&[1, 1, 3]));
    }

    fn said(f: impl FnOnce()) -> String {
        *catch_unwind(std::panic::AssertUnwindSafe(f)).unwrap_err().downcast::<String>().unwrap()
    }

    #[test]
    fn what_does_not_fit_is_said() {
        let x = counted(&[2, 3]);
        let expect = |f: &dyn Fn(), words: &str| assert!(said(f).contains(words), "{}", said(f));
        expect(&|| drop(x.split(1, &[1, 1])), "split of a tensor of shape [2, 3]: [1, 1] are not 3 together");
        expect(&|| drop(x.split(1, &[usize::MAX, 4])), "are not 3 together");
        expect(&|| drop(x.split(2, &[3])), "there is no axis 2");
        expect(&|| drop(x.tile(&[usize::MAX / 2, 1])), "more than memory holds");
        expect(&|| drop(x.repeat(0, usize::MAX / 2)), "more than memory holds");
        expect(&|| drop(x.repeat(-3, 2)), "there is no axis -3");
        expect(&|| drop(x.gather(0, Indices::new(&[1, 3], [0, 2, 1]))), "gather: index 1 is 2, but axis 0 ends at 2");
        expect(
            &|| drop(x.gather(0, Indices::new(&[1, 2], [0, 0]))),
            "gather along axis 0 of [2, 3] by indices of [1, 2]",
        );
        expect(&|| x.clone().assign(s![2, ..], 0.0), "assign to a tensor of shape [2, 3]");
        expect(&|| drop(x.matmul(&Tensor::from([1.0, 2.0]))), "matmul of shapes [2, 3] and [2]");
        expect(&|| drop(x.matmul(&Tensor::scalar(1.0))), "matmul of shapes [2, 3] and []");
        expect(&|| assert!(x.dot(&x) > 0.0), "not two vectors of one length");
        let (short, long) = (Tensor::from([1.0]), Tensor::from([1.0, 2.0]));
        expect(&|| assert!(short.dot(&long) > 0.0), "not two vectors of one length");
    }

    #[test]
    fn gathered_elements_are_those_of_their_index() {
        let x = counted(&[4, 3, 2]).permute(&[1, 0, 2]);
        let index = Indices::new(&[3, 5, 2], (0..30).map(|i| i * 7 % 4).collect::<Vec<u32>>());
        for (i, value) in x.gather(1, &index).iter().enumerate() {
            assert_eq!(value, x[[i / 10, i * 7 % 4, i % 2]]);
        }
        assert_eq!(counted(&[2, 0]).gather(1, Indices::new(&[2, 0], [])).shape(), [2, 0]);
        assert!(catch_unwind(|| x.gather(1, Indices::new(&[3, 1, 2], [0, 1, 2, 3, 4, 0]))).is_err());
        assert!(catch_unwind(|| x.gather(1, Indices::new(&[3, 1, 1], [0, 1, 2]))).is_err());
    }

    #[test]
    fn elements_are_put_in_place_and_only_there() {
        let mut x = counted(&[2, 3, 4]).permute(&[1, 0, 2]);
        let shared = x.clone();
        let mut array = Array3::from_shape_fn((3, 2, 4), |(i, j, k)| shared[[i, j, k]]);
        x.assign(s![..;-2, 1, 1..3], Tensor::from([[-1.0, -2.0], [-3.0, -4.0]]));
        array.slice_mut(s![..;-2, 1, 1..3]).assign(&ndarray::arr2(&[[-1.0, -2.0], [-3.0, -4.0]]));
        x.assign(s![1..2, .., 3], 7.0);
        array.slice_mut(s![1..2, .., 3]).fill(7.0);
        x[[2, 0, 0]] = 0.5;
        array[[2, 0, 0]] = 0.5;
        assert_eq!(x, Tensor::from(array.clone()));
        assert_eq!(shared, counted(&[2, 3, 4]).permute(&[1, 0, 2]));
        assert_eq!(array.index_axis(Axis(0), 2)[[0, 0]], 0.5);
        let other = x.clone();
        x.assign(s![..;-1], other.clone());
        assert_eq!(x, other.flip(0));
        for refused in [s![4, .., ..].as_ref(), s![.., .., .., 0].as_ref()] {
            let mut x = x.clone();
            assert!(catch_unwind(move || x.assign(refused, 0.0)).is_err());
        }
        let mut narrow = x.clone();
        assert!(catch_unwind(move || narrow.assign(s![.., .., ..2], Tensor::zeros(&[3]))).is_err());
        for place in [&[0_usize, 2, 0][..], &[2], &[0, 0, 0, 0]] {
            let mut x = x.clone();
            let message = said(move || match *place {
                [i] => x[[i]] = 1.0,
                [i, j, k] => x[[i, j, k]] = 1.0,
                _ => x[[0; 4]] = 1.0,
            });
            assert!(message.starts_with("no element"), "{message}");
        }
    }

    #[test]
    fn a_tensor_equals_a_list_of_its_shape() {
        let x = counted(&[2, 2]);
        assert!(x == [[0.0, 1.0], [2.0, 3.0]] && x.t() == [[0.0, 2.0], [1.0, 3.0]]);
        assert!(
            x != [[0.0, 1.0, 2.0, 3.0]]
                && x != [[0.0], [1.0], [2.0], [3.0]]
                && x.reshape(&[4]) != [[0.0, 1.0], [2.0, 3.0]]
        );
        assert!(x != [[0.0, 1.0], [2.0, 4.0]] && x != [0.0, 1.0, 2.0, 3.0] && x.reshape(&[4]) == [0.0, 1.0, 2.0, 3.0]);
        let (matrix, vector) = (&x, &x.reshape(&[4]));
        assert!(matrix == [[0.0, 1.0], [2.0, 3.0]] && matrix != [[0.0, 1.0], [2.0, 4.0]]);
        assert!(vector == [0.0, 1.0, 2.0, 3.0] && vector != [0.0; 4]);
        let [one, nan] = [Tensor::scalar(1.0), Tensor::from([f64::NAN])];
        assert!(one != [1.0] && nan != [f64::NAN]);
    }
}
