//! Formulas on a tape: numbers that stand for variables.

use crate::ops::activation::LogisticDensity;
use crate::ops::arithmetic::MulAdd;
use crate::ops::trigonometric::Cosine;
use crate::{Formula, Var};
use raygrad_tensor::{Plain, Real, Scalar};
use std::array::from_fn;
use std::cell::RefCell;
use std::ops::{Add, Div, Mul, Neg, Sub};

/// A number inside a formula that [`record`] writes on a tape.
#[derive(Clone, Copy)]
pub struct Recorded<'s, 't, T: Scalar> {
    sheet: &'s Sheet<'t, T>,
    index: usize,
}

/// The origin of a number.
enum Step<'t, T: Scalar> {
    Given(Var<'t, T>),
    Constant(f64),
    Unary(fn(&Var<'t, T>) -> Var<'t, T>, usize),
    Binary(fn(&Var<'t, T>, &Var<'t, T>) -> Var<'t, T>, [usize; 2]),
    Powi(i32, usize),
    IfPositive([usize; 3]),
    MulAdd([usize; 3]),
}

impl<'t, T: Scalar> Step<'t, T> {
    fn operands(&self) -> &[usize] {
        match self {
            Step::Given(_) | Step::Constant(_) => &[],
            Step::Unary(_, x) | Step::Powi(_, x) => std::slice::from_ref(x),
            Step::Binary(_, x) => x,
            Step::IfPositive(x) | Step::MulAdd(x) => x,
        }
    }
}

/// A formula as a list of steps, before any is computed. Steps that the results do not need are never computed.
pub(crate) struct Sheet<'t, T: Scalar>(RefCell<Vec<Step<'t, T>>>);

impl<'t, T: Scalar> Sheet<'t, T> {
    pub(crate) fn new() -> Self {
        Sheet(RefCell::new(vec![]))
    }

    fn push(&self, step: Step<'t, T>) -> Recorded<'_, 't, T> {
        let mut steps = self.0.borrow_mut();
        steps.push(step);
        Recorded { sheet: self, index: steps.len() - 1 }
    }

    pub(crate) fn given(&self, x: Var<'t, T>) -> Recorded<'_, 't, T> {
        self.push(Step::Given(x))
    }

    pub(crate) fn constant(&self, value: f64) -> Recorded<'_, 't, T> {
        self.push(Step::Constant(value))
    }

    /// The results on the tape of `any`.
    #[track_caller]
    pub(crate) fn vars(&self, any: &Var<'t, T>, results: &[Recorded<'_, 't, T>]) -> Vec<Var<'t, T>> {
        let steps = self.0.borrow();
        let mut needed = vec![false; steps.len()];
        results.iter().for_each(|result| needed[result.index] = true);
        // Operands come before what is made of them.
        for i in (0..steps.len()).rev() {
            if needed[i] {
                steps[i].operands().iter().for_each(|&operand| needed[operand] = true);
            }
        }
        let mut vars: Vec<Var<'t, T>> = Vec::with_capacity(steps.len());
        any.tape().as_one(|| {
            for (step, needed) in steps.iter().zip(needed) {
                vars.push(match step {
                    _ if !needed => any.clone(),
                    Step::Given(x) => x.clone(),
                    Step::Constant(value) => any.constant(*value),
                    Step::Unary(f, x) => f(&vars[*x]),
                    Step::Binary(f, [a, b]) => f(&vars[*a], &vars[*b]),
                    Step::Powi(exponent, x) => vars[*x].powi(*exponent),
                    Step::IfPositive([x, yes, no]) => vars[*x].if_positive(&vars[*yes], &vars[*no]),
                    Step::MulAdd(x) => MulAdd.on(x.map(|x| &vars[x])),
                });
            }
        });
        results.iter().map(|result| vars[result.index].clone()).collect()
    }
}

/// Runs a function of numbers on variables, and records it operation by operation. For functions that are generic over
/// [`Real`] and have several results. For a function with one result, a [`Formula`](crate::Formula) is faster: it runs
/// in one pass.
///
/// ```
/// use raygrad_autograd::{Real, Tape, Tensor, record};
///
/// fn polar<E: Real>([x, y]: [E; 2]) -> [E; 2] {
///     [(x * x + y * y).sqrt(), y.atan2(x)]
/// }
///
/// assert_eq!(polar([3.0, 4.0])[0], 5.0);
/// let tape = Tape::<f64>::new();
/// let (x, y) = (tape.leaf(Tensor::scalar(3.0)), tape.leaf(Tensor::scalar(4.0)));
/// let [radius, _] = record([&x, &y], |point| polar(point));
/// assert!((radius.grad(&[&x])[0].item() - 0.6).abs() < 1e-15);
/// ```
///
/// # Panics
/// If shapes that meet in an operation do not broadcast, or `N` is 0 and `M` is not.
#[track_caller]
pub fn record<'t, T: Scalar, const N: usize, const M: usize>(
    x: [&Var<'t, T>; N],
    formula: impl for<'s> FnOnce([Recorded<'s, 't, T>; N]) -> [Recorded<'s, 't, T>; M],
) -> [Var<'t, T>; M] {
    let sheet = Sheet::new();
    let results = formula(x.map(|x| sheet.given(x.clone())));
    assert!(N > 0 || M == 0, "{M} results of no variable: a function of constants needs no tape");
    // Not in a closure, which would hide the caller's line.
    let vars = match x.first() {
        Some(x) => sheet.vars(x, &results),
        None => vec![],
    };
    from_fn(|i| vars[i].clone())
}

impl<'t, T: Scalar> Recorded<'_, 't, T> {
    fn unary(self, f: fn(&Var<'t, T>) -> Var<'t, T>) -> Self {
        self.sheet.push(Step::Unary(f, self.index))
    }

    fn binary(self, other: Self, f: fn(&Var<'t, T>, &Var<'t, T>) -> Var<'t, T>) -> Self {
        self.sheet.push(Step::Binary(f, [self.index, other.index]))
    }
}

macro_rules! operator {
    ($($trait:ident $method:ident)*) => {
        $(
            impl<T: Scalar> $trait for Recorded<'_, '_, T> {
                type Output = Self;
                fn $method(self, other: Self) -> Self {
                    self.binary(other, |a, b| a.$method(b))
                }
            }
        )*
    };
}

operator! { Add add Sub sub Mul mul Div div }

impl<T: Scalar> Neg for Recorded<'_, '_, T> {
    type Output = Self;
    fn neg(self) -> Self {
        self.unary(|x| -x)
    }
}

macro_rules! recorded {
    (() unary $f:ident $doc:literal) => {
        fn $f(self) -> Self {
            self.unary(Var::$f)
        }
    };
    (() binary $f:ident $doc:literal) => {
        fn $f(self, other: Self) -> Self {
            self.binary(other, |a, b| a.$f(b))
        }
    };
}

impl<T: Scalar> Real for Recorded<'_, '_, T> {
    fn like(&self, value: f64) -> Self {
        self.sheet.constant(value)
    }
    fn if_positive(&self, yes: Self, no: Self) -> Self {
        self.sheet.push(Step::IfPositive([self.index, yes.index, no.index]))
    }
    fn powi(self, exponent: i32) -> Self {
        self.sheet.push(Step::Powi(exponent, self.index))
    }
    fn mul_add(self, factor: Self, summand: Self) -> Self {
        self.sheet.push(Step::MulAdd([self.index, factor.index, summand.index]))
    }
    fn logistic_density(self) -> Self {
        self.unary(|x| LogisticDensity.on([x]))
    }
    fn along(self, a: Self, b: Self, _length: Self) -> Self {
        self * a.binary(b, |a, b| Cosine.on([a, b]))
    }
    type Wide = Plain<Self>;
    raygrad_tensor::functions!(recorded());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Tape, Tensor};

    #[test]
    fn what_no_result_needs_is_not_recorded() {
        let tape = Tape::<f64>::new();
        let x = tape.leaf(Tensor::scalar(0.5));
        let before = tape.len();
        let [y] = record([&x], |[x]| {
            let _unused = x.exp().sin() / x;
            [x * x]
        });
        assert_eq!((tape.len() - before, y.item()), (1, 0.25));
        let [same] = record([&x], |x| x);
        assert_eq!(same.grad(&[&x])[0].item(), 1.0);
        let [] = record::<f64, 0, 0>([], |[]| []);
    }
}
