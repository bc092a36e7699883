//! Arithmetic of variables with variables, tensors and numbers.

use crate::{Tape, Var, ops};
use raygrad_tensor::{Scalar, Tensor};
use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, DivAssign, Mul, MulAssign, Neg, Sub, SubAssign};

/// The other operand of a variable: a variable, or a tensor or number as a constant.
///
/// ```
/// use raygrad_autograd::{Tape, Tensor};
/// let tape = Tape::<f32>::new();
/// let x = tape.leaf(Tensor::from([1.0, -2.0]));
/// let weights = Tensor::from([10.0, 1.0]);
/// assert_eq!((2.0 * &x * &weights).value(), &Tensor::from([20.0, -4.0]));
/// assert_eq!(x.maximum(0.0).mse_loss(&weights).item(), 41.0);
/// ```
pub trait Operand<'t, T: Scalar> {
    /// This operand as a variable on `tape`.
    fn on(self, tape: &'t Tape<T>) -> Var<'t, T>;
}

impl<'t, T: Scalar> Operand<'t, T> for Var<'t, T> {
    fn on(self, _tape: &'t Tape<T>) -> Var<'t, T> {
        self
    }
}

impl<'t, T: Scalar> Operand<'t, T> for &Var<'t, T> {
    fn on(self, _tape: &'t Tape<T>) -> Var<'t, T> {
        self.clone()
    }
}

impl<'t, T: Scalar> Operand<'t, T> for Tensor<T> {
    fn on(self, tape: &'t Tape<T>) -> Var<'t, T> {
        tape.constant(self)
    }
}

impl<'t, T: Scalar> Operand<'t, T> for &Tensor<T> {
    fn on(self, tape: &'t Tape<T>) -> Var<'t, T> {
        tape.constant(self.clone())
    }
}

/// Number types that become constants of the tape's type: `f32`, `f64` and `i32`.
pub trait Constant: Copy {
    /// The number as `f64`, without rounding.
    fn number(self) -> f64;
}

macro_rules! constant {
    ($($t:ty)+) => {
        $(
            impl Constant for $t {
                fn number(self) -> f64 {
                    self.into()
                }
            }
            impl<'t, T: Scalar> Operand<'t, T> for $t {
                fn on(self, tape: &'t Tape<T>) -> Var<'t, T> {
                    tape.constant(Tensor::scalar(T::from_f64(self.into())))
                }
            }
        )+
    };
}

constant!(f32 f64 i32);

/// An operator for every pair of operand types. `$op` takes references to variables. `$right` and `$left` take a number
/// on that side.
macro_rules! operator {
    ($trait:ident $method:ident, $assign:ident $assign_method:ident, $op:expr, |$x:ident, $c:ident| $right:expr, $left:expr) => {
        operator!(pair $trait $method ['t] (&Var<'t, T>) (&Var<'t, T>) |a, b| $op(a, b));
        operator!(pair $trait $method ['t] (&Var<'t, T>) (Var<'t, T>) |a, b| $op(a, &b));
        operator!(pair $trait $method ['t] (Var<'t, T>) (&Var<'t, T>) |a, b| $op(&a, b));
        operator!(pair $trait $method ['t] (Var<'t, T>) (Var<'t, T>) |a, b| $op(&a, &b));
        operator!(pair $trait $method ['t] (&Var<'t, T>) (&Tensor<T>) |a, b| $op(a, &b.on(a.tape())));
        operator!(pair $trait $method ['t] (&Var<'t, T>) (Tensor<T>) |a, b| $op(a, &b.on(a.tape())));
        operator!(pair $trait $method ['t] (Var<'t, T>) (&Tensor<T>) |a, b| $op(&a, &b.on(a.tape())));
        operator!(pair $trait $method ['t] (Var<'t, T>) (Tensor<T>) |a, b| $op(&a, &b.on(a.tape())));
        operator!(pair $trait $method ['t] (&Tensor<T>) (&Var<'t, T>) |a, b| $op(&a.on(b.tape()), b));
        operator!(pair $trait $method ['t] (&Tensor<T>) (Var<'t, T>) |a, b| $op(&a.on(b.tape()), &b));
        operator!(pair $trait $method ['t] (Tensor<T>) (&Var<'t, T>) |a, b| $op(&a.on(b.tape()), b));
        operator!(pair $trait $method ['t] (Tensor<T>) (Var<'t, T>) |a, b| $op(&a.on(b.tape()), &b));
        impl<'t, T: Scalar, C: Constant> $trait<C> for &Var<'t, T> {
            type Output = Var<'t, T>;
            #[track_caller]
            fn $method(self, c: C) -> Var<'t, T> {
                let ($x, $c) = (self, c.number());
                $right
            }
        }
        impl<'t, T: Scalar, C: Constant> $trait<C> for Var<'t, T> {
            type Output = Var<'t, T>;
            #[track_caller]
            fn $method(self, c: C) -> Var<'t, T> {
                let ($x, $c) = (&self, c.number());
                $right
            }
        }
        operator!(pair $trait $method ['t] (f64) (&Var<'t, T>) |$c, $x| $left);
        operator!(pair $trait $method ['t] (f64) (Var<'t, T>) |c, x| {
            let ($c, $x) = (c, &x);
            $left
        });
        impl<'t, T: Scalar, O> $assign<O> for Var<'t, T>
        where
            for<'a> &'a Var<'t, T>: $trait<O, Output = Var<'t, T>>,
        {
            /// Replaces this variable with the result. The tape keeps the old value as long as a gradient needs it.
            #[track_caller]
            fn $assign_method(&mut self, other: O) {
                *self = $trait::$method(&*self, other);
            }
        }
    };
    (pair $trait:ident $method:ident [$t:lifetime] ($a:ty) ($b:ty) |$x:ident, $y:ident| $result:expr) => {
        impl<$t, T: Scalar> $trait<$b> for $a {
            type Output = Var<$t, T>;
            #[track_caller]
            fn $method(self, other: $b) -> Var<$t, T> {
                let ($x, $y) = (self, other);
                $result
            }
        }
    };
}

// A product adds -0, which changes no number: +0 would turn -0 into +0.
operator!(Add add, AddAssign add_assign, ops::add, |x, c| x.affine(1.0, c), x.affine(1.0, c));
operator!(Sub sub, SubAssign sub_assign, ops::sub, |x, c| x.affine(1.0, -c), x.affine(-1.0, c));
operator!(Mul mul, MulAssign mul_assign, ops::mul, |x, c| x.affine(c, -0.0), x.affine(c, -0.0));
operator!(Div div, DivAssign div_assign, ops::div, |x, c| x / x.constant(c), x.constant(c) / x);

impl<'t, T: Scalar> Neg for &Var<'t, T> {
    type Output = Var<'t, T>;
    #[track_caller]
    fn neg(self) -> Var<'t, T> {
        self.affine(-1.0, -0.0)
    }
}

impl<'t, T: Scalar> Neg for Var<'t, T> {
    type Output = Var<'t, T>;
    #[track_caller]
    fn neg(self) -> Var<'t, T> {
        -&self
    }
}

impl<'t, T: Scalar> Sum for Var<'t, T> {
    /// The sum of variables that broadcast together, in order.
    ///
    /// # Panics
    /// If there are none, since a result needs a tape. If the shapes do not broadcast; the message then names the line
    /// of `Iterator::sum`.
    #[track_caller]
    fn sum<I: Iterator<Item = Var<'t, T>>>(vars: I) -> Self {
        let mut vars = vars;
        let mut sum = vars.next().expect("the sum of no variables belongs to no tape");
        for x in vars {
            sum += x;
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn operand_forms_agree_only_vars_get_gradients() {
        let tape = Tape::<f32>::new();
        let (a, b) = (Tensor::from([3.0, -1.5]), Tensor::from([0.5, 4.0]));
        let (x, y) = (tape.leaf(a.clone()), tape.leaf(b.clone()));
        macro_rules! all {
            ($op:tt) => {
                let expected = &a $op &b;
                let results = [
                    &x $op &y, &x $op y.clone(), x.clone() $op &y, x.clone() $op y.clone(),
                    &x $op &b, &x $op b.clone(), x.clone() $op &b, x.clone() $op b.clone(),
                    &a $op &y, &a $op y.clone(), a.clone() $op &y, a.clone() $op y.clone(),
                ];
                for (i, result) in results.iter().enumerate() {
                    assert_eq!(result.value(), &expected, "form {i}");
                    let wrt = if i < 8 { &x } else { &y };
                    assert!(result.sum().try_grad(&[wrt]).is_ok() && (i < 4 || result.sum().grad(&[wrt])[0] == results[0].sum().grad(&[wrt])[0]));
                }
                let numbers = [&x $op 0.5, &x $op 0.5_f32, x.clone() $op 0.5];
                assert!(numbers.iter().all(|result| result.value() == &(&a $op 0.5)));
                assert_eq!((&x $op 2).value(), &(&a $op 2.0));
                assert_eq!([(0.5 $op &x).value(), (0.5 $op x.clone()).value()], [&(0.5 $op &a), &(0.5 $op &a)]);
            };
        }
        all!(+);
        all!(-);
        all!(*);
        all!(/);
        let mut z = x.clone();
        z += &y;
        z *= 2.0;
        z -= &b;
        z /= x.clone();
        assert_eq!(z.value(), &(((&a + &b) * 2.0 - &b) / &a));
        let total: Var<'_, f32> = [&x, &y, &x].into_iter().cloned().sum();
        assert_eq!((total.value(), &total.sum().grad(&[&x])[0]), (&(&a + &b + &a), &Tensor::full(&[2], 2.0)));
    }
}
