//! Arithmetic and elementwise functions of tensors, with NumPy's broadcasting.

use crate::parallel::{ELEMENT, chunks};
use crate::{Real, Scalar, Tensor, map, map_real, simd};
use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, DivAssign, Index, Mul, MulAssign, Neg, Sub, SubAssign};

/// Elements that one task updates in place.
const STRETCH: usize = 1 << 14;

macro_rules! operator {
    ($trait:ident $method:ident, $assign:ident $assign_method:ident, $op:tt) => {
        impl<T: Scalar> $trait<&Tensor<T>> for &Tensor<T> {
            type Output = Tensor<T>;
            #[track_caller]
            fn $method(self, other: &Tensor<T>) -> Tensor<T> {
                map([self, other], &self.pool(), #[inline(always)] |[a, b]| a $op b)
            }
        }
        impl<T: Scalar> $trait<Tensor<T>> for &Tensor<T> {
            type Output = Tensor<T>;
            #[track_caller]
            fn $method(self, other: Tensor<T>) -> Tensor<T> {
                self $op &other
            }
        }
        impl<T: Scalar> $trait<&Tensor<T>> for Tensor<T> {
            type Output = Tensor<T>;
            #[track_caller]
            fn $method(self, other: &Tensor<T>) -> Tensor<T> {
                &self $op other
            }
        }
        impl<T: Scalar> $trait<Tensor<T>> for Tensor<T> {
            type Output = Tensor<T>;
            #[track_caller]
            fn $method(self, other: Tensor<T>) -> Tensor<T> {
                &self $op &other
            }
        }
        impl<T: Scalar> $trait<T> for &Tensor<T> {
            type Output = Tensor<T>;
            fn $method(self, other: T) -> Tensor<T> {
                self $op &Tensor::scalar(other)
            }
        }
        impl<T: Scalar> $trait<T> for Tensor<T> {
            type Output = Tensor<T>;
            fn $method(self, other: T) -> Tensor<T> {
                &self $op other
            }
        }
        operator!(left f32 $trait $method $op);
        operator!(left f64 $trait $method $op);
        impl<T: Scalar> $assign<&Tensor<T>> for Tensor<T> {
            /// Updates this tensor in place, unless another tensor shares its elements; then it copies them first.
            ///
            /// # Panics
            /// If `other` does not broadcast to the shape of this tensor.
            #[track_caller]
            fn $assign_method(&mut self, other: &Tensor<T>) {
                let other = other.broadcast_to(self.shape());
                self.update(&other, |a, b| a $op b);
            }
        }
        impl<T: Scalar> $assign<Tensor<T>> for Tensor<T> {
            /// Updates this tensor in place, unless another tensor shares its elements; then it copies them first.
            ///
            /// # Panics
            /// If `other` does not broadcast to the shape of this tensor.
            #[track_caller]
            fn $assign_method(&mut self, other: Tensor<T>) {
                self.$assign_method(&other);
            }
        }
        impl<T: Scalar> $assign<T> for Tensor<T> {
            /// Updates this tensor in place, unless another tensor shares its elements; then it copies them first.
            fn $assign_method(&mut self, other: T) {
                let other = Tensor::scalar(other).broadcast_to(self.shape());
                self.update(&other, |a, b| a $op b);
            }
        }
    };
    (left $t:ident $trait:ident $method:ident $op:tt) => {
        impl $trait<&Tensor<$t>> for $t {
            type Output = Tensor<$t>;
            fn $method(self, other: &Tensor<$t>) -> Tensor<$t> {
                map([&Tensor::scalar(self), other], &other.pool(), #[inline(always)] |[a, b]| a $op b)
            }
        }
        impl $trait<Tensor<$t>> for $t {
            type Output = Tensor<$t>;
            fn $method(self, other: Tensor<$t>) -> Tensor<$t> {
                self $op &other
            }
        }
    };
}

operator!(Add add, AddAssign add_assign, +);
operator!(Sub sub, SubAssign sub_assign, -);
operator!(Mul mul, MulAssign mul_assign, *);
operator!(Div div, DivAssign div_assign, /);

impl<T: Scalar> Neg for &Tensor<T> {
    type Output = Tensor<T>;
    fn neg(self) -> Tensor<T> {
        self.map(|x| -x)
    }
}

impl<T: Scalar> Neg for Tensor<T> {
    type Output = Tensor<T>;
    fn neg(self) -> Tensor<T> {
        -&self
    }
}

impl<T: Scalar> Sum for Tensor<T> {
    /// The sum of tensors that broadcast together. For no tensors it is a scalar 0.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    fn sum<I: Iterator<Item = Tensor<T>>>(tensors: I) -> Self {
        tensors.reduce(|a, b| a + b).unwrap_or_else(|| Tensor::scalar(T::ZERO))
    }
}

impl<T: Scalar, const N: usize> Index<[usize; N]> for Tensor<T> {
    type Output = T;
    /// Reads one element: `x[[i, j]]`.
    ///
    /// # Panics
    /// If the number of indices is not the number of axes, or an index is outside its axis.
    #[track_caller]
    fn index(&self, index: [usize; N]) -> &T {
        let inside = N == self.ndim() && index.iter().zip(self.shape()).all(|(i, extent)| i < extent);
        assert!(inside, "no element {index:?} in a tensor of shape {:?}", self.shape());
        let layout = self.layout();
        let steps = index.iter().zip(layout.strides()).map(|(&i, &stride)| i as isize * stride);
        &self.buffer()[(layout.offset() as isize + steps.sum::<isize>()) as usize]
    }
}

macro_rules! method {
    (() unary $f:ident $doc:literal) => {
        #[doc = concat!($doc, "\n\nOf each element.")]
        pub fn $f(&self) -> Self {
            map_real!([self], &self.pool(), |[x]| x.$f())
        }
    };
    (() binary $f:ident $doc:literal) => {
        #[doc = concat!($doc, "\n\nOf the elements of two tensors that broadcast together.\n\n# Panics\nIf the shapes do not broadcast.")]
        #[track_caller]
        pub fn $f(&self, other: impl Into<Self>) -> Self {
            map_real!([self, &other.into()], &self.pool(), |[a, b]| a.$f(b))
        }
    };
}

/// The functions of [`Real`], elementwise.
impl<T: Scalar> Tensor<T> {
    crate::functions!(method());
}

impl<T: Scalar> Tensor<T> {
    /// Applies `f` to each element. Vectorised if `f` has no branches.
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// assert_eq!(Tensor::from([1.0, -2.0]).map(|x| x * x + 1.0), Tensor::from([2.0, 5.0]));
    /// ```
    pub fn map(&self, f: impl Fn(T) -> T + Sync) -> Self {
        map(
            [self],
            &self.pool(),
            #[inline(always)]
            |[x]| f(x),
        )
    }

    /// Applies `f` to the elements of two tensors that broadcast together.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn zip(&self, other: &Self, f: impl Fn(T, T) -> T + Sync) -> Self {
        map(
            [self, other],
            &self.pool(),
            #[inline(always)]
            |[a, b]| f(a, b),
        )
    }

    /// `a = f(a, b)` for the elements `b` of a tensor of the same shape.
    fn update(&mut self, other: &Self, f: impl Fn(T, T) -> T + Sync) {
        let work = ELEMENT * self.len();
        let stretch = |a: &mut [T], b: &[T]| {
            simd::dispatch(
                #[inline(always)]
                || {
                    for (a, &b) in a.iter_mut().zip(b) {
                        *a = f(*a, b);
                    }
                },
            );
        };
        // A transpose is brought into order tile by tile first.
        let turned = other.layout().rows_in_memory().is_some() && !other.layout().strides().contains(&0);
        if other.is_packed() || turned {
            // A separate view: its packed copy is dropped with it.
            let other = other.with_layout(other.layout().clone());
            let b = other.as_slice();
            chunks(self.as_mut_slice(), STRETCH, work, || (), &|(), i, a| stretch(a, &b[i * STRETCH..][..a.len()]));
            return;
        }
        let layout = other.layout();
        let one = if let [one] = *other.buffer() { Some(one) } else { None };
        let scratch = || vec![one.unwrap_or(T::ZERO); STRETCH.min(other.len())];
        chunks(self.as_mut_slice(), STRETCH, work, scratch, &|scratch: &mut Vec<T>, i, a| {
            let b = &mut scratch[..a.len()];
            if one.is_none() {
                layout.read_range(other.buffer(), i * STRETCH, b);
            }
            stretch(a, b);
        });
    }

    /// Each element to the power of a number.
    pub fn powf(&self, exponent: T) -> Self {
        self.pow(Tensor::scalar(exponent))
    }

    /// Each element to an integer power.
    pub fn powi(&self, exponent: i32) -> Self {
        map_real!([self], &self.pool(), |[x]| Real::powi(x, exponent))
    }

    /// The square of each element.
    pub fn square(&self) -> Self {
        self.map(|x| x * x)
    }

    /// Limits each element to `low..=high`; NaN stays NaN. An infinite limit has no effect.
    ///
    /// # Panics
    /// If `low` is above `high`, or if one is NaN.
    #[track_caller]
    pub fn clamp(&self, low: T, high: T) -> Self {
        assert!(low <= high, "clamp: no number is between {low} and {high}");
        self.map(|x| Real::minimum(Real::maximum(x, low), high))
    }

    /// The matrix product over the last two axes, with NumPy's conventions; see [`matmul`](crate::matmul::matmul). A
    /// vector on the left is a row, on the right a column. That axis is missing from the result.
    ///
    /// ```
    /// use raygrad_tensor::Tensor;
    /// let (a, x) = (Tensor::from([[1.0, 2.0], [3.0, 4.0]]), Tensor::from([1.0, 10.0]));
    /// assert_eq!((a.matmul(&x), x.matmul(&a)), (Tensor::from([21.0, 43.0]), Tensor::from([31.0, 42.0])));
    /// ```
    ///
    /// # Panics
    /// If a factor is a scalar, the inner extents differ or the leading axes do not broadcast.
    #[track_caller]
    pub fn matmul(&self, other: &Self) -> Self {
        let (row, column) = (self.ndim() == 1, other.ndim() == 1);
        let [inner, lines] = [self.shape().last(), other.shape().iter().nth_back(if column { 0 } else { 1 })];
        assert!(
            inner.is_some() && inner == lines,
            "matmul of shapes {:?} and {:?}: the inner extents differ",
            self.shape(),
            other.shape()
        );
        let left = if row { self.unsqueeze(0) } else { self.clone() };
        let right = if column { other.unsqueeze(1) } else { other.clone() };
        let mut y = crate::matmul::matmul(&left, &right, &self.pool());
        if column {
            y = y.squeeze(-1);
        }
        if row { y.squeeze(if column { -1 } else { -2 }) } else { y }
    }

    /// Whether the shapes are equal and each element `x` is close to the element `y` of `other`:
    /// `|x - y| <= absolute + relative * |y|`, or `x == y`. NaN is close to no number.
    pub fn allclose(&self, other: &Self, relative: f64, absolute: f64) -> bool {
        let close = |a: f64, b: f64| a == b || (b.is_finite() && (a - b).abs() <= absolute + relative * b.abs());
        self.shape() == other.shape() && self.iter().zip(other.iter()).all(|(a, b)| close(a.to_f64(), b.to_f64()))
    }

    /// The elements in row-major order.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = T> {
        self.as_slice().iter().copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn operators_broadcast_in_every_combination() {
        let (x, row) = (Tensor::from([[1.0, 2.0], [3.0, 4.0_f64]]), Tensor::from([10.0, 20.0]));
        let sum = Tensor::from([[11.0, 22.0], [13.0, 24.0]]);
        assert_eq!(
            (&x + &row, &x + row.clone(), x.clone() + &row, x.clone() + row.clone()),
            (sum.clone(), sum.clone(), sum.clone(), sum.clone())
        );
        assert_eq!(&row - &x, Tensor::from([[9.0, 18.0], [7.0, 16.0]]));
        assert_eq!(12.0 / &x, Tensor::from([[12.0, 6.0], [4.0, 3.0]]));
        assert_eq!((-&x * 2.0 + 1.0).to_vec(), [-1.0, -3.0, -5.0, -7.0]);
        assert_eq!(1.0_f32 - Tensor::from([0.25]), Tensor::from([0.75]));
        let mut y = x.clone();
        y += &row;
        y -= 1.0;
        y *= &Tensor::from([[2.0], [0.0]]);
        y /= 2.0;
        assert_eq!((y.to_vec(), x[[0, 0]]), (vec![10.0, 21.0, 0.0, 0.0], 1.0));
        // In pieces, of views, where they are.
        let (rows, columns) = (700, 300);
        let counted = Tensor::from_fn(&[rows, columns], |i| i as f64);
        let (turned, packed) = (counted.reshape(&[columns, rows]).t(), counted.flip(0).packed());
        let mut large = Tensor::from_vec(&[rows, columns], counted.to_vec());
        let place = large.as_slice().as_ptr();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
        pool.install(|| {
            large += &turned;
            large *= 2.0;
            large -= Tensor::arange(0.0, columns as f64, 1.0);
            large += &packed;
        });
        for (i, value) in large.iter().enumerate() {
            let (row, column) = (i / columns, i % columns);
            let sum = 2.0 * (i + column * rows + row) as f64 - column as f64;
            assert_eq!(value, sum + ((rows - 1 - row) * columns + column) as f64);
        }
        assert!(std::ptr::eq(large.as_slice().as_ptr(), place));
        assert_eq!([x.clone(), x.t(), x.clone()].into_iter().sum::<Tensor<f64>>(), &x * 2.0 + x.t());
        assert_eq!(std::iter::empty::<Tensor<f32>>().sum::<Tensor<f32>>().item(), 0.0);
        assert!(std::panic::catch_unwind(|| &x + &Tensor::zeros(&[3])).is_err());
        let mut narrow = row.clone();
        assert!(
            std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| narrow += &x)).is_err(),
            "it would have to grow"
        );
    }

    #[test]
    fn functions_are_those_of_numbers() {
        let x = Tensor::from([0.3, 1.7, 2.5, -0.4_f64]);
        for (got, f) in [
            (x.exp(), f64::exp as fn(f64) -> f64),
            (x.expm1(), f64::exp_m1),
            (x.abs().ln(), |x| x.abs().ln()),
            (x.ln1p(), f64::ln_1p),
            (x.abs().sqrt(), |x| x.abs().sqrt()),
            (x.sin(), f64::sin),
            (x.cos(), f64::cos),
            (x.tanh(), f64::tanh),
            (x.sigmoid(), |x| 1.0 / (1.0 + (-x).exp())),
            (x.floor(), f64::floor),
            (x.ceil(), f64::ceil),
            (x.round(), f64::round_ties_even),
            (x.powi(3), |x| x * x * x),
            (x.abs().powf(1.5), |x| x.abs().powf(1.5)),
            (x.square(), |x| x * x),
            (x.maximum(0.5), |x| x.max(0.5)),
            (x.minimum(Tensor::from([0.5; 4])), |x| x.min(0.5)),
            (x.clamp(0.0, 2.0), |x| x.clamp(0.0, 2.0)),
        ] {
            assert!(got.allclose(&x.iter().map(f).collect(), 1e-14, 0.0), "{got}");
        }
        let nan = Tensor::from([f64::NAN]);
        assert!(nan.clamp(0.0, 1.0)[[0]].is_nan() && nan.maximum(3.0)[[0]].is_nan() && !nan.allclose(&nan, 1.0, 1.0));
        assert!(!x.allclose(&x.reshape(&[4, 1]), 1.0, 1.0));
        let [one, near] = [1.0, 1.1].map(|x| Tensor::<f64>::from([2.0, x]));
        assert!(one.allclose(&near, 0.1, 0.0) && !one.allclose(&near, 0.09, 0.0));
        assert!(one.allclose(&near, 0.0, 0.11) && !one.allclose(&near, 0.0, 0.09));
        assert!(!Tensor::from([1.0]).allclose(&Tensor::from([f64::INFINITY]), 1.0, 1.0));
    }

    #[test]
    fn elements_are_found_in_views() {
        let x = Tensor::<f32>::arange(0.0, 12.0, 1.0).reshape(&[3, 4]);
        let view = x.t().flip(0);
        assert_eq!((view[[0, 2]], view[[3, 0]], x.sum_over(0)[[1]]), (11.0, 0.0, 15.0));
        assert_eq!(view.iter().nth(1), Some(7.0));
        assert!(std::panic::catch_unwind(|| view[[4, 0]]).is_err() && std::panic::catch_unwind(|| view[[0]]).is_err());
        assert_eq!(x.matmul(&x.t()).shape(), [3, 3]);
    }

    #[test]
    fn vectors_are_rows_and_columns_of_products() {
        let (a, b) =
            (Tensor::from_fn(&[2, 3, 4], |i| (i * 5 % 7) as f64), Tensor::from_fn(&[2, 4, 3], |i| (i * 3 % 5) as f64));
        let (three, four) = (Tensor::from([1.0, -2.0, 3.0]), Tensor::from([2.0, 1.0, 0.5, -1.0]));
        let sum = |n: usize, f: &dyn Fn(usize) -> f64| (0..n).map(f).sum::<f64>();
        let expected = Tensor::from_fn(&[2, 3], |i| sum(4, &|k| a[[i / 3, i % 3, k]] * four[[k]]));
        assert_eq!(a.matmul(&four), expected);
        let expected = Tensor::from_fn(&[2, 4], |i| sum(3, &|k| three[[k]] * a[[i / 4, k, i % 4]]));
        assert_eq!(three.matmul(&a), expected);
        let expected = Tensor::from_fn(&[2, 3, 3], |i| sum(4, &|k| a[[i / 9, i / 3 % 3, k]] * b[[i / 9, k, i % 3]]));
        assert_eq!(a.matmul(&b), expected);
        assert_eq!(four.matmul(&four), Tensor::scalar(6.25));
    }
}
