//! Boolean arrays: results of comparisons, and selections of elements.

use crate::fused::Part;
use crate::layout::checked_len;
use crate::parallel::{ELEMENT, PIECE, chunks};
use crate::{Indices, Layout, Pool, Scalar, Shape, Tensor, axis_of, broadcast_shape, simd};
use std::fmt;
use std::ops::{BitAnd, BitOr, BitXor, Not};
use std::sync::Arc;

/// A boolean array in row-major order. Cloning copies a reference.
///
/// ```
/// use raygrad_tensor::Tensor;
/// let x = Tensor::from([3.0, -1.0, 0.5]);
/// let inside = x.gt(0.0) & x.lt(2.0);
/// assert_eq!((inside.as_slice(), inside.count()), (&[false, false, true][..], 1));
/// assert_eq!(x.where_(&inside, 9.0), Tensor::from([9.0, 9.0, 0.5]));
/// assert_eq!(x.masked_select(&!inside), Tensor::from([3.0, -1.0]));
/// ```
#[derive(Clone, PartialEq, Eq)]
pub struct Mask {
    shape: Shape,
    values: Arc<Vec<bool>>,
}

impl Mask {
    /// A mask of this shape, from values in row-major order.
    ///
    /// # Panics
    /// If the number of values is not the product of the shape.
    #[track_caller]
    pub fn new(shape: &[usize], values: impl Into<Vec<bool>>) -> Self {
        let values = Arc::new(values.into());
        assert_eq!(checked_len(shape), Some(values.len()), "{} values for a mask of shape {shape:?}", values.len());
        Mask { shape: Shape::from_slice(shape), values }
    }

    /// The extent of each axis.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// The values in row-major order.
    pub fn as_slice(&self) -> &[bool] {
        &self.values
    }

    /// Number of true values.
    pub fn count(&self) -> usize {
        self.values.iter().filter(|&&x| x).count()
    }

    /// Whether at least one value is true; false for an empty mask.
    pub fn any(&self) -> bool {
        self.values.contains(&true)
    }

    /// Whether all values are true; true for an empty mask.
    pub fn all(&self) -> bool {
        !self.values.contains(&false)
    }

    /// The row-major positions of the true values: `[count]`.
    ///
    /// # Panics
    /// If there are more than 2^32 elements.
    #[track_caller]
    pub fn flatnonzero(&self) -> Indices {
        let places: Vec<u32> = (0..self.values.len()).filter(|&i| self.values[i]).map(crate::indices::index).collect();
        Indices::new(&[places.len()], places)
    }

    /// The mask as numbers: 1 where it is true, 0 elsewhere.
    pub fn cast<T: Scalar>(&self) -> Tensor<T> {
        let mut numbers = vec![T::ZERO; self.values.len()];
        chunks(&mut numbers, PIECE, self.values.len() * ELEMENT, || (), &|(), i, numbers| {
            let pairs = numbers.iter_mut().zip(&self.values[i * PIECE..]);
            pairs.for_each(|(number, &x)| *number = if x { T::ONE } else { T::ZERO });
        });
        Tensor::from_vec(&self.shape, numbers)
    }

    /// Broadcasts the mask to `shape`, with NumPy's rules.
    ///
    /// # Panics
    /// If the mask does not broadcast to `shape`.
    #[track_caller]
    pub fn broadcast_to(&self, shape: &[usize]) -> Mask {
        if self.shape() == shape {
            return self.clone();
        }
        let layout = Layout::contiguous(&self.shape).stretched(shape);
        let mut values = vec![false; layout.len()];
        layout.read_range(&self.values, 0, &mut values);
        Mask::new(shape, values)
    }

    #[track_caller]
    fn join(&self, other: &Mask, f: impl Fn(bool, bool) -> bool) -> Mask {
        let Some(shape) = broadcast_shape(&[self.shape(), other.shape()]) else {
            panic!("masks of shapes {:?} and {:?} do not broadcast", self.shape, other.shape)
        };
        let (a, b) = (self.broadcast_to(&shape), other.broadcast_to(&shape));
        Mask::new(&shape, a.values.iter().zip(&*b.values).map(|(&a, &b)| f(a, b)).collect::<Vec<_>>())
    }
}

macro_rules! operator {
    ($trait:ident $method:ident $op:tt) => {
        impl $trait for &Mask {
            type Output = Mask;
            /// # Panics
            /// If the shapes do not broadcast.
            #[track_caller]
            fn $method(self, other: &Mask) -> Mask {
                self.join(other, |a, b| a $op b)
            }
        }
        operator!(forward $trait $method Mask, Mask, |a, b| &a $op &b);
        operator!(forward $trait $method &Mask, Mask, |a, b| a $op &b);
        operator!(forward $trait $method Mask, &Mask, |a, b| &a $op b);
    };
    (forward $trait:ident $method:ident $left:ty, $right:ty, |$a:ident, $b:ident| $result:expr) => {
        impl $trait<$right> for $left {
            type Output = Mask;
            /// # Panics
            /// If the shapes do not broadcast.
            #[track_caller]
            fn $method(self, $b: $right) -> Mask {
                let $a = self;
                $result
            }
        }
    };
}

operator!(BitAnd bitand &);
operator!(BitOr bitor |);
operator!(BitXor bitxor ^);

impl Not for &Mask {
    type Output = Mask;
    fn not(self) -> Mask {
        Mask::new(&self.shape, self.values.iter().map(|&x| !x).collect::<Vec<_>>())
    }
}

impl Not for Mask {
    type Output = Mask;
    fn not(self) -> Mask {
        !&self
    }
}

impl<const N: usize> PartialEq<[bool; N]> for Mask {
    /// Whether this is a vector with these values.
    fn eq(&self, other: &[bool; N]) -> bool {
        self.shape() == [N] && self.as_slice() == other
    }
}

impl fmt::Debug for Mask {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Mask{:?} {:?}", self.shape, self.values)
    }
}

/// The elements of `yes` where `mask` is true, and those of `no` elsewhere; see [`Tensor::where_`].
///
/// # Panics
/// If the shapes do not broadcast.
#[track_caller]
pub fn choose<T: Scalar>(mask: &Mask, yes: &Tensor<T>, no: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
    let shapes = [mask.shape(), yes.shape(), no.shape()];
    let Some(shape) = broadcast_shape(&shapes) else { panic!("shapes {shapes:?} do not broadcast") };
    let mask = mask.broadcast_to(&shape);
    let layouts = [yes, no].map(|x| x.layout().stretched(&shape));
    let [yes, no] = [Part::of(yes.buffer(), &layouts[0]), Part::of(no.buffer(), &layouts[1])];
    pool.filled(&shape, |out| {
        let width = PIECE.min(out.len());
        let scratch = || [&yes, &no].map(|part| part.scratch(width, &Pool::none()));
        chunks(out, PIECE, mask.values.len() * ELEMENT, scratch, &|[first, second]: &mut [Vec<T>; 2], i, out| {
            let (start, n) = (i * PIECE, out.len());
            let (mask, yes, no) = (&mask.values[start..][..n], yes.cut(start, n, first), no.cut(start, n, second));
            simd::dispatch(
                #[inline(always)]
                || {
                    for ((out, &mask), (&yes, &no)) in out.iter_mut().zip(mask).zip(yes.iter().zip(no)) {
                        *out = if mask { yes } else { no };
                    }
                },
            );
        });
    })
}

impl<T: Scalar> Tensor<T> {
    #[track_caller]
    fn compare(&self, other: &Self, f: impl Fn(T, T) -> bool + Sync) -> Mask {
        let Some(shape) = broadcast_shape(&[self.shape(), other.shape()]) else {
            panic!("shapes {:?} and {:?} do not broadcast", self.shape(), other.shape())
        };
        let mut holds = vec![false; crate::layout::len_of(&shape)];
        let work = holds.len() * ELEMENT;
        let a = self.broadcast_to(&shape);
        let a = a.as_slice();
        // A number is not spread out first.
        if let [b] = *other.buffer() {
            chunks(&mut holds, PIECE, work, || (), &|(), i, holds| {
                holds.iter_mut().zip(&a[i * PIECE..]).for_each(|(holds, &a)| *holds = f(a, b));
            });
            return Mask::new(&shape, holds);
        }
        let b = other.broadcast_to(&shape);
        let b = b.as_slice();
        chunks(&mut holds, PIECE, work, || (), &|(), i, holds| {
            let pairs = a[i * PIECE..].iter().zip(&b[i * PIECE..]);
            holds.iter_mut().zip(pairs).for_each(|(holds, (&a, &b))| *holds = f(a, b));
        });
        Mask::new(&shape, holds)
    }

    /// Where elements are less than those of `other`, a tensor or a number.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn lt(&self, other: impl Into<Tensor<T>>) -> Mask {
        self.compare(&other.into(), |a, b| a < b)
    }

    /// Where elements are at most those of `other`, a tensor or a number.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn le(&self, other: impl Into<Tensor<T>>) -> Mask {
        self.compare(&other.into(), |a, b| a <= b)
    }

    /// Where elements are greater than those of `other`, a tensor or a number.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn gt(&self, other: impl Into<Tensor<T>>) -> Mask {
        self.compare(&other.into(), |a, b| a > b)
    }

    /// Where elements are at least those of `other`, a tensor or a number.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn ge(&self, other: impl Into<Tensor<T>>) -> Mask {
        self.compare(&other.into(), |a, b| a >= b)
    }

    /// Where elements equal those of `other`, a tensor or a number. NaN equals no number.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn elementwise_eq(&self, other: impl Into<Tensor<T>>) -> Mask {
        self.compare(&other.into(), |a, b| a == b)
    }

    /// Where elements are NaN.
    pub fn is_nan(&self) -> Mask {
        !self.elementwise_eq(self)
    }

    /// The elements where `mask` is true, and those of `other` elsewhere (`numpy.where`, `torch.where`; `where` is a
    /// Rust keyword). All three broadcast together.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn where_(&self, mask: &Mask, other: impl Into<Tensor<T>>) -> Self {
        choose(mask, self, &other.into(), &self.pool())
    }

    /// The elements where a mask is true, in row-major order: `[count]` (`x[mask]` in NumPy, `torch.masked_select`).
    ///
    /// # Panics
    /// If the mask has another shape.
    #[track_caller]
    pub fn masked_select(&self, mask: &Mask) -> Self {
        assert_eq!(self.shape(), mask.shape(), "a mask of another shape");
        let mut kept = Vec::with_capacity(mask.count());
        kept.extend(self.iter().zip(mask.as_slice()).filter(|(_, keep)| **keep).map(|(x, _)| x));
        Tensor::from_vec(&[kept.len()], kept)
    }

    /// Selects entries along `axis` by index (`numpy.take`). The axes of `index` replace `axis`.
    ///
    /// ```
    /// use raygrad_tensor::{Indices, Tensor};
    /// let x = Tensor::from([[1.0, 2.0], [3.0, 4.0]]);
    /// assert_eq!(x.take(0, &Indices::new(&[3], [1, 0, 1])), Tensor::from([[3.0, 4.0], [1.0, 2.0], [3.0, 4.0]]));
    /// ```
    ///
    /// # Panics
    /// If the axis does not exist, or an index is not below its extent.
    #[track_caller]
    pub fn take(&self, axis: isize, index: impl Into<Indices>) -> Self {
        let index = index.into();
        let axis = axis_of(axis, self.shape());
        let (extent, inner) = (self.shape()[axis], self.shape()[axis + 1..].iter().product::<usize>());
        if let Some(place) = index.as_slice().iter().position(|&i| i as usize >= extent) {
            let number = index.as_slice()[place];
            panic!(
                "take: index {place} is {number}, but axis {axis} of a tensor of shape {:?} ends before",
                self.shape()
            )
        }
        let mut shape = Shape::from_slice(&self.shape()[..axis]);
        shape.extend_from_slice(index.shape());
        shape.extend_from_slice(&self.shape()[axis + 1..]);
        let mut values = Vec::with_capacity(shape.iter().product());
        for block in self.as_slice().chunks_exact((extent * inner).max(1)) {
            for &i in index.as_slice() {
                values.extend_from_slice(&block[i as usize * inner..][..inner]);
            }
        }
        Tensor::from_vec(&shape, values)
    }

    /// The elements as indices.
    ///
    /// # Panics
    /// If an element is not a whole number from 0 to 2^32 - 1.
    #[track_caller]
    pub fn to_indices(&self) -> Indices {
        let whole = |x: T| {
            let value = x.to_f64();
            assert!(value.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&value), "{x} is no index");
            value as u32
        };
        Indices::new(self.shape(), self.iter().map(whole).collect::<Vec<_>>())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn comparisons_broadcast_and_masks_join() {
        let x = Tensor::from([[1.0, 2.0], [3.0, f64::NAN]]);
        let row = Tensor::from([2.0, 2.0]);
        let is = |mask: Mask, values: [bool; 4]| assert_eq!(mask.as_slice(), values);
        is(x.lt(&row), [true, false, false, false]);
        is(x.le(&row), [true, true, false, false]);
        is(x.gt(&row), [false, false, true, false]);
        is(x.ge(2.0), [false, true, true, false]);
        is(x.elementwise_eq(x.t()), [true, false, false, false]);
        is(x.is_nan(), [false, false, false, true]);
        is(x.gt(1.5) & x.lt(2.5), [false, true, false, false]);
        is(&x.gt(2.5) | &x.lt(1.5), [true, false, true, false]);
        is(x.gt(1.5) ^ x.gt(2.5), [false, true, false, false]);
        is(&x.gt(1.5) & x.lt(2.5), [false, true, false, false]);
        is(x.gt(2.5) | &x.lt(1.5), [true, false, true, false]);
        assert!(x.gt(1.5) != [false, true, true, false] && row.gt(1.5) == [true, true]);
        assert!(x.is_nan().any() && !x.is_nan().all() && Mask::new(&[0], []).all() && !Mask::new(&[0], []).any());
        assert_eq!((x.gt(1.5).count(), x.gt(1.5).flatnonzero().as_slice()), (2, &[1, 2][..]));
        assert_eq!(x.gt(1.5).cast::<f32>(), Tensor::from([[0.0, 1.0], [1.0, 0.0]]));
        assert_eq!(row.where_(&x.is_nan(), &x), Tensor::from([[1.0, 2.0], [3.0, 2.0]]));
        assert_eq!(x.t().masked_select(&x.t().gt(0.0)), Tensor::from([1.0, 3.0, 2.0]));
    }

    #[test]
    fn large_comparisons_are_those_of_their_elements() {
        let n = 200_003;
        let a = Tensor::<f32>::from_fn(&[n], |i| ((i * 7919) % n) as f32);
        let b = Tensor::<f32>::from_fn(&[n], |i| ((i * 104_729) % n) as f32);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        let same = |mask: Mask, expected: &dyn Fn(usize) -> bool| {
            assert!(mask.as_slice().iter().enumerate().all(|(i, &holds)| holds == expected(i)));
            let numbers = pool.install(|| mask.cast::<f64>());
            assert!(numbers.iter().enumerate().all(|(i, x)| x == f64::from(u8::from(expected(i)))));
        };
        pool.install(|| {
            same(a.lt(&b), &|i| a[[i]] < b[[i]]);
            same(a.ge(50_000.0), &|i| a[[i]] >= 50_000.0);
            let (column, row) =
                (Tensor::<f32>::arange(0.0, 901.0, 1.0).reshape(&[901, 1]), Tensor::arange(0.0, 307.0, 2.0));
            same(column.gt(&row), &|i| (i / 154) as f32 > 2.0 * (i % 154) as f32);
            same(a.flip(0).le(&b), &|i| a[[n - 1 - i]] <= b[[i]]);
        });
        let chosen = a.where_(&a.lt(&b), &b);
        assert!((0..n).all(|i| chosen[[i]] == a[[i]].min(b[[i]])));
    }

    #[test]
    fn masks_broadcast() {
        let (column, row) = (Mask::new(&[2, 1], [true, false]), Mask::new(&[3], [true, false, true]));
        assert_eq!(&column & &row, Mask::new(&[2, 3], [true, false, true, false, false, false]));
        assert_eq!(column.broadcast_to(&[2, 2, 2]).as_slice(), [true, true, false, false].repeat(2));
        let refused = std::panic::catch_unwind(|| column | Mask::new(&[3, 2], [true; 6]));
        let message = *refused.unwrap_err().downcast::<String>().unwrap();
        assert_eq!(message, "masks of shapes [2, 1] and [3, 2] do not broadcast");
    }

    #[test]
    fn select_large_views_equals_elements() {
        let shape = [501, 403];
        let at = |i: usize| [i / 403, i % 403];
        let x = Tensor::<f64>::from_fn(&[403, 501], |i| i as f64);
        let (yes, no) = (x.t(), Tensor::<f64>::from_fn(&[501, 1], |i| -(i as f64)));
        let (whole, row) = (yes.gt(60_000.0), Mask::new(&[403], (0..403).map(|j| j % 3 == 0).collect::<Vec<_>>()));
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        for mask in [&whole, &row] {
            for (yes, no) in [(&yes, &no), (&no, &yes), (&yes, &Tensor::scalar(0.5))] {
                let chosen = pool.install(|| yes.where_(mask, no));
                assert_eq!(chosen.shape(), shape);
                let [mask, yes, no] = [mask.cast(), yes.clone(), no.clone()].map(|x| x.broadcast_to(&shape));
                for (i, value) in chosen.iter().enumerate() {
                    assert_eq!(value, if mask[at(i)] == 1.0 { yes[at(i)] } else { no[at(i)] });
                }
            }
        }
        assert_eq!(yes.where_(&Mask::new(&[0, 1, 403], []), &no).shape(), [0, 501, 403]);
    }

    #[test]
    #[should_panic(expected = "values for a mask of shape")]
    fn a_mask_has_a_value_for_each_place() {
        Mask::new(&[3], [true, false]);
    }

    #[test]
    fn entries_are_taken_along_any_axis() {
        let x = Tensor::<f64>::arange(0.0, 24.0, 1.0).reshape(&[2, 3, 4]);
        let index = Indices::new(&[2, 2], [2, 0, 1, 1]);
        for (axis, shape) in [(1, [2, 2, 2, 4]), (-1, [2, 3, 2, 2])] {
            let (taken, own) = (x.take(axis, &index), axis_of(axis, x.shape()));
            assert_eq!(taken.shape(), shape);
            for (i, value) in taken.iter().enumerate() {
                let at = ndarray::indices(shape).into_iter().nth(i).unwrap();
                let at = [at.0, at.1, at.2, at.3];
                let number = index.as_slice()[2 * at[own] + at[own + 1]] as usize;
                let expected = if own == 1 { x[[at[0], number, at[3]]] } else { x[[at[0], at[1], number]] };
                assert_eq!(value, expected);
            }
        }
        assert!(std::panic::catch_unwind(|| x.take(0, &index)).is_err());
        assert_eq!(Tensor::<f32>::from(&index).to_indices(), index);
        assert!(std::panic::catch_unwind(|| Tensor::from([0.5]).to_indices()).is_err());
        assert!(std::panic::catch_unwind(|| Tensor::from([-1.0]).to_indices()).is_err());
        assert!(x.slice(crate::s![..0]).take(1, &index).is_empty());
    }
}
