//! The cross-entropy of logits and classes.

use super::gradient_op::{FusedGradient, GradientOp};
use super::softmax::{column, softmax_times};
use crate::error::ensure;
use crate::{Axes, Grads, Op, Reads, ShapeError, Var, Vjp};
use raygrad_tensor::rows::{cross_entropy_rows, cross_entropy_rows_grad};
use raygrad_tensor::{Indices, Mask, Pool, Real, Scalar, Shape, Tensor, map, mean_to};
use std::sync::Arc;

/// y = ln sum e^x - x[class] of each row of logits: `[.., n]` to `[..]`; dx = g (softmax - 1 at the class).
#[derive(Clone)]
pub struct CrossEntropy {
    /// The class of each row.
    pub classes: Arc<[u32]>,
}

impl<T: Scalar> Op<T> for CrossEntropy {
    fn name(&self) -> &'static str {
        "cross_entropy"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let Some((&n, rest)) = x[0].split_last() else { return Err("a scalar has no classes".into()) };
        let rows: usize = rest.iter().product();
        if rows != self.classes.len() {
            return Err(format!("{} classes for {rows} rows", self.classes.len()));
        }
        match self.classes.iter().enumerate().find(|&(_, &class)| class as usize >= n) {
            Some((i, class)) => Err(format!("row {i} has class {class}, but there are {n} classes")),
            None => Ok(Shape::from_slice(rest)),
        }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let axes = x[0].ndim() - 1;
        let mut out = pool.tensor(&x[0].shape()[..axes]);
        cross_entropy_rows(x[0].as_slice(), x[0].shape()[axes], &self.classes, out.as_mut_slice(), pool);
        out
    }

    fn reads(&self) -> Reads {
        Reads::INPUTS
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        Grads::one(cx.tape().apply(GradientOp { op: self.clone(), input: 0 }, &[&cx.x(0), cx.g()]))
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        let axes = x[0].shape().len() - 1;
        let mut column = Shape::from_slice(x[0].shape());
        column[axes] = 1;
        let logs = x[0].log_softmax(-1).gather(-1, Indices::new(&column, self.classes.clone()));
        Some(-logs.reshape(&x[0].shape()[..axes]))
    }
}

impl<T: Scalar> FusedGradient<T> for CrossEntropy {
    const GRADIENT: &'static str = "cross_entropy_grad";

    fn gradient(&self, _input: usize, x: &[&Tensor<T>], g: &Tensor<T>, pool: &Pool<T>) -> Tensor<T> {
        let (n, mut out) = (x[0].shape()[x[0].ndim() - 1], pool.tensor(x[0].shape()));
        cross_entropy_rows_grad(x[0].as_slice(), n, &self.classes, g.as_slice(), out.as_mut_slice(), pool);
        out
    }

    fn recorded<'t>(&self, _input: usize, x: &[Var<'t, T>], g: &Var<'t, T>) -> Option<Var<'t, T>> {
        let x = &x[0];
        let n = x.shape()[x.shape().len() - 1];
        // The gradient at the class is minus the sum of the others: the probability minus 1 would cancel.
        let is_class = (0..x.value().len()).map(|i| self.classes[i / n] as usize == i % n);
        let is_class = Mask::new(x.shape(), is_class.collect::<Vec<_>>());
        let others = x.constant(0.0).where_(&is_class, softmax_times(x, &column(g)));
        Some((-others.sum_over(Axes::from(-1).keepdims())).where_(&is_class, others))
    }
}

/// y = the mean of the [cross-entropies](CrossEntropy) of rows, given these and the logits; the gradient of a row is
/// g / n. Where the loss of a row overflows and the mean does not, the mean follows from the logits.
#[derive(Clone)]
pub struct MeanCrossEntropy {
    /// The class of each row.
    pub classes: Arc<[u32]>,
}

impl<T: Scalar> Op<T> for MeanCrossEntropy {
    fn name(&self) -> &'static str {
        "mean_cross_entropy"
    }

    fn shape(&self, x: &[&[usize]]) -> Result<Shape, ShapeError> {
        let losses = Op::<T>::shape(&CrossEntropy { classes: self.classes.clone() }, &x[1..])?;
        if x[0] == losses.as_slice() { Ok(Shape::new()) } else { Err("not one loss for each row".into()) }
    }

    fn forward(&self, x: &[&Tensor<T>], pool: &Pool<T>) -> Tensor<T> {
        let (mean, [losses, logits]) = (mean_to(x[0], &[], pool), [x[0], x[1]]);
        if mean.is_finite() || losses.is_empty() || !logits.is_finite() {
            return mean;
        }
        let [down, up] = [0.25, 4.0].map(T::from_f64);
        let mut small = losses.clone();
        let rows = logits.as_slice().chunks_exact(logits.len() / losses.len());
        for ((loss, row), &class) in small.as_mut_slice().iter_mut().zip(rows).zip(self.classes.iter()) {
            // Beside a difference that overflows, the logarithm of the sum is that of its largest term.
            let most = || row.iter().copied().reduce(Real::maximum).unwrap_or(T::ZERO);
            *loss = if loss.is_finite() { *loss * down } else { most() * down - row[class as usize] * down };
        }
        map([&mean_to(&small, &[], pool)], pool, |[mean]| mean * up)
    }

    fn reads(&self) -> Reads {
        Reads::NOTHING
    }

    fn vjp<'t>(&self, cx: &Vjp<'t, '_, T>) -> Grads<'t, T> {
        let shape = cx.shape(0);
        Grads::new([Some(cx.g().spread_to(shape)), None])
    }

    fn reference<'t>(&self, x: &[Var<'t, T>]) -> Option<Var<'t, T>> {
        Some(x[0].mean())
    }
}

impl<'t, T: Scalar> Var<'t, T> {
    /// The cross-entropy of each row of logits, `-ln softmax(row)[class]`: `[.., n]` to `[..]`. `classes` has one class
    /// below `n` for each row, as a list or an array `[..]`.
    ///
    /// ```
    /// use raygrad_autograd::{Tape, Tensor};
    /// let tape = Tape::<f64>::new();
    /// let logits = tape.leaf(Tensor::from([[0.0, 0.0], [3.0_f64.ln(), 0.0]]));
    /// let loss = logits.cross_entropy(&[1, 0]);
    /// assert!((loss.value().as_slice()[0] - 2.0_f64.ln()).abs() < 1e-15); // 1/2 for the right class
    /// assert!((loss.value().as_slice()[1] - (4.0_f64 / 3.0).ln()).abs() < 1e-15); // 3/4
    /// ```
    ///
    /// # Panics
    /// If there is not one class for each row, or one is not below `n`.
    #[track_caller]
    pub fn cross_entropy(&self, classes: impl Into<Indices>) -> Self {
        let classes = classes.into();
        // One list, or an array of the rows' shape.
        let rows = self.shape().split_last().map_or(&[][..], |(_, rows)| rows);
        let fits = classes.shape().len() == 1 || classes.shape() == rows;
        let what = || format!("classes of shape {:?} for rows of shape {rows:?}", classes.shape());
        self.fits("cross_entropy", ensure(fits, what));
        self.tape().apply(CrossEntropy { classes: classes.values().clone() }, &[self])
    }

    /// The mean of [`cross_entropy`](Self::cross_entropy) over the rows, as a scalar; NaN for no rows.
    ///
    /// # Panics
    /// Where [`cross_entropy`](Self::cross_entropy) panics.
    #[track_caller]
    pub fn cross_entropy_loss(&self, classes: impl Into<Indices>) -> Self {
        let classes = classes.into();
        let losses = self.cross_entropy(classes.clone());
        self.tape().apply(MeanCrossEntropy { classes: classes.values().clone() }, &[&losses, self])
    }
}

#[cfg(test)]
mod tests {
    use crate::{Tape, Tensor};

    #[test]
    #[should_panic(expected = "row 1 has class 3, but there are 3 classes")]
    fn a_class_that_does_not_exist_is_reported() {
        let tape = Tape::<f32>::new();
        let _ = tape.constant(Tensor::zeros(&[2, 3])).cross_entropy_loss([0, 3]);
    }
}
