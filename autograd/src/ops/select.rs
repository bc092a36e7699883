//! Choices: comparisons, selection by a mask, and interpolation.

use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor, broadcast_shape, map};

/// y = 1 where the comparison holds, else 0. No gradient.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Compare {
    /// a > b.
    Greater,
    /// a >= b.
    GreaterEqual,
    /// a < b.
    Less,
    /// a <= b.
    LessEqual,
    /// a = b.
    Equal,
    /// a != b.
    NotEqual,
}

fn compared<T: Scalar>(x: &[&Tensor<T>], pool: &Pool<T>, holds: impl Fn(T, T) -> bool + Sync) -> Tensor<T> {
    map(
        [x[0], x[1]],
        pool,
        #[inline(always)]
        |[a, b]| if holds(a, b) { T::ONE } else { T::ZERO },
    )
}

impl<T: Scalar> Op<T> for Compare {
    fn name(&self) -> &'static str {
        "compare"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        broadcast_shape(x).ok_or_else(|| "the shapes do not broadcast".into())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        // A loop for each: inside one, the choice would be made for every element.
        match self {
            Compare::Greater => compared(
                x,
                pool,
                #[inline(always)]
                |a, b| a > b,
            ),
            Compare::GreaterEqual => compared(
                x,
                pool,
                #[inline(always)]
                |a, b| a >= b,
            ),
            Compare::Less => compared(
                x,
                pool,
                #[inline(always)]
                |a, b| a < b,
            ),
            Compare::LessEqual => compared(
                x,
                pool,
                #[inline(always)]
                |a, b| a <= b,
            ),
            Compare::Equal => compared(
                x,
                pool,
                #[inline(always)]
                |a, b| a == b,
            ),
            Compare::NotEqual => compared(
                x,
                pool,
                #[inline(always)]
                |a, b| a != b,
            ),
        }
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, _cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::new([None, None])
    }
}

/// y = yes where the mask is not 0, else no. The mask has no gradient.
#[derive(Clone, Copy)]
pub struct Where;

impl<T: Scalar> Op<T> for Where {
    fn name(&self) -> &'static str {
        "where"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        broadcast_shape(x).ok_or_else(|| "the shapes do not broadcast".into())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        map(
            [x[0], x[1], x[2]],
            pool,
            #[inline(always)]
            |[mask, yes, no]| if mask == T::ZERO { no } else { yes },
        )
    }

    fn reads(&self) -> Reads {
        Reads::only(&[0])
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        // Chosen and not multiplied: an infinite gradient on one side leaves no NaN on the other.
        let (mask, g, zero) = (cx.x(0), cx.g(), cx.g().constant(0.0));
        let yes = cx.needs(1).then(|| g.where_(&mask, &zero).sum_to(cx.shape(1)));
        let no = cx.needs(2).then(|| zero.where_(&mask, g).sum_to(cx.shape(2)));
        Grads::new([None, yes, no])
    }
}

/// y = a + w (b - a), and exactly b for w = 1.
#[derive(Clone, Copy)]
pub struct Lerp;

impl<T: Scalar> Op<T> for Lerp {
    fn name(&self) -> &'static str {
        "lerp"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        broadcast_shape(x).ok_or_else(|| "the shapes do not broadcast".into())
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let half = T::from_f64(0.5);
        map(
            [x[0], x[1], x[2]],
            pool,
            #[inline(always)]
            |[a, b, w]| if w < half { a + w * (b - a) } else { b - (T::ONE - w) * (b - a) },
        )
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let (a, b, w, g) = (cx.x(0), cx.x(1), cx.x(2), cx.g());
        let da = cx.needs(0).then(|| (g * (1.0 - &w)).sum_to(cx.shape(0)));
        let db = cx.needs(1).then(|| (g * &w).sum_to(cx.shape(1)));
        let dw = cx.needs(2).then(|| (g * (&b - &a)).sum_to(cx.shape(2)));
        Grads::new([da, db, dw])
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// Comparisons give constants: they are not on the graph.
    #[track_caller]
    fn compare(&self, comparison: Compare, other: &Self) -> Self {
        self.tape().apply(comparison, &[&self.detach(), &other.detach()])
    }

    /// 1 where `self > other`, else 0, as a constant; broadcasts. A NaN compares as in Rust: it equals nothing.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from_vec(&[3], vec![-2.0, 0.0, 3.0]));
    /// assert_eq!(x.gt(&x.constant(-1.0)).value().as_slice(), [0.0, 1.0, 1.0]);
    /// ```
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn gt(&self, other: &Self) -> Self {
        self.compare(Compare::Greater, other)
    }

    /// 1 where `self >= other`, else 0; see [`gt`](Self::gt).
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn ge(&self, other: &Self) -> Self {
        self.compare(Compare::GreaterEqual, other)
    }

    /// 1 where `self < other`, else 0; see [`gt`](Self::gt).
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn lt(&self, other: &Self) -> Self {
        self.compare(Compare::Less, other)
    }

    /// 1 where `self <= other`, else 0; see [`gt`](Self::gt).
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn le(&self, other: &Self) -> Self {
        self.compare(Compare::LessEqual, other)
    }

    /// 1 where `self == other`, else 0; see [`gt`](Self::gt).
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn eq(&self, other: &Self) -> Self {
        self.compare(Compare::Equal, other)
    }

    /// 1 where `self != other`, else 0; see [`gt`](Self::gt).
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn ne(&self, other: &Self) -> Self {
        self.compare(Compare::NotEqual, other)
    }

    /// `self` where `mask` is not 0, else `other`: PyTorch's `where`, with the underscore because Rust keeps that word
    /// to itself. All three broadcast together. The gradient goes to whichever was chosen, and none to the mask.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f32>::new();
    /// let x = tape.leaf(Tensor::from_vec(&[3], vec![-2.0, 0.0, 3.0]));
    /// let y = x.square().where_(&x.lt(&x.constant(1.0)), &x);
    /// assert_eq!(y.value().as_slice(), [4.0, 0.0, 3.0]);
    /// assert_eq!(y.sum().grad(&[&x])[0].as_slice(), [-4.0, 0.0, 1.0]);
    /// ```
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn where_(&self, mask: &Self, other: &Self) -> Self {
        self.tape().apply(Where, &[mask, self, other])
    }

    /// `self + weight * (end - self)`: linear interpolation, exact at weights 0 and 1; broadcasts.
    ///
    /// # Panics
    /// If the shapes do not broadcast.
    #[track_caller]
    pub fn lerp(&self, end: &Self, weight: &Self) -> Self {
        self.tape().apply(Lerp, &[self, end, weight])
    }
}

#[cfg(test)]
mod tests {
    use crate::{Tape, Tensor};

    #[test]
    fn comparisons_are_constants_and_nan_equals_nothing() {
        let tape = Tape::<f64>::new();
        let a = tape.leaf(Tensor::from_vec(&[4], vec![1.0, 2.0, f64::INFINITY, f64::NAN]));
        let b = tape.leaf(Tensor::from_vec(&[4], vec![2.0, 2.0, f64::INFINITY, f64::NAN]));
        let all = [a.gt(&b), a.ge(&b), a.lt(&b), a.le(&b), a.eq(&b), a.ne(&b)];
        let expected = [[0, 0, 0, 0], [0, 1, 1, 0], [1, 0, 0, 0], [1, 1, 1, 0], [0, 1, 1, 0], [1, 0, 0, 1]];
        for (got, expected) in all.iter().zip(expected) {
            assert!(!got.is_on_graph());
            assert_eq!(got.value().as_slice(), expected.map(f64::from));
        }
        assert_eq!(a.gt(&tape.constant(Tensor::zeros(&[0, 1]))).shape(), [0, 4]);
    }

    #[test]
    fn an_infinite_gradient_on_one_side_of_a_choice_leaves_the_other_alone() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::from_vec(&[2], vec![0.0, 4.0]));
        let y = x.sqrt().where_(&x.gt(&x.constant(1.0)), &x).sum();
        // The root's own slope at 0 is infinite, and 0 times it is NaN: the user must keep the root away from 0.
        let safe = x.maximum(&x.constant(1.0)).sqrt().where_(&x.gt(&x.constant(1.0)), &x).sum();
        assert!(y.grad(&[&x])[0].as_slice()[0].is_nan());
        assert_eq!(safe.grad(&[&x])[0].as_slice(), [1.0, 0.25]);
    }

    #[test]
    fn interpolation_meets_its_ends_exactly() {
        let tape = Tape::<f32>::new();
        let (a, b) = (tape.leaf(Tensor::scalar(1e8)), tape.leaf(Tensor::scalar(0.1)));
        assert_eq!(a.lerp(&b, &a.constant(1.0)).item(), 0.1);
        assert_eq!(a.lerp(&b, &a.constant(0.0)).item(), 1e8);
    }
}
