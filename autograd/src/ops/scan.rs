//! Cumulative sums and products, and the recurrence in their derivatives.

use crate::{Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::{Pool, Scalar, Shape, Tensor};
use std::ops::Range;

/// The order in which a scan walks an axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Walk {
    /// The axis.
    pub axis: usize,
    /// Whether to walk from the last entry to the first.
    pub reverse: bool,
}

impl Walk {
    fn back(self) -> Self {
        Walk { reverse: !self.reverse, ..self }
    }

    fn check(&self, x: &[usize]) -> Result<Shape, ShapeError> {
        if self.axis < x.len() { Ok(Shape::from_slice(x)) } else { Err(format!("there is no axis {}", self.axis)) }
    }

    /// Calls `f(state, i)` for every element in the order of the walk. Each line along the axis has one state, which
    /// starts as `start`. States are f64, so they are not rounded to the type.
    #[inline(always)]
    fn run(self, shape: &[usize], start: f64, mut f: impl FnMut(&mut f64, usize)) {
        let (count, inner) = (shape[self.axis], shape[self.axis + 1..].iter().product::<usize>());
        let outer: usize = shape[..self.axis].iter().product();
        if inner == 1 {
            // Several lines side by side: in one, each entry waits for the entry before.
            const LINES: usize = 8;
            let mut lines = |first: usize, states: &mut [f64]| {
                for step in 0..count {
                    let entry = if self.reverse { count - 1 - step } else { step };
                    for (k, state) in states.iter_mut().enumerate() {
                        f(state, (first + k) * count + entry);
                    }
                }
            };
            let whole = outer - outer % LINES;
            (0..whole).step_by(LINES).for_each(|first| lines(first, &mut [start; LINES]));
            (whole..outer).for_each(|line| lines(line, &mut [start]));
            return;
        }
        walk_rows((0..outer).map(|o| o * count..(o + 1) * count), inner, self.reverse, start, f);
    }

    /// Entry `i` of the result is the entry that the walk passes before `i` (after it with `next`), and `fill` at the
    /// end.
    pub(super) fn neighbour<'t, T: Scalar>(self, x: &Var<'t, T>, next: bool, fill: f64) -> Var<'t, T> {
        let axis = self.axis as isize;
        if x.shape()[self.axis] == 0 {
            return x.clone();
        }
        let mut shape = Shape::from_slice(x.shape());
        shape[self.axis] = 1;
        let end = x.tape().constant(x.tape().pool().full(&shape, T::from_f64(fill)));
        if self.reverse == next {
            Var::concat(&[&end, &x.slice_axis(axis, ..-1)], axis)
        } else {
            Var::concat(&[&x.slice_axis(axis, 1..), &end], axis)
        }
    }
}

/// Calls `f(state, i)` for every element of these ranges of rows, with `inner` elements in a row. It walks from the
/// first row of a range to the last, or in `reverse`. Each column of a range has a state that starts as `start`.
#[inline(always)]
pub(super) fn walk_rows(
    ranges: impl Iterator<Item = Range<usize>>,
    inner: usize,
    reverse: bool,
    start: f64,
    mut f: impl FnMut(&mut f64, usize),
) {
    let mut states = vec![start; inner];
    for rows in ranges {
        states.fill(start);
        for step in 0..rows.len() {
            let row = if reverse { rows.end - 1 - step } else { rows.start + step };
            for (j, state) in states.iter_mut().enumerate() {
                f(state, row * inner + j);
            }
        }
    }
}

/// y = the sum of x up to and including each entry; dx = the sum of g the other way.
#[derive(Clone, Copy)]
pub struct Cumsum(
    /// The order.
    pub Walk,
);

impl<T: Scalar> Op<T> for Cumsum {
    fn name(&self) -> &'static str {
        "cumsum"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        self.0.check(x[0])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(x[0].shape());
        let (x, y, shape) = (x[0].as_slice(), out.as_mut_slice(), x[0].shape());
        self.0.run(shape, 0.0, |sum, i| {
            *sum += x[i].to_f64();
            y[i] = T::from_f64(*sum);
        });
        out
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(Cumsum(self.0.back()), &[cx.g()]))
    }
}

/// y = the product of x up to and including each entry. dx: [`Recurrence`] carries the gradients of all later products
/// back, times the product before the entry. Nothing is divided, so zeros do no harm.
#[derive(Clone, Copy)]
pub struct Cumprod(
    /// The order.
    pub Walk,
);

impl<T: Scalar> Op<T> for Cumprod {
    fn name(&self) -> &'static str {
        "cumprod"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        self.0.check(x[0])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(x[0].shape());
        let (x, y, shape) = (x[0].as_slice(), out.as_mut_slice(), x[0].shape());
        self.0.run(shape, 1.0, |product, i| {
            *product *= x[i].to_f64();
            y[i] = T::from_f64(*product);
        });
        out
    }

    fn reads(&self) -> Reads {
        Reads::ALL
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let next = self.0.neighbour(&cx.x(0), true, 0.0);
        let later = cx.tape().apply(Recurrence(self.0.back()), &[&next, cx.g()]);
        Grads::one(later * self.0.neighbour(&cx.y(), false, 1.0))
    }
}

/// y[i] = a[i] y[i - 1] + b[i], with 0 before the first entry. db: the same recurrence of g in the other direction,
/// with the next factor; da = db y[i - 1].
#[derive(Clone, Copy)]
pub struct Recurrence(
    /// The order.
    pub Walk,
);

impl<T: Scalar> Op<T> for Recurrence {
    fn name(&self) -> &'static str {
        "recurrence"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        if x[0] != x[1] {
            return Err("factors and summands must have one shape".into());
        }
        self.0.check(x[0])
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let mut out = pool.tensor(x[0].shape());
        let (a, b, y, shape) = (x[0].as_slice(), x[1].as_slice(), out.as_mut_slice(), x[0].shape());
        self.0.run(shape, 0.0, |state, i| {
            *state = a[i].to_f64() * *state + b[i].to_f64();
            y[i] = T::from_f64(*state);
        });
        out
    }

    fn reads(&self) -> Reads {
        Reads::only(&[0]).and_output()
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let next = self.0.neighbour(&cx.x(0), true, 0.0);
        let db = cx.tape().apply(Recurrence(self.0.back()), &[&next, cx.g()]);
        let da = cx.needs(0).then(|| &db * self.0.neighbour(&cx.y(), false, 0.0));
        Grads::new([da, Some(db)])
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// A scan along an axis; a scalar counts as one entry.
    #[track_caller]
    fn walk(&self, op: &'static str, axis: isize, reverse: bool, scan: impl Fn(Walk, &Self) -> Self) -> Self {
        if self.shape().is_empty() {
            return self.reshape(&[1]).walk(op, axis, reverse, scan).reshape(&[]);
        }
        let walk = Walk { axis: self.axis(op, axis), reverse };
        self.tape().as_one(|| scan(walk, self))
    }

    /// The cumulative sum along `axis`, with the running sum in f64. Each sum includes its own entry.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn cumsum(&self, axis: isize) -> Self {
        self.walk("cumsum", axis, false, |walk, x| x.tape().apply(Cumsum(walk), &[x]))
    }

    /// The cumulative sum along `axis` from the last entry back, with the running sum in f64. Each sum includes its own
    /// entry.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn reverse_cumsum(&self, axis: isize) -> Self {
        self.walk("reverse_cumsum", axis, true, |walk, x| x.tape().apply(Cumsum(walk), &[x]))
    }

    /// The cumulative product along `axis`, with the running product in f64. Each product includes its own entry. The
    /// gradient is right even if entries are 0.
    ///
    /// # Panics
    /// If the axis does not exist.
    #[track_caller]
    pub fn cumprod(&self, axis: isize) -> Self {
        self.walk("cumprod", axis, false, |walk, x| x.tape().apply(Cumprod(walk), &[x]))
    }

    /// A first-order linear recurrence along `axis`: `y[i] = self[i] y[i - 1] + summand[i]`, with 0 before the first
    /// entry. It computes discounted sums and exponential moving averages.
    ///
    /// # Panics
    /// If the shapes differ or the axis does not exist.
    #[track_caller]
    pub fn recurrence(&self, summand: &Self, axis: isize) -> Self {
        let walk = Walk { axis: self.axis("recurrence", axis), reverse: false };
        self.tape().apply(Recurrence(walk), &[self, summand])
    }
}
